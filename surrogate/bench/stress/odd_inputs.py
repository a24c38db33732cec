"""Inputs that a rollout was not made for: moved, noisy, strained, hot, mirrored, permuted, with other atoms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from surrogate.bench.stress.frame_statistics import measure_validity
from surrogate.bench.stress.other_arithmetic import openmm_of
from surrogate.sampling.chunks import ChunkSampler, noise_seed
from surrogate.sampling.domain import find_deviations, match_domain
from systems.chemistry.validity import Geometry
from systems.errors import OutOfDomainError, SurromdError
from systems.library.named_scenes import prepare
from systems.scene import Scene, part_of, reordered
from systems.trajectory.companion_writer import pdb_text

if TYPE_CHECKING:
    from surrogate.models.weights import Weights

FloatArray = npt.NDArray[np.float64]
NOISE_NM = (0.001, 0.003, 0.01, 0.03, 0.1)
_ROWS = 8
_HOT_K = 50.0


def moved_scenes(scene: Scene, seed: int) -> Iterator[tuple[str, Scene, FloatArray, FloatArray]]:
    """Yield names, scenes and the rotation `(3, 3)` and shift `(3,)` nm that made them of a scene."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_quat(np.roll(rng.normal(size=4), -1)).as_matrix()
    still, none = np.eye(3), np.zeros(3)
    direction = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    yield "rotated", scene.with_positions(scene.positions_nm @ rotation.T), rotation, none
    for far in (1.0, 10.0, 1e6):
        shift = far * direction
        yield f"translated by {far:g} nm", scene.with_positions(scene.positions_nm + shift), still, shift


def first_chunk(scene: Scene, weights: Weights, sampler: ChunkSampler, *, force: bool = False, rows: int = 1,
                chunks: int = 1) -> FloatArray:  # fmt: skip
    """Return the first chunks `(rows, frames, n_atoms, 3)` nm after a scene, in its atom order, float64 throughout."""
    order = match_domain(scene, weights, force=force).order
    start = scene.positions_nm[order]
    last = np.repeat(start[None, None], sampler.n_conditioning, axis=1).repeat(rows, axis=0)
    drawn, velocities = [], None
    for number in range(chunks):
        made = sampler.draw(last, [noise_seed(0, row, number) for row in range(rows)], velocities)
        drawn.append(made.frames_nm)
        velocities = made.velocities_nm_ps
        last = np.concatenate([last, made.frames_nm], axis=1)[:, -sampler.n_conditioning :]
    return np.concatenate(drawn, axis=1).astype(np.float64)[:, :, np.argsort(order)]


def measure_invariance(weights: Weights, *, precision: str, seed: int = 0) -> list[dict[str, Any]]:
    """Return how far the first chunk is from that of the unmoved scene, moved alike, in nm (greatest coordinate)."""
    scene = weights.domain.scene
    sampler = ChunkSampler(weights, precision=precision)
    plain = first_chunk(scene, weights, sampler)
    size = float(np.abs(plain - plain.mean(axis=2, keepdims=True)).max())
    rows = []
    for name, moved, rotation, shift in moved_scenes(scene, seed):
        chunk = first_chunk(moved, weights, sampler)
        error = float(np.abs(chunk - (plain @ rotation.T + shift)).max())
        rows.append({"input": name, "precision": precision, "deviation_nm": error, "of_size": error / size})
    for name, error in _moved_in_files(scene, weights, sampler):
        rows.append({"input": name, "precision": precision, "deviation_nm": error, "of_size": error / size})
    order = np.random.default_rng(seed).permutation(scene.n_atoms)
    chunk = first_chunk(reordered(scene, order), weights, sampler)
    error = float(np.abs(chunk - plain[:, :, order]).max())
    rows.append({"input": "atoms permuted", "precision": precision, "deviation_nm": error, "of_size": error / size})
    return rows


def _moved_in_files(scene: Scene, weights: Weights, sampler: ChunkSampler) -> Iterator[tuple[str, float]]:
    """Yield how far the first chunk of a molecule that a PDB file puts 1 and 10 nm away is from where it should be."""
    still = first_chunk(_through_pdb(scene), weights, sampler)
    for far in (1.0, 10.0):
        shift = np.array([far, -far, 0.0])
        chunk = first_chunk(_through_pdb(scene.with_positions(scene.positions_nm + shift)), weights, sampler)
        yield f"translated by {far:g} nm along x and y in a PDB file", float(np.abs(chunk - (still + shift)).max())


def _through_pdb(scene: Scene) -> Scene:
    """Return what our own PDB file of a scene is read as."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.pdb"
        path.write_text(pdb_text(scene))
        return prepare(str(path))


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
    hot = _hot_frame(weights, seed)
    if hot is not None:
        yield f"{_HOT_K:g} K too hot, from MD", scene.with_positions(hot)
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


def _hot_frame(weights: Weights, seed: int) -> FloatArray | None:
    """A frame `(n_atoms, 3)` nm of MD at 50 K more than the training's, None for weights that OpenMM cannot follow."""
    try:
        timestep_ps = weights.domain.conditions["timestep_ps"]
        with openmm_of(weights.domain, timestep_ps, seed, hotter_k=_HOT_K) as engine:
            engine.step(round(5.0 / timestep_ps))
            return engine.positions()
    except (KeyError, SurromdError):
        return None
