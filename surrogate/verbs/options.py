"""Options of the verbs: one dataclass a verb, made of those that verbs share (`systems.options`); and the
lines that verbs write to stderr, which name options in backticks."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import MDConfig
from surrogate.sampling.config import GUARDS, RolloutConfig
from systems.options import Preparation, from_field, option
from systems.units import Quantity, parse_time_ps

PathLike = str | Path
# A file, a folder, a glob, a comma-separated list, or a sequence of these: replicas of each other.
Trajectories = PathLike | Sequence[PathLike]


# How options that a line names in backticks are written; the command line, where they are flags, sets its own.
said: ContextVar[Callable[[str], str]] = ContextVar("said", default=str)


def tell(name: str, line: str, *, quiet: bool = False) -> None:
    """Write a line about a scene or a file to stderr, unless `quiet`."""
    if not quiet:
        sys.stderr.write(f"{name}: {said.get()(line)}\n")


@dataclass(frozen=True, kw_only=True)
class Seeded:
    seed: int = option("Random seed.", 0, within=(0, None))


@dataclass(frozen=True, kw_only=True)
class Replicated:
    replicas: int = option("Independent runs; NAME.h5 becomes NAME_r0.h5, ...", 1, within=(1, None))


@dataclass(frozen=True, kw_only=True)
class Joining(Replicated):
    join: bool = option("Also write all replicas into one file, NAME.h5.", False)


@dataclass(frozen=True, kw_only=True)
class Quiet:
    quiet: bool = option("No progress bar and no summary.", False, words=("quiet", "q"))


@dataclass(frozen=True, kw_only=True)
class Overwriting:
    overwrite: bool = option("Overwrite existing output.", False)


@dataclass(frozen=True, kw_only=True)
class Resuming:
    resume: bool = option("Continue an interrupted run of the same settings.", False)


@dataclass(frozen=True, kw_only=True)
class Validated:
    validation: Trajectories | None = option(
        "Trajectory kept for validation; repeatable.", None, unset="the last 5 % of each"
    )


@dataclass(frozen=True, kw_only=True)
class MDSettings:
    """What the MD is and how it is run: fields of MDConfig, ForceFieldSpec and WaterBox. What is left open (None) is
    resolved for the scene: by the protocol that is asked for, else by its default there."""

    protocol: str | None = option(
        "Conditions of a published data set, with our force fields: md17, md22, mdgen, fast-folders.", None
    )
    force_field: str | None = from_field(ForceFieldSpec, "force_field", None, unset="auto")
    solvent: str | None = from_field(ForceFieldSpec, "solvent", None, unset="auto")
    level: str | None = option(
        "Level of theory: mm (force field) or gfn2-xtb (semiempirical quantum chemistry).", None, unset="mm"
    )
    padding_nm: float | None = from_field(WaterBox, "padding_nm", None)
    ionic_strength_molar: float | None = from_field(WaterBox, "ionic_strength_molar", None)
    temperature_k: float | None = from_field(MDConfig, "temperature_k", None)
    friction_per_ps: float | None = from_field(MDConfig, "friction_per_ps", None)
    timestep_ps: float | None = from_field(MDConfig, "timestep_ps", None)
    # None is a mass of its own here: the natural one.
    hydrogen_mass_da: Quantity | None = from_field(ForceFieldSpec, "hydrogen_mass_da", "default")
    equilibrate_ps: float | None = from_field(MDConfig, "equilibrate_ps", None)
    ensemble: str | None = from_field(MDConfig, "ensemble", None)
    pressure_bar: float | None = from_field(MDConfig, "pressure_bar", None)
    platform: str = from_field(MDConfig, "platform")
    starts: str = from_field(MDConfig, "starts")


@dataclass(frozen=True, kw_only=True)
class PlanOptions(MDSettings, Replicated, Preparation):
    """Options of `plan`."""

    time_ps: float | None = option("Run length whose wall time is estimated.", None)


@dataclass(frozen=True, kw_only=True)
class ReferenceOptions(MDSettings, Joining, Preparation, Seeded, Resuming, Overwriting, Quiet):
    """Options of `reference`."""

    time_ps: float = from_field(MDConfig, "time_ps")
    save_every_ps: float | None = from_field(MDConfig, "save_every_ps", None)
    keep: str = from_field(MDConfig, "keep")
    save_velocities: bool = from_field(MDConfig, "save_velocities")
    save_forces: bool = from_field(MDConfig, "save_forces")


@dataclass(frozen=True, kw_only=True)
class RolloutOptions(RolloutConfig, Joining, Preparation, Resuming, Overwriting, Quiet):
    """Options of `rollout`."""

    level: str | None = option("Level of theory of shipped weights: mm or gfn2-xtb.", None, unset="that of any")


@dataclass(frozen=True, kw_only=True)
class OnDask:
    workers: int | None = option(
        "Number of local processes, if several scenes run.", None, within=(1, None), unset="one per core"
    )
    scheduler: str | None = option("Address of a Dask scheduler, such as tcp://host:8786.", None)


@dataclass(frozen=True, kw_only=True)
class CampaignOptions(OnDask, Quiet):
    """Options of `campaign` beside its file."""

    dry_run: bool = option("List the runs without starting them.", False)


@dataclass(frozen=True, kw_only=True)
class WindowsOptions(Validated, Overwriting, Quiet):
    """Options of `windows`."""

    velocities: bool = option("Store velocities (needed by painet).", False)
    canonical: bool = option("Superpose frames on one pose, unless velocities are kept.", True, words=None)


@dataclass(frozen=True, kw_only=True)
class CompareOptions(Overwriting):
    """Options of `compare`. Of `top` and `dt_ps` one stands for all, or there is one for the reference, each
    candidate and the replicate, in this order, None where the file says it itself."""

    replicate: Trajectories | None = option("Independent reference run, for the replicate baseline.", None)
    top: PathLike | Sequence[PathLike | None] | None = option(
        "Topology file: once for all, or repeated in the order REF, TRAJ, ..., replicate ('-' for none).",
        None,
        read=lambda text, what: None if text == "-" else text,
    )
    dt_ps: float | Sequence[float | None] | None = option(
        "Time between frames, such as 10ps, instead of the file's; once for all, or repeated as the topology is.",
        None,
        read=lambda text, what: None if text == "-" else parse_time_ps(text, what),
    )
    labels: str | Sequence[str] | None = option("Names of the candidates in the report.", None, words=None)


@dataclass(frozen=True, kw_only=True)
class DemoOptions(Seeded, Quiet):
    """Options of `demo`."""

    reference_ps: float = option("Of each of two OpenMM runs.", 3_000.0, words=None)
    rollout_ps: float = option("Of each rollout.", 3_200.0, words=None)
    rollout_save_every_ps: float = option("Between frames of it.", 2.0, words=None)
    rollout_replicas: int = option("Rollouts side by side.", 8, within=(1, None), words=None)


@dataclass(frozen=True, kw_only=True)
class TrainOptions(Validated, Seeded, Resuming, Overwriting, Quiet):
    """Options of `train`. What is left open is chosen to suit the references, and said with its reason."""

    arch: str | None = option(
        "Model architecture: lam-slide, painet, egnn, a baseline, or an installed plug-in.",
        None,
        unset="chosen from the references",
    )
    level: str | None = option("Train a potential on forces at this level of theory: gfn2-xtb.", None)
    budget_s: float | None = option("Wall-time budget, such as 30min.", None)
    steps: int | None = option("Number of optimiser steps, instead of a budget.", None, within=(1, None))
    start_from: str | Path | None = option("Pretrained weights to fine-tune: a name or a file.", None, words=("from",))
    longest_lag_ps: float | None = option("Learn all lag times up to this one, such as 1ns.", None)
    device: str = option("Compute device.", "auto", choices=("auto", "cpu", "cuda"))
    model: dict[str, Any] | None = option("Settings of the network, as explained.", None, words=None)
    training: dict[str, Any] | None = option("Settings of its training, as explained.", None, words=None)


@dataclass(frozen=True, kw_only=True)
class RunOptions(MDSettings, Preparation, OnDask, Seeded, Resuming, Overwriting, Quiet):
    """Options of `run`. `workers` and `scheduler` are those of many molecules."""

    budget_s: float = option("Total wall-time budget, such as 1h.", 600.0)
    way: str = option(
        "Method: md, surrogate (it finds the states, MD weighs them) or auto (least expected error).",
        "auto",
        choices=("auto", "md", "surrogate"),
    )
    weights: str | Path | None = option(
        "Name of shipped weights, or a .safetensors file.", None, unset="those that cover SCENE"
    )
    save_every_ps: float | None = option("Interval between saved frames.", None, unset="what can be compared in time")
    format: str = option("Trajectory format.", "h5", choices=("h5", "dcd", "xtc"))
    cores: int | None = option("Maximum number of CPU cores.", None, within=(1, None), unset="all")
    dry_run: bool = option("Print the timings and the decision without running.", False)


@dataclass(frozen=True, kw_only=True)
class CostErrorConfig:
    """What is the same for all settings. Rolled are `time_ps` in all replicas together, in `rounds` parts, after
    `discarded_ps` of each replica that count in neither cost nor error; MD runs `slice_ps` before each part."""

    time_ps: float = option("Rollout time per setting, all replicas together.", 20_000.0, within=(1.0, None))
    discarded_ps: float = option("Time left out at the start of each replica.", 100.0, within=(0.0, None), words=None)
    rounds: int = option("Number of blocks, alternating with OpenMM.", 4, within=(1, None))
    slice_ps: float = option("Length of MD before each block.", 40.0, within=(0.01, None), words=None)
    lag_ps: float | None = option(
        "Interval between compared frames.", None, within=(1e-6, None), unset="as in the references"
    )
    threads: int = option("Number of threads of both.", 1, within=(1, None), words=None)
    seed: int = option("Random seed.", 0, within=(0, None))


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """The settings of a benchmark: all combinations of what is given."""

    solvers: Sequence[str] | None = option(
        "Solver to try; repeatable.", None, words=("solver",), unset="all of a fixed number of steps"
    )
    steps: Sequence[int] = option("Solver steps to try; repeatable.", (2, 3, 4, 6, 10, 20), within=(1, None))
    precisions: Sequence[str] = option(
        "Precision to try; repeatable.", ("auto",), choices=("auto", "fp32", "bf16"), words=("precision",)
    )
    batches: Sequence[int] = option("Number of replicas to try; repeatable.", (32,), within=(1, None), words=("batch",))


@dataclass(frozen=True, kw_only=True)
class CostErrorOptions(CostErrorConfig, Sweep, Quiet):
    """Options of `bench cost-error`: what is the same for all settings, and which settings."""


@dataclass(frozen=True, kw_only=True)
class StressOptions(Seeded, Quiet):
    """Options of `stress`."""

    frames: Sequence[int] | None = option(
        "Rollout length in frames, all replicas together; repeatable.", None, within=(1, None), unset="10000 and 100000"
    )
    replicas: int | None = option("Number of rollout replicas.", None, within=(1, None), unset="16")
    guards: Sequence[str] = option(
        "Guard policy of the rollouts; repeatable.", ("flag", "repair"), choices=GUARDS, words=("guard",)
    )
    sections: Sequence[str] = option(
        "Test to run; repeatable.",
        ("length", "inputs", "openmm"),
        choices=("length", "inputs", "openmm"),
        words=("section",),
    )
    scene: str | None = option(
        "Scene to test, for weights of several peptides, such as sequence:ACE-LEU-SER-NME.", None
    )
    quick: bool = option("Short runs: a minute or two.", False)


# By the verb's name in Python.
VERB_OPTIONS: dict[str, type] = {
    "demo": DemoOptions,
    "plan": PlanOptions,
    "reference": ReferenceOptions,
    "campaign": CampaignOptions,
    "windows": WindowsOptions,
    "train": TrainOptions,
    "rollout": RolloutOptions,
    "compare": CompareOptions,
    "run": RunOptions,
}
