"""Scene from what the user names: a library system, a structure file, a SMILES string or a peptide sequence."""

from __future__ import annotations

from pathlib import Path

from systems.errors import InputError
from systems.preparation import Preparation
from systems.prepare.read.file_text import suffix_of
from systems.prepare.read.mol_file import SUFFIXES
from systems.prepare.read.peptide_mol2 import is_peptide_mol2
from systems.prepare.structure_file import prepare_file
from systems.scene import Scene
from systems.takes import takes

_FILE_SUFFIXES = (".pdb", ".ent", ".cif", ".mmcif", ".gz")
_OTHER_SUFFIXES = (".xyz", ".gro", ".pdbqt", ".prmtop", ".psf", ".h5", ".dcd", ".xtc")


@takes(Preparation)
def prepare(spec: str, options: Preparation) -> Scene:
    """Return the scene that `spec` names: `alanine-dipeptide`, `peptide.pdb`, `molecule.sdf`, `smiles:CCO`,
    `sequence:ACE-ALA-NME`.

    Atoms keep the file's order and names when nothing has to be added. What was added, chosen or left out stands, a
    line each, in `scene.provenance["repairs"]`. `ph` decides the protonation of amino acids where hydrogens are
    missing. Waters are left out unless `keep_water` (for explicit solvent; `drop_water` states the default), and with
    them free ions, which no N, O or S of the rest holds, and agents of crystallisation and buffers (glycerol, DMSO,
    sulfate and the like), unless `keep_ligand`. Other ions and ligands beside a peptide are refused until one says what
    becomes of them; so is a chain that breaks, unless `cap_breaks` closes both ends
    with the caps NME and ACE.
    Raises UnknownNameError, InputError or PreparationError, each in one line.
    """
    options.refuse_contradictions()
    text = str(spec).strip()
    kind, _, rest = text.partition(":")
    if kind.lower() == "sequence":
        from systems.prepare.peptide import build_peptide

        return build_peptide(rest, ph=options.ph)
    if kind.lower() == "smiles":
        from systems.prepare.molecule import scene_from_smiles

        return scene_from_smiles(rest)
    path = Path(text).expanduser()
    if text in names():
        return load(text)
    suffix = suffix_of(path)
    if suffix in SUFFIXES and not (suffix == ".mol2" and is_peptide_mol2(path)):
        from systems.prepare.molecule import scene_from_mol_file

        return scene_from_mol_file(path)
    if suffix in _OTHER_SUFFIXES:
        raise InputError(f"{path}: {suffix} files are not read as scenes; convert it to PDB, mmCIF or SDF.")
    if suffix in (*_FILE_SUFFIXES, ".mol2") or path.exists() or "/" in text:
        return prepare_file(path, options)
    return load(text)
