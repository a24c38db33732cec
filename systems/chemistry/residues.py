"""Standard residues: heavy atoms, bonds, hydrogens that must be there, and the names other programs give them."""

from __future__ import annotations

from dataclasses import dataclass

_BACKBONE = "N-CA CA-C C-O"
# Side-chain bonds, and the least number of hydrogens on each heavy atom (protonation may add to it).
_SIDE_CHAINS: dict[str, tuple[str, str]] = {
    "ALA": ("CA-CB", "CB3"),
    "ARG": ("CA-CB CB-CG CG-CD CD-NE NE-CZ CZ-NH1 CZ-NH2", "CB2 CG2 CD2 NE1 NH11 NH21"),
    "ASN": ("CA-CB CB-CG CG-OD1 CG-ND2", "CB2 ND22"),
    "ASP": ("CA-CB CB-CG CG-OD1 CG-OD2", "CB2"),
    "CYS": ("CA-CB CB-SG", "CB2"),
    "GLN": ("CA-CB CB-CG CG-CD CD-OE1 CD-NE2", "CB2 CG2 NE22"),
    "GLU": ("CA-CB CB-CG CG-CD CD-OE1 CD-OE2", "CB2 CG2"),
    "GLY": ("", ""),
    "HIS": ("CA-CB CB-CG CG-ND1 CG-CD2 ND1-CE1 CD2-NE2 CE1-NE2", "CB2 CD21 CE11"),
    "ILE": ("CA-CB CB-CG1 CB-CG2 CG1-CD1", "CB1 CG12 CG23 CD13"),
    "LEU": ("CA-CB CB-CG CG-CD1 CG-CD2", "CB2 CG1 CD13 CD23"),
    "LYS": ("CA-CB CB-CG CG-CD CD-CE CE-NZ", "CB2 CG2 CD2 CE2 NZ2"),
    "MET": ("CA-CB CB-CG CG-SD SD-CE", "CB2 CG2 CE3"),
    "PHE": ("CA-CB CB-CG CG-CD1 CG-CD2 CD1-CE1 CD2-CE2 CE1-CZ CE2-CZ", "CB2 CD11 CD21 CE11 CE21 CZ1"),
    "PRO": ("CA-CB CB-CG CG-CD CD-N", "CB2 CG2 CD2"),
    "SER": ("CA-CB CB-OG", "CB2 OG1"),
    "THR": ("CA-CB CB-OG1 CB-CG2", "CB1 OG11 CG23"),
    "TRP": (
        "CA-CB CB-CG CG-CD1 CG-CD2 CD1-NE1 NE1-CE2 CD2-CE2 CD2-CE3 CE3-CZ3 CZ3-CH2 CH2-CZ2 CZ2-CE2",
        "CB2 CD11 NE11 CE31 CZ31 CH21 CZ21",
    ),
    "TYR": ("CA-CB CB-CG CG-CD1 CG-CD2 CD1-CE1 CD2-CE2 CE1-CZ CE2-CZ CZ-OH", "CB2 CD11 CD21 CE11 CE21 OH1"),
    "VAL": ("CA-CB CB-CG1 CB-CG2", "CB1 CG13 CG23"),
}
_CAPS: dict[str, tuple[str, str]] = {
    "ACE": ("CH3-C C-O", "CH33"),
    "NME": ("N-C", "N1 C3"),
    "NH2": ("", "N2"),
}
_RESIDUE_ALIASES = {
    "HID": "HIS", "HIE": "HIS", "HIP": "HIS", "HSD": "HIS", "HSE": "HIS", "HSP": "HIS", "HISD": "HIS", "HISE": "HIS",
    "HISH": "HIS", "HISA": "HIS", "HISB": "HIS", "HIS1": "HIS", "HIS2": "HIS", "ASH": "ASP", "ASPH": "ASP",
    "ASPP": "ASP", "GLH": "GLU", "GLUH": "GLU", "GLUP": "GLU", "LYN": "LYS", "LYSH": "LYS", "LYP": "LYS", "LSN": "LYS",
    "CYX": "CYS", "CYM": "CYS", "CYS2": "CYS", "CYSH": "CYS", "CYN": "CYS", "NMA": "NME", "CBX": "NME", "NHE": "NH2",
}  # fmt: skip
_ATOM_ALIASES: dict[str, dict[str, str]] = {
    "ILE": {"CD": "CD1"},
    "ACE": {"CA": "CH3", "CAY": "CH3", "CY": "C", "OY": "O"},
    "NME": {"CH3": "C", "CA": "C", "CAT": "C", "CT": "C", "NT": "N"},
    "NH2": {"NT": "N"},
}
_TERMINAL_ALIASES = {"OT1": "O", "OC1": "O", "O1": "O", "OT2": "OXT", "OC2": "OXT", "O2": "OXT", "OT": "OXT"}
_WATERS = {
    "HOH", "WAT", "H2O", "DOD", "D2O", "SOL", "SPC", "SPCE", "TIP", "TIP3", "TIP4", "TIP5", "TIP3P", "TIP4P", "TIP5P",
    "TP3", "TP4", "TP5", "T3P", "T4P", "T5P", "T3H", "T4H", "T4E", "TP3M", "OPC", "OPC3", "SWM", "SWM4", "SWM6", "HHO",
    "OHH", "OH2", "W", "WATER",
}  # fmt: skip
ONE_LETTER = {
    "A": "ALA", "R": "ARG", "N": "ASN", "D": "ASP", "C": "CYS", "Q": "GLN", "E": "GLU", "G": "GLY", "H": "HIS",
    "I": "ILE", "L": "LEU", "K": "LYS", "M": "MET", "F": "PHE", "P": "PRO", "S": "SER", "T": "THR", "W": "TRP",
    "Y": "TYR", "V": "VAL",
}  # fmt: skip


