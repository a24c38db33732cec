"""Types of the command line's arguments and options that several verbs share, with their help."""

from __future__ import annotations

import functools
import inspect
import logging
from collections.abc import Callable, Iterable
from dataclasses import is_dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, cast, get_type_hints

import typer

from systems.options import MissingOptionError, Option, gather, options_of


def literal(text: str) -> str:
    """Return a help text in which brackets are what they look like: typer and rich take `[default: 4fs]` for markup and
    show nothing of it."""
    return text.replace("[", "\\[")


def _scenes(incomplete: str) -> list[str]:
    """Return the library's names that begin so, for a shell that completes the word."""
    from systems.library.named_scenes import names

    return [name for name in names() if name.startswith(incomplete)]


def _weights(incomplete: str) -> list[str]:
    from surrogate.models.architecture import shipped_weights

    return [name for name in shipped_weights() if name.startswith(incomplete)]


SceneArg = Annotated[
    str,
    typer.Argument(
        metavar="SCENE", help="Library name, path, smiles:CCO or sequence:ACE-ALA-NME.", autocompletion=_scenes
    ),
]
WeightsOpt = Annotated[
    str | None,
    typer.Option(
        "--weights",
        help="Shipped weights by name, or a .safetensors file (default: those that cover SCENE).",
        autocompletion=_weights,
    ),
]
OutOpt = Annotated[Path, typer.Option("--out", "-o", help="Output trajectory (.h5, .dcd or .xtc).")]


def usage_error(message: str, context: Any = None) -> Exception:
    """Return click's error that ends a command with its usage, a message and exit code 2."""
    # Newer versions of typer bring a click of their own, under another name.
    kind: Any = next(each for each in typer.BadParameter.__mro__ if each.__name__ == "UsageError")
    made: Exception = kind(message, context)
    return made


def _hush(quiet: bool) -> bool:
    """Keep the lines of loggers, such as those about charges, from stderr."""
    logging.getLogger("surromd").setLevel(logging.ERROR if quiet else logging.NOTSET)
    return quiet


JsonOpt = Annotated[bool, typer.Option("--json", help="Print the result as JSON to stdout.")]


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with an option of the command line for each that its dataclasses of options declare.

    A parameter of such a type (`options: RolloutOptions`) becomes all of them, in its place, and `--config FILE`, which
    what stands on the command line comes before. Names and units are those of `systems.options`.
    """
    hints = get_type_hints(command, include_extras=True)
    shown: list[inspect.Parameter] = []
    kinds: dict[str, type] = {}
    for parameter in inspect.signature(command).parameters.values():
        hint = hints[parameter.name]
        if is_dataclass(hint):
            kinds[parameter.name] = cast(Any, hint)
            known = options_of(cast(type, hint)).values()
            shown += [_parameter(each) for each in known if each.flags]
            shown.append(_keyword("config", Path | None, None, _config_option(known)))
        else:
            shown.append(parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY))

    @functools.wraps(command)
    def run(**given: Any) -> None:
        for name, kind in kinds.items():
            try:
                resolved = _resolved(kind, given)
            except MissingOptionError as error:
                raise usage_error(f"{command.__name__} {error.needs}") from None
            _hush(getattr(resolved, "quiet", False))
            given[name] = resolved
        command(**given)

    run.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in shown}
    return run


def _config_option(known: Iterable[Option]) -> Any:
    """Return `--config`, whose help names the tables of the file."""
    tables = dict.fromkeys(found.section or found.name for found in known if found.section or found.kind is dict)
    listed = "".join(f", [{table}]" for table in tables)
    return typer.Option("--config", help=literal(f"TOML of these options{listed}; what is given here comes first."))


def _resolved(kind: type, given: dict[str, Any]) -> Any:
    """Take a dataclass's options out of what the command line gives, and return it. Raises what `gather` does."""
    typed = {name: given.pop(name) for name, found in options_of(kind).items() if found.flags}
    said = {name: _plain(value) for name, value in typed.items() if value is not None and value != []}
    return gather(kind, said, file=given.pop("config"), naming=lambda found: found.flags[0])


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(one) for one in value]
    return value.value if isinstance(value, StrEnum) else value


def _keyword(name: str, kind: Any, default: Any, option: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option])


def _parameter(found: Option) -> inspect.Parameter:
    """Return an option as typer takes it: None where it is left out, so that a file may give it."""
    kind: Any = str if found.reader is not None else found.kind
    if found.choices:
        enumeration: Any = StrEnum  # called by its functional form, which mypy takes with literal names alone
        kind = enumeration(found.name, {choice: choice for choice in found.choices})
    default = "required" if found.required else f"default: {text}" if (text := found.shown_default) else ""
    least, most = found.within if kind in (int, float) else (None, None)
    option = typer.Option(
        *found.flags,
        help=literal(f"{found.help} [{default}]" if default else found.help),
        min=least,
        max=most,
        show_default=False,
    )
    return _keyword(found.name, (list[kind] if found.many else kind) | None, None, option)
