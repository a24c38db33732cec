"""Molecules through RDKit: SMILES, MDL MOL and SDF, Tripos MOL2 and files of components as scenes; the one molecule
that a salt means; 3-D coordinates by RDKit's embedding and minimisation, with a check that stereo is kept.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.distance_bonds import refuse_long_bonds
from systems.chemistry.element_data import atomic_weight_da
from systems.chemistry.geometry import near_pairs
from systems.chemistry.residues import NAMES
from systems.errors import InputError, PreparationError, first_line, listed
from systems.prepare.mol2_file import molecule_of, read_mol2
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

    Missing hydrogens are added (not to MOL2) and a flat drawing is embedded, each said in `provenance["repairs"]`;
    stereo is read from the positions (from the wedges of a drawing). Raises InputError for a file that cannot be read,
    PreparationError for what `scene_from_smiles` refuses.
    """
    from rdkit import Chem, rdBase

    file = Path(path).expanduser()
    notes: list[str] = []
    try:
        if suffix_of(file) == ".mol2":
            found = read_mol2(file)
            notes = found.notes
            molecule = molecule_of(found)
        else:
            text = read_text(file, "a molecule with coordinates")
            records = [r for r in text.split("$$$$") if r.strip()]
            if len(records) > 1:
                notes.append(f"{len(records)} molecules in the file: the first is taken")
            with rdBase.BlockLogs():
                molecule = Chem.MolFromMolBlock("".join(records[:1]), sanitize=False, removeHs=False)
        if molecule is None:
            raise InputError(
                f"{file} holds no molecule that can be read as {suffix_of(file)[1:].upper()}; write it again."
            )
        molecule = _resolved(main_molecule(molecule, notes), notes)
    except PreparationError as error:
        raise PreparationError(f"{file}: {error}") from error
    return scene_from_rdkit(molecule, **file_name_and_provenance(file, notes))


def scene_from_component(text: str, path: Path) -> Scene:
    """Return the scene of the first component (of the chemical component dictionary) of a CIF file, all of its atoms
    under their names, at its ideal positions.

    Where these are missing the positions of the model that the component was taken from are, then drawn ones. Raises
    InputError for atoms or bonds that cannot be read, PreparationError for what is no molecule.
    """
    import gemmi
    from rdkit import Chem

    notes: list[str] = []
    blocks = read_blocks(text, path, "_chem_comp_atom.")
    if len(blocks) > 1:
        notes.append(f"{len(blocks)} components in the file: the first is taken")
    block = blocks[0]
    molecule = Chem.RWMol()
    try:
        component = gemmi.make_chemcomp_from_block(block)
        models = [[a.pos.tolist() for a in model[0][0]] for model in gemmi.make_structure_from_chemcomp_block(block)]
        index: dict[str, int] = {}
        for each in component.atoms:
            atom = Chem.Atom(each.el.atomic_number)
            atom.SetFormalCharge(round(each.charge))
            atom.SetNoImplicit(True)
            index[each.id] = molecule.AddAtom(atom)
        for bond in component.rt.bonds:
            if bond.type.name.upper() not in Chem.BondType.names:
                raise InputError(
                    f"{path}, component {block.name}: it has bonds of type {bond.type.name.lower()!r}, which do not "
                    "fix a Lewis structure; give the wwPDB's CIF or an SDF."
                )
            order = Chem.BondType.names[bond.type.name.upper()]
            molecule.AddBond(index[bond.id1.atom], index[bond.id2.atom], order)
            for i in (index[bond.id1.atom], index[bond.id2.atom]) if order == Chem.BondType.AROMATIC else ():
                molecule.GetAtomWithIdx(i).SetIsAromatic(True)
    except (RuntimeError, LookupError, ValueError) as error:
        raise InputError(
            f"{path}, component {block.name}, cannot be read ({first_line(error)}); fetch it again."
        ) from error
    whole = [np.array(x) for x in models if np.isfinite(x).all()]
    if whole:  # the ideal positions come last
        conformer = Chem.Conformer(len(index))
        conformer.SetPositions(whole[-1])
        molecule.AddConformer(conformer)
    try:
        if len(Chem.GetMolFrags(molecule)) > 1:
            raise PreparationError("it is a salt of several molecules; give one of them.")
        resolved = _resolved(molecule, notes)
    except PreparationError as error:
        raise PreparationError(f"{path}: {error}") from error
    name = (block.find_value("_chem_comp.id") or block.name or "component").strip("'\"")
    scene = scene_from_rdkit(resolved, name=name, provenance=file_name_and_provenance(path, notes)["provenance"])
    return replace(
        scene,
        atom_names=(*index, *scene.atom_names[len(index) :]),
        residue_names=(name if len(name) <= 5 else RESIDUE_NAME,),
    )


