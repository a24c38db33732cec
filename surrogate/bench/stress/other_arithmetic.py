"""A surrogate under other arithmetic and other settings, and OpenMM under other time steps, by the same criteria."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from surrogate.bench.rolling import Roller
from surrogate.bench.stress.frame_statistics import measure_bonds, measure_validity
from surrogate.data import fitted_atoms
from surrogate.models.layers import with_compiled_parts
from surrogate.models.propagator import Propagator, draw_noise
from surrogate.sampling.chunks import ChunkSampler, noise_seed, with_bf16_weights
from systems.chemistry.validity import Geometry
from systems.errors import SurromdError, first_line

if TYPE_CHECKING:
    from md_reference.run.engine import Engine
    from surrogate.models.weights import TrainingDomain, Weights

SOLVER_STEPS = (2, 5, 10, 20, 40)
BATCHES = (1, 8, 64, 512)
TIMESTEPS_PS = (0.001, 0.002, 0.004, 0.005)
# Before anything is counted OpenMM leaves the minimum that it starts from.
DISCARDED_PS = 10.0
_ROWS = 8
Frames = npt.NDArray[np.float64]


def measure_precision(weights: Weights, *, compiled: bool, seed: int = 0) -> list[dict[str, Any]]:
    """Return of each arithmetic how far its first chunk is from float64's, from the training template, eight replicas.

    `deviation_nm` is the greatest coordinate, `rms_nm` the root mean square; validity is that of this one chunk.
    """
    inputs = _Inputs(weights, _ROWS, seed)
    geometry = Geometry.from_dict(weights.domain.geometry)
    rows: list[dict[str, Any]] = []
    with _in_double():
        reference = inputs.chunk(copy.deepcopy(weights.model).double(), torch.float64)
        rows.append({"arithmetic": "fp64", **_valid(reference, geometry)})

    def add(name: str, draw: Callable[[], Frames]) -> None:
        try:
            draw()  # what is compiled or cached at first
            started = time.process_time()
            frames = draw()
        except (RuntimeError, OSError, ImportError) as error:
            rows.append({"arithmetic": name, "outcome": f"not run: {first_line(error)[:120]}"})
            return
        spent = max(time.process_time() - started, 1e-9)
        gap = np.abs(frames - reference)
        rows.append(
            {
                "arithmetic": name,
                "deviation_nm": float(gap.max()),
                "rms_nm": float(np.sqrt(np.square(gap).mean())),
                **_valid(frames, geometry),
                "frames_per_cpu_s": frames.shape[0] * frames.shape[1] / spent,
            }
        )

    model = weights.model
    add("fp32", lambda: inputs.chunk(model, torch.float32))
    half = with_bf16_weights(model)
    add("bf16", lambda: inputs.chunk(half, torch.float32, autocast=torch.bfloat16))
    add("fp16", lambda: inputs.chunk(model, torch.float32, autocast=torch.float16))
    threads = torch.get_num_threads()
    for number in (1, max(2, threads)):
        torch.set_num_threads(number)
        try:
            add(f"fp32, {number} thread{'s' if number > 1 else ''}", lambda: inputs.chunk(model, torch.float32))
        finally:
            torch.set_num_threads(threads)
    if compiled:
        fast = with_compiled_parts(model)
        add("fp32, compiled", lambda: inputs.chunk(fast, torch.float32))
    return rows


def measure_batches(weights: Weights, *, seed: int = 0, batches: tuple[int, ...] = BATCHES) -> list[dict[str, Any]]:
    """Return of each batch size how far the first replica's chunk is from the same drawn alone, and the speed."""
    sampler = ChunkSampler(weights, precision="fp32")
    start = weights.domain.scene.positions_nm
    alone: Frames | None = None
    rows = []
    for size in batches:
        last = np.repeat(start[None, None], sampler.n_conditioning, axis=1).repeat(size, axis=0)
        started = time.process_time()
        frames = sampler.draw(last, [noise_seed(seed, row, 0) for row in range(size)]).frames_nm
        spent = max(time.process_time() - started, 1e-9)
        alone = frames[0] if alone is None else alone
        rows.append(
            {
                "batch": size,
                "deviation_nm": float(np.abs(frames[0] - alone).max()),
                "frames_per_cpu_s": frames.shape[0] * frames.shape[1] / spent,
            }
        )
    return rows


