"""Messages in the command line's words: options that they name as Python's keywords become flags."""

from __future__ import annotations

import re
from functools import cache

from surrogate.bench.cost_error.sweep_settings import CostErrorOptions
from surrogate.bench.stress.stress_options import StressOptions
from surrogate.verbs.options import VERB_OPTIONS
from systems.options import Option, options_of

# `overwrite`, `overwrite=True`, `timestep_ps='1fs'`
_NAMED = re.compile(r"`([a-z][a-z_]*)(?:=([^`]+))?`")
# Arguments of the Python calls that are options on the command line, and one that is nowhere else.
_ARGUMENTS = {"out": "--out", "weights": "--weights", "config": "--config"}


@cache
def _known() -> dict[str, Option]:
    # Of a name that several have the last one counts.
    kinds = [CostErrorOptions, StressOptions, *VERB_OPTIONS.values()]
    return {name: found for kind in kinds for name, found in options_of(kind).items()}


def as_flags(text: str) -> str:
    """Return a message in which `overwrite=True` is --overwrite and `timestep_ps='1fs'` is --timestep 1fs.

    What stands in a table of a `config` file alone is said so; any other word in backticks stays.
    """
    return _NAMED.sub(_flag, text)


def _flag(match: re.Match[str]) -> str:
    name, value = match.groups()
    found = _known().get(name)
    flag = _ARGUMENTS.get(name) or (found.flags[0] if found is not None and found.flags else None)
    if flag is not None:
        return flag if value in (None, "True") else f"{flag} {value.strip(chr(39))}"
    if found is not None and found.section:
        said = found.key if value is None else f"{found.key} = {value.replace(chr(39), chr(34))}"
        return f"{said} in [{found.section}] of --config"
    return match.group()
