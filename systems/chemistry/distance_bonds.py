"""Bonds by distance, where neither the file nor a residue template says what is bonded; periodic cells: box vectors,
nearest images, molecules whole in a cell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import networkx as nx
import numpy as np
import numpy.typing as npt

from systems.chemistry.element_data import covalent_radius_nm, is_metal
from systems.chemistry.geometry import near_pairs
from systems.errors import PreparationError
from systems.files.outside import check_density
from systems.scene import PARTICLE, FloatArray, IntArray, Scene

# Bonded atoms are nearer than the sum of covalent radii and this.
_TOLERANCE_NM = 0.04
# A bond longer than so many sums of covalent radii is none.
_BOND_STRETCH = 1.3
# More than any bond is longer than the sum of radii.
_SLACK_NM = 0.1


def with_bonds_by_distance(scene: Scene, cell_nm: npt.ArrayLike | None = None) -> Scene:
    """Return the scene with bonds for residues that hold an atom without any, else as it is: two atoms are bonded when
    they, or images of theirs in the cell `(3, 3)` nm (rows a, b, c), are nearer than the sum of their covalent radii
    and 0.04 nm. Ions, rare gases and virtual sites stay alone. Where residues stand in pieces, because a file's atoms
    are shuffled, every atom is looked at, and impossibly long bonds that other programs made of the pieces go."""
    if scene.positions_nm.any() and _are_in_pieces(scene):
        return _all_by_distance(scene)
    virtual = np.array([e == PARTICLE for e in scene.elements])
    bonded = virtual.copy()
    bonded[scene.bonds.ravel()] = True
    residue = scene.residue_of_atom
    size = np.bincount(residue, minlength=len(scene.residue_names))
    open_residues = np.unique(residue[~bonded & (size[residue] > 1)])
    if not len(open_residues) or not scene.positions_nm.any():
        return scene
    atoms = np.flatnonzero(np.isin(residue, open_residues) & ~virtual)
    found = bonds_by_distance([scene.elements[i] for i in atoms], scene.positions_nm[atoms], cell_nm)
    return _with_more(scene, atoms[found])


def _are_in_pieces(scene: Scene) -> bool:
    """Whether a residue comes back after another one with other atoms; with the same ones it is a copy."""
    names: dict[tuple[str, str, str], list[set[str]]] = {}
    pieces: list[set[str]] = [set() for _ in scene.residue_names]
    for name, r in zip(scene.atom_names, scene.residue_of_atom.tolist(), strict=True):
        pieces[r].add(name)
    for key, piece in zip(zip(scene.chain_of_residue, scene.residue_ids, scene.residue_names), pieces, strict=True):
        names.setdefault(key, []).append(piece)
    return any(len(own) > 1 and sum(map(len, own)) == len(set().union(*own)) for own in names.values())


def _all_by_distance(scene: Scene) -> Scene:
    i, j = scene.bonds.T
    length = np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j], axis=1)
    radii = np.array([0.0 if e == PARTICLE else covalent_radius_nm(e) for e in scene.elements])
    good = length < radii[i] + radii[j] + _SLACK_NM
    # Orders and charges that were perceived in wrong bonds are none.
    nothing = np.zeros(int(good.sum())), np.zeros_like(scene.formal_charges)
    kept = replace(scene, bonds=scene.bonds[good], bond_orders=nothing[0], formal_charges=nothing[1])
    atoms = np.flatnonzero([not is_metal(e) and e != PARTICLE for e in scene.elements])
    return _with_more(kept, atoms[bonds_by_distance([scene.elements[k] for k in atoms], scene.positions_nm[atoms])])


def _with_more(scene: Scene, found: IntArray) -> Scene:
    order_of = dict(zip(map(tuple, scene.bonds.tolist()), scene.bond_orders.tolist(), strict=True))
    order_of = dict.fromkeys(map(tuple, found.tolist()), 0.0) | order_of
    rows = sorted(order_of)
    return replace(
        scene,
        bonds=np.array(rows, dtype=np.int64).reshape(-1, 2),
        bond_orders=np.array([order_of[row] for row in rows], dtype=np.float64),
    )


def bonds_by_distance(
    elements: Sequence[str], positions_nm: npt.ArrayLike, cell_nm: npt.ArrayLike | None = None
) -> IntArray:
    """Return the pairs i < j nearer than the sum of their covalent radii and 0.04 nm, by nearest images where a cell
    `(3, 3)` nm is wide enough to tell them apart; hydrogen bonds to its nearest."""
    x = np.asarray(positions_nm, dtype=np.float64)
    radii = np.array([covalent_radius_nm(e) for e in elements])
    reach = 2.0 * float(radii.max(initial=0.0)) + _TOLERANCE_NM
    cell = None if cell_nm is None else np.asarray(cell_nm, dtype=np.float64)
    if cell is not None and abs(np.linalg.det(cell)) > 0.0 and _widths(cell).min() > 2.0 * reach:
        near, length = _near_images(x, cell, reach)
    else:
        near = near_pairs(x, reach, "the molecule")
        length = np.linalg.norm(x[near[:, 0]] - x[near[:, 1]], axis=1)
    close = length < radii[near[:, 0]] + radii[near[:, 1]] + _TOLERANCE_NM
    best: dict[int, tuple[float, int]] = {}
    rows = []
    for (i, j), d in sorted(zip(map(tuple, near[close].tolist()), length[close].tolist(), strict=True)):
        hydrogens = [k for k in (i, j) if elements[k] == "H"]
        if not hydrogens:
            rows.append((i, j))
        for h in hydrogens:
            best[h] = min(best.get(h, (np.inf, -1)), (d, i + j - h))
    rows += [(min(h, k), max(h, k)) for h, (_, k) in best.items()]
    return np.array(sorted(set(rows)), dtype=np.int64).reshape(-1, 2)


def refuse_long_bonds(
    elements: Sequence[str], positions_nm: FloatArray, bonds: npt.ArrayLike, label: Callable[[int], str]
) -> None:
    """Raise PreparationError, which names the longest of them, where bonds `(n, 2)` are longer than any bond is:
    the sum of their covalent radii and 0.04 nm."""
    rows = np.asarray(bonds, dtype=np.int64).reshape(-1, 2)
    radii = np.array([covalent_radius_nm(e) for e in elements])
    length = np.linalg.norm(positions_nm[rows[:, 0]] - positions_nm[rows[:, 1]], axis=1)
    excess = length - radii[rows].sum(axis=1) - _TOLERANCE_NM
    wrong = int((excess > 0).sum())
    if wrong:
        k = int(excess.argmax())
        i, j = rows[k].tolist()
        more = f" ({wrong - 1} more too long)" if wrong > 1 else ""
        raise PreparationError(
            f"the bond {label(i)} - {label(j)} is {10 * length[k]:.2f} Å long{more}: the molecule is broken; make it "
            "whole (unwrap it from its periodic cell, or write the cell into the file), or correct the coordinates."
        )


def changed_bond(scene: Scene, positions_nm: npt.ArrayLike, *, stretch: float = _BOND_STRETCH) -> str:
    """Return what of the scene's bonds does not hold at `positions_nm` (n_atoms, 3), in words; empty where all hold: a
    bond longer than `stretch` sums of covalent radii, or a hydrogen nearest, in units of that sum, to an atom it is not
    bonded to."""
    if not len(scene.bonds):
        return ""
    x = np.asarray(positions_nm, dtype=np.float64)
    radii = np.array([covalent_radius_nm(e) for e in scene.elements])
    length = np.linalg.norm(x[:, None] - x[None], axis=-1)
    reach = length / (radii[:, None] + radii[None])
    np.fill_diagonal(reach, np.inf)
    bonded = np.zeros_like(reach, dtype=bool)
    first, second = scene.bonds.T
    bonded[first, second] = bonded[second, first] = True
    name = scene.atom_names
    for h in (k for k, e in enumerate(scene.elements) if e == "H" and bonded[k].any()):
        nearest, parent = int(np.argmin(reach[h])), int(np.argmin(np.where(bonded[h], reach[h], np.inf)))
        if not bonded[h, nearest]:
            return f"{name[h]} moves from {name[parent]} to {name[nearest]} ({length[h, parent] * 10:.2f} Å away)"
    i, j = scene.bonds[int(np.argmax(reach[first, second]))].tolist()
    return f"{name[i]} - {name[j]} breaks ({length[i, j] * 10:.2f} Å)" if reach[i, j] > stretch else ""


# ---- cells ----------------------------------------------------------------------------------------------------------


# The longest bond that is looked for across a cell. Files without a cell write one of 1 Å; nearest images of bonds are
# only certain where every width of the cell is more than twice their length.
_LONGEST_BOND_NM = 0.35
_LEAST_WIDTH_NM = 2.0 * _LONGEST_BOND_NM
# Water has 100 atoms in a cubic nanometre, diamond 176.
_DENSEST_PER_NM3 = 250.0


def lengths_and_angles(cell_nm: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return `(lengths (n, 3) nm, angles (n, 3) degrees)` of box vectors `(n, 3, 3)` nm (rows a, b, c). Angles are
    alpha (between b and c), beta (a and c) and gamma (a and b)."""
    cell = np.asarray(cell_nm, dtype=np.float64)
    lengths = np.linalg.norm(cell, axis=2)
    unit = cell / lengths[:, :, None]
    pairs = ((1, 2), (0, 2), (0, 1))
    cosines = np.stack([(unit[:, i] * unit[:, j]).sum(axis=1) for i, j in pairs], axis=1)
    # An arc cosine of rounding noise shows 90.00000000000001.
    return lengths, np.round(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))), 10)


