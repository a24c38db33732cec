"""OpenMM's files of residue templates: which belong to a force field and a water, and which residues they know."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

from systems.scene import Scene

# OpenMM's own file names: the proteins, then water and ions for each explicit solvent.
PROTEIN_FILES = {
    "ff14SB": "amber14/protein.ff14SB.xml",
    "ff19SB": "amber19/protein.ff19SB.xml",
    "ff99SB-ILDN": "amber99sbildn.xml",
    "charmm36": "charmm36.xml",
}
# ff14SB with what Amber pairs with it: DNA, RNA and phosphorylated residues
# (docs/studies/reference/phosphorylated_residues.py).
CHAIN_FILES = (
    PROTEIN_FILES["ff14SB"],
    str(files("systems.library") / "data" / "phosaa14SB.xml"),
    "amber14/DNA.OL15.xml",
    "amber14/RNA.OL3.xml",
)
_WATER_FILES = {
    "tip3p": {"ff14SB": "amber14/tip3p.xml", "ff19SB": "amber19/tip3p.xml", "ff99SB-ILDN": "amber14/tip3p.xml",
              "charmm36": "charmm36/water.xml"},
    "opc": {"ff14SB": "amber14/opc.xml", "ff19SB": "amber19/opc.xml", "ff99SB-ILDN": "amber14/opc.xml"},
}  # fmt: skip
# (cut-off, start of the switching function or None), nm: Amber's and CHARMM's own practice.
CUTOFFS_NM = {"charmm36": (1.2, 1.0)}
DEFAULT_CUTOFF_NM: tuple[float, float | None] = (0.9, None)


def water_file(protein: str, solvent: str) -> str | None:
    """Return OpenMM's file of this water (TIP3P where the solvent is implicit) and its ions, or None."""
    return _WATER_FILES["opc" if solvent == "opc" else "tip3p"].get(protein)


def chain_files(protein: str) -> tuple[str, ...]:
    """Return the files of a protein force field: its own, and those of the other residues that it goes with."""
    return CHAIN_FILES if protein == "ff14SB" else (PROTEIN_FILES[protein],)


def cutoff_nm(protein: str) -> tuple[float, float | None]:
    """Return the cut-off of direct interactions in a periodic cell and where it starts to act, in nm."""
    return CUTOFFS_NM.get(protein, DEFAULT_CUTOFF_NM)


@cache
def force_field_of(names: tuple[str, ...]) -> Any:
    """Return OpenMM's force field of these files, read once."""
    from openmm import app

    return app.ForceField(*names)


def unmatched_residues(scene: Scene, force_field: Any) -> list[int]:
    """Return the residues whose bonds fit no template. Raises InputError for residues that are not contiguous."""
    return [r.index for r in force_field.getUnmatchedResidues(scene.to_openmm_topology())]
