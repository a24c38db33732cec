"""The options of a reference run, each written once: name with unit, type, default, flag and help.

Python takes them as keywords (`takes`), the command line as flags (`surrogate.cli.options.spread_options`); a
campaign's file calls them as the flags do (`md_reference.campaign.run_options`). What is left open (None) is settled
for the scene: by the protocol that is asked for, else by what the help calls the default.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, ParamSpec, TypedDict, TypeVar, get_type_hints

from systems.units import (
    Quantity,
    parse_length_nm,
    parse_mass_da,
    parse_molar,
    parse_pressure_bar,
    parse_rate_per_ps,
    parse_temperature_k,
    parse_time_or_none_ps,
    parse_time_ps,
)

P = ParamSpec("P")
R = TypeVar("R")
# Where None says something itself.
Default = Literal["default"]


@dataclass(frozen=True)
class Flag:
    """How an option is written on the command line. `read(text, flag)` returns its value in our units; None where the
    text is the value. `least`, `most`: bounds of a number."""

    flag: str
    help: str
    default: Any = None
    read: Callable[[str, str], Any] | None = None
    least: float | None = None
    most: float | None = None

    def value(self, given: Any) -> Any:
        """Return the option's value for what stands on the command line. Raises UnitError."""
        if self.read is None:
            return given
        return self.default if given is None else self.read(given, self.flag)


def parse_hydrogen_mass_da(text: str, what: str = "hydrogen mass") -> float | None:
    """Return the hydrogen mass in dalton, or None where natural masses are asked for. Raises UnitError."""
    return None if text in ("natural", "none") else parse_mass_da(text, what)


Replicas = Annotated[int, Flag("--replicas", "Independent runs; NAME.h5 becomes NAME_r0.h5, ...", default=1, least=1)]


class MDSettings(TypedDict, total=False):
    """What the MD is and how it is run: fields of MDConfig and ForceFieldSpec, and what makes the box."""

    protocol: Annotated[
        str | None, Flag("--protocol", "A paper's settings, unless given: md17, md22, mdgen, fast-folders.")
    ]
    force_field: Annotated[
        str | None, Flag("--force-field", "ff14SB, ff19SB, ff99SB-ILDN, charmm36, gaff2, gfn2-xtb. [default: auto]")
    ]
    solvent: Annotated[str | None, Flag("--solvent", "obc2, gbn2, tip3p, opc, vacuum, amber99-obc. [default: auto]")]
    level: Annotated[str | None, Flag("--level", "mm or gfn2-xtb, quantum mechanics for molecules. [default: mm]")]
    padding_nm: Annotated[
        Quantity | None,
        Flag("--padding", "From the solute to the walls, in explicit water. [default: 1nm]", read=parse_length_nm),
    ]
    ionic_strength_molar: Annotated[
        Quantity | None,
        Flag("--ionic-strength", "Of NaCl in explicit water, beside counter-ions. [default: 0M]", read=parse_molar),
    ]
    temperature_k: Annotated[
        Quantity | None, Flag("--temperature", "Of the bath. [default: 300K]", read=parse_temperature_k)
    ]
    friction_per_ps: Annotated[
        Quantity | None, Flag("--friction", "Of the Langevin bath. [default: 1/ps]", read=parse_rate_per_ps)
    ]
    timestep_ps: Annotated[Quantity | None, Flag("--timestep", "Integration step. [default: 4fs]", read=parse_time_ps)]
    hydrogen_mass_da: Annotated[
        Quantity | Default | None,
        Flag(
            "--hydrogen-mass",
            "Repartitioned mass, or 'natural'. [default: 3Da]",
            default="default",
            read=parse_hydrogen_mass_da,
        ),
    ]
    equilibrate_ps: Annotated[
        Quantity | None,
        Flag("--equilibrate", "So long before frames are written. [default: 100ps]", read=parse_time_or_none_ps),
    ]
    ensemble: Annotated[str | None, Flag("--ensemble", "nvt, nve or npt. [default: nvt]")]
    pressure_bar: Annotated[
        Quantity | None, Flag("--pressure", "Of the barostat (npt). [default: 1bar]", read=parse_pressure_bar)
    ]
    replicas: Replicas
    platform: Annotated[
        str, Flag("--platform", "OpenMM platform; auto: the fastest, timed on the scene.", default="auto")
    ]


class Preparation(TypedDict, total=False):
    """How a Scene is made of what a user names: switches of `systems.source.prepare`."""

    ph: Annotated[float, Flag("--ph", "Where a peptide's hydrogens are added.", default=7.0, least=0.0, most=14.0)]
    keep_ligand: Annotated[
        bool, Flag("--keep-ligand", "Simulate ligands and ions beside a peptide, too.", default=False)
    ]
    drop_ligand: Annotated[bool, Flag("--drop-ligand", "Leave ligands and ions beside a peptide out.", default=False)]
    drop_water: Annotated[bool, Flag("--drop-water", "Leave the file's waters out, as is usual.", default=False)]
    keep_water: Annotated[bool, Flag("--keep-water", "Keep the file's waters, in explicit solvent.", default=False)]
    cap_breaks: Annotated[bool, Flag("--cap-breaks", "Close a chain that breaks with ACE and NME.", default=False)]


class MDOptions(MDSettings, Preparation, total=False):
    """All that `plan` and `reference` share."""


def flags_of(options: Any) -> dict[str, tuple[Any, Flag]]:
    """Return the type and the flag of each option of a TypedDict, in order."""
    hints = get_type_hints(options, include_extras=True)
    return {name: (hint.__origin__, hint.__metadata__[0]) for name, hint in hints.items()}


def takes(options: Any) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Let a verb that ends in `**options: Unpack[...]` be called with all of them filled in by their defaults, and
    texts with units (`temperature_k="310K"`) read.

    Its signature lists them one by one, as an editor or `help` shows it. Any other keyword is a TypeError, as always.
    """

    def decorate(verb: Callable[P, R]) -> Callable[P, R]:
        plain, flags = inspect.signature(verb), flags_of(options)
        named = [p for p in plain.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
        whole = plain.replace(
            parameters=[
                *named,
                *(
                    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=flag.default, annotation=kind)
                    for name, (kind, flag) in flags.items()
                ),
            ]
        )

        @functools.wraps(verb)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                bound = whole.bind(*args, **kwargs)
            except TypeError as error:
                raise TypeError(f"{verb.__name__}() {error}") from None
            bound.apply_defaults()
            for name, (_, flag) in flags.items():
                value = bound.arguments[name]
                if flag.read is not None and isinstance(value, str) and value != flag.default:
                    bound.arguments[name] = flag.read(value, name)
            return verb(*bound.args, **bound.kwargs)

        call.__signature__ = whole  # type: ignore[attr-defined]
        return call

    return decorate