def box_vectors(lengths_nm: npt.ArrayLike, angles_deg: npt.ArrayLike) -> FloatArray:
    """Return box vectors `(n, 3, 3)` nm, a along x and b in the xy plane, from `(n, 3)` lengths and angles."""
    lengths = np.asarray(lengths_nm, dtype=np.float64)
    cosine = np.cos(np.radians(np.asarray(angles_deg, dtype=np.float64)))
    cosine[np.abs(cosine) < 1e-7] = 0.0
    alpha, beta, gamma = cosine[:, 0], cosine[:, 1], cosine[:, 2]
    sine_gamma = np.sqrt(1.0 - gamma**2)
    cell = np.zeros((len(lengths), 3, 3))
    cell[:, 0, 0] = 1.0
    cell[:, 1, 0], cell[:, 1, 1] = gamma, sine_gamma
    cell[:, 2, 0], cell[:, 2, 1] = beta, (alpha - beta * gamma) / sine_gamma
    cell[:, 2, 2] = np.sqrt(1.0 - cell[:, 2, 0] ** 2 - cell[:, 2, 1] ** 2)
    scaled: FloatArray = cell * lengths[:, :, None]
    return scaled


def read_cells(lengths_nm: npt.ArrayLike, angles_deg: npt.ArrayLike) -> FloatArray | None:
    """Return the box vectors `(n, 3, 3)` nm of the lengths and angles `(n, 3)` in a file; None where a length is zero,
    as files without a cell have it."""
    lengths = np.asarray(lengths_nm, dtype=np.float64)
    return None if (lengths == 0.0).any() else box_vectors(lengths, angles_deg)


