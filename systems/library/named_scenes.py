"""Scenes by what the user names: a library system, a structure file, a SMILES string or a peptide sequence; and the
library's contents: names, groups, model systems, protocols of papers.

A molecule is simulated by the program's defaults, under whichever name; the papers' settings are asked for by theirs
(`PROTOCOLS`): a protocol goes with no molecule, what is said beside it outweighs it, and what it leaves out stays at
the program's defaults. Model systems, which no force field knows, bring settings of their own: a dictionary of those of
`surrogate.api.reference` that they fix. Such a scene holds particles (`systems.scene.PARTICLE`) and says in
`Scene.interactions` what acts on them:

- `harmonic`: (k_x x^2 + k_y y^2 + k_z z^2) / 2 on each particle, with `force_constants_kj_mol_nm2`;
- `double-well`: h ((x/a)^2 - 1)^2 + t x + k (y^2 + z^2) / 2, with `barrier_kj_mol` h, `minimum_nm` a,
  `tilt_kj_mol_nm` t and `transverse_kj_mol_nm2` k.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.residues import ONE_LETTER
from systems.errors import InputError, PreparationError, UnknownNameError, nearest
from systems.options import Preparation, options_as_keywords
from systems.scene import PARTICLE, Scene


@dataclass(frozen=True)
class Protocol:
    """Settings of `surrogate.api.reference` by name, and the paper they are from."""

    name: str
    settings: dict[str, Any]
    source: str


# The friction is ours, and low, but a window of the forecasting task is not deterministic: two runs from one state that
# draw other noise are 0.07 Å (aspirin) to 0.12 Å (ethanol) apart after 100 fs, root mean square over atoms, and 0.10 to
# 0.22 Å after 150 fs; the best forecast of one of them is off by that over √2.
_MD17: dict[str, Any] = {
    "force_field": "gaff2",
    "solvent": "vacuum",
    "temperature_k": 500.0,
    "friction_per_ps": 0.1,
    "timestep_ps": 0.0005,
    "hydrogen_mass_da": None,
    "constrain_hydrogens": False,
    "save_every_ps": 0.005,
}
_MDGEN: dict[str, Any] = {
    "force_field": "ff14SB",
    "solvent": "gbn2",
    "temperature_k": 350.0,
    "friction_per_ps": 0.3,
    "timestep_ps": 0.002,
    "hydrogen_mass_da": None,
    "save_every_ps": 0.1,
}
PROTOCOLS = {
    "md17": Protocol(
        "md17",
        _MD17,
        "MD17, Chmiela et al., Sci. Adv. 3, e1603015 (2017), every tenth frame as in GeoTDM; GAFF2 for their PBE",
    ),
    "md22": Protocol(
        "md22",
        _MD17 | {"force_field": "ff14SB", "timestep_ps": 0.001, "save_every_ps": 0.01},
        "MD22, Chmiela et al., Sci. Adv. 9, eadf0873 (2023): 500 K, 1 fs; ff14SB in vacuum for their PBE+MBD",
    ),
    "mdgen": Protocol(
        "mdgen",
        _MDGEN,
        "MDGen's implicit-solvent runs: Jing, Stärk, Jaakkola and Berger, NeurIPS 2024 (100 ns each)",
    ),
    "fast-folders": Protocol(
        "fast-folders",
        {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 340.0},
        "340 K, near chignolin's melting temperature: Lindorff-Larsen et al., Science 334, 517 (2011)",
    ),
}


def find_protocol(name: str) -> Protocol:
    """Return a protocol by name. Raises UnknownNameError, with the nearest."""
    if name not in PROTOCOLS:
        known = list(PROTOCOLS)
        raise UnknownNameError(f"unknown protocol {name!r}; known: {', '.join(known)}.{nearest(name, known)}")
    return PROTOCOLS[name]


# ---- model systems --------------------------------------------------------------------------------------------------


def harmonic_oscillator() -> Scene:
    """Return one particle of 12 Da in a harmonic well, a different force constant along each axis: at 300 K its spread
    is 0.22, 0.16 and 0.11 nm, its period 3.1, 2.2 and 1.5 ps."""
    law = {"kind": "harmonic", "force_constants_kj_mol_nm2": [50.0, 100.0, 200.0]}
    return particles("harmonic-oscillator", law, [[0.1, 0.1, 0.1]])


def double_well() -> Scene:
    """Return one particle of 12 Da in two wells along x, 6 kJ/mol deep and 0.6 nm apart, the left one lower."""
    law = {"kind": "double-well", "barrier_kj_mol": 6.0, "minimum_nm": 0.3, "tilt_kj_mol_nm": 2.5,
           "transverse_kj_mol_nm2": 200.0}  # fmt: skip
    return particles("double-well", law, [[-0.3, 0.0, 0.0]])


def particles(name: str, law: dict[str, Any], positions_nm: npt.ArrayLike) -> Scene:
    """Return a scene of particles of 12 Da at `(n, 3)` nm under `law` (see the module).

    Raises InputError when the law is unknown or incomplete.
    """
    positions = np.array(positions_nm, dtype=np.float64)
    n = len(positions)
    check_law(law)
    return Scene(
        name=name,
        atom_names=tuple(f"P{k + 1}" for k in range(n)),
        elements=(PARTICLE,) * n,
        residue_of_atom=np.zeros(n, dtype=np.int64),
        residue_names=("PAR",),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=np.zeros((0, 2), dtype=np.int64),
        bond_orders=np.zeros(0),
        formal_charges=np.zeros(n, dtype=np.int64),
        masses_da=np.full(n, 12.0),
        positions_nm=positions,
        provenance={},
        interactions=law,
    )


_LAWS = {
    "harmonic": {"kind", "force_constants_kj_mol_nm2"},
    "double-well": {"kind", "barrier_kj_mol", "minimum_nm", "tilt_kj_mol_nm", "transverse_kj_mol_nm2"},
}


def check_law(law: dict[str, Any]) -> None:
    """Raise InputError unless `law` is known and complete."""
    constants = law.get("force_constants_kj_mol_nm2", (0, 0, 0))
    if _LAWS.get(law.get("kind", "")) != set(law) or not isinstance(constants, list | tuple) or len(constants) != 3:
        known = "; ".join(f"{kind}: {', '.join(sorted(entries - {'kind'}))}" for kind, entries in _LAWS.items())
        raise InputError(f"the law {law} of a model system is none of {known} (three force constants, for x, y and z).")


# ---- contents of the library ----------------------------------------------------------------------------------------


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


ENTRIES: dict[str, Entry] = {each.name: each for each in _entries()}


# ---- scenes by name -------------------------------------------------------------------------------------------------


ON_DEMAND = "Made from their name besides: capped peptides (ACE-ALA-GLY-NME), tetrapeptides in one-letter code (SDFS)."


def names() -> list[str]:
    """Return the names of the scenes that ship with the package, sorted."""
    return sorted(ENTRIES)


def groups() -> dict[str, list[str]]:
    """Return the names by group, in the catalogue's order; see also `ON_DEMAND`."""
    each = ENTRIES.values()
    return {group: [e.name for e in each if e.group == group] for group in dict.fromkeys(e.group for e in each)}


