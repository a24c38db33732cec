"""Residues of chains: heavy atoms, bonds, hydrogens that must be there, and the names other programs give them.

They are those of the chemical component dictionary: the data (systems/library/data/components.tsv.gz) come from the
wwPDB's, which is in the public domain (CC0), by docs/studies/preparation/component_subset.py.
"""

from __future__ import annotations

import gzip
import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any, cast

import networkx as nx

from systems.chemistry.graph import ring_sizes

# The least numbers of hydrogens that differ from what the dictionary leaves a residue at the highest pH: a lone charge
# may be drawn on either nitrogen, sulfur may be bridged.
_FEWEST_HYDROGENS = {"ARG": {"NH1": 1, "NH2": 1}, "CYS": {"SG": 0}, "HIS": {"NE2": 0}, "LYS": {"NZ": 2}}
# Bonds, and the least number of hydrogens on each heavy atom: of caps, and of residues whose rings are built in the
# order of these bonds.
_WRITTEN: dict[str, tuple[str, str]] = {
    "ACE": ("CH3-C C-O", "CH33"),
    "NME": ("N-C", "N1 C3"),
    "NH2": ("", "N2"),
    "PRO": ("N-CA CA-C C-O CA-CB CB-CG CG-CD CD-N", "CA1 CB2 CG2 CD2"),
    "TRP": (
        "N-CA CA-C C-O CA-CB CB-CG CG-CD1 CG-CD2 CD1-NE1 NE1-CE2 CD2-CE2 CD2-CE3 CE3-CZ3 CZ3-CH2 CH2-CZ2 CZ2-CE2",
        "CA1 CB2 CD11 NE11 CE31 CZ31 CH21 CZ21",
    ),
}
# What other programs call residues and atoms, and names of water, of ions and of what stands beside a molecule.
NAMES: dict[str, Any] = tomllib.loads((files("systems.library") / "data" / "names.toml").read_text())
_RESIDUE_ALIASES = {alias: name for name, aliases in NAMES["residues"].items() for alias in aliases}
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
    return _template(name) if name in _WRITTEN or name in ONE_LETTER.values() else None


def canonical_heavy_name(template: ResidueTemplate, name: str) -> str | None:
    """Return the template's name of a heavy atom (`OXT` included), or None when it has no such atom."""
    upper = name.upper()
    upper = NAMES["atoms"].get(template.name, {}).get(upper, upper)
    if upper in template.heavy:
        return upper
    if template.is_amino_acid:
        terminal = NAMES["terminal_atoms"].get(upper, upper)
        if terminal in ("O", "OXT"):
            return terminal
    return None


def is_water_name(residue_name: str) -> bool:
    """Whether this is one of the usual names of water; what the residue is, its elements say."""
    return residue_name.upper() in NAMES["waters"]


@cache
def _template(name: str) -> ResidueTemplate:
    if name in _WRITTEN:
        bonds, hydrogens = _WRITTEN[name]
        pairs = tuple((a, b) for a, b in (bond.split("-") for bond in bonds.split()))
        heavy = tuple(dict.fromkeys(atom for pair in pairs for atom in pair)) or ("N",)
        least = {h[:-1]: int(h[-1]) for h in hydrogens.split()}
        return ResidueTemplate(name, heavy, pairs, least, is_amino_acid=name in ONE_LETTER.values())
    found = cast(Component, component(name)).template
    least = found.hydrogens | {"N": 0} | _FEWEST_HYDROGENS.get(name, {})
    return replace(found, hydrogens={atom: n for atom, n in least.items() if n})


# ---- the chemical component dictionary ------------------------------------------------------------------------------


_ATOM = re.compile(r"([^:+]+?)(?::([A-Z][a-z]?))?([+-]\d+)?$")
_BACKBONE_ATOMS = {"N", "CA", "C", "O"}
_PHOSPHATE = {"P", "OP1", "OP2", "OP3"}
_ANOMERIC = {"SIA": "O2", "SLB": "O2"}
# pKa of groups as in a peptide in water, rounded: enough to tell what is charged at a given pH.
_PKA_CARBOXYLIC, _PKA_AMINE, _PKA_GUANIDINE, _PKA_IMIDAZOLE, _PKA_SULFURIC = 4.0, 10.0, 12.5, 6.5, -2.0
_PKA_PHOSPHORIC = (1.5, 6.5, 12.0)
# At this pH every group has lost what it can lose.
PH_OF_FEWEST = 14.0


@dataclass(frozen=True)
class Component:
    """A residue as the dictionary has it, mostly uncharged and alone. Per heavy atom: name, element, formal charge and
    the names of its hydrogens, those first that leave when the residue is linked. `bonds`: pairs of heavy atoms with
    their order. `kind`: peptide, nucleotide or saccharide."""

    name: str
    kind: str
    heavy: tuple[str, ...]
    elements: tuple[str, ...]
    charges: tuple[int, ...]
    bonds: tuple[tuple[int, int, int], ...]
    hydrogens: tuple[tuple[str, ...], ...]

    @property
    def optional(self) -> frozenset[str]:
        """Heavy atoms that a link to another residue replaces, or that stand only in the middle of a chain."""
        if self.kind == "peptide":
            return frozenset({"OXT"})
        return frozenset(_PHOSPHATE if self.kind == "nucleotide" else {_ANOMERIC.get(self.name, "O1")})

    @property
    def template(self) -> ResidueTemplate:
        """The residue as `residues.template_for` returns standard ones, hydrogens at their least."""
        bonds = tuple(
            (self.heavy[i], self.heavy[j]) for i, j, _ in self.bonds if "OXT" not in (self.heavy[i], self.heavy[j])
        )
        least: dict[str, int] = {}
        for _, parent in hydrogens_of(self, set(self.heavy), {}, ph=PH_OF_FEWEST):
            least[parent] = least.get(parent, 0) + 1
        heavy = tuple(a for a in self.heavy if a != "OXT")
        links = self.kind == "peptide" and set(heavy) >= _BACKBONE_ATOMS
        return ResidueTemplate(
            self.name, heavy, bonds, least, self.optional - {"OXT"}, links, self.kind == "saccharide"
        )


