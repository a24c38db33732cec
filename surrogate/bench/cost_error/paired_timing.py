"""Timing of the surrogate and of MD by turns, in processor seconds for a ns."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.bench.cost_error.sweep_settings import OURS, PLAIN, SIMD, CostErrorConfig, Setting
from surrogate.bench.rolling import Frames, Roller
from surrogate.bench.stress.other_arithmetic import openmm_of
from systems.errors import SurromdError

if TYPE_CHECKING:
    from md_reference.simd.force_field import SimdReplicas
    from surrogate.models.weights import Weights
    from surrogate.sampling.chunks import ChunkSampler

TIMESTEPS_PS = (0.001, 0.002, 0.004)


def chunk_ps(weights: Weights, sampler: ChunkSampler, setting: Setting) -> float:
    """Simulated time of a chunk of all replicas together."""
    return sampler.n_new * setting.batch * weights.domain.lag_ps


def roll_in_turns(weights: Weights, roller: Roller, sampler: ChunkSampler, setting: Setting,
                   config: CostErrorConfig) -> tuple[list[Frames], dict[str, Any]]:  # fmt: skip
    """Return the frames of each part, and what a ns of the surrogate and of MD at 4 fs took beside each other."""
    n_chunks = max(config.rounds, math.ceil(config.time_ps / chunk_ps(weights, sampler, setting)))
    shares = [n_chunks * k // config.rounds for k in range(config.rounds + 1)]
    parts, cpu, wall, md, sizes = [], [], [], [], []
    with openmm_of(weights.domain, TIMESTEPS_PS[-1], config.seed) as engine:
        n_steps = _steps(config.slice_ps, TIMESTEPS_PS[-1])
        for k in range(config.rounds):
            md.append(_seconds_per_ns(config.slice_ps, lambda: engine.step(n_steps))[0])
            n = (shares[k + 1] - shares[k]) * sampler.n_new
            ps = n * setting.batch * weights.domain.lag_ps
            found: list[Frames] = []
            seconds = _seconds_per_ns(ps, lambda n=n, found=found: found.append(roller.advance(n)))  # type: ignore[misc]
            parts += found
            sizes.append(ps)
            cpu.append(seconds[0])
            wall.append(seconds[1])
    ratios = [m / c for m, c in zip(md, cpu, strict=True)]
    return parts, {
        "cpu_s_per_ns": _spread(cpu, sizes),
        "wall_s_per_ns": _spread(wall, sizes),
        "md_s_per_ns": _spread(md),
        "speed_over_md": _spread(ratios),
    }


def md_costs(weights: Weights, config: CostErrorConfig) -> list[dict[str, Any]]:
    """Return processor and wall seconds of MD for a ns, by turns: OpenMM as it is set up here at each time step, MD in
    SIMD at the longest where it runs, and what OpenMM's manual makes of the model on one thread (`plain_openmm.plain`),
    where it knows the force field.

    A plain step is timed once: it takes the same at any time step, of which 4 fs wants heavier hydrogens.
    """
    with ExitStack() as stack:
        engines = {dt: stack.enter_context(openmm_of(weights.domain, dt, config.seed)) for dt in TIMESTEPS_PS}
        found: dict[float, list[tuple[float, float]]] = {dt: [] for dt in TIMESTEPS_PS}
        simple, simd = _plain_steps(weights, config), _by_simd(weights, config)
        steps: list[tuple[float, float]] = []
        together: list[tuple[float, float]] = []
        for _ in range(config.rounds):
            for dt, engine in engines.items():
                n = _steps(config.slice_ps, dt)
                found[dt].append(_seconds_per_ns(config.slice_ps, lambda e=engine, n=n: e.step(n)))  # type: ignore[misc]
            if simd is not None:
                n = _steps(config.slice_ps, simd.timestep_ps)
                together.append(_seconds_per_ns(config.slice_ps * simd.n_replicas, lambda n=n: simd.step(n)))  # type: ignore[misc]
            if simple is not None:
                steps.append(_seconds_per_ns(_steps(config.slice_ps, TIMESTEPS_PS[-1]), simple))
    rows = [_md_cost(OURS, dt, times) for dt, times in found.items()]
    if steps:
        rows += [_md_cost(PLAIN, dt, [(cpu / dt, wall / dt) for cpu, wall in steps]) for dt in TIMESTEPS_PS]
    return rows + ([_md_cost(SIMD, TIMESTEPS_PS[-1], together)] if simd is not None else [])


def _md_cost(way: str, timestep_ps: float, times: Sequence[tuple[float, float]]) -> dict[str, Any]:
    name = {OURS: "OpenMM, {:g} fs", PLAIN: "OpenMM, {:g} fs, plain", SIMD: "MD by SIMD replicas, {:g} fs"}[way]
    return {
        "label": name.format(1e3 * timestep_ps),
        "way": way,
        "timestep_fs": 1e3 * timestep_ps,
        "cpu_s_per_ns": _spread([cpu for cpu, _ in times]),
        "wall_s_per_ns": _spread([wall for _, wall in times]),
    }


def _by_simd(weights: Weights, config: CostErrorConfig) -> SimdReplicas | None:
    """Return copies of the molecule by SIMD, equilibrated; None where this machine or the force field has none."""
    from md_reference.forces.forcefield import build_system, resolve
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.simd.force_field import SimdReplicas
    from md_reference.simd.system_terms import SimdUnavailableError

    domain = weights.domain
    try:
        system = build_system(domain.scene, resolve(domain.scene, ForceFieldSpec.of(domain.conditions)))
        simd = SimdReplicas(
            system, temperature_k=domain.conditions["temperature_k"],
            friction_per_ps=domain.conditions.get("friction_per_ps") or 1.0, timestep_ps=TIMESTEPS_PS[-1],
            seed=config.seed,
        )  # fmt: skip
    except (KeyError, SimdUnavailableError):
        return None
    simd.check(system, domain.scene.positions_nm)
    simd.set_positions(np.repeat(domain.scene.positions_nm[None], simd.n_replicas, axis=0))
    simd.thermalise()
    simd.step(_steps(config.slice_ps, TIMESTEPS_PS[-1]))
    return simd


def _plain_steps(weights: Weights, config: CostErrorConfig) -> Callable[[], object] | None:
    """Return what runs plain OpenMM for as many steps as a slice has at 4 fs; None where it cannot be set up."""
    from md_reference.forces.spec import ForceFieldSpec
    from surrogate.bench.plain_openmm import plain

    domain = weights.domain
    spec = ForceFieldSpec(str(domain.conditions["force_field"]), str(domain.conditions["solvent"]))
    try:
        context = plain(domain.scene, spec, threads=config.threads).context
    except (KeyError, ValueError, SurromdError):
        return None
    context.setPositions(domain.scene.positions_nm)
    n_steps = _steps(config.slice_ps, TIMESTEPS_PS[-1])
    return lambda: (context.getIntegrator().step(n_steps), context.getState())


def _steps(time_ps: float, timestep_ps: float) -> int:
    return max(1, round(time_ps / timestep_ps))


def _seconds_per_ns(simulated_ps: float, run: Callable[[], object]) -> tuple[float, float]:
    """Return processor seconds (of this process, all threads) and wall seconds of `run` for a ns that it simulates."""
    wall, cpu = time.perf_counter(), time.process_time()
    run()
    spent = max(time.process_time() - cpu, 1e-9), max(time.perf_counter() - wall, 1e-9)
    return 1e3 * spent[0] / simulated_ps, 1e3 * spent[1] / simulated_ps


def _spread(values: Sequence[float], shares: Sequence[float] | None = None) -> dict[str, float]:
    """Return the mean of all parts together, and the extremes: what a chunk takes depends on what happens in it."""
    weights = [1.0] * len(values) if shares is None else shares
    mean = sum(x * w for x, w in zip(values, weights, strict=True)) / sum(weights)
    return {"mean": mean, "least": min(values), "greatest": max(values)}
