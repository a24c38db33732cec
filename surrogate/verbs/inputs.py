"""What verbs take and leave: scenes of the names or files that a user gives, trajectories found by pattern, outputs
that are checked before the work starts and reported when it is interrupted."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from glob import glob
from pathlib import Path
from typing import Any

from md_reference.campaign.manifest import campaign_folder, campaign_trajectories
from surrogate.verbs.options import Trajectories, tell
from systems.chemistry.graph import backbone_torsions, molecule_key
from systems.errors import InputError
from systems.library import named_scenes
from systems.options import Preparation, part_of
from systems.scene import Scene
from systems.trajectory.checkpoint import checkpoint_path, frames_in
from systems.trajectory.codec import WRITTEN, open_trajectory
from systems.trajectory.companion_writer import refuse_other_companions
from systems.trajectory.joined import KEY


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
    if isinstance(scene, Scene):
        return scene
    if not isinstance(scene, str | Path):
        raise InputError(f"a scene is a file, a name, smiles:…, sequence:… or a Scene, not a {type(scene).__name__}.")
    scene = str(scene)
    prepared = named_scenes.prepare(scene, options=part_of(options, Preparation))
    for line in prepared.provenance.get("repairs", []):
        tell(scene, line, quiet=quiet)
    return prepared


def check_outputs(
    paths: Sequence[Path], suffixes: Sequence[str], *, resume: bool = False, overwrite: bool = False
) -> None:
    """Refuse outputs that cannot be meant, before anything is computed.

    Raises InputError for another suffix, a folder that does not exist, an existing file (unless `resume` or
    `overwrite`), or both switches at once; TrajectoryError where a trajectory's NAME.pdb is another program's.
    """
    if resume and overwrite:
        raise InputError("`resume` and `overwrite` exclude each other.")
    for path in paths:
        if "\0" in str(path):
            raise InputError(f"{str(path)!r} is no name for a file: it holds a NUL.")
        if path.suffix.lower() not in suffixes:
            raise InputError(f"{path}: the output must end in {' or '.join(suffixes)}.")
        if not path.parent.is_dir():
            raise InputError(f"{path}: its folder does not exist; create {path.parent} first.")
        if path.is_dir():
            raise InputError(f"{path} is a folder; name a file.")
        if path.exists() and not (resume or overwrite):
            raise InputError(f"{path} exists; add `overwrite=True` to replace it, or choose another name.")
        if path.suffix.lower() in WRITTEN and suffixes == WRITTEN and not resume:
            refuse_other_companions(path)


@contextmanager
def summarised_outputs(paths: Sequence[Path], *, resumable: str = "") -> Iterator[None]:
    """Run a verb that writes trajectories; on Ctrl-C say what is kept, as the message of KeyboardInterrupt.
    `resumable`: what the user does to go on, said when there is something to go on from."""
    try:
        yield
    except KeyboardInterrupt:
        counts = {path: frames_in(path) for path in paths if path.exists() or checkpoint_path(path).exists()}
        kept = ", ".join(f"{path} holds {frames} frames" for path, frames in list(counts.items())[:2])
        kept += f", and so on for {len(counts)} files" if len(counts) > 2 else ""
        raise KeyboardInterrupt(f"{kept}; {resumable}" if counts else "nothing was written") from None


def find_trajectories(spec: Trajectories, *, verify: bool = False) -> list[Path]:
    """Return the files that a user means by a path, a folder, a glob pattern, a comma-separated list or a sequence.

    A folder stands for the trajectories in it (HDF5 before DCD, if it holds both); one of a campaign, or within it, for
    the runs that its manifest calls complete, whose hashes are checked if `verify`. Raises InputError when nothing is
    found, TrajectoryError when a hash differs.
    """
    if not isinstance(spec, (str, Path, Sequence)):
        raise InputError(
            f"a trajectory is a file, a folder, a pattern or a list of these, not a {type(spec).__name__}."
        )
    if not isinstance(spec, (str, Path)):
        return [path for part in spec for path in find_trajectories(part, verify=verify)]
    path = Path(spec)
    if path.is_dir() and campaign_folder(path) is not None:
        found, left_out = campaign_trajectories(path, verify=verify)
        if left_out:
            sys.stderr.write(f"{path}: {left_out} runs of this campaign are not complete and left out\n")
        return found
    if path.is_dir():
        files = [p for p in sorted(path.iterdir()) if not p.name.endswith(".meta.h5")]
        for suffixes in ((".h5", ".hdf5"), (".dcd",), (".xtc",)):
            found = _counted_once([p for p in files if p.suffix.lower() in suffixes])
            if found:
                return found
        raise InputError(f"{path}: no trajectory (.h5, .dcd, .xtc) in this folder.")
    if path.exists():
        return [path]
    text = str(spec)
    if "," in text:
        parts = [part.strip() for part in text.split(",") if part.strip()]
        return [p for part in parts for p in find_trajectories(part, verify=verify)]
    if any(c in text for c in "*?["):
        found = _counted_once([Path(p) for p in sorted(glob(text)) if not p.endswith(".meta.h5")])
        if found:
            return found
        raise InputError(f"{text}: no file matches.")
    raise InputError(f"{text}: no such file.")


def _counted_once(found: list[Path]) -> list[Path]:
    """Return files without those that join others of them, which would be counted twice."""
    kept = []
    for path in found:
        if path.with_name(f"{path.stem}_r0{path.suffix}") in found:
            with open_trajectory(path) as reader:
                if KEY in reader.record:
                    sys.stderr.write(f"{path} joins replicas that are taken one by one, and is left out\n")
                    continue
        kept.append(path)
    return kept
