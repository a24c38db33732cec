"""The stages of a run, each one call of a verb: its files stay, so that it can be stopped at any moment and gone on.
The last one is the report, which puts into words what came of the run."""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from md_reference.forces.mixture import dry_part
from md_reference.run.config import MDConfig
from surrogate.comparison.answer import Answer
from surrogate.comparison.md_answer import frames_over_states, md_answer
from surrogate.comparison.read.ensemble import STOPPED, Ensemble, load_ensemble
from surrogate.comparison.verdict import LEAST_SAMPLES
from surrogate.models.architecture import weights_path
from surrogate.verbs.compare import compare
from surrogate.verbs.inputs import summarised_outputs
from surrogate.verbs.options import MDSettings, ReferenceOptions, RolloutOptions, RunOptions, TrainOptions
from surrogate.verbs.run.decision import Decision, Stage, Way, md_ps, table
from surrogate.verbs.run.rates import Rates, rollout_rate
from surrogate.verbs.run.run_record import ANSWER_NAME, ENERGIES_NAME, REPORT_NAME, Outcome, RunRecord
from surrogate.verbs.simulate import rollout
from surrogate.verbs.train import train
from systems.errors import InputError, SimulationError
from systems.files.schema import built
from systems.files.whole_file import create_whole, replica_paths
from systems.options import Preparation
from systems.scene import Scene
from systems.trajectory.checkpoint import checkpoint_path, frames_in
from systems.trajectory.codec import frame_factors, open_trajectory, write_weights
from systems.units import format_time_ps, format_wall

if TYPE_CHECKING:
    from md_reference.forces.umbrella import Umbrella
    from surrogate.comparison.comparison import Comparison, Evaluation, Summary
    from surrogate.comparison.equivalent_time import EquivalentTime

# A run may turn out faster than measured, and have the machine for itself: the clock, not its length, ends it.
_AMPLE = 2.0
_LEAST_FRAMES = 20
# Of MD from frames of a rollout is left out so much: what is local has forgotten the model by then.
_LEFT_OUT_PS = 20.0
# Of a potential's rollout goes into annealing, at most: what turns once in a ns would keep the state it was built in.
_ANNEAL_PS, _ANNEAL = 50.0, 0.1
# In each of its frames, 0.1 ps, for four forces beside 25 (`docs/studies/quantum/reweighted_runs.py`).
_TORSION_MOVES = 3
# Of MD's time goes into relaxing frames of a rollout to begin at; in less, fewer replicas begin apart, but so many.
_STARTING, _LEAST_STARTS = 0.15, 4
# Frames of MD under an umbrella potential count differently, so that it takes many.
_WEIGHED_EVERY_PS = 1.0
# Runs of one scene whose seeds differ by this are independent, replicas and all.
_SEEDS_APART, _UMBRELLA_SEED = 10_000, 2
# Of a run's report, where frames have weights.
UNWEIGHTED = (
    "This comparison counts all frames alike; their weights at equilibrium are in the lines on top, in the maps below "
    "them and in the files."
)
# Of the time for energies of frames, so that they are written before it is up.
_ASKING = 0.9
BY_ITSELF = (
    "Reference, replicate and candidate are replicas of one rollout: MD at this level would be too short to compare "
    "with."
)
WEIGHTS_NAME = "weights.safetensors"


