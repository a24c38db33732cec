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
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.bench.cost_error.cost_page import write_cost_error
from surrogate.bench.cost_error.effective_samples import effective_row, training_cost
from surrogate.bench.cost_error.errors_beside_md import (
    ReferenceForces,
    compare_frames,
    compare_reference,
    equivalent_time_row,
    read_reference,
)
from surrogate.bench.cost_error.paired_timing import chunk_ps, md_costs, roll_in_turns
from surrogate.bench.cost_error.sweep_settings import (
    SIMD,
    USUAL_BATCH,
    CostErrorConfig,
    CostErrorOptions,
    Setting,
    Sweep,
    choose_settings,
)
from surrogate.bench.held_out import refuse_trained_on
from surrogate.bench.machine import machine_facts
from surrogate.bench.rolling import Roller
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.domain import fit_weights
from surrogate.training.devices import torch_threads
from surrogate.verbs.options import Trajectories
from surrogate.verbs.outputs import find_trajectories
from systems.errors import InputError, StorageError, SurromdError
from systems.options import part_of
from systems.trajectory.codec import open_trajectory

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
                    if not any(row["weights_hash"] == one.hash and _is(row, setting) for row in result["rows"]):
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
    fastest = min(cost["cpu_s_per_ns"]["mean"] for cost in md["cost"] if cost["way"] != SIMD)
    return effective_row(row, row["slow_relaxation_ps"]["value"], md) | {"before": training_cost(weights, fastest)}


def measure_setting(
    weights: Weights,
    setting: Setting,
    ref: ReferenceForces,
    config: CostErrorConfig,
    slowest: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Roll one setting in parts, by turns with OpenMM; return its cost, its errors and its equivalent MD time,
    JSON-able.
    `slowest`: the torsion that effective samples are counted by (effective_samples.slowest_torsion).

    A batch smaller than the usual one is only timed, over a few chunks: replicas do not depend on those beside them.
    """
    model = weights.model
    row: dict[str, Any] = {
        "weights": weights.path.stem,
        "weights_hash": weights.hash,
        **asdict(setting),
        "label": setting.label,
        "clean_conditioning": bool(getattr(getattr(model.config, "approximator", None), "clean_conditioning", False)),
    }
    try:
        sampler = ChunkSampler(weights, solver=setting.solver, solver_steps=setting.steps, precision=setting.precision,
                               compile=setting.compile)  # fmt: skip
        roller = Roller(weights, sampler, rows=setting.batch, seed=config.seed)
        resolved = -(-config.discarded_ps // (sampler.n_new * weights.domain.lag_ps))
        started = time.process_time()
        roller.advance(max(1, int(resolved)) * sampler.n_new)
        row["first_chunks_s"] = time.process_time() - started
        only_timed = setting.batch < USUAL_BATCH
        total_ps = min(config.time_ps, chunk_ps(weights, sampler, setting) * config.rounds * 2) if only_timed \
            else config.time_ps  # fmt: skip
        parts, costs = roll_in_turns(weights, roller, sampler, setting, replace(config, time_ps=total_ps))
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


def _is(row: dict[str, Any], setting: Setting) -> bool:
    return all(row.get(key) == value for key, value in asdict(setting).items())


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
