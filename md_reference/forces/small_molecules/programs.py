"""Other programs, run in folders of their own: neither outlives this process, whatever ends it.

Each is guarded by a shell that holds the other end of a pipe. When this process ends, by `kill -9` too, the pipe
closes, and the guard kills the program with all that it has started, or removes the folder. A guard has a session of
its own, so that a terminal's Ctrl-C and hang-up do not reach it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from systems.errors import StorageError
from systems.interrupts import stop_if_asked

# So often a program that runs is looked at, and a wish to stop is heard.
_LOOK_S = 0.1
# One process group: the program, what it starts, and a watch that kills them all when nobody holds the pipe any more.
_RUN = (
    "exec 3<&0 </dev/null; { trap '' HUP INT TERM; read -r _ <&3; kill -KILL 0; } 2>/dev/null & "
    '"$@" 3<&-; status=$?; kill -KILL $! 2>/dev/null; wait $! 2>/dev/null; exit $status'
)
# What is killed at the same moment may still be writing into the folder: some seconds of patience.
_FOLDER = (
    "trap '' HUP INT TERM PIPE; mkdir -m 700 -- \"$1\" || exit 1; echo made; read -r _; n=0; "
    'until rm -rf -- "$1" 2>/dev/null || [ $n -ge 100 ]; do n=$((n + 1)); sleep 0.1; done'
)


def run_program(
    command: list[str],
    folder: Path,
    environment: Mapping[str, str],
    *,
    waiting: Callable[[float], None] | None = None,
) -> tuple[int, str]:
    """Run a program in `folder` until it ends; return its exit status and what it printed, errors among the rest.

    `waiting` is called several times a second with the seconds since the start. An interruption, also one that
    `deferred_interrupt` has put off or that is meant for this thread, ends the program and whatever it has started:
    KeyboardInterrupt. So does the end of this process. POSIX systems only.
    """
    started = time.monotonic()
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
                    if waiting is not None:
                        waiting(time.monotonic() - started)
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
        output.seek(0)
        return status, output.read().decode(errors="replace")


@contextmanager
def scratch_folder(prefix: str) -> Iterator[Path]:
    """Yield a new folder among the system's temporary ones; it goes with the block, and with this process.

    Raises StorageError where it cannot be made. Where there is no shell (Windows) it goes with the block alone.
    """
    if os.name != "posix":
        with tempfile.TemporaryDirectory(prefix=prefix) as name:
            yield Path(name)
        return
    path = Path(tempfile.gettempdir()) / f"{prefix}{uuid.uuid4().hex[:12]}"
    with subprocess.Popen(
        ["/bin/sh", "-c", _FOLDER, "surromd-guard", str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as guard:
        assert guard.stdin is not None and guard.stdout is not None and guard.stderr is not None
        if guard.stdout.readline() != "made\n":
            raise StorageError(
                f"no temporary folder can be made: {guard.stderr.read().strip()}; free space or set TMPDIR."
            )
        yield path
