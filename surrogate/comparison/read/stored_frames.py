"""Frames of a file as those of the reference's molecule: atoms matched, molecules whole, coordinates rounded alike.

A file may hold the whole molecule in any order, or a part of it. A coordinate that is rounded to a grid of spacing g is
off by a uniform error of standard deviation g/√12, and the length of a bond, along which two of them subtract, by g/√6.
All trajectories of a comparison are laid on the coarsest grid of any of them, so that what rounding does to lengths,
angles and nearest distances it does to all alike.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import networkx as nx
import numpy as np
import numpy.typing as npt

from systems.chemistry.graph import bonded_graph, match_atoms
from systems.chemistry.residues import is_water_name
from systems.errors import OutOfDomainError
from systems.scene import FloatArray, IntArray, Scene, part_of
from systems.trajectory.base import TrajectoryReader

Frames = npt.NDArray[np.float32]

_PIECE_FRAMES = 8192
_NEIGHBOURS = np.array(list(itertools.product((-1, 0, 1), repeat=3)), dtype=np.float64)
# Two decimals of an Å to four: what text formats write, and XTC and TNG at their usual precisions. Finer ones do not
# show in anything that is measured.
_GRIDS_NM = (1e-2, 1e-3, 1e-4)
# Fewer numbers lie on a grid by chance.
_LEAST_NUMBERS = 24
_OFF, _WORST_OFF = 0.02, 0.2
_FLAT = 0.45
_PSEUDO_BOND_NM = 0.11


class BondTree(NamedTuple):
    """How to make molecules whole: bonds in breadth-first levels `(parents, children)`, and each molecule's atoms."""

    levels: tuple[tuple[IntArray, IntArray], ...]
    molecules: tuple[IntArray, ...]


def bond_tree(scene: Scene) -> BondTree:
    """Return the spanning forest of the scene's bonds, the largest molecule first."""
    graph = bonded_graph(scene)
    components = [np.array(sorted(c), dtype=np.int64) for c in nx.connected_components(graph)]
    molecules = sorted(components, key=lambda atoms: (-len(atoms), int(atoms[0])))
    levels: list[tuple[list[int], list[int]]] = []
    for atoms in molecules:
        depth = {int(atoms[0]): 0}
        for parent, child in nx.bfs_edges(graph, int(atoms[0])):
            depth[child] = depth[parent] + 1
            while len(levels) < depth[child]:
                levels.append(([], []))
            levels[depth[child] - 1][0].append(parent)
            levels[depth[child] - 1][1].append(child)
    return BondTree(tuple((np.array(a), np.array(b)) for a, b in levels), tuple(molecules))


