"""Named scenes: those that ship with the package, and peptides and model systems made from their name on demand."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from systems.chemistry.residues import ONE_LETTER
from systems.errors import UnknownNameError, nearest
from systems.library.catalogue import ENTRIES, Entry
from systems.library.model_systems import double_well, harmonic_oscillator
from systems.scene import Scene

_ON_DEMAND = "Made from their name besides: capped peptides (ACE-ALA-GLY-NME), tetrapeptides in one-letter code (SDFS)."


def names() -> list[str]:
    """Return the names of the scenes that ship with the package, sorted."""
    return sorted(ENTRIES)


def groups() -> dict[str, list[str]]:
    """Return the names by group, in the catalogue's order; see also `on_demand`."""
    found: dict[str, list[str]] = {}
    for entry in ENTRIES.values():
        found.setdefault(entry.group, []).append(entry.name)
    return found


def on_demand() -> str:
    """Return one line about the names that are made into scenes when asked for."""
    return _ON_DEMAND


def knows(name: str) -> bool:
    """Whether `load` makes a scene of this name, shipped or on demand."""
    return _find(name) is not None


def describe(name: str) -> str:
    """Return one line about a named scene. Raises UnknownNameError."""
    return _known(name).title


def own_settings(name: str) -> dict[str, Any]:
    """Return the settings that a model system brings (names of `api.reference`); empty for a molecule.

    Raises UnknownNameError.
    """
    return dict(_known(name).own_settings)


def source_of_settings(name: str) -> str:
    """Return where a model system's own settings come from, in words. Raises UnknownNameError."""
    return _known(name).source


def protocols(name: str) -> tuple[str, ...]:
    """Return the names of the protocols (systems.library.protocols) that papers simulated this scene by.

    Raises UnknownNameError.
    """
    return _known(name).protocols


def load(name: str) -> Scene:
    """Return a named scene, with bonds, bond orders, masses and residues.

    Raises UnknownNameError, and PreparationError for a peptide that cannot be built.
    """
    scene = _load(_known(name))
    return replace(scene, provenance=dict(scene.provenance))


@cache
def _shipped(file: str) -> Scene:
    from systems.prepare.structure import scene_from_file

    path = Path(str(files("systems.library") / "data" / f"{file}.pdb"))
    return scene_from_file(path, name=file, provenance={})


def _load(entry: Entry) -> Scene:
    provenance = {"source": "library", "library_name": entry.name, "repairs": []}
    if entry.group == ANALYTIC:
        return {"harmonic-oscillator": harmonic_oscillator, "double-well": double_well}[entry.name]()
    if entry.name in ENTRIES:
        return replace(_shipped(entry.file or entry.name), name=entry.name, provenance=provenance)
    return _built(entry)


@cache
def _built_peptide(sequence: str) -> Scene:
    from systems.prepare.peptide import build_peptide

    return build_peptide(sequence)


def _built(entry: Entry) -> Scene:
    scene = _built_peptide(entry.sequence)
    provenance = scene.provenance | {"source": "library", "library_name": entry.name}
    return replace(scene, name=entry.name, provenance=provenance)


def _known(name: str) -> Entry:
    entry = _find(name)
    if entry is None:
        raise UnknownNameError(
            f"No system is called {name!r}.{nearest(name, names())} `surromd systems` lists them; a file is named by "
            "its path, a peptide as sequence:..., a molecule as smiles:..."
        )
    return entry


def _find(name: str) -> Entry | None:
    """Return the entry of a name, made for names on demand; None when there is no such scene."""
    if name in ENTRIES:
        return ENTRIES[name]
    if len(name) == 4 and set(name) <= set(ONE_LETTER):
        return _tetrapeptide(name, "-".join(ONE_LETTER[c] for c in name))
    if "-" not in name:
        return None
    from systems.errors import PreparationError
    from systems.prepare.peptide import parse_sequence

    try:
        residues = parse_sequence(name)
    except PreparationError:
        return None
    sequence = "-".join(residues)
    if sequence in ENTRIES:
        return ENTRIES[sequence]
    if len(residues) == 4 and "ACE" not in residues and "NME" not in residues:
        return _tetrapeptide(sequence, sequence)
    title = f"{sequence}, built extended from its sequence"
    return Entry(sequence, PEPTIDES, title, sequence=sequence)


def _tetrapeptide(name: str, sequence: str) -> Entry:
    title = f"{sequence}, a tetrapeptide with charged ends, built extended from its sequence"
    return Entry(name, PEPTIDES, title, protocols=("mdgen",), sequence=sequence)