def cell_of(numbers: Sequence[float]) -> FloatArray | None:
    """Return the box vectors `(3, 3)` nm of a, b, c in Å and alpha, beta, gamma in degrees; None where they are none,
    or placeholders."""
    given = np.asarray(numbers, dtype=np.float64)
    if given.shape != (6,) or not np.isfinite(given).all() or (given <= 0).any() or (given[3:] >= 180).any():
        return None
    with np.errstate(invalid="ignore"):
        cell: FloatArray = box_vectors(given[None, :3] / 10.0, given[None, 3:])[0]
    if not np.isfinite(cell).all() or abs(np.linalg.det(cell)) < _LEAST_WIDTH_NM**3:
        return None
    return cell if _widths(cell).min() > _LEAST_WIDTH_NM else None


def images_of_whole(positions_nm: FloatArray, cell_nm: FloatArray, pairs: IntArray) -> IntArray:
    """Return how many of each cell vector to add to each atom, `(n_atoms, 3)`, so that all `pairs` `(n, 2)` are at
    their nearest images; the largest uncut part of each molecule stays where it is. A molecule that is bonded to an
    image of itself is left as it is."""
    n = len(positions_nm)
    images = np.zeros((n, 3), dtype=np.int64)
    steps = -np.rint((positions_nm[pairs[:, 1]] - positions_nm[pairs[:, 0]]) @ np.linalg.inv(cell_nm)).astype(np.int64)
    cut = steps.any(axis=1)
    if not cut.any():
        return images
    uncut = nx.Graph(pairs[~cut].tolist())
    uncut.add_nodes_from(range(n))
    parts = [sorted(part) for part in nx.connected_components(uncut)]
    part_of = {i: k for k, part in enumerate(parts) for i in part}
    joined = nx.Graph()
    for (i, j), step in zip(pairs[cut].tolist(), steps[cut], strict=True):
        a, b = part_of[i], part_of[j]
        if a != b:
            joined.add_edge(a, b, first=a, step=step)
    for molecule in nx.connected_components(joined):
        start = max(molecule, key=lambda k: (len(parts[k]), -parts[k][0]))
        for a, b in nx.bfs_edges(joined, start):
            edge = joined.edges[a, b]
            images[parts[b]] = images[parts[a][0]] + (edge["step"] if edge["first"] == a else -edge["step"])
    return images


