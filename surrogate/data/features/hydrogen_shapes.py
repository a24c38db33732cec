"""Hydrogens of a reference: sites from the bonds, shapes and rotations from the training frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data.frames import QUANTUM_NM, TrainingFrames
from surrogate.models.hydrogens import N_PHASES, HydrogenPlacer, HydrogenPlan, Site, SiteGroup
from systems.errors import InputError
from systems.scene import Scene

_BLOCK = 16384
# Numbers held at once: fewer frames of larger molecules.
_SHAPE_FRAMES, _SHAPE_ATOMS = 20_000, 1_000_000
# A nitrogen's hydrogens stand to one side where they rise so far above the plane (sine), root mean square: flat groups
# swing through 0.2, pyramidal amines stand at 0.7 and more.
_PYRAMIDAL = 0.45
# Least variance of a combination of features that is used, relative to the strongest.
_LEAST_VARIANCE = 1e-8
# The other side counts from this share of frames on.
_LEAST_SHARE = 0.002


def hydrogen_sites(scene: Scene) -> HydrogenPlan:
    """Return where a scene has its hydrogens, from its bonds and its positions.

    Raises InputError where a hydrogen has no heavy neighbour or several, or where its molecule has too few heavy atoms
    to say how it lies: three are needed.
    """
    near = scene.neighbours()
    hydrogen = [element == "H" for element in scene.elements]
    sites = []
    for h in (i for i, is_one in enumerate(hydrogen) if is_one):
        if len(near[h]) != 1 or hydrogen[near[h][0]]:
            raise InputError(
                f"{_name(scene, h)} does not hang on one heavy atom, so it cannot be placed by it; train with "
                'hydrogens = "modelled".'
            )
    for parent, around in enumerate(near):
        hydrogens = tuple(j for j in around if hydrogen[j])
        heavy = [j for j in around if not hydrogen[j]]
        if not hydrogens:
            continue
        if len(heavy) > 1:
            sites.append(Site(parent, hydrogens, tuple(heavy[:3]), turns=False))
            continue
        further = _further_atom(scene, near, hydrogen, parent, heavy[0]) if heavy else None
        if further is None:
            raise InputError(
                f"the hydrogens of {_name(scene, parent)} cannot be placed: their molecule has fewer than three heavy "
                'atoms; train with hydrogens = "modelled".'
            )
        sites.append(Site(parent, hydrogens, (heavy[0], further), turns=True))
    return HydrogenPlan(scene.n_atoms, tuple(sites))


def plan_hydrogens(frames: TrainingFrames) -> HydrogenPlan:
    """Return the sites of a scene's hydrogens, with two hands where its training frames show both. Raises InputError
    as `hydrogen_sites` does."""
    plan = hydrogen_sites(frames.scene)
    x = _shape_frames(frames)
    return replace(plan, sites=tuple(replace(site, hands=_hands(site, x)) for site in plan.sites))


@torch.no_grad()
def fit_hydrogens(placer: HydrogenPlacer, frames: TrainingFrames) -> None:
    """Measure shapes, swings and turns on training frames of all atoms and set them in the placer."""
    x = _shape_frames(frames)
    groups = [group for group in placer.groups if isinstance(group, SiteGroup)]
    for group in groups:
        _fit_shapes(group, x)
    for group in groups:
        if group.n_states > 1:
            _fit_moves(group, frames)


def _hands(site: Site, x: Tensor) -> int:
    """Return 2 where one hydrogen beside two neighbours, or two beside one, stand on either side in some frames."""
    n_hydrogens, n_near = len(site.hydrogens), len(site.around)
    if (n_hydrogens, site.turns) not in ((1, False), (2, True)) or n_near > 2:
        return 1
    group = SiteGroup([replace(site, hands=2)]).double()
    if site.turns:
        about = group.angles(x)[1]
        height = torch.sin(about[..., 1] - about[..., 0])
    else:
        height = (_unit(group.bonds(x)[..., 0, :]) * group.axes(x)[..., 2, :]).sum(-1)
    share = float((height > 0).double().mean())
    pyramidal = float(height.square().mean().sqrt()) > _PYRAMIDAL
    return 2 if pyramidal and _LEAST_SHARE < share < 1.0 - _LEAST_SHARE else 1


def _fit_shapes(group: SiteGroup, x: Tensor) -> None:
    wide = deepcopy(group).double()
    vectors, hand, axes = wide.bonds(x), wide.hand(x), wide.axes(x)
    lengths = vectors.norm(dim=-1)
    group.lengths_nm.copy_(lengths.mean(0))
    # Less what the rounding of training frames adds to it: constrained bonds have no spread.
    group.length_spread_nm.copy_((lengths.var(0, correction=0) - QUANTUM_NM**2 / 6).clamp(min=0.0).sqrt())
    told = torch.stack(wide.angles(x), dim=-1) if group.turns else wide.features(x)
    for k in range(len(group.parent)):
        for side in range(group.hands):
            chosen = hand[:, k] == side
            if group.turns:
                shape, left = _turning_shape(told[chosen, k])
            else:
                shape, left = _held_shape(told[chosen, k], vectors[chosen, k], axes[chosen, k])
            group.shape[k, side] = shape
            group.swing[k, side] = _root(left.T @ left / len(left))


def _turning_shape(angles: Tensor) -> tuple[Tensor, Tensor]:
    """Shape `(k, 2)` of a rotor and what is left `(n, 2k)` rad, from its angles `(n, k, 2)`."""
    opening, about = angles.unbind(-1)
    relative = about - about[:, :1]
    shift = torch.atan2(relative.sin().mean(0), relative.cos().mean(0))
    turned = about - shift
    phase = torch.atan2(turned.sin().sum(-1), turned.cos().sum(-1))
    off = turned - phase[:, None]
    mean = opening.mean(0)
    left = torch.cat([opening - mean, torch.atan2(off.sin(), off.cos())], dim=-1)
    return torch.stack([mean, shift], dim=-1), left


def _held_shape(features: Tensor, vectors: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Weights `(k, 12)` of the features `(n, 12, 3)` that come nearest to the bonds `(n, k, 3)` nm, least squares, and
    what is left `(n, 3k)` nm along the axes `(n, 3, 3)`."""
    gram = torch.einsum("tfj,tgj->fg", features, features)
    # Features that do not vary (of two neighbours, of a structure that stands still) get no weight.
    inverse = torch.linalg.pinv(gram, rtol=_LEAST_VARIANCE, hermitian=True)
    weights = (inverse @ torch.einsum("tfj,tkj->fk", features, vectors)).T
    mean = _unit(torch.einsum("kf,tfj->tkj", weights, features)) * vectors.norm(dim=-1).mean(0)[:, None]
    return weights, torch.einsum("taj,tkj->tka", axes, vectors - mean).flatten(1)


