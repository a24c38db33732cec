"""A surrogate that carries velocities, held against MD as an integrator.

    python docs/studies/published/integrator.py WEIGHTS REF

From states of a reference with velocities that training has not seen:
- NVE: chunks without a bath. Total energy (OpenMM's potential, kinetic energy of the velocities that chunks end in)
  against time; its drift per atom is zero for an exact integrator.
- sampling: chunks with the bath. Standard deviations of bonds and angles over those of the reference, and the mean
  potential energy beside it. Never the kinetic temperature, which the bath sets.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from surrogate.data import TrainingFrames, collect_frames
from surrogate.models.painet.model import Painet
from surrogate.models.propagator import Molecule, Propagator
from surrogate.models.weights import load_weights
from systems.errors import InputError
from systems.scene import Scene

FloatArray = npt.NDArray[np.float64]
# Positions (n_atoms, 3) nm -> potential energy, kJ/mol.
EnergyFn = Callable[[FloatArray], float]


@dataclass(frozen=True)
class IntegratorReport:
    """Drift of the total energy in kJ/mol/ps per atom, mean and standard error over starts, and its spread at the end
    per atom; ratios of standard deviations, medians over bonds and over angles; mean potential energies in kJ/mol.
    `finite`: share of the starts whose sampling stayed finite to the end."""

    starts: int
    nve_ps: float
    drift: float
    drift_error: float
    spread: float
    sampled_ps: float
    finite: float
    bond_ratio: float
    angle_ratio: float
    potential: float
    reference_potential: float


def compare_integrator(model: Propagator, frames: TrainingFrames, energy: EnergyFn, *, nve: Propagator, starts: int,
                     chunks: int, seed: int = 0) -> IntegratorReport:  # fmt: skip
    """Roll `chunks` chunks from `starts` evenly spaced frames of `frames` (with velocities), with and without the bath
    (`model`, `nve`), and compare."""
    if frames.velocities is None:
        raise InputError("these frames carry no velocities to start from.")
    scene = frames.scene
    picked = np.linspace(0, frames.n_frames - 1, starts).astype(np.int64)
    x, v = frames.positions_nm(picked), frames.velocities[picked]
    chunk_ps = model.n_new * frames.lag_ps
    ends, end_velocities, _ = rolled(nve, scene, x, v, chunks, seed)
    total = np.stack([[_total(scene, energy, *state) for state in zip(a, b, strict=True)]
                      for a, b in zip(ends, end_velocities, strict=True)])  # fmt: skip
    times = chunk_ps * np.arange(chunks + 1)
    slopes = np.polyfit(times, total.T, 1)[0] / scene.n_atoms
    _, _, sampled = rolled(model, scene, x, v, chunks, seed)
    alive = np.isfinite(sampled).all((1, 2, 3))
    half = sampled[alive][:, sampled.shape[1] // 2 :].reshape(-1, scene.n_atoms, 3)
    reference = frames.positions_nm(np.arange(frames.n_frames)).astype(np.float64)
    some = lambda f: f[np.linspace(0, len(f) - 1, min(len(f), 200)).astype(int)]  # noqa: E731
    ratios = [np.nan, np.nan]
    if len(half):
        ratios = [float(np.median(of(scene, half).std(0) / of(scene, reference).std(0))) for of in (bonds, angles)]
    return IntegratorReport(
        starts=starts,
        nve_ps=float(times[-1]),
        drift=float(slopes.mean()),
        drift_error=float(slopes.std(ddof=1) / np.sqrt(starts)),
        spread=float((total[:, -1] - total[:, 0]).std() / scene.n_atoms),
        sampled_ps=float(times[-1]),
        finite=float(alive.mean()),
        bond_ratio=ratios[0],
        angle_ratio=ratios[1],
        potential=float(np.mean([energy(f) for f in some(half)])) if len(half) else float("nan"),
        reference_potential=float(np.mean([energy(f) for f in some(reference)])),
    )


def compare_weights(path: Path, frames: TrainingFrames, *, starts: int, chunks: int, seed: int = 0) -> IntegratorReport:
    """`compare_integrator` of a weights file of PAINET, with OpenMM's energies of its force field, bonds flexible.

    Raises InputError for weights that carry no velocities.
    """
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.config import Conditions
    from md_reference.run.engine import Engine

    weights = load_weights(path)
    if not isinstance(weights.model, Painet):
        raise InputError(f"{path} ({weights.model.arch}) carries no velocities.")
    of = weights.domain.conditions
    spec = ForceFieldSpec(of["force_field"], of["solvent"], None, constrain_hydrogens=False)
    nve = Painet(replace(weights.model.config, friction_per_ps=0.0)).eval()
    nve.load_state_dict(weights.model.state_dict())
    strided = replace(frames, lag_ps=frames.lag_ps * weights.model.config.frame_stride)
    with Engine(frames.scene, Conditions(force=spec, platform="Reference", timestep_ps=0.0005)) as engine:
        return compare_integrator(
            weights.model, strided, engine.energy, nve=nve, starts=starts, chunks=chunks, seed=seed
        )


@torch.inference_mode()
def rolled(model: Propagator, scene: Scene, x: npt.NDArray[np.float32], v: npt.NDArray[np.float32], chunks: int,
           seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return positions and velocities `(b, chunks + 1, n_atoms, 3)` where chunks end, from the start on, and all
    frames."""
    molecule, generator = Molecule.of(scene), torch.Generator().manual_seed(seed)
    frames, velocities = torch.from_numpy(x)[:, None], torch.from_numpy(v)
    ends, end_velocities, every = [frames[:, 0]], [velocities], []
    for _ in range(chunks):
        noise = torch.randn(len(x), *model.noise_shape(scene.n_atoms), generator=generator)
        chunk = model.next_chunk(frames[:, -1:], molecule, noise, last_velocities_nm_ps=velocities)
        assert chunk.velocities_nm_ps is not None
        frames, velocities = chunk.frames_nm, chunk.velocities_nm_ps
        ends.append(frames[:, -1])
        end_velocities.append(velocities)
        every.append(frames)
    joined = (torch.stack(ends, 1), torch.stack(end_velocities, 1), torch.cat(every, 1))
    return tuple(t.double().numpy() for t in joined)  # type: ignore[return-value]


