"""Types of the command line's arguments and options that several verbs share, with their help."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from systems.units import parse_mass_da


class Solver(StrEnum):
    multistep = "multistep"
    euler = "euler"
    dopri5 = "dopri5"


class Precision(StrEnum):
    auto = "auto"
    fp32 = "fp32"
    bf16 = "bf16"


class Guard(StrEnum):
    off = "off"
    flag = "flag"
    resample = "resample"
    repair = "repair"
    fallback = "fallback"


class Atoms(StrEnum):
    all = "all"
    heavy = "heavy"


SceneArg = Annotated[
    str, typer.Argument(metavar="SCENE", help="Library name, path, smiles:CCO or sequence:ACE-ALA-NME.")
]
PhOpt = Annotated[float, typer.Option("--ph", min=0.0, max=14.0, help="Where a peptide's hydrogens are added.")]
KeepLigandOpt = Annotated[bool, typer.Option("--keep-ligand", help="Simulate ligands and ions beside a peptide, too.")]
DropLigandOpt = Annotated[bool, typer.Option("--drop-ligand", help="Leave ligands and ions beside a peptide out.")]
DropWaterOpt = Annotated[bool, typer.Option("--drop-water", help="Leave the file's waters out.")]
# What a verb is not told comes from the protocol of a library scene, else from what the help calls the default.
ForceFieldOpt = Annotated[
    str | None,
    typer.Option("--force-field", help="ff14SB, ff19SB, ff99SB-ILDN, charmm36, gaff2, gfn2-xtb. [default: auto]"),
]
SolventOpt = Annotated[
    str | None, typer.Option("--solvent", help="obc2, gbn2, tip3p, opc, vacuum, amber99-obc. [default: auto]")
]
LevelOpt = Annotated[
    str | None, typer.Option("--level", help="mm or gfn2-xtb, quantum mechanics for molecules. [default: mm]")
]
PaddingOpt = Annotated[
    str | None, typer.Option("--padding", help="From the solute to the walls, in explicit water. [default: 1nm]")
]
IonicStrengthOpt = Annotated[
    str | None, typer.Option("--ionic-strength", help="Of NaCl in explicit water, beside counter-ions. [default: 0M]")
]
TemperatureOpt = Annotated[str | None, typer.Option("--temperature", help="Of the bath. [default: 300K]")]
FrictionOpt = Annotated[str | None, typer.Option("--friction", help="Of the Langevin bath. [default: 1/ps]")]
TimestepOpt = Annotated[str | None, typer.Option("--timestep", help="Integration step. [default: 4fs]")]
HydrogenMassOpt = Annotated[
    str | None, typer.Option("--hydrogen-mass", help="Repartitioned mass, or 'natural'. [default: 3Da]")
]
EquilibrateOpt = Annotated[
    str | None, typer.Option("--equilibrate", help="So long before the first frame, unwritten. [default: 100ps]")
]
EnsembleOpt = Annotated[str | None, typer.Option("--ensemble", help="nvt, nve or npt. [default: nvt]")]
PressureOpt = Annotated[float | None, typer.Option("--pressure", help="Of the barostat (npt), in bar. [default: 1]")]
SaveVelocitiesOpt = Annotated[bool, typer.Option("--save-velocities", help="Keep them with each frame (.h5).")]
SaveForcesOpt = Annotated[bool, typer.Option("--save-forces", help="Keep them with each frame (.h5).")]
ArchOpt = Annotated[
    str,
    typer.Option(
        "--arch",
        help="lam-slide, painet, egnn; baselines: frozen, constant-velocity, resampling, normal-modes, msm.",
    ),
]
VelocitiesOpt = Annotated[bool, typer.Option("--velocities", help="Keep velocities, which painet learns from.")]
ValidationOpt = Annotated[
    list[str] | None,
    typer.Option("--validation", help="Trajectory held out whole; repeatable. Default: the last 5 % of each."),
]
DeviceOpt = Annotated[str, typer.Option("--device", help="auto, cpu or cuda.")]
ReplicasOpt = Annotated[
    int, typer.Option("--replicas", min=1, help="Independent runs; NAME.h5 becomes NAME_r0.h5, ...")
]
GuardOpt = Annotated[
    Guard,
    typer.Option("--guard", help="Frames that no reference shows: mark; draw again; relax by OpenMM; MD instead."),
]
EnergyEveryOpt = Annotated[
    int, typer.Option("--energy-every", min=0, help="Check the energy of every so many frames (OpenMM).")
]
MdBetweenOpt = Annotated[str | None, typer.Option("--md-between", help="So much real MD after each chunk.")]
SelectOpt = Annotated[str | None, typer.Option("--select", help="Atoms to write, in MDTraj's words: backbone.")]
AtomsOpt = Annotated[Atoms, typer.Option("--atoms", help="Write all atoms or no hydrogens.")]
ForceOpt = Annotated[bool, typer.Option("--force", help="Roll a scene that leaves the training domain, marked.")]
WantedTemperatureOpt = Annotated[
    str | None, typer.Option("--temperature", help="Refused if it is not that of the weights.")
]
PlatformOpt = Annotated[str, typer.Option("--platform", help="OpenMM platform; auto: the fastest, timed on the scene.")]
SeedOpt = Annotated[int, typer.Option("--seed", min=0, help="Of every random number.")]
ResumeOpt = Annotated[bool, typer.Option("--resume", help="Go on where an earlier run of the same settings stopped.")]
OverwriteOpt = Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")]
QuietOpt = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar, no account.")]
JsonOpt = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def parse_hydrogen_mass_da(text: str) -> float | None:
    """Return the hydrogen mass in dalton, or None where natural masses are asked for. Raises UnitError."""
    return None if text in ("natural", "none") else parse_mass_da(text, "--hydrogen-mass")
