"""Kernels of the tutorials that are spoken to through socket files instead of ports.

Jupyter looks for free ports first and starts the kernel, which opens them, later: on a busy machine another program has
taken one of them by then ("Address already in use"), and the build ends with a kernel that died.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

from nbclient import NotebookClient
from sphinx.application import Sphinx


class SocketClient(NotebookClient):
    """A notebook's client whose kernels listen in a folder of their own."""

    def create_kernel_manager(self) -> Any:
        """Return a manager that will start a kernel with socket files, which go with it."""
        manager = super().create_kernel_manager()
        # Not in the notebook's folder, where two builds would share them; a socket's path has 107 characters at most.
        manager.sockets = tempfile.TemporaryDirectory(prefix="surromd-")
        manager.transport, manager.ip = "ipc", str(Path(manager.sockets.name) / "kernel")
        return manager


def setup(app: Sphinx) -> dict[str, Any]:
    """Let the notebooks be executed with such kernels, where the system has socket files."""
    if os.name == "posix":
        import nbclient.client

        nbclient.client.NotebookClient = SocketClient
    return {"parallel_read_safe": True}
