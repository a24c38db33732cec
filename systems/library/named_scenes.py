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

import tomllib
from collections.abc import Iterator
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


with (files("systems.library") / "data" / "library.toml").open("rb") as _file:
    _LIBRARY: dict[str, Any] = tomllib.load(_file)
PROTOCOLS = {
    name: Protocol(name, {k: None if v == "natural" else v for k, v in said["settings"].items()}, said["source"])
    for name, said in _LIBRARY["protocols"].items()
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
    """Return a scene of particles of 12 Da at `(n, 3)` nm under `law` (see the module). Raises InputError when the law
    is unknown or incomplete."""
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
    """One scene of the library. `smiles` or `sequence` say what the data file was made from; model systems have
    neither. `file`: the data file, named after the entry unless it is shared. `own_settings`: of a model system, and
    `source`, where they come from; `protocols`: names of those that papers simulated this molecule by."""

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


def _entries() -> Iterator[Entry]:
    for name, said in _LIBRARY["peptides"].items():
        protocols = (said["protocol"],) if "protocol" in said else ()
        yield Entry(name, PEPTIDES, said["title"], protocols=protocols, sequence=said["sequence"])
    for code, title in _LIBRARY["amino_acids"].items():
        name, file = f"ACE-{code}-NME", "alanine-dipeptide" if code == "ALA" else ""
        yield Entry(name, AMINO_ACIDS, title, sequence=name, file=file)
    for name, (smiles, title) in _LIBRARY["molecules"].items():
        yield Entry(name, MOLECULES, title, protocols=("md17",), smiles=smiles)
    for name, title in _LIBRARY["model_systems"].items():
        yield Entry(name, ANALYTIC, title, _LIBRARY["model_settings"], "this program's own")


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
    """Return a named scene, with bonds, bond orders, masses and residues. Raises UnknownNameError, and PreparationError
    for a peptide that cannot be built."""
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
