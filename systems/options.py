"""Options of the verbs, each declared once: a field of a frozen dataclass whose metadata says what it does. From it
follow the command line, the Python call (`options_as_keywords`), the keys of a `config` file and the manual's tables.

A name ends in its unit (`time_ps`), which the command line and files leave out: there a value carries it (`time =
"10ns"`). Imports no library, so that the command's help is quick.
"""

from __future__ import annotations

import functools
import inspect
import textwrap
import tomllib
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from inspect import get_annotations
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from systems.errors import InputError, UnknownNameError, nearest
from systems.files.outside import content
from systems.units import format_quantity, parser_of, quantity, stem_of, unit_of

T = TypeVar("T")
_KEY = "option"
_SCALARS = (bool, int, float, str, Path)


class MissingOptionError(InputError):
    """An option that has no default is given nowhere. `needs` says which one, after the name of what needs it."""

    def __init__(self, option: Option, name: str) -> None:
        super().__init__(f"{name} must be given: {option.help}")
        self.needs = f"needs {name}: {option.help}"


def option(
    help: str,
    default: Any = MISSING,
    *,
    choices: Sequence[str] = (),
    within: tuple[float | None, float | None] = (None, None),
    read: Callable[[str, str], Any] | None = None,
    unset: str = "",
    words: Sequence[str] | None = (),
    section: str = "",
) -> Any:
    """Return a dataclass field that is an option; without a `default` it must be given.

    `help`: one sentence. `choices`: the values that there are; `within`: bounds of a number. `read(text, what)` returns
    the value of a text where the unit in the name does not say how. `unset`: what the default comes to, for the help.
    `words`: how the command line calls it, where that is not its name without the unit, and a letter for it; None keeps
    it off the command line. `section`: the table of a `config` file that it stands in, which keeps it off the command
    line, too.
    """
    words = None if words is None or section else tuple(words)
    said = {"help": help, "choices": tuple(choices), "within": within, "read": read, "unset": unset, "words": words}
    return field(default=default, metadata={_KEY: {**said, "section": section}})


def from_field(kind: type, name: str, default: Any = ..., *, unset: str = "") -> Any:
    """Return a dataclass field that is the option `name` of the dataclass `kind`. With another `default`, None say,
    what the option comes to is what it is there, or `unset`."""
    said, shown = cast(Any, kind).__dataclass_fields__[name].metadata[_KEY], options_of(kind)[name]
    if default is ...:
        return field(default=shown.default, metadata={_KEY: said})
    return field(default=default, metadata={_KEY: {**said, "unset": unset or shown.shown_default}})


@dataclass(frozen=True, kw_only=True)
class Option:
    """An option of a dataclass: what `option` declares, and the field's name, type and default (MISSING: none)."""

    help: str
    choices: tuple[str, ...]
    within: tuple[float | None, float | None]
    read: Callable[[str, str], Any] | None
    unset: str
    words: tuple[str, ...] | None
    section: str
    name: str
    hint: Any
    default: Any

    @property
    def required(self) -> bool:
        return self.default is MISSING

    @property
    def key(self) -> str:
        """The name in a file: without unit."""
        return self.words[0].replace("-", "_") if self.words else stem_of(self.name)

    @property
    def flags(self) -> tuple[str, ...]:
        """The names on the command line; none where it is not there."""
        if self.words is None:
            return ()
        words = self.words or (self.key.replace("_", "-"),)
        return tuple(f"{'-' if len(word) == 1 else '--'}{word}" for word in words)

    @property
    def unit(self) -> str:
        return unit_of(self.name) if self.kind is float else ""

    @property
    def many(self) -> bool:
        """Whether it takes several values."""
        return any(get_origin(hint) in (list, tuple, Sequence) for hint in _members(self.hint))

    @property
    def kind(self) -> type:
        """The type of one value: bool, int, float, str or Path; dict for a table of a file."""
        for hint in _members(self.hint):
            found = get_args(hint)[0] if get_origin(hint) in (list, tuple, Sequence) else hint
            found = _members(found)[0]
            if found in _SCALARS:
                return cast(type, found)
            if get_origin(found) is Literal:
                return str
        return dict

    @property
    def reader(self) -> Callable[[str, str], Any] | None:
        """What reads a text of it: (text, what to call it) -> value in our unit. None where a text is the value."""
        return self.read or (parser_of(self.name) if self.unit else None)

    @property
    def shown_default(self) -> str:
        """The default as the help states it; empty where there is none to state, or it must be given."""
        if self.unset or self.required or self.default is None or self.default is False or self.default == ():
            return self.unset
        if self.unit and not isinstance(self.default, str):
            return format_quantity(self.name, self.default)
        return ", ".join(map(str, self.default)) if isinstance(self.default, tuple) else str(self.default)

    def value(self, given: Any, what: str) -> Any:
        """Return what is given for it, checked and in our unit. Raises UnitError, UnknownNameError or InputError, which
        call it `what`."""
        if hasattr(given, "item") and not getattr(given, "ndim", 1):
            given = given.item()
        if self.reader is not None and (given is not None or type(None) not in get_args(self.hint)):
            several = self.many and isinstance(given, list | tuple)
            value: Any = [self._read(one, what) for one in given] if several else self._read(given, what)
        else:
            from systems.files.schema import fitted

            try:
                value = fitted(given, self.hint, what)
            except ValueError as error:
                raise InputError(f"{error}.") from None
        self.check(value, what)
        return value

    def written(self, given: Any, what: str) -> Any:
        """Return what a file gives for it; there a quantity carries its unit."""
        bare = self.unit and isinstance(given, int | float) and not isinstance(given, bool)
        return self.value(str(given) if bare else given, what)

    def _read(self, given: Any, what: str) -> Any:
        if given is None or given == self.default:
            return given
        if isinstance(given, str):
            return cast(Callable[[str, str], Any], self.reader)(given, what)
        return quantity(self.name, given, what) if self.unit else given

    def check(self, value: Any, what: str) -> None:
        """Raise UnknownNameError or InputError where a value is none of the choices, or outside the bounds."""
        for one in value if isinstance(value, list | tuple) else (value,):
            choices, (least, most) = self.choices, self.within
            if choices and one is not None and one not in choices:
                meant = nearest(str(one), list(choices))
                raise UnknownNameError(f"{what} {one!r} is unknown; choose {' or '.join(choices)}.{meant}")
            if isinstance(one, bool) or not isinstance(one, int | float):
                continue
            if least is not None and one < least:
                raise InputError(f"{what} {one!r} must be at least {least:g}.")
            if most is not None and one > most:
                raise InputError(f"{what} {one!r} must be at most {most:g}.")