def bonded_images(
    elements: Sequence[str], positions_nm: FloatArray, cell_nm: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Return the pairs i < j `(n, 2)` any images of which are within a bond's length, and the distances `(n,)` nm.
    Metals are bonded to nothing. In a cell too small for its atoms, which is another structure's, there are none.
    Raises PreparationError where most atoms stand in each other."""
    if len(elements) > _DENSEST_PER_NM3 * abs(float(np.linalg.det(cell_nm))):
        return np.empty((0, 2), dtype=np.int64), np.empty(0)
    pairs, length = _near_images(positions_nm, cell_nm, _LONGEST_BOND_NM)
    radii = np.array([-1.0 if is_metal(e) else covalent_radius_nm(e) for e in elements])
    near = length < np.minimum(radii[pairs].sum(axis=1) + _TOLERANCE_NM, _LONGEST_BOND_NM)
    return pairs[near], length[near]


def _near_images(positions_nm: FloatArray, cell_nm: FloatArray, reach_nm: float) -> tuple[IntArray, FloatArray]:
    """Return the pairs i < j `(n, 2)`, ascending, whose nearest images may be within `reach_nm`, and how far apart
    these are `(n,)` nm; every width of the cell must be more than twice that."""
    from scipy.spatial import cKDTree

    widths, inverse = _widths(cell_nm), np.linalg.inv(cell_nm)
    # Heights above the faces: none differs by more than the distance, so a box of theirs holds the sphere.
    heights = np.mod(positions_nm @ inverse, 1.0) * widths
    heights[heights >= widths] = 0.0
    tree = cKDTree(heights, boxsize=widths)
    check_density(tree, reach_nm, "the structure")
    pairs = np.sort(tree.query_pairs(reach_nm, p=np.inf, output_type="ndarray").reshape(-1, 2).astype(np.int64), axis=1)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    apart = positions_nm[pairs[:, 1]] - positions_nm[pairs[:, 0]]
    return pairs, np.linalg.norm(apart - np.rint(apart @ inverse) @ cell_nm, axis=1)


def _widths(cell_nm: FloatArray) -> FloatArray:
    """Distances `(3,)` nm between opposite faces."""
    widths: FloatArray = 1.0 / np.linalg.norm(np.linalg.inv(cell_nm), axis=0)
    return widths
