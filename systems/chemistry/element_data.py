"""Elements: atomic weight, covalent radius, whether a metal (by gemmi), and the element of a PDB atom name."""

from __future__ import annotations

from functools import cache
from typing import Any

from systems.chemistry.residues import NAMES, template_for
from systems.interrupts import deferred_interrupt
from systems.scene import ATOMIC_NUMBERS

# Standard atomic weights in Da, IUPAC 2021 abridged. gemmi's are older (sulfur 32.065, not 32.06), and the masses of
# these elements are inputs of shipped weights.
_WEIGHTS_DA = {
    "H": 1.008, "He": 4.0026, "Li": 6.94, "Be": 9.0122, "B": 10.81, "C": 12.011, "N": 14.007, "O": 15.999,
    "F": 18.998, "Ne": 20.18, "Na": 22.99, "Mg": 24.305, "Al": 26.982, "Si": 28.085, "P": 30.974, "S": 32.06,
    "Cl": 35.45, "Ar": 39.95, "K": 39.098, "Ca": 40.078, "Sc": 44.956, "Ti": 47.867, "V": 50.942, "Cr": 51.996,
    "Mn": 54.938, "Fe": 55.845, "Co": 58.933, "Ni": 58.693, "Cu": 63.546, "Zn": 65.38, "Ga": 69.723, "Ge": 72.63,
    "As": 74.922, "Se": 78.971, "Br": 79.904, "Kr": 83.798, "Rb": 85.468, "Sr": 87.62, "Mo": 95.95, "Ru": 101.07,
    "Rh": 102.91, "Pd": 106.42, "Ag": 107.87, "Cd": 112.41, "Sn": 118.71, "Sb": 121.76, "Te": 127.6, "I": 126.9,
    "Xe": 131.29, "Cs": 132.91, "Ba": 137.33, "Pt": 195.08, "Au": 196.97, "Hg": 200.59, "Pb": 207.2,
}  # fmt: skip
# Covalent radii in nm where Cordero et al. (Dalton Trans. 2008, 2832) give several, of which gemmi has the smallest:
# sp3 carbon, high spin.
_RADII_NM = {"C": 0.076, "Mn": 0.150, "Fe": 0.142, "Co": 0.138}
# Elements whose names are seldom the beginning of another atom's: these are also known by an atom's name alone.
_COMMON = frozenset(_WEIGHTS_DA)
_ANY_ION = ("ION", "IONS", "IO", "CIO", "IP", "IM", "CIP", "CIM")
_HALOGENS = ("F", "Cl", "Br", "I")
_UNNAMED_RESIDUES = ("UNL", "UNK", "LIG", "MOL", "DRG")
_TWO_LETTER_IN_LIGANDS = ("Cl", "Br", "Si", "Se", "Na", "Mg", "Zn", "Fe", "Li", "As")


def atomic_weight_da(symbol: str) -> float:
    """Standard atomic weight in dalton. Raises KeyError for what is no element."""
    return _WEIGHTS_DA.get(symbol) or float(_element(symbol).weight)


def covalent_radius_nm(symbol: str) -> float:
    """Covalent radius in nm. Raises KeyError for what is no element."""
    return _RADII_NM.get(symbol) or round(_element(symbol).covalent_r / 10.0, 4)


def is_metal(symbol: str) -> bool:
    """Whether this is the symbol of a metal."""
    return symbol in ATOMIC_NUMBERS and bool(_element(symbol).is_metal)


@cache
def _element(symbol: str) -> Any:
    if symbol not in ATOMIC_NUMBERS:
        raise KeyError(symbol)
    # A Ctrl-C while gemmi is imported would abort the process.
    with deferred_interrupt() as asked:
        from gemmi import Element
    if asked():
        raise KeyboardInterrupt
    return Element(symbol)


def is_lone_ion(symbol: str) -> bool:
    """Whether a lone atom of this element is an ion: a metal or a halide."""
    return is_metal(symbol) or symbol in _HALOGENS


def ion_symbol(name: str) -> str | None:
    """Return the element of a monatomic ion by its name (`SOD`, `Na+`, `CL-`, `ZN2`, `MG`), or None."""
    upper = name.strip().upper()
    bare = upper.rstrip("+-").rstrip("0123456789").rstrip("+-") or upper
    symbol = NAMES["ions"].get(upper, bare.capitalize())
    return symbol if symbol in _COMMON and is_lone_ion(symbol) else None


def repeats_name(name_field: str, residue_name: str, symbol: str) -> bool:
    """Whether an element column repeats the atom's name: Ca for the alpha carbon, Hg for a hydrogen of a side chain."""
    if len(symbol) < 2 or symbol == "Se" or not name_field.strip().upper().startswith(symbol.upper()):
        return False
    return template_for(residue_name) is not None


def element_symbol(name_field: str, residue_name: str, written: str, *, hetero: bool = False) -> str | None:
    """Return the element of an atom from the element column or, failing this, from its PDB name; None when unknown.

    `written` is the element column, whatever its case; `name_field` the atom name, which may start with digits
    (`1HH3`). `CA` is calcium in a residue called CA and carbon elsewhere; an atom called as its residue is the ion of
    that name whatever the column says (programs that guess make sulfur of sodium's SOD).
    """
    ion = ion_symbol(name_field)
    if ion is not None and (residue_name.upper() in _ANY_ION or ion == ion_symbol(residue_name)):
        return ion
    symbol = written.strip("0123456789+- ").capitalize()
    if symbol == "D":
        return "H"
    if _is_stated(symbol, name_field) and not repeats_name(name_field, residue_name, symbol):
        return symbol
    name = name_field.strip().upper()
    letters = name.lstrip("0123456789'\"*")
    if not letters or not letters[0].isalpha():
        return None
    residue = residue_name.upper()
    two = letters[:2].capitalize()
    # The columns of PDB files put an element's second letter where a nitrogen called NA has its first.
    numbered = len(letters) == 2 or letters[2:].isdigit()
    halogen = two in ("Cl", "Br") and numbered
    other = (hetero or residue in _UNNAMED_RESIDUES) and not name_field.startswith(" ")
    other = other and (numbered or two != "Na")  # nitrogens are called NAA, NAB, ... where letters count
    if (halogen or other) and two in _TWO_LETTER_IN_LIGANDS and template_for(residue) is None:
        return two
    if residue in ("MSE", "SEC") and two == "Se":
        return two
    first = "H" if letters[0] == "D" and name != letters else letters[0]
    return first if first in _COMMON else (two if two in _COMMON else None)


def _is_stated(symbol: str, name_field: str) -> bool:
    """Whether an element column is believed. A rare element whose symbol also begins a usual name (HO: holmium, or the
    hydrogen HO2 of a program that fills the column with names) must be the atom's whole name."""
    if symbol in _COMMON or symbol not in ATOMIC_NUMBERS:
        return symbol in _COMMON
    return name_field.strip().upper() == symbol.upper() or symbol[0] not in "BCFHNOPS"
