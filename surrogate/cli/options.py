"""Types of the command line's arguments and options that several verbs share, with their help."""

from __future__ import annotations

import functools
import inspect
import logging
from collections.abc import Callable
from enum import StrEnum
from typing import Annotated, Any, get_type_hints, is_typeddict

import typer

from surrogate.verbs.md_options import Flag, flags_of


def literal(text: str) -> str:
    """Return a help text in which brackets are what they look like: typer and rich take `[default: 4fs]` for markup and
    show nothing of it."""
    return text.replace("[", "\\[")


class Solver(StrEnum):
    multistep = "multistep"
    fitted = "fitted"
    euler = "euler"
    dopri5 = "dopri5"


class Stiff(StrEnum):
    modelled = "modelled"
    imposed = "imposed"


class FailOn(StrEnum):
    different = "different"
    broken = "broken"


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
SaveVelocitiesOpt = Annotated[bool, typer.Option("--save-velocities", help="Keep them with each frame (.h5).")]
SaveForcesOpt = Annotated[bool, typer.Option("--save-forces", help="Keep them with each frame (.h5).")]
ArchOpt = Annotated[
    str | None,
    typer.Option("--arch", help="lam-slide, painet, egnn, a baseline, ... Default: what suits the references."),
]
VelocitiesOpt = Annotated[bool, typer.Option("--velocities", help="Keep velocities, which painet learns from.")]
ValidationOpt = Annotated[
    list[str] | None,
    typer.Option("--validation", help="Trajectory held out whole; repeatable. Default: the last 5 % of each."),
]
DeviceOpt = Annotated[str, typer.Option("--device", help="auto, cpu or cuda.")]
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
SeedOpt = Annotated[int, typer.Option("--seed", min=0, help="Of every random number.")]
ResumeOpt = Annotated[bool, typer.Option("--resume", help="Go on where an earlier run of the same settings stopped.")]
OverwriteOpt = Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")]


def _hush(quiet: bool) -> bool:
    """Keep the lines of loggers, such as those about charges, from stderr."""
    logging.getLogger("surromd").setLevel(logging.ERROR if quiet else logging.NOTSET)
    return quiet


QuietOpt = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar, no account.", callback=_hush)]
JsonOpt = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def spread_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with one option of the command line for each of what surrogate.verbs.md_options writes once.

    A parameter that is a TypedDict of such options becomes all of them, in its place, and is given as a dictionary of
    their values in our units; one that is a single such option becomes that.
    """
    hints = get_type_hints(command, include_extras=True)
    shown: list[inspect.Parameter] = []
    grouped: dict[str, dict[str, Flag]] = {}
    for parameter in inspect.signature(command).parameters.values():
        hint = hints[parameter.name]
        if is_typeddict(hint):
            found = flags_of(hint)
            grouped[parameter.name] = {name: flag for name, (_, flag) in found.items()}
            shown += [_parameter(name, kind, flag) for name, (kind, flag) in found.items()]
        elif isinstance(flag := getattr(hint, "__metadata__", [None])[0], Flag):
            shown.append(_parameter(parameter.name, hint.__origin__, flag))
        else:
            shown.append(parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY))

    @functools.wraps(command)
    def run(**given: Any) -> None:
        for name, flags in grouped.items():
            given[name] = {option: flag.value(given.pop(option)) for option, flag in flags.items()}
        command(**given)

    run.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in shown}
    return run


def _parameter(name: str, kind: Any, flag: Flag) -> inspect.Parameter:
    """Return an option as typer takes it."""
    if flag.read is not None:
        kind, default = str | None, None
    else:
        default = flag.default
    option = typer.Option(flag.flag, help=literal(flag.help), min=flag.least, max=flag.most)
    annotation = Annotated[kind, option]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
