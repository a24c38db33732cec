"""What a stress test tries: inputs that a rollout was not made for (moved, noisy, strained, mirrored, permuted,
with other atoms), other arithmetic and settings, and OpenMM under other time steps, all by the same criteria."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation

from surrogate.bench.stress_page import measure_bonds, measure_validity
from surrogate.bench.timing import Frames, Roller, openmm_of
from surrogate.data.frames import fitted_atoms
from surrogate.models.lean import with_compiled_parts
from surrogate.models.propagator import Propagator, draw_noise
from surrogate.sampling.chunks import ChunkSampler, noise_seed, with_bf16_weights
from surrogate.sampling.domain import find_deviations, match_domain
from systems.chemistry.validity import Geometry
from systems.errors import OutOfDomainError, SurromdError, first_line
from systems.scene import FloatArray, Scene, part_of, reordered

if TYPE_CHECKING:
    from surrogate.models.weights import Weights

NOISE_NM = (0.001, 0.003, 0.01, 0.03, 0.1)
_ROWS = 8
SOLVER_STEPS = (2, 5, 10, 20, 40)
BATCHES = (1, 8, 64, 512)
TIMESTEPS_PS = (0.001, 0.002, 0.004, 0.005)
# Before anything is counted OpenMM leaves the minimum that it starts from.
DISCARDED_PS = 10.0


def first_chunk(
    scene: Scene, weights: Weights, sampler: ChunkSampler, *, force: bool = False, rows: int = 1, chunks: int = 1
) -> FloatArray:
    """Return the first chunks `(rows, frames, n_atoms, 3)` nm after a scene, in its atom order."""
    order = match_domain(scene, weights, force=force).order
    roller = Roller(weights, sampler, rows=rows, seed=0, start_nm=scene.positions_nm[order])
    return roller.advance(chunks * sampler.n_new)[:, :, np.argsort(order)]


def measure_invariance(weights: Weights, *, precision: str, seed: int = 0) -> list[dict[str, Any]]:
    """Return how far the first chunk is from that of the unmoved scene, moved alike, in nm (greatest coordinate)."""
    scene = weights.domain.scene
    sampler = ChunkSampler(weights, precision=precision)
    plain = first_chunk(scene, weights, sampler)
    size = float(np.abs(plain - plain.mean(axis=2, keepdims=True)).max())
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_quat(np.roll(rng.normal(size=4), -1)).as_matrix()
    direction = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    moves = {f"translated by {far:g} nm": (np.eye(3), far * direction) for far in (1.0, 10.0, 1e6)}
    found: dict[str, float] = {}
    for name, (turn, shift) in {"rotated": (rotation, np.zeros(3)), **moves}.items():
        chunk = first_chunk(scene.with_positions(scene.positions_nm @ turn.T + shift), weights, sampler)
        found[name] = float(np.abs(chunk - (plain @ turn.T + shift)).max())
    order = np.random.default_rng(seed).permutation(scene.n_atoms)
    permuted = first_chunk(reordered(scene, order), weights, sampler)
    found["atoms permuted"] = float(np.abs(permuted - plain[:, :, order]).max())
    return [
        {"input": name, "precision": precision, "deviation_nm": error, "of_size": error / size}
        for name, error in found.items()
    ]


def odd_scenes(weights: Weights, seed: int) -> Iterator[tuple[str, Scene]]:
    """Yield scenes outside the training domain, by name."""
    scene = weights.domain.scene
    x = scene.positions_nm
    rng = np.random.default_rng(seed)
    for sigma in NOISE_NM:
        yield f"noise of {sigma:g} nm", scene.with_positions(x + rng.normal(scale=sigma, size=x.shape))
    yield "mirrored", scene.with_positions(x * np.array([1.0, 1.0, -1.0]))
    yield "strained: all bonds 10 % longer", scene.with_positions(x * 1.1)
    yield "strained: all bonds 40 % longer", scene.with_positions(x * 1.4)
    far = np.linalg.norm(x[:, None] - x[None], axis=2)
    i, j = (int(k) for k in np.unravel_index(far.argmax(), far.shape))
    clashing = x.copy()
    clashing[i] = x[j] + [0.02, 0.0, 0.0]
    yield "clashing: two far atoms 0.02 nm apart", scene.with_positions(clashing)
    broken = x.copy()
    broken[0, 0] = np.nan
    yield "a coordinate that is no number", scene.with_positions(broken)
    if 0 < len(scene.heavy_idx) < scene.n_atoms:
        yield "heavy atoms only", part_of(scene, scene.heavy_idx)
        lost = next(k for k in range(scene.n_atoms) if scene.elements[k] == "H")
        rest = part_of(scene, np.array([k for k in range(scene.n_atoms) if k != lost]))
        charges = rest.formal_charges.copy()
        charges[0] -= 1
        yield "a proton less", replace(rest, formal_charges=charges)


def measure_odd_inputs(weights: Weights, *, chunks: int = 4, seed: int = 0) -> list[dict[str, Any]]:
    """Return of each odd input: refused or not and why, and what becomes of it when it is forced.

    `first_%` and `last_%`: frames that obey the 0.5 Å rule in the first and the last of `chunks`, over eight replicas.
    """
    sampler = ChunkSampler(weights)
    geometry = Geometry.from_dict(weights.domain.geometry)
    rows = []
    for name, scene in odd_scenes(weights, seed):
        deviations = find_deviations(scene, weights.domain, model=weights.model)
        row: dict[str, Any] = {"input": name, "outcome": "refused" if deviations else "run"}
        row["reasons"] = ", ".join(d.what for d in deviations)
        try:
            order = match_domain(scene, weights, force=True).order
            frames = first_chunk(scene, weights, sampler, force=True, rows=_ROWS, chunks=chunks)[:, :, order]
        except OutOfDomainError:
            row["forced"] = "refused too"
        except SurromdError as error:
            row["forced"] = str(error)
        else:
            row["forced"] = "run, marked" if deviations else ""
            for key, part in (("first_%", slice(sampler.n_new)), ("last_%", slice(-sampler.n_new, None))):
                found = measure_validity(list(frames[:, part]), geometry, 1.0)
                row[key] = 100.0 * (1.0 - found.broken / found.frames)
        rows.append(row)
    return rows


# ---- other arithmetic and settings ----------------------------------------------------------------------------------


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
        speed = _frames_per_cpu_s(frames, started)
        gap = np.abs(frames - reference)
        row = {"deviation_nm": float(gap.max()), "rms_nm": float(np.sqrt(np.square(gap).mean()))}
        rows.append({"arithmetic": name, **row, **_valid(frames, geometry), **speed})

    model = weights.model
    add("fp32", lambda: inputs.chunk(model, torch.float32))
    half = with_bf16_weights(model)
    add("bf16", lambda: inputs.chunk(half, torch.float32, autocast=torch.bfloat16))
    if compiled:
        fast = with_compiled_parts(model)
        add("fp32, compiled", lambda: inputs.chunk(fast, torch.float32))
    return rows


def measure_batches(weights: Weights, *, seed: int = 0, batches: tuple[int, ...] = BATCHES) -> list[dict[str, Any]]:
    """Return of each batch size how far the first replica's chunk is from the same drawn alone, and the speed."""
    sampler = ChunkSampler(weights, precision="fp32")
    alone: Frames | None = None
    rows = []
    for size in batches:
        roller = Roller(weights, sampler, rows=size, seed=seed)
        started = time.process_time()
        frames = roller.advance(sampler.n_new)
        speed = _frames_per_cpu_s(frames, started)
        alone = frames[0] if alone is None else alone
        rows.append({"batch": size, "deviation_nm": float(np.abs(frames[0] - alone).max()), **speed})
    return rows


