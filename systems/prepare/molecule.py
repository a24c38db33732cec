"""Molecules through RDKit: SMILES, MDL MOL and SDF, Tripos MOL2 and files of components as scenes; the one molecule
that a salt means; 3-D coordinates by RDKit's embedding and minimisation, with a check that stereo is kept.

Metals drawn with covalent bonds are refused.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.distance_bonds import refuse_long_bonds
from systems.chemistry.element_data import atomic_weight_da
from systems.chemistry.geometry import near_pairs
from systems.errors import InputError, PreparationError, first_line, listed
from systems.prepare.mol2_file import Mol2, add_conformer, missing_hydrogens, molecule_of, read_mol2
from systems.prepare.records import file_name_and_provenance, read_text, suffix_of
from systems.prepare.structure_text import read_blocks
from systems.scene import Scene

RESIDUE_NAME = "MOL"
SUFFIXES = (".sdf", ".sd", ".mol", ".mdl", ".mol2")


def scene_from_smiles(smiles: str, *, seed: int = 0) -> Scene:
    """Return the scene of a SMILES string: all hydrogens, charges as written, 3-D coordinates drawn with `seed`.

    Bond orders are those of one Kekulé structure. Stereo that the SMILES leaves open is drawn and said in
    `provenance["repairs"]`. `provenance["multiplicity"]` is 1 + the number of unpaired electrons. Raises
    PreparationError for what is no SMILES, mixtures, metals, and stereo that no geometry can have.
    """
    notes: list[str] = []
    text = smiles.strip()
    parsed = parse_smiles(text, notes)
    try:
        molecule = embed(parsed, seed=seed, notes=notes)
    except PreparationError as error:
        raise PreparationError(f"SMILES {text!r}: {error}") from error
    provenance = {"source": "smiles", "smiles": text, "seed": seed, "repairs": notes}
    return scene_from_rdkit(molecule, name=text, provenance=provenance)


def scene_from_mol_file(path: str | Path) -> Scene:
    """Return the scene of the first molecule of an SDF, MOL or MOL2 file, at the file's positions.

    Missing hydrogens are added and a flat drawing is embedded, each said in `provenance["repairs"]`; stereo is read
    from the positions (from the wedges of a drawing). Raises InputError for a file that cannot be read,
    PreparationError for what `scene_from_smiles` refuses.
    """
    file = Path(path).expanduser()
    notes: list[str] = []
    try:
        molecule = _read_molecule(file, notes)
        return scene_from_rdkit(molecule, **file_name_and_provenance(file, notes))
    except PreparationError as error:
        raise PreparationError(f"{file}: {error}") from error


def scene_from_rdkit(molecule: Any, *, name: str, provenance: dict[str, Any]) -> Scene:
    """Return the scene of an RDKit molecule with all hydrogens and one conformer, in its atom order.

    One residue; atoms are called after their element and a number, C1, C2, ... Adds `multiplicity` to the provenance.
    """
    from rdkit import Chem

    drawn = Chem.Mol(molecule)
    Chem.Kekulize(drawn, clearAromaticFlags=True)
    atoms = list(drawn.GetAtoms())
    elements = tuple(atom.GetSymbol() for atom in atoms)
    bonds = [(*sorted((b.GetBeginAtomIdx(), b.GetEndAtomIdx())), b.GetBondTypeAsDouble()) for b in drawn.GetBonds()]
    bonds.sort()
    unpaired = sum(atom.GetNumRadicalElectrons() for atom in atoms)
    return Scene(
        name=name,
        atom_names=tuple(f"{e.upper()}{elements[: k + 1].count(e)}" for k, e in enumerate(elements)),
        elements=elements,
        residue_of_atom=np.zeros(len(atoms), dtype=np.int64),
        residue_names=(RESIDUE_NAME,),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=np.array([b[:2] for b in bonds], dtype=np.int64).reshape(-1, 2),
        bond_orders=np.array([b[2] for b in bonds], dtype=np.float64),
        formal_charges=np.array([atom.GetFormalCharge() for atom in atoms], dtype=np.int64),
        masses_da=np.array([atomic_weight_da(e) for e in elements]),
        positions_nm=np.array(drawn.GetConformer().GetPositions(), dtype=np.float64) / 10.0,
        provenance=provenance | {"multiplicity": 1 + unpaired},
    )


# ---- MOL, SDF and MOL2 -----------------------------------------------------------------------------------------------


def _read_molecule(path: Path, notes: list[str]) -> Any:
    """Return the first molecule of the file. Raises InputError or PreparationError; `notes` says what was changed."""
    from rdkit import Chem, rdBase

    text = read_text(path, "a molecule with coordinates")
    with rdBase.BlockLogs():
        if suffix_of(path) == ".mol2":
            return _read_mol2(text, path, notes)
        records = [r for r in text.split("$$$$") if r.strip()]
        if len(records) > 1:
            notes.append(f"{len(records)} molecules in the file: the first is taken")
        molecule = Chem.MolFromMolBlock("".join(records[:1]), sanitize=False, removeHs=False)
    if molecule is None:
        raise InputError(f"{path} holds no molecule that can be read as {suffix_of(path)[1:].upper()}; write it again.")
    return _resolved(main_molecule(molecule, notes), notes)


def _read_mol2(text: str, path: Path, notes: list[str]) -> Any:
    """MOL2 with all hydrogens by its elements and bonds; without them by its types, if they are SYBYL's."""
    found = read_mol2(text, path, notes)
    if "H" in found.elements or "C" not in found.elements:
        molecule = molecule_of(found, notes) or _by_types(found)
    else:  # most often a file that leaves its hydrogens out
        molecule = _by_types(found) or molecule_of(found, notes)
    if molecule is None:
        raise missing_hydrogens(found)
    return _resolved(main_molecule(molecule, notes), notes)


