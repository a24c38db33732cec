"""A scene of a campaign, prepared once and kept as JSON: what all its replicas start from, on whichever machine."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from md_reference.campaign.campaign_file import SceneSpec
from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import MDConfig
from md_reference.run.platforms import PlatformChoice, measured_platform
from md_reference.run.starts import many_starts
from systems.chemistry.graph import molecule_key
from systems.errors import InputError
from systems.files.outside import content
from systems.files.schema import built, parsed
from systems.options import options_of
from systems.preparation import Preparation
from systems.scene import Scene

T = TypeVar("T")


@dataclass(frozen=True)
class PreparedScene:
    """What replicas share: the scene, the force field settled for it, and the platform they run on; where each begins,
    `(n_atoms, 3)` nm, as far as that is known, how it was found, and the seed of that."""

    scene: Scene
    force: ForceFieldSpec
    platform: PlatformChoice
    starts_nm: tuple[tuple[tuple[float, ...], ...], ...] = ()
    started: str = ""
    seed: int = 0

    def start_of(self, replica: int, config: MDConfig) -> Scene:
        """Return what a replica starts from; that of one by which the campaign has grown is drawn now."""
        if replica < len(self.starts_nm):
            return replace(self.scene, positions_nm=np.array(self.starts_nm[replica]))
        if replica == 0 or config.starts != "many":
            return self.scene
        return many_starts(self.scene, replace(config, force=self.force, seed=self.seed), replica + 1).scenes[-1]

    def account(self) -> dict[str, Any]:
        """Return what the manifest says of it."""
        repairs = self.scene.provenance.get("repairs")
        return {
            "n_atoms": self.scene.n_atoms,
            "formula": self.scene.formula,
            "topology_hash": self.scene.topology_hash,
            "molecule_key": molecule_key(self.scene),
            "platform": self.platform.name,
            "force": asdict(self.force),
            "starts": self.started,
            "repairs": list(map(str, repairs)) if isinstance(repairs, list | tuple) else [],
        }


def prepare_once(path: Path, spec: SceneSpec, config: MDConfig, seed: int, replicas: int = 1) -> PreparedScene:
    """Return the prepared scene, from `path` where it lies there already, else made and written to `path`.

    Prepared, solvated where the solvent is made of molecules (`seed`), its forces built, so that parameters which take
    long are in the cache, its platform chosen, and starts for its `replicas` drawn. Raises what `prepare` and the force
    field refuse.
    """
    if path.is_file():
        return load_prepared(path)
    from md_reference.forces.solvation import require_molecules, solvate
    from systems.files.whole_file import create_whole
    from systems.source import prepare

    scene = prepare(spec.source, options=_chosen(Preparation, spec))
    force = resolve(scene, config.force)
    if spec.preparation.get("keep_water"):
        require_molecules(force)
    if force.is_explicit and scene.cell_nm is None:
        scene = solvate(scene, force, _chosen(WaterBox, spec), seed=seed, temperature_k=config.temperature_k)
    system = build_system(scene, force)
    platform = measured_platform(scene, replace(config, force=force), system=lambda: system)
    prepared = PreparedScene(replace(scene, name=spec.name), force, replace(platform, timings=()), seed=seed)
    if replicas > 1 and config.starts == "many":
        starts = many_starts(prepared.scene, replace(config, force=force, seed=seed), replicas)
        frames = tuple(s.positions_nm.tolist() for s in starts.scenes)
        prepared = replace(prepared, starts_nm=frames, started=starts.how)
    record = {
        "scene": prepared.scene.to_dict(),
        "force": asdict(force),
        "platform": asdict(prepared.platform),
        "starts_nm": prepared.starts_nm,
        "started": prepared.started,
        "seed": seed,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    create_whole(path, json.dumps(record))
    return prepared


def _chosen(kind: type[T], spec: SceneSpec) -> T:
    """Return what a scene's table says of the options of `kind`, the defaults for the rest."""
    return kind(**{name: value for name, value in spec.preparation.items() if name in options_of(kind)})


def load_prepared(path: Path) -> PreparedScene:
    """Read what `prepare_once` wrote. Raises InputError when it cannot be read."""
    try:
        return built(PreparedScene, parsed(content(path)))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); delete it to have the scene prepared again.") from error
