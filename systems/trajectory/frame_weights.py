"""Weights of frames: how much each counts at equilibrium, in `/surromd/weights` of the trajectory."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import numpy.typing as npt

from systems.errors import TrajectoryError
from systems.trajectory.codec import companions, open_trajectory
from systems.trajectory.frame_store import WEIGHTS, FrameStore, open_hdf5


def frame_weights(path: str | Path) -> npt.NDArray[np.float64]:
    """Return the weights `(n_frames,)` of a trajectory's frames at equilibrium; ones where the file has none.

    All replicas of one answer share a scale, mean 1 over all their frames: concatenate them as the frames. Raises
    TrajectoryError for a damaged file, or one that has grown since the weights were written.
    """
    path = Path(path)
    with closing(open_trajectory(path)) as reader:
        n_frames = reader.n_frames
    store = _store(path)
    if store.suffix in (".h5", ".hdf5") and store.is_file():
        with closing(open_hdf5(store)) as file:
            if WEIGHTS in file:
                weights = np.asarray(file[WEIGHTS][:], dtype=np.float64)
                if len(weights) != n_frames:
                    raise TrajectoryError(
                        f"{path} holds {n_frames} frames and weights of {len(weights)}: it has grown since they were "
                        "written; let the run that made it end."
                    )
                return weights
    return np.ones(n_frames)


def write_weights(path: Path, weights: npt.NDArray[np.float64]) -> None:
    """Write weights `(n_frames,)` into a trajectory of ours, or replace them. Raises InputError for another number of
    them, TrajectoryError for a file of others, StorageError."""
    with closing(FrameStore(_store(path))) as store:
        store.write_weights(np.asarray(weights, dtype=np.float64))


def _store(path: Path) -> Path:
    """Return the HDF5 file that holds a trajectory's columns: itself, or what lies beside a DCD."""
    return next((p for p in companions(path) if p.name.endswith(".meta.h5")), path)
