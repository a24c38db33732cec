"""Reference geometry for the validity checks: terms of a scene's bond graph, with their values in reference frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.geometry import column_blocks, signed_volume, squared_distance, torsion_cosine
from systems.errors import InputError
from systems.scene import Scene

FloatArray = npt.NDArray[np.floating[Any]]
IntArray = npt.NDArray[np.int64]

HALF_ANGSTROM_NM = 0.05
RING_BENT_COSINE = 0.5
MAX_PAIRS = 40_000
_RING_PLANAR_COSINE = float(np.cos(np.deg2rad(20.0)))
_TOLERATED_SHARE = 1e-3
# Between hydrogens, hydrogen and heavy atom, heavy atoms; nm. At most: the lengths of the shortest hydrogen bonds.
_CLASH_WITHOUT_FRAMES_NM = (0.1, 0.1, 0.2)
CLASH_AT_MOST_NM = (0.14, 0.14, 0.24)
_CLASH_SHARE_OF_LEAST = 0.8
# Of unit vectors to three neighbours: 0.77 where a fourth is missing, 0 where there is none.
_PYRAMID = 0.4
_FRAMES_FOR_SHAPE = 200
# What is flatter than this has no handedness: a signed volume, a torsion's cosine.
_FLAT_NM3 = 2e-4
_FLAT_COSINE = 0.1


def n_pairs(n_atoms: int) -> int:
    """Number of pairs among `n_atoms` atoms."""
    return n_atoms * (n_atoms - 1) // 2


def find_rules(scene: Scene) -> dict[str, Any]:
    """Return the fields of a `validity.Geometry` as the scene's bond graph and starting positions give them."""
    from systems.chemistry.graph import exclusions, stereocentres

    start = np.ascontiguousarray(scene.positions_nm.T[:, :, None])
    stereo_idx = stereocentres(scene)
    omega_idx = _stiff_torsions(scene)
    ring_idx = _flat_ring_torsions(scene, lambda quads: torsion_cosine(start, quads)[:, 0])
    return {
        "hydrogen": np.array([int(e == "H") for e in scene.elements], dtype=np.int64),
        "bond_idx": scene.bonds,
        "bond_mean_nm": np.sqrt(squared_distance(start, scene.bonds)[:, 0]),
        "bond_std_nm": np.zeros(len(scene.bonds)),
        "near_idx": exclusions(scene, depth=3),
        # The particles of a model system have no size.
        "clash_min_nm": np.array(_CLASH_WITHOUT_FRAMES_NM) if scene.interactions is None else np.zeros(3),
        "stereo_idx": stereo_idx,
        "stereo_sign": np.where(signed_volume(start, stereo_idx)[:, 0] > 0, 1, -1),
        "omega_idx": omega_idx,
        "omega_sign": np.where(torsion_cosine(start, omega_idx)[:, 0] > 0, 1, -1),
        "ring_idx": ring_idx,
        "excluded": (),
    }


def measured_rules(scene: Scene, positions_nm: FloatArray) -> dict[str, Any]:
    """Return the same fields with lengths, signs and distances of frames `(n_frames, n_atoms, 3)` nm.

    Raises InputError when no frame is finite.
    """
    rules = find_rules(scene)
    finite = np.isfinite(positions_nm).all(axis=(1, 2))
    if not finite.any():
        raise InputError("None of the reference frames is finite.")
    frames = positions_nm if finite.all() else positions_nm[finite]
    ring_idx = _flat_ring_torsions(scene, lambda quads: _means(frames, quads))
    bonds, omega_idx = rules["bond_idx"], rules["omega_idx"]
    stereo_idx = np.concatenate([rules["stereo_idx"], centres_without_hydrogen(scene, frames)])
    mean, std = _bond_lengths(frames, bonds)
    pairs = _pairs_by_kind(rules) if n_pairs(scene.n_atoms) <= MAX_PAIRS else []
    n_broken, n_positive = np.zeros(len(bonds)), np.zeros(len(stereo_idx))
    n_cis, n_bent = np.zeros(len(omega_idx)), np.zeros(len(ring_idx))
    least = np.full((3, len(frames)), np.inf)
    for start, columns in column_blocks(frames, max([len(p) for p in pairs], default=0)):
        stop = start + columns.shape[2]
        length = np.sqrt(squared_distance(columns, bonds))
        n_broken += (np.abs(length - mean[:, None]) > HALF_ANGSTROM_NM).sum(axis=1)
        n_positive += (signed_volume(columns, stereo_idx) > 0).sum(axis=1)
        n_cis += (torsion_cosine(columns, omega_idx) > 0).sum(axis=1)
        n_bent += (torsion_cosine(columns, ring_idx) < RING_BENT_COSINE).sum(axis=1)
        for kind, idx in enumerate(pairs):
            if len(idx):
                least[kind, start:stop] = np.sqrt(squared_distance(columns, idx).min(axis=0))
    n = len(frames)
    labels = _Labels(scene, [])
    keep_bond = labels.keep(bonds, n_broken / n, "bond")
    keep_stereo = labels.keep(stereo_idx, np.minimum(n_positive, n - n_positive) / n, "stereocentre")
    keep_omega = labels.keep(omega_idx, np.minimum(n_cis, n - n_cis) / n, "peptide or double bond torsion")
    keep_ring = labels.keep(ring_idx, n_bent / n, "ring torsion")
    rules |= {
        "bond_idx": bonds[keep_bond], "bond_mean_nm": mean[keep_bond], "bond_std_nm": std[keep_bond],
        "stereo_idx": stereo_idx[keep_stereo], "stereo_sign": np.where(2 * n_positive > n, 1, -1)[keep_stereo],
        "omega_idx": omega_idx[keep_omega], "omega_sign": np.where(2 * n_cis > n, 1, -1)[keep_omega],
        "ring_idx": ring_idx[keep_ring], "excluded": tuple(labels.lines),
    }  # fmt: skip
    if pairs and scene.interactions is None:
        seen = np.quantile(least, _TOLERATED_SHARE, axis=1, method="lower")
        rules["clash_min_nm"] = np.minimum(_CLASH_SHARE_OF_LEAST * seen, CLASH_AT_MOST_NM)
    return rules