@dataclass(frozen=True)
class ResidueTemplate:
    """A residue that is known by its name: `bonds` between heavy atoms, `hydrogens` the least number on each heavy atom
    that has any, `optional` heavy atoms that need not be there. `is_amino_acid`: N, CA, C and O link it into a chain.
    """

    name: str
    heavy: tuple[str, ...]
    bonds: tuple[tuple[str, str], ...]
    hydrogens: dict[str, int]
    optional: frozenset[str] = frozenset()
    is_amino_acid: bool = False
    is_saccharide: bool = False


def template_for(residue_name: str) -> ResidueTemplate | None:
    """Return the template of a residue under its standard or another program's name (HIE, HSD, NMA, NALA), or None."""
    name = residue_name.upper()
    name = _RESIDUE_ALIASES.get(name, name)
    if len(name) == 4 and name[0] in "NC":  # Amber's terminal forms
        name = _RESIDUE_ALIASES.get(name[1:], name[1:])
    if name in _SIDE_CHAINS:
        side, hydrogens = _SIDE_CHAINS[name]
        counts = {"CA": 2 if name == "GLY" else 1}
        return _template(name, f"{_BACKBONE} {side}", hydrogens, counts)
    if name in _CAPS:
        return _template(name, *_CAPS[name], {})
    return None


def canonical_heavy_name(template: ResidueTemplate, name: str) -> str | None:
    """Return the template's name of a heavy atom (`OXT` included), or None when it has no such atom."""
    upper = name.upper()
    upper = _ATOM_ALIASES.get(template.name, {}).get(upper, upper)
    if upper in template.heavy:
        return upper
    if template.is_amino_acid:
        terminal = _TERMINAL_ALIASES.get(upper, upper)
        if terminal in ("O", "OXT"):
            return terminal
    return None


def is_water_name(residue_name: str) -> bool:
    """Whether this is one of the usual names of water; what the residue is, its elements say."""
    return residue_name.upper() in _WATERS


def amino_acid_names() -> list[str]:
    """Three-letter names of the twenty."""
    return list(_SIDE_CHAINS)


def _template(name: str, bonds: str, hydrogens: str, counts: dict[str, int]) -> ResidueTemplate:
    pairs = [tuple(b.split("-")) for b in bonds.split()]
    heavy = list(dict.fromkeys(a for pair in pairs for a in pair)) or ["N"]
    counts = counts | {h[:-1]: int(h[-1]) for h in hydrogens.split()}
    return ResidueTemplate(
        name, tuple(heavy), tuple((a, b) for a, b in pairs), counts, is_amino_acid=name in _SIDE_CHAINS
    )
