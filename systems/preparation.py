"""Preparation of a scene: what can be chosen about the file, SMILES or sequence that it is made of."""

from __future__ import annotations

from dataclasses import dataclass

from systems.errors import InputError
from systems.options import option


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """How a Scene is made of what a user names: options of `systems.source.prepare`."""

    ph: float = option("Where a peptide's hydrogens are added.", 7.0, within=(0.0, 14.0))
    keep_ligand: bool = option("Simulate ligands and ions beside a peptide, too.", False)
    drop_ligand: bool = option("Leave ligands and ions beside a peptide out.", False)
    drop_water: bool = option("Leave the file's waters out, as is usual.", False)
    keep_water: bool = option("Keep the file's waters, in explicit solvent.", False)
    cap_breaks: bool = option("Close a chain that breaks with ACE and NME.", False)

    def refuse_contradictions(self) -> None:
        """Raise InputError where something shall be both kept and left out."""
        for what in ("ligand", "water"):
            if getattr(self, f"keep_{what}") and getattr(self, f"drop_{what}"):
                raise InputError(f"`keep_{what}` and `drop_{what}` exclude each other; choose one.")