def scene_from_rdkit(molecule: Any, *, name: str, provenance: dict[str, Any]) -> Scene:
    """Return the scene of an RDKit molecule with all hydrogens and one conformer, in its atom order. One residue; atoms
    are called after their element and a number, C1, C2, ... Adds `multiplicity` to the provenance."""
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


# ---- hydrogens and positions ----------------------------------------------------------------------------------------


def _resolved(molecule: Any, notes: list[str]) -> Any:
    """Return an unsanitised molecule with all hydrogens, at its own positions if it has three-dimensional ones. Raises
    PreparationError for what is no molecule, or has atoms on one point."""
    require(molecule)
    sanitise(molecule)
    drop_isotopes(molecule, notes)
    return _with_geometry(molecule, notes)


def _with_geometry(molecule: Any, notes: list[str]) -> Any:
    from rdkit import Chem

    conformer = molecule.GetConformer() if molecule.GetNumConformers() else None
    is_drawing = conformer is None or _is_drawing(molecule, conformer)
    if is_drawing:
        if conformer is not None:
            Chem.AssignChiralTypesFromBondDirs(molecule)
            Chem.DetectBondStereochemistry(molecule)
        Chem.AssignStereochemistry(molecule, cleanIt=True, force=True)
    out = Chem.AddHs(molecule, addCoords=not is_drawing)
    if out.GetNumAtoms() > molecule.GetNumAtoms():
        notes.append(f"hydrogens added: {out.GetNumAtoms() - molecule.GetNumAtoms()}")
    if is_drawing:
        notes.append("2-D structure: 3-D coordinates generated, stereochemistry from the wedge bonds")
        return embed(out, seed=0, notes=notes)
    symbols, positions = [atom.GetSymbol() for atom in out.GetAtoms()], np.array(out.GetConformer().GetPositions())
    if not np.isfinite(positions).all():
        raise PreparationError("a coordinate is not a number; write the file again.")
    for i, j in near_pairs(positions, 0.3, "the molecule").tolist():
        raise PreparationError(
            f"atoms {i + 1} ({symbols[i]}) and {j + 1} ({symbols[j]}) have the same coordinates; correct them."
        )
    bonds = np.array([(b.GetBeginAtomIdx(), b.GetEndAtomIdx()) for b in out.GetBonds()], dtype=np.int64)
    refuse_long_bonds(symbols, positions / 10.0, bonds, lambda i: f"{symbols[i]}{i + 1}")
    Chem.AssignStereochemistryFrom3D(out)
    return out


def _is_drawing(molecule: Any, conformer: Any) -> bool:
    """Whether the file says that it is a drawing, or all atoms are in one plane that cannot be."""
    return not conformer.Is3D() or (
        not conformer.GetPositions()[:, 2].any()
        and any(a.GetSymbol() == "C" and a.GetTotalDegree() == 4 and a.GetDegree() > 2 for a in molecule.GetAtoms())
    )


# ---- salts ----------------------------------------------------------------------------------------------------------


# Other metals hold what stands beside them: ferrocene is no salt.
_MONATOMIC = ("Li", "Na", "K", "Rb", "Cs", "Mg", "Ca", "Sr", "Ba", "Al", "Zn", "F", "Cl", "Br", "I")


def main_molecule(molecule: Any, notes: list[str]) -> Any:
    """Return the one molecule that an unsanitised RDKit molecule means, its atoms in their order. Counterions, water
    and further copies beside it are left out and said; of counterions alone the organic one. Its charge stays as
    written. Raises PreparationError for a mixture: several molecules of which none is known to be a counterion."""
    from rdkit import Chem

    parts = list(Chem.GetMolFrags(molecule, asMols=True, sanitizeFrags=False))
    if len(parts) < 2:
        return molecule
    keys = [_key(part) for part in parts]
    lone = [part.GetNumAtoms() == 1 and part.GetAtomWithIdx(0).GetSymbol() in _MONATOMIC for part in parts]
    wanted = [k for k, key in enumerate(keys) if not lone[k] and key not in _known()]
    if not wanted:  # acetate, with sodium
        wanted = [k for k, part in enumerate(parts) if sum(a.GetSymbol() == "C" for a in part.GetAtoms()) > 1]
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


