"""Hydrogen bonds: which triplets can form one, and in which frames they do."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from systems.chemistry.geometry import FloatArray, squared_distance
from systems.scene import Scene

IntArray = npt.NDArray[np.int64]

MAX_LENGTH_NM = 0.25
MIN_ANGLE_COSINE = -0.5


def find_triplets(scene: Scene) -> IntArray:
    """Return all (donor, hydrogen, acceptor) `(k, 3)`: donors and acceptors are N and O at least three bonds apart."""
    from systems.chemistry.graph import bonded_graph, exclusions

    graph = bonded_graph(scene)
    polar = [i for i, e in enumerate(scene.elements) if e in ("N", "O")]
    near = {tuple(p) for p in exclusions(scene, depth=2).tolist()}
    rows = [
        (donor, hydrogen, acceptor)
        for donor in polar
        for hydrogen in sorted(graph[donor])
        if scene.elements[hydrogen] == "H"
        for acceptor in polar
        if acceptor != donor and (min(donor, acceptor), max(donor, acceptor)) not in near
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, 3)


def is_formed(columns: FloatArray, triplets: IntArray) -> npt.NDArray[np.bool_]:
    """Return `(k, n)`: whether each triplet is a hydrogen bond in each frame of coordinates `(3, n_atoms, n)` nm.

    H...A below 0.25 nm and D-H...A above 120°: Baker and Hubbard, Prog. Biophys. Mol. Biol. 44, 97 (1984), as in
    `mdtraj.baker_hubbard`. Frames that are not finite form none.
    """
    donor, hydrogen, acceptor = triplets.T
    with np.errstate(invalid="ignore", over="ignore"):
        to_acceptor = squared_distance(columns, triplets[:, 1:])
        to_donor = squared_distance(columns, triplets[:, :2])
        along = np.zeros_like(to_acceptor)
        for axis in columns:
            along += (axis[donor] - axis[hydrogen]) * (axis[acceptor] - axis[hydrogen])
        bent = along < MIN_ANGLE_COSINE * np.sqrt(to_acceptor * to_donor)
        formed: npt.NDArray[np.bool_] = bent & (to_acceptor < MAX_LENGTH_NM**2)
    return formed


def triplet_label(scene: Scene, triplet: npt.ArrayLike) -> str:
    """Return a name for people: 'N-H (NME 3) ... O (ACE 1)'."""
    donor, hydrogen, acceptor = (int(i) for i in np.asarray(triplet))

    def where(atom: int) -> str:
        residue = int(scene.residue_of_atom[atom])
        return f"({scene.residue_names[residue]} {scene.residue_ids[residue]})"

    names = scene.atom_names
    return f"{names[donor]}-{names[hydrogen]} {where(donor)} ... {names[acceptor]} {where(acceptor)}"
