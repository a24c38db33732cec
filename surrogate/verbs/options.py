"""What each verb can be told: one dataclass a verb, made of those that verbs share (`systems.options`)."""

from __future__ import annotations

from dataclasses import dataclass

from surrogate.sampling.config import RolloutConfig
from systems.options import OptionRow, option, option_rows
from systems.units import Quantity, parse_mass_da


def parse_hydrogen_mass_da(text: str, what: str = "hydrogen mass") -> float | None:
    """Return the hydrogen mass in dalton, or None where natural masses are asked for. Raises UnitError."""
    return None if text in ("natural", "none") else parse_mass_da(text, what)


@dataclass(frozen=True, kw_only=True)
class Seeded:
    """Of verbs that draw random numbers."""

    seed: int = option("Of every random number.", 0, within=(0, None))


@dataclass(frozen=True, kw_only=True)
class Replicated:
    """Of verbs that run a scene several times."""

    replicas: int = option("Independent runs; NAME.h5 becomes NAME_r0.h5, ...", 1, within=(1, None))


@dataclass(frozen=True, kw_only=True)
class Quiet:
    """Of verbs that show their progress."""

    quiet: bool = option("No progress bar, no account.", False, words=("quiet", "q"))


@dataclass(frozen=True, kw_only=True)
class Overwriting:
    """Of verbs that write a file."""

    overwrite: bool = option("Replace existing output.", False)


@dataclass(frozen=True, kw_only=True)
class Resuming:
    """Of verbs that can go on where they were stopped."""

    resume: bool = option("Go on where an earlier run of the same settings stopped.", False)


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """How a Scene is made of what a user names: switches of `systems.source.prepare`."""

    ph: float = option("Where a peptide's hydrogens are added.", 7.0, within=(0.0, 14.0))
    keep_ligand: bool = option("Simulate ligands and ions beside a peptide, too.", False)
    drop_ligand: bool = option("Leave ligands and ions beside a peptide out.", False)
    drop_water: bool = option("Leave the file's waters out, as is usual.", False)
    keep_water: bool = option("Keep the file's waters, in explicit solvent.", False)
    cap_breaks: bool = option("Close a chain that breaks with ACE and NME.", False)


@dataclass(frozen=True, kw_only=True)
class MDSettings:
    """What the MD is and how it is run: fields of MDConfig and ForceFieldSpec, and what makes the box.

    What is left open (None) is settled for the scene: by the protocol that is asked for, else by what `unset` says.
    """

    protocol: str | None = option("A paper's settings, unless given: md17, md22, mdgen, fast-folders.", None)
    force_field: str | None = option("ff14SB, ff19SB, ff99SB-ILDN, charmm36, gaff2, gfn2-xtb.", None, unset="auto")
    solvent: str | None = option("obc2, gbn2, tip3p, opc, vacuum, amber99-obc.", None, unset="auto")
    level: str | None = option("mm or gfn2-xtb, quantum mechanics for molecules.", None, unset="mm")
    padding_nm: float | None = option("From the solute to the walls, in explicit water.", None, unset="1nm")
    ionic_strength_molar: float | None = option("Of NaCl in explicit water, beside counter-ions.", None, unset="0M")
    temperature_k: float | None = option("Of the bath.", None, unset="300K")
    friction_per_ps: float | None = option("Of the Langevin bath.", None, unset="1/ps")
    timestep_ps: float | None = option("Integration step.", None, unset="4fs")
    # None is a mass of its own here: the natural one.
    hydrogen_mass_da: Quantity | None = option(
        "Repartitioned mass, or 'natural'.", "default", read=parse_hydrogen_mass_da, unset="3Da"
    )
    equilibrate_ps: float | None = option("So long before frames are written.", None, unset="100ps")
    ensemble: str | None = option("nvt, nve or npt.", None, unset="nvt")
    pressure_bar: float | None = option("Of the barostat (npt).", None, unset="1bar")
    platform: str = option("OpenMM platform; auto: the fastest, timed on the scene.", "auto")


@dataclass(frozen=True, kw_only=True)
class PlanOptions(Preparation, Replicated, MDSettings):
    """What `plan` can be told."""

    time_ps: float | None = option("Estimate the wall time of a run this long.", None)


@dataclass(frozen=True, kw_only=True)
class _ReferenceTime:
    time_ps: float = option("Simulated time, such as 10ns.")
    save_every_ps: float | None = option("Interval between saved frames.", None, unset="1ps")


@dataclass(frozen=True, kw_only=True)
class ReferenceOptions(Quiet, Overwriting, Resuming, Seeded, Preparation, Replicated, MDSettings, _ReferenceTime):
    """What `reference` can be told."""

    save_velocities: bool = option("Keep them with each frame (.h5).", False)
    save_forces: bool = option("Keep them with each frame (.h5).", False)


@dataclass(frozen=True, kw_only=True)
class RolloutOptions(Quiet, Overwriting, Resuming, Preparation, Replicated, RolloutConfig):
    """What `rollout` can be told."""


# By the verb's name in Python.
VERB_OPTIONS: dict[str, type] = {
    "plan": PlanOptions,
    "reference": ReferenceOptions,
    "rollout": RolloutOptions,
}


def verb_option_rows(verb: str) -> list[OptionRow]:
    """Return the options of a verb as rows of a table, for the manual."""
    return option_rows(VERB_OPTIONS[verb])
