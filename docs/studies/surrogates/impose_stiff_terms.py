"""Give weights the stiff terms of a reference (models.stiff): `python docs/studies/surrogates/impose_stiff_terms.py
WEIGHTS REF... -o OUT`.

The network stays as it is, rounded to float16 as weights are shipped; rollouts then hold rigid bonds rigid and draw the
width of other bonds and of angles given the torsions. `--check HELD` rolls with and without and prints, beside a run
that nothing was measured on, widths and how far the energies of frames lie from MD's.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from surrogate.data.features.stiff_terms import drawn_terms
from surrogate.data.frames import collect_frames
from surrogate.data.shipped import weights_path
from surrogate.data.weights import load_weights, save_weights
from systems.chemistry.validity import BOND_20_PERCENT, INVALID, Geometry, check_frames
from systems.errors import InputError
from systems.trajectory.codec import open_trajectory

if TYPE_CHECKING:
    from surrogate.models.stiff import StiffTerms
    from systems.scene import Scene

FloatArray = npt.NDArray[np.float64]
_REPLICAS, _TIME_PS, _ENERGIES = 8, 620.0, 3000


@dataclass(frozen=True)
class StiffFigures:
    """Of one trajectory: widths, root mean square over terms; energies of frames in kJ/mol, with the Wasserstein
    distance to MD's; the share of frames, in per cent, that are valid with every bond within 20 %."""

    name: str
    bond_width_angstrom: float
    angle_width_deg: float
    energy: float
    energy_q99: float
    energy_off: float
    percent_valid: float


def check(weights: Path, held: Path, *, time_ps: float = _TIME_PS, solver_steps: int = 10) -> list[StiffFigures]:
    """Return the figures of `held` MD, of a rollout without the weights' stiff terms and of one with them, each model
    frame of eight replicas; energies are those of the reference's force field, of up to 3,000 frames each.

    Raises InputError for weights without stiff terms.
    """
    from surrogate.data.weights import load_weights
    from surrogate.sampling.runner import RolloutConfig, rollout

    loaded = load_weights(weights)
    scene, stiff = loaded.domain.scene, loaded.stiff
    if stiff is None or not stiff.plan.rows:
        raise InputError(f"{weights} holds no stiff terms to check.")
    with open_trajectory(held) as reader:
        found = {"MD": reader.read().astype(np.float64)}
    with tempfile.TemporaryDirectory(prefix="surromd-stiff-") as folder:
        for name in ("modelled", "imposed"):
            outs = [Path(folder) / f"{name}{k}.h5" for k in range(_REPLICAS)]
            rollout(scene, loaded, outs, RolloutConfig(time_ps=time_ps, solver_steps=solver_steps, stiff=name))
            frames = []
            for out in outs:
                with open_trajectory(out) as reader:
                    frames.append(reader.read().astype(np.float64))
            found[name] = np.concatenate(frames)
    energy = {name: energies(scene, loaded.domain.conditions, x) for name, x in found.items()}
    geometry, figures = Geometry.from_dict(loaded.domain.geometry), []
    for name, x in found.items():
        bad = check_frames(x, geometry) & (INVALID | BOND_20_PERCENT) != 0
        bonds, angles = widths(stiff, x)
        off = _wasserstein(energy[name], energy["MD"])
        figures.append(
            StiffFigures(name, bonds, angles, float(np.median(energy[name])), float(np.quantile(energy[name], 0.99)),
                         off, 100.0 * float(1.0 - bad.mean()))
        )  # fmt: skip
    return figures


def widths(stiff: StiffTerms, frames_nm: FloatArray) -> tuple[float, float]:
    """Return the root mean square widths of flexible bonds (Å) and of angles (degrees) in frames `(n, n_atoms, 3)`."""
    import torch

    lengths, angles, _ = stiff.tree.measure(torch.from_numpy(frames_nm))
    bonds = float(lengths[:, stiff.tree.flexible].var(0).mean().sqrt())
    return 10.0 * bonds, float(np.degrees(float(angles[:, stiff.tree.bent].var(0).mean().sqrt())))


def energies(scene: Scene, conditions: dict[str, Any], frames_nm: FloatArray) -> FloatArray:
    """Return the potential energy in kJ/mol of up to 3,000 evenly spaced frames `(n, n_atoms, 3)` as they are."""
    import openmm
    from openmm import unit

    from md_reference.forces.forcefield import build_system, resolve
    from md_reference.forces.spec import ForceFieldSpec

    system = build_system(scene, resolve(scene, ForceFieldSpec.of(conditions)))
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    found = []
    for k in np.linspace(0, len(frames_nm) - 1, min(_ENERGIES, len(frames_nm))).astype(int):
        context.setPositions(frames_nm[k])
        energy = context.getState(getEnergy=True).getPotentialEnergy()
        found.append(energy.value_in_unit(unit.kilojoule_per_mole))
    return np.array(found)


def _wasserstein(a: FloatArray, b: FloatArray) -> float:
    """Return the first Wasserstein distance between two samples."""
    shares = (np.arange(2000) + 0.5) / 2000
    return float(np.abs(np.quantile(a, shares) - np.quantile(b, shares)).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="name of shipped weights, or a file")
    parser.add_argument("references", nargs="*", type=Path)
    parser.add_argument("--out", "-o", type=Path, help="weights to write, with the references' stiff terms")
    parser.add_argument("--check", type=Path, metavar="HELD", help="MD that nothing was measured on")
    args = parser.parse_args()
    path = weights_path(args.weights)
    if args.references:
        if args.out is None:
            parser.error("say with -o where to write the weights")
        weights, frames = load_weights(path), collect_frames(args.references)
        provenance = {**weights.provenance, "stiff_terms": frames.origin}
        save_weights(args.out, weights.model, weights.domain, provenance, stiff=drawn_terms(frames), half=True)
        path = args.out
    if args.check is None:
        return
    sys.stdout.write("             bonds / Å  angles / °  energy, median  99 %  off by / kJ/mol  valid / %\n")
    for f in check(path, args.check):
        sys.stdout.write(
            f"{f.name:10s} {f.bond_width_angstrom:10.4f} {f.angle_width_deg:10.3f} {f.energy:12.1f} {f.energy_q99:9.1f}"
            f" {f.energy_off:10.2f} {f.percent_valid:16.3f}\n"
        )


if __name__ == "__main__":
    main()
