"""The verb `run`: a scene and a budget in, an evaluated trajectory out, by whatever way pays best on this machine; and
runs of many molecules on Dask, each in a folder of its own, with one table of results."""

from __future__ import annotations

import json
import math
import queue
import re
import uuid
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from md_reference.campaign.campaign_file import (
    SCENE_FILES,
    SceneSpec,
    file_name_of,
    name_of,
    read_campaign,
)
from md_reference.campaign.cluster import guarded, open_client, poll, result_of, stop
from surrogate.progress import progress_bar
from surrogate.verbs.options import PathLike, RunOptions, tell
from surrogate.verbs.run.decision import LEAST_BUDGET_S, table
from surrogate.verbs.run.one_scene import plan_scene, run_scene
from surrogate.verbs.run.run_record import RUN_NAME, RunResult, read_run
from systems.errors import InputError, PreparationError, SimulationError
from systems.files.outside import content
from systems.files.whole_file import create_whole
from systems.interrupts import deferred_interrupt
from systems.options import Preparation, options_as_keywords
from systems.scene import Scene
from systems.units import format_time_ps, format_wall

LIST_NAME, PAGE_NAME, RESULTS_NAME = "molecules.txt", "index.html", "results.json"
_HEADS = (
    "Molecule",
    "Way",
    "Evaluated",
    "Held-out MD",
    "Equivalent MD time",
    "Speed-up at least",
    "Verdict",
    "Wall time",
)
_LIST_SUFFIXES = (".smi", ".smiles")
# What other programs call the first column of a list; no SMILES reads so.
_TITLE = re.compile(r"\W*([a-z]+[ _-]?)?smi(les)?\W*", re.IGNORECASE)
_POLL_EVERY_S = 2.0
# Workers that were asked to stop have so long to come to the end of a frame.
_STOP_PATIENCE_S = 60.0


@options_as_keywords(RunOptions)
def run(scene: PathLike | Scene, out: PathLike | None = None, *, options: RunOptions) -> dict[str, Any]:
    """Simulate a molecule in `budget_s` of wall time by whatever way pays best here, evaluate it, and return the
    record.

    What MD and the weights that cover the scene simulate is measured in the first seconds, and decides: weights that
    cover it and outrun MD are rolled for a short while to find the states, and MD runs from their frames; where nothing
    covers it and MD is cheap, MD takes the whole budget, its replicas beginning in many states (`starts`); at
    `level='gfn2-xtb'` a potential learns the molecule first. `way` overrides that. `dry_run`: the decision alone. The
    answer is MD's: its transitions give populations, free energies and timescales with errors (`equilibrium.json`), and
    each frame of MD a weight (`sm.frame_weights`); the surrogate's count with them where MD is too short, and it is
    reported beside that.

    The folder `out` holds `report.html`, whose first line says what was achieved, the trajectory, `reference/`, the
    weights that were trained, `run.json` (the record that is returned: rates, decision, stages, seeds, versions) and
    `log.txt`. Ctrl-C and a kill lose nothing that was written; `resume` goes on, within the same budget.

    Many molecules are a list of SMILES (.smi: one a line, a name behind it), a folder of structure files, or the
    [[scenes]] of a campaign's TOML: they share the budget, a core each, on Dask's `workers`, and `out` holds a folder
    for each and one table of results, index.html. What fails is listed with its reason.
    Raises InputError, PreparationError, OutOfDomainError (`weights` that do not cover the scene), SimulationError.
    """
    molecules = molecules_in(scene)
    if options.dry_run and molecules is not None:
        raise InputError("`dry_run` takes one molecule: each is measured and decided by itself.")
    if options.dry_run:
        record = plan_scene(scene, options)
        assert record.rates is not None and record.decision is not None
        return {"decision_table": table(record.rates, record.decision, options.budget_s), **record.to_dict()}
    if out is None:
        raise InputError("name a folder for the trajectory and the report with `out`.")
    folder = Path(out)
    if molecules is not None:
        return run_many(molecules, folder, options)

    run_scene(scene, folder, options)
    return RunResult.of(folder)


# ---- many molecules ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Molecules:
    """Molecules to run. `unreadable`: the reasons of those that are none, by name."""

    scenes: tuple[SceneSpec, ...]
    unreadable: dict[str, str] = field(default_factory=dict)


def molecules_in(given: str | Path | Scene) -> Molecules | None:
    """Return the molecules that a user means by a list of SMILES, a folder of structures or a campaign's file; None for
    one scene. Every SMILES is read, so that one that is none takes no share of a budget. Raises InputError for a list
    that names no molecule."""
    if not isinstance(given, str | Path):
        return None
    path = Path(given)
    if path.suffix == ".toml":
        campaign = read_campaign(path)
        return Molecules(campaign.scenes, _unreadable(campaign.scenes))
    if path.suffix.lower() in _LIST_SUFFIXES:
        found = _smiles(path)
    elif path.is_dir():
        found = [(str(file.resolve()), "") for file in sorted(path.iterdir()) if file.suffix.lower() in SCENE_FILES]
    else:
        return None
    if not found:
        raise InputError(f"{path} names no molecule.")
    specs = [SceneSpec(name or name_of(source), source, "", {}) for source, name in found]
    names = [spec.name.lower() for spec in specs]
    if twice := next((name for name in names if names.count(name) > 1), ""):
        raise InputError(f"{path}: two molecules are called {twice!r}; name them apart.")
    unreadable = _unreadable(specs)
    if len(unreadable) == len(specs):
        raise InputError(f"{path}: no line begins with a SMILES that can be read: {unreadable[specs[0].name]}")
    return Molecules(tuple(specs), unreadable)


