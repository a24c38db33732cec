"""Watch over the parent process: a worker ends with the process that started it, whatever ended that one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from multiprocessing.connection import wait

# A run that is asked to stop does so after the frame in hand; after this long it is ended as it stands.
_GRACE_S = 10.0


def end_with_parent(*, grace_s: float = _GRACE_S) -> None:
    """Watch the parent of this worker process from a thread of its own; to be called once, when the worker starts.

    When the parent is gone (killed, even by `kill -9`) this process gets SIGTERM, at which a run stops between two
    frames with a checkpoint, and after `grace_s` seconds more it exits. In a process without a parent of ours: nothing.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)
        # A daemon thread: an orderly end of the process comes first.
        threading.Event().wait(grace_s)
        os._exit(1)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