def _by_types(found: Mol2) -> Any | None:
    """RDKit's reading, where it finds the same elements (other programs' types are none) and hydrogens to add."""
    from rdkit import Chem

    molecule = Chem.MolFromMol2Block(found.block, sanitize=False, removeHs=False, cleanupSubstructures=True)
    if molecule is None or tuple(a.GetSymbol() for a in molecule.GetAtoms()) != found.elements:
        return None
    _draw_nitro(molecule)
    for atom in molecule.GetAtoms():
        atom.SetNoImplicit(False)  # its reader expects all hydrogens, and makes anions of hydroxyls and amines without
        is_anion = atom.GetFormalCharge() < 0 and all(a.GetFormalCharge() <= 0 for a in atom.GetNeighbors())
        if is_anion and "H" not in found.elements and atom.GetProp("_TriposAtomType") != "O.co2":
            atom.SetFormalCharge(0)
    try:
        sanitise(molecule)
    except PreparationError:
        return None
    return molecule if any(a.GetNumImplicitHs() for a in molecule.GetAtoms()) else None


def _draw_nitro(molecule: Any) -> None:
    """Give nitro groups of two single bonds (antechamber's) one double bond and their charges, in place."""
    from rdkit import Chem

    for atom in molecule.GetAtoms():
        ends = [b for b in atom.GetBonds() if b.GetOtherAtom(atom).GetSymbol() == "O"
                and b.GetOtherAtom(atom).GetDegree() == 1]  # fmt: skip
        if atom.GetSymbol() != "N" or len(ends) != 2 or any(b.GetBondType() != Chem.BondType.SINGLE for b in ends):
            continue
        ends[0].SetBondType(Chem.BondType.DOUBLE)
        for one, charge in ((atom, 1), (ends[0].GetOtherAtom(atom), 0), (ends[1].GetOtherAtom(atom), -1)):
            one.SetFormalCharge(charge)


def _resolved(molecule: Any, notes: list[str]) -> Any:
    """Return an unsanitised molecule with all hydrogens, at its own positions if it has three-dimensional ones.

    Valences that are impossible as written are perceived anew, and said. Raises PreparationError for what is no
    molecule, or has atoms on one point.
    """
    require(molecule)
    try:
        sanitise(molecule)
    except PreparationError as error:
        repaired = _with_charges(molecule, notes) or _reperceived(molecule, notes)
        if repaired is None:
            raise error
        molecule = repaired
    drop_isotopes(molecule, notes)
    return _with_geometry(molecule, notes)