def make_whole(frames_nm: Frames, cells_nm: npt.NDArray[np.floating], tree: BondTree) -> Frames:
    """Return frames `(n, n_atoms, 3)` nm with no bond across the cell `(n, 3, 3)` nm, in a new array: each atom beside
    the one it is bonded to, then each molecule's centre at its image nearest to that of the largest. Right for bonds
    shorter than half of the cell's least width."""
    x = np.array(frames_nm, dtype=np.float32)
    cell = np.asarray(cells_nm, dtype=np.float64)
    inverse = np.linalg.inv(cell)

    def image(step: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        whole = np.round(np.einsum("nki,nij->nkj", step.astype(np.float64), inverse))
        return np.einsum("nki,nij->nkj", whole, cell)

    with np.errstate(invalid="ignore", over="ignore"):
        for parents, children in tree.levels:
            x[:, children] -= image(x[:, children] - x[:, parents]).astype(np.float32)
        home = x[:, tree.molecules[0]].mean(axis=1, keepdims=True)
        for atoms in tree.molecules[1:]:
            step = x[:, atoms].mean(axis=1, keepdims=True) - home
            shift = image(step)
            # In a skewed cell the nearest image may be one cell further than rounding says.
            around = np.einsum("mi,nij->nmj", _NEIGHBOURS, cell)
            nearest = (((step - shift) - around) ** 2).sum(axis=2).argmin(axis=1)
            shift = shift + around[np.arange(len(x)), nearest][:, None]
            x[:, atoms] -= shift.astype(np.float32)
    return x


class StoredFrames:
    """Frames of one open file, an array `(n, n_atoms, 3)` float32 nm to whoever slices it: atoms of `order` (all where
    None), molecules made whole with `tree` (not where None), coordinates rounded to `grid_nm` (not where 0). Slices
    read from the file, which is open for as long as anybody refers to it; `thinned`, `restricted` and `on_grid` read
    nothing."""

    def __init__(
        self,
        reader: TrajectoryReader,
        span: range | None = None,
        order: IntArray | None = None,
        tree: BondTree | None = None,
        grid_nm: float = 0.0,
    ) -> None:
        self._reader, self._order, self._tree, self._grid_nm = reader, order, tree, grid_nm
        self._span = range(reader.n_frames) if span is None else span
        n_atoms = reader.n_atoms if order is None else len(order)
        self.shape = (len(self._span), n_atoms, 3)
        self.ndim = 3
        self.dtype = np.dtype(np.float32)

    def __len__(self) -> int:
        return len(self._span)

    def __getitem__(self, part: slice) -> Frames:
        """Return the frames of a slice, read now. Raises TypeError for anything but a slice of positive step."""
        if not isinstance(part, slice) or (part.step or 1) < 1:
            raise TypeError("Stored frames are read by slices of positive step.")
        span = self._span[part]
        out = np.empty((len(span), *self.shape[1:]), dtype=np.float32)
        for start in range(0, len(span), _PIECE_FRAMES):
            piece = span[start : start + _PIECE_FRAMES]
            frames = self._reader.read(piece.start, piece.stop, piece.step)
            if self._tree is not None:
                cells = self._reader.read_cells(piece.start, piece.stop, piece.step)
                if cells is not None:
                    frames = make_whole(frames, cells, self._tree)
            out[start : start + len(piece)] = frames if self._order is None else frames[:, self._order]
        return rounded(out, self._grid_nm) if self._grid_nm else out

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        return self[:].astype(dtype or np.float32, copy=False)

    def _with(self, span: range, order: IntArray | None = None, grid_nm: float | None = None) -> StoredFrames:
        grid = self._grid_nm if grid_nm is None else grid_nm
        return StoredFrames(self._reader, span, self._order if order is None else order, self._tree, grid)

    def thinned(self, stride: int) -> StoredFrames:
        """Return every `stride`-th frame, unread."""
        return self._with(self._span[::stride])

    def restricted(self, atoms: IntArray) -> StoredFrames:
        """Return some of the atoms `(k,)` of every frame, unread."""
        return self._with(self._span, atoms if self._order is None else self._order[atoms])

    def on_grid(self, grid_nm: float) -> StoredFrames:
        """Return the same frames rounded to `grid_nm`, unread."""
        return self._with(self._span, grid_nm=grid_nm)

    def split(self, cuts: Sequence[int]) -> list[StoredFrames]:
        """Return the stretches that begin at frame 0 and at each of `cuts`, unread."""
        return [self._with(self._span[a:b]) for a, b in itertools.pairwise([0, *cuts, len(self)])]


def grid_of(reader: TrajectoryReader) -> float:
    """Return what the coordinates of an open file are rounded to, nm: as its header states, else as the first, middle
    and last frame show; 0 where they are not."""
    if reader.grid_nm is not None:
        return reader.grid_nm
    some = sorted({0, reader.n_frames // 2, reader.n_frames - 1})
    x = np.concatenate([reader.read(k, k + 1).ravel() for k in some]).astype(np.float64)
    x = x[np.isfinite(x) & (x != 0.0)]
    if len(x) < _LEAST_NUMBERS:
        return 0.0
    spacing = np.spacing(np.abs(x).astype(np.float32)).astype(np.float64)
    for grid in _GRIDS_NM:
        off = np.abs(x / grid - np.rint(x / grid))
        allowed = _OFF + 4.0 * spacing / grid
        if allowed.max() < _WORST_OFF and (off <= allowed).all():
            return grid
    return 0.0


def rounded(frames_nm: npt.NDArray[Any], grid_nm: float) -> Frames:
    """Return frames with every coordinate at the nearest multiple of `grid_nm`, in a new array."""
    out = np.asarray(frames_nm, dtype=np.float32) * np.float32(1.0 / grid_nm)
    np.rint(out, out=out)
    out *= np.float32(grid_nm)
    return out


def length_error_nm(grid_nm: float) -> float:
    """Return the standard deviation that rounding gives the distance of two atoms, nm: two uniform errors, g/√6."""
    return grid_nm / math.sqrt(6.0)


def angle_variance(
    first_nm: npt.ArrayLike, second_nm: npt.ArrayLike, angle_rad: npt.ArrayLike, grid_nm: float
) -> FloatArray:
    """Return the variance that rounding gives bond angles, rad²: g²/12 times the squared gradient of the angle by all
    nine coordinates. Arms `(k,)` nm, angles `(k,)` rad; to first order."""
    a, b, angle = (np.asarray(v, dtype=np.float64) for v in (first_nm, second_nm, angle_rad))
    return np.asarray(grid_nm**2 / 6.0 * (1.0 / a**2 + 1.0 / b**2 - np.cos(angle) / (a * b)))


class Match(NamedTuple):
    """Atom `order[k]` of the file is atom `kept[k]` of the template; `how` says by what they were matched."""

    order: IntArray
    kept: IntArray
    how: str


def solute_atoms(scene: Scene) -> IntArray:
    """Return the atoms that are evaluated: all but water and single ions, where anything else is left."""
    kept: list[int] = []
    largest = 0
    for component in nx.connected_components(bonded_graph(scene)):
        atoms = sorted(component)
        elements = sorted(scene.elements[i] for i in atoms)
        named_water = is_water_name(scene.residue_names[int(scene.residue_of_atom[atoms[0]])])
        if len(atoms) > 1 and elements != ["H", "H", "O"] and not (named_water and set(elements) <= {"H", "O"}):
            kept += atoms
            largest = max(largest, sum(e != "H" for e in elements))
    # A trace of single atoms without bonds is a molecule all the same.
    return np.array(sorted(kept), dtype=np.int64) if largest > 1 else np.arange(scene.n_atoms)


def match_scenes(scene: Scene, template: Scene) -> Match:
    """Match a file's `scene` to the `template`: by the bonded graph when both hold one molecule, else what both have.

    Atoms that only one of them holds (water, hydrogens, side chains that were not saved) are left out: by names and
    residues, or else heavy atoms by the bonded graph with handedness. Raises OutOfDomainError when they are different
    molecules.
    """
    everything = np.arange(template.n_atoms)
    if scene.topology_hash == template.topology_hash:
        return Match(everything, everything, "")
    own = solute_atoms(scene)
    solute = scene if len(own) == scene.n_atoms else part_of(scene, own)
    try:
        return Match(own[match_atoms(solute, template)], everything, "the bond graph")
    except OutOfDomainError as error:
        if sorted(solute.elements) == sorted(template.elements):
            raise
        found = _by_names(solute, template) or _by_heavy_atoms(solute, template)
        if found is None:
            raise OutOfDomainError(f"{error} Nor is one of them a part of the other.") from error
    rank = np.argsort(found.kept)
    return Match(own[found.order[rank]], found.kept[rank], found.how)


def _by_names(scene: Scene, template: Scene) -> Match | None:
    """Atoms of equal name in residues of equal name and number, with the same bonds among them; None unless one side's
    heavy atoms are all found."""
    ours, theirs = _named(scene), _named(template)
    if ours is None or theirs is None:
        return None
    both = [(ours[key], theirs[key]) for key in ours if key in theirs]
    if any(scene.elements[i] != template.elements[k] for i, k in both):
        return None
    order, kept = (np.array([pair[side] for pair in both], dtype=np.int64) for side in (0, 1))
    n_heavy = sum(scene.elements[i] != "H" for i in order.tolist())
    if n_heavy < 3 or n_heavy < min(len(scene.heavy_idx), len(template.heavy_idx)):
        return None
    if _bonds_among(scene, order) != _bonds_among(template, kept):
        return None
    return Match(order, kept, "names and residues")


def _named(scene: Scene) -> dict[tuple[str, str, str], int] | None:
    atoms = zip(scene.residue_of_atom.tolist(), scene.atom_names, strict=True)
    keys = [(scene.residue_ids[r], scene.residue_names[r], name) for r, name in atoms]
    return {key: i for i, key in enumerate(keys)} if len(set(keys)) == len(keys) else None


def _bonds_among(scene: Scene, atoms: IntArray) -> set[tuple[int, int]]:
    place = {int(atom): k for k, atom in enumerate(atoms)}
    inside = [(place[i], place[j]) for i, j in scene.bonds.tolist() if i in place and j in place]
    return {(min(bond), max(bond)) for bond in inside}


def _by_heavy_atoms(scene: Scene, template: Scene) -> Match | None:
    ours, theirs = scene.heavy_idx, template.heavy_idx
    if len(ours) != len(theirs) or len(ours) < 3:
        return None
    parts = [_with_pseudo_hydrogens(part_of(s, atoms)) for s, atoms in ((scene, ours), (template, theirs))]
    try:
        order = match_atoms(*parts)[: len(theirs)]
    except OutOfDomainError:
        return None
    return Match(ours[order], theirs, "the bond graph of the heavy atoms")


def _with_pseudo_hydrogens(scene: Scene) -> Scene:
    """Add a hydrogen to every atom with three neighbours that is not flat, so that its handedness can be compared."""
    x = scene.positions_nm
    centres, places = [], []
    for i, around in enumerate(scene.neighbours()):
        if len(around) != 3:
            continue
        arms = x[around] - x[i]
        arms /= np.maximum(np.linalg.norm(arms, axis=1, keepdims=True), 1e-9)
        if abs(float(np.linalg.det(arms))) > _FLAT:
            away = -arms.sum(axis=0)
            centres.append(i)
            places.append(x[i] + _PSEUDO_BOND_NM * away / np.linalg.norm(away))
    n, k = scene.n_atoms, len(centres)
    added = np.array([[i, n + m] for m, i in enumerate(centres)], dtype=np.int64).reshape(-1, 2)
    return replace(
        scene,
        atom_names=(*scene.atom_names, *("H",) * k),
        elements=(*scene.elements, *("H",) * k),
        residue_of_atom=np.concatenate([scene.residue_of_atom, scene.residue_of_atom[centres]]),
        bonds=np.concatenate([scene.bonds.reshape(-1, 2), added]),
        bond_orders=np.concatenate([np.zeros(len(scene.bonds)), np.zeros(k)]),
        formal_charges=np.zeros(n + k, dtype=np.int64),
        masses_da=np.concatenate([scene.masses_da, np.ones(k)]),
        positions_nm=np.concatenate([x, np.array(places).reshape(-1, 3)]),
    )
