"""What the surrogate and MD cost beside each other, in processor seconds for a ns, the machine that this holds for, and
the Markdown tables of benchmarks. Rollouts are made in memory, without guards and without files."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.machine import machine_name
from md_reference.simd.force_field import SimdReplicas
from md_reference.simd.system_terms import SimdUnavailableError
from surrogate.models.weights import TrainingDomain, Weights
from surrogate.sampling.chunks import ChunkSampler, noise_seed
from surrogate.training.devices import product_speed
from surrogate.verbs.options import CostErrorConfig
from systems.errors import InputError
from systems.scene import FloatArray

Frames = npt.NDArray[np.float64]
# Of the MD that surrogates are timed beside.
TIMESTEP_PS = 0.004
# Ways of MD: OpenMM, and sixteen copies at once (`md_reference.simd`).
OPENMM, SIMD = "openmm", "simd"


def machine_facts() -> dict[str, Any]:
    """Return the machine's name, the load that was there before and the speed of its matrix products on torch's
    threads; JSON-able."""
    (fp32, bf16), threads = product_speed(), torch.get_num_threads()
    products = f"products on {threads} threads: fp32 {fp32:.3g} GFLOP/s, bf16 {bf16 / fp32:.2g} times as fast"
    return {
        "name": machine_name(),
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "threads": threads,
        "fp32_gflops": fp32,
        "bf16_gflops": bf16,
        "about": f"{machine_name()}; {products}",
    }


class Roller:
    """`rows` replicas in one batch, from the template of the weights or positions `start_nm` in its order; each call
    goes on where the last one ended."""

    def __init__(
        self, weights: Weights, sampler: ChunkSampler, *, rows: int, seed: int, start_nm: FloatArray | None = None
    ) -> None:
        start = weights.domain.scene.positions_nm if start_nm is None else start_nm
        self.rows, self._sampler, self._seed = rows, sampler, seed
        self._last = np.repeat(start[None, None], sampler.n_conditioning, axis=1).repeat(rows, axis=0)
        self._velocities: npt.NDArray[np.floating] | None = None
        self._chunk = 0

    def advance(self, n_frames: int) -> Frames:
        """Return `(rows, n_frames, n_atoms, 3)` nm. What a last chunk has beyond `n_frames` is lost: the next call goes
        on from that chunk's end."""
        parts: list[Frames] = []
        for _ in range(-(-n_frames // self._sampler.n_new)):
            seeds = [noise_seed(self._seed, row, self._chunk) for row in range(self.rows)]
            drawn = self._sampler.draw(self._last, seeds, self._velocities)
            self._velocities = drawn.velocities_nm_ps
            parts.append(drawn.frames_nm.astype(np.float64))
            self._last = np.concatenate([self._last, parts[-1]], axis=1)[:, -self._sampler.n_conditioning :]
            self._chunk += 1
        return np.concatenate(parts, axis=1)[:, :n_frames]


def roll_in_turns(
    weights: Weights, roller: Roller, sampler: ChunkSampler, config: CostErrorConfig
) -> tuple[list[Frames], dict[str, Any]]:
    """Return the frames of each part, and what a ns of the surrogate and of MD at 4 fs took beside each other."""
    chunk_ps = sampler.n_new * roller.rows * weights.domain.lag_ps
    n_chunks = max(config.rounds, math.ceil(config.time_ps / chunk_ps))
    shares = [n_chunks * k // config.rounds for k in range(config.rounds + 1)]
    parts: list[Frames] = []
    costs, md, sizes = [], [], []
    with openmm_of(weights.domain, TIMESTEP_PS, config.seed) as engine:
        for first, last in pairwise(shares):
            md.append(_seconds_per_ns(config.slice_ps, partial(engine.step, _steps(config.slice_ps)))[0])
            n = (last - first) * sampler.n_new
            sizes.append(n * roller.rows * weights.domain.lag_ps)
            costs.append(_seconds_per_ns(sizes[-1], lambda n=n: parts.append(roller.advance(n))))  # type: ignore[misc]
    cpu, wall = zip(*costs, strict=True)
    return parts, {
        "cpu_s_per_ns": _spread(cpu, sizes),
        "wall_s_per_ns": _spread(wall, sizes),
        "md_s_per_ns": _spread(md),
        "speed_over_md": _spread([m / c for m, c in zip(md, cpu, strict=True)]),
    }


def md_costs(weights: Weights, config: CostErrorConfig) -> list[dict[str, Any]]:
    """Return processor and wall seconds of MD for a ns at 4 fs, by turns: OpenMM, and SIMD replicas where they run."""
    with openmm_of(weights.domain, TIMESTEP_PS, config.seed) as engine:
        n_steps = _steps(config.slice_ps)
        ways: dict[str, tuple[float, Callable[[], object]]] = {OPENMM: (config.slice_ps, partial(engine.step, n_steps))}
        simd = _by_simd(weights, config)
        if simd is not None:
            ways[SIMD] = config.slice_ps * simd.n_replicas, partial(simd.step, n_steps)
        times: dict[str, list[tuple[float, float]]] = {way: [] for way in ways}
        for _ in range(config.rounds):
            for way, (simulated_ps, run) in ways.items():
                times[way].append(_seconds_per_ns(simulated_ps, run))
    names = {OPENMM: "OpenMM, {:g} fs", SIMD: "MD by SIMD replicas, {:g} fs"}
    return [
        {
            "label": names[way].format(1e3 * TIMESTEP_PS),
            "way": way,
            "cpu_s_per_ns": _spread([cpu for cpu, _ in found]),
            "wall_s_per_ns": _spread([wall for _, wall in found]),
        }
        for way, found in times.items()
    ]


def _steps(time_ps: float) -> int:
    return max(1, round(time_ps / TIMESTEP_PS))


def _seconds_per_ns(simulated_ps: float, run: Callable[[], object]) -> tuple[float, float]:
    """Return processor seconds (of this process, all threads) and wall seconds of `run` for a ns that it simulates."""
    wall, cpu = time.perf_counter(), time.process_time()
    run()
    spent = max(time.process_time() - cpu, 1e-9), max(time.perf_counter() - wall, 1e-9)
    return 1e3 * spent[0] / simulated_ps, 1e3 * spent[1] / simulated_ps


def _spread(values: Sequence[float], shares: Sequence[float] | None = None) -> dict[str, float]:
    """Return the mean of all parts together, and the extremes: what a chunk takes depends on what happens in it."""
    return {"mean": float(np.average(values, weights=shares)), "least": min(values), "greatest": max(values)}


@contextmanager
def openmm_of(domain: TrainingDomain, timestep_ps: float, seed: int) -> Iterator[Engine]:
    """Yield OpenMM under the conditions of training, minimised and with velocities. Raises InputError where the domain
    does not say one of these, and what `Engine` raises."""
    given = {name: value for name, value in domain.conditions.items() if value is not None}
    if missing := [name for name in ("force_field", "solvent", "temperature_k") if name not in given]:
        raise InputError(f"the weights do not say their {' and '.join(missing)}; give weights of training that do.")
    conditions = Conditions(
        force=resolve(domain.scene, ForceFieldSpec.of(given)),
        temperature_k=given["temperature_k"],
        friction_per_ps=given.get("friction_per_ps") or 1.0,
        timestep_ps=timestep_ps,
        seed=seed,
    )
    with Engine(domain.scene, conditions) as engine:
        engine.minimise()
        engine.thermalise()
        yield engine


def _by_simd(weights: Weights, config: CostErrorConfig) -> SimdReplicas | None:
    """Return copies of the molecule by SIMD, equilibrated; None where this machine or the force field has none."""
    scene, given = weights.domain.scene, weights.domain.conditions
    try:
        system = build_system(scene, resolve(scene, ForceFieldSpec.of(given)))
        simd = SimdReplicas(
            system, temperature_k=given["temperature_k"], friction_per_ps=given.get("friction_per_ps") or 1.0,
            timestep_ps=TIMESTEP_PS, seed=config.seed,
        )  # fmt: skip
    except SimdUnavailableError:
        return None
    simd.check(system, scene.positions_nm)
    simd.set_positions(np.repeat(scene.positions_nm[None], simd.n_replicas, axis=0))
    simd.thermalise()
    simd.step(_steps(config.slice_ps))
    return simd


def markdown_table(rows: list[dict[str, Any]]) -> list[str]:
    """Return Markdown lines with a column for each key that a row has."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    if not keys:
        return ["nothing was run"]
    head = [key.replace("_", " ") for key in keys]
    lines = [head, ["---"] * len(keys), *([_cell(row.get(key)) for key in keys] for row in rows)]
    return ["| " + " | ".join(cells) + " |" for cells in lines]


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.2e}" if value and abs(value) < 1e-3 else f"{value:.6g}"
    return str(value).replace("|", "\\|")