def measure_solvers(weights: Weights, *, chunks: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return validity and bonds from coarse to fine: solver steps of each solver, and chunks of which only a part is
    kept (so that the surrogate is asked anew after fewer frames)."""
    geometry = Geometry.from_dict(weights.domain.geometry)
    whole = weights.model.n_new
    cases: list[tuple[str | None, int, int]] = [
        (solver, steps, whole) for solver in weights.model.solvers for steps in SOLVER_STEPS
    ]
    default = weights.model.solvers[0] if weights.model.solvers else None
    parts = sorted({max(1, whole // part) for part in (8, 4, 2)})
    cases += [(default, 20, part) for part in parts]
    rows = []
    for solver, steps, kept in cases:
        sampler = ChunkSampler(weights, solver=solver, solver_steps=steps)
        started = time.process_time()
        frames = Roller(weights, sampler, rows=_ROWS, seed=seed).advance(chunks * whole, kept)
        spent = max(time.process_time() - started, 1e-9)
        rows.append(
            {
                "solver": solver or "none",
                "steps": steps if solver else 1,
                "frames_kept_of_chunk": kept,
                **_valid(frames, geometry),
                **measure_bonds(frames.reshape(-1, *frames.shape[2:]), geometry),
                "frames_per_cpu_s": frames.shape[0] * frames.shape[1] / spent,
            }
        )
    return rows


@contextmanager
def openmm_of(domain: TrainingDomain, timestep_ps: float, seed: int, *, hotter_k: float = 0.0) -> Iterator[Engine]:
    """Yield OpenMM under the conditions of training, `hotter_k` above their temperature, minimised and with velocities.

    Raises KeyError where the domain does not say one of these, and what `Engine` raises.
    """
    from md_reference.forces.forcefield import resolve
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.config import Conditions
    from md_reference.run.engine import Engine

    conditions = domain.conditions
    spec = resolve(domain.scene, ForceFieldSpec.of(conditions))
    with Engine(
        domain.scene,
        Conditions(
            force=spec,
            temperature_k=conditions["temperature_k"] + hotter_k,
            friction_per_ps=conditions.get("friction_per_ps") or 1.0,
            timestep_ps=timestep_ps,
            seed=seed,
        ),
    ) as engine:
        engine.minimise()
        engine.thermalise()
        yield engine


def measure_openmm(weights: Weights, *, n_frames: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return the same criteria of OpenMM itself at 1, 2, 4 and 5 fs, under the conditions of training."""
    domain = weights.domain
    geometry, lag_ps = Geometry.from_dict(domain.geometry), domain.lag_ps
    rows: list[dict[str, Any]] = []
    for timestep_ps in TIMESTEPS_PS:
        row: dict[str, Any] = {"timestep_fs": 1e3 * timestep_ps}
        frames = np.empty((n_frames, domain.scene.n_atoms, 3))
        energies, temperatures = np.empty(n_frames), np.empty(n_frames)
        try:
            with openmm_of(domain, timestep_ps, seed) as engine:
                engine.step(round(DISCARDED_PS / timestep_ps))
                started = time.process_time()
                # Of a model with shorter frames than this step, every step is one.
                steps = max(1, round(lag_ps / timestep_ps))
                for k in range(n_frames):
                    engine.step(steps)
                    state = engine.state()
                    frames[k] = state.positions_nm
                    energies[k], temperatures[k] = state.potential_kj_mol, state.temperature_k
            spent = max(time.process_time() - started, 1e-9)
        except KeyError as error:
            rows.append({**row, "outcome": f"not run: the weights do not say their {error}"})
            continue
        except SurromdError as error:
            rows.append({**row, "outcome": str(error)})
            continue
        half = n_frames // 2
        rows.append(
            {
                **row,
                **_valid(frames[None], geometry),
                **measure_bonds(frames, geometry),
                "temperature_k": float(temperatures[half:].mean()),
                "potential_kj_mol": float(energies[half:].mean()),
                "frames_per_cpu_s": n_frames / spent,
            }
        )
    return rows


class _Inputs:
    """The template in its canonical pose and the noise of a few replicas: what `next_chunk` takes."""

    def __init__(self, weights: Weights, rows: int, seed: int) -> None:
        template = weights.domain.scene
        self._molecule = weights.model.featurise(template)
        fit = fitted_atoms(template)
        start = template.positions_nm - template.positions_nm[fit].mean(axis=0)
        model = weights.model
        self._last = torch.from_numpy(start).expand(rows, model.n_conditioning, -1, -1)
        generators = [torch.Generator().manual_seed(noise_seed(seed, row, 0)) for row in range(rows)]
        self._noise = draw_noise(model, template.n_atoms, generators)

    @torch.inference_mode()
    def chunk(self, model: Propagator, dtype: torch.dtype, *, autocast: torch.dtype | None = None) -> Frames:
        """Return frames `(rows, n_new, n_atoms, 3)` nm of a model that computes in `dtype`."""
        with torch.autocast("cpu", dtype=autocast or torch.bfloat16, enabled=autocast is not None):
            found = model.next_chunk(
                self._last.to(dtype).contiguous(), self._molecule, self._noise.to(dtype), solver_steps=20
            )
        frames: Frames = found.frames_nm.double().numpy()
        return frames


@contextmanager
def _in_double() -> Iterator[None]:
    """Let the places where networks ask for float32 (Fourier features, the last layer) compute in float64: the models
    have no such switch, because nobody rolls in float64."""
    single = torch.Tensor.float
    torch.Tensor.float = torch.Tensor.double  # type: ignore[method-assign]
    try:
        yield
    finally:
        torch.Tensor.float = single  # type: ignore[method-assign]


def _valid(frames: Frames, geometry: Geometry) -> dict[str, float]:
    found = measure_validity(list(frames), geometry, 1.0).to_dict()
    return {key: found[key] for key in ("valid_half_angstrom_%", "valid_all_%")}
