"""Lines about a run on stderr, in the words of whoever runs it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextvars import ContextVar

# How options that a line names in backticks are written; the command line, where they are flags, sets its own.
said: ContextVar[Callable[[str], str]] = ContextVar("said", default=str)


def tell(name: str, line: str) -> None:
    """Say a line about a scene or a file on stderr."""
    sys.stderr.write(f"{name}: {said.get()(line)}\n")
