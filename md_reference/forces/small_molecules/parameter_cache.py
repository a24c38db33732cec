"""Parameters of molecules on disk: those that ship with the package and those computed here, found by molecule."""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from md_reference.forces.small_molecules.prmtop import Prmtop
from systems.chemistry.graph import match_atoms, molecule_key
from systems.errors import InputError, OutOfDomainError
from systems.files.checksums import sealed, unsealed
from systems.files.native import cache_folder
from systems.files.outside import content
from systems.files.schema import built, parsed
from systems.files.whole_file import create_whole, storage_error
from systems.scene import Scene

_FORMAT = 1


@dataclass(frozen=True)
class Entry:
    """Parameters of one molecule: prmtop text in the atom order of `template`, and where they come from."""

    template: Scene
    prmtop: str
    source: dict[str, Any]

    def ordered_as(self, scene: Scene) -> str:
        """Return the prmtop text in the scene's atom order. Raises OutOfDomainError for another molecule."""
        order = match_atoms(scene, self.template)
        return Prmtop(self.prmtop).permuted(order).text()


@dataclass(frozen=True)
class _Record:
    format: int
    scene: Scene
    prmtop: str
    source: dict[str, Any]


def shipped_folder() -> Path:
    """Where the parameters lie that come with the package."""
    return Path(str(files("systems.library") / "data" / "parameters"))


def find_shipped(scene: Scene, method: str) -> Entry | None:
    """Return the shipped parameters of this molecule, or None."""
    return _read(shipped_folder() / f"{molecule_key(scene)}-{method}.json.gz")


def find_cached(scene: Scene, method: str, version: str | None) -> Entry | None:
    """Return parameters computed here earlier by this version (by any, the last by name, where `version` is None)."""
    folder = cache_folder() / "parameters"
    if version is not None:
        return _read(folder / f"{molecule_key(scene)}-{method}-{version}.json.gz")
    found = sorted(folder.glob(f"{molecule_key(scene)}-{method}-*.json.gz"))
    return _read(found[-1]) if found else None


def cached_path(scene: Scene, method: str, version: str) -> Path:
    """Where `find_cached` looks."""
    return cache_folder() / "parameters" / f"{molecule_key(scene)}-{method}-{version}.json.gz"


def fits(entry: Entry | None, scene: Scene) -> bool:
    """Return whether the entry's molecule is the scene's (keys are hashes, and some stereo is beyond them)."""
    if entry is None:
        return False
    try:
        match_atoms(scene, entry.template)
    except OutOfDomainError:
        return False
    return True


def store(path: Path, entry: Entry) -> Entry:
    """Write an entry and return what lies there: of several processes that compute the same, the first one's stays.

    The file appears whole or not at all. Raises StorageError when it cannot be written.
    """
    template = replace(entry.template, provenance={})
    record = {"format": _FORMAT, "source": entry.source, "scene": template.to_dict(), "prmtop": entry.prmtop}
    data = gzip.compress(sealed(json.dumps(record, sort_keys=True)).encode(), mtime=0)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(path, error, "nothing was changed") from error
    existing = _read(path)
    if existing is not None and fits(existing, entry.template):
        return existing
    create_whole(path, data)
    return entry


def _read(path: Path) -> Entry | None:
    """Return an entry, or None where there is none or it is damaged (it is then made again)."""
    try:
        text = content(path).decode()
        found = built(_Record, parsed(unsealed(text) if path.parent != shipped_folder() else text))
        if found.format != _FORMAT or Prmtop(found.prmtop).n_atoms != found.scene.n_atoms:
            return None
        return Entry(found.scene, found.prmtop, found.source)
    except (OSError, ValueError, LookupError, TypeError, InputError):
        return None
