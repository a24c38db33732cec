"""AMBER parameter files (prmtop) of one molecule: read, checked against a scene, and put into another atom order."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import InputError

IntArray = npt.NDArray[np.int64]

# (section, atoms in a record, numbers in a record); atom numbers are stored as 3 (i - 1).
_TERMS = (("BONDS", 2, 3), ("ANGLES", 3, 4), ("DIHEDRALS", 4, 5))
_PER_ATOM = (
    "ATOM_NAME", "CHARGE", "ATOMIC_NUMBER", "MASS", "ATOM_TYPE_INDEX", "AMBER_ATOM_TYPE", "TREE_CHAIN_CLASSIFICATION",
    "JOIN_ARRAY", "IROTAT", "RADII", "SCREEN",
)  # fmt: skip
# Amber's unit of charge: sqrt(kcal/mol Å) per elementary charge.
CHARGE_UNIT = 18.2223


class Prmtop:
    """The sections of a prmtop file: `fields[name]` is a list of numbers or of strings, in the file's own units.

    Raises InputError for text that is no prmtop of this kind (one molecule, no polarisability, no CMAP).
    """

    def __init__(self, text: str) -> None:
        self.fields: dict[str, list[Any]] = {}
        self._formats: dict[str, str] = {}
        self._head = text.partition("%FLAG")[0]
        for block in text.split("%FLAG")[1:]:
            lines = [line for line in block.splitlines() if not line.startswith("%COMMENT")]
            name, form = lines[0].strip(), lines[1].strip()
            match = re.fullmatch(r"%FORMAT\((\d+)([aEIei])(\d+)(?:\.\d+)?\)", form)
            if match is None:
                raise InputError(f"prmtop section {name} has an unknown format {form}.")
            width = int(match[3])
            cells = [line[k : k + width] for line in lines[2:] for k in range(0, len(line.rstrip("\n")), width)]
            kind = match[2].lower()
            convert: Any = {"a": str.strip, "i": int, "e": float}[kind]
            self.fields[name] = [convert(c) for c in cells if kind == "a" or c.strip()]
            self._formats[name] = form
        needed = {"POINTERS", "DIHEDRALS_INC_HYDROGEN", "EXCLUDED_ATOMS_LIST", *_PER_ATOM} - set(self.fields)
        if needed:
            raise InputError(f"not an AMBER prmtop file: it lacks {', '.join(sorted(needed))}.")
        n = self.n_atoms
        for name in _PER_ATOM:
            self.fields[name] = self.fields[name][:n]
            if len(self.fields[name]) != n:
                raise InputError(f"prmtop section {name} has {len(self.fields[name])} entries for {n} atoms.")
        if any("CMAP" in name for name in self.fields):
            raise InputError("a prmtop file with CMAP terms cannot be reordered.")

    @property
    def n_atoms(self) -> int:
        return int(self.fields["POINTERS"][0])

    @property
    def charges_e(self) -> npt.NDArray[np.float64]:
        """Partial charges `(n_atoms,)` in elementary charges."""
        return np.array(self.fields["CHARGE"], dtype=np.float64) / CHARGE_UNIT

    @property
    def bonds(self) -> set[tuple[int, int]]:
        """Bonded pairs, i < j, from 0."""
        flat = self.fields["BONDS_INC_HYDROGEN"] + self.fields["BONDS_WITHOUT_HYDROGEN"]
        pairs = ((flat[k] // 3, flat[k + 1] // 3) for k in range(0, len(flat), 3))
        return {(min(pair), max(pair)) for pair in pairs}

    def permuted(self, order: IntArray) -> Prmtop:
        """Return the same molecule with its atom k in place `order[k]`; every energy stays what it was."""
        out = object.__new__(Prmtop)
        out._head, out._formats = self._head, self._formats
        out.fields = {name: list(values) for name, values in self.fields.items()}
        to = [int(i) for i in order]
        for name in _PER_ATOM:
            for k, value in enumerate(self.fields[name]):
                out.fields[name][to[k]] = value
        for prefix, n_indices, width in _TERMS:
            for suffix in ("_INC_HYDROGEN", "_WITHOUT_HYDROGEN"):
                flat = out.fields[prefix + suffix]
                for start in range(0, len(flat), width):
                    flat[start : start + n_indices] = _moved(flat[start : start + n_indices], to)
        out.fields["NUMBER_EXCLUDED_ATOMS"], out.fields["EXCLUDED_ATOMS_LIST"] = self._exclusions(to)
        return out

    def _exclusions(self, to: list[int]) -> tuple[list[int], list[int]]:
        n = self.n_atoms
        later: list[list[int]] = [[] for _ in range(n)]
        partners = iter(self.fields["EXCLUDED_ATOMS_LIST"])
        for i, count in enumerate(self.fields["NUMBER_EXCLUDED_ATOMS"]):
            for _ in range(count):
                j = next(partners)
                if j > 0:
                    a, b = sorted((to[i], to[j - 1]))
                    later[a].append(b + 1)
        # An atom without later partners still has one entry, a zero.
        rows = [sorted(row) or [0] for row in later]
        return [len(row) for row in rows], [j for row in rows for j in row]

    def text(self) -> str:
        """Return the file as text."""
        parts = [self._head]
        for name, values in self.fields.items():
            form = self._formats[name]
            match = re.fullmatch(r"%FORMAT\((\d+)([aEIei])(\d+)(?:\.(\d+))?\)", form)
            assert match is not None
            per_line, kind, width = int(match[1]), match[2].lower(), int(match[3])
            spec = {"a": f"<{width}", "i": f">{width}", "e": f">{width}.{match[4]}E"}[kind]
            cells = [format(v, spec) for v in values]
            lines = ["".join(cells[k : k + per_line]) for k in range(0, len(cells), per_line)] or [""]
            parts.append("\n".join([f"%FLAG {name:<74}", f"{form:<80}", *lines]) + "\n")
        return "".join(parts)


def _moved(indices: list[int], to: list[int]) -> list[int]:
    """One term's stored atom numbers at their new places; the signs of a dihedral stay at its third and fourth atom.

    A negative third number says that the 1-4 pair is counted elsewhere, a negative fourth that the term is improper.
    Zero has no sign, so a dihedral whose third or fourth atom is the first of the file is written backwards.
    """
    new = [3 * to[abs(i) // 3] for i in indices]
    if len(indices) < 4:
        return new
    if 0 in new[2:]:
        new.reverse()
    return new[:2] + [-i if old < 0 else i for i, old in zip(new[2:], indices[2:], strict=True)]


def load_openmm(text: str) -> Any:
    """Return OpenMM's own reader (`openmm.app.AmberPrmtopFile`) of a prmtop given as text."""
    from openmm import app

    with tempfile.TemporaryDirectory(prefix="surromd-") as folder:
        path = Path(folder) / "molecule.prmtop"
        path.write_text(text)
        return app.AmberPrmtopFile(str(path))
