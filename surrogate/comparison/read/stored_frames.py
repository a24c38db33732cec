"""Frames that stay in their file until they are asked for, whole molecules, in the atom order of the comparison; and
what their coordinates are rounded to, as the file's header states or its numbers show.

A coordinate that is rounded to a grid of spacing g is off by a uniform error of standard deviation g/√12, and the
length of a bond, along which two of them subtract, by g/√6. All trajectories of a comparison are laid on the coarsest
grid of any of them, so that what rounding does to lengths, angles and nearest distances it does to all alike.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.scene import Scene
from systems.trajectory.base import TrajectoryReader

Frames = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

_PIECE_FRAMES = 8192
_NEIGHBOURS = np.array(list(itertools.product((-1, 0, 1), repeat=3)), dtype=np.float64)
# Two decimals of an Å to four: what text formats write, and XTC and TNG at their usual precisions. Finer ones do not
# show in anything that is measured.
_GRIDS_NM = (1e-2, 1e-3, 1e-4)
# Fewer numbers lie on a grid by chance.
_LEAST_NUMBERS = 24
_OFF = 0.02
_WORST_OFF = 0.2


@dataclass(frozen=True, eq=False)
class BondTree:
    """How to make molecules whole: bonds in breadth-first levels `(parents, children)`, and each molecule's atoms."""

    levels: tuple[tuple[IntArray, IntArray], ...]
    molecules: tuple[IntArray, ...]


def bond_tree(scene: Scene) -> BondTree:
    """Return the spanning forest of the scene's bonds, the largest molecule first."""
    import networkx as nx

    from systems.chemistry.graph import bonded_graph

    graph = bonded_graph(scene)
    molecules = sorted((np.array(sorted(c), dtype=np.int64) for c in nx.connected_components(graph)),
                       key=lambda atoms: (-len(atoms), int(atoms[0])))  # fmt: skip
    levels: list[tuple[list[int], list[int]]] = []
    for atoms in molecules:
        depth = {int(atoms[0]): 0}
        for parent, child in nx.bfs_edges(graph, int(atoms[0])):
            depth[child] = depth[parent] + 1
            while len(levels) < depth[child]:
                levels.append(([], []))
            levels[depth[child] - 1][0].append(parent)
            levels[depth[child] - 1][1].append(child)
    return BondTree(
        tuple((np.array(a, dtype=np.int64), np.array(b, dtype=np.int64)) for a, b in levels), tuple(molecules)
    )


def make_whole(frames_nm: Frames, cells_nm: npt.NDArray[np.floating], tree: BondTree) -> Frames:
    """Return frames `(n, n_atoms, 3)` nm with no bond across the cell `(n, 3, 3)` nm, in a new array.

    Each atom is put beside the one it is bonded to, then each molecule's centre at its image nearest to that of the
    largest. Right for bonds shorter than half of the cell's least width.
    """
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
    """Frames of one open file, an array `(n, n_atoms, 3)` float32 nm to whoever slices it.

    Atoms are those of `order` (all where None), molecules made whole with `tree` (not where None), coordinates rounded
    to `grid_nm` (not where 0). Slices read from the file; `thinned`, `restricted` and `on_grid` do not. The file is
    open for as long as anybody refers to it.
    """

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

    def thinned(self, stride: int) -> StoredFrames:
        """Return every `stride`-th frame, unread."""
        return StoredFrames(self._reader, self._span[::stride], self._order, self._tree, self._grid_nm)

    def restricted(self, atoms: IntArray) -> StoredFrames:
        """Return some of the atoms `(k,)` of every frame, unread."""
        order = atoms if self._order is None else self._order[atoms]
        return StoredFrames(self._reader, self._span, order, self._tree, self._grid_nm)

    def on_grid(self, grid_nm: float) -> StoredFrames:
        """Return the same frames rounded to `grid_nm`, unread."""
        return StoredFrames(self._reader, self._span, self._order, self._tree, grid_nm)

    def split(self, cuts: Sequence[int]) -> list[StoredFrames]:
        """Return the stretches that begin at frame 0 and at each of `cuts`, unread."""
        edges = [0, *cuts, len(self)]
        return [StoredFrames(self._reader, self._span[a:b], self._order, self._tree, self._grid_nm)
                for a, b in itertools.pairwise(edges)]  # fmt: skip


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
) -> npt.NDArray[np.float64]:
    """Return the variance that rounding gives bond angles, rad²: g²/12 times the squared gradient of the angle by all
    nine coordinates. Arms `(k,)` nm, angles `(k,)` rad; to first order."""
    a, b, angle = (np.asarray(v, dtype=np.float64) for v in (first_nm, second_nm, angle_rad))
    return np.asarray(grid_nm**2 / 6.0 * (1.0 / a**2 + 1.0 / b**2 - np.cos(angle) / (a * b)))


def rounding_note(labels: list[str], grid_nm: float) -> str:
    """Return the line on the trajectories whose rounding all are compared at."""
    error = 10.0 * length_error_nm(grid_nm)
    return (
        f"{' and '.join(labels)}: coordinates are rounded to {10.0 * grid_nm:.3g} Å, which alone makes bond lengths "
        f"vary by {error:.2g} Å; all trajectories are compared rounded alike, and what is narrower is hidden."
    )
