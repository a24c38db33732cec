"""Rollouts of peptides beside MD of them: as long and as often, or many and long to count what is rare."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surrogate.models.peptides.chains import POSITIVE_PHI_DEG
from systems.errors import InputError

if TYPE_CHECKING:
    from surrogate.models.weights import Weights
    from systems.scene import Scene

FloatArray = npt.NDArray[np.float64]
# Frames of rollouts and of MD are compared so far apart.
FRAMES_PS = 10.0
# Rollouts by which rare states are counted.
REPLICAS, REPLICA_PS, REPLICA_LAG_PS = 64, 200_000.0, 50.0
_MARKOV_LAG_PS = 50.0


def thinned(paths: Sequence[Path], apart_ps: float = FRAMES_PS) -> tuple[Scene, list[FloatArray], float]:
    """Return the scene, the frames `apart_ps` apart of each file, and the time that the first one spans."""
    from systems.trajectory.codec import open_trajectory

    frames = []
    for path in paths:
        with open_trajectory(path) as reader:
            every = max(1, round(apart_ps / float(reader.time_ps[1] - reader.time_ps[0])))
            frames.append(reader.read(every - 1, None, every).astype(np.float64))
            scene = reader.scene
    if scene is None:
        raise InputError(f"{paths[-1]} does not say what molecule it is of.")
    return scene, frames, len(frames[0]) * apart_ps


def rolled(
    weights: Weights, scene: Scene, outs: Sequence[Path], time_ps: float, lag_ps: float = FRAMES_PS,
    solvent: str | None = None, starts_nm: FloatArray | None = None,
) -> list[FloatArray]:  # fmt: skip
    """Return the frames of unguarded rollouts, of molecules longer than any in training too; those that are there are
    read. `starts_nm`: where each begins."""
    from surrogate.sampling.runner import RolloutConfig, rollout

    if not all(out.exists() for out in outs):
        outs[0].parent.mkdir(parents=True, exist_ok=True)
        rollout(
            scene,
            weights,
            outs,
            RolloutConfig(time_ps=time_ps, lag_ps=lag_ps, solvent=solvent, seed=1, guard="off", force=True),
            starts_nm=starts_nm,
            overwrite=True,
        )
    return [thinned([out], lag_ps)[1][0] for out in outs]


def frame_weights(runs: Sequence[FloatArray], phi: int | None = None, positive_kt: float | None = None) -> FloatArray:
    """Return how likely each frame of seeded runs, torsions `(n_frames, n)` FRAMES_PS apart, is in equilibrium.

    `positive_kt`: the free energy of phi > 0, where it is known, of the torsion at place `phi`.
    """
    from surrogate.models.peptides.subjects import equilibrium_weights

    states = shares = None
    if phi is not None and positive_kt is not None:
        low, high = np.radians(POSITIVE_PHI_DEG)
        angle = np.concatenate(runs)[:, phi]
        states, shares = ((angle > low) & (angle < high)).astype(np.int64), np.array([1.0, np.exp(-positive_kt)])
    found = equilibrium_weights(
        [np.concatenate([np.cos(x), np.sin(x)], axis=1) for x in runs], round(_MARKOV_LAG_PS / FRAMES_PS),
        states=states, shares=shares,
    )  # fmt: skip
    n = sum(len(x) for x in runs)
    return np.full(n, 1.0 / n) if found is None else found / found.sum()


def free_energy(shares: Sequence[float]) -> dict[str, float | None]:
    """Return the free energy in kT of a state that runs spend `shares` of their time in, and its standard error; None
    where it was never seen, or nothing else."""
    p = float(np.mean(shares))
    if not 0 < p < 1:
        return {"free_energy_kt": None, "error_kt": None}
    # of ln((1 - p) / p), by the scatter of p over runs
    error = float(np.std(shares, ddof=1) / len(shares) ** 0.5 / (p * (1 - p)))
    return {"free_energy_kt": float(np.log((1 - p) / p)), "error_kt": error}
