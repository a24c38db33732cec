"""Run time against error: a surrogate at many settings beside OpenMM at many lengths, on one core.

`surromd bench cost-error` runs it. Each setting rolls the same time; its error is that of the φ/ψ map against two held-
out runs, its cost the processor time of this process, one thread. Before each of its parts OpenMM runs for a moment, so
that the ratio of the two does not hang on what else the machine does. MD's own error is that of pieces of one held-out
run against the whole of the other (`comparison.equivalent_time`): it is taken to be the same at each time step,
by simulated time.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.bench.accuracy import (
    HeldOut,
    compare_frames,
    compare_reference,
    effective_row,
    equivalent_time_row,
    fastest_openmm,
    read_reference,
    training_cost,
)
from surrogate.bench.bench_options import STEPS, USUAL_BATCH, CostErrorConfig, CostErrorOptions, Setting, Sweep
from surrogate.bench.cost_page import write_cost_error
from surrogate.bench.timing import Roller, machine_facts, md_costs, roll_in_turns
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.domain import fit_weights
from surrogate.training.devices import torch_threads
from surrogate.verbs.options import Trajectories
from surrogate.verbs.outputs import find_trajectories
from systems.errors import InputError, StorageError, SurromdError
from systems.options import part_of
from systems.trajectory.codec import open_trajectory
from systems.units import format_time_ps

if TYPE_CHECKING:
    from surrogate.models.weights import Weights

ReportFn = Callable[[str], None]


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
    from surrogate.models.architecture import weights_path
    from surrogate.models.weights import load_weights

    loaded = [load_weights(weights_path(name)) for name in weights]
    sweep = part_of(options, Sweep)
    chosen = [(one, choose_settings(one, sweep)) for one in loaded]  # what cannot be is said before anything is read
    first, second = find_trajectories(reference), find_trajectories(replicate)
    return run_cost_error(chosen, first, second, folder, part_of(options, CostErrorConfig), report=report)


def choose_settings(weights: Weights, sweep: Sweep) -> list[Setting]:
    """Return the settings to run, of all solvers where none is named.

    Where neither precisions nor batches are given, the usual solver at the usual steps is run in both precisions, alone
    and in a batch; with `compiled` also compiled. Raises InputError for a solver that the weights do not know.
    """
    from surrogate.training.devices import choose_precision

    known = weights.model.solvers
    unknown = [name for name in sweep.solvers or () if name not in known]
    if unknown:
        raise InputError(f"{weights.path.name} knows no solver {unknown[0]!r}; choose {', '.join(known) or 'none'}.")
    chosen: list[str | None] = [*(sweep.solvers or known)] or [None]
    own = weights.model.usual_steps
    numbers = (sweep.steps or STEPS) if known else (own,)
    axes = chosen, numbers, sweep.precisions or ("auto",), sweep.batches or (USUAL_BATCH,)
    found = [Setting(solver, n, precision, batch) for solver, n, precision, batch in product(*axes)]
    usual = Setting(chosen[0], own if own in numbers else max(numbers))
    if not (sweep.precisions or sweep.batches):
        with_bf16 = choose_precision("auto", suits=weights.model.float32_layers is not None).bf16
        found += [replace(usual, precision="fp32" if with_bf16 else "bf16"), replace(usual, batch=1)]
    if sweep.compiled:
        found += [replace(usual, compile=True)]
    return list(dict.fromkeys(found))


def run_cost_error(
    chosen: Sequence[tuple[Weights, Sequence[Setting]]],
    reference: Sequence[Path],
    replicate: Sequence[Path],
    folder: Path,
    config: CostErrorConfig,
    *,
    report: ReportFn = lambda line: None,
) -> dict[str, Any]:
    """Measure weights at their settings and write cost_error.json, .md and .svg into `folder` after each.

    What an earlier run left there is kept, if it was of the same references and the same `config`. Raises InputError
    for references that weights were trained on, for a folder of another benchmark, and for weights of other molecules;
    StorageError; KeyboardInterrupt says what is kept.
    """
    weights = [one for one, _ in chosen]
    prints = [refuse_trained_on(w, reference, replicate, lag_ps=config.lag_ps) for w in weights]
    fitted = [_fitted(w, reference, config.lag_ps) for w in weights]
    header = {"references": prints[0], "config": asdict(config)}
    result = _earlier(folder, header)
    scene = fitted[0].domain.scene
    scenes = {w.domain.scene.topology_hash: w.domain.scene for w in fitted}  # atoms may stand in another order
    report("reading the references")
    references = {hashed: read_reference(of, reference, replicate, config.lag_ps) for hashed, of in scenes.items()}
    ref = references[scene.topology_hash]
    result |= {"machine": machine_facts(), "scene": scene.name, "files": [p.name for p in (*reference, *replicate)]}
    try:
        with torch_threads(config.threads):
            if "slowest" not in result.get("md", {}):  # an earlier version's did not say
                report("OpenMM")
                result["md"] = compare_reference(ref, seed=config.seed) | {"cost": md_costs(fitted[0], config)}
            for (one, settings), as_rolled in zip(chosen, fitted, strict=True):
                of_these = references[as_rolled.domain.scene.topology_hash]
                for setting in settings:
                    named = {"weights_hash": one.hash, **asdict(setting)}
                    if not any(row.items() >= named.items() for row in result["rows"]):
                        report(f"{one.path.stem}: {setting.label}")
                        row = measure_setting(as_rolled, setting, of_these, config, result["md"].get("slowest"))
                        result["rows"].append(row | _earned(row, one, result["md"]))
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


def _earned(row: dict[str, Any], weights: Weights, md: dict[str, Any]) -> dict[str, Any]:
    """Return effective samples of a setting, and what its weights cost before; nothing of one that is only timed."""
    if "slow_relaxation_ps" not in row:
        return {}
    before = training_cost(weights, fastest_openmm(md))
    return effective_row(row, row["slow_relaxation_ps"]["value"], md) | {"before": before}


def measure_setting(weights: Weights, setting: Setting, ref: HeldOut, config: CostErrorConfig,
                    slowest: dict[str, Any] | None = None) -> dict[str, Any]:  # fmt: skip
    """Roll one setting in parts, by turns with OpenMM; return its cost, its errors and its equivalent MD time,
    JSON-able. `slowest`: the torsion that effective samples are counted by (`accuracy.slowest_torsion`).

    A batch smaller than the usual one is only timed, over a few chunks: replicas do not depend on those beside them.
    """
    named = {"weights": weights.path.stem, "weights_hash": weights.hash, "label": setting.label}
    row: dict[str, Any] = named | asdict(setting)
    try:
        sampler = ChunkSampler(weights, solver=setting.solver, solver_steps=setting.steps, precision=setting.precision,
                               compile=setting.compile)  # fmt: skip
        roller = Roller(weights, sampler, rows=setting.batch, seed=config.seed)
        resolved = -(-config.discarded_ps // (sampler.n_new * weights.domain.lag_ps))
        started = time.process_time()
        roller.advance(max(1, int(resolved)) * sampler.n_new)
        row["first_chunks_s"] = time.process_time() - started
        only_timed = setting.batch < USUAL_BATCH
        if only_timed:
            few_ps = 2 * config.rounds * sampler.n_new * setting.batch * weights.domain.lag_ps
            config = replace(config, time_ps=min(config.time_ps, few_ps))
        parts, costs = roll_in_turns(weights, roller, sampler, setting, config)
    except (SurromdError, np.linalg.LinAlgError) as error:  # the latter where frames are no longer finite
        return row | {"outcome": f"not run: {error}"}
    frames = np.concatenate(parts, axis=1)
    ns = 1e-3 * frames.shape[0] * frames.shape[1] * weights.domain.lag_ps
    row |= {"bf16": sampler.precision.bf16, "evaluations": sampler.evaluations_per_chunk, "ns": ns, **costs}
    if only_timed:
        return row | {"timed_only": True}
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
    from surrogate.data import collect_frames

    domain, name = weights.domain, weights.path.name
    canonical = getattr(weights.model.config, "canonical", True)
    frames = collect_frames(list(reference), canonical=canonical, held=list(replicate))
    try:
        frames.refuse_leaks()
    except InputError as error:
        raise InputError(f"reference and replicate must be runs of their own, and share motion: {error}") from error
    known = {key: domain.conditions.get(key) for key in frames.conditions}
    other_key = next((key for key, value in frames.conditions.items() if value != known[key]), None)
    if other_key is not None:
        raise InputError(
            f"{reference[0]} has {other_key} {frames.conditions[other_key]}, {name} was trained for "
            f"{known[other_key]}: no reference to compare it with."
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
            same_frames = other.get("sha256") == source["sha256"]
            same_run = not domain.further and source["seed"] is not None and other.get("seed") == source["seed"]
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
