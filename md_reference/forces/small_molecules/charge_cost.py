"""Time that AM1-BCC charges take, expected from the number of atoms and told while they are computed."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from systems.scene import Scene
from systems.units import format_wall

# SECONDS_AT_30_ATOMS (atoms / 30)^POWER, measured by docs/studies/preparation/charge_cost.py: AmberTools 26.0,
# processor seconds on a core of an AMD EPYC, ten molecules of 21 to 72 atoms, none off by more than a factor of 2.3.
SECONDS_AT_30_ATOMS = 7.3
POWER = 3.3
_WORTH_SAYING_S = 2.0
_log = logging.getLogger("surromd.charges")


def expected_s(n_atoms: int) -> float:
    """Return about how many seconds AM1-BCC charges of a molecule of so many atoms take on one idle core."""
    return SECONDS_AT_30_ATOMS * (n_atoms / 30.0) ** POWER


@contextmanager
def announced(scene: Scene) -> Iterator[Callable[[float], None] | None]:
    """Say before and after a molecule's charges are computed how long that takes, where it is worth saying.

    Yields what `programs.run_program` calls while it waits: on a terminal it keeps a line with the seconds so far. The
    lines are warnings of the logger 'surromd.charges': on stderr unless a program that uses this package decides else.
    """
    expected = expected_s(scene.n_atoms)
    if expected < _WORTH_SAYING_S:
        yield None
        return
    about = format_wall(float(f"{expected:.1g}"))
    _log.warning(
        "%s: AM1-BCC charges of %d atoms, about %s on an idle core, once: they are kept in the cache",
        scene.name,
        scene.n_atoms,
        about,
    )
    on_terminal = sys.stderr.isatty() and _log.isEnabledFor(logging.WARNING)
    started = time.monotonic()

    def waiting(_: float) -> None:
        sys.stderr.write(f"\r{scene.name}: {format_wall(time.monotonic() - started)} of about {about} \x1b[K")
        sys.stderr.flush()

    try:
        yield waiting if on_terminal else None
    finally:
        if on_terminal:
            sys.stderr.write("\r\x1b[K")
    _log.warning("%s: charges computed in %s", scene.name, format_wall(time.monotonic() - started))
