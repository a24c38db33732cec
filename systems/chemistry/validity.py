"""Validity of frames: bonds, clashes, chirality and planarity by the geometry of a scene or of reference frames, for
guards and for the comparison; and limits of the reference's angles, flat centres and steps, for guards alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.geometry import bond_angle, column_blocks, cross, signed_volume, squared_distance, torsion_cosine
from systems.errors import InputError
from systems.files.schema import Recorded
from systems.scene import Scene

FloatArray = npt.NDArray[np.floating[Any]]
IntArray = npt.NDArray[np.int64]

HALF_ANGSTROM_NM = 0.05
RING_BENT_COSINE = 0.5
MAX_PAIRS = 40_000
_RING_PLANAR_COSINE = float(np.cos(np.deg2rad(20.0)))
_TOLERATED_SHARE = 1e-3
# Classes of atoms by what they touch, the last for all other elements.
CONTACT_CLASSES = ("hydrogen of N, O or S", "hydrogen of C", "C", "N", "O", "other")
# Distance in nm below which atoms of two classes, more than three bonds apart, clash: 0.8 of the nearest that MD at
# 300 K shows, rounded down (docs/studies/preparation/contacts.py), with room for ions and fluorine in the last row.
CLASH_NM = np.array([
    [0.114, 0.112, 0.150, 0.118, 0.126, 0.118],
    [0.112, 0.140, 0.176, 0.172, 0.164, 0.160],
    [0.150, 0.176, 0.228, 0.216, 0.206, 0.200],
    [0.118, 0.172, 0.216, 0.220, 0.200, 0.190],
    [0.126, 0.164, 0.206, 0.200, 0.200, 0.190],
    [0.118, 0.160, 0.200, 0.190, 0.190, 0.190],
])  # fmt: skip
CLASH_SHARE_OF_LEAST = 0.8
# Of unit vectors to three neighbours: 0.77 where a fourth is missing, 0 where there is none.
_PYRAMID = 0.4
_FRAMES_FOR_SHAPE = 200
# What is flatter than this has no handedness: a signed volume, a torsion's cosine.
_FLAT_NM3 = 2e-4
_FLAT_COSINE = 0.1

NOT_FINITE = 1
BOND_HALF_ANGSTROM = 2
BOND_20_PERCENT = 4
CLASH = 8
CHIRALITY = 16
OMEGA = 32
RING = 64
# What guards watch beyond that while rolling; they are no part of INVALID.
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

    Atoms: `contact_class (n_atoms,)`, numbers into `CONTACT_CLASSES`. Bonds: `bond_idx (n_bonds, 2)`, `bond_mean_nm`,
    `bond_std_nm (n_bonds,)` (0 where no frames were given). Clashes: `near_idx (k, 2)` are the pairs up to three bonds
    apart, which never count; `clash_min_nm (n_classes, n_classes)` the least distance of all others, by their classes.
    Handedness: `stereo_idx (k, 4)` rows (centre, a, b, c), `stereo_sign (k,)` of their signed volume. Torsions about
    peptide and double bonds: `omega_idx (k, 4)` with `omega_sign (k,)`, 1 for cis and -1 for trans. Planar rings:
    `ring_idx (k, 4)`, the torsions within them. `excluded` says what is not checked because the reference changes it.
    """

    contact_class: IntArray
    bond_idx: Annotated[IntArray, (-1, 2)]
    bond_mean_nm: FloatArray
    bond_std_nm: FloatArray
    near_idx: Annotated[IntArray, (-1, 2)]
    clash_min_nm: Annotated[FloatArray, (-1, len(CONTACT_CLASSES))]
    stereo_idx: Annotated[IntArray, (-1, 4)]
    stereo_sign: IntArray
    omega_idx: Annotated[IntArray, (-1, 4)]
    omega_sign: IntArray
    ring_idx: Annotated[IntArray, (-1, 4)]
    excluded: tuple[str, ...] = ()

    @property
    def n_atoms(self) -> int:
        return len(self.contact_class)

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
        one, other = self.contact_class[pairs].T
        return np.asarray(self.clash_min_nm[one, other])

    @cached_property
    def near_keys(self) -> IntArray:
        """`near_idx` as sorted numbers i * n_atoms + j."""
        return np.unique(self.near_idx[:, 0] * self.n_atoms + self.near_idx[:, 1])


