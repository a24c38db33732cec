"""Stiff terms measured on a reference (models.stiff): which bonds it holds rigid, and the distribution of all other
bonds and angles given the torsions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from surrogate.data.frames import TrainingFrames
from surrogate.models.stiff import StiffPlan, StiffTerms, Tree
from systems.errors import InputError
from systems.scene import Scene

# Bonds that a reference holds rigid vary by less, by rounding alone; others by ten times as much.
RIGID_NM = 2e-4
_LOOKED_AT = 1000
_BLOCK = 8192
# Ridge of the regression of terms on features, relative to their power: for torsions that hardly turn.
_RIDGE = 1e-3
# Nearer to a straight line an angle leaves torsions about its bonds without meaning.
_STRAIGHTEST_RAD = np.radians(165.0)


def rigid_hydrogens(frames: TrainingFrames) -> list[tuple[int, int]]:
    """Return the bonds (hydrogen, its one neighbour) that keep their length in these frames, as constraints do."""
    idx = np.linspace(0, frames.n_frames - 1, min(_LOOKED_AT, frames.n_frames)).astype(int)
    x, scene = frames.positions_nm(idx), frames.scene
    bonds = [(i, near[0]) for i, near in enumerate(scene.neighbours()) if scene.elements[i] == "H" and len(near) == 1]
    return [(i, j) for i, j in bonds if np.linalg.norm(x[:, i] - x[:, j], axis=-1).std() < RIGID_NM]


def rigid_terms(frames: TrainingFrames) -> StiffTerms | None:
    """Return the bonds to hydrogen that a reference holds rigid, with their lengths; None where it holds none."""
    rigid = rigid_hydrogens(frames)
    return _with_lengths(StiffPlan(tuple(rigid)), frames) if rigid else None


def drawn_terms(frames: TrainingFrames) -> StiffTerms:
    """Return all stiff terms of a molecule, measured on training frames: see `models.stiff`.

    Raises InputError for molecules that have rings, straight angles, or fewer than four atoms.
    """
    plan = replace(plan_terms(frames.scene), rigid=tuple(rigid_hydrogens(frames)))
    known = _with_lengths(plan, frames)
    tree, starts = known.tree, frames.window_starts(1, validation=False)
    near = np.linspace(0, len(starts) - 1, min(_LOOKED_AT, len(starts))).astype(int)
    lengths, angles, turns = tree.measure(_tensor(frames, starts[near]))
    if float(angles[:, tree.bent].max()) > _STRAIGHTEST_RAD:
        raise InputError(f"{frames.scene.name} has an angle that is straight, or nearly; its stiff terms are modelled.")
    means = tree.terms(lengths, angles, turns)
    rest = means.mean(0)
    rest[-len(tree.planes) :] = torch.atan2(turns[:, tree.planes].sin().mean(0), turns[:, tree.planes].cos().mean(0))
    # Least squares of what is off on the torsions' features, from sums over all frames.
    gram, cross, power = (torch.zeros(1, 1, dtype=torch.float64) for _ in range(3))
    for features, off in _measured(frames, tree, rest):
        gram, cross, power = gram + features.T @ features, cross + features.T @ off, power + off.T @ off
    n = len(starts)
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


def _with_lengths(plan: StiffPlan, frames: TrainingFrames) -> StiffTerms:
    starts = frames.window_starts(1, validation=False)
    x = _tensor(frames, starts[np.linspace(0, len(starts) - 1, min(_LOOKED_AT, len(starts))).astype(int)])
    hydrogen, parent = torch.tensor(plan.rigid, dtype=torch.long).reshape(-1, 2).T
    return StiffTerms(plan, {"rigid_nm": (x[:, hydrogen] - x[:, parent]).norm(dim=-1).mean(0)})


def _measured(frames: TrainingFrames, tree: Tree, rest: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Features and deviations from rest of all training frames, block by block."""
    starts = frames.window_starts(1, validation=False)
    for begin in range(0, len(starts), _BLOCK):
        lengths, angles, turns = tree.measure(_tensor(frames, starts[begin : begin + _BLOCK]))
        yield tree.features(turns), tree.deviation(tree.terms(lengths, angles, turns), rest)


def _tensor(frames: TrainingFrames, idx: np.ndarray) -> Tensor:
    return torch.from_numpy(frames.positions_nm(idx)).double()
