"""SMILES to 3-D coordinates: accepted elements, RDKit's embedding and minimisation, a check that stereo is kept.

Of a salt the one molecule that is meant is taken, without counterions and water; metals drawn with covalent bonds are
refused.
"""

from __future__ import annotations

from collections import Counter
from functools import cache
from typing import Any

from systems.errors import PreparationError, listed

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
    companions = [_is_lone(part) or key in _known() for part, key in zip(parts, keys, strict=True)]
    wanted = [k for k, companion in enumerate(companions) if not companion]
    acids = [k for k, companion in enumerate(companions) if companion and _is_neutral_organic(parts[k])]
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


def _is_lone(part: Any) -> bool:
    return part.GetNumAtoms() == 1 and part.GetAtomWithIdx(0).GetSymbol() in _MONATOMIC


def _is_organic(part: Any) -> bool:
    """Whether it has a carbon, and not carbonate's alone."""
    carbons = [a for a in part.GetAtoms() if a.GetSymbol() == "C"]
    return len(carbons) > 1 or any(n.GetSymbol() != "O" for a in carbons for n in a.GetNeighbors())


def _is_neutral_organic(part: Any) -> bool:
    return _is_organic(part) and not any(a.GetFormalCharge() for a in part.GetAtoms())


@cache
def _known() -> frozenset[str]:
    from rdkit import Chem

    return frozenset(_key(Chem.MolFromSmiles(smiles)) for smiles in _COUNTERIONS)


def _key(part: Any) -> str:
    """Canonical SMILES without charge, stereo and isotopes; empty for what is no possible molecule."""
    from rdkit import Chem, rdBase
    from rdkit.Chem.MolStandardize import rdMolStandardize

    with rdBase.BlockLogs():
        try:
            clean = Chem.Mol(part)
            Chem.SanitizeMol(clean)
            clean = rdMolStandardize.Uncharger().uncharge(Chem.RemoveHs(clean))
        except (Chem.MolSanitizeException, ValueError):
            return ""
    for atom in clean.GetAtoms():
        atom.SetIsotope(0)
    return str(Chem.MolToSmiles(clean, isomericSmiles=False))


def _smiles(part: Any) -> str:
    from rdkit import Chem, rdBase

    with rdBase.BlockLogs():
        try:
            clean = Chem.Mol(part)
            Chem.SanitizeMol(clean)
            return str(Chem.MolToSmiles(Chem.RemoveHs(clean)))
        except (Chem.MolSanitizeException, ValueError):
            return str(Chem.MolToSmiles(part))


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
    UFF. Stereo is the molecule's own; stereocentres and double bonds it leaves open are drawn and said in `notes`.

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
        reason = (str(error).strip().splitlines() or ["no reason given"])[0].rstrip(".")
        raise PreparationError(f"it is no possible molecule ({reason}).") from error


def drop_isotopes(molecule: Any, notes: list[str]) -> None:
    """Replace isotopes by the natural element, in place, and say so: force fields know natural masses alone."""
    labelled = [a for a in molecule.GetAtoms() if a.GetIsotope()]
    if labelled:
        which = ", ".join(sorted({f"{a.GetIsotope()}{a.GetSymbol()}" for a in labelled}))
        notes.append(f"isotope labels ({which}) left out: all atoms have natural masses")
        for atom in labelled:
            atom.SetIsotope(0)
