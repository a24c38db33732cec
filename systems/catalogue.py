"""What the library holds: names, groups, how each scene is made, and the protocol its data are usually made with.

A protocol is a dictionary of the settings of `surrogate.api.reference` that it fixes; what it leaves out stays at the
program's defaults.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from systems.model_systems import N_BODY


@dataclass(frozen=True)
class Entry:
    """One scene of the library.

    `smiles` or `sequence` say what the data file was made from; model systems have neither. `file`: the data file,
    named after the entry unless it is shared. `source`: where the protocol comes from.
    """

    name: str
    group: str
    title: str
    protocol: dict[str, Any] = field(default_factory=dict)
    source: str = ""
    smiles: str = ""
    sequence: str = ""
    file: str = ""


PEPTIDES = "peptides"
AMINO_ACIDS = "capped amino acids"
MOLECULES = "MD17 molecules"
PARTICLES = "n-body systems"
ANALYTIC = "analytic systems"

# What the program does to a peptide anyway, spelled out because published data depend on it.
PEPTIDE_PROTOCOL: dict[str, Any] = {
    "force_field": "ff14SB",
    "solvent": "obc2",
    "temperature_k": 300.0,
    "friction_per_ps": 1.0,
    "timestep_ps": 0.004,
    "hydrogen_mass_da": 3.0,
    "save_every_ps": 1.0,
}
_PEPTIDE_SOURCE = "this program's defaults"
CHIGNOLIN_PROTOCOL = PEPTIDE_PROTOCOL | {"temperature_k": 340.0}
_CHIGNOLIN_SOURCE = "340 K, near the melting temperature: Lindorff-Larsen et al., Science 334, 517 (2011)"
TETRAPEPTIDE_PROTOCOL: dict[str, Any] = {
    "force_field": "ff14SB",
    "solvent": "gbn2",
    "temperature_k": 350.0,
    "friction_per_ps": 0.3,
    "timestep_ps": 0.002,
    "hydrogen_mass_da": None,
    "save_every_ps": 0.1,
}
TETRAPEPTIDE_SOURCE = "MDGen's implicit-solvent runs: Jing, Stärk, Jaakkola and Berger, NeurIPS 2024 (100 ns each)"
# The friction is ours, and low, but a window of the forecasting task is not deterministic: two runs from one state that
# draw other noise are 0.07 Å (aspirin) to 0.12 Å (ethanol) apart after 100 fs, root mean square over atoms, and 0.10 to
# 0.22 Å after 150 fs; the best forecast of one of them is off by that over √2.
MD17_PROTOCOL: dict[str, Any] = {
    "force_field": "gaff2",
    "solvent": "vacuum",
    "temperature_k": 500.0,
    "friction_per_ps": 0.1,
    "timestep_ps": 0.0005,
    "hydrogen_mass_da": None,
    "constrain_hydrogens": False,
    "save_every_ps": 0.005,
}
_MD17_SOURCE = "MD17, Chmiela et al., Sci. Adv. 3, e1603015 (2017), every tenth frame as in GeoTDM; GAFF2 for their PBE"
MD22_PROTOCOL: dict[str, Any] = MD17_PROTOCOL | {"force_field": "ff14SB", "timestep_ps": 0.001, "save_every_ps": 0.01}
_MD22_SOURCE = "MD22, Chmiela et al., Sci. Adv. 9, eadf0873 (2023): 500 K, 1 fs; ff14SB in vacuum for their PBE+MBD"
_BATH_PROTOCOL: dict[str, Any] = {
    "temperature_k": 300.0,
    "friction_per_ps": 1.0,
    "timestep_ps": 0.01,
    "save_every_ps": 0.1,
}
_N_BODY_SOURCE = "LaM-SLidE, section 4.3, with the generator of GeoTDM (Han et al., NeurIPS 2024): 30 frames"

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
              PEPTIDE_PROTOCOL, _PEPTIDE_SOURCE, sequence="ACE-ALA-NME"),
        Entry("ac-ala3-nhme", PEPTIDES, "ACE-ALA-ALA-ALA-NME, the peptide of MD22", MD22_PROTOCOL, _MD22_SOURCE,
              sequence="ACE-ALA-ALA-ALA-NME"),
        Entry("chignolin", PEPTIDES, "GYDPETGTWG (PDB 1UAO), built extended from its sequence, not folded",
              CHIGNOLIN_PROTOCOL, _CHIGNOLIN_SOURCE, sequence="GYDPETGTWG"),
        Entry("cln025", PEPTIDES, "YYDPETGTWY (PDB 5AWL), the stabler chignolin, built extended, not folded",
              CHIGNOLIN_PROTOCOL, _CHIGNOLIN_SOURCE, sequence="YYDPETGTWY"),
    ]  # fmt: skip
    for code, title in _AMINO_ACIDS.items():
        name = f"ACE-{code}-NME"
        file = "alanine-dipeptide" if code == "ALA" else ""
        found.append(Entry(name, AMINO_ACIDS, title, PEPTIDE_PROTOCOL, _PEPTIDE_SOURCE, sequence=name, file=file))
    for name, (smiles, title) in _SMILES.items():
        found.append(Entry(name, MOLECULES, title, MD17_PROTOCOL, _MD17_SOURCE, smiles=smiles))
    laws = {"coulomb": "charges of ±1", "springs": "springs between half of the pairs", "gravity": "softened gravity"}
    for name, n_body in N_BODY.items():
        protocol = {"ensemble": "nve", "timestep_ps": n_body.timestep_ps, "save_every_ps": n_body.save_every_ps,
                    "equilibrate_ps": 0.0}  # fmt: skip
        title = f"{n_body.n_particles} particles, {laws[n_body.kind]}; {name}:SEED draws other starting conditions"
        found.append(Entry(name, PARTICLES, title, protocol, _N_BODY_SOURCE))
    single = (("harmonic-oscillator", "one particle, one force constant an axis: variance kT/k, frequency sqrt(k/m)"),
              ("double-well", "one particle, two wells of unequal depth: populations by quadrature"))  # fmt: skip
    found += [Entry(name, ANALYTIC, title, _BATH_PROTOCOL, "this program's own") for name, title in single]
    return found


ENTRIES: dict[str, Entry] = {entry.name: entry for entry in _entries()}