class Site(NamedTuple):
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
        return replica_paths(site.folder / f"{place}{mark}.{site.options.format if name == 'md' else 'h5'}", replicas)

    def by_now(site: Site, record: RunRecord) -> list[Path]:
        assert record.rates is not None
        return outs(site, record.rates.replicas, "-openmm" if record.simd_failed else "")

    def work(site: Site, record: RunRecord) -> RunRecord:
        _simulate(site, record, by_now(site, record), name, seed)
        done = found(site, record)
        if done is None:
            raise InputError("MD wrote fewer than two frames, too few to evaluate.")
        return done

    def found(site: Site, record: RunRecord) -> RunRecord | None:
        parts = [by_now(site, record)] + ([outs(site, record.simd_failed)] if record.simd_failed else [])
        files = [_with_frames(site.folder, part) for part in parts]
        together = tuple(itertools.chain(*files))
        if not together:
            return None
        if name == "held-out md":  # beside what an only replica has left to it
            return replace(record, held_out=tuple(dict.fromkeys((*record.held_out, *together))))
        n_own = [-(-len(part) // 2) for part in files]
        own = [part[:n] for part, n in zip(files, n_own, strict=True)]
        held = [part[n:] for part, n in zip(files, n_own, strict=True)]
        return replace(record, trajectory=tuple(itertools.chain(*own)), held_out=tuple(itertools.chain(*held)))

    return StageOf(work, found)


def _simulate(site: Site, record: RunRecord, files: list[Path], name: Stage, seed: int) -> None:
    """Simulate replicas of a stage into `files`, until it is over."""
    from md_reference.run.replicas import simulate_replicas

    rates, config = _rates_and_decision(record)[0], _config(site, record, name, seed)
    files[0].parent.mkdir(exist_ok=True)

    def heard(said: str | SimulationError) -> None:
        if isinstance(said, SimulationError) and rates.at_once > 1:  # nothing to wait for
            raise said

    with summarised_outputs(files):
        starts, config = _starts(site, record, config, files, name)
        simulate_replicas(starts, config, files, resume=True, announce=heard)


def _config(site: Site, record: RunRecord, name: Stage, seed: int) -> MDConfig:
    """Return the settings of a stage of MD: longer than it can be in its time."""
    rates, decision = _rates_and_decision(record)
    is_weighed = name == "umbrella md"
    every_ps = min(decision.save_every_ps, _WEIGHED_EVERY_PS) if is_weighed else decision.save_every_ps
    expected_ps = md_ps(rates, decision, name) / rates.replicas
    return replace(
        site.config,
        time_ps=every_ps * max(_LEAST_FRAMES, math.ceil(_AMPLE * rates.stretch * expected_ps / every_ps)),
        save_every_ps=every_ps,
        equilibrate_ps=min(site.config.equilibrate_ps, decision.equilibrate_ps),
        platform=rates.platform,
        seed=site.options.seed + seed * _SEEDS_APART,
        umbrella=_umbrella(site, record) if is_weighed else None,
    )


def _umbrella(site: Site, record: RunRecord) -> Umbrella:
    """Return the umbrella potential that the rollout tells, of atoms of the scene in its water; the one that MD has
    begun under where there is some."""
    from md_reference.forces.mixture import solute_of
    from md_reference.forces.umbrella import Umbrella, umbrella_torsions
    from systems.chemistry.geometry import torsion

    begun = _umbrella_files(site, record)[0]
    if begun.exists():
        with open_trajectory(begun) as reader:
            return built(Umbrella, reader.record["umbrella"])
    dry = dry_part(site.scene)
    rolled = load_ensemble([site.folder / file for file in record.trajectory], template=dry)
    quads, left_kt = umbrella_torsions(dry)
    angles = np.concatenate([np.asarray(torsion(x[:], quads)) for x in rolled.segments])
    atoms = np.arange(dry.n_atoms) if site.scene.cell_nm is None else np.asarray(solute_of(site.scene))
    return Umbrella.of(atoms[quads], angles[np.isfinite(angles).all(axis=1)], left_kt, site.config.temperature_k)


def _umbrella_files(site: Site, record: RunRecord) -> list[Path]:
    assert record.rates is not None
    return replica_paths(site.folder / f"reference/umbrella.{site.options.format}", record.rates.replicas)


def _under_umbrella(site: Site, record: RunRecord) -> RunRecord:
    _simulate(site, record, _umbrella_files(site, record), "umbrella md", _UMBRELLA_SEED)
    return _were_under_umbrella(site, record) or record


def _were_under_umbrella(site: Site, record: RunRecord) -> RunRecord | None:
    files = _with_frames(site.folder, _umbrella_files(site, record))
    return replace(record, umbrella=files) if files else None


def _starts(
    site: Site, record: RunRecord, config: MDConfig, files: list[Path], name: Stage
) -> tuple[Scene | list[Scene], MDConfig]:
    """Return where replicas of MD begin, and their settings: where those under an umbrella potential were left, water
    and all, or at frames of the rollout, drawn over all its states, where there is one, else at states of hot MD, which
    takes a small part of their time."""
    from md_reference.run.replicas import where_left
    from md_reference.run.starts import HOT_PS, frames_as_starts, many_starts

    rates, decision = _rates_and_decision(record)
    if config.starts == "one" or len(files) < 2:
        return site.scene, config
    rolled = None
    hot_ps = min(HOT_PS, 1.2 * config.equilibrate_ps / rates.cores)  # on one core, while the others wait
    if decision.way != "md" and record.trajectory:
        rolled = load_ensemble([site.folder / file for file in record.trajectory])
    if rolled is not None:
        left_out_ps = max(config.equilibrate_ps, min(_LEFT_OUT_PS, 2.5 * config.equilibrate_ps))
        config = replace(config, starts="rollout", equilibrate_ps=left_out_ps)
    if all(path.exists() or checkpoint_path(path).exists() for path in files):
        return site.scene, config
    if record.umbrella and name == "held-out md" and rates.at_once > 1:
        left_nm = where_left(site.scene, _config(site, record, "umbrella md", _UMBRELLA_SEED),
                             _umbrella_files(site, record))  # fmt: skip
        if len(left_nm):
            return [replace(site.scene, positions_nm=left_nm[k % len(left_nm)]) for k in range(len(files))], config
    if rolled is not None:
        with suppress(SimulationError):
            frames = frames_over_states(rolled, 2 * len(files), seed=site.options.seed)
            in_time = _until(frames, _STARTING * decision.seconds(name))
            return list(frames_as_starts(site.scene, config, in_time, len(files), hot_ps=hot_ps)[0]), config
    return list(many_starts(site.scene, config, len(files), hot_ps=hot_ps)[0]), config


def _until(frames: npt.NDArray[np.float32], seconds: float) -> Iterator[npt.NDArray[np.float32]]:
    """Yield frames until their time is up, but a few in any case."""
    began = time.monotonic()
    for k, frame in enumerate(frames):
        if k >= _LEAST_STARTS and time.monotonic() - began > seconds:
            return
        yield frame


def md_options(options: RunOptions, **more: Any) -> ReferenceOptions:
    """Return what `reference` is told of a run's MD: its settings, and `more`."""
    given = {f.name: getattr(options, f.name) for kind in (MDSettings, Preparation) for f in fields(kind)}
    return ReferenceOptions(**{**given, "time_ps": 0.0, "quiet": True, **more})


def _with_frames(folder: Path, paths: list[Path]) -> tuple[str, ...]:
    """Return the files that can be evaluated: one frame tells no interval."""
    return tuple(str(path.relative_to(folder)) for path in paths if frames_in(path) > 1)


def _train(site: Site, record: RunRecord) -> RunRecord:
    _, decision = _rates_and_decision(record)
    options = TrainOptions(
        level=site.options.level, budget_s=decision.seconds("train"), seed=site.options.seed, resume=True, quiet=True
    )
    train(site.scene, site.folder / WEIGHTS_NAME, options=options)
    return _rolling(site, record) or record


def _trained(site: Site, record: RunRecord) -> RunRecord | None:
    """Return the record with the weights that were trained, None where they roll nothing."""
    with suppress(SimulationError):
        return _rolling(site, record)
    return None


def _rolling(site: Site, record: RunRecord) -> RunRecord | None:
    """Return the record with the weights that were trained, and how fast they roll. Raises SimulationError."""
    from surrogate.models.weights import load_weights

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


def _roll(site: Site, record: RunRecord) -> RunRecord:
    rates, decision = _rates_and_decision(record)
    assert rates.rolls is not None
    every_ps = rates.rolls.lag_ps * math.ceil(decision.save_every_ps / rates.rolls.lag_ps - 1e-6)
    expected_ps = decision.seconds("rollout") * rates.rolls.ps_per_s / rates.rolls.replicas
    own = site.folder / WEIGHTS_NAME
    out = site.folder / f"trajectory/surrogate.{site.options.format}"
    out.parent.mkdir(exist_ok=True)
    rollout(
        dry_part(site.scene),
        own if record.weights == WEIGHTS_NAME else record.weights,
        out,
        options=RolloutOptions(
            time_ps=every_ps * max(_LEAST_FRAMES, math.ceil(_AMPLE * rates.stretch * expected_ps / every_ps)),
            save_every_ps=every_ps,
            temperature_k=site.config.temperature_k,
            solvent=site.config.force.solvent,
            seed=site.options.seed,
            replicas=rates.rolls.replicas,
            anneal_ps=min(_ANNEAL_PS, _ANNEAL * expected_ps) if rates.expensive else 0.0,
            torsion_moves=_TORSION_MOVES if rates.expensive else 0,
            # Of a potential, and without the water, nothing could mend frames; one bad replica must not end the others.
            guard="resample" if rates.expensive or site.config.force.is_explicit else "repair",
            resume=True,
            quiet=True,
        ),
    )
    return _rolled(site, record) or record


def _rolled(site: Site, record: RunRecord) -> RunRecord | None:
    rates, _ = _rates_and_decision(record)
    if rates.rolls is None:
        return None
    outs = replica_paths(site.folder / f"trajectory/surrogate.{site.options.format}", rates.rolls.replicas)
    files = _with_frames(site.folder, outs)
    return replace(record, trajectory=files) if files else None


def _ask(site: Site, record: RunRecord) -> RunRecord:
    """Ask the reference for energies of the rollout's frames."""
    from surrogate.models.weights import load_weights
    from surrogate.verbs.run.single_points import ask_reference

    _, decision = _rates_and_decision(record)
    own = site.folder / WEIGHTS_NAME
    weights = load_weights(own if record.weights == WEIGHTS_NAME else weights_path(record.weights))
    rolled = load_ensemble([site.folder / file for file in record.trajectory])
    seconds = _ASKING * decision.seconds("energies")
    ask_reference(site.scene, weights, rolled, site.folder, seconds, site.options.seed)
    return record


def _asked(site: Site, record: RunRecord) -> RunRecord | None:
    return record if (site.folder / ENERGIES_NAME).is_file() else None


# ---- the report ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Costs:
    """Wall seconds of a candidate: of rolling it, and of training its weights here; `md_ps_per_s`: what MD simulates in
    such a second by the fastest way here, `by` which and in how many `replicas`; `budget_s`: of all."""

    rolling_s: float
    training_s: float
    md_ps_per_s: float
    budget_s: float
    replicas: int = 1
    by: str = "OpenMM"


def outcome(
    way: Way, comparison: Comparison, costs: Costs, answer: Answer | None = None, notes: tuple[str, ...] = (), *,
    by_itself: bool = False,
) -> Outcome:  # fmt: skip
    """Return what a run comes to: its `answer`, and a comparison of its trajectory with its held-out MD; `by_itself`:
    with other replicas of the same rollout."""
    evaluated = comparison.evaluations[0]
    held = [comparison.reference, *([] if comparison.replicate is None else [comparison.replicate])]
    found = None
    if evaluated.equivalent_time_words:
        found = next((each for each in evaluated.equivalent_time if each.kind == "distribution"), None)
    rolled, speed_up = _length([evaluated.summary]), None
    said = f"{rolled} of the surrogate"
    if way == "md":
        said = f"All frames counted alike, {rolled} of MD evaluated by {_length(held)}"
    if by_itself:
        said += f", compared with {_length(held)} of the same rollout: {evaluated.status}."
    elif found is None:
        said += f": {evaluated.status}, without an equivalent MD time."
    else:
        said += f": equivalent to {found.in_words()} of MD by its {found.measure}."
    if found is not None and way != "md" and costs.md_ps_per_s > 0.0:
        speed_up, words = _least_speed_up(found, costs)
        said += f" {words}"
    lines = evaluated.in_short if answer is None else answer.in_short
    on_surrogate = answer.on_surrogate if answer else ""
    if answer is not None and on_surrogate and not answer.is_sure and not answer.is_joint:
        what = "The rollout" if answer.is_of_rollout else "MD"
        on_surrogate = f"{what} has not converged, and cannot say whether the surrogate's populations are right."
    return Outcome(
        headline=" ".join(lines), in_short=lines,
        details=" ".join(filter(None, (on_surrogate, said, "" if by_itself else _remedy(comparison, costs)))),
        status=evaluated.status, verdict=evaluated.verdict,
        held_out_ps=0.0 if by_itself else sum(a.total_ps for a in held),
        rolled_ps=evaluated.summary.total_ps, equivalent_time=found.in_words() if found else "", speed_up=speed_up,
        on_surrogate=on_surrogate, converged=answer.holds and not answer.missing if answer else False, notes=notes,
    )  # fmt: skip


def lines_of(way: Way, evaluated: Evaluation, answer: Answer | None) -> tuple[str, str, str]:
    """Return the three lines on top of the report, which say of the trajectory what MD's answer says: a comparison
    counts all frames of MD alike, and MD's transitions weigh them."""
    if answer is None or evaluated.status == "broken":
        return evaluated.in_short
    if way == "md" or answer.is_joint or answer.is_reweighted:
        return answer.in_short
    rolled = [s for s in answer.states if s.surrogate is not None and not s.missing]
    off = [s for s in rolled if s.differs]
    if not answer.is_sure or not rolled:
        use, for_what = "Not known yet whether the surrogate can be used.", "It found the states that MD began in."
        return use, for_what, "Why: the MD it is compared with has not converged."
    right = f"Right: populations of {len(rolled) - len(off)} of {len(rolled)} states."
    if off:
        wrong = ", ".join(f"{s.torsion} {s.state}" for s in off[:3]) + (", and more" if len(off) > 3 else "")
        return "Use MD's populations, not the surrogate's.", f"{right} Wrong: {wrong}.", f"Why: {answer.on_surrogate}"
    if answer.method == "plain averages" or evaluated.status in ("agrees", "close"):
        return evaluated.in_short
    return "Use the surrogate for populations.", right, f"Why: {answer.on_surrogate}"


def _length(summaries: list[Summary]) -> str:
    """Return such as '32 replicas of 3.8 ns', which is no length of one run."""
    n = sum(a.n_segments for a in summaries)
    each = format_time_ps(sum(a.total_ps for a in summaries) / n, 2)
    return f"{n} replicas of {each}" if n > 1 else each


def _remedy(comparison: Comparison, costs: Costs) -> str:
    """Return what would tell more; a longer budget where its replicas outlast the slowest relaxation that was seen."""
    found, evaluated = comparison.convergence, comparison.evaluations[0]

    def budget(times: float) -> str:
        return f"a budget of about {format_wall(float(f'{costs.budget_s * times:.2g}'))}"

    if found is not None and not found.converged and not found.n_replicas:
        return f"The MD it is compared with is too short to be tested: {found.reasons[0]}."
    if found is not None and not found.converged:
        said = f"MD, {found.verdict.rstrip('.')}; {found.remedy}"
        if found.needed_ps is None or found.needed_ps <= found.replica_ps:
            return f"{said}."
        return f"{said}: {budget(found.needed_ps / found.replica_ps)}."
    n = evaluated.effective_samples
    if evaluated.status == "undecided" and 0.0 < n < LEAST_SAMPLES:
        return (
            f"Of the slowest motion {n:.2g} independent samples were seen, of {LEAST_SAMPLES} that it takes: "
            f"{budget(LEAST_SAMPLES / n)} would tell."
        )
    return ""


def _least_speed_up(found: EquivalentTime, costs: Costs) -> tuple[float, str]:
    """Return what MD of an equivalent MD time's lower end would cost, over what the candidate did, training here
    included; and this in words."""
    least_ps = found.equivalent_ps if found.low_ps is None and found.bound == "at least" else found.low_ps or 0.0
    # Where MD at hand ends first, the part of the rollout that comes as near is what it is the equivalent MD time of.
    spent_s = max(costs.training_s + found.share * costs.rolling_s, 1e-9)
    speed_up = (0.0 if found.bound == "less than" else least_ps) / (costs.md_ps_per_s * spent_s)
    each = format_time_ps(costs.md_ps_per_s * spent_s / costs.replicas, 2)
    bought = f"{costs.replicas} replicas of {each}" if costs.replicas > 1 else each
    training = f", training included ({format_wall(costs.training_s)})" if costs.training_s else ""
    said = "Speed-up at equal accuracy" if speed_up >= 1.0 else "No speed-up at equal accuracy is shown:"
    return speed_up, (
        f"{said} at least {speed_up:.2g}; in the {format_wall(spent_s)} that took{training}, MD by {costs.by}, the "
        f"fastest here, makes {bought}."
    )


def costs_of(record: RunRecord, comparison: Comparison, held_ps: float) -> Costs:
    """Return what the trajectory that a comparison evaluates has cost, beside what `held_ps` of the run's own held-out
    MD did."""
    spent, rates = record.spent_in, _rates_and_decision(record)[0]
    # The faster of what was measured before and what it came to: the speed-up is a lower bound.
    md_ps_per_s = max(rates.md_ps_per_s, held_ps / spent.get("held-out md", math.inf))
    training_s = spent.get("train", 0.0)
    # What reading weights takes is no part of it: a longer rollout does it once, too.
    rolling_s = comparison.evaluations[0].summary.wall_s or spent.get("rollout", 0.0)
    by = "SIMD" if rates.at_once > 1 else "OpenMM"
    return Costs(rolling_s, training_s, md_ps_per_s, record.settings["budget_s"], rates.replicas, by)


def notable(notes: tuple[str, ...]) -> tuple[str, ...]:
    """Return a comparison's notes without the one that files were stopped: the clock ends a stage, as is planned."""
    return tuple(note for note in notes if not note.startswith(STOPPED))


def answer_of(site: Site, record: RunRecord) -> Answer | None:
    """Return what all MD of a run says of equilibrium, written into its folder, each frame's weight into its file; None
    where it tells nothing."""
    is_md = _rates_and_decision(record)[1].way == "md"
    frames = [site.folder / file for file in record.trajectory]
    rolled = None if is_md else load_ensemble(frames)
    answer = None if rolled is None else _reweighted(site, rolled)
    files = frames
    if record.umbrella and rolled is not None:
        files = [site.folder / file for file in record.umbrella]
        under = load_ensemble(files, template=rolled.scene)
        with suppress(InputError):
            answer = md_answer(under, site.config.temperature_k, surrogate=rolled, seed=site.options.seed)
    held_out = [*(frames if is_md else ()), *(site.folder / file for file in record.held_out)]
    if held_out and (answer is None or not (answer.is_sure or answer.under_umbrella)):
        md = load_ensemble(held_out, template=None if rolled is None else rolled.scene)
        with suppress(InputError):
            by_md = md_answer(md, site.config.temperature_k, surrogate=rolled, seed=site.options.seed)
            if answer is None or by_md.is_sure:
                answer, files = by_md, held_out
    if answer is None:
        return None
    if len(answer.weights) == len(files):
        for path, weights in zip(files, answer.weights, strict=True):
            write_weights(path, weights)
    create_whole(site.folder / ANSWER_NAME, json.dumps(answer.to_dict(), indent=1, allow_nan=False) + "\n")
    return answer


def _reweighted(site: Site, rolled: Ensemble) -> Answer | None:
    """Return what a rollout says at the law of its reference; None where that was not asked, or it is too short."""
    from surrogate.verbs.run.single_points import differences

    known = differences(site.folder, rolled.segment_lengths)
    if not any(np.isfinite(d).any() for d in known):
        return None
    temperature_k = site.config.temperature_k
    with suppress(InputError):
        return md_answer(
            rolled, temperature_k, surrogate=rolled, factors=frame_factors(known, temperature_k), seed=site.options.seed
        )
    return None


def _compared(held: list[Path], candidate: list[Path], label: str) -> Comparison:
    ref, other = (held, None) if len(held) < 2 else (held[: len(held) // 2], held[len(held) // 2 :])
    return compare(ref, [candidate], replicate=other, labels=[label])


_NOTHING_KNOWN = (
    "Not known yet whether it can be used.",
    "For nothing yet: there is no MD to compare it with.",
    "Why: too few frames, or too few energies of its reference, to weigh any state; a longer `budget` gives more.",
)


def among_themselves(comparison: Comparison) -> Comparison:
    """Return a comparison of replicas of one rollout without what only MD could tell: no time of MD, no speed-up."""
    (found,) = comparison.evaluations
    verdict = f"Replicas of one rollout compared with each other, not with reference MD: {found.status}."
    found = replace(found, verdict=verdict, equivalent_time=(), equivalent_time_words="", speed_ratio=None)
    if found.status != "broken":
        found = replace(found, in_short=_NOTHING_KNOWN)
    return replace(comparison, evaluations=(found,))


def _report(site: Site, record: RunRecord) -> RunRecord:
    from surrogate.comparison.report.figures import weighted_maps
    from surrogate.comparison.report.report import Foreword, write_report

    rates, decision = _rates_and_decision(record)
    is_reweighted = _asked(site, record) is not None and len(record.trajectory) > 1
    if not record.trajectory or not (record.held_out or is_reweighted):
        lacking = "the trajectory" if record.held_out else "MD to compare it with"
        raise InputError(f"{lacking} came to nothing in its time; `resume=True` with a longer `budget_s` goes on.")
    answer = answer_of(site, record)
    held, rolled = ([site.folder / file for file in files] for files in (record.held_out, record.trajectory))
    repairs = tuple(site.scene.provenance.get("repairs", ()))
    notes = (*repairs, *(f"{entry.name}: {entry.note}" for entry in record.stages if entry.note))
    label = "MD" if decision.way == "md" else "surrogate"
    comparison = None
    if held:
        try:
            comparison = _compared(held, rolled, label)
        except InputError as error:
            if not is_reweighted:
                raise InputError(f"{error} `resume=True` with a longer `budget_s` goes on.") from error
            notes = (*notes, f"MD is not compared with: {error}")
    by_itself = comparison is None
    if comparison is None:
        comparison = among_themselves(_compared(rolled[: len(rolled) // 2], rolled[len(rolled) // 2 :], label))
    held_ps = comparison.reference.total_ps + (comparison.replicate.total_ps if comparison.replicate else 0.0)
    costs = costs_of(record, comparison, held_ps)
    found = outcome(decision.way, comparison, costs, answer, notes, by_itself=by_itself)
    evaluated = comparison.evaluations[0]
    evaluated = replace(evaluated, in_short=lines_of(decision.way, evaluated, answer))
    said = (
        *((BY_ITSELF,) if by_itself else ()),
        *(() if answer is None else (UNWEIGHTED,)),
        *notable(comparison.notes),
    )
    comparison = replace(comparison, notes=said, evaluations=(evaluated,))
    lines = [*(answer.table() if answer else ()), *table(rates, decision, site.options.budget_s).items()]
    write_report(
        comparison,
        site.folder / REPORT_NAME,
        command=f"surromd run {record.scene!r} -o {site.folder.name}",
        foreword=Foreword(
            "\n".join(found.in_short),
            "States, equivalent MD time, and how the budget was spent",
            [("equivalent MD time", found.details), *lines, *(("note", note) for note in notes)],
            [] if answer is None else weighted_maps(answer.maps),
        ),
    )
    return replace(record, outcome=found)


STAGES: dict[str, StageOf] = {
    "md": _md_stage("md", "trajectory/md", 0),
    "held-out md": _md_stage("held-out md", "reference/held_out", 1),
    "train": StageOf(_train, _trained, may_fail=True),
    "rollout": StageOf(_roll, _rolled, may_fail=True),
    "umbrella md": StageOf(_under_umbrella, _were_under_umbrella, may_fail=True),
    "energies": StageOf(_ask, _asked, may_fail=True),
    "report": StageOf(_report, lambda site, record: None),
}
