"""Typed errors. Each message is one line that says what is wrong, where, and what to do."""

from __future__ import annotations

from collections.abc import Sequence


class SurromdError(Exception):
    """Base of every error a user can cause or meet; the command line prints its message and exits with 1."""


class InputError(SurromdError):
    """A file or an argument cannot be used as it is."""


class UnknownNameError(InputError):
    """A name (scene, weights, force field) that the library does not hold."""


class UnitError(InputError):
    """A quantity without a unit, with an unknown one, or with one of the wrong dimension."""


class PreparationError(InputError):
    """A molecule cannot be prepared: unknown residues, broken structure, impossible chemistry."""


class TrajectoryError(SurromdError):
    """A trajectory file is damaged, incomplete, or does not fit the scene."""


class OutOfDomainError(SurromdError):
    """A scene that the weights were not trained for. `brief`: how it differs, without the advice; `forcible`: they can
    roll it all the same, if asked to."""

    def __init__(self, message: str, brief: str = "", *, forcible: bool = False) -> None:
        super().__init__(message)
        self.brief, self.forcible = brief or message, forcible


class WeightsError(SurromdError):
    """A weights file is damaged or does not fit this version."""


class SimulationError(SurromdError):
    """A simulation failed while running (non-finite coordinates, a platform that cannot run the scene)."""


class StorageError(SurromdError):
    """The disk is full or not writable; what was complete before stays readable."""


def nearest(name: str, known: list[str]) -> str:
    """Return ' Did you mean X?' for the nearest of `known`, or an empty string."""
    import difflib

    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f" Did you mean {close[0]!r}?" if close else ""


def first_line(error: BaseException) -> str:
    """Return the first line of another library's error without its full stop, or the error's kind."""
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


def counted(n: int, what: str) -> str:
    """Return a number with its noun, `1 atom` or `2 atoms`."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def listed(things: Sequence[str], most: int = 6) -> str:
    """Return names as a message lists them: `A1, A2 and 5 more`."""
    return ", ".join(things[:most]) + (f" and {len(things) - most} more" if len(things) > most else "")