def _with_charges(molecule: Any, notes: list[str]) -> Any | None:
    """With the charge that nitrogen of four bonds, oxygen of three and boron of four have, where none is written."""
    from rdkit import Chem

    out = Chem.Mol(molecule)
    changed = []
    for atom in out.GetAtoms():
        valence = sum(bond.GetBondTypeAsDouble() for bond in atom.GetBonds())
        charge = {("N", 4): 1, ("O", 3): 1, ("B", 4): -1}.get((atom.GetSymbol(), valence))
        if charge is not None and not atom.GetFormalCharge():
            atom.SetFormalCharge(charge)
            changed.append(f"{atom.GetSymbol()}{atom.GetIdx() + 1} {charge:+d}")
    try:
        sanitise(out)
    except PreparationError:
        return None
    notes.append(f"charges that the file leaves out, from the number of bonds: {', '.join(changed)}")
    return out


def _reperceived(molecule: Any, notes: list[str]) -> Any | None:
    """With the bond orders and charges of its elements and bonds, all of whose hydrogens must be there, in space."""
    if not molecule.GetNumConformers() or not molecule.GetConformer().Is3D():
        return None
    elements = tuple(atom.GetSymbol() for atom in molecule.GetAtoms())
    rows = {
        tuple(sorted((b.GetBeginAtomIdx(), b.GetEndAtomIdx()))): b.GetBondTypeAsDouble() for b in molecule.GetBonds()
    }
    found = Mol2(
        names=elements,
        elements=elements,
        positions_nm=np.array(molecule.GetConformer().GetPositions()) / 10.0,
        bonds=np.array(sorted(rows), dtype=np.int64).reshape(-1, 2),
        orders={(i, j): round(order) for (i, j), order in rows.items() if order in (1, 2, 3)},
        charge=None,
        residues=(),
        block="",
    )
    out = molecule_of(found, [])
    if out is not None:
        try:
            sanitise(out)
        except PreparationError:
            return None
        total = sum(atom.GetFormalCharge() for atom in out.GetAtoms())
        notes.append(f"its valences are impossible as written: orders and charges perceived, total {total:+d}")
    return out


def _with_geometry(molecule: Any, notes: list[str]) -> Any:
    from rdkit import Chem

    n_atoms = molecule.GetNumAtoms()
    conformer = molecule.GetConformer() if molecule.GetNumConformers() else None
    if conformer is None or _is_drawing(molecule, conformer):
        if conformer is not None and n_atoms > 1:
            Chem.AssignChiralTypesFromBondDirs(molecule)
            Chem.DetectBondStereochemistry(molecule)
        Chem.AssignStereochemistry(molecule, cleanIt=True, force=True)
        out = Chem.AddHs(molecule)
        if out.GetNumAtoms() > n_atoms:
            notes.append(f"hydrogens added: {out.GetNumAtoms() - n_atoms}")
        notes.append("a flat drawing: 3-D coordinates embedded, stereo from its wedges")
        return embed(out, seed=0, notes=notes)
    for x, y, z in conformer.GetPositions().tolist():
        if not all(map(math.isfinite, (x, y, z))):
            raise PreparationError("a coordinate is not a number; write the file again.")
    out = Chem.AddHs(molecule, addCoords=True)
    if out.GetNumAtoms() > n_atoms:
        notes.append(f"hydrogens added: {out.GetNumAtoms() - n_atoms}")
    symbols, positions = [atom.GetSymbol() for atom in out.GetAtoms()], np.array(out.GetConformer().GetPositions())
    for i, j in near_pairs(positions, 0.3, "the molecule").tolist():
        raise PreparationError(
            f"atoms {i + 1} ({symbols[i]}) and {j + 1} ({symbols[j]}) stand on one point; correct the coordinates."
        )
    bonds = np.array([(b.GetBeginAtomIdx(), b.GetEndAtomIdx()) for b in out.GetBonds()], dtype=np.int64)
    refuse_long_bonds(symbols, positions / 10.0, bonds, lambda i: f"{symbols[i]}{i + 1}")
    Chem.AssignStereochemistryFrom3D(out)
    return out