def contact_classes(scene: Scene) -> IntArray:
    """Return the class of each atom, `(n_atoms,)`, a number into `CONTACT_CLASSES`."""
    number = {name: k for k, name in enumerate(CONTACT_CLASSES)}
    found = [number.get(element, len(CONTACT_CLASSES) - 1) for element in scene.elements]
    for i, around in enumerate(scene.neighbours()):
        if scene.elements[i] == "H":
            found[i] = int(any(scene.elements[j] == "C" for j in around))
    return np.array(found, dtype=np.int64)


def geometry_from_scene(scene: Scene) -> Geometry:
    """Return the geometry of a scene's starting positions, for use before there is a reference; clash distances are
    `CLASH_NM`, below which no thermal frame comes."""
    from systems.chemistry.graph import exclusions, stereocentres

    start = np.ascontiguousarray(scene.positions_nm.T[:, :, None])
    stereo_idx, omega_idx = stereocentres(scene), _stiff_torsions(scene)
    return Geometry(
        contact_class=contact_classes(scene),
        bond_idx=scene.bonds,
        bond_mean_nm=np.sqrt(squared_distance(start, scene.bonds)[:, 0]),
        bond_std_nm=np.zeros(len(scene.bonds)),
        near_idx=exclusions(scene, depth=3),
        # The particles of a model system have no size.
        clash_min_nm=CLASH_NM if scene.interactions is None else np.zeros_like(CLASH_NM),
        stereo_idx=stereo_idx,
        stereo_sign=np.where(signed_volume(start, stereo_idx)[:, 0] > 0, 1, -1),
        omega_idx=omega_idx,
        omega_sign=np.where(torsion_cosine(start, omega_idx)[:, 0] > 0, 1, -1),
        ring_idx=_flat_ring_torsions(scene, lambda quads: torsion_cosine(start, quads)[:, 0]),
    )


