"""Validity of frames: NumPy checks of bonds, clashes, chirality and planarity, for guards and for the judge."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.frame_columns import column_blocks, signed_volume, squared_distance, torsion_cosine
from systems.chemistry.geometry_rules import (
    HALF_ANGSTROM_NM,
    MAX_PAIRS,
    RING_BENT_COSINE,
    find_rules,
    measured_rules,
    n_pairs,
)
from systems.errors import InputError
from systems.files.schema import Recorded
from systems.scene import Scene

FloatArray = npt.NDArray[np.floating[Any]]
IntArray = npt.NDArray[np.int64]

NOT_FINITE = 1
BOND_HALF_ANGSTROM = 2
BOND_20_PERCENT = 4
CLASH = 8
CHIRALITY = 16
OMEGA = 32
RING = 64
# What guards watch beyond that while rolling (systems.chemistry.limits); they are no part of INVALID.
ANGLE = 128
PLANARITY = 256
JUMP = 512
DRIFT = 1024
ENERGY = 2048
STILL = 4096
UNSURE = 8192
INVALID = NOT_FINITE | BOND_HALF_ANGSTROM | CLASH | CHIRALITY | OMEGA | RING

_NAMES = {
    NOT_FINITE: "not finite",
    BOND_HALF_ANGSTROM: "bond more than 0.5 Å off",
    BOND_20_PERCENT: "bond more than 20 % off",
    CLASH: "clash",
    CHIRALITY: "stereocentre inverted",
    OMEGA: "peptide or double bond turned over",
    RING: "planar ring bent",
    ANGLE: "angle beyond the reference",
    PLANARITY: "flat centre bent",
    JUMP: "jump between frames",
    DRIFT: "drift of the whole",
    ENERGY: "energy above the reference",
    STILL: "hardly a change from the frame before",
    UNSURE: "the model is unsure of its energy",
}


@dataclass(frozen=True, eq=False)
class Geometry(Recorded):
    """What a valid frame keeps. Made by `geometry_from_scene` or `geometry_from_frames`.

    Atoms: `hydrogen (n_atoms,)` 1 for hydrogens. Bonds: `bond_idx (n_bonds, 2)`, `bond_mean_nm`, `bond_std_nm`
    `(n_bonds,)` (0 where no frames were given). Clashes: `near_idx (k, 2)` are the pairs up to three bonds apart, which
    never count; `clash_min_nm (3,)` the least distance of all others: between hydrogens, hydrogen and heavy, heavy.
    Handedness: `stereo_idx (k, 4)` rows (centre, a, b, c), `stereo_sign (k,)` of their signed volume. Torsions about
    peptide and double bonds: `omega_idx (k, 4)` with `omega_sign (k,)`, 1 for cis and -1 for trans. Planar rings:
    `ring_idx (k, 4)`, the torsions within them. `excluded` says what is not checked because the reference changes it.
    """

    hydrogen: IntArray
    bond_idx: Annotated[IntArray, (-1, 2)]
    bond_mean_nm: FloatArray
    bond_std_nm: FloatArray
    near_idx: Annotated[IntArray, (-1, 2)]
    clash_min_nm: FloatArray
    stereo_idx: Annotated[IntArray, (-1, 4)]
    stereo_sign: IntArray
    omega_idx: Annotated[IntArray, (-1, 4)]
    omega_sign: IntArray
    ring_idx: Annotated[IntArray, (-1, 4)]
    excluded: tuple[str, ...] = ()

    @property
    def n_atoms(self) -> int:
        return len(self.hydrogen)

    @cached_property
    def clash_idx(self) -> IntArray:
        """The pairs i < j further apart than three bonds, `(k, 2)`."""
        apart = np.triu(np.ones((self.n_atoms, self.n_atoms), dtype=bool), k=1)
        apart[self.near_idx[:, 0], self.near_idx[:, 1]] = False
        return np.argwhere(apart)

    @cached_property
    def clash_pair_min_nm(self) -> FloatArray:
        """The least distance in nm of each pair in `clash_idx`, `(k,)`."""
        return self.pair_min_nm(self.clash_idx)

    def pair_min_nm(self, pairs: IntArray) -> FloatArray:
        """Return the least distance in nm for pairs `(k, 2)`."""
        n_heavy = 2 - self.hydrogen[pairs].sum(axis=1)
        least: FloatArray = self.clash_min_nm[n_heavy]
        return least

    @cached_property
    def near_keys(self) -> IntArray:
        """`near_idx` as sorted numbers i * n_atoms + j."""
        return np.unique(self.near_idx[:, 0] * self.n_atoms + self.near_idx[:, 1])


def geometry_from_scene(scene: Scene) -> Geometry:
    """Return the geometry of a scene's starting positions, for use before there is a reference.

    Clash distances are 0.2 nm between heavy atoms and 0.1 nm where a hydrogen takes part, for atoms more than three
    bonds apart: the closest that unbonded heavy atoms come is the 0.24 nm of strong hydrogen bonds, and hydrogen
    comes no closer than 0.15 nm to an acceptor, so no thermal frame is called a clash, and fused atoms are.
    """
    return Geometry(**find_rules(scene))


def geometry_from_frames(scene: Scene, positions_nm: npt.ArrayLike) -> Geometry:
    """Return the geometry of reference frames `(n_frames, n_atoms, 3)` nm: mean bond lengths, handedness, torsions.

    What differs from the majority in more than one frame in a thousand is left out and named in `.excluded` (a proton
    that hops, an amide that turns, a ring that buckles); frames that are not finite are not used. Clash distances are
    0.8 times the least that the frames show for each kind of pair, and at most 0.24 nm between heavy atoms and 0.14 nm
    with a hydrogen: the lengths of the shortest hydrogen bonds, which a short reference need not have visited.
    Raises InputError when no finite frame fits the scene.
    """
    positions = np.asarray(positions_nm)
    if positions.ndim != 3 or positions.shape[1:] != (scene.n_atoms, 3):
        raise InputError(f"Reference frames have shape {positions.shape}, not (n_frames, {scene.n_atoms}, 3).")
    return Geometry(**measured_rules(scene, positions))


def check_frames(positions_nm: npt.ArrayLike, geometry: Geometry) -> npt.NDArray[np.uint16]:
    """Return validity bits `(n_frames,)` of frames `(n_frames, n_atoms, 3)` nm (or one frame); 0 is a valid frame.

    NOT_FINITE: a coordinate is NaN or infinite. BOND_HALF_ANGSTROM: a bond is more than 0.05 nm from its mean (the
    stability rule of Fu et al., Forces are not enough, TMLR 2023). BOND_20_PERCENT: more than 20 % from it; the
    stricter warning, which INVALID leaves out. CLASH: atoms more than three bonds apart nearer than the geometry
    allows. CHIRALITY: a stereocentre is inverted or flat. OMEGA: a peptide or double bond has gone from cis to trans or
    back. RING: a torsion inside a planar ring beyond 60°.
    Raises InputError when the frames do not have the geometry's atoms.
    """
    positions = np.asarray(positions_nm)
    if positions.ndim == 2:
        positions = positions[None]
    if positions.ndim != 3 or positions.shape[1:] != (geometry.n_atoms, 3):
        raise InputError(f"Frames have shape {positions.shape}, not (n_frames, {geometry.n_atoms}, 3).")
    flags = np.zeros(len(positions), dtype=np.uint16)
    with np.errstate(invalid="ignore", over="ignore"):
        widest = len(geometry.bond_idx) + min(n_pairs(geometry.n_atoms), MAX_PAIRS)
        for start, columns in column_blocks(positions, widest):
            part = flags[start : start + columns.shape[2]]
            part |= np.uint16(NOT_FINITE) * ~np.isfinite(columns).all(axis=(0, 1))
            _check_bonds(columns, geometry, part)
            _check_clashes(columns, geometry, part)
            turned = signed_volume(columns, geometry.stereo_idx) * geometry.stereo_sign[:, None] <= 0
            part |= np.uint16(CHIRALITY) * turned.any(axis=0)
            flipped = torsion_cosine(columns, geometry.omega_idx) * geometry.omega_sign[:, None] < 0
            part |= np.uint16(OMEGA) * flipped.any(axis=0)
            bent = torsion_cosine(columns, geometry.ring_idx) < RING_BENT_COSINE
            part |= np.uint16(RING) * bent.any(axis=0)
    return flags


def flag_names(flags: int) -> list[str]:
    """Return what the bits of one frame's flags say, in words."""
    return [name for bit, name in _NAMES.items() if int(flags) & bit]


