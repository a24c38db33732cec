"""Atoms that are close and not bonded: noted, for minimising parts them, or refused where they coincide."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from systems.chemistry.geometry import near_pairs
from systems.errors import PreparationError
from systems.prepare.read.records import AtomRecord
from systems.prepare.structure import atom_label

# Nearer than this two atoms have one place, and nothing says which way they part.
_COINCIDE_ANGSTROM = 0.1
# Heavy atoms, a heavy atom and a hydrogen, hydrogens: models have them before any refinement. Whether bonds and
# stereocentres survive the minimisation is seen then (`md_reference.run.engine.refuse_damaged`).
_CLOSE_ANGSTROM = (1.5, 1.1, 0.9)


def check_contacts(atoms: Sequence[AtomRecord], bonds: npt.NDArray[np.int64]) -> list[str]:
    """Return a note of atoms that are close, with more than three bonds between them; none where all keep apart.

    Raises PreparationError for atoms that have the same place.
    """
    neighbours: dict[int, set[int]] = {}
    for i, j in bonds.tolist():
        neighbours.setdefault(i, set()).add(j)
        neighbours.setdefault(j, set()).add(i)
    x = np.array([a.position_angstrom for a in atoms])
    found = []
    for i, j in near_pairs(x, max(_CLOSE_ANGSTROM), "the structure").tolist():
        gap = float(np.linalg.norm(x[i] - x[j]))
        kind = sum(atoms[k].element == "H" for k in (i, j))
        if gap < _CLOSE_ANGSTROM[kind] and not _is_near(neighbours, i, j):
            found.append((gap, i, j))
    if not found:
        return []
    gap, i, j = min(found)
    more = f", and {len(found) - 1} pairs more are close" if len(found) > 1 else ""
    what = f"{atom_label(atoms[i])} and {atom_label(atoms[j])} are {gap:.2f} Å apart and not bonded{more}"
    if gap < _COINCIDE_ANGSTROM:
        raise PreparationError(f"{what}: atoms have the same place; take one of them out, or model them again.")
    return [f"{what}; minimising has to part them"]


def _is_near(neighbours: dict[int, set[int]], i: int, j: int, n_bonds: int = 3) -> bool:
    reached = {i}
    for _ in range(n_bonds):
        reached |= {b for a in reached for b in neighbours.get(a, ())}
    return j in reached