def geometry_from_frames(scene: Scene, positions_nm: npt.ArrayLike) -> Geometry:
    """Return the geometry of reference frames `(n_frames, n_atoms, 3)` nm: mean bond lengths, handedness, torsions.

    What differs from the majority in more than one frame in a thousand is left out and named in `.excluded` (a proton
    that hops, an amide that turns, a ring that buckles); frames that are not finite are not used. Clash distances are
    0.8 times the least that the frames show for each pair of classes, and at most `CLASH_NM`: what a short reference
    need not have visited. Raises InputError when no finite frame fits the scene.
    """
    frames = np.asarray(positions_nm)
    if frames.ndim != 3 or frames.shape[1:] != (scene.n_atoms, 3):
        raise InputError(f"Reference frames have shape {frames.shape}, not (n_frames, {scene.n_atoms}, 3).")
    finite = np.isfinite(frames).all(axis=(1, 2))
    if not finite.any():
        raise InputError("None of the reference frames is finite.")
    frames = frames if finite.all() else frames[finite]
    plain = geometry_from_scene(scene)
    ring_idx = _flat_ring_torsions(scene, lambda quads: _means(frames, quads))
    bonds, omega_idx = plain.bond_idx, plain.omega_idx
    stereo_idx = np.concatenate([plain.stereo_idx, centres_without_hydrogen(scene, frames)])
    mean, std = _bond_lengths(frames, bonds)
    pairs: dict[tuple[int, int], IntArray] = {}
    if n_pairs(scene.n_atoms) <= MAX_PAIRS:
        classes = np.sort(plain.contact_class[plain.clash_idx], axis=1)
        pairs = {(a, b): plain.clash_idx[(classes == (a, b)).all(axis=1)] for a, b in np.unique(classes, axis=0)}
    n_broken, n_positive = np.zeros(len(bonds)), np.zeros(len(stereo_idx))
    n_cis, n_bent = np.zeros(len(omega_idx)), np.zeros(len(ring_idx))
    least = {kind: np.empty(len(frames)) for kind in pairs}
    for start, columns in column_blocks(frames, max(map(len, pairs.values()), default=0)):
        stop = start + columns.shape[2]
        length = np.sqrt(squared_distance(columns, bonds))
        n_broken += (np.abs(length - mean[:, None]) > HALF_ANGSTROM_NM).sum(axis=1)
        n_positive += (signed_volume(columns, stereo_idx) > 0).sum(axis=1)
        n_cis += (torsion_cosine(columns, omega_idx) > 0).sum(axis=1)
        n_bent += (torsion_cosine(columns, ring_idx) < RING_BENT_COSINE).sum(axis=1)
        for kind, idx in pairs.items():
            least[kind][start:stop] = np.sqrt(squared_distance(columns, idx).min(axis=0))
    n = len(frames)
    excluded: list[str] = []

    def kept(rows: IntArray, n_changed: FloatArray, what: str) -> npt.NDArray[np.bool_]:
        """Return which rows the reference keeps, and note the others."""
        share = n_changed / n
        for row, part in zip(rows.tolist(), share.tolist(), strict=True):
            if part > _TOLERATED_SHARE:
                atoms = row[:1] if what == "stereocentre" else row
                names, numbers = "-".join(scene.atom_names[i] for i in atoms), ", ".join(str(i + 1) for i in atoms)
                excluded.append(f"{what} {names} (atom {numbers}): changes in {100 * part:.2g} % of the reference")
        return np.asarray(share <= _TOLERATED_SHARE)

    keep_bond = kept(bonds, n_broken, "bond")
    keep_stereo = kept(stereo_idx, np.minimum(n_positive, n - n_positive), "stereocentre")
    keep_omega = kept(omega_idx, np.minimum(n_cis, n - n_cis), "peptide or double bond torsion")
    keep_ring = kept(ring_idx, n_bent, "ring torsion")
    clash_min_nm = plain.clash_min_nm.copy()
    for (a, b), distances in least.items():
        seen = float(np.quantile(distances, _TOLERATED_SHARE, method="lower"))
        clash_min_nm[a, b] = clash_min_nm[b, a] = min(CLASH_SHARE_OF_LEAST * seen, clash_min_nm[a, b])
    return replace(
        plain, bond_idx=bonds[keep_bond], bond_mean_nm=mean[keep_bond], bond_std_nm=std[keep_bond],
        clash_min_nm=clash_min_nm, stereo_idx=stereo_idx[keep_stereo],
        stereo_sign=np.where(2 * n_positive > n, 1, -1)[keep_stereo], omega_idx=omega_idx[keep_omega],
        omega_sign=np.where(2 * n_cis > n, 1, -1)[keep_omega], ring_idx=ring_idx[keep_ring], excluded=tuple(excluded),
    )  # fmt: skip


def n_pairs(n_atoms: int) -> int:
    """Number of pairs among `n_atoms` atoms."""
    return n_atoms * (n_atoms - 1) // 2


