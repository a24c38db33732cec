"""TOML files that users write: read whole, refused in one line."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from systems.errors import InputError
from systems.files.outside import content
from systems.files.schema import parsed


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return a TOML file's record. Raises InputError when it is missing or malformed."""
    try:
        return dict(parsed(content(Path(path)).decode(), tomllib.loads))
    except FileNotFoundError:
        raise InputError(f"configuration {path} does not exist.") from None
    except (OSError, ValueError) as error:
        raise InputError(f"configuration {path} is not valid TOML: {error}.") from error