def _is_drawing(molecule: Any, conformer: Any) -> bool:
    """Whether positions are none: the file says so, or all atoms are on one point, or in one plane that cannot be."""
    positions = conformer.GetPositions()
    if not conformer.Is3D():
        return True
    if len(positions) > 1 and float(abs(positions - positions[0]).max()) < 1e-6:
        return True
    return not positions[:, 2].any() and any(
        atom.GetSymbol() == "C" and atom.GetTotalDegree() == 4 and atom.GetDegree() > 2 for atom in molecule.GetAtoms()
    )


# ---- files of the chemical component dictionary ---------------------------------------------------------------------


# Of ideal positions, those of the model that it was taken from, and others.
_POSITIONS = ("pdbx_model_Cartn_{}_ideal", "model_Cartn_{}", "{}")
_ORDERS = {"sing": 1, "single": 1, "doub": 2, "double": 2, "trip": 3, "triple": 3, "quad": 4, "arom": 12,
           "aromatic": 12, "delo": 12, "deloc": 12}  # fmt: skip
_AROMATIC = 12


def scene_from_component(text: str, path: Path) -> Scene:
    """Return the scene of the first component of a file, all of its atoms under their names, at its ideal positions.

    Where these are missing the positions of the model that the component was taken from are, then drawn ones. Raises
    InputError for atoms or bonds that cannot be read, PreparationError for what is no molecule.
    """
    from rdkit import rdBase

    notes: list[str] = []
    blocks = [b for b in read_blocks(text, path) if b.find_mmcif_category("_chem_comp_atom.")]
    if len(blocks) > 1:
        notes.append(f"{len(blocks)} components in the file: the first is taken")
    block = blocks[0]
    with rdBase.BlockLogs():
        try:
            molecule, names = _molecule(block, path, notes)
        except RuntimeError as error:  # gemmi's, of tables whose tags do not go together
            raise InputError(f"{path} is damaged ({first_line(error)}); fetch it again.") from error
        try:
            if main_molecule(molecule, []).GetNumAtoms() < molecule.GetNumAtoms():
                raise PreparationError("it is a salt of several molecules; give one of them.")
            resolved = _resolved(molecule, notes)
        except PreparationError as error:
            raise PreparationError(f"{path}: {error}") from error
    name = (block.find_value("_chem_comp.id") or block.name or "component").strip("'\"")
    scene = scene_from_rdkit(
        resolved,
        name=name,
        provenance=file_name_and_provenance(path, notes)["provenance"],
    )
    return replace(
        scene,
        atom_names=(*names, *scene.atom_names[len(names) :]),
        residue_names=(name if len(name) <= 5 else RESIDUE_NAME,),
    )


def _molecule(block: Any, path: Path, notes: list[str]) -> tuple[Any, list[str]]:
    """Return the RDKit molecule of a component, unsanitised, and the names of its atoms."""
    from rdkit import Chem

    where = f"{path}, component {block.name}"
    tags = [f"?{tag.format(axis)}" for tag in _POSITIONS for axis in "xyz"]
    rows = block.find("_chem_comp_atom.", ["atom_id", "type_symbol", "?charge", *tags])
    molecule = Chem.RWMol()
    index: dict[str, int] = {}
    positions: list[list[list[float]]] = [[], [], []]
    for row in rows:
        name, symbol = row.str(0), row.str(1).capitalize()
        try:
            atom = Chem.Atom("H" if symbol == "D" else symbol)
            atom.SetFormalCharge(round(float(row.str(2))) if row.has(2) and row.str(2) else 0)
        except (RuntimeError, ValueError):
            raise InputError(f"{where}: atom {name!r} has no element or no charge that can be read.") from None
        atom.SetNoImplicit(True)
        if name in index:
            raise InputError(f"{where}: two atoms are called {name!r}; fetch the file again.")
        index[name] = molecule.AddAtom(atom)
        for k, those in enumerate(positions):
            values = [row.str(3 + 3 * k + axis) if row.has(3 + 3 * k + axis) else "" for axis in range(3)]
            if all(values):
                try:
                    those.append([float(v) for v in values])
                except ValueError:
                    raise InputError(f"{where}: a coordinate of {name!r} is not a number.") from None
    if not index:
        raise InputError(f"{where} lacks atom_id or type_symbol; fetch the file again, or give the component as SDF.")
    for row in block.find("_chem_comp_bond.", ["atom_id_1", "atom_id_2", "?value_order", "?type"]):
        order = next((row.str(k).lower() for k in (2, 3) if row.has(k) and row.str(k)), "sing")
        try:
            ends = index[row.str(0)], index[row.str(1)]
            molecule.AddBond(*ends, Chem.BondType.values[_ORDERS[order]])
        except (KeyError, RuntimeError):
            raise InputError(f"{where}: the bond {row.str(0)} - {row.str(1)} ({order}) cannot be read.") from None
        for i in ends if _ORDERS[order] == _AROMATIC else ():
            molecule.GetAtomWithIdx(i).SetIsAromatic(True)
    whole = [found for found in positions if len(found) == len(index)]
    if whole:
        add_conformer(molecule, whole[0])
    else:
        notes.append("no whole set of positions in the file")
    return molecule, list(index)


