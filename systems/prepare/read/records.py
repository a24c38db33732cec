"""Atom records: what a structure file says of each atom, in the order and under the names of the file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

# Narrower than float(), which also takes 1_0.5, tabs and the digits of other alphabets.
_COORDINATE = re.compile(r" *[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)? *|\s*[-+]?(nan|inf)\w*\s*", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True)
class AtomRecord:
    """One ATOM or HETATM record; positions in Å as the file has them."""

    serial: str
    name: str
    altloc: str
    residue_name: str
    chain: str
    residue_id: str
    position_angstrom: tuple[float, float, float]
    occupancy: float
    element: str
    hetero: bool

    @property
    def residue_key(self) -> tuple[str, str, str]:
        """(chain, residue number with insertion code, residue name)."""
        return self.chain, self.residue_id, self.residue_name


@dataclass
class StructureFile:
    """The first model of a structure file: records in the file's order, the bonds it states, and what was passed over.

    `conect` holds the pairs of CONECT, LINK and SSBOND records (`_struct_conn` in mmCIF), `chain_ends` the atoms that a
    TER record follows, or with which a chain of mmCIF ends. An atom whose element is not known has the element "", and
    `unknown` says where it stands. `cell_nm`: box vectors `(3, 3)` of a periodic cell, None where the file has none.
    """

    atoms: list[AtomRecord]
    conect: list[tuple[int, int]] = field(default_factory=list)
    chain_ends: set[int] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)
    unknown: dict[int, str] = field(default_factory=dict)
    cell_nm: npt.NDArray[np.float64] | None = None


def coordinates(fields: Sequence[str]) -> tuple[float, float, float] | None:
    """Return three coordinates written as plain decimal numbers, or None where one is written otherwise."""
    if not all(_COORDINATE.fullmatch(text) for text in fields):
        return None
    x, y, z = (float(text) for text in fields)
    return x, y, z