def knows(name: str) -> bool:
    """Whether `load` makes a scene of this name, shipped or on demand."""
    return _find(name) is not None


def entry(name: str) -> Entry:
    """Return what the library says of a scene, shipped or on demand. Raises UnknownNameError, with the nearest."""
    found = _find(name)
    if found is None:
        raise UnknownNameError(
            f"No system is called {name!r}.{nearest(name, names())} `surromd systems` lists them; a file is named by "
            "its path, a peptide as sequence:..., a molecule as smiles:..."
        )
    return found


def load(name: str) -> Scene:
    """Return a named scene, with bonds, bond orders, masses and residues.

    Raises UnknownNameError, and PreparationError for a peptide that cannot be built.
    """
    found = entry(name)
    provenance: dict[str, Any] = {"source": "library", "library_name": found.name, "repairs": []}
    if found.group == ANALYTIC:
        model = {"harmonic-oscillator": harmonic_oscillator, "double-well": double_well}[found.name]()
        return replace(model, provenance=provenance)
    if found.name in ENTRIES:
        return replace(_shipped(found.file or found.name), name=found.name, provenance=provenance)
    scene = _built_peptide(found.sequence)
    return replace(scene, name=found.name, provenance=provenance | scene.provenance | {"source": "library"})


@cache
def _shipped(file: str) -> Scene:
    from systems.prepare.records import scene_from_records
    from systems.prepare.structure_text import read_structure

    # Its CONECT records hold every bond.
    found = read_structure(Path(str(files("systems.library") / "data" / f"{file}.pdb")))
    return scene_from_records(found.atoms, np.array(found.conect, dtype=np.int64), name=file, provenance={})


