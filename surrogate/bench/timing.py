"""What the surrogate and MD cost beside each other, in processor seconds for a ns, and the machine that this holds for.
Rollouts are made in memory, without guards and without files."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from md_reference.forces.spec import PROTEIN_FILES, ForceFieldSpec, cutoff_nm, water_file
from surrogate.bench.bench_options import CostErrorConfig, Setting
from surrogate.sampling.chunks import ChunkSampler, noise_seed
from systems.errors import SurromdError
from systems.scene import FloatArray, Scene

if TYPE_CHECKING:
    from md_reference.run.engine import Engine
    from md_reference.simd.force_field import SimdReplicas
    from surrogate.models.weights import TrainingDomain, Weights

Frames = npt.NDArray[np.float64]
TIMESTEPS_PS = (0.001, 0.002, 0.004)
# Ways of MD: OpenMM as it is set up here and as its manual does, and sixteen copies at once (`md_reference.simd`).
OURS, PLAIN, SIMD = "ours", "plain", "simd"


def machine_facts() -> dict[str, Any]:
    """Return the machine's name, the load that was there before and the speed of its matrix products on torch's
    threads; JSON-able."""
    import torch

    from md_reference.run.machine import machine_name
    from surrogate.training.devices import product_speed

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
        self._sampler, self._rows, self._seed = sampler, rows, seed
        self._last = np.repeat(start[None, None], sampler.n_conditioning, axis=1).repeat(rows, axis=0)
        self._velocities: npt.NDArray[np.floating] | None = None
        self._chunk = 0

    def advance(self, n_frames: int) -> Frames:
        """Return `(rows, n_frames, n_atoms, 3)` nm. What a last chunk has beyond `n_frames` is lost: the next call goes
        on from that chunk's end."""
        parts: list[Frames] = []
        for _ in range(-(-n_frames // self._sampler.n_new)):
            seeds = [noise_seed(self._seed, row, self._chunk) for row in range(self._rows)]
            drawn = self._sampler.draw(self._last, seeds, self._velocities)
            self._velocities = drawn.velocities_nm_ps
            parts.append(drawn.frames_nm.astype(np.float64))
            self._last = np.concatenate([self._last, parts[-1]], axis=1)[:, -self._sampler.n_conditioning :]
            self._chunk += 1
        return np.concatenate(parts, axis=1)[:, :n_frames]


def roll_in_turns(weights: Weights, roller: Roller, sampler: ChunkSampler, setting: Setting,
                   config: CostErrorConfig) -> tuple[list[Frames], dict[str, Any]]:  # fmt: skip
    """Return the frames of each part, and what a ns of the surrogate and of MD at 4 fs took beside each other."""
    chunk_ps = sampler.n_new * setting.batch * weights.domain.lag_ps
    n_chunks = max(config.rounds, math.ceil(config.time_ps / chunk_ps))
    shares = [n_chunks * k // config.rounds for k in range(config.rounds + 1)]
    parts: list[Frames] = []
    costs, md, sizes = [], [], []
    with openmm_of(weights.domain, TIMESTEPS_PS[-1], config.seed) as engine:
        n_steps = _steps(config.slice_ps, TIMESTEPS_PS[-1])
        for first, last in pairwise(shares):
            md.append(_seconds_per_ns(config.slice_ps, partial(engine.step, n_steps))[0])
            n = (last - first) * sampler.n_new
            sizes.append(n * setting.batch * weights.domain.lag_ps)
            costs.append(_seconds_per_ns(sizes[-1], lambda n=n: parts.append(roller.advance(n))))  # type: ignore[misc]
    cpu, wall = zip(*costs, strict=True)
    return parts, {
        "cpu_s_per_ns": _spread(cpu, sizes),
        "wall_s_per_ns": _spread(wall, sizes),
        "md_s_per_ns": _spread(md),
        "speed_over_md": _spread([m / c for m, c in zip(md, cpu, strict=True)]),
    }


def md_costs(weights: Weights, config: CostErrorConfig) -> list[dict[str, Any]]:
    """Return processor and wall seconds of MD for a ns, by turns: OpenMM as it is set up here at each time step, MD in
    SIMD at the longest where it runs, and what OpenMM's manual makes of the model on one thread (`plain_context`),
    where it knows the force field.

    A plain step is timed once: it takes the same at any time step, of which 4 fs wants heavier hydrogens.
    """
    slice_ps = config.slice_ps
    with ExitStack() as stack:
        ways: dict[tuple[str, float], tuple[float, Callable[[], object]]] = {}
        for dt in TIMESTEPS_PS:
            engine = stack.enter_context(openmm_of(weights.domain, dt, config.seed))
            ways[OURS, dt] = slice_ps, partial(engine.step, _steps(slice_ps, dt))
        n_steps = _steps(slice_ps, TIMESTEPS_PS[-1])
        plain, simd = _plain_steps(weights, config), _by_simd(weights, config)
        if simd is not None:
            ways[SIMD, simd.timestep_ps] = slice_ps * simd.n_replicas, partial(simd.step, n_steps)
        if plain is not None:
            ways[PLAIN, 1.0] = float(n_steps), plain  # at one ps a step
        found: dict[tuple[str, float], list[tuple[float, float]]] = {way: [] for way in ways}
        for _ in range(config.rounds):
            for way, (simulated_ps, run) in ways.items():
                found[way].append(_seconds_per_ns(simulated_ps, run))
    rows = [_md_cost(OURS, dt, found[OURS, dt]) for dt in TIMESTEPS_PS]
    if plain is not None:
        steps = found[PLAIN, 1.0]
        rows += [_md_cost(PLAIN, dt, [(cpu / dt, wall / dt) for cpu, wall in steps]) for dt in TIMESTEPS_PS]
    return rows + [_md_cost(*way, times) for way, times in found.items() if way[0] == SIMD]


def _md_cost(way: str, timestep_ps: float, times: Sequence[tuple[float, float]]) -> dict[str, Any]:
    name = {OURS: "OpenMM, {:g} fs", PLAIN: "OpenMM, {:g} fs, plain", SIMD: "MD by SIMD replicas, {:g} fs"}[way]
    return {
        "label": name.format(1e3 * timestep_ps),
        "way": way,
        "timestep_fs": 1e3 * timestep_ps,
        "cpu_s_per_ns": _spread([cpu for cpu, _ in times]),
        "wall_s_per_ns": _spread([wall for _, wall in times]),
    }


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
    return {"mean": float(np.average(values, weights=shares)), "least": min(values), "greatest": max(values)}


# ---- ways of MD -----------------------------------------------------------------------------------------------------


@contextmanager
def openmm_of(domain: TrainingDomain, timestep_ps: float, seed: int) -> Iterator[Engine]:
    """Yield OpenMM under the conditions of training, minimised and with velocities. Raises KeyError where the domain
    does not say one of these, and what `Engine` raises."""
    from md_reference.forces.forcefield import resolve
    from md_reference.run.config import Conditions
    from md_reference.run.engine import Engine

    given = domain.conditions
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
    from md_reference.forces.forcefield import build_system, resolve
    from md_reference.simd.force_field import SimdReplicas
    from md_reference.simd.system_terms import SimdUnavailableError

    scene, given = weights.domain.scene, weights.domain.conditions
    try:
        system = build_system(scene, resolve(scene, ForceFieldSpec.of(given)))
        simd = SimdReplicas(
            system, temperature_k=given["temperature_k"], friction_per_ps=given.get("friction_per_ps") or 1.0,
            timestep_ps=TIMESTEPS_PS[-1], seed=config.seed,
        )  # fmt: skip
    except (KeyError, SimdUnavailableError):
        return None
    simd.check(system, scene.positions_nm)
    simd.set_positions(np.repeat(scene.positions_nm[None], simd.n_replicas, axis=0))
    simd.thermalise()
    simd.step(_steps(config.slice_ps, TIMESTEPS_PS[-1]))
    return simd


def _plain_steps(weights: Weights, config: CostErrorConfig) -> Callable[[], object] | None:
    """Return what runs plain OpenMM for as many steps as a slice has at 4 fs; None where it cannot be set up."""
    domain = weights.domain
    spec = ForceFieldSpec(str(domain.conditions["force_field"]), str(domain.conditions["solvent"]))
    try:
        context = plain_context(domain.scene, spec, threads=config.threads)
    except (KeyError, ValueError, SurromdError):
        return None
    context.setPositions(domain.scene.positions_nm)
    n_steps = _steps(config.slice_ps, TIMESTEPS_PS[-1])
    return lambda: (context.getIntegrator().step(n_steps), context.getState())


def plain_context(scene: Scene, spec: ForceFieldSpec, *, threads: int | None) -> Any:
    """Return an `openmm.Context` of what OpenMM's manual makes of the model: its files, its defaults, 300 K, 1/ps, 2
    fs, the platform it picks by itself.

    `threads`: of the CPU platform where that is picked; None leaves its default, all cores.
    """
    from openmm import LangevinMiddleIntegrator, Platform, app

    topology, system = scene.to_openmm_topology(), plain_system(scene, spec)
    simulation = app.Simulation(topology, system, LangevinMiddleIntegrator(300.0, 1.0, 0.002))
    if threads is not None and simulation.context.getPlatform().getName() == "CPU":
        chosen = Platform.getPlatform("CPU"), {"Threads": str(threads)}
        simulation = app.Simulation(topology, system, LangevinMiddleIntegrator(300.0, 1.0, 0.002), *chosen)
    return simulation.context


def plain_system(scene: Scene, spec: ForceFieldSpec) -> Any:
    """Return the `openmm.System` by OpenMM's own way: its XML files, or for GAFF2 its reader of the same prmtop.

    Bonds to hydrogen are rigid, as a step of 2 fs needs; all else is default, the removal of the centre of mass's
    motion included.
    """
    from openmm import app, unit

    rigid = {"constraints": app.HBonds}
    if spec.force_field == "gaff2":
        from md_reference.forces import gaff

        implicit = {"implicitSolvent": app.OBC2} if spec.solvent == "obc2" else {}
        return gaff.entry(scene).system(scene, nonbondedMethod=app.NoCutoff, **rigid, **implicit)
    files = [PROTEIN_FILES[spec.force_field]]
    box: dict[str, Any] = {"nonbondedMethod": app.NoCutoff}
    if spec.solvent == "obc2":
        files.append("implicit/obc2.xml")
    elif spec.is_explicit:
        files.append(str(water_file(spec.force_field, spec.solvent)))
        box = {"nonbondedMethod": app.PME, "nonbondedCutoff": cutoff_nm(spec.force_field)[0] * unit.nanometer}
    topology = scene.to_openmm_topology()
    if scene.cell_nm is not None:
        topology.setPeriodicBoxVectors(scene.cell_nm * unit.nanometer)
    return app.ForceField(*files).createSystem(topology, **rigid, **box)