def _smiles(path: Path) -> list[tuple[str, str]]:
    """Return the molecules of a list: a SMILES a line, and a name behind it, to the next tab, if there is one. A
    first line that names its columns is none."""
    try:
        lines = content(path).decode("utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as a list of SMILES: {error}.") from None
    words = [line.split(maxsplit=1) for line in lines if line.strip() and not line.startswith("#")]
    if words and _TITLE.fullmatch(words[0][0]):
        del words[0]
    names = [rest[0].partition("\t")[0].strip() if rest else "" for _, *rest in words]
    return [(f"smiles:{line[0]}", file_name_of(name) if name else "") for line, name in zip(words, names, strict=True)]


def _unreadable(specs: Sequence[SceneSpec]) -> dict[str, str]:
    """Return why, by name, of those that are given as SMILES and are none."""
    from systems.prepare.molecule import parse_smiles

    found = {}
    for spec in specs:
        kind, _, text = spec.source.partition(":")
        if kind.lower() == "smiles":
            try:
                parse_smiles(text.strip(), [])
            except PreparationError as error:
                found[spec.name] = str(error)
    return found


def run_many(molecules: Molecules, folder: Path, options: RunOptions) -> dict[str, Any]:
    """Run every molecule within `options.budget_s` in all and return the results (JSON-able), failures among them.

    Each gets an equal share of the workers' time and one core. Molecules that are done are not run again. Raises
    InputError for a folder that is not ours or a budget too short to evaluate each, KeyboardInterrupt with what is
    kept.
    """
    _open_folder(molecules, folder, options)
    failed = dict(molecules.unreadable)
    lacking = [spec for spec in molecules.scenes if spec.name not in failed and not _is_done(folder / spec.name)]
    for name, reason in failed.items():
        tell(name, reason, quiet=options.quiet)
    if lacking:
        with open_client(workers=options.workers, scheduler=options.scheduler) as client:
            each = replace(options, budget_s=_share_s(len(lacking), client, options.budget_s))
            with progress_bar(f"run {len(lacking)} molecules", quiet=options.quiet) as advance:
                failed |= _hand_out(lacking, folder, each, client, advance)
    results = [_result(spec, folder / spec.name, failed.get(spec.name, "")) for spec in molecules.scenes]
    write_results(folder, results)
    n_done = sum(not result["failed"] for result in results)
    return {
        "file": str(folder),
        "type": "runs",
        "summary": f"{n_done} of {len(results)} molecules evaluated",
        "molecules": results,
        "failed": {result["name"]: result["failed"] for result in results if result["failed"]} or None,
    }


def _open_folder(molecules: Molecules, folder: Path, options: RunOptions) -> None:
    listed = "".join(f"{spec.name}\t{spec.source}\n" for spec in molecules.scenes)
    witness = folder / LIST_NAME
    if witness.is_file() and not (options.resume or options.overwrite):
        raise InputError(f"{folder} holds runs; add `resume=True` to go on, or `overwrite=True` to start over.")
    if not witness.is_file() and folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder} is not empty and holds no runs of molecules; name another.")
    if options.resume and witness.is_file() and witness.read_text("utf-8") != listed:
        raise InputError(f"{folder} holds runs of other molecules; name another.")
    folder.mkdir(parents=True, exist_ok=True)
    create_whole(witness, listed)


def _is_done(folder: Path) -> bool:
    return (folder / RUN_NAME).is_file() and read_run(folder).outcome is not None


def _share_s(n: int, client: Any, budget_s: float) -> float:
    """Return the wall seconds of each of `n` molecules."""
    width = len(client.scheduler_info(n_workers=-1)["workers"])
    each_s = budget_s / math.ceil(n / max(1, width))
    if each_s < LEAST_BUDGET_S:
        raise InputError(
            f"{n} molecules on {width} workers have {format_wall(each_s)} each, too short to evaluate anything; use a "
            f"`budget_s` of {format_wall(math.ceil(n / width) * LEAST_BUDGET_S)} or more."
        )
    return each_s


def run_molecule(token: str, witness: str, folder: str, source: str, options: RunOptions) -> dict[str, Any]:
    """Run a molecule on a worker into its own `folder`, or go on with it, and return how it ended; `witness` is the
    list beside it."""

    def work() -> dict[str, Any]:
        is_there = (Path(folder) / RUN_NAME).is_file()
        run_scene(source, Path(folder), replace(options, resume=is_there, overwrite=False))
        return {}

    return guarded(token, Path(witness), work)