def _fit_moves(group: SiteGroup, frames: TrainingFrames) -> None:
    """Count states and the pairs of states of consecutive frames, forwards and backwards alike: the reference is in
    equilibrium. Turns by which hydrogens change places count for each other."""
    n, n_states = len(group.parent), group.n_states
    starts = frames.window_starts(2, validation=False)
    counts = np.zeros((n, n_states, n_states))
    for some in _blocks(starts):
        first, second = (group.states(_tensor(frames, some + k, torch.float32)).numpy() for k in (0, 1))
        for k in range(n):
            np.add.at(counts[k], (first[:, k], second[:, k]), 1.0)
    counts = counts + counts.transpose(0, 2, 1)
    if group.turns:
        fold = np.array([_fold(group, k) for k in range(n)])
        for k in range(n):
            counts[k] = _symmetrised(counts[k], group.hands, int(fold[k]))
    totals = counts.sum(2, keepdims=True)
    shares = totals[..., 0] / totals.sum(1)
    # A state that was never visited is only ever met in a start of the user's; it is left as if for the first time.
    moves = np.where(totals > 0, counts / np.where(totals > 0, totals, 1.0), shares[:, None, :])
    group.shares.copy_(torch.from_numpy(shares))
    group.moves.copy_(torch.from_numpy(moves))


def _fold(group: SiteGroup, k: int) -> int:
    """By how many turns hydrogens change places: three of a methyl group, two of a flat NH2, none of a hydroxyl."""
    if group.k == 3:
        return 3
    flat = group.hands == 1 and group.k == 2 and abs(float(torch.sin(group.shape[k, 0, 1, 1]))) < 0.26
    return 2 if flat else 1


def _symmetrised(counts: npt.NDArray[np.float64], hands: int, fold: int) -> npt.NDArray[np.float64]:
    table = counts.reshape(hands, N_PHASES, hands, N_PHASES)
    turned = [np.roll(table, turn * (N_PHASES // fold), axis=(1, 3)) for turn in range(fold)]
    mean: npt.NDArray[np.float64] = np.mean(turned, axis=0).reshape(counts.shape)
    return mean


def _shape_frames(frames: TrainingFrames) -> Tensor:
    """Evenly spaced training frames `(n, n_atoms, 3)` nm, in double precision."""
    most = min(_SHAPE_FRAMES, max(500, _SHAPE_ATOMS // frames.scene.n_atoms))
    return _tensor(frames, frames.spread_starts(most))


def _blocks(idx: npt.NDArray[np.int64]) -> Iterator[npt.NDArray[np.int64]]:
    for start in range(0, len(idx), _BLOCK):
        yield idx[start : start + _BLOCK]


def _tensor(frames: TrainingFrames, idx: npt.NDArray[np.int64], dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.from_numpy(frames.positions_nm(idx)).to(dtype)


def _root(covariance: Tensor) -> Tensor:
    """Return a symmetric root `(d, d)`; covariances may be singular."""
    values, vectors = torch.linalg.eigh(covariance)
    root: Tensor = (vectors * values.clamp(min=0.0).sqrt()) @ vectors.T
    return root


def _unit(x: Tensor) -> Tensor:
    return x / x.norm(dim=-1, keepdim=True).clamp(min=1e-12)


def _further_atom(
    scene: Scene, near: Sequence[Sequence[int]], hydrogen: Sequence[bool], parent: int, neighbour: int
) -> int | None:
    """Return the heavy atom that a rotor's angle is counted from: the nearest in bonds, then in order, that does not
    lie on the line of parent and neighbour; beside a triple bond that is one farther on."""
    axis = scene.positions_nm[parent] - scene.positions_nm[neighbour]
    seen, layer, spare = {parent, neighbour}, [neighbour], None
    while layer:
        layer = [j for i in layer for j in near[i] if not hydrogen[j] and j not in seen]
        layer = sorted(set(layer))
        seen.update(layer)
        for atom in layer:
            side = scene.positions_nm[atom] - scene.positions_nm[neighbour]
            sine = np.linalg.norm(np.cross(axis, side)) / (np.linalg.norm(axis) * np.linalg.norm(side))
            if sine > 0.3:
                return atom
            spare = atom if spare is None else spare
    return spare


def _name(scene: Scene, atom: int) -> str:
    residue = int(scene.residue_of_atom[atom])
    return f"{scene.atom_names[atom]} of {scene.residue_names[residue]} {scene.residue_ids[residue]}"
