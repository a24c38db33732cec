"""Plan of a rollout: everything that is settled before the first chunk."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.config import RolloutConfig
from surrogate.sampling.domain import DomainMatch
from systems.errors import InputError
from systems.scene import Scene, select_atoms
from systems.units import whole_steps

if TYPE_CHECKING:
    from surrogate.data.weights import Weights

# Farther from the origin float32 coordinates are too coarse for a molecule; frames are then written about it.
_FAR_NM = 1000.0


@dataclass(frozen=True, eq=False)
class Plan:
    """What a rollout works with, settled before the first chunk."""

    scene: Scene
    weights: Weights
    config: RolloutConfig
    match: DomainMatch
    kept_atoms: npt.NDArray[np.int64]  # of the scene
    shift_nm: npt.NDArray[np.float64]  # added to frames when they are written
    save_every_ps: float
    stride: int
    n_frames: int
    n_between: int
    settings: dict[str, Any]

    @property
    def n_steps(self) -> int:
        return self.n_frames * self.stride


def settle_plan(
    scene: Scene, weights: Weights, match: DomainMatch, config: RolloutConfig, sampler: ChunkSampler, *, n_replicas: int
) -> Plan:
    """Turn durations into numbers of frames; `weights` and `match` are what `domain.fit_weights` made of the scene.

    Raises UnitError for intervals that do not divide, InputError for a selection that means no atom.
    """
    lag_ps = weights.domain.lag_ps
    save_every_ps = lag_ps if config.save_every_ps is None else config.save_every_ps
    stride = whole_steps(save_every_ps, lag_ps, "save interval in the weights' frame spacing")
    n_frames = whole_steps(config.time_ps, save_every_ps, "rollout length in save intervals")
    n_between = 0
    if config.md_between_ps:
        n_between = whole_steps(config.md_between_ps, lag_ps, "MD between chunks in the weights' frame spacing")
    kept = np.arange(scene.n_atoms) if config.atoms == "all" else scene.heavy_idx
    if config.select is not None:
        kept = np.intersect1d(kept, select_atoms(scene, config.select))
    if not len(kept):
        raise InputError(f"the selection leaves no atom of {scene.name} to write.")
    if config.anneal_ps and not weights.model.integrates:
        raise InputError("`anneal_ps` is for learned potentials; these weights learned frames. Leave it out.")
    centre = scene.positions_nm.mean(axis=0)
    settings = {
        **asdict(config),
        "solver": sampler.solver,
        "bf16": sampler.precision.bf16,
        "weights_hash": weights.hash,
        "replicas": n_replicas,
        "start": hashlib.sha256(scene.positions_nm.tobytes()).hexdigest()[:16],
    }
    del settings["time_ps"]  # a rollout may be resumed to become longer
    for key in ("lag_ps", "compile", "friction_per_ps", "timestep_ps", "ensemble", "anneal_ps"):
        if settings[key] in (None, False):
            del settings[key]  # as checkpoints of earlier versions have it
    return Plan(
        scene=scene,
        weights=weights,
        config=config,
        match=match,
        kept_atoms=kept,
        shift_nm=centre if np.abs(centre).max() <= _FAR_NM else np.zeros(3),
        save_every_ps=save_every_ps,
        stride=stride,
        n_frames=n_frames,
        n_between=n_between,
        settings=settings,
    )