def changed_stereo(scene: Scene, positions_nm: FloatArray) -> list[str]:
    """Return of each state `(n_states, n_atoms, 3)` nm what of the scene's handedness it has not, in words, empty where
    it has all: a stereocentre turned over, or a double bond gone from cis to trans or back. What the scene has flat may
    go either way."""
    from systems.chemistry.graph import stereocentres

    centres, torsions = stereocentres(scene), _stiff_torsions(scene)
    order = {frozenset(b): o for b, o in zip(scene.bonds.tolist(), scene.bond_orders.tolist(), strict=True)}
    double = [k for k, (_, i, j, _) in enumerate(torsions.tolist()) if order.get(frozenset((i, j))) == 2.0]
    torsions = torsions[double]
    start, states = (np.moveaxis(np.asarray(x, dtype=np.float64), 0, -1).swapaxes(0, 1) for x in
                     (scene.positions_nm[None], positions_nm))  # fmt: skip
    volume, cosine = signed_volume(start, centres), torsion_cosine(start, torsions)
    wrong_centre = (np.abs(volume) > _FLAT_NM3) & (volume * signed_volume(states, centres) < 0)
    wrong_bond = (np.abs(cosine) > _FLAT_COSINE) & (cosine * torsion_cosine(states, torsions) < 0)
    name, found = scene.atom_names, [""] * len(positions_nm)
    for state in np.flatnonzero(wrong_centre.any(axis=0) | wrong_bond.any(axis=0)).tolist():
        if wrong_centre[:, state].any():
            found[state] = f"the stereocentre {name[int(centres[wrong_centre[:, state], 0][0])]} turns over"
        else:
            i, j = torsions[wrong_bond[:, state]][0, 1:3].tolist()
            found[state] = f"the double bond {name[i]} - {name[j]} turns from cis to trans or back"
    return found