def _total(scene: Scene, energy: EnergyFn, x: FloatArray, v: FloatArray) -> float:
    if not (np.isfinite(x).all() and np.isfinite(v).all()):
        return float("nan")
    return energy(x) + 0.5 * float((scene.masses_da[:, None] * np.square(v)).sum())


def bonds(scene: Scene, frames_nm: FloatArray) -> FloatArray:
    """Bond lengths `(n_frames, n_bonds)` nm."""
    return np.linalg.norm(frames_nm[:, scene.bonds[:, 0]] - frames_nm[:, scene.bonds[:, 1]], axis=-1)


def angles(scene: Scene, frames_nm: FloatArray) -> FloatArray:
    """Bond angles `(n_frames, n_angles)` in radians."""
    near = scene.neighbours()
    triples = np.array([(a, j, b) for j, row in enumerate(near) for a in row for b in row if a < b])
    first, second = (frames_nm[:, triples[:, k]] - frames_nm[:, triples[:, 1]] for k in (0, 2))
    lengths = np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1)
    return np.arccos(np.clip((first * second).sum(-1) / lengths, -1.0, 1.0))


def cut(frames: TrainingFrames, share: float) -> tuple[TrainingFrames, TrainingFrames]:
    """Split frames of one trajectory by time: all but the last `share`, and that."""
    at = round(frames.n_frames * (1.0 - share))
    if frames.velocities is None:
        raise InputError("these frames carry no velocities.")
    parts = []
    for part in (slice(0, at), slice(at, frames.n_frames)):
        x, v = frames.coordinates[part], frames.velocities[part]
        parts.append(replace(frames, coordinates=x, velocities=v, starts=np.array([0, len(x)])))
    return parts[0], parts[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("reference", type=Path, help="trajectory with velocities")
    parser.add_argument("--share", type=float, default=0.05, help="of the reference's end that is used")
    parser.add_argument("--starts", type=int, default=16)
    parser.add_argument("--chunks", type=int, default=25)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    torch.set_num_threads(1)
    _, frames = cut(collect_frames([args.reference], canonical=False, velocities=True), args.share)
    report = compare_weights(args.weights, frames, starts=args.starts, chunks=args.chunks, seed=args.seed)
    for key, value in asdict(report).items():
        sys.stdout.write(f"{key:20} {value:.5g}\n")
    if args.json is not None:
        args.json.write_text(json.dumps(asdict(report), indent=1))


if __name__ == "__main__":
    main()