@cache
def _known() -> frozenset[str]:
    from rdkit import Chem

    return frozenset(_key(Chem.MolFromSmiles(smiles)) for smiles in NAMES["counterions"])


def _key(part: Any) -> str:
    """Canonical SMILES without charge and stereo; that of the molecule as written where it is no possible one."""
    from rdkit import Chem, rdBase
    from rdkit.Chem.MolStandardize import rdMolStandardize

    try:
        with rdBase.BlockLogs():
            clean = Chem.Mol(part)
            Chem.SanitizeMol(clean)
            clean = rdMolStandardize.Uncharger().uncharge(Chem.RemoveHs(clean))
    except (Chem.MolSanitizeException, ValueError):
        return _smiles(part)
    return str(Chem.MolToSmiles(clean, isomericSmiles=False))


def _smiles(part: Any) -> str:
    from rdkit import Chem, rdBase

    with rdBase.BlockLogs():
        return str(Chem.MolToSmiles(Chem.RemoveHs(Chem.Mol(part), sanitize=False)))


# ---- embedding ------------------------------------------------------------------------------------------------------


# What some force field or GFN2-xTB describes as part of a molecule; metals are not embedded with any confidence.
_ELEMENTS = ("H", "B", "C", "N", "O", "F", "Si", "P", "S", "Cl", "Se", "Br", "I")
_LARGEST = 999
_CLEAN_UP_STEPS = 2000
# Embeddings until none has two bonds of an atom in a line, by the cosine of their angle.
_ATTEMPTS, _IN_LINE = 5, -0.95


def parse_smiles(text: str, notes: list[str]) -> Any:
    """Return the RDKit molecule of a SMILES string with all hydrogens. Raises PreparationError; see `require`."""
    from rdkit import Chem, rdBase

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
    """Raise PreparationError for wildcards, bonds without an order, metals and other elements without a model, and
    giants."""
    symbols = sorted({a.GetSymbol() for a in molecule.GetAtoms()})
    if not symbols:
        raise PreparationError("it has no atoms.")
    if "*" in symbols or any(a.HasQuery() for a in molecule.GetAtoms()):
        raise PreparationError("it holds wildcard atoms (*); write the elements.")
    for bond in molecule.GetBonds():
        if bond.HasQuery() or bond.GetBondTypeAsDouble() == 0:
            ends = (f"{a.GetSymbol()}{a.GetIdx() + 1}" for a in (bond.GetBeginAtom(), bond.GetEndAtom()))
            raise PreparationError(
                f"the bond {' - '.join(ends)} has no order (a query, or of type 0); write it as single, double, triple "
                "or aromatic."
            )
    foreign = [s for s in symbols if s not in _ELEMENTS]
    if foreign:
        raise PreparationError(
            f"it holds {', '.join(foreign)}: metals and rare elements have no parameters and no reliable 3-D "
            f"embedding; supported elements: {', '.join(_ELEMENTS)}."
        )
    if molecule.GetNumAtoms() > _LARGEST:
        raise PreparationError(f"it has {molecule.GetNumAtoms()} atoms; molecules are embedded up to {_LARGEST}.")