# ---- salts ----------------------------------------------------------------------------------------------------------


# What drugs are sold with (the salts of the pharmacopoeias), uncharged; and water, ammonia and what has no such form.
_COUNTERIONS = (
    "Cl", "Br", "I", "F", "O", "N", "OS(O)(=O)=O", "OP(O)(O)=O", "O[N+]([O-])=O", "OC(O)=O", "OCl(=O)(=O)=O",
    "F[B-](F)(F)F", "F[P-](F)(F)(F)(F)F", "OC=O", "CC(O)=O", "OC(=O)C(F)(F)F", "CCC(O)=O", "OCC(O)=O", "CC(O)C(O)=O",
    "OC(=O)C(O)=O", "OC(=O)CC(O)=O", "OC(=O)CCC(O)=O", "OC(=O)C=CC(O)=O", "OC(=O)CC(O)C(O)=O", "OC(=O)C(O)C(O)C(O)=O",
    "OC(=O)CC(O)(CC(O)=O)C(O)=O", "OCC(O)C(O)C(O)C(O)C(O)=O", "CS(O)(=O)=O", "CCS(O)(=O)=O", "OCCS(O)(=O)=O",
    "OS(=O)(=O)CCS(O)(=O)=O", "OS(=O)(=O)c1ccccc1", "Cc1ccc(cc1)S(O)(=O)=O", "OS(=O)(=O)C(F)(F)F", "COS(O)(=O)=O",
    "OC(=O)c1cc2ccccc2c(c1O)Cc1c(O)c(cc2ccccc12)C(O)=O", "NC(CO)(CO)CO", "CNCC(O)C(O)C(O)C(O)CO",
)  # fmt: skip
_DRAWN_BONDED = {"Li": 1, "Na": 1, "K": 1, "Rb": 1, "Cs": 1, "Mg": 2, "Ca": 2, "Sr": 2, "Ba": 2}
# Other metals hold what stands beside them: ferrocene is no salt.
_MONATOMIC = (*_DRAWN_BONDED, "Al", "Zn", "F", "Cl", "Br", "I")


def main_molecule(molecule: Any, notes: list[str]) -> Any:
    """Return the one molecule that an unsanitised RDKit molecule means, its atoms in their order.

    Counterions, water and further copies beside it are left out and said. Its charge stays as written. Raises
    PreparationError for a mixture: several molecules of which none is known to be a counterion.
    """
    from rdkit import Chem

    molecule = _ionic(molecule, notes)
    parts = list(Chem.GetMolFrags(molecule, asMols=True, sanitizeFrags=False))
    if len(parts) < 2:
        return molecule
    keys = [_key(part) for part in parts]
    lone = [part.GetNumAtoms() == 1 and part.GetAtomWithIdx(0).GetSymbol() in _MONATOMIC for part in parts]
    companions = [alone or key in _known() for alone, key in zip(lone, keys, strict=True)]
    wanted = [k for k, companion in enumerate(companions) if not companion]
    acids = [
        k
        for k, companion in enumerate(companions)
        if companion and _is_organic(parts[k]) and not any(a.GetFormalCharge() for a in parts[k].GetAtoms())
    ]
    if wanted and acids and not any(a.GetSymbol() == "N" for a in parts[wanted[0]].GetAtoms()):
        wanted += acids  # acetic acid and ethanol are no salt
    if not wanted:  # acetate, with sodium: of counterions alone, the organic one
        wanted = [k for k, part in enumerate(parts) if _is_organic(part)]
    if len({keys[k] for k in wanted}) != 1 or len(wanted) == len(parts):
        names = sorted((_smiles(part) for part in parts), key=len, reverse=True)
        raise PreparationError(
            f"it has {len(names)} fragments ({listed(names, most=4)}), a salt or a mixture; give one molecule, for "
            f"instance smiles:{names[0]}."
        )
    rest = Counter(_smiles(part) for k, part in enumerate(parts) if k != wanted[0])
    names = [f"{n} {name}" if n > 1 else name for name, n in rest.items()]
    notes.append(f"a salt: {_smiles(parts[wanted[0]])} is taken as it is written, left out: {listed(names)}")
    return parts[wanted[0]]


