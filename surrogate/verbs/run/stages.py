"""The stages of a run, each one call of a verb: its files stay, so that it can be stopped at any moment and gone on."""

from __future__ import annotations

import importlib
import itertools
import json
import math
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogate.verbs.compare import compare
from surrogate.verbs.options import MDSettings, ReferenceOptions, RolloutOptions, RunOptions, TrainOptions
from surrogate.verbs.outputs import accounted_outputs
from surrogate.verbs.rollout import rollout
from surrogate.verbs.run.decision import Decision, Stage, expected_errors, md_ps, table
from surrogate.verbs.run.outcome_words import Costs, outcome
from surrogate.verbs.run.rates import Rates, Rolls, rollout_rate
from surrogate.verbs.run.run_record import RunRecord
from surrogate.verbs.train import train
from systems.errors import InputError, SimulationError
from systems.files.whole_file import create_whole
from systems.options import Preparation

if TYPE_CHECKING:
    from md_reference.run.config import MDConfig
    from surrogate.judge.comparison import Comparison
    from surrogate.judge.md_answer import Answer
    from systems.scene import Scene

# A run may turn out faster than measured, and have the machine for itself: the clock, not its length, ends it.
_AMPLE = 2.0
_LEAST_FRAMES = 20
# Of MD from frames of a rollout is left out so much: what is local has forgotten the model by then.
_LEFT_OUT_PS = 20.0
# Of a training's time what may go into steps, and must; processor seconds that do not: weights are tried out, frames
# read and encoded (of an atom in a frame), which may take so large a share.
_OPTIMISING, _LEAST_OPTIMISING = 0.95, 0.1
_BESIDE_STEPS_S, _ENCODING_S, _ENCODING = 9.0, 1.2e-5, 0.3
# Of a potential's rollout goes into annealing, at most: what turns once in a ns would keep the state it was built in.
_ANNEAL_PS, _ANNEAL = 50.0, 0.2
# Runs of one scene whose seeds differ by this are independent, replicas and all.
_SEEDS_APART = 10_000
# What a stage takes a third of its time, or ten seconds, to load when it is the first to.
_LOADED_BEFORE: dict[Stage, tuple[str, ...]] = {
    "report": ("deeptime.decomposition", "matplotlib.figure", "matplotlib.backends.backend_svg", "jinja2", "mdtraj"),
    "train": ("torch", "lightning_fabric", "matplotlib.backends.backend_svg", "surrogate.models.lam_slide.trainer"),
}
WEIGHTS_NAME, ANSWER_NAME, REPORT_NAME = "weights.safetensors", "equilibrium.json", "report.html"


@dataclass(frozen=True, eq=False)
class Site:
    """Where a run takes place: its folder, the scene, the settings of its MD, and what was asked for."""

    folder: Path
    scene: Scene
    config: MDConfig
    options: RunOptions


@dataclass(frozen=True)
class StageOf:
    """`work(site, record)` does a stage and returns the record with what it made; `found(site, record)`
    returns it with what there is after a stop, None for nothing. `may_fail`: a run goes on without it."""

    work: Callable[[Site, RunRecord], RunRecord]
    found: Callable[[Site, RunRecord], RunRecord | None]
    may_fail: bool = False


def _rates_and_decision(record: RunRecord) -> tuple[Rates, Decision]:
    assert record.rates is not None and record.decision is not None
    return record.rates, record.decision