def _members(hint: Any) -> list[Any]:
    """Return the types of a union, or the one type that a hint is."""
    if get_origin(hint) in (Union, types.UnionType):
        return [one for kind in get_args(hint) if kind is not types.NoneType for one in _members(kind)]
    return [hint]


def options_of(kind: type) -> dict[str, Option]:
    """Return the options of a dataclass by name: its own, then those of its bases, each in the order they stand in."""
    return _options_of(kind)


@cache
def _options_of(kind: Any) -> dict[str, Option]:
    hints = get_type_hints(kind)
    declared = {f.name: f for f in fields(kind) if _KEY in f.metadata}
    order = dict.fromkeys(name for each in kind.__mro__ for name in get_annotations(each) if name in declared)
    return {
        name: Option(**declared[name].metadata[_KEY], name=name, hint=hints[name], default=declared[name].default)
        for name in order
    }


def check_options(settings: Any) -> None:
    """Raise UnknownNameError or InputError for a value of a dataclass that its declaration does not allow."""
    for name, found in options_of(type(settings)).items():
        found.check(getattr(settings, name), name)


def gather(
    kind: type[T],
    given: Mapping[str, Any],
    *,
    file: str | Path | None = None,
    naming: Callable[[Option], str] = attrgetter("name"),
) -> T:
    """Return the dataclass `kind` of the options that are `given`, before those of a TOML `file`, before the defaults.
    `naming` says what to call an option in a message. Raises MissingOptionError, InputError for an unknown name (with
    the nearest) and what `Option.value` raises."""
    known = options_of(kind)
    values = {} if file is None else read_options(kind, file)
    for name, value in given.items():
        if name not in known:
            raise InputError(f"there is no option {name!r}.{nearest(name, list(known))}")
        values[name] = known[name].value(value, naming(known[name]))
    for name, found in known.items():
        if found.required and name not in values:
            raise MissingOptionError(found, naming(found))
    return kind(**values)


def read_options(kind: type, file: str | Path) -> dict[str, Any]:
    """Return the options that a TOML file gives, by name, in our units. Raises InputError, which names file and key."""

    known = options_of(kind)
    sections = {found.section for found in known.values()} - {""}
    record = read_toml(file)
    tables: dict[str, Any] = {"": {key: value for key, value in record.items() if key not in sections}}
    tables |= {section: record[section] for section in sections if section in record}
    values: dict[str, Any] = {}
    for section, table in tables.items():
        where = f"{file}: {section}." if section else f"{file}: "
        if not isinstance(table, dict):
            raise InputError(f"{file}: {section} is a table, [{section}], not {table!r}.")
        keys = {found.key: name for name, found in known.items() if found.section == section}
        for key, value in table.items():
            name = keys.get(key.replace("-", "_"))
            if name is None:
                raise InputError(f"{where}unknown key {key!r}.{_meant(key, section, known)}")
            values[name] = known[name].written(value, f"{where}{key}")
    return values


