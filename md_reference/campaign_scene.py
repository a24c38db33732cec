"""A scene of a campaign, prepared once and kept as JSON: what all its replicas start from, on whichever machine."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from md_reference.campaign_file import SceneSpec
from md_reference.forcefield import ForceFieldSpec
from md_reference.simulate import MDConfig
from systems.errors import InputError
from systems.scene import Scene


def prepared_scene(path: Path, spec: SceneSpec, config: MDConfig, seed: int) -> dict[str, Any]:
    """Write the prepared scene to `path`, unless it is there, and return its account for the manifest.

    The platform is chosen and the force field's parameters are made here, once for all replicas.
    Raises what `prepare` and the force field refuse.
    """
    if not path.is_file():
        _prepare(path, spec, config, seed)
    record = _read(path)
    scene = Scene.from_dict(record["scene"])
    return {
        "n_atoms": scene.n_atoms,
        "formula": scene.formula,
        "topology_hash": scene.topology_hash,
        "molecule_key": scene.molecule_key,
        "platform": record["platform"],
        "force": record["force"],
        "repairs": list(scene.provenance.get("repairs", [])),
    }


def _prepare(path: Path, spec: SceneSpec, config: MDConfig, seed: int) -> None:
    from md_reference.engine import Engine
    from systems.prepare import prepare
    from systems.whole_file import create_whole

    scene = replace(prepare(spec.source, **spec.preparation), name=spec.name)
    with Engine(scene, config.force, timestep_ps=config.timestep_ps, platform=config.platform) as engine:
        chosen = engine.platform_name
    record = {"scene": scene.to_dict(), "force": asdict(config.force), "platform": chosen}
    path.parent.mkdir(parents=True, exist_ok=True)

    def fill(temporary: Path) -> None:
        temporary.write_text(json.dumps(record), encoding="utf-8")

    create_whole(path, fill)


def _read(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); delete it to have the scene prepared again.") from error


def load_prepared(path: Path, config: MDConfig) -> tuple[Scene, MDConfig]:
    """Return the prepared scene and a run's settings with what was decided for all replicas of the scene."""
    record = _read(path)
    return Scene.from_dict(record["scene"]), replace(
        config, force=ForceFieldSpec(**record["force"]), platform=record["platform"]
    )