def _md_stage(name: Stage, place: str, seed: int) -> StageOf:
    """Return a stage of MD into `place`, by the fastest way, replicas on all cores.

    Where SIMD replicas have failed in this run, it is OpenMM's, in files beside theirs.
    """

    def outs(site: Site, replicas: int, mark: str = "") -> list[Path]:
        from systems.files.whole_file import replica_paths

        return replica_paths(site.folder / f"{place}{mark}.{site.options.format if name == 'md' else 'h5'}", replicas)

    def by_now(site: Site, record: RunRecord) -> list[Path]:
        assert record.rates is not None
        return outs(site, record.rates.replicas, "-openmm" if record.simd_failed else "")

    def work(site: Site, record: RunRecord) -> RunRecord:
        from md_reference.run.replicas import simulate_replicas

        rates, decision = _rates_and_decision(record)
        every_ps = decision.save_every_ps
        expected_ps = md_ps(rates, decision, name) / rates.replicas
        config = replace(
            site.config,
            time_ps=every_ps * max(_LEAST_FRAMES, math.ceil(_AMPLE * rates.stretch * expected_ps / every_ps)),
            save_every_ps=every_ps,
            equilibrate_ps=min(site.config.equilibrate_ps, decision.equilibrate_ps),
            platform=rates.platform,
            seed=site.options.seed + seed * _SEEDS_APART,
        )
        files = by_now(site, record)
        files[0].parent.mkdir(exist_ok=True)

        def heard(said: str | SimulationError) -> None:
            if (
                isinstance(said, SimulationError) and rates.at_once > 1
            ):  # what is left of SIMD replicas is no reason to wait
                raise said

        with accounted_outputs(files):
            starts, config = _starts(site, record, config, files)
            simulate_replicas(starts, config, files, resume=True, announce=heard)
        done = found(site, record)
        if done is None:
            raise InputError("MD wrote fewer than two frames, too few to judge.")
        return done

    def found(site: Site, record: RunRecord) -> RunRecord | None:
        parts = [by_now(site, record)] + ([outs(site, record.simd_failed)] if record.simd_failed else [])
        files = [_with_frames(site.folder, part) for part in parts]
        together = tuple(itertools.chain(*files))
        if not together:
            return None
        if name == "held-out md":  # beside what an only replica has left to it
            return replace(record, held_out=tuple(dict.fromkeys((*record.held_out, *together))))
        if name == "training md":
            return replace(record, training=together)
        n_own = [-(-len(part) // 2) for part in files]
        own = [part[:n] for part, n in zip(files, n_own, strict=True)]
        held = [part[n:] for part, n in zip(files, n_own, strict=True)]
        return replace(record, trajectory=tuple(itertools.chain(*own)), held_out=tuple(itertools.chain(*held)))

    return StageOf(work, found)


def _starts(site: Site, record: RunRecord, config: MDConfig, files: list[Path]) -> tuple[Scene | list[Scene], MDConfig]:
    """Return where replicas of MD begin, and their settings: at frames of the rollout, drawn over all its states, where
    there is one, else at states of hot MD, which takes a small part of their time."""
    from md_reference.run.starts import HOT_PS, frames_as_starts, many_starts
    from surrogate.judge.md_answer import frames_over_states
    from surrogate.judge.read.ensemble import load_ensemble
    from systems.trajectory.checkpoint import checkpoint_path

    rates, decision = _rates_and_decision(record)
    if config.starts == "one" or len(files) < 2:
        return site.scene, config
    rolled = None
    if decision.way != "md" and record.trajectory:
        rolled = load_ensemble([site.folder / file for file in record.trajectory])
        if rolled.scene.n_atoms != site.scene.n_atoms:  # water was not rolled
            rolled = None
    if rolled is not None:
        left_out_ps = max(config.equilibrate_ps, min(_LEFT_OUT_PS, 2.5 * config.equilibrate_ps))
        config = replace(config, starts="rollout", equilibrate_ps=left_out_ps)
    if all(path.exists() or checkpoint_path(path).exists() for path in files):
        return site.scene, config
    if rolled is not None:
        with suppress(SimulationError):
            frames = frames_over_states(rolled, 2 * len(files), seed=site.options.seed)
            return list(frames_as_starts(site.scene, config, frames, len(files)).scenes), config
    # On one core, while the others wait.
    hot_ps = min(HOT_PS, 1.2 * config.equilibrate_ps / rates.cores)
    return list(many_starts(site.scene, config, len(files), hot_ps=hot_ps).scenes), config


def md_options(options: RunOptions, **more: Any) -> ReferenceOptions:
    """Return what `reference` is told of a run's MD: its settings, and `more`."""
    given = {f.name: getattr(options, f.name) for kind in (MDSettings, Preparation) for f in fields(kind)}
    return ReferenceOptions(**{**given, "time_ps": 0.0, "quiet": True, **more})


def _with_frames(folder: Path, paths: list[Path]) -> tuple[str, ...]:
    """Return the files that can be judged: one frame tells no interval."""
    from systems.trajectory.checkpoint import frames_in

    return tuple(str(path.relative_to(folder)) for path in paths if frames_in(path) > 1)


def _train(site: Site, record: RunRecord) -> RunRecord:
    from surrogate.sampling.choice import weights_to_go_on_from

    out = site.folder / WEIGHTS_NAME
    _, decision = _rates_and_decision(record)
    dear, seconds = decision.way == "potential", decision.seconds("train")
    files, beside_s = _to_train_on(site, record, seconds)
    if not dear and beside_s > (1.0 - _LEAST_OPTIMISING) * seconds:
        raise InputError(f"it takes {beside_s:.0f} s beside its steps, and has {seconds:.0f} s.")
    options = TrainOptions(
        level=site.options.level if dear else None,
        start_from=None if dear else weights_to_go_on_from(site.scene),
        # A potential's budget covers all it does, that of others their steps. They are tried out when they are written.
        budget_s=seconds if dear else min(seconds - beside_s, _OPTIMISING * seconds),
        seed=site.options.seed,
        resume=True,
        quiet=True,
    )
    train(site.scene if dear else files, out, options=options)
    return _rolling(site, record) or record


def _to_train_on(site: Site, record: RunRecord, seconds: float) -> tuple[list[Path], float]:
    """Return as many of the files to train on as can be encoded in time, and the wall seconds of all but the steps."""
    from systems.trajectory.checkpoint import frames_in

    rates, _ = _rates_and_decision(record)
    stretch = max(1.0, rates.stretch * rates.alone)
    files: list[Path] = []
    encoding_s = 0.0
    for path in (site.folder / file for file in record.training):
        encoding_s += stretch * _ENCODING_S * rates.n_atoms * frames_in(path)
        if files and encoding_s > _ENCODING * seconds:
            break
        files.append(path)
    return files, stretch * _BESIDE_STEPS_S + min(encoding_s, _ENCODING * seconds)


def _trained(site: Site, record: RunRecord) -> RunRecord | None:
    """Return the record with the weights that were trained, None where they roll nothing."""
    with suppress(SimulationError):
        return _rolling(site, record)
    return None


def _rolling(site: Site, record: RunRecord) -> RunRecord | None:
    """Return the record with the weights that were trained, and how fast they roll. Raises SimulationError."""
    from surrogate.data.weights import load_weights

    out = site.folder / WEIGHTS_NAME
    if not out.exists():
        return None
    rates, _ = _rates_and_decision(record)
    try:
        weights = load_weights(out)
        rolled = rollout_rate(site.scene, weights, site.config.temperature_k, rates.stretch, rates.cores)
    except SimulationError as error:
        raise SimulationError(f"its weights roll nothing: {str(error).partition(';')[0]}.") from error
    return replace(record, weights=WEIGHTS_NAME, rates=replace(rates, rolls=replace(rolled, weights=WEIGHTS_NAME)))


def _rolled_paths(site: Site, rolls: Rolls) -> list[Path]:
    from systems.files.whole_file import replica_paths

    return replica_paths(site.folder / f"trajectory/surrogate.{site.options.format}", rolls.replicas)


def _roll(site: Site, record: RunRecord) -> RunRecord:
    rates, decision = _rates_and_decision(record)
    assert rates.rolls is not None
    every_ps = rates.rolls.lag_ps * math.ceil(decision.save_every_ps / rates.rolls.lag_ps - 1e-6)
    expected_ps = decision.seconds("rollout") * rates.rolls.ps_per_s / rates.rolls.replicas
    own = site.folder / WEIGHTS_NAME
    out = site.folder / f"trajectory/surrogate.{site.options.format}"
    out.parent.mkdir(exist_ok=True)
    rollout(
        site.scene,
        own if record.weights == WEIGHTS_NAME else record.weights,
        out,
        options=RolloutOptions(
            time_ps=every_ps * max(_LEAST_FRAMES, math.ceil(_AMPLE * rates.stretch * expected_ps / every_ps)),
            save_every_ps=every_ps,
            temperature_k=site.config.temperature_k,
            seed=site.options.seed,
            replicas=rates.rolls.replicas,
            anneal_ps=min(_ANNEAL_PS, _ANNEAL * expected_ps) if rates.dear else 0.0,
            # Of a potential only the truth could mend frames; a replica that flies apart must not end the others.
            guard="resample" if rates.dear else "repair",
            resume=True,
            quiet=True,
        ),
    )
    return _rolled(site, record) or record


def _rolled(site: Site, record: RunRecord) -> RunRecord | None:
    rates, _ = _rates_and_decision(record)
    if rates.rolls is None:
        return None
    files = _with_frames(site.folder, _rolled_paths(site, rates.rolls))
    return replace(record, trajectory=files) if files else None


def costs_of(record: RunRecord, comparison: Comparison, held_ps: float) -> Costs:
    """Return what the trajectory that a comparison judges has cost, beside what `held_ps` of the run's own held-out MD
    did."""
    spent, rates = record.spent_in, _rates_and_decision(record)[0]
    # The faster of what was measured before and what it came to: the gain is a lower bound.
    md_ps_per_s = max(rates.md_ps_per_s, held_ps / spent.get("held-out md", math.inf))
    training_s = spent.get("train", 0.0) + spent.get("training md", 0.0)
    # What reading weights takes is no part of it: a longer rollout does it once, too.
    rolling_s = comparison.judgements[0].account.wall_s or spent.get("rollout", 0.0)
    return Costs(rolling_s, training_s, md_ps_per_s, record.settings["budget_s"])


def worth_saying(notes: tuple[str, ...]) -> tuple[str, ...]:
    """Return a comparison's notes without the one that files were stopped: the clock ends a stage, as is planned."""
    from surrogate.judge.read.ensemble import STOPPED

    return tuple(note for note in notes if not note.startswith(STOPPED))


def answer_of(site: Site, record: RunRecord) -> Answer | None:
    """Return what all MD of a run says of equilibrium, written into its folder, each frame's weight into its file; None
    where it tells nothing."""
    from surrogate.judge.md_answer import md_answer
    from surrogate.judge.read.ensemble import load_ensemble
    from systems.trajectory.codec import write_weights

    is_md = _rates_and_decision(record)[1].way == "md"
    files = [site.folder / file for file in (*(record.trajectory if is_md else ()), *record.held_out)]
    rolled = None if is_md else load_ensemble([site.folder / file for file in record.trajectory])
    md = load_ensemble(files, template=None if rolled is None else rolled.scene)
    try:
        answer = md_answer(md, site.config.temperature_k, surrogate=rolled, seed=site.options.seed)
    except InputError:
        return None
    if len(answer.weights) == len(files):
        for path, weights in zip(files, answer.weights, strict=True):
            write_weights(path, weights)
    create_whole(site.folder / ANSWER_NAME, json.dumps(answer.to_dict(), indent=1, allow_nan=False) + "\n")
    return answer


def _report(site: Site, record: RunRecord) -> RunRecord:
    from surrogate.judge.report.report import Foreword, write_report

    rates, decision = _rates_and_decision(record)
    if not record.held_out or not record.trajectory:
        lacking = "the trajectory" if record.held_out else "MD to judge it by"
        raise InputError(f"{lacking} came to nothing in its time; `resume=True` with a longer `budget_s` goes on.")
    answer = answer_of(site, record)
    held = [site.folder / file for file in record.held_out]
    truth, other = (held, None) if len(held) < 2 else (held[: len(held) // 2], held[len(held) // 2 :])
    label = "MD" if decision.way == "md" else "surrogate"
    comparison = compare(truth, [[site.folder / file for file in record.trajectory]], replicate=other, labels=[label])
    comparison = replace(comparison, notes=worth_saying(comparison.notes))
    held_ps = comparison.reference.total_ps + (comparison.replicate.total_ps if comparison.replicate else 0.0)
    notes = tuple(f"{entry.name}: {entry.note}" for entry in record.stages if entry.note)
    found = outcome(decision.way, comparison, costs_of(record, comparison, held_ps), answer, notes)
    lines = [*(answer.table() if answer else ()), *table(rates, decision, site.options.budget_s)]
    if answer is not None and answer.timescales_ps:
        errors = expected_errors(rates, decision, answer.timescales_ps[0], answer.model_error)
        said = ", ".join(f"{100 * error:.2g} % by {name}" for name, error in errors.items())
        lines.append(("expected error", f"of a population, in this budget: {said}"))
    write_report(
        comparison,
        site.folder / REPORT_NAME,
        command=f"surromd run {record.scene!r} -o {site.folder.name}",
        foreword=Foreword(
            found.headline, "States by MD, and how the budget was spent", [*lines, *(("note", note) for note in notes)]
        ),
    )
    return replace(record, outcome=found)


def load_beside(coming: Stage) -> None:
    """Load the libraries of a stage that is to come, beside other work."""

    def load() -> None:
        with suppress(ImportError, RuntimeError):  # the stage says what is missing; or the program is at its end
            for name in _LOADED_BEFORE.get(coming, ()):
                importlib.import_module(name)

    threading.Thread(target=load, name=f"libraries of {coming}").start()


def _nothing(site: Site, record: RunRecord) -> RunRecord | None:
    return None


STAGES: dict[str, StageOf] = {
    "training md": _md_stage("training md", "reference/training", 2),
    "md": _md_stage("md", "trajectory/md", 0),
    "held-out md": _md_stage("held-out md", "reference/held_out", 1),
    "train": StageOf(_train, _trained, may_fail=True),
    "rollout": StageOf(_roll, _rolled, may_fail=True),
    "report": StageOf(_report, _nothing),
}
