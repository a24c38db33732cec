"""Trajectory files of a chain of carbons with random frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer

SUFFIXES = (".h5", ".dcd", ".xtc")
# Of positions, nm: what each keeps.
TOLERANCES = {".h5": (0.0, 0.0), ".dcd": (3e-7, 0.0), ".xtc": (3e-7, 5.1e-4)}
RECORD = {"kind": "reference", "timestep_ps": 0.004, "save_every_ps": 1.0, "seed": 7, "completed": False}


def chain(n_atoms: int, *, name: str = "chain") -> Scene:
    """A chain of carbons, one residue for every two atoms."""
    n_residues = (n_atoms + 1) // 2
    return Scene(
        name=name,
        atom_names=tuple(f"C{i + 1}" for i in range(n_atoms)),
        elements=("C",) * n_atoms,
        residue_of_atom=np.arange(n_atoms) // 2,
        residue_names=("UNK",) * n_residues,
        residue_ids=tuple(str(i + 1) for i in range(n_residues)),
        chain_of_residue=("A",) * n_residues,
        bonds=np.array([(i, i + 1) for i in range(n_atoms - 1)], dtype=np.int64).reshape(-1, 2),
        bond_orders=np.ones(max(n_atoms - 1, 0)),
        formal_charges=np.zeros(n_atoms, dtype=np.int64),
        masses_da=np.full(n_atoms, 12.011),
        positions_nm=np.arange(3.0 * n_atoms).reshape(n_atoms, 3) * 0.1,
    )


def frames(n: int, n_atoms: int = 5, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, n_atoms, 3)).astype(np.float32)


def write(path: Path, n: int = 10, *, n_atoms: int = 5, block: int = 4, **keywords: Any) -> np.ndarray:
    positions = frames(n, n_atoms)
    with open_writer(path, chain(n_atoms), RECORD, **keywords) as writer:
        for k in range(0, n, block):
            part = positions[k : k + block]
            writer.append(part, np.arange(k, k + len(part)) + 1.0)
    return positions


def read(path: Path, **keywords: Any) -> np.ndarray:
    with open_trajectory(path, **keywords) as reader:
        return reader.read()


def left_behind(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())