@cache
def _built_peptide(sequence: str) -> Scene:
    from systems.prepare.peptide import build_peptide

    return build_peptide(sequence)


def _find(name: str) -> Entry | None:
    """Return the entry of a name, made for names on demand; None when there is no such scene."""
    if name in ENTRIES:
        return ENTRIES[name]
    is_short = len(name) == 4 and set(name) <= set(ONE_LETTER)
    if not is_short and "-" not in name:
        return None
    from systems.prepare.peptide import parse_sequence

    try:
        residues = parse_sequence(name)
    except PreparationError:
        return None
    sequence = "-".join(residues)
    if sequence in ENTRIES:
        return ENTRIES[sequence]
    is_tetrapeptide = len(residues) == 4 and not {"ACE", "NME"} & set(residues)
    what = "a tetrapeptide with charged ends, " if is_tetrapeptide else ""
    return Entry(
        name if is_short else sequence,
        PEPTIDES,
        f"{sequence}, {what}built extended from its sequence",
        protocols=("mdgen",) if is_tetrapeptide else (),
        sequence=sequence,
    )


# ---- scenes of all that a user can name -----------------------------------------------------------------------------


@options_as_keywords(Preparation)
def prepare(spec: str, options: Preparation) -> Scene:
    """Return the scene that `spec` names: `alanine-dipeptide`, `peptide.pdb`, `molecule.sdf`, `smiles:CCO`,
    `sequence:ACE-ALA-NME`.

    Atoms keep the file's order and names when nothing has to be added. What was added, chosen or left out stands, a
    line each, in `scene.provenance["repairs"]`. `ph` decides the protonation of amino acids where hydrogens are
    missing. Waters are left out unless `keep_water` (for explicit solvent; `drop_water` states the default), and with
    them free ions, which no N, O or S of the rest holds, and agents of crystallisation and buffers (glycerol, DMSO,
    sulfate and the like), unless `keep_ligand`. Other ions and ligands beside a peptide are refused until one says what
    becomes of them; so is a chain that breaks, unless `cap_breaks` closes both ends with the caps NME and ACE.
    Raises UnknownNameError, InputError or PreparationError, each in one line.
    """
    from systems.prepare.mol2_file import is_peptide, read_mol2
    from systems.prepare.molecule import SUFFIXES, scene_from_mol_file, scene_from_smiles
    from systems.prepare.peptide import build_peptide
    from systems.prepare.records import suffix_of
    from systems.prepare.structure_file import prepare_file

    options.refuse_contradictions()
    text = str(spec).strip()
    kind, _, rest = text.partition(":")
    if kind.lower() == "sequence":
        return build_peptide(rest, ph=options.ph)
    if kind.lower() == "smiles":
        return scene_from_smiles(rest)
    path = Path(text).expanduser()
    if text in names():
        return load(text)
    suffix = suffix_of(path)
    if suffix in SUFFIXES and not (suffix == ".mol2" and is_peptide(read_mol2(path))):
        return scene_from_mol_file(path)
    if suffix or path.exists() or "/" in text:
        return prepare_file(path, options)
    return load(text)