def _hand_out(specs: list[SceneSpec], folder: Path, options: RunOptions, client: Any, advance: Any) -> dict[str, str]:
    """Run molecules on the client's workers and return the reasons of those that failed."""
    token, ended = uuid.uuid4().hex, queue.SimpleQueue[tuple[str, Any]]()
    if options.overwrite:
        for spec in specs:
            (folder / spec.name / RUN_NAME).unlink(missing_ok=True)
    witness = str((folder / LIST_NAME).resolve())
    waiting = {}
    for spec in specs:
        own = {key: value for key, value in spec.preparation.items() if key in {f.name for f in fields(Preparation)}}
        task = token, witness, str((folder / spec.name).resolve()), spec.source
        options_of_it = replace(options, cores=1, quiet=True, **own)
        future = client.submit(run_molecule, *task, options_of_it, key=f"surromd-{token}-{spec.name}", pure=False)
        waiting[spec.name] = future
        future.add_done_callback(lambda done, name=spec.name: ended.put((name, done)))
    failed: dict[str, str] = {}
    with deferred_interrupt() as asked_to_stop:
        while waiting:
            with suppress(queue.Empty):
                name, done = ended.get(timeout=_POLL_EVERY_S)
                del waiting[name]
                if (reason := _reason(done)) and not asked_to_stop():
                    failed[name] = reason
                    tell(name, reason, quiet=options.quiet)
            # Workers that hear nothing for a minute stop by themselves.
            client.run(poll, token, on_error="ignore")
            if advance is not None:
                advance(len(specs) - len(waiting), len(specs), f"{len(specs) - len(waiting)}/{len(specs)}")
            if asked_to_stop():
                client.run(stop, token, on_error="ignore")
                from distributed import wait

                with suppress(Exception):
                    wait(list(waiting.values()), timeout=_STOP_PATIENCE_S)
                raise KeyboardInterrupt(f"{folder} keeps what was done; the same again with `resume=True` goes on")
    return failed


def _reason(future: Any) -> str:
    """Return why a task failed, empty where it did not."""
    try:
        result = result_of(future)
    except SimulationError as error:
        return str(error)
    return "" if result["status"] == "complete" else str(result.get("reason", "stopped"))


def _result(spec: SceneSpec, folder: Path, failed: str) -> dict[str, Any]:
    """Return a molecule's line of the table."""
    line: dict[str, Any] = {"name": spec.name, "scene": spec.source, "failed": failed}
    if not (folder / RUN_NAME).is_file():
        return line | {"failed": failed or "not begun"}
    record = RunResult.of(folder)
    outcome, decision = record["outcome"], record["decision"]
    line |= {"formula": record["formula"], "way": decision["way"] if decision else "", "wall_s": record["spent_s"]}
    if outcome is None:
        return line | {"failed": failed or "not done"}
    return line | outcome


def write_results(folder: Path, results: list[dict[str, Any]]) -> None:
    """Write the table of results into a folder whose subfolders hold the runs, those that failed with their reasons."""
    create_whole(folder / RESULTS_NAME, json.dumps(results, indent=1) + "\n")
    style = files("surrogate.comparison.report").joinpath("report.css").read_text("utf-8")
    heads = "".join(f"<th>{head}</th>" for head in _HEADS)
    rows = "\n".join(_row(result) for result in results)
    n_failed = sum(bool(result["failed"]) for result in results)
    page = f"""<!doctype html> <html lang="en"> <head> <meta charset="utf-8"> <meta http-equiv="Content-Security-Policy"
content="default-src 'none'; style-src 'unsafe-inline'"> <meta name="viewport" content="width=device-width,
initial-scale=1"> <meta name="color-scheme" content="light dark"> <title>{len(results)} molecules</title> <style>
{style} </style> </head> <body> <h1>{len(results)} molecules, {n_failed} failed</h1> <table class="stack">
<thead><tr>{heads}</tr></thead> <tbody> {rows} </tbody> </table> </body> </html>
"""
    create_whole(folder / PAGE_NAME, page)


def _row(result: dict[str, Any]) -> str:
    name = escape(result["name"])
    if result["failed"]:
        reason = f'<td colspan="{len(_HEADS) - 1}">failed: {escape(result["failed"])}</td>'
        return f'<tr><th scope="row">{name}</th>{reason}</tr>'
    cells = (
        result["way"],
        format_time_ps(result["rolled_ps"], 2),
        format_time_ps(result["held_out_ps"], 2),
        result["equivalent_time"] or "-",
        "" if result["speed_up"] is None else f"{result['speed_up']:.2g}",
        "; ".join([result["verdict"], *result["notes"]]),
        format_wall(result["wall_s"]),
    )
    columns = "".join(f'<td data-label="{head}">{escape(cell)}</td>' for head, cell in zip(_HEADS[1:], cells))
    return f'<tr><th scope="row"><a href="{quote(result["name"])}/report.html">{name}</a></th>{columns}</tr>'
