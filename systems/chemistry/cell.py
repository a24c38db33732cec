"""Periodic cells: box vectors from lengths and angles, and back; nearest images, and molecules whole in a cell."""

from __future__ import annotations

from collections.abc import Sequence

import networkx as nx
import numpy as np
import numpy.typing as npt

from systems.chemistry.element_data import covalent_radius_nm, is_metal
from systems.files.outside import check_density

Float64Array = npt.NDArray[np.float64]


def lengths_and_angles(cell_nm: npt.ArrayLike) -> tuple[Float64Array, Float64Array]:
    """Return `(lengths (n, 3) nm, angles (n, 3) degrees)` of box vectors `(n, 3, 3)` nm (rows a, b, c).

    Angles are alpha (between b and c), beta (a and c) and gamma (a and b).
    """
    cell = np.asarray(cell_nm, dtype=np.float64)
    lengths = np.linalg.norm(cell, axis=2)
    unit = cell / lengths[:, :, None]
    pairs = ((1, 2), (0, 2), (0, 1))
    cosines = np.stack([(unit[:, i] * unit[:, j]).sum(axis=1) for i, j in pairs], axis=1)
    # An arc cosine of rounding noise shows 90.00000000000001.
    return lengths, np.round(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))), 10)


def box_vectors(lengths_nm: npt.ArrayLike, angles_deg: npt.ArrayLike) -> Float64Array:
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
    scaled: Float64Array = cell * lengths[:, :, None]
    return scaled


def read_cells(lengths_nm: npt.ArrayLike, angles_deg: npt.ArrayLike) -> Float64Array | None:
    """Return the box vectors `(n, 3, 3)` nm of the lengths and angles `(n, 3)` in a file; None where a length is zero,
    as files without a cell have it."""
    lengths = np.asarray(lengths_nm, dtype=np.float64)
    return None if (lengths == 0.0).any() else box_vectors(lengths, angles_deg)


# ---- images ---------------------------------------------------------------------------------------------------------


FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

# The longest bond that is looked for. Files without a cell write one of 1 Å; nearest images of bonds are only certain
# where every width of the cell is more than twice their length.
_LONGEST_BOND_NM = 0.35
_LEAST_WIDTH_NM = 2.0 * _LONGEST_BOND_NM
_BOND_SLACK_NM = 0.04
# Water has 100 atoms in a cubic nanometre, diamond 176.
_DENSEST_PER_NM3 = 250.0


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
    their nearest images; the largest uncut part of each molecule stays where it is.

    A molecule that is bonded to an image of itself has no such place, and is left as it is.
    """
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

    That is the sum of covalent radii and 0.04 nm; metals are bonded to nothing. In a cell too small for its atoms,
    which is another structure's, there are none. Raises PreparationError where most atoms stand in each other.
    """
    if len(elements) > _DENSEST_PER_NM3 * abs(float(np.linalg.det(cell_nm))):
        return np.empty((0, 2), dtype=np.int64), np.empty(0)
    from scipy.spatial import cKDTree

    widths, inverse = _widths(cell_nm), np.linalg.inv(cell_nm)
    # Heights above the faces: none differs by more than the distance, so a box of theirs holds the sphere.
    heights = np.mod(positions_nm @ inverse, 1.0) * widths
    heights[heights >= widths] = 0.0
    tree = cKDTree(heights, boxsize=widths)
    check_density(tree, _LONGEST_BOND_NM, "the structure")
    pairs = tree.query_pairs(_LONGEST_BOND_NM, p=np.inf, output_type="ndarray").reshape(-1, 2).astype(np.int64)
    apart = positions_nm[pairs[:, 1]] - positions_nm[pairs[:, 0]]
    length = np.linalg.norm(apart - np.rint(apart @ inverse) @ cell_nm, axis=1)
    radii = np.array([-1.0 if is_metal(e) else covalent_radius_nm(e) for e in elements])
    near = length < np.minimum(radii[pairs].sum(axis=1) + _BOND_SLACK_NM, _LONGEST_BOND_NM)
    pairs, length = np.sort(pairs[near], axis=1), length[near]
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    return pairs[order], length[order]


def _widths(cell_nm: FloatArray) -> FloatArray:
    """Distances `(3,)` nm between opposite faces."""
    widths: FloatArray = 1.0 / np.linalg.norm(np.linalg.inv(cell_nm), axis=0)
    return widths
