"""Weights by name: those that are shipped, or a file."""

from __future__ import annotations

import os
from pathlib import Path

from systems.errors import InputError, UnknownNameError, nearest

_FOLDER = Path(__file__).parents[1] / "pretrained"


def shipped_weights() -> dict[str, Path]:
    """Return the files of the weights that are shipped, by name."""
    return {p.stem: p for p in sorted(_FOLDER.glob("*.safetensors"))}


def weights_path(weights: str | os.PathLike[str]) -> Path:
    """Return the file of shipped weights by name, or the path itself.

    Raises UnknownNameError (with the nearest name) or InputError when there is no such file.
    """
    path = Path(weights)
    if path.suffix == ".safetensors" or path.exists():
        if not path.is_file():
            raise InputError(f"{path}: no such weights file.")
        return path
    shipped = shipped_weights()
    if str(weights) not in shipped:
        raise UnknownNameError(
            f"no weights are called {str(weights)!r}; shipped: {', '.join(shipped) or 'none'}."
            f"{nearest(str(weights), list(shipped))} A trained file is named by its path (.safetensors)."
        )
    return shipped[str(weights)]