def embed(molecule: Any, *, seed: int, notes: list[str]) -> Any:
    """Return the molecule (all hydrogens in it) with one conformer: ETKDG (Riniker and Landrum, 2015), then MMFF94 or
    UFF. Stereo that it leaves open is drawn, and said in `notes`. Raises PreparationError when RDKit finds no geometry
    or the geometry has other stereo than the molecule."""
    from rdkit import Chem, rdBase
    from rdkit.Chem import rdDistGeom
    from rdkit.Chem import rdForceFieldHelpers as force_fields

    def embedded() -> bool:
        try:
            return bool(rdDistGeom.EmbedMolecule(out, parameters) == 0)
        except RuntimeError:  # an invariant violation, with these torsions of cyclopentane
            parameters.useSmallRingTorsions = False
            return bool(rdDistGeom.EmbedMolecule(out, parameters) == 0)

    out = Chem.Mol(molecule)
    parameters: Any = rdDistGeom.ETKDGv3()
    parameters.useSmallRingTorsions = True
    for attempt in range(_ATTEMPTS):
        out.RemoveAllConformers()
        parameters.randomSeed = (seed + 1 + attempt) % 2**31
        for random_start in (False, True):
            parameters.useRandomCoords = random_start
            with rdBase.BlockLogs():
                if embedded():
                    break
        else:
            raise PreparationError(
                "RDKit finds no 3-D geometry for it; its stereo or its rings may be impossible. Give an SDF with "
                "coordinates."
            )
        with rdBase.BlockLogs():
            if force_fields.MMFFHasAllMoleculeParams(out):
                force_fields.MMFFOptimizeMolecule(out, maxIters=_CLEAN_UP_STEPS)
            elif force_fields.UFFHasAllMoleculeParams(out):
                force_fields.UFFOptimizeMolecule(out, maxIters=_CLEAN_UP_STEPS)
        if not _stretched_angle(out):
            break
    labelled = Chem.Mol(out)
    Chem.AssignStereochemistryFrom3D(labelled)
    notes += compare_stereo(molecule, labelled)
    return out


def _stretched_angle(molecule: Any) -> bool:
    """Return whether a carbon or nitrogen of three or four bonds has two of them in a line: a saddle on which ETKDG
    leaves a methylene group now and then (one molecule in 700), and no force field gets it off."""
    x = molecule.GetConformer().GetPositions()
    centres = (
        (a.GetIdx(), [n.GetIdx() for n in a.GetNeighbors()]) for a in molecule.GetAtoms() if a.GetSymbol() in "CN"
    )
    ways = (x[near] - x[atom] for atom, near in centres if len(near) > 2)
    units = (way / np.linalg.norm(way, axis=1, keepdims=True) for way in ways)
    return any((unit @ unit.T).min() < _IN_LINE for unit in units)


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


def compare_stereo(before: Any, after: Any) -> list[str]:
    """Return a note for each element of stereo that `after` alone specifies. Raises PreparationError when one that is
    specified in `before` has another label in `after`."""
    had, has = stereo_labels(before), stereo_labels(after)
    for where, label in had.items():
        if has.get(where) != label:
            raise PreparationError(
                f"{_where(before, where)} is {label} in the input and {has.get(where, 'flat')} in 3-D; "
                "its stereo may be impossible. Give an SDF with coordinates."
            )
    return [
        f"{_where(before, k)} is not specified in the input; {label} was chosen"
        for k, label in has.items()
        if k not in had
    ]


def _where(molecule: Any, where: tuple[int, ...]) -> str:
    """`stereocentre C4` or `double bond C2=C3`, counted as atom names are."""
    names = []
    for i in where:
        symbol = molecule.GetAtomWithIdx(i).GetSymbol()
        names.append(symbol + str(sum(molecule.GetAtomWithIdx(k).GetSymbol() == symbol for k in range(i + 1))))
    return f"stereocentre {names[0]}" if len(names) == 1 else f"double bond {'='.join(names)}"


def sanitise(molecule: Any) -> None:
    """Check valences and aromaticity in place. Raises PreparationError."""
    from rdkit import Chem, rdBase

    try:
        with rdBase.BlockLogs():
            Chem.SanitizeMol(molecule)
    except (Chem.MolSanitizeException, ValueError) as error:
        raise PreparationError(f"RDKit rejects it: {first_line(error)} (is a formal charge missing?).") from error


def drop_isotopes(molecule: Any, notes: list[str]) -> None:
    """Replace isotopes by the natural element, in place, and say so: force fields know natural masses alone."""
    labelled = [a for a in molecule.GetAtoms() if a.GetIsotope()]
    if labelled:
        which = ", ".join(sorted({f"{a.GetIsotope()}{a.GetSymbol()}" for a in labelled}))
        notes.append(f"isotope labels ({which}) left out: all atoms have natural masses")
        for atom in labelled:
            atom.SetIsotope(0)
