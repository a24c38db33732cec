"""Scenes: what the library holds, and what is made of the name or file that a user gives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogate.verbs.options import tell
from systems.chemistry.graph import backbone_torsions, molecule_key
from systems.library import named_scenes
from systems.options import Preparation, part_of

if TYPE_CHECKING:
    from systems.scene import Scene


def systems(name: str | None = None) -> list[dict[str, Any]]:
    """Return what the library holds: one record per named scene, or the one asked for, with its protocols and atoms.
    Raises UnknownNameError (with the nearest name)."""
    if name is None:
        groups = named_scenes.groups()
        return [_describe(each) | {"group": group} for group in groups for each in groups[group]]
    scene = named_scenes.load(name)
    record = _describe(name) | {
        "n_bonds": len(scene.bonds),
        "residues": list(scene.residue_names),
        "atoms": list(scene.atom_names),
        "mass_da": float(scene.masses_da.sum()),
        "charge_e": int(scene.formal_charges.sum()),
        "torsions": {key: len(quads) for key, quads in backbone_torsions(scene).items() if len(quads)},
        "topology_hash": scene.topology_hash,
        "molecule_key": molecule_key(scene),
        "protocols": {
            each: _written(named_scenes.find_protocol(each).settings) for each in named_scenes.entry(name).protocols
        },
    }
    if scene.interactions is not None:
        settings, source = named_scenes.entry(name).own_settings, named_scenes.entry(name).source
        record |= {"law": scene.interactions, "settings": _written(settings), "source": source}
    return [record]


def _describe(name: str) -> dict[str, Any]:
    scene, title = named_scenes.load(name), named_scenes.entry(name).title
    return {"name": name, "title": title, "n_atoms": scene.n_atoms, "formula": scene.formula}


def _written(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings as they are printed."""
    return {key: "natural" if value is None else value for key, value in settings.items()}


def prepare_scene(scene: str | Path | Scene, options: Preparation, *, quiet: bool) -> Scene:
    """Return a Scene for what a user may write, a path as such too; what had to be repaired is said on stderr. Raises
    what `systems.library.named_scenes.prepare` raises."""
    if not isinstance(scene, str | Path):
        return scene
    scene = str(scene)
    prepared = named_scenes.prepare(scene, options=part_of(options, Preparation))
    if not quiet:
        for line in prepared.provenance.get("repairs", []):
            tell(scene, line)
    return prepared
