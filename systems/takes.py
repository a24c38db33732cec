"""Functions that take options: inputs in their places, options by keyword, as a dataclass or from a file."""

from __future__ import annotations

import functools
import inspect
import textwrap
from collections.abc import Callable
from dataclasses import MISSING
from pathlib import Path
from typing import Any, TypeVar

from systems.errors import nearest
from systems.options import MissingOptionError, Option, gather, options_of

R = TypeVar("R")


def takes(kind: type) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Let a function whose last parameter is `options`, a dataclass `kind`, be called with these options as keywords.

    Its signature lists them one by one, as an editor or `help` shows it, and its documentation says what each does.
    `options=` takes the dataclass itself, `config=` the path of a TOML file; keywords come before both. A quantity is a
    number in the unit that its name ends in, or a text with its own. Any other keyword is a TypeError, as always, which
    names the nearest.
    """
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
                settled: Any = gather(kind, given, file=config)
            except MissingOptionError as error:
                raise TypeError(f"{function.__name__}() {error.needs}") from None
            except TypeError as error:
                raise TypeError(f"{function.__name__}() {error}") from None
            return function(*bound.args, **bound.kwargs, options=settled)

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
        said = [option.unit, " | ".join(option.said.choices), default]
        about = ", ".join(word for word in said if word)
        lines.append(f"{option.name}{f' ({about})' if about else ''}")
        lines += textwrap.wrap(option.help, 112, initial_indent="    ", subsequent_indent="    ")
    return "\n".join(lines)
