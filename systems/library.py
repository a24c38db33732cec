"""Named scenes that ship with the package."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path

from systems.errors import UnknownNameError, nearest
from systems.scene import Scene

_DESCRIPTIONS = {
    "alanine-dipeptide": "ACE-ALA-NME, 22 atoms: the usual first peptide, two backbone torsions (phi, psi)",
}


def names() -> list[str]:
    """Return the names that `load` knows, sorted."""
    return sorted(_DESCRIPTIONS)


def describe(name: str) -> str:
    """Return one line about a named scene. Raises UnknownNameError."""
    return _DESCRIPTIONS[_known(name)]


def load(name: str) -> Scene:
    """Return a named scene, with bonds, bond orders, masses and residues. Raises UnknownNameError."""
    scene = _load(_known(name))
    return replace(scene, provenance=dict(scene.provenance))


@cache
def _load(name: str) -> Scene:
    from systems.structure import scene_from_file

    path = Path(str(files("systems") / "data" / f"{name}.pdb"))
    return scene_from_file(path, name=name, provenance={"source": "library", "library_name": name, "repairs": []})


def _known(name: str) -> str:
    if name not in _DESCRIPTIONS:
        raise UnknownNameError(f"No system is called {name!r}.{nearest(name, names())} `surromd systems` lists them.")
    return name
