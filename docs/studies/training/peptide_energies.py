"""How likely each phi is in each capped amino acid: `python docs/studies/training/peptide_energies.py FOLDER`.

Short runs leave phi > 0 and hardly ever enter it, so they do not tell how rare it is. Umbrella sampling does: sixteen
copies of the molecule at once (`md_reference.simd`), each held at another phi, neighbours exchanging their places
(Sugita, Kitao and Okamoto, J. Chem. Phys. 113, 6042 (2000)) so that psi and side chains turn where phi lets them, put
together by WHAM (Kumar et al., J. Comput. Chem. 13, 1011 (1992)). Two runs of each, whose difference is kept; what is
in FOLDER is not done again.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from peptide_list import RESIDUES

from md_reference.forces.forcefield import build_system
from md_reference.forces.spec import ForceFieldSpec
from md_reference.simd.force_field import SimdReplicas
from surrogate.models.peptides.chains import POSITIVE_PHI_DEG
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions
from systems.prepare.peptide import build_peptide
from systems.scene import Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
_KELVIN, _TIMESTEP_PS = 300.0, 0.004
# Centres from phi > 0 over the lower barrier, at 0, and round to -180; the higher one, at 130, is left open. They lie
# 18 degrees apart, and within its window phi scatters by 9. Less stiff ones slip from the barrier.
_FIRST_RAD, _LAST_RAD = math.radians(82.0), math.radians(-185.0)
_STIFFNESS_KJ_MOL = 100.0
_PULLED_PS, _RESOLVED_PS, _SAVE_PS = 100.0, 200.0, 0.4
_BINS = 72
_SWEEPS = 20_000
_CONVERGED_KT = 1e-6
_SEEDS = (1, 2)


def population_of_phi(scene: Scene, *, time_ps: float, seed: int) -> FloatArray:
    """Return the population `(72,)` of phi of the first residue that has one, in bins from -π, at 300 K; `time_ps` is
    that of each copy. Raises SimulationError. Not for glycine, which has no higher barrier."""
    quad = backbone_torsions(scene)["phi"][0]
    system = build_system(scene, ForceFieldSpec("ff14SB", "obc2"))
    run = SimdReplicas(
        system, temperature_k=_KELVIN, friction_per_ps=1.0, timestep_ps=_TIMESTEP_PS, seed=seed, biased=[quad.tolist()]
    )
    run.check(system, scene.positions_nm)
    centres = np.linspace(_FIRST_RAD, _LAST_RAD, run.n_replicas)
    start = float(torsion(scene.positions_nm, quad[None])[0])
    # The shorter way round.
    way = (centres - start + np.pi) % (2 * np.pi) - np.pi
    run.set_positions(np.repeat(scene.positions_nm[None], run.n_replicas, axis=0))
    run.thermalise()
    stages = round(_PULLED_PS)
    for k in range(stages):
        run.set_bias(0, start + way * (k + 1) / stages, _STIFFNESS_KJ_MOL)
        run.step(round(_PULLED_PS / stages / _TIMESTEP_PS))
    kt = GAS_CONSTANT_KJ_MOL_K * _KELVIN
    rng = np.random.default_rng(seed)
    held = np.arange(run.n_replicas)  # which centre each copy has
    angles = np.empty((run.n_replicas, round(time_ps / _SAVE_PS)))
    for k in range(-round(_RESOLVED_PS / _SAVE_PS), angles.shape[1]):
        run.step(round(_SAVE_PS / _TIMESTEP_PS))
        phi = torsion(run.positions_nm, quad[None])[:, 0]
        if k >= 0:
            angles[held, k] = phi
        held = exchanged(held, phi, centres, _STIFFNESS_KJ_MOL / kt, k % 2, rng)
        run.set_bias(0, centres[held], _STIFFNESS_KJ_MOL)
    return wham(angles, centres, _STIFFNESS_KJ_MOL / kt)


def exchanged(
    held: IntArray,
    angles: npt.NDArray[Any],
    centres: npt.NDArray[Any],
    stiffness_kt: float,
    first: int,
    rng: np.random.Generator,
) -> IntArray:
    """Return which centre each copy has after neighbouring centres were offered to each other's copies: the pairs from
    `first` (0 or 1) around the circle, by Metropolis' rule. `held` and `angles` (n_copies,)."""
    copy_at = np.argsort(held)
    left, right = copy_at[first:-1:2], copy_at[first + 1 :: 2]
    speed_up = stiffness_kt * (
        np.cos(angles[left] - centres[held[right]]) + np.cos(angles[right] - centres[held[left]])
        - np.cos(angles[left] - centres[held[left]]) - np.cos(angles[right] - centres[held[right]])
    )  # fmt: skip
    swapped = np.log(rng.random(len(speed_up))) < speed_up
    found = held.copy()
    found[left[swapped]], found[right[swapped]] = held[right[swapped]], held[left[swapped]]
    return found


