"""Stiff terms measured on a reference (models.stiff): which bonds it holds rigid, and the distribution of all other
bonds and angles given the torsions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data.frames import TrainingFrames
from surrogate.models.stiff import StiffPlan, StiffTerms, Tree
from systems.errors import InputError
from systems.scene import Scene

FloatArray = npt.NDArray[np.floating]
# Bonds that a reference holds rigid vary by less, by rounding alone; others by ten times as much.
RIGID_NM = 2e-4
# Frames that are looked at for what is rigid.
LOOKED_AT = 1000
_BLOCK = 8192
# Ridge of the regression of terms on features, relative to their power: for torsions that hardly turn.
_RIDGE = 1e-3
# Nearer to a straight line an angle leaves torsions about its bonds without meaning.
_STRAIGHTEST_RAD = np.radians(165.0)


def rigid_hydrogens(scene: Scene, positions_nm: FloatArray) -> list[tuple[int, int]]:
    """Return the bonds (hydrogen, its one neighbour) that keep their length, as constraints do, in frames `(n, n_atoms,
    3)` nm."""
    bonds = [(i, near[0]) for i, near in enumerate(scene.neighbours()) if scene.elements[i] == "H" and len(near) == 1]
    lengths = [np.linalg.norm(positions_nm[:, i] - positions_nm[:, j], axis=-1) for i, j in bonds]
    return [bond for bond, length in zip(bonds, lengths, strict=True) if length.std() < RIGID_NM]


def holds_hydrogens(scene: Scene, positions_nm: FloatArray) -> bool:
    """Return whether all bonds to hydrogen keep their length in frames `(n, n_atoms, 3)` nm."""
    is_hydrogen = np.array(scene.elements) == "H"
    return len(rigid_hydrogens(scene, positions_nm)) == int(is_hydrogen[scene.bonds].any(axis=1).sum())


def rigid_terms(scene: Scene, positions_nm: FloatArray) -> StiffTerms | None:
    """Return the bonds to hydrogen that are rigid in frames `(n, n_atoms, 3)` nm, with their lengths; None where there
    are none."""
    rigid = rigid_hydrogens(scene, positions_nm)
    return _with_lengths(StiffPlan(tuple(rigid)), positions_nm) if rigid else None


def drawn_terms(frames: TrainingFrames) -> StiffTerms:
    """Return all stiff terms of a molecule, measured on training frames: see `models.stiff`.

    Raises InputError for molecules that have rings, straight angles, or fewer than four atoms.
    """
    some = frames.some_nm(LOOKED_AT)
    plan = replace(plan_terms(frames.scene), rigid=tuple(rigid_hydrogens(frames.scene, some)))
    known = _with_lengths(plan, some)
    tree = known.tree
    lengths, angles, turns = tree.measure(torch.from_numpy(some).double())
    if float(angles[:, tree.bent].max()) > _STRAIGHTEST_RAD:
        raise InputError(f"{frames.scene.name} has an angle that is straight, or nearly; its stiff terms are modelled.")
    means = tree.terms(lengths, angles, turns)
    rest = means.mean(0)
    rest[-len(tree.planes) :] = torch.atan2(turns[:, tree.planes].sin().mean(0), turns[:, tree.planes].cos().mean(0))
    # Least squares of what is off on the torsions' features, from sums over all frames.
    gram, cross, power = (torch.zeros(1, 1, dtype=torch.float64) for _ in range(3))
    for features, off in _measured(frames, tree, rest):
        gram, cross, power = gram + features.T @ features, cross + features.T @ off, power + off.T @ off
    n = len(frames.window_starts(1, validation=False))
    held = torch.full((len(gram),), _RIDGE * n, dtype=torch.float64)
    held[0] = 0.0
    weights = torch.linalg.solve(gram + held.diag(), cross)
    left = (power - weights.T @ cross - cross.T @ weights + weights.T @ gram @ weights) / n
    spread = (power.diagonal() / n - (cross[0] / n) ** 2).sqrt()
    low, high = torch.full_like(rest, np.inf), torch.full_like(rest, -np.inf)
    for features, _ in _measured(frames, tree, rest):
        told = features @ weights
        low, high = torch.minimum(low, told.amin(0)), torch.maximum(high, told.amax(0))
    # Beside rounding: a covariance of fewer frames than terms is singular.
    root = torch.linalg.cholesky(left + 1e-9 * left.diagonal().diag())
    numbers = {"rest": rest, "spread": spread, "weights": weights, "low": low, "high": high, "root": root}
    return StiffTerms(plan, {**known.numbers, **numbers})


def plan_terms(scene: Scene) -> StiffPlan:
    """Return the tree by which a molecule is placed atom by atom, from its middle outwards; nothing is rigid yet.

    Of the atoms beside one another, the one with the most atoms behind it is placed first, so that torsions are those
    of the backbone. Raises InputError for what `drawn_terms` does not take.
    """
    near = scene.neighbours()
    if scene.n_atoms < 4 or len(scene.bonds) != scene.n_atoms - 1:
        raise InputError(
            f"{scene.name} has rings, several molecules or fewer than four atoms; its stiff terms are modelled."
        )
    # From the middle, so that what is drawn moves as few atoms as it can.
    heavy = scene.heavy_idx.tolist()
    root = min(heavy, key=lambda atom: len(_levels(near, atom)))
    parent = {root: -1}
    order = [root]
    for atom in order:
        for other in near[atom]:
            if other not in parent:
                parent[other] = atom
                order.append(other)
    if len(order) < scene.n_atoms:
        raise InputError(f"{scene.name} is several molecules; its stiff terms are modelled.")
    size = dict.fromkeys(order, 1)
    for atom in reversed(order[1:]):
        size[parent[atom]] += size[atom]
    behind = {atom: sorted((k for k in near[atom] if k != parent[atom]), key=lambda k: (-size[k], k)) for atom in order}
    rows: list[tuple[int, int, int, int]] = []
    soft = []
    for atom in order:
        first = behind[atom][0] if behind[atom] else -1
        beside = behind[root]
        for k, other in enumerate(behind[atom]):
            if atom == root:
                rows.append((other, root, *((beside[0], beside[1]) if k > 1 else (beside[0], -1) if k else (-1, -1))))
                continue
            above = parent[atom]
            if k:
                rows.append((other, atom, above, first))
                continue
            # The torsion about the bond above, told from what lies beyond that.
            beyond = parent[above] if above != root else next(j for j in beside if j != atom)
            soft.append(len(rows))
            rows.append((other, atom, above, beyond))
    return StiffPlan((), tuple(rows), tuple(soft))


def _levels(near: list[list[int]], start: int) -> list[list[int]]:
    """Return the atoms by how many bonds they lie from `start`."""
    seen, levels = {start}, [[start]]
    while levels[-1]:
        levels.append(sorted({k for atom in levels[-1] for k in near[atom]} - seen))
        seen.update(levels[-1])
    return levels[:-1]


def _with_lengths(plan: StiffPlan, positions_nm: FloatArray) -> StiffTerms:
    x = torch.from_numpy(positions_nm).double()
    hydrogen, parent = torch.tensor(plan.rigid, dtype=torch.long).reshape(-1, 2).T
    return StiffTerms(plan, {"rigid_nm": (x[:, hydrogen] - x[:, parent]).norm(dim=-1).mean(0)})


def _measured(frames: TrainingFrames, tree: Tree, rest: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Features and deviations from rest of all training frames, block by block."""
    starts = frames.window_starts(1, validation=False)
    for begin in range(0, len(starts), _BLOCK):
        x = torch.from_numpy(frames.positions_nm(starts[begin : begin + _BLOCK])).double()
        lengths, angles, turns = tree.measure(x)
        yield tree.features(turns), tree.deviation(tree.terms(lengths, angles, turns), rest)
