"""Preparation of a scene: what can be chosen about the file, SMILES or sequence that it is made of."""

from __future__ import annotations

from dataclasses import dataclass

from systems.errors import InputError
from systems.options import option


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """How a Scene is made of what a user names: options of `systems.source.prepare`."""

    ph: float = option("pH at which missing hydrogens of peptides are added.", 7.0, within=(0.0, 14.0))
    keep_ligand: bool = option("Keep ligands and ions beside a peptide.", False)
    drop_ligand: bool = option("Remove ligands and ions beside a peptide.", False)
    drop_water: bool = option("Remove crystal waters (the default).", False)
    keep_water: bool = option("Keep crystal waters (explicit solvent only).", False)
    cap_breaks: bool = option("Cap chain breaks with ACE and NME.", False)

    def refuse_contradictions(self) -> None:
        """Raise InputError where something shall be both kept and left out."""
        for what in ("ligand", "water"):
            if getattr(self, f"keep_{what}") and getattr(self, f"drop_{what}"):
                raise InputError(f"`keep_{what}` and `drop_{what}` exclude each other; choose one.")
