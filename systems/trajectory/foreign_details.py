"""What the readers of MDTraj and MDAnalysis leave out: units of NetCDF, TRR frames without positions, odd paths."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import TrajectoryError
from systems.trajectory.format_table import Format
from systems.trajectory.stated_units import nm_per, ps_per

_TRR_MAGIC = 1993
# Of the header's ten sizes: box, virial, pressure, (topology), positions, velocities and forces have bytes behind it.
_TRR_X = 7
# Magic, atoms, step, time, nine numbers of the cell, atoms again; then the precision, a float32.
_XTC_PRECISION = 56
_TRR_FLOATS = (2, 3, 4, 7, 8, 9)


def unit_note(format_: Format) -> tuple[str, ...]:
    """Return the line on a unit of length that a format does not state, none where it states one."""
    if not format_.unit_taken:
        return ()
    return (f"a {format_.name} file states no unit of length; {format_.unit_taken} is taken.",)


def counted_note(time_ps: npt.NDArray[np.float64]) -> tuple[str, ...]:
    """Return the line on times `(n_frames,)` that are what MDTraj writes where nobody stated any."""
    if len(time_ps) < 3 or not np.array_equal(time_ps, np.arange(len(time_ps))):
        return ()
    return ("its times are 0, 1, 2, ... ps, which MDTraj also writes where it was told none; if so, state `dt_ps`.",)


def netcdf_units(handle: Any, path: Path) -> tuple[float, float, float]:
    """Return what one stands for, by `units` and `scale_factor`, in positions (nm), times (ps) and cell lengths (nm).

    `handle`: SciPy's or netCDF4's open file, which MDTraj reads raw numbers from. Where no unit is stated Amber's
    convention counts: Å and ps. Raises TrajectoryError for a unit that is not known.
    """
    if hasattr(handle, "set_auto_maskandscale"):
        handle.set_auto_maskandscale(False)
    factors: list[float] = []
    for name, per, usual in (("coordinates", nm_per, "angstrom"), ("time", ps_per, "picosecond"),
                             ("cell_lengths", nm_per, "angstrom")):  # fmt: skip
        variable = handle.variables.get(name)
        unit, factor = getattr(variable, "units", usual), per(getattr(variable, "units", usual))
        if factor is None:
            text = unit.decode(errors="replace") if isinstance(unit, bytes) else unit
            raise TrajectoryError(f"{path}: {name} are in {text!r}, a unit that is not known; write it in Å and ps.")
        factors.append(factor * float(np.squeeze(getattr(variable, "scale_factor", 1.0))))
    return factors[0], factors[1], factors[2]


def trr_positions(path: Path) -> npt.NDArray[np.bool_]:
    """Return which frames of a TRR file hold positions `(n_frames,)`, by their headers: MDTraj gives memory that
    nobody set for the others. Raises TrajectoryError for a damaged header."""
    found: list[bool] = []
    with path.open("rb") as file:
        size = path.stat().st_size
        while file.tell() + 84 <= size:
            magic, _, length = np.frombuffer(file.read(12), ">i4").tolist()
            file.seek(-(-length // 4) * 4, 1)
            sizes = np.frombuffer(file.read(52), ">i4").tolist()
            if magic != _TRR_MAGIC or len(sizes) != 13 or min(sizes[:11]) < 0:
                raise TrajectoryError(f"{path} is damaged after frame {len(found)}.")
            of_atoms = next((sizes[k] for k in (7, 8, 9) if sizes[k]), 0)
            double = sizes[2] == 72 if sizes[2] else of_atoms == 24 * sizes[10]
            file.seek((16 if double else 8) + sum(sizes[k] for k in _TRR_FLOATS), 1)
            found.append(sizes[_TRR_X] > 0)
    return np.array(found, dtype=bool)


def trr_has_cell(path: Path) -> bool:
    """Return whether the first frame of a TRR file states a cell: MDTraj gives memory that nobody set where not."""
    with path.open("rb") as file:
        length = int.from_bytes(file.read(12)[8:], "big")
        file.seek(-(-length // 4) * 4 + 8, 1)
        return int.from_bytes(file.read(4), "big") > 0


def xtc_grid_nm(path: Path) -> float | None:
    """Return what an XTC file rounds coordinates to, nm, by the precision in its first frame's header (1000: 0.001 nm);
    None where it states none, as of nine atoms or fewer, which are not rounded."""
    with path.open("rb") as file:
        header = file.read(_XTC_PRECISION + 8)
    if len(header) < _XTC_PRECISION + 8 or int.from_bytes(header[4:8], "big") <= 9:
        return None
    # Files of 2^31 bytes in a frame (magic 2023) differ behind the precision.
    precision = float(np.frombuffer(header, ">f4", 1, _XTC_PRECISION)[0])
    return 1.0 / precision if np.isfinite(precision) and precision > 0 else None


class AsciiPath:
    """A file's path for libraries in C that take ASCII alone: `path` is itself, or a link in a folder of its own."""

    def __init__(self, path: Path) -> None:
        self.path, self._folder = path, None
        if str(path).isascii():
            return
        with contextlib.suppress(OSError):  # without links the library says what it cannot read
            self._folder = tempfile.TemporaryDirectory(prefix="surromd-")
            link = Path(self._folder.name) / f"frames{''.join(path.suffixes[-2:])}"
            link.symlink_to(path.resolve(), target_is_directory=path.is_dir())
            self.path = link

    def close(self) -> None:
        """Remove the link."""
        if self._folder is not None:
            self._folder.cleanup()
        self._folder = None