@cache
def component(name: str) -> Component | None:
    """Return the component of this name, or None."""
    line = _lines().get(name.upper())
    if line is None:
        return None
    kind, atoms, bonds, hydrogens = line.split("\t")
    parsed = [m.groups() for m in map(_ATOM.match, atoms.split()) if m]
    pairs = [(pair.partition("#")[0].split("-"), pair.partition("#")[2]) for pair in bonds.split()]
    return Component(
        name.upper(),
        kind,
        tuple(atom for atom, _, _ in parsed),
        tuple(element or atom[0] for atom, element, _ in parsed),
        tuple(int(charge or 0) for _, _, charge in parsed),
        tuple((int(ends[0]), int(ends[1]), int(order or 1)) for ends, order in pairs),
        tuple(tuple(h for h in own.split(",") if h) for own in hydrogens.split(";")),
    )


def known_template(residue_name: str) -> ResidueTemplate | None:
    """Return the template of a standard residue, or that of a component of the dictionary, or None."""
    found = component(residue_name)
    return template_for(residue_name) or (found.template if found else None)


def hydrogens_of(
    residue: Component, present: Collection[str], links: Mapping[str, int], *, ph: float
) -> list[tuple[str, str]]:
    """Return (name, heavy atom) of each hydrogen of a residue with these heavy atoms `present` at this pH, groups
    charged by their usual pKa. `links`: how many bonds each heavy atom has to other residues; each takes the place of a
    hydrogen, or of an atom that leaves (OXT)."""
    near: list[list[tuple[int, int]]] = [[] for _ in residue.heavy]
    for i, j, order in residue.bonds:
        near[i].append((j, order))
        near[j].append((i, order))
    gone = [
        0 if residue.elements[k] == "P" else sum(residue.heavy[j] not in present for j, _ in around)
        for k, around in enumerate(near)
    ]
    counts = [max(0, len(own) + gone[k] - links.get(residue.heavy[k], 0)) for k, own in enumerate(residue.hydrogens)]
    _ionise(residue, near, counts, links, ph)
    taken = {h for own in residue.hydrogens for h in own}
    out = []
    for k, (atom, own) in enumerate(zip(residue.heavy, residue.hydrogens, strict=True)):
        if atom not in present:
            continue
        names = list(own[max(0, len(own) - counts[k]) :])
        serial = 1
        while len(names) < counts[k]:
            new = ("H" + atom[1:] if atom[0] != "O" else "H" + atom)[:3] + ("" if serial == 1 else str(serial))
            serial += 1
            if new not in taken:
                taken.add(new)
                names.append(new)
        out += [(name, atom) for name in names]
    return out


def _ionise(
    residue: Component, near: list[list[tuple[int, int]]], counts: list[int], links: Mapping[str, int], ph: float
) -> None:
    """Add to and take from the hydrogens of titratable groups."""
    symbol = residue.elements
    ring = ring_sizes(nx.Graph([(i, j) for i, j, _ in residue.bonds]))
    acid_protons: dict[int, int] = {}
    for k, element in enumerate(symbol):
        if element == "O" and counts[k] and len(near[k]) == 1:
            centre = near[k][0][0]
            oxo = any(symbol[j] == "O" and order == 2 for j, order in near[centre])
            earlier = acid_protons.get(centre, 0)
            pka = {"C": _PKA_CARBOXYLIC, "S": _PKA_SULFURIC, "P": _PKA_PHOSPHORIC[min(earlier, 2)]}.get(symbol[centre])
            if oxo and pka is not None:
                acid_protons[centre] = earlier + 1
                counts[k] -= ph > pka
        elif element == "N":
            single = all(order == 1 and symbol[j] == "C" for j, order in near[k])
            saturated = all(order == 1 for j, _ in near[k] for _, order in near[j])
            linked = links.get(residue.heavy[k], 0)
            if residue.charges[k] == 0 and single and saturated and not linked and len(near[k]) + counts[k] < 4:
                counts[k] += ph < _PKA_AMINE
            elif residue.charges[k] == 1 and single and linked and counts[k]:  # an amide where lysine has its amine
                counts[k] -= 1
            for j, order in near[k]:
                others = [n for n, _ in near[j] if symbol[n] == "N" and n != k]
                if order != 2 or symbol[j] != "C" or not others:
                    continue
                bond = min(j, k), max(j, k)
                in_ring = bond in ring
                if residue.charges[k] == 0 and not in_ring:  # guanidine, amidine
                    counts[k] += ph < _PKA_GUANIDINE
                elif residue.charges[k] == 1 and in_ring and ring[bond] == 5 and counts[k]:
                    counts[k] -= ph > _PKA_IMIDAZOLE


@cache
def _lines() -> dict[str, str]:
    data = gzip.decompress((files("systems.library") / "data" / "components.tsv.gz").read_bytes()).decode()
    rows = (line.partition("\t") for line in data.splitlines() if not line.startswith("#"))
    return {name: rest for name, _, rest in rows}
