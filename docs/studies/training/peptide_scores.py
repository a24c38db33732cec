"""Torsions of peptides for the studies, a library of monomers' torsions, and what coding by residues loses.

Torsions are phi, psi and chi, each folded by its symmetry. The library draws each residue's torsions together from MD
of its monomer ACE-X-NME, independent of the neighbours: what a model must beat on joint maps of neighbours, or it has
learned nothing of pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.torsions import find_torsions
from surrogate.models.peptides.chains import NEGATIVE_CORE_DEG, POSITIVE_CORE_DEG
from systems.chemistry.geometry import superpose, torsion
from systems.chemistry.graph import backbone_torsions
from systems.scene import Scene

if TYPE_CHECKING:
    from surrogate.models.peptides.layout import PeptideConfig

FloatArray = npt.NDArray[np.float64]
_LEAST_ENTRIES = 10
# The middles of the basins of psi, helices and strands.
_CORES_DEG = ((-100.0, 30.0), (100.0, 180.0))


@dataclass(frozen=True)
class Turn:
    """One torsion of a peptide: its `kind` (phi, psi, chi1, ...), the place of its residue among the amino acids, its
    four atoms, and by how many equal positions it is folded."""

    kind: str
    residue: int
    quad: tuple[int, int, int, int]
    fold: int = 1


def turns_of(scene: Scene) -> list[Turn]:
    """Return phi, psi and chi of each amino acid; rotors without heavy atoms and omega are left out."""
    backbone = backbone_torsions(scene)
    rows = [("phi", 2, q) for q in backbone["phi"].tolist()] + [("psi", 1, q) for q in backbone["psi"].tolist()]
    found = [(kind, int(scene.residue_of_atom[q[place]]), tuple(q), 1) for kind, place, q in rows]
    for t in find_torsions(scene):
        if t.kind == "χ":
            found.append(
                (t.label.split()[0].replace("χ", "chi"), int(scene.residue_of_atom[t.quad[1]]), t.quad, t.fold)
            )
    rank = {r: k for k, r in enumerate(sorted({r for _, r, _, _ in found}))}
    return [Turn(kind, rank[r], (q[0], q[1], q[2], q[3]), fold) for kind, r, q, fold in found]


def psi_crossings(psi: FloatArray) -> int:
    """Return how often psi (n_frames,) in rad comes from the middle of one basin to that of the other."""
    degrees = np.degrees(psi)
    inside = np.stack([(degrees > low) & (degrees < high) for low, high in _CORES_DEG])
    core = inside[1][inside.any(axis=0)]
    return int((core[1:] != core[:-1]).sum())


def angles(turns: Sequence[Turn], frames_nm: npt.NDArray[np.floating]) -> FloatArray:
    """Return the torsions `(n_frames, n_turns)` of frames `(n_frames, n_atoms, 3)` nm, in rad, folded ones
    multiplied."""
    raw = np.asarray(torsion(frames_nm.astype(np.float64), [t.quad for t in turns]), dtype=np.float64)
    folded = raw * np.array([t.fold for t in turns])
    return np.asarray((folded + np.pi) % (2 * np.pi) - np.pi)


def library(
    turns: Sequence[Turn], monomers: Sequence[FloatArray], likely: Sequence[FloatArray],
    monomer_turns: Sequence[Sequence[Turn]], n: int, rng: np.random.Generator,
) -> FloatArray:  # fmt: skip
    """Return `n` draws `(n, n_turns)`: of residue k together from `monomers[k]` (n_frames, its turns), blind to others.

    `likely[k]` (n_frames,): the probability of each of its frames in equilibrium.

    Raises KeyError for a torsion that the residue's monomer does not have.
    """
    out = np.empty((n, len(turns)))
    for k, (values, p, own) in enumerate(zip(monomers, likely, monomer_turns, strict=True)):
        column = {t.kind: j for j, t in enumerate(own)}
        rows = values[rng.choice(len(values), size=n, p=p)]
        for j, t in enumerate(turns):
            if t.residue == k:
                out[:, j] = rows[:, column[t.kind]]
    return out


def rarely_positive(turns: Sequence[Turn], reference: Sequence[FloatArray]) -> list[int]:
    """Return the places of phi in `turns` that enter the left-handed side fewer than ten times in all of MD."""
    phi = [k for k, t in enumerate(turns) if t.kind == "phi"]
    return [k for k in phi if crossings([x[:, k] for x in reference], 1.0)["entries"] < _LEAST_ENTRIES]


def rebuilt(scene: Scene, frames_nm: FloatArray, config: PeptideConfig) -> dict[str, float]:
    """Return how far frames `(n, n_atoms, 3)` coded by residues and rebuilt lie from themselves: heavy atoms (RMSD, Å),
    mean and most, and the most that a torsion differs (degrees)."""
    import torch

    from surrogate.models.peptides.layout import chain_features

    code = chain_features(scene, config).code
    found = code.decode(code.encode(torch.from_numpy(frames_nm).float())).double().numpy()
    heavy = scene.heavy_idx
    laid = np.stack([superpose(x[None], y, idx=heavy)[0] for x, y in zip(found, frames_nm, strict=True)])
    rmsd = np.sqrt(((laid - frames_nm)[:, heavy] ** 2).sum(-1).mean(-1)) * 10
    turns = turns_of(scene)
    turned = np.angle(np.exp(1j * (angles(turns, found) - angles(turns, frames_nm))))
    return {
        "frames": len(frames_nm),
        "rmsd_angstrom": float(rmsd.mean()),
        "rmsd_angstrom_most": float(rmsd.max()),
        "torsions_degrees_most": float(np.degrees(np.abs(turned)).max()),
    }


def crossings(phi: Sequence[FloatArray], apart_ps: float) -> dict[str, float]:
    """Return how often runs of phi `(n,)`, rad, enter phi > 0 and leave it, and the rates per ns spent on the other
    side.

    Between the cores of both basins the last one counts, so that nothing is counted for a frame on a barrier.
    """
    moves, spent_ns = np.zeros(2, dtype=int), np.zeros(2)
    for run in phi:
        degrees = np.degrees(run)
        positive, negative = (
            (degrees > low) & (degrees < high) for low, high in (POSITIVE_CORE_DEG, NEGATIVE_CORE_DEG)
        )
        seen = np.flatnonzero(positive | negative)
        if len(seen):
            state = positive[seen].astype(int)
            spent_ns += [np.diff(np.append(seen, len(run)))[state == k].sum() * apart_ps * 1e-3 for k in (0, 1)]
            moves += [int(((state[1:] == k) & (state[:-1] != k)).sum()) for k in (0, 1)]
    per_ns = moves[::-1] / np.maximum(spent_ns, 1e-12)
    return {
        "entries": int(moves[1]), "exits": int(moves[0]),
        "entries_per_ns": float(per_ns[0]), "exits_per_ns": float(per_ns[1]),
    }  # fmt: skip