def _is_organic(part: Any) -> bool:
    """Whether it has a carbon, and not carbonate's alone."""
    carbons = [a for a in part.GetAtoms() if a.GetSymbol() == "C"]
    return len(carbons) > 1 or any(n.GetSymbol() != "O" for a in carbons for n in a.GetNeighbors())


@cache
def _known() -> frozenset[str]:
    from rdkit import Chem

    return frozenset(_key(Chem.MolFromSmiles(smiles)) for smiles in _COUNTERIONS)


def _clean(part: Any, *, uncharged: bool) -> Any | None:
    """Return a molecule sanitised, without hydrogens, and without charges if asked; None for no possible molecule."""
    from rdkit import Chem, rdBase
    from rdkit.Chem.MolStandardize import rdMolStandardize

    with rdBase.BlockLogs():
        try:
            clean = Chem.Mol(part)
            Chem.SanitizeMol(clean)
            clean = Chem.RemoveHs(clean)
            return rdMolStandardize.Uncharger().uncharge(clean) if uncharged else clean
        except (Chem.MolSanitizeException, ValueError):
            return None


def _key(part: Any) -> str:
    """Canonical SMILES without charge, stereo and isotopes; empty for what is no possible molecule."""
    from rdkit import Chem

    clean = _clean(part, uncharged=True)
    if clean is None:
        return ""
    for atom in clean.GetAtoms():
        atom.SetIsotope(0)
    return str(Chem.MolToSmiles(clean, isomericSmiles=False))


def _smiles(part: Any) -> str:
    from rdkit import Chem

    return str(Chem.MolToSmiles(_clean(part, uncharged=False) or part))


def _ionic(molecule: Any, notes: list[str]) -> Any:
    """Return the molecule with alkali and alkaline earth metals as ions where they are drawn bonded to O, N or S."""
    from rdkit import Chem

    cut = []
    for atom in molecule.GetAtoms():
        valence = _DRAWN_BONDED.get(atom.GetSymbol())
        bonds = list(atom.GetBonds())
        if valence is None or not bonds or atom.GetFormalCharge() or len(bonds) > valence:
            continue
        others = [bond.GetOtherAtom(atom) for bond in bonds]
        if all(b.GetBondType() == Chem.BondType.SINGLE for b in bonds) and all(
            o.GetSymbol() in ("O", "N", "S") and not o.GetFormalCharge() for o in others
        ):
            cut += [(atom.GetIdx(), other.GetIdx()) for other in others]
    if not cut:
        return molecule
    out = Chem.RWMol(molecule)
    for metal, other in cut:
        out.RemoveBond(metal, other)
        for i, step in ((metal, 1), (other, -1)):
            atom = out.GetAtomWithIdx(i)
            atom.SetFormalCharge(atom.GetFormalCharge() + step)
            atom.SetNoImplicit(i == metal)
    metals = sorted({out.GetAtomWithIdx(metal).GetSymbol() for metal, _ in cut})
    notes.append(f"bonds to {', '.join(metals)} taken as ionic")
    return out.GetMol()


# ---- embedding ------------------------------------------------------------------------------------------------------