def changed_stereo(scene: Scene, positions_nm: FloatArray) -> list[str]:
    """Return of each state `(n_states, n_atoms, 3)` nm what of the scene's handedness it has not, in words, empty where
    it has all: a stereocentre turned over, or a double bond gone from cis to trans or back. What the scene has flat may
    go either way; amides turn without becoming another molecule."""
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
    kinds, and not flat in frames `(n_frames, n_atoms, 3)` nm.

    The fourth neighbour lies where the three leave room, so that the sign of their volume is the handedness.
    """
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


class _Labels:
    """Collects what is not checked, in words."""

    def __init__(self, scene: Scene, lines: list[str]) -> None:
        self.scene, self.lines = scene, lines

    def keep(self, rows: IntArray, share: FloatArray, what: str) -> npt.NDArray[np.bool_]:
        """Return which rows the reference keeps, and note the others."""
        kept: npt.NDArray[np.bool_] = share <= _TOLERATED_SHARE
        for row, part in zip(rows[~kept].tolist(), share[~kept].tolist(), strict=True):
            atoms = row[:1] if what == "stereocentre" else row
            names = "-".join(self.scene.atom_names[i] for i in atoms)
            where = ", ".join(str(i + 1) for i in atoms)
            self.lines.append(f"{what} {names} (atom {where}): changes in {100 * part:.2g} % of the reference")
        return kept


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


def _pairs_by_kind(rules: dict[str, Any]) -> list[IntArray]:
    hydrogen = rules["hydrogen"]
    apart = np.triu(np.ones((len(hydrogen), len(hydrogen)), dtype=bool), k=1)
    apart[rules["near_idx"][:, 0], rules["near_idx"][:, 1]] = False
    pairs = np.argwhere(apart)
    n_heavy = 2 - hydrogen[pairs].sum(axis=1)
    return [pairs[n_heavy == kind] for kind in range(3)]


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


def _flat_ring_torsions(scene: Scene, mean_cosine: Any) -> IntArray:
    """Torsions `(k, 4)` inside rings of 4 to 7 atoms with at most three neighbours each that are planar.

    `mean_cosine(quads)` gives the mean cosine of each torsion; a ring is planar when none lies beyond 20°.
    """
    rows: list[tuple[int, ...]] = []
    for cycle in small_rings(scene, most_neighbours=3):
        torsions = [tuple(cycle[(k + m) % len(cycle)] for m in range(4)) for k in range(len(cycle))]
        if (mean_cosine(np.array(torsions, dtype=np.int64)) > _RING_PLANAR_COSINE).all():
            rows.extend(torsions)
    return np.array(rows, dtype=np.int64).reshape(-1, 4)


def small_rings(scene: Scene, *, most_neighbours: int | None = None) -> list[list[int]]:
    """Return the rings of 4 to 7 atoms, atoms in order: the smallest ring of each bond.

    `most_neighbours` leaves out rings with an atom of more neighbours.
    """
    from systems.chemistry.graph import bonded_graph, ring_bonds

    graph = bonded_graph(scene)
    rings: dict[frozenset[int], list[int]] = {}
    for i, j in ring_bonds(scene).tolist():
        before = {i: i}
        layer = [i]
        for _ in range(6):  # breadth first from i to j without the bond itself
            layer = [
                step
                for atom in layer
                for step in graph[atom]
                if {atom, step} != {i, j} and step not in before and before.setdefault(step, atom) == atom
            ]
        if j in before:
            ring = [j]
            while ring[-1] != i:
                ring.append(before[ring[-1]])
            crowded = most_neighbours is not None and any(graph.degree(atom) > most_neighbours for atom in ring)
            if 4 <= len(ring) <= 7 and not crowded:
                rings.setdefault(frozenset(ring), ring)
    return list(rings.values())
