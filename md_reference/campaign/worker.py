"""Tasks of a campaign's workers: prepare a scene once, for all its replicas; simulate a run from wherever it stands,
until the campaign has not been heard of for a minute."""

from __future__ import annotations

import json
import os
import platform
import socket
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from md_reference.campaign.campaign_file import Run, SceneSpec
from md_reference.campaign.cluster import LEASE_S, session_of
from md_reference.campaign.manifest import file_sha256, frames_sha256
from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.solvation import require_molecules, solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import MDConfig
from md_reference.run.simulate import simulate
from md_reference.run.starts import many_starts
from systems.chemistry.graph import molecule_key
from systems.errors import InputError
from systems.files.outside import content
from systems.files.schema import built, parsed
from systems.files.whole_file import OutputLock, create_whole
from systems.library.named_scenes import prepare
from systems.options import Preparation, options_of
from systems.scene import Scene
from systems.trajectory.codec import companions, open_trajectory
from systems.trajectory.companion_writer import topology_path

T = TypeVar("T")


@dataclass(frozen=True)
class PreparedScene:
    """What replicas share: the scene and the force field resolved for it; where each begins, `(n_atoms, 3)` nm, as far
    as that is known, how it was found, and the seed of that."""

    scene: Scene
    force: ForceFieldSpec
    starts_nm: tuple[tuple[tuple[float, ...], ...], ...] = ()
    started: str = ""
    seed: int = 0

    def start_of(self, replica: int, config: MDConfig) -> Scene:
        """Return what a replica starts from; that of one by which the campaign has grown is drawn now."""
        if replica < len(self.starts_nm):
            return replace(self.scene, positions_nm=np.array(self.starts_nm[replica]))
        if replica == 0 or config.starts != "many":
            return self.scene
        return many_starts(self.scene, replace(config, force=self.force, seed=self.seed), replica + 1)[0][-1]

    def summary(self) -> dict[str, Any]:
        """Return what the manifest says of it."""
        repairs = self.scene.provenance.get("repairs")
        return {
            "n_atoms": self.scene.n_atoms,
            "formula": self.scene.formula,
            "topology_hash": self.scene.topology_hash,
            "molecule_key": molecule_key(self.scene),
            "force": asdict(self.force),
            "starts": self.started,
            "repairs": tuple(map(str, repairs)) if isinstance(repairs, list | tuple) else (),
        }


def scene_path(folder: Path, name: str) -> Path:
    """Where the prepared scene lies, from which all its runs start."""
    return folder / "scenes" / f"{name}.json"


def prepare_scene(folder: Path, spec: SceneSpec, config: MDConfig, seed: int, replicas: int = 1) -> dict[str, Any]:
    """Prepare a scene, or take the one that lies in `scenes/NAME.json`, and return its summary. `config`: of any of its
    runs, which share all but temperature and seed; `seed`: of the water around it; `replicas`: how many begin apart.

    A new one is solvated where the solvent is made of molecules, starts of its replicas are drawn; its forces are
    built, so that replicas find parameters that take long in the cache."""
    path = scene_path(folder, spec.name)
    if path.is_file():
        return load_prepared(path).summary()
    scene = prepare(spec.source, options=_chosen(Preparation, spec))
    force = resolve(scene, config.force)
    if spec.preparation.get("keep_water"):
        require_molecules(force)
    if force.is_explicit and scene.cell_nm is None:
        scene = solvate(scene, force, _chosen(WaterBox, spec), seed=seed, temperature_k=config.temperature_k)
    build_system(scene, force)
    prepared = PreparedScene(replace(scene, name=spec.name), force, seed=seed)
    if replicas > 1 and config.starts == "many":
        starts, how = many_starts(prepared.scene, replace(config, force=force, seed=seed), replicas)
        prepared = replace(prepared, starts_nm=tuple(s.positions_nm.tolist() for s in starts), started=how)
    path.parent.mkdir(parents=True, exist_ok=True)
    create_whole(path, json.dumps(vars(prepared) | {"scene": prepared.scene.to_dict(), "force": asdict(force)}))
    return prepared.summary()


def _chosen(kind: type[T], spec: SceneSpec) -> T:
    """Return what a scene's table says of the options of `kind`, the defaults for the rest."""
    return kind(**{name: value for name, value in spec.preparation.items() if name in options_of(kind)})


def load_prepared(path: Path) -> PreparedScene:
    """Read what `prepare_scene` wrote. Raises InputError when it cannot be read."""
    try:
        return built(PreparedScene, parsed(content(path)))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path} cannot be read ({error}); delete it to have the scene prepared again.") from error


def simulate_run(folder: Path, token: str, run: Run) -> dict[str, Any]:
    """Simulate a run, or go on with it, and return what the manifest says of it when it is complete."""
    session = session_of(token)
    # Read when OpenMM creates its first Context: one thread per replica.
    os.environ["OPENMM_CPU_THREADS"] = "1"

    def report(done: int, total: int, note: str | None = None) -> None:
        if note is None:
            session.frames[run.name] = done

    prepared = load_prepared(scene_path(folder, run.scene))
    out = folder / run.file
    out.parent.mkdir(parents=True, exist_ok=True)
    # A worker that this one stands in for, cut off and not yet stopped, may still have the file.
    OutputLock(out, patience_s=2 * LEASE_S, stopped=session.should_stop).close()
    start, config = prepared.start_of(run.replica, run.config), replace(run.config, force=prepared.force)
    session.frames[run.name] = 0
    try:
        simulate(start, config, out, resume=True, progress=report)
    finally:
        session.frames.pop(run.name, None)
    with open_trajectory(out) as reader:
        record, n_frames = dict(reader.record), reader.n_frames
    # The PDB is for other programs: a run without it is whole.
    files = [path for path in (out, *companions(out)) if path.is_file() and path != topology_path(out)]
    return {
        "n_frames": n_frames,
        "size_bytes": out.stat().st_size,
        "sha256": {path.relative_to(folder).as_posix(): file_sha256(path) for path in files},
        "frames_sha256": frames_sha256(out),
        "platform": record.get("platform", ""),
        "programs": {"python": platform.python_version(), **record.get("program", {})},
        "host": socket.gethostname(),
        "wall_s": round(float(record.get("cost", {}).get("wall_s", 0.0)), 3),
    }