# What some force field or GFN2-xTB describes as part of a molecule; metals are not embedded with any confidence.
_ELEMENTS = ("H", "B", "C", "N", "O", "F", "Si", "P", "S", "Cl", "Se", "Br", "I")
_NOT_METALS = (*_ELEMENTS, "He", "Ne", "Ar", "Kr", "Xe", "Rn", "As", "Te", "At")
_LARGEST = 999
_CLEAN_UP_STEPS = 2000


def parse_smiles(text: str, notes: list[str]) -> Any:
    """Return the RDKit molecule of a SMILES string with all hydrogens. Raises PreparationError; see `require`."""
    from rdkit import Chem, rdBase

    if not text:
        raise PreparationError("The SMILES string is empty; write it like smiles:CCO.")
    if ">" in text.partition("|")[0].replace("->", ""):
        raise PreparationError(f"SMILES {text!r} is a reaction; give one molecule.")
    with rdBase.BlockLogs():
        molecule = Chem.MolFromSmiles(text, sanitize=False)
    if molecule is None:
        raise PreparationError(f"SMILES {text!r} cannot be read; check brackets, ring numbers and letters.")
    try:
        molecule = main_molecule(molecule, notes)
        require(molecule)
        sanitise(molecule)
    except PreparationError as error:
        raise PreparationError(f"SMILES {text!r}: {error}") from error
    drop_isotopes(molecule, notes)
    Chem.AssignStereochemistry(molecule, cleanIt=True, force=True)
    return Chem.AddHs(molecule)


def require(molecule: Any) -> None:
    """Raise PreparationError for wildcards, metals, elements without a model, and giants."""
    symbols = sorted({a.GetSymbol() for a in molecule.GetAtoms()})
    if not symbols:
        raise PreparationError("it has no atoms.")
    if "*" in symbols or any(a.HasQuery() for a in molecule.GetAtoms()):
        raise PreparationError("it holds wildcard atoms (*); write the elements.")
    metals = [s for s in symbols if s not in _NOT_METALS]
    if metals:
        raise PreparationError(
            f"it holds {', '.join(metals)}: metals have no parameters and no reliable 3-D embedding; "
            "give the molecule without the metal."
        )
    unusual = [s for s in symbols if s not in _ELEMENTS]
    if unusual:
        raise PreparationError(f"it holds {', '.join(unusual)}; molecules are prepared of {', '.join(_ELEMENTS)}.")
    if molecule.GetNumAtoms() > _LARGEST:
        raise PreparationError(f"it has {molecule.GetNumAtoms()} atoms; molecules are embedded up to {_LARGEST}.")


def embed(molecule: Any, *, seed: int, notes: list[str]) -> Any:
    """Return the molecule (all hydrogens in it) with one conformer: ETKDG (Riniker and Landrum, 2015), then MMFF94 or
    UFF. Stereo that it leaves open is drawn, and said in `notes`.

    Raises PreparationError when RDKit finds no geometry or the geometry has other stereo than the molecule.
    """
    from rdkit import Chem, rdBase
    from rdkit.Chem import rdDistGeom

    out = Chem.Mol(molecule)
    out.RemoveAllConformers()
    parameters: Any = rdDistGeom.ETKDGv3()
    parameters.randomSeed = (seed + 1) % 2**31
    parameters.useSmallRingTorsions = True
    for random_start in (False, True):
        parameters.useRandomCoords = random_start
        with rdBase.BlockLogs():
            if rdDistGeom.EmbedMolecule(out, parameters) == 0:
                break
    else:
        raise PreparationError(
            "RDKit finds no 3-D geometry for it; its stereo or its rings may be impossible. Give an SDF with "
            "coordinates."
        )
    _clean_up(out, notes)
    labelled = Chem.Mol(out)
    Chem.AssignStereochemistryFrom3D(labelled)
    _say_drawn(molecule, labelled, notes)
    refuse_changed_stereo(molecule, labelled)
    return out