def wham(angles: FloatArray, centres: FloatArray, stiffness_kt: float) -> FloatArray:
    """Return the unbiased population `(72,)` of bins around the circle from angles `(n_windows, n)`, of which each
    window had -stiffness cos(angle - centre) kT added to its energy."""
    counts = np.stack([np.histogram(row, bins=_BINS, range=(-np.pi, np.pi))[0] for row in angles]).astype(np.float64)
    middles = (np.arange(_BINS) + 0.5) * 2 * np.pi / _BINS - np.pi
    weights = np.exp(stiffness_kt * (np.cos(middles - centres[:, None]) - 1.0))
    offsets = np.zeros(len(centres))
    for _ in range(_SWEEPS):
        population = counts.sum(0) / (counts.sum(1)[:, None] * weights * np.exp(offsets)[:, None]).sum(0)
        found = -np.log((weights * population).sum(1))
        found -= found[0]
        done = np.abs(found - offsets).max() < _CONVERGED_KT
        offsets = found
        if done:
            break
    return np.asarray(population / population.sum())


def free_energy_kt(population: FloatArray, low_deg: float = 0.0, high_deg: float = 180.0) -> float:
    """Return the free energy in kT of phi between two angles over phi elsewhere, of a population `(72,)`."""
    middles = (np.arange(_BINS) + 0.5) * 360.0 / _BINS - 180.0
    inside = (middles > low_deg) & (middles < high_deg)
    return float(np.log(population[~inside].sum() / population[inside].sum()))


def known_energies(folder: Path) -> dict[str, float]:
    """Return the free energies in kT of phi in POSITIVE_PHI_DEG, of the records in a folder, by residue type."""
    found = {}
    for path in sorted(folder.glob("ACE-*-NME-phi.json")):
        record = json.loads(path.read_text())
        runs = [np.array(record[f"umbrella {seed}"]) for seed in _SEEDS]
        found[record["sequence"].split("-")[1]] = float(np.mean([free_energy_kt(x, *POSITIVE_PHI_DEG) for x in runs]))
    return found


def trained_with(provenance: dict[str, Any] | None) -> dict[str, float]:
    """Return the free energies of φ > 0 that weights, or those that they began with, were trained with."""
    while provenance is not None:
        if found := provenance.get("positive_phi_kt"):
            return dict(found)
        provenance = provenance.get("from")
    return {}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--time-ps", type=float, default=3000.0, help="of each of the sixteen copies")
    parser.add_argument("--residues", nargs="+", default=[r for r in RESIDUES if r not in ("GLY", "PRO")])
    a = parser.parse_args(arguments)
    a.folder.mkdir(parents=True, exist_ok=True)
    for residue in a.residues:
        sequence = f"ACE-{residue}-NME"
        path = a.folder / f"{sequence}-phi.json"
        if not path.exists():
            scene = build_peptide(sequence)
            found = {seed: population_of_phi(scene, time_ps=a.time_ps, seed=seed) for seed in _SEEDS}
            record = {f"umbrella {seed}": [float(f"{p:.4g}") for p in x] for seed, x in found.items()}
            part = path.with_suffix(".part")
            part.write_text(json.dumps({"sequence": sequence, "umbrella_ps": a.time_ps, **record}))
            os.replace(part, path)
        record = json.loads(path.read_text())
        energies = [free_energy_kt(np.array(record[f"umbrella {seed}"])) for seed in _SEEDS]
        sys.stdout.write(f"{sequence}: phi > 0 lies {energies[0]:.2f} and {energies[1]:.2f} kT above phi < 0\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
