"""How near rollouts of a peptide come to MD of it, beside MD's own scatter and a library of monomers' torsions.

Figures are Jensen-Shannon distances of 50 bins (36 x 36 of joint maps), means over all torsions of a peptide: phi, psi
and chi, each folded by its symmetry. The replicate baseline is the mean over pairs of independent MD runs; a source's
figure is the mean over each of its runs against each of MD's, of equal length and as many frames. The library draws
each residue's torsions together from MD of its monomer ACE-X-NME, independent of the neighbours: what a model must beat
on joint maps of neighbours, or it has learned nothing of pairs. A phi > 0 that MD enters fewer than ten times in all
leaves the maps of all sources: how often it is visited is chance, and a matter of free energies (`peptide_gates
seeds`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.distributions import distance
from surrogate.comparison.measure.torsions import find_torsions
from surrogate.models.peptides.chains import NEGATIVE_CORE_DEG, POSITIVE_CORE_DEG, POSITIVE_PHI_DEG
from systems.chemistry.geometry import superpose, torsion
from systems.chemistry.graph import backbone_torsions
from systems.scene import Scene

if TYPE_CHECKING:
    from surrogate.models.peptides.layout import PeptideConfig

FloatArray = npt.NDArray[np.float64]
_BINS, _JOINT_BINS = 50, 36
_LEAST_ENTRIES = 10


@dataclass(frozen=True)
class Turn:
    """One torsion of a peptide: its `kind` (phi, psi, chi1, ...), the place of its residue among the amino acids, its
    four atoms, and by how many equal positions it is folded."""

    kind: str
    residue: int
    quad: tuple[int, int, int, int]
    fold: int = 1


@dataclass(frozen=True)
class Scores:
    """Distances of one source to MD of a peptide, with the standard error over its runs: mean over single torsions, and
    over joint maps of psi and the next residue's phi (NaN for a monomer). `valid`: the share of its frames without
    broken bonds, angles or clashes (NaN of what has no frames)."""

    source: str
    single: float
    single_error: float
    joint: float
    joint_error: float
    valid: float = float("nan")


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


def without(runs: Sequence[FloatArray], rare: Sequence[int]) -> list[FloatArray]:
    """Return runs of torsions `(n_frames, n_turns)` without frames in which one of the phi at `rare` is on the left-
    handed side; runs that spend half of their time there are left out."""
    low, high = np.radians(POSITIVE_PHI_DEG)
    kept = [x[~((x[:, rare] > low) & (x[:, rare] < high)).any(axis=1)] for x in runs]
    return [x for x, whole in zip(kept, runs, strict=True) if len(x) >= len(whole) / 2]


def score(turns: Sequence[Turn], reference: Sequence[FloatArray], source: Sequence[FloatArray], name: str) -> Scores:
    """Return a source's distances to MD; `reference` and `source` are runs of torsions `(n_frames, n_turns)` of one
    length."""
    return _scores(turns, [(i, a, b) for i, a in enumerate(source) for b in reference], name)


def floor(turns: Sequence[Turn], reference: Sequence[FloatArray]) -> Scores:
    """Return the distances between independent MD runs."""
    return _scores(turns, [(k, a, b) for k, (a, b) in enumerate(combinations(reference, 2))], "MD")


def _scores(turns: Sequence[Turn], pairs: list[tuple[int, FloatArray, FloatArray]], name: str) -> Scores:
    joints = [
        (i, j)
        for i, a in enumerate(turns)
        for j, b in enumerate(turns)
        if (a.kind, b.kind) == ("psi", "phi") and b.residue == a.residue + 1
    ]

    def over_pairs(measured: Callable[[FloatArray, FloatArray], float]) -> tuple[float, float]:
        of_run: dict[int, list[float]] = {}
        for run, a, b in pairs:
            of_run.setdefault(run, []).append(measured(a, b))
        means = np.array([np.mean(values) for values in of_run.values()])
        error = float(means.std(ddof=1) / np.sqrt(len(means))) if len(means) > 1 else float("nan")
        return float(means.mean()), error

    def single(a: FloatArray, b: FloatArray) -> float:
        return float(np.mean([_distance_1d(a[:, k], b[:, k]) for k in range(len(turns))]))

    def joint(a: FloatArray, b: FloatArray) -> float:
        return (
            float(np.mean([_distance_2d(a[:, ij], b[:, ij]) for ij in map(list, joints)])) if joints else float("nan")
        )

    return Scores(name, *over_pairs(single), *over_pairs(joint))


def _distance_1d(a: FloatArray, b: FloatArray) -> float:
    edges = np.linspace(-np.pi, np.pi, _BINS + 1)
    return float(distance(*(np.histogram(x, edges)[0].astype(np.float64) for x in (a, b))))


def _distance_2d(a: FloatArray, b: FloatArray) -> float:
    edges = np.linspace(-np.pi, np.pi, _JOINT_BINS + 1)
    return float(distance(*(np.histogram2d(x[:, 0], x[:, 1], (edges, edges))[0].ravel() for x in (a, b))))


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