def stereo_labels(molecule: Any) -> dict[tuple[int, ...], str]:
    """Return CIP labels: (atom,) -> R or S, (atom, atom) -> E or Z, of every specified element of stereo."""
    from rdkit import Chem
    from rdkit.Chem import rdCIPLabeler

    copy = Chem.Mol(molecule)
    marked: list[Any] = [*copy.GetAtoms(), *copy.GetBonds()]
    for thing in marked:
        thing.ClearProp("_CIPCode")
    rdCIPLabeler.AssignCIPLabels(copy)
    labels: dict[tuple[int, ...], str] = {
        (a.GetIdx(),): a.GetProp("_CIPCode") for a in copy.GetAtoms() if a.HasProp("_CIPCode")
    }
    for bond in copy.GetBonds():
        if bond.HasProp("_CIPCode"):
            labels[tuple(sorted((bond.GetBeginAtomIdx(), bond.GetEndAtomIdx())))] = bond.GetProp("_CIPCode")
    return labels


def refuse_changed_stereo(before: Any, after: Any) -> None:
    """Raise PreparationError when an element of stereo specified in `before` has another label in `after`."""
    had, has = stereo_labels(before), stereo_labels(after)
    for where, label in had.items():
        if has.get(where) != label:
            raise PreparationError(
                f"{_where(before, where)} is {label} in the input and {has.get(where, 'flat')} in 3-D; "
                "its stereo may be impossible. Give an SDF with coordinates."
            )


def _say_drawn(before: Any, after: Any, notes: list[str]) -> None:
    from rdkit import Chem

    labels = stereo_labels(after)
    for info in Chem.FindPotentialStereo(Chem.Mol(before)):
        if info.specified == Chem.StereoSpecified.Specified:
            continue
        if info.type == Chem.StereoType.Bond_Double:
            bond = before.GetBondWithIdx(info.centeredOn)
            where = tuple(sorted((bond.GetBeginAtomIdx(), bond.GetEndAtomIdx())))
        elif info.type == Chem.StereoType.Atom_Tetrahedral:
            where = (info.centeredOn,)
        else:
            continue
        if where in labels:
            notes.append(f"{_where(before, where)} is not specified: drawn as {labels[where]}")


def _where(molecule: Any, where: tuple[int, ...]) -> str:
    """`stereocentre C4` or `double bond C2=C3`, counted as atom names are."""
    names = []
    for i in where:
        symbol = molecule.GetAtomWithIdx(i).GetSymbol()
        names.append(symbol + str(sum(molecule.GetAtomWithIdx(k).GetSymbol() == symbol for k in range(i + 1))))
    return f"stereocentre {names[0]}" if len(names) == 1 else f"double bond {'='.join(names)}"


def _clean_up(molecule: Any, notes: list[str]) -> None:
    """Relax in MMFF94, in UFF where it has no parameters, and say where neither has."""
    from rdkit import rdBase
    from rdkit.Chem import rdForceFieldHelpers as force_fields

    if molecule.GetNumAtoms() < 2:
        return
    with rdBase.BlockLogs():
        if force_fields.MMFFHasAllMoleculeParams(molecule):
            force_fields.MMFFOptimizeMolecule(molecule, maxIters=_CLEAN_UP_STEPS)
        elif force_fields.UFFHasAllMoleculeParams(molecule):
            force_fields.UFFOptimizeMolecule(molecule, maxIters=_CLEAN_UP_STEPS)
        else:
            notes.append("neither MMFF94 nor UFF has parameters: the geometry is RDKit's embedding as it is")


def sanitise(molecule: Any) -> None:
    """Check valences and aromaticity in place. Raises PreparationError."""
    from rdkit import Chem, rdBase

    try:
        with rdBase.BlockLogs():
            Chem.SanitizeMol(molecule)
    except (Chem.MolSanitizeException, ValueError) as error:
        raise PreparationError(f"it is no possible molecule ({first_line(error)}).") from error


def drop_isotopes(molecule: Any, notes: list[str]) -> None:
    """Replace isotopes by the natural element, in place, and say so: force fields know natural masses alone."""
    labelled = [a for a in molecule.GetAtoms() if a.GetIsotope()]
    if labelled:
        which = ", ".join(sorted({f"{a.GetIsotope()}{a.GetSymbol()}" for a in labelled}))
        notes.append(f"isotope labels ({which}) left out: all atoms have natural masses")
        for atom in labelled:
            atom.SetIsotope(0)