def centres_without_hydrogen(scene: Scene, positions_nm: FloatArray) -> IntArray:
    """Return rows (centre, a, b, c), `(k, 4)`, of carbons whose hydrogen is not in the scene: three neighbours of three
    kinds, and not flat in frames `(n_frames, n_atoms, 3)` nm. The sign of the volume of the three is the handedness."""
    from systems.chemistry.graph import atom_classes

    neighbours = scene.neighbours()
    rows = [(i, *around) for i, around in enumerate(neighbours) if scene.elements[i] == "C" and len(around) == 3]
    if not rows:
        return np.empty((0, 4), dtype=np.int64)
    found = np.array(rows, dtype=np.int64)
    frames = positions_nm[:: max(1, len(positions_nm) // _FRAMES_FOR_SHAPE)].astype(np.float64)
    arms = frames[:, found[:, 1:]] - frames[:, found[:, :1]]
    arms /= np.maximum(np.linalg.norm(arms, axis=-1, keepdims=True), 1e-9)
    found = found[np.abs(np.linalg.det(arms).mean(axis=0)) > _PYRAMID]
    classes = atom_classes(scene)
    return found[[len(set(classes[row[1:]].tolist())) == 3 for row in found]].reshape(-1, 4)


def _bond_lengths(frames: FloatArray, bonds: IntArray) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    total, squares = np.zeros(len(bonds)), np.zeros(len(bonds))
    for _, columns in column_blocks(frames, len(bonds)):
        square = squared_distance(columns, bonds).astype(np.float64)
        total += np.sqrt(square).sum(axis=1)
        squares += square.sum(axis=1)
    mean = total / len(frames)
    return mean, np.sqrt(np.maximum(squares / len(frames) - mean**2, 0.0))


def _means(frames: FloatArray, quads: IntArray) -> FloatArray:
    total = np.zeros(len(quads))
    for _, columns in column_blocks(frames, len(quads)):
        total += torsion_cosine(columns, quads).sum(axis=1)
    return total / len(frames)


def _stiff_torsions(scene: Scene) -> IntArray:
    """Peptide torsions and torsions about double bonds outside rings whose ends tell cis from trans, `(k, 4)`."""
    from systems.chemistry.graph import atom_classes, backbone_torsions, bonded_graph, ring_bonds

    graph, classes = bonded_graph(scene), atom_classes(scene)
    in_ring = {tuple(row) for row in ring_bonds(scene).tolist()}
    rows = backbone_torsions(scene)["omega"].tolist()
    for (b, c), order in zip(scene.bonds.tolist(), scene.bond_orders.tolist(), strict=True):
        ends = [[j for j in graph[b] if j != c], [j for j in graph[c] if j != b]]
        distinct = all(end and len({int(classes[j]) for j in end}) == len(end) for end in ends)
        if order == 2 and (b, c) not in in_ring and distinct and max(map(len, ends)) <= 2:
            rows.append([max(ends[0], key=lambda j: classes[j]), b, c, max(ends[1], key=lambda j: classes[j])])
    return np.array(rows, dtype=np.int64).reshape(-1, 4)


def _flat_ring_torsions(scene: Scene, mean_cosine: Callable[[IntArray], FloatArray]) -> IntArray:
    """Torsions `(k, 4)` inside rings of 4 to 7 atoms with at most three neighbours each whose `mean_cosine(quads)` are
    all within 20° of flat."""
    rows: list[tuple[int, ...]] = []
    for cycle in small_rings(scene, most_neighbours=3):
        torsions = [tuple(cycle[(k + m) % len(cycle)] for m in range(4)) for k in range(len(cycle))]
        if (mean_cosine(np.array(torsions, dtype=np.int64)) > _RING_PLANAR_COSINE).all():
            rows.extend(torsions)
    return np.array(rows, dtype=np.int64).reshape(-1, 4)


def small_rings(scene: Scene, *, most_neighbours: int | None = None) -> list[list[int]]:
    """Return the rings of 4 to 7 atoms, atoms in order: the smallest ring of each bond. `most_neighbours` leaves out
    rings with an atom of more neighbours."""
    import networkx as nx

    from systems.chemistry.graph import bonded_graph, ring_bonds

    graph = bonded_graph(scene)
    rings: dict[frozenset[int], list[int]] = {}
    for i, j in ring_bonds(scene).tolist():
        without_bond = nx.restricted_view(graph, [], [(i, j)])
        before = dict(nx.bfs_predecessors(without_bond, i, depth_limit=6))
        if j in before:
            ring = [j]
            while ring[-1] != i:
                ring.append(before[ring[-1]])
            crowded = most_neighbours is not None and any(graph.degree(atom) > most_neighbours for atom in ring)
            if 4 <= len(ring) <= 7 and not crowded:
                rings.setdefault(frozenset(ring), ring)
    return list(rings.values())


# ---- checks of frames -----------------------------------------------------------------------------------------------


def check_frames(positions_nm: npt.ArrayLike, geometry: Geometry) -> npt.NDArray[np.uint16]:
    """Return validity bits `(n_frames,)` of frames `(n_frames, n_atoms, 3)` nm (or one frame); 0 is a valid frame.

    BOND_HALF_ANGSTROM: a bond is more than 0.05 nm from its mean (the stability rule of Fu et al., Forces are not
    enough, TMLR 2023). BOND_20_PERCENT: more than 20 %; INVALID leaves it out. CLASH: atoms more than three bonds apart
    nearer than the geometry allows. CHIRALITY: a stereocentre is inverted or flat. OMEGA: a peptide or double bond has
    gone from cis to trans or back. RING: a torsion inside a planar ring beyond 60°. Raises InputError for other atoms.
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
            mean = geometry.bond_mean_nm[:, None]
            deviation = np.abs(np.sqrt(squared_distance(columns, geometry.bond_idx)) - mean.astype(columns.dtype))
            part |= np.uint16(BOND_HALF_ANGSTROM) * (deviation > HALF_ANGSTROM_NM).any(axis=0)
            part |= np.uint16(BOND_20_PERCENT) * (deviation > (0.2 * mean).astype(columns.dtype)).any(axis=0)
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


# ---- limits of a reference's frames ---------------------------------------------------------------------------------


# How much farther than in the reference counts as too far: a sample's extremes lie inside those of a longer one. For
# Gaussian motion and 20,000 frames the limit stands at six standard deviations.
WIDENING = 1.5
# A model that does not simulate moves least of all: random weights of PAINET leave distances as they are to a hundredth
# of what the quietest of 20,000 frames of MD changes.
_STILLER = 3.0
# A centre with three neighbours is flat where the reference keeps it, root mean square, this near to their plane: sp2
# centres stay within 0.01 nm, pyramidal ones stand 0.03 nm or more above it.
_FLAT_NM = 0.02
_MOST_PAIRS = 2_000


@dataclass(frozen=True, eq=False)
class Limits(Recorded):
    """How far frames of the reference go. Made by `limits_from_frames`.

    Angles: `angle_idx (k, 3)` rows (end, middle, end) within `angle_min_rad` and `angle_max_rad (k,)`. Flat centres:
    `flat_idx (k, 4)` rows (centre, a, b, c) no farther than `flat_max_nm (k,)` from the plane of a, b, c. Jumps:
    `jump_idx (k, 2)` pairs of atoms, whose distances change from one frame to the next by `jump_min_nm` to
    `jump_max_nm`, root mean square; the middle of those atoms moves no farther than `jump_max_nm`, or than
    `drift_max_nm`, if that is more.
    """

    angle_idx: Annotated[IntArray, (-1, 3)]
    angle_min_rad: FloatArray
    angle_max_rad: FloatArray
    flat_idx: Annotated[IntArray, (-1, 4)]
    flat_max_nm: FloatArray
    jump_idx: Annotated[IntArray, (-1, 2)]
    jump_max_nm: float
    jump_min_nm: float = 0.0
    drift_max_nm: float = 0.0


def limits_from_frames(scene: Scene, positions_nm: npt.ArrayLike, next_nm: npt.ArrayLike) -> Limits:
    """Return the limits that reference frames `(n_frames, n_atoms, 3)` nm set; frame k is followed by `next_nm[k]`.
    Raises InputError when the frames do not fit the scene or each other, or none is finite."""
    first, second = np.asarray(positions_nm), np.asarray(next_nm)
    if first.ndim != 3 or first.shape[1:] != (scene.n_atoms, 3) or second.shape != first.shape:
        raise InputError(f"Frames {first.shape} and {second.shape} do not fit each other and {scene.n_atoms} atoms.")
    finite = np.isfinite(first).all(axis=(1, 2)) & np.isfinite(second).all(axis=(1, 2))
    if not finite.any():
        raise InputError("None of the reference frames is finite.")
    first, second = first[finite], second[finite]
    near = scene.neighbours()
    triples = [(a, b, c) for b, around in enumerate(near) for a in around for c in around if a < c]
    angle_idx = np.array(triples, dtype=np.int64).reshape(-1, 3)
    quads = [(i, *around) for i, around in enumerate(near) if len(around) == 3]
    centres = np.array(quads, dtype=np.int64).reshape(-1, 4)
    angles = _gather(first, angle_idx, bond_angle)
    heights = np.abs(_gather(first, centres, _height))
    flat = np.sqrt((heights**2).mean(axis=1)) < _FLAT_NM
    mean = angles.mean(axis=1)
    pairs = _jump_pairs(scene)
    jumps = np.concatenate([_jump(a, b, pairs) for _, a, b in _both(first, second, len(pairs))])
    return Limits(
        angle_idx=angle_idx,
        angle_min_rad=mean - WIDENING * (mean - angles.min(axis=1)),
        angle_max_rad=mean + WIDENING * (angles.max(axis=1) - mean),
        flat_idx=centres[flat],
        flat_max_nm=WIDENING * heights[flat].max(axis=1, initial=0.0),
        jump_idx=pairs,
        jump_max_nm=WIDENING * float(jumps.max()) if len(pairs) else float("inf"),
        jump_min_nm=float(jumps.min()) / _STILLER if len(pairs) else 0.0,
    )


def check_limits(positions_nm: npt.ArrayLike, limits: Limits, previous_nm: npt.ArrayLike) -> npt.NDArray[np.uint16]:
    """Return bits `(n_frames,)` for frames `(n_frames, n_atoms, 3)` nm; 0 is within the limits.

    ANGLE and PLANARITY: an angle, or a centre's height above the plane of its neighbours, beyond the limits. JUMP and
    DRIFT: too far from the frame before, `previous_nm (n_frames, n_atoms, 3)`; STILL: too near to it, but not equal. A
    frame that is not finite is beyond every limit, and so is the step away.
    """
    positions, previous = np.asarray(positions_nm), np.asarray(previous_nm)
    flags = np.zeros(len(positions), dtype=np.uint16)
    least, greatest = limits.angle_min_rad[:, None], limits.angle_max_rad[:, None]
    atoms = np.unique(limits.jump_idx)
    widest = max(len(limits.angle_idx), len(limits.flat_idx), len(limits.jump_idx))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        for start, before, columns in _both(previous, positions, widest):
            part = flags[start : start + columns.shape[2]]
            angle = bond_angle(columns, limits.angle_idx)
            part |= np.uint16(ANGLE) * ~((angle >= least) & (angle <= greatest)).all(axis=0)
            height = np.abs(_height(columns, limits.flat_idx))
            part |= np.uint16(PLANARITY) * ~(height <= limits.flat_max_nm[:, None]).all(axis=0)
            if len(atoms):
                jump = _jump(before, columns, limits.jump_idx)
                part |= np.uint16(JUMP) * ~(jump <= limits.jump_max_nm)
                part |= np.uint16(STILL) * ((jump < limits.jump_min_nm) & (jump > 0.0))
                moved = columns[:, atoms].mean(axis=1) - before[:, atoms].mean(axis=1)
                far = max(limits.jump_max_nm, limits.drift_max_nm)
                part |= np.uint16(DRIFT) * ~(np.sqrt((moved * moved).sum(axis=0)) <= far)
    return flags


def _jump_pairs(scene: Scene) -> IntArray:
    """Pairs of heavy atoms (of all atoms where there are fewer than three heavy ones), evenly thinned to 2,000."""
    atoms = scene.heavy_idx if len(scene.heavy_idx) >= 3 else np.arange(scene.n_atoms)
    rows, columns = np.triu_indices(len(atoms), k=1)
    pairs = np.stack([atoms[rows], atoms[columns]], axis=1)
    return pairs[:: max(-(-len(pairs) // _MOST_PAIRS), 1)]


def _gather(frames: FloatArray, rows: IntArray, measure: Any) -> FloatArray:
    """Return `measure(columns, rows)` of all frames, `(len(rows), n_frames)` float64."""
    parts = [measure(columns, rows) for _, columns in column_blocks(frames, len(rows))]
    return np.concatenate(parts, axis=1).astype(np.float64)


def _both(first: FloatArray, second: FloatArray, widest: int) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    blocks = zip(column_blocks(first, widest), column_blocks(second, widest), strict=True)
    yield from ((start, a, b) for (start, a), (_, b) in blocks)


def _height(columns: FloatArray, quads: IntArray) -> FloatArray:
    """Signed distance `(k, n)` nm of a centre from the plane of its three neighbours."""
    a, b, c = (columns[:, quads[:, k]] for k in (1, 2, 3))
    normal = cross(b - a, c - a)
    area = np.sqrt((normal * normal).sum(axis=0))
    height: FloatArray = signed_volume(columns, quads) / np.maximum(area, np.finfo(columns.dtype).tiny)
    return height


def _jump(first: FloatArray, second: FloatArray, pairs: IntArray) -> FloatArray:
    """Root mean square change `(n,)` nm of the distances of pairs from `first` to `second (3, n_atoms, n)`."""
    change = np.sqrt(squared_distance(second, pairs)) - np.sqrt(squared_distance(first, pairs))
    jump: FloatArray = np.sqrt((change * change).mean(axis=0))
    return jump
