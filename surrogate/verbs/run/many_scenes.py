"""Runs of many molecules on Dask: each in a folder of its own, one table of results, failures with their reasons."""

from __future__ import annotations

import math
import queue
import re
import uuid
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from md_reference.campaign.campaign_file import (
    SCENE_FILES,
    SceneSpec,
    file_name_of,
    name_of,
    read_campaign,
)
from md_reference.campaign.cluster import guarded, open_client, poll, result_of, stop
from surrogate.progress import progress_bar
from surrogate.verbs.options import RunOptions, tell
from surrogate.verbs.run.decision import LEAST_BUDGET_S
from surrogate.verbs.run.one_scene import run_scene
from surrogate.verbs.run.results_page import write_results
from surrogate.verbs.run.run_record import RUN_NAME, read_run
from surrogate.verbs.run.run_result import RunResult
from systems.errors import InputError, PreparationError, SimulationError
from systems.files.outside import content
from systems.files.whole_file import create_whole
from systems.interrupts import deferred_interrupt
from systems.options import Preparation
from systems.units import format_wall

if TYPE_CHECKING:
    from systems.scene import Scene

LIST_NAME = "molecules.txt"
_LIST_SUFFIXES = (".smi", ".smiles")
# What other programs call the first column of a list; no SMILES reads so.
_TITLE = re.compile(r"\W*([a-z]+[ _-]?)?smi(les)?\W*", re.IGNORECASE)
_POLL_EVERY_S = 2.0
# Workers that were asked to stop have so long to come to the end of a frame.
_STOP_PATIENCE_S = 60.0


@dataclass(frozen=True)
class Molecules:
    """Molecules to run. `unreadable`: the reasons of those that are none, by name."""

    scenes: tuple[SceneSpec, ...]
    unreadable: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class MoleculeTask:
    """One molecule as a worker gets it: `folder` is its own, `witness` the list beside it."""

    token: str
    witness: str
    folder: str
    source: str
    options: RunOptions


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
    if not options.quiet:
        for name, reason in failed.items():
            tell(name, reason)
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


def run_molecule(task: MoleculeTask) -> dict[str, Any]:
    """Run a molecule on a worker, or go on with it, and return how it ended."""

    def work() -> dict[str, Any]:
        folder = Path(task.folder)
        is_there = (folder / RUN_NAME).is_file()
        options = replace(task.options, resume=is_there, overwrite=False)
        run_scene(task.source, folder, options, lambda record: None)
        return {}

    return guarded(task.token, Path(task.witness), work)


def _hand_out(specs: list[SceneSpec], folder: Path, options: RunOptions, client: Any, advance: Any) -> dict[str, str]:
    """Run molecules on the client's workers and return the reasons of those that failed."""
    token, ended = uuid.uuid4().hex, queue.SimpleQueue[tuple[str, Any]]()
    if options.overwrite:
        _forget(specs, folder)
    waiting = {}
    for spec in specs:
        own = {key: value for key, value in spec.preparation.items() if key in {f.name for f in fields(Preparation)}}
        task = MoleculeTask(token, str((folder / LIST_NAME).resolve()), str((folder / spec.name).resolve()),
                            spec.source, replace(options, cores=1, quiet=True, **own))  # fmt: skip
        future = client.submit(run_molecule, task, key=f"surromd-{token}-{spec.name}", pure=False)
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
                    if not options.quiet:
                        tell(name, reason)
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


def _forget(specs: list[SceneSpec], folder: Path) -> None:
    for spec in specs:
        (folder / spec.name / RUN_NAME).unlink(missing_ok=True)


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
    return line | {key: value for key, value in outcome.items() if key != "notes"}