def _check_bonds(columns: FloatArray, geometry: Geometry, part: npt.NDArray[np.uint16]) -> None:
    length = np.sqrt(squared_distance(columns, geometry.bond_idx))
    deviation = np.abs(length - geometry.bond_mean_nm[:, None].astype(columns.dtype))
    part |= np.uint16(BOND_HALF_ANGSTROM) * (deviation > HALF_ANGSTROM_NM).any(axis=0)
    limit = (0.2 * geometry.bond_mean_nm)[:, None].astype(columns.dtype)
    part |= np.uint16(BOND_20_PERCENT) * (deviation > limit).any(axis=0)


def _check_clashes(columns: FloatArray, geometry: Geometry, part: npt.NDArray[np.uint16]) -> None:
    if n_pairs(geometry.n_atoms) <= MAX_PAIRS:
        limit = (geometry.clash_pair_min_nm**2)[:, None].astype(columns.dtype)
        part |= np.uint16(CLASH) * (squared_distance(columns, geometry.clash_idx) < limit).any(axis=0)
        return
    # Beyond some 280 atoms the list of all pairs costs more than looking for neighbours.
    from scipy.spatial import cKDTree

    for k in range(columns.shape[2]):
        frame = columns[:, :, k].T
        finite = np.flatnonzero(np.isfinite(frame).all(axis=1))
        close = cKDTree(frame[finite]).query_pairs(float(geometry.clash_min_nm.max()), output_type="ndarray")
        pairs = np.sort(finite[close], axis=1)
        pairs = pairs[~np.isin(pairs[:, 0] * geometry.n_atoms + pairs[:, 1], geometry.near_keys)]
        distance = np.linalg.norm(frame[pairs[:, 0]] - frame[pairs[:, 1]], axis=1)
        part[k] |= np.uint16(CLASH) * bool((distance < geometry.pair_min_nm(pairs)).any())
