"""Scenes of a few atoms, and turns about their bonds."""

from __future__ import annotations

import numpy as np

from systems.scene import Scene


def scene_of(elements: str, bonds: list[tuple[int, int, float]], positions_nm: np.ndarray) -> Scene:
    n = len(elements)
    return Scene(
        name="made",
        atom_names=tuple(f"{e}{i + 1}" for i, e in enumerate(elements)),
        elements=tuple(elements),
        residue_of_atom=np.zeros(n, dtype=np.int64),
        residue_names=("LIG",),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=np.array([b[:2] for b in bonds], dtype=np.int64).reshape(-1, 2),
        bond_orders=np.array([b[2] for b in bonds], dtype=np.float64),
        formal_charges=np.zeros(n, dtype=np.int64),
        masses_da=np.full(n, 12.0),
        positions_nm=positions_nm,
    )


def benzene() -> Scene:
    angles = np.arange(6) * np.pi / 3
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(6)], axis=1)
    bonds = [(k, (k + 1) % 6, 1.5) for k in range(6)] + [(k, k + 6, 1.0) for k in range(6)]
    ordered = [(min(i, j), max(i, j), o) for i, j, o in bonds]
    return scene_of("CCCCCCHHHHHH", ordered, np.concatenate([0.14 * ring, 0.248 * ring]))


def difluoroethene() -> Scene:
    """Trans FHC=CHF, flat."""
    positions = np.array(
        [[-0.066, 0, 0], [0.066, 0, 0], [-0.135, 0.115, 0], [0.135, -0.115, 0], [-0.12, -0.094, 0], [0.12, 0.094, 0]]
    )
    bonds = [(0, 1, 2.0), (0, 2, 1.0), (1, 3, 1.0), (0, 4, 1.0), (1, 5, 1.0)]
    return scene_of("CCFFHH", bonds, positions)


def rotated(positions: np.ndarray, atoms: list[int], axis: tuple[int, int], angle: float) -> np.ndarray:
    """Turn `atoms` about the bond `axis`."""
    origin, end = positions[axis[0]], positions[axis[1]]
    k = (end - origin) / np.linalg.norm(end - origin)
    v = positions[atoms] - origin
    out = positions.copy()
    out[atoms] = origin + v * np.cos(angle) + np.cross(k, v) * np.sin(angle) + np.outer(v @ k, k) * (1 - np.cos(angle))
    return out


def turn_frames(x: np.ndarray, i: int, j: int, atoms: list[int], angle: np.ndarray) -> None:
    """Turn `atoms` of every frame `(n, n_atoms, 3)` about the axis i -> j by `angle` `(n,)`, in place (Rodrigues)."""
    axis = x[:, j] - x[:, i]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    v = x[:, atoms] - x[:, j : j + 1]
    k = axis[:, None]
    c, s = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
    x[:, atoms] = v * c + np.cross(k, v) * s + k * (k * v).sum(-1, keepdims=True) * (1 - c) + x[:, j : j + 1]


def beyond(scene: Scene, start: int, end: int) -> list[int]:
    """Atoms on the side of `end` of the bond from `start` to `end`."""
    from systems.chemistry.graph import bonded_graph

    graph = bonded_graph(scene).copy()
    graph.remove_edge(start, end)
    import networkx as nx

    return sorted(nx.node_connected_component(graph, end))


def with_phi_turned(scene: Scene, kind: str = "phi") -> np.ndarray:
    """Every phi turned by half a circle: strands become left-handed; or every torsion of another kind."""
    from systems.chemistry.graph import backbone_torsions

    positions = scene.positions_nm
    for _, start, end, _ in backbone_torsions(scene)[kind].tolist():
        positions = rotated(positions, beyond(scene, start, end), (start, end), np.pi)
    return positions


def stretched(scene: Scene, by_nm: float) -> np.ndarray:
    """The first bond that ends in one atom alone, longer by `by_nm`."""
    i, j = next((i, j) for i, j in scene.bonds.tolist() if beyond(scene, i, j) == [j])
    positions = scene.positions_nm.copy()
    step = positions[j] - positions[i]
    positions[j] += by_nm * step / np.linalg.norm(step)
    return positions


def n_unpaired_electrons(scene: Scene) -> int:
    """Return the number of unpaired electrons that the scene's bonds and charges leave (0 for closed shells).

    Raises PreparationError where the bond orders are not known.
    """
    from rdkit_of_scene import to_rdkit

    return sum(atom.GetNumRadicalElectrons() for atom in to_rdkit(scene).GetAtoms())
