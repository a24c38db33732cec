"""Run time against error: a surrogate at many settings beside OpenMM at many lengths, on one core.

`surromd bench cost-error` runs it. Each setting rolls the same time; its error is that of the φ/ψ map against two held-
out runs, its cost the processor time of this process, one thread. Before each of its parts OpenMM runs for a moment, so
that the ratio of the two does not hang on what else the machine does. MD's own error is that of pieces of one held-out
run against the whole of the other (`comparison.equivalent_time`).

Effective samples are simulated time over 2 max(τ_model, τ_MD), τ the relaxation time of the slowest torsion of which
the MD at hand holds at least 50: a model that forgets too fast gains nothing by it, and one that forgets too slowly
loses. They say nothing of whether the samples are right; that is the distance beside them.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from surrogate.bench.timing import (
    SIMD,
    Frames,
    Roller,
    machine_facts,
    markdown_table,
    md_costs,
    roll_in_turns,
)
from surrogate.comparison.equivalent_time import (
    EquivalentTime,
    distance_to_reference,
    equivalent_time_by,
    joint_measure,
)
from surrogate.comparison.measure.distributions import block_occupancy
from surrogate.comparison.measure.slow_motion import longest_correlation
from surrogate.comparison.measure.statistics import block_length, estimate, make_blocks
from surrogate.comparison.measure.structure import Baseline, Features, backbone
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.rows.kinetics_rows import relaxation_of, turning
from surrogate.comparison.rows.rows import Options, Sample, make_sample
from surrogate.data import collect_frames
from surrogate.models.architecture import weights_path
from surrogate.models.lam_slide.flow import ADAPTIVE
from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.domain import fit_weights
from surrogate.training.devices import torch_threads
from surrogate.verbs.inputs import find_trajectories
from surrogate.verbs.options import CostErrorConfig, CostErrorOptions, Sweep, Trajectories
from systems.chemistry.validity import BOND_20_PERCENT, BOND_HALF_ANGSTROM, NOT_FINITE
from systems.errors import InputError, StorageError, SurromdError
from systems.files.whole_file import create_whole
from systems.options import part_of
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory
from systems.units import format_time_ps

ReportFn = Callable[[str], None]
CHECKS = {
    "valid_half_angstrom_%": NOT_FINITE | BOND_HALF_ANGSTROM,
    "bonds_20_percent_%": NOT_FINITE | BOND_20_PERCENT,
}
# Below so many effective samples of MD, nobody knows its relaxation time.
LEAST_SAMPLES = 50.0


@dataclass(frozen=True)
class Setting:
    """One way to roll. `solver` None: of a model without one, for which `steps` mean nothing."""

    solver: str | None
    steps: int
    precision: str = "auto"
    batch: int = 32

    @property
    def label(self) -> str:
        words = [f"{self.solver} {self.steps}" if self.solver else "as it is"]
        words += [self.precision] if self.precision != "auto" else []
        words += [f"batch {self.batch}"] if self.batch != Setting.batch else []
        return ", ".join(words)


def cost_error(
    reference: Trajectories,
    replicate: Trajectories,
    weights: Sequence[str | Path],
    folder: Path,
    options: CostErrorOptions,
    *,
    report: ReportFn = lambda line: None,
) -> dict[str, Any]:
    """Measure weights, by name or file, at the settings of `choose_settings`; see `run_cost_error`."""
    loaded = [load_weights(weights_path(name)) for name in weights]
    sweep = part_of(options, Sweep)
    chosen = [(one, choose_settings(one, sweep)) for one in loaded]  # what cannot be is said before anything is read
    first, second = find_trajectories(reference), find_trajectories(replicate)
    return run_cost_error(chosen, first, second, folder, part_of(options, CostErrorConfig), report=report)


def choose_settings(weights: Weights, sweep: Sweep) -> list[Setting]:
    """Return all combinations of what is asked for; without solvers those that take a batch at once. Raises InputError
    for a solver that the weights do not know."""
    known = weights.model.solvers
    unknown = [name for name in sweep.solvers or () if name not in known]
    if unknown:
        raise InputError(f"{weights.path.name} knows no solver {unknown[0]!r}; choose {', '.join(known) or 'none'}.")
    solvers: list[str | None] = [*(sweep.solvers or [name for name in known if name not in ADAPTIVE])] or [None]
    steps = sweep.steps if known else (weights.model.usual_steps,)
    return [Setting(*each) for each in product(solvers, steps, sweep.precisions, sweep.batches)]


def run_cost_error(
    chosen: Sequence[tuple[Weights, Sequence[Setting]]],
    reference: Sequence[Path],
    replicate: Sequence[Path],
    folder: Path,
    config: CostErrorConfig,
    *,
    report: ReportFn = lambda line: None,
) -> dict[str, Any]:
    """Measure weights at their settings and write cost_error.json and .md into `folder` after each.

    What an earlier run left there is kept, if it was of the same references and the same `config`. Raises InputError
    for references that weights were trained on, for a folder of another benchmark, and for weights of other molecules;
    StorageError; KeyboardInterrupt says what is kept.
    """
    weights = [one for one, _ in chosen]
    prints = [refuse_trained_on(w, reference, replicate, lag_ps=config.lag_ps) for w in weights]
    fitted = [_fitted(w, reference, config.lag_ps) for w in weights]
    result = _earlier(folder, {"references": prints[0], "config": asdict(config)})
    scene = fitted[0].domain.scene
    scenes = {w.domain.scene.topology_hash: w.domain.scene for w in fitted}  # atom orders may differ
    report("reading the references")
    references = {hashed: read_reference(of, reference, replicate, config.lag_ps) for hashed, of in scenes.items()}
    ref = references[scene.topology_hash]
    result |= {"machine": machine_facts(), "scene": scene.name, "files": [p.name for p in (*reference, *replicate)]}
    try:
        with torch_threads(config.threads):
            if "md" not in result:
                report("OpenMM")
                result["md"] = compare_reference(ref, seed=config.seed) | {"cost": md_costs(fitted[0], config)}
            for (one, settings), as_rolled in zip(chosen, fitted, strict=True):
                of_these = references[as_rolled.domain.scene.topology_hash]
                for setting in settings:
                    named = {"weights_hash": one.hash, **asdict(setting)}
                    if not any(row.items() >= named.items() for row in result["rows"]):
                        report(f"{one.path.stem}: {setting.label}")
                        row = measure_setting(as_rolled, setting, of_these, config, result["md"]["slowest"])
                        result["rows"].append(row | effective_row(row, result["md"]))
                        write_cost_error(result, folder)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{folder} keeps the settings that were finished; the same command goes on") from None
    write_cost_error(result, folder)
    return result


def _fitted(weights: Weights, reference: Sequence[Path], lag_ps: float | None) -> Weights:
    """Return weights as they roll the molecule of the references at one lag, where they know several of either."""
    knows_lags = weights.domain.longest_lag_ps > weights.domain.lag_ps
    if not (weights.domain.transferable or (knows_lags and lag_ps)):
        return weights
    with open_trajectory(reference[0]) as reader:
        scene = reader.scene
    return fit_weights(
        scene or weights.domain.scene, weights, lag_ps=(lag_ps or weights.domain.lag_ps) if knows_lags else None
    )[0]


def measure_setting(
    weights: Weights, setting: Setting, ref: HeldOut, config: CostErrorConfig, slowest: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Roll one setting in parts, by turns with OpenMM; return its cost, its errors and its equivalent MD time,
    JSON-able. `slowest`: the torsion that effective samples are counted by (`slowest_torsion`)."""
    named = {"weights": weights.path.stem, "weights_hash": weights.hash, "label": setting.label}
    row: dict[str, Any] = named | asdict(setting)
    try:
        sampler = ChunkSampler(weights, solver=setting.solver, solver_steps=setting.steps, precision=setting.precision)
        roller = Roller(weights, sampler, rows=setting.batch, seed=config.seed)
        discarded = -(-config.discarded_ps // (sampler.n_new * weights.domain.lag_ps))
        started = time.process_time()
        roller.advance(max(1, int(discarded)) * sampler.n_new)
        row["first_chunks_s"] = time.process_time() - started
        parts, costs = roll_in_turns(weights, roller, sampler, config)
    except (SurromdError, np.linalg.LinAlgError) as error:  # the latter where frames are no longer finite
        return row | {"outcome": f"not run: {error}"}
    frames = np.concatenate(parts, axis=1)
    ns = 1e-3 * frames.shape[0] * frames.shape[1] * weights.domain.lag_ps
    row |= {"bf16": sampler.precision.bf16, "evaluations": sampler.evaluations_per_chunk, "ns": ns, **costs}
    every = max(1, round(ref.reference.lag_ps / weights.domain.lag_ps))
    errors, equivalent_time = compare_frames(
        frames[:, every - 1 :: every], ref, seed=config.seed, slowest=None if slowest is None else slowest["torsion"]
    )
    spent = ns * row["cpu_s_per_ns"]["mean"]
    return row | errors | {"spent_s": spent} | equivalent_time_row(equivalent_time, spent, row["md_s_per_ns"]["mean"])


def _earlier(folder: Path, header: dict[str, Any]) -> dict[str, Any]:
    """Return what a folder holds, or an empty result. Raises InputError where it is of other references or times."""
    path = folder / "cost_error.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    except (OSError, ValueError) as error:
        raise StorageError(f"{path} cannot be used ({error}); name another folder with `out`.") from error
    if found and any(found.get(key) != value for key, value in header.items()):
        raise InputError(f"{path} is of other references, times or rounds; name another folder with `out`.")
    return {**header, "rows": [], **found}


# ---- errors against held-out reference -----------------------------------------------------------------------------


class HeldOut(NamedTuple):
    """Held-out reference and its replicate, measured once. `length_ps`: of each, as far as they are compared."""

    scene: Scene
    baseline: Baseline
    reference: Features
    replicate: Features

    @property
    def length_ps(self) -> float:
        return min(self.reference.total_ps, self.replicate.total_ps)


def read_reference(
    scene: Scene, reference: Sequence[Path], replicate: Sequence[Path], lag_ps: float | None = None
) -> HeldOut:
    """Measure two held-out runs of `scene`, atoms in its order, frames `lag_ps` apart or all. Raises InputError for a
    scene without φ and ψ."""
    if not backbone(scene).residues:
        raise InputError(f"{scene.name} has no residue with φ and ψ, by whose map errors are measured here.")
    first, second = (load_ensemble(paths, template=scene) for paths in (reference, replicate))
    if lag_ps is not None:
        first, second = (run.strided(max(1, round(lag_ps / run.lag_ps))) for run in (first, second))
    baseline = Baseline.of(first, probing=False)
    return HeldOut(scene, baseline, baseline.measure(first), baseline.measure(second))


def compare_frames(
    frames: Frames, ref: HeldOut, *, seed: int = 0, slowest: int | None = None
) -> tuple[dict[str, Any], EquivalentTime]:
    """Return what replicas `(rows, n_frames, n_atoms, 3)` nm get wrong, JSON-able, and their equivalent MD time by the
    φ/ψ map.

    `jsd`: Jensen-Shannon distance of the joint φ/ψ histograms (50 x 50, overflow bins), the root mean square of those
    to the two held-out runs; shares of valid frames; the autocorrelation of cos ψ after one frame and its relaxation
    time. Numbers with intervals are dictionaries of `comparison.statistics.Estimate`. `slow_relaxation_ps`: of the
    torsion `slowest`, where one is named (`slowest_torsion`). Raises InputError where frames are too few.
    """
    rolled = Ensemble("rollout", [x.astype(np.float32) for x in frames], ref.reference.lag_ps, ref.scene)
    features = ref.baseline.measure(rolled)
    found = joint_measure(ref.reference, features, ref.replicate, ref.baseline.torsions)
    if found is None or (equivalent_time := equivalent_time_by(*found, seed)) is None:
        raise InputError("too few frames to tell an error; give longer references, or a longer `time_ps`.")
    sample = _sample(features, ref, seed)
    correlation, relaxation = relaxation_of(sample)
    out: dict[str, Any] = {
        "jsd": distance_to_reference(found[0], seed).to_dict(),
        "correlation": correlation.to_dict(),
        "relaxation_ps": relaxation.to_dict(),
    }
    if slowest is not None:
        out["slow_relaxation_ps"] = relaxation_of(sample, slowest)[1].to_dict()
    for key, mask in CHECKS.items():
        inside, total = block_occupancy([(f & mask) == 0 for f in features.flags], sample.blocks)
        draws = 100.0 * (sample.weights @ inside) / (sample.weights @ total)
        out[key] = estimate(100.0 * float(inside.sum() / total.sum()), draws, sample.blocks.n_blocks).to_dict()
    return out, equivalent_time


def compare_reference(ref: HeldOut, *, seed: int = 0) -> dict[str, Any]:
    """Return what rollouts are compared with: the errors of MD of each length, the replicate baseline (the two runs
    against each other), and the reference's own autocorrelation and relaxation time."""
    found = joint_measure(ref.reference, ref.replicate, ref.replicate, ref.baseline.torsions)
    if found is None or (equivalent_time := equivalent_time_by(*found, seed)) is None:
        raise InputError("the references are too short to tell the error of MD; give longer ones.")
    samples = [_sample(features, ref, seed) for features in (ref.reference, ref.replicate)]
    kinetic = [[e.to_dict() for e in relaxation_of(sample)] for sample in samples]
    return {
        "length_ps": ref.length_ps,
        "lengths_ps": list(equivalent_time.lengths_ps),
        "errors": list(equivalent_time.errors),
        "errors_low": list(equivalent_time.errors_low),
        "errors_high": list(equivalent_time.errors_high),
        "replicate_baseline": equivalent_time.errors[-1],
        "correlation": [pair[0] for pair in kinetic],
        "relaxation_ps": [pair[1] for pair in kinetic],
        "slowest": slowest_torsion(samples),
    }


def equivalent_time_row(equivalent_time: EquivalentTime, spent_s: float, md_s_per_ns: float) -> dict[str, Any]:
    """Return the equivalent MD time of a rollout; what so much MD takes, over `spent_s` (`times_faster`, with the ends
    of its interval); and the error of as many seconds of MD, None where that is shorter than any MD at hand."""
    row: dict[str, Any] = {"equivalent_time": {"words": equivalent_time.in_words(), "bound": equivalent_time.bound}}
    for end, name in (("", "equivalent_ps"), ("_low", "low_ps"), ("_high", "high_ps")):
        time_ps = getattr(equivalent_time, name)
        row["equivalent_time"][name] = time_ps
        row[f"times_faster{end}"] = None if time_ps is None else 1e-3 * time_ps * md_s_per_ns / spent_s
    md_ps = 1e3 * spent_s / md_s_per_ns
    is_at_hand = md_ps >= equivalent_time.lengths_ps[0]
    row["md_of_same_seconds"] = equivalent_time.error_at(md_ps / equivalent_time.lengths_ps[-1]) if is_at_hand else None
    return row


def _sample(features: Features, ref: HeldOut, seed: int) -> Sample:
    each = block_length(features.n_frames, longest_correlation(ref.reference))
    return make_sample(features, make_blocks(features.segment_lengths, each), Options(seed=seed), 1)


# ---- effective samples ----------------------------------------------------------------------------------------------


def slowest_torsion(samples: Sequence[Sample]) -> dict[str, Any] | None:
    """Return the torsion that effective samples are counted by, JSON-able: its place in `relaxation_rows.turning`, its
    name, its relaxation time in ps over all of MD `samples`, how many of them these hold. None where none relaxes often
    enough."""
    found: list[dict[str, Any]] = []
    total_ps = sum(sample.features.total_ps for sample in samples)
    for k, (symbol, label, _) in enumerate(turning(samples[0].features)):
        times = [relaxation_of(sample, k)[1].value for sample in samples]
        if all(math.isfinite(time) and time > 0 for time in times):
            tau_ps = sum(times) / len(times)
            name = f"cos {symbol or label}".strip()
            found.append({"torsion": k, "name": name, "tau_ps": tau_ps, "samples": total_ps / (2.0 * tau_ps)})
    enough = [one for one in found if one["samples"] >= LEAST_SAMPLES]
    return max(enough, key=lambda one: float(one["tau_ps"])) if enough else None


def samples_per_second(cpu_s_per_ns: float, tau_ps: float | None, md_tau_ps: float) -> float | None:
    """Return effective samples a processor second; None where the model's own relaxation time is not known."""
    if tau_ps is None or not math.isfinite(tau_ps):
        return None
    return 1e3 / cpu_s_per_ns / (2.0 * max(tau_ps, md_tau_ps))


def effective_row(row: dict[str, Any], md: dict[str, Any]) -> dict[str, Any]:
    """Return the effective samples a second of a setting that was rolled (`row`), and these over those of OpenMM."""
    slow = md.get("slowest")
    if slow is None or "slow_relaxation_ps" not in row:
        return {}
    rate = samples_per_second(row["cpu_s_per_ns"]["mean"], row["slow_relaxation_ps"]["value"], slow["tau_ps"])
    md_s_per_ns = next(cost["cpu_s_per_ns"]["mean"] for cost in md["cost"] if cost["way"] != SIMD)
    over_md = None if rate is None else rate * md_s_per_ns * 2e-3 * slow["tau_ps"]
    return {"effective_per_s": rate, "effective_over_md": over_md}


# ---- held-out reference ---------------------------------------------------------------------------------------------


def refuse_trained_on(
    weights: Weights, reference: Sequence[Path], replicate: Sequence[Path], *, lag_ps: float | None = None
) -> list[str]:
    """Raise InputError unless weights never saw these trajectories; return the fingerprints of their frames.

    Refused are: frames named in the provenance of the weights, of those they began from and so on; a run of the
    same conditions and seed as one of these (a part of it, or saved otherwise); conditions other than those of
    training; an interval between the frames that are compared (`lag_ps`, or all) that the weights do not step to; and
    motion that reference and replicate have in common (`data.frames.refuse_leaks`).
    """
    domain, name = weights.domain, weights.path.name
    canonical = getattr(weights.model.config, "canonical", True)
    frames = collect_frames(list(reference), canonical=canonical, held=list(replicate))
    try:
        frames.refuse_leaks()
    except InputError as error:
        raise InputError(f"reference and replicate must be runs of their own, and share motion: {error}") from error
    for key, value in frames.conditions.items():
        if value != domain.conditions.get(key):
            raise InputError(
                f"{reference[0]} has {key} {value}, {name} was trained for {domain.conditions.get(key)}: no reference "
                "to compare it with."
            )
    compared_ps = lag_ps or frames.lag_ps
    for step_ps, what in ((frames.lag_ps, f"frames of {reference[0]}"), (domain.lag_ps, f"steps of {name}")):
        if round(compared_ps / step_ps) < 1 or abs(compared_ps / step_ps - round(compared_ps / step_ps)) > 1e-6:
            raise InputError(
                f"frames {format_time_ps(compared_ps)} apart cannot be compared: {what} are "
                f"{format_time_ps(step_ps)} apart; give `lag_ps` as a multiple of both, or other references."
            )
    trained = list(_sources(weights.provenance))
    for path, source in zip([*reference, *replicate], frames.sources, strict=True):
        for other in trained:
            same_frames = any(other.get(key) == source[key] for key in ("sha256", "shape_sha256"))
            same_run = source["seed"] is not None and other.get("seed") == source["seed"]
            same_run &= other.get("topology") in (None, source["topology"])
            if same_frames or same_run:
                raise InputError(
                    f"{path}: {name} was trained on this run (seed {other.get('seed')}, then called "
                    f"{other.get('file')}); give runs that training never saw."
                )
    return [str(source["sha256"]) for source in frames.sources]


def _sources(provenance: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """All trajectories of a training and of those that it began from."""
    yield from provenance.get("sources", ())
    if isinstance(provenance.get("from"), dict):
        yield from _sources(provenance["from"])


# ---- the page -------------------------------------------------------------------------------------------------------


def write_cost_error(result: dict[str, Any], folder: Path) -> None:
    """Write cost_error.json and .md. Raises StorageError."""
    create_whole(folder / "cost_error.json", json.dumps(result, indent=1))
    create_whole(folder / "cost_error.md", markdown(result))


def markdown(result: dict[str, Any]) -> str:
    """Return the tables: MD and the settings."""
    md, config = result["md"], result["config"]
    correlation, relaxation_ps = (
        np.mean([run["value"] for run in md[key]]) for key in ("correlation", "relaxation_ps")
    )
    columns = (md[key] for key in ("lengths_ps", "errors", "errors_low", "errors_high"))
    by_length = "; ".join(
        f"{1e-3 * ps:.3g} ns {error:.3f} [{low:.3f}, {high:.3f}]" for ps, error, low, high in zip(*columns, strict=True)
    )
    slow = md["slowest"]
    counted = "No torsion relaxes 50 times over in the MD at hand: effective samples are not counted."
    if slow is not None:
        counted = (
            f"Effective samples: simulated time over 2 max(τ, τ of MD) of {slow['name']} (MD: {slow['tau_ps']:.1f} ps, "
            f"{slow['samples']:.0f} of them at hand), a processor second; over OpenMM's."
        )
    md_rows = [
        {"MD": cost["label"], "s/ns": _range(cost["cpu_s_per_ns"]), "wall s/ns": cost["wall_s_per_ns"]["mean"]}
        for cost in md["cost"]
    ]
    return "\n".join(
        [
            f"# Run time against error: {result['scene']}",
            "",
            f"Rollouts of {1e-3 * config['time_ps']:g} ns in all replicas, against two held-out runs of "
            f"{1e-3 * md['length_ps']:g} ns; processor seconds on {config['threads']} thread(s), mean of "
            f"{config['rounds']} parts [least, greatest]; 95 % intervals in brackets elsewhere.",
            "",
            result["machine"]["about"],
            "",
            "## MD",
            "",
            *markdown_table(md_rows),
            "",
            f"JSD of MD by length, typical piece [10 %, 90 % of pieces]: {by_length}.",
            "",
            "## Settings",
            "",
            *markdown_table([_row(row, md["errors"][0]) for row in result["rows"]]),
            "",
            "JSD: Jensen-Shannon distance of the joint φ/ψ map (50 x 50) to the held-out runs, root mean square; "
            f"{md['replicate_baseline']:.3f} is what these have between them, and nothing below is claimed. MD, "
            "same seconds: the JSD of as many processor seconds of OpenMM at 4 fs. Equivalent MD time: how much MD "
            "is as far from the reference; faster: what that MD takes, over what the rollout took. C1: autocorrelation "
            f"of cos ψ after one frame (reference {correlation:.3f}), τ: its relaxation time (reference "
            f"{relaxation_ps:.1f} ps).",
            "",
            counted,
            "",
        ]
    )


def _row(row: dict[str, Any], shortest: float) -> dict[str, Any]:
    """Return the cells of a setting; `shortest` is the error of the shortest MD at hand."""
    out: dict[str, Any] = {"weights": row["weights"], "setting": row["label"]}
    if "outcome" in row:
        return out | {"evaluations": row["outcome"]}
    bound = {"at least": "≥ ", "less than": "< "}.get(row["equivalent_time"]["bound"], "")
    faster = [row[f"times_faster{end}"] for end in ("", "_low", "_high")]
    same, over_md = row["md_of_same_seconds"], row.get("effective_over_md")
    return out | {
        "evaluations": f"{row['evaluations']:.3g}",
        "s/ns": _range(row["cpu_s_per_ns"]),
        "wall s/ns": f"{row['wall_s_per_ns']['mean']:.3g}",
        "x MD 4 fs": _range(row["speed_over_md"]),
        "0.5 Å %": f"{row['valid_half_angstrom_%']['value']:.2f}",
        "20 % %": f"{row['bonds_20_percent_%']['value']:.2f}",
        "JSD": _interval([row["jsd"][key] for key in ("value", "low", "high")], ".3f"),
        "MD, same seconds": f"> {shortest:.3f}" if same is None else f"{same:.3f}",
        "equivalent MD time": row["equivalent_time"]["words"],
        "faster": f"{bound}{faster[0]:.2g}" if bound else _interval(faster, ".2g"),
        "C1": "none" if row["correlation"]["value"] is None else f"{row['correlation']['value']:.3f}",
        "τ / ps": _interval([row["relaxation_ps"][key] for key in ("value", "low", "high")], ".1f"),
        "effective samples": "" if over_md is None else f"{row['effective_per_s']:.3g}/s, {over_md:.3g} x MD",
    }


def _range(spread: dict[str, float]) -> str:
    return _interval([spread["mean"], spread["least"], spread["greatest"]], ".3g")


def _interval(found: Sequence[float | None], digits: str) -> str:
    """Return a value with the ends of its interval, such as '0.31 [0.28, 0.35]'; without them where none is known."""
    value, *ends = ("..." if each is None else f"{each:{digits}}" for each in found)
    return f"{value} [{', '.join(ends)}]" if found[1:] != [None, None] else value
