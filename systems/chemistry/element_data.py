"""Atomic weights, covalent radii, and the element of a PDB atom name."""

from __future__ import annotations

from systems.chemistry.residues import template_for

# Symbol: (standard atomic weight in Da, IUPAC 2021 abridged; covalent radius in nm, Cordero et al., Dalton 2008, 2832).
_TABLE: dict[str, tuple[float, float]] = {
    "H": (1.008, 0.031), "He": (4.0026, 0.028), "Li": (6.94, 0.128), "Be": (9.0122, 0.096), "B": (10.81, 0.084),
    "C": (12.011, 0.076), "N": (14.007, 0.071), "O": (15.999, 0.066), "F": (18.998, 0.057), "Ne": (20.180, 0.058),
    "Na": (22.990, 0.166), "Mg": (24.305, 0.141), "Al": (26.982, 0.121), "Si": (28.085, 0.111), "P": (30.974, 0.107),
    "S": (32.06, 0.105), "Cl": (35.45, 0.102), "Ar": (39.95, 0.106), "K": (39.098, 0.203), "Ca": (40.078, 0.176),
    "Sc": (44.956, 0.170), "Ti": (47.867, 0.160), "V": (50.942, 0.153), "Cr": (51.996, 0.139), "Mn": (54.938, 0.150),
    "Fe": (55.845, 0.142), "Co": (58.933, 0.138), "Ni": (58.693, 0.124), "Cu": (63.546, 0.132), "Zn": (65.38, 0.122),
    "Ga": (69.723, 0.122), "Ge": (72.630, 0.120), "As": (74.922, 0.119), "Se": (78.971, 0.120), "Br": (79.904, 0.120),
    "Kr": (83.798, 0.116), "Rb": (85.468, 0.220), "Sr": (87.62, 0.195), "Mo": (95.95, 0.154), "Ru": (101.07, 0.146),
    "Rh": (102.91, 0.142), "Pd": (106.42, 0.139), "Ag": (107.87, 0.145), "Cd": (112.41, 0.144), "Sn": (118.71, 0.139),
    "Sb": (121.76, 0.139), "Te": (127.60, 0.138), "I": (126.90, 0.139), "Xe": (131.29, 0.140), "Cs": (132.91, 0.244),
    "Ba": (137.33, 0.215), "Pt": (195.08, 0.136), "Au": (196.97, 0.136), "Hg": (200.59, 0.132), "Pb": (207.2, 0.146),
}  # fmt: skip
_NOT_METALS = frozenset(
    ("H", "He", "B", "C", "N", "O", "F", "Ne", "Si", "P", "S", "Cl", "Ar", "Ge", "As", "Se", "Br", "Kr", "Sb", "Te",
     "I", "Xe")
)  # fmt: skip
# Names of ions that are not their element's: CHARMM's, and those of the Protein Data Bank.
_ION_NAMES = {"SOD": "Na", "POT": "K", "CLA": "Cl", "CAL": "Ca", "CES": "Cs", "LIT": "Li", "RUB": "Rb",
              "BAR": "Ba", "CAD": "Cd", "IOD": "I", "BRO": "Br", "CU1": "Cu", "3CO": "Co", "3NI": "Ni"}  # fmt: skip
_ANY_ION = ("ION", "IONS", "IO", "CIO", "IP", "IM", "CIP", "CIM")
_HALOGENS = ("F", "Cl", "Br", "I")
_UNNAMED_RESIDUES = ("UNL", "UNK", "LIG", "MOL", "DRG")
_TWO_LETTER_IN_LIGANDS = ("Cl", "Br", "Si", "Se", "Na", "Mg", "Zn", "Fe", "Li", "As")


def atomic_weight_da(symbol: str) -> float:
    """Standard atomic weight in dalton. Raises KeyError for a symbol the table lacks."""
    return _TABLE[symbol][0]


def is_element(symbol: str) -> bool:
    """Whether the table has this symbol."""
    return symbol in _TABLE


def is_metal(symbol: str) -> bool:
    """Whether this is a metal of the table."""
    return symbol in _TABLE and symbol not in _NOT_METALS


def is_lone_ion(symbol: str) -> bool:
    """Whether a lone atom of this element is an ion: a metal or a halide."""
    return is_metal(symbol) or symbol in _HALOGENS


def ion_symbol(name: str) -> str | None:
    """Return the element of a monatomic ion by its name (`SOD`, `Na+`, `CL-`, `ZN2`, `MG`), or None."""
    upper = name.strip().upper()
    bare = upper.rstrip("+-").rstrip("0123456789").rstrip("+-") or upper
    symbol = _ION_NAMES.get(upper, bare.capitalize())
    return symbol if is_lone_ion(symbol) else None


def covalent_radius_nm(symbol: str) -> float:
    """Covalent radius in nm. Raises KeyError for a symbol the table lacks."""
    return _TABLE[symbol][1]


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
    if symbol in _TABLE and not repeats_name(name_field, residue_name, symbol):
        return symbol
    name = name_field.strip().upper()
    letters = name.lstrip("0123456789'\"*")
    if not letters or not letters[0].isalpha():
        return None
    residue = residue_name.upper()
    two = letters[:2].capitalize()
    # The columns of PDB files put an element's second letter where a nitrogen called NA has its first.
    halogen = two in ("Cl", "Br") and (len(letters) == 2 or letters[2:].isdigit())
    other = (hetero or residue in _UNNAMED_RESIDUES) and not name_field.startswith(" ")
    if (halogen or other) and two in _TWO_LETTER_IN_LIGANDS and template_for(residue) is None:
        return two
    if residue in ("MSE", "SEC") and two == "Se":
        return two
    first = "H" if letters[0] == "D" and name != letters else letters[0]
    return first if first in _TABLE else (two if two in _TABLE else None)
