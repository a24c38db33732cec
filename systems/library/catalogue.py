"""Contents of the library: names, groups, how each scene is made, and the papers whose data are of it.

A molecule is simulated by the program's defaults, under whichever name; the papers' settings are asked for by theirs
(systems.library.protocols). Model systems, which no force field knows, bring settings of their own: a dictionary of
those of `surrogate.api.reference` that they fix.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Entry:
    """One scene of the library.

    `smiles` or `sequence` say what the data file was made from; model systems have neither. `file`: the data file,
    named after the entry unless it is shared. `own_settings`: of a model system, and `source`, where they come from;
    `protocols`: names of those that papers simulated this molecule by.
    """

    name: str
    group: str
    title: str
    own_settings: dict[str, Any] = field(default_factory=dict)
    source: str = ""
    protocols: tuple[str, ...] = ()
    smiles: str = ""
    sequence: str = ""
    file: str = ""


PEPTIDES = "peptides"
AMINO_ACIDS = "capped amino acids"
MOLECULES = "MD17 molecules"
ANALYTIC = "analytic systems"

_BATH_SETTINGS: dict[str, Any] = {
    "temperature_k": 300.0,
    "friction_per_ps": 1.0,
    "timestep_ps": 0.01,
    "save_every_ps": 0.1,
}

_AMINO_ACIDS = {
    "ALA": "alanine", "ARG": "arginine, +1", "ASN": "asparagine", "ASP": "aspartate, -1", "CYS": "cysteine",
    "GLN": "glutamine", "GLU": "glutamate, -1", "GLY": "glycine", "HID": "histidine, hydrogen on N-delta",
    "HIE": "histidine, hydrogen on N-epsilon", "HIP": "histidine, both hydrogens, +1", "ILE": "isoleucine",
    "LEU": "leucine", "LYS": "lysine, +1", "MET": "methionine", "PHE": "phenylalanine", "PRO": "proline",
    "SER": "serine", "THR": "threonine", "TRP": "tryptophan", "TYR": "tyrosine", "VAL": "valine",
}  # fmt: skip

# Atoms stand in the order of the SMILES, hydrogens after; for ethanol and malonaldehyde that is MD17's own order.
_SMILES = {
    "aspirin": ("CC(=O)Oc1ccccc1C(=O)O", "acetylsalicylic acid"),
    "benzene": ("c1ccccc1", "benzene"),
    "ethanol": ("C(C)O", "ethanol, atoms in MD17's order"),
    "malonaldehyde": ("C(CC=O)=O", "malonaldehyde, the dialdehyde as in MD17 (not the enol), in MD17's order"),
    "naphthalene": ("c1ccc2ccccc2c1", "naphthalene"),
    "salicylic-acid": ("c1ccc(c(c1)C(=O)O)O", "2-hydroxybenzoic acid"),
    "toluene": ("Cc1ccccc1", "toluene"),
    "uracil": ("c1c[nH]c(=O)[nH]c1=O", "uracil, the diketo form"),
}


def _entries() -> list[Entry]:
    found = [
        Entry("alanine-dipeptide", PEPTIDES, "ACE-ALA-NME: the usual first peptide, two backbone torsions (phi, psi)",
              sequence="ACE-ALA-NME"),
        Entry("ac-ala3-nhme", PEPTIDES, "ACE-ALA-ALA-ALA-NME, the peptide of MD22", protocols=("md22",),
              sequence="ACE-ALA-ALA-ALA-NME"),
        Entry("chignolin", PEPTIDES, "GYDPETGTWG (PDB 1UAO), built extended from its sequence, not folded",
              protocols=("fast-folders",), sequence="GYDPETGTWG"),
        Entry("cln025", PEPTIDES, "YYDPETGTWY (PDB 5AWL), the stabler chignolin, built extended, not folded",
              protocols=("fast-folders",), sequence="YYDPETGTWY"),
    ]  # fmt: skip
    for code, title in _AMINO_ACIDS.items():
        name = f"ACE-{code}-NME"
        file = "alanine-dipeptide" if code == "ALA" else ""
        found.append(Entry(name, AMINO_ACIDS, title, sequence=name, file=file))
    for name, (smiles, title) in _SMILES.items():
        found.append(Entry(name, MOLECULES, title, protocols=("md17",), smiles=smiles))
    single = (("harmonic-oscillator", "one particle, one force constant an axis: variance kT/k, frequency sqrt(k/m)"),
              ("double-well", "one particle, two wells of unequal depth: populations by quadrature"))  # fmt: skip
    found += [Entry(name, ANALYTIC, title, _BATH_SETTINGS, "this program's own") for name, title in single]
    return found


ENTRIES: dict[str, Entry] = {entry.name: entry for entry in _entries()}