def _meant(key: str, section: str, known: Mapping[str, Option]) -> str:
    """Return what a key that is not known may have been meant for."""
    for found in known.values():
        if found.section != section and found.key == key:
            return f" It stands in [{found.section}]." if found.section else " It stands before the first table."
    here = [found.key for found in known.values() if found.section == section]
    return nearest(key, here) or f" Known: {', '.join(sorted(here))}."


def part_of(settings: Any, kind: type[T]) -> T:
    """Return the dataclass `kind` of the fields that `settings`, which has all of them, holds."""
    return kind(**{f.name: getattr(settings, f.name) for f in fields(cast(Any, kind)) if f.init})


def flag_of(name: str) -> str:
    """Return how the command line calls an option of this name, where nothing else is declared."""
    return f"--{stem_of(name).replace('_', '-')}"


# ---- files ----------------------------------------------------------------------------------------------------------


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return a TOML file's record. Raises InputError when it is missing or malformed."""
    try:
        from systems.files.schema import parsed  # loads NumPy

        return dict(parsed(content(Path(path)).decode(), tomllib.loads))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist.") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is not valid TOML: {error}.") from error


# ---- functions that take options ------------------------------------------------------------------------------------


R = TypeVar("R")


def options_as_keywords(kind: type) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Let a function whose last parameter is `options`, a dataclass `kind`, be called with these options as keywords,
    which its signature lists and its documentation explains. `options=` takes the dataclass itself, `config=` the path
    of a TOML file; keywords come before both. Any other keyword is a TypeError, as always, which names the nearest."""
    known = options_of(kind)

    def decorate(function: Callable[..., R]) -> Callable[..., R]:
        plain = inspect.signature(function)
        own = [parameter for name, parameter in plain.parameters.items() if name != "options"]
        inputs = inspect.Signature(own)
        whole = plain.replace(parameters=[*own, *_keywords(kind, known)])

        @functools.wraps(function)
        def call(*args: Any, options: Any = None, config: str | Path | None = None, **keywords: Any) -> R:
            given = {name: keywords.pop(name) for name in known if name in keywords}
            for name in keywords:
                if name not in inputs.parameters:
                    meant = nearest(name, [*known, *inputs.parameters, "options", "config"])
                    raise TypeError(f"{function.__name__}() got an unexpected keyword argument {name!r}.{meant}")
            try:
                bound = inputs.bind(*args, **keywords)
                if options is not None:
                    if not isinstance(options, kind):
                        raise TypeError(f"options must be a {kind.__name__}, not {type(options).__name__}")
                    given = {name: getattr(options, name) for name in known} | given
                resolved: Any = gather(kind, given, file=config)
            except MissingOptionError as error:
                raise TypeError(f"{function.__name__}() {error.needs}") from None
            except TypeError as error:
                raise TypeError(f"{function.__name__}() {error}") from None
            return function(*bound.args, **bound.kwargs, options=resolved)

        call.__signature__ = whole  # type: ignore[attr-defined]
        call.__doc__ = f"{inspect.cleandoc(function.__doc__ or '')}\n\n{_documented(known)}\n"
        return call

    return decorate


def _keywords(kind: type, known: dict[str, Option]) -> list[inspect.Parameter]:
    """Return the parameters that options come in by."""

    def keyword(name: str, default: Any, annotation: Any) -> inspect.Parameter:
        return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)

    needed = inspect.Parameter.empty
    return [
        *(keyword(o.name, needed if o.default is MISSING else o.default, o.hint) for o in known.values()),
        keyword("options", None, kind | None),
        keyword("config", None, str | Path | None),
    ]


def _documented(known: dict[str, Option]) -> str:
    """Return what each option does, one after the other, as a docstring says it."""
    lines = ["Options, by keyword or in the TOML file `config`:", ""]
    for option in known.values():
        default = "required" if option.required else f"default {shown}" if (shown := option.shown_default) else ""
        said = [option.unit, " | ".join(option.choices), default]
        about = ", ".join(word for word in said if word)
        lines.append(f"{option.name}{f' ({about})' if about else ''}")
        lines += textwrap.wrap(option.help, 112, initial_indent="    ", subsequent_indent="    ")
    return "\n".join(lines)


# ---- how a scene is prepared ----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """How a Scene is made of what a user names: options of `systems.library.named_scenes.prepare`."""

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
