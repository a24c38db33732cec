"""Make the data files of the library: `python docs/studies/preparation/make_library_data.py [NAME...]`.

A file that is there stays as it is, because weights and trajectories know a scene by its atoms and their order.
Molecules come from their SMILES through RDKit, peptides from their sequence; GAFF2 parameters of the molecules are made
by AmberTools and written beside them.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

from systems.library.named_scenes import ENTRIES, Entry
from systems.scene import Scene
from systems.trajectory.companion_writer import pdb_text


def make(entry: Entry) -> list[Path]:
    """Write the structure of one entry and, for a molecule, its parameters; return what is new."""
    from md_reference.forces import gaff
    from systems.library.named_scenes import load

    written = []
    path = Path(str(files("systems.library") / "data" / f"{entry.file or entry.name}.pdb"))
    if not path.exists():
        path.write_text(pdb_text(replace(_scene(entry), name=entry.name)))
        written.append(path)
    if entry.smiles:
        scene = load(entry.name)
        made, parameters = gaff.entry(scene, cached=False), gaff.shipped_path(scene)
        parameters.unlink(missing_ok=True)
        gaff.store(parameters, made)
        written.append(parameters)
    return written


def _scene(entry: Entry) -> Scene:
    if entry.smiles:
        from systems.prepare.molecule import scene_from_smiles

        return scene_from_smiles(entry.smiles)
    from systems.prepare.peptide import build_peptide

    return build_peptide(entry.sequence)


def main(chosen: list[str]) -> None:
    """Make the files of the entries named, or of all."""
    for entry in ENTRIES.values():
        if (entry.smiles or entry.sequence) and (not chosen or entry.name in chosen):
            for path in make(entry):
                sys.stdout.write(f"{path}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
