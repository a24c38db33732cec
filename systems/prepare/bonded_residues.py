"""Residues of a structure file and the bonds between its atoms, as `systems.prepare.bonding` finds them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from systems.chemistry.residues import ResidueTemplate


@dataclass
class Residue:
    """All atoms of one residue, wherever they stand in the file. `heavy` is empty when the names fit no template."""

    key: tuple[str, str, str]
    atoms: list[int]
    template: ResidueTemplate | None
    heavy: dict[str, int] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    lacks_hydrogens: bool = False

    @property
    def label(self) -> str:
        return f"{self.key[2]} {self.key[0]}{self.key[1]}"


@dataclass
class Bonding:
    """Bonds `(n_bonds, 2)`, the residues in the order of the file, and an account of where bonds came from.

    `peptide_bonds` are the pairs (C, N) that join standard residues, `unmade` the bonds that the file states and that
    are none.
    """

    bonds: npt.NDArray[np.int64]
    residues: list[Residue]
    notes: list[str]
    peptide_bonds: set[tuple[int, int]]
    unmade: list[str] = field(default_factory=list)

    @property
    def neighbours(self) -> list[list[int]]:
        """Of each atom the atoms that it is bonded to."""
        near: list[list[int]] = [[] for _ in range(sum(len(r.atoms) for r in self.residues))]
        for i, j in self.bonds.tolist():
            near[i].append(j)
            near[j].append(i)
        return near

    @property
    def is_complete(self) -> bool:
        """Whether no residue that is known by its name lacks an atom."""
        return not any(r.missing or r.lacks_hydrogens for r in self.residues)
