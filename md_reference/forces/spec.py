"""Specification of the forces: force field, solvent, hydrogen masses and constraints, and which combinations exist;
OpenMM's files of residue templates: which belong to a force field and a water, and which residues they know.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from systems.errors import InputError, PreparationError, UnknownNameError, nearest
from systems.options import check_options, option
from systems.units import quantity

if TYPE_CHECKING:
    from systems.scene import Scene

PROTEIN_FORCE_FIELDS = ("ff14SB", "ff19SB", "ff99SB-ILDN", "charmm36")
QUANTUM = "gfn2-xtb"
MODEL = "model"
_WITH_LIGANDS = tuple(f"{name}+gaff2" for name in PROTEIN_FORCE_FIELDS if name != "charmm36")
FORCE_FIELDS = (*PROTEIN_FORCE_FIELDS, "gaff2", *_WITH_LIGANDS, QUANTUM, MODEL, "auto")
IMPLICIT_SOLVENTS = ("obc2", "gbn2", "amber99-obc")
EXPLICIT_SOLVENTS = ("tip3p", "opc")
QUANTUM_SOLVENTS = ("alpb-water",)
SOLVENTS = (*IMPLICIT_SOLVENTS, *EXPLICIT_SOLVENTS, *QUANTUM_SOLVENTS, "vacuum", "auto")


def parse_hydrogen_mass_da(text: str, what: str = "hydrogen mass") -> float | None:
    """Return the hydrogen mass in dalton, or None where natural masses are asked for. Raises UnitError."""
    return None if text in ("natural", "none") else quantity("hydrogen_mass_da", text, what)


@dataclass(frozen=True, kw_only=True)
class WaterBox:
    """The periodic cell of water that a scene is put into where the solvent is explicit. Raises InputError."""

    padding_nm: float = option("Least distance between the solute and its periodic images.", 1.0, within=(0.3, 10.0))
    ionic_strength_molar: float = option(
        "NaCl concentration in explicit water, beyond counter-ions.", 0.0, within=(0.0, 5.0)
    )

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class ForceFieldSpec:
    """What the forces are. `hydrogen_mass_da=None` leaves natural masses; rigid bonds to hydrogen are needed above 1
    fs.

    `force_field`: a protein force field; 'gaff2' (GAFF2 with AM1-BCC charges) for any other molecule; 'ff14SB+gaff2'
    for scenes with both; 'gfn2-xtb' (quantum mechanics by tblite); 'model' for scenes with `interactions`; 'auto',
    which `resolve` settles. `solvent`: 'obc2' (GBSA-OBC2, Onufriev 2004, mbondi2 radii), 'gbn2' (Nguyen 2013, mbondi3),
    'amber99-obc' (ff99SB-ILDN only), 'tip3p' or 'opc' (explicit: `solvation.solvate`), 'alpb-water' (Ehlert 2021;
    gfn2-xtb only), 'vacuum', or 'auto'.
    """

    force_field: str = option("Force field: ff14SB, ff19SB, ff99SB-ILDN, charmm36, gaff2, gfn2-xtb.", "ff14SB")
    solvent: str = option(
        "Solvent model: obc2, gbn2, tip3p, opc, vacuum, amber99-obc; alpb-water for gfn2-xtb.", "obc2"
    )
    hydrogen_mass_da: float | None = option(
        "Mass of hydrogens after repartitioning, or 'natural'.", 3.0, read=parse_hydrogen_mass_da
    )
    constrain_hydrogens: bool = option("Keep bonds to hydrogen rigid.", True, words=None)

    def __post_init__(self) -> None:
        for what, name, known in (
            ("force field", self.force_field, FORCE_FIELDS), ("solvent", self.solvent, SOLVENTS)
        ):  # fmt: skip
            if name not in known:
                meant = nearest(name, list(known))
                raise UnknownNameError(f"unknown {what} {name!r}; known: {', '.join(known)}.{meant}")
        only = {"amber99-obc": "ff99SB-ILDN", **dict.fromkeys(QUANTUM_SOLVENTS, QUANTUM)}.get(self.solvent)
        if only and self.force_field != only:
            raise PreparationError(f"solvent {self.solvent!r} goes with {only} alone; use obc2 or tip3p otherwise.")
        own = {QUANTUM: QUANTUM_SOLVENTS, MODEL: (), "charmm36": ("obc2", "gbn2", "tip3p")}.get(
            self.force_field, SOLVENTS
        )
        if self.solvent not in (*own, "vacuum", "auto"):
            instead = "".join(f"{name}, " for name in own)
            raise PreparationError(
                f"{self.force_field} has no solvent {self.solvent!r}; give {instead}vacuum, or leave `solvent` out."
            )

    @staticmethod
    def of(record: Mapping[str, Any]) -> ForceFieldSpec:
        """Return what a trajectory's record, or the conditions of a training, say of the forces. Raises KeyError where
        they name no force field or no solvent."""
        return ForceFieldSpec(
            record["force_field"],
            record["solvent"],
            record.get("hydrogen_mass_da"),
            constrain_hydrogens=record.get("constrain_hydrogens", True),
        )

    @property
    def is_explicit(self) -> bool:
        """Whether the solvent is made of molecules, in a periodic cell."""
        return self.solvent in EXPLICIT_SOLVENTS

    @property
    def is_born(self) -> bool:
        """Whether there is a generalised Born term."""
        return self.solvent in IMPLICIT_SOLVENTS

    @property
    def protein(self) -> str:
        """The force field of peptides, water and ions."""
        name = self.force_field.removesuffix("+gaff2")
        return name if name in PROTEIN_FORCE_FIELDS else "ff14SB"

    def openmm_settings(self) -> dict[str, Any]:
        """Return constraints and hydrogen masses as `createSystem` of OpenMM's force fields takes them."""
        from openmm import app, unit

        mass = self.hydrogen_mass_da
        return {
            "constraints": app.HBonds if self.constrain_hydrogens else None,
            "hydrogenMass": None if mass is None else mass * unit.dalton,
            "removeCMMotion": False,
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is known to go badly together, one line each."""
        name, solvent = self.protein, self.solvent
        if self.is_born and name == "ff19SB":
            return (f"ff19SB is tuned for OPC water; with {solvent} helices and turns are off. Use ff14SB.",)
        if self.is_born and name == "charmm36":
            return (f"charmm36 was not made for {solvent}, whose radii are Amber's. Use ff14SB, or tip3p.",)
        if solvent == "tip3p" and name == "ff19SB":
            return ("ff19SB is tuned for OPC water; use `solvent='opc'`.",)
        return ()


def at_level(level: str | None, force_field: str | None) -> str | None:
    """Return the force field that a level of theory ('mm', 'gfn2-xtb' or None) leaves or demands. Raises
    UnknownNameError, and InputError where the two contradict each other."""
    if level is None:
        return force_field
    if level not in ("mm", QUANTUM):
        raise UnknownNameError(f"unknown level {level!r}; known: mm, {QUANTUM}." + nearest(level, ["mm", QUANTUM]))
    if (level == QUANTUM) != (force_field == QUANTUM) and force_field not in (None, "auto"):
        raise InputError(f"`level='{level}'` contradicts `force_field='{force_field}'`; give one of them.")
    return QUANTUM if level == QUANTUM else force_field


# ---- OpenMM's files of residue templates ----------------------------------------------------------------------------


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


def water_file(protein: str, solvent: str) -> str | None:
    """Return OpenMM's file of this water (TIP3P where the solvent is implicit) and its ions, or None."""
    return _WATER_FILES["opc" if solvent == "opc" else "tip3p"].get(protein)


def chain_files(protein: str) -> tuple[str, ...]:
    """Return the files of a protein force field: its own, and those of the other residues that it goes with."""
    return CHAIN_FILES if protein == "ff14SB" else (PROTEIN_FILES[protein],)


def cutoff_nm(protein: str) -> tuple[float, float | None]:
    """Return the cut-off of direct interactions in a periodic cell and where switching starts, in nm: Amber's and
    CHARMM's own practice."""
    return (1.2, 1.0) if protein == "charmm36" else (0.9, None)


@cache
def force_field_of(names: tuple[str, ...]) -> Any:
    """Return OpenMM's force field of these files, read once."""
    from openmm import app

    return app.ForceField(*names)


def unmatched_residues(scene: Scene, force_field: Any) -> list[int]:
    """Return the residues whose bonds fit no template. Raises InputError for residues that are not contiguous."""
    return [r.index for r in force_field.getUnmatchedResidues(scene.to_openmm_topology())]