def measure_solvers(weights: Weights, *, chunks: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return validity and bonds from coarse to fine: at solver steps of each solver."""
    geometry = Geometry.from_dict(weights.domain.geometry)
    solvers: Sequence[str] = weights.model.solvers
    cases: list[tuple[str | None, int]]
    cases = [(solver, steps) for solver in solvers for steps in SOLVER_STEPS]
    rows = []
    for solver, steps in cases or [(None, 1)]:
        sampler = ChunkSampler(weights, solver=solver, solver_steps=steps)
        started = time.process_time()
        frames = Roller(weights, sampler, rows=_ROWS, seed=seed).advance(chunks * sampler.n_new)
        speed = _frames_per_cpu_s(frames, started)
        bonds = measure_bonds(frames.reshape(-1, *frames.shape[2:]), geometry)
        rows.append({"solver": solver or "none", "steps": steps, **_valid(frames, geometry), **bonds, **speed})
    return rows


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
            speed = _frames_per_cpu_s(frames[None], started)
        except KeyError as error:
            rows.append({**row, "outcome": f"not run: the weights do not say their {error}"})
            continue
        except SurromdError as error:
            rows.append({**row, "outcome": str(error)})
            continue
        half = n_frames // 2
        row |= _valid(frames[None], geometry) | measure_bonds(frames, geometry)
        row |= {"temperature_k": float(temperatures[half:].mean()), "potential_kj_mol": float(energies[half:].mean())}
        rows.append(row | speed)
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


def _frames_per_cpu_s(frames: npt.NDArray[Any], started: float) -> dict[str, float]:
    spent = max(time.process_time() - started, 1e-9)
    return {"frames_per_cpu_s": frames.shape[0] * frames.shape[1] / spent}


def _valid(frames: Frames, geometry: Geometry) -> dict[str, float]:
    found = measure_validity(list(frames), geometry, 1.0).to_dict()
    return {key: found[key] for key in ("valid_half_angstrom_%", "valid_all_%")}
