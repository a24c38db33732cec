"""Salts: the one molecule that is meant beside counterions and water, and metals drawn with covalent bonds."""

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
