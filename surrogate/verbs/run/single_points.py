"""Energies of an expensive reference at frames of a potential's rollout: by these its frames follow the reference's own
law, at the cost of a single point for what costs MD thousands of steps."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import torch

from md_reference.run.labeller import Labeller
from surrogate.comparison.measure.statistics import FloatArray
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.models.potential import Potential
from surrogate.models.propagator import Molecule
from surrogate.models.weights import Weights
from surrogate.sampling.domain import match_known
from surrogate.verbs.run.run_record import ENERGIES_NAME
from systems.chemistry.validity import INVALID
from systems.errors import InputError
from systems.files.outside import content
from systems.files.whole_file import create_whole
from systems.interrupts import stop_if_asked
from systems.scene import Scene

_COLUMNS = "replica,frame,difference_kj_mol"
# Frames that a core computes before the clock is looked at again.
_TOGETHER = 16


def ask_reference(scene: Scene, weights: Weights, rolled: Ensemble, folder: Path, seconds: float, seed: int) -> None:
    """Write U_reference - U_model, kJ/mol, of frames into `folder`: as many as `seconds` allow, and a few in any case,
    valid ones drawn at random, none that is there already.

    Frames that the reference has no energy for, or that are another molecule, get infinity. Raises InputError where it
    has none of any, PreparationError for what it refuses.
    """
    until = time.monotonic() + seconds
    model = weights.model
    assert isinstance(model, Potential)
    match = match_known(scene, weights.domain, weights.path.name)
    molecule = Molecule.of(weights.domain.scene if match.seen else scene)
    flags = rolled.flags or [np.zeros(n, dtype=np.uint16) for n in rolled.segment_lengths]
    found = differences(folder, rolled.segment_lengths)
    frames = [
        (k, int(t)) for k, f in enumerate(flags) for t in np.flatnonzero(((f & INVALID) == 0) & np.isnan(found[k]))
    ]
    order = np.random.default_rng(seed).permutation(len(frames))
    try:
        with Labeller(scene) as reference:
            n = _TOGETHER * reference.n_workers
            for first in range(0, len(order), n):
                batch = [frames[i] for i in order[first : first + n]]
                x = np.array([rolled.segments[k][t] for k, t in batch], dtype=np.float64)
                with torch.no_grad():
                    own = model.energies(torch.from_numpy(x[:, match.order]), molecule).mean(-1).numpy()
                for (k, t), difference in zip(batch, reference.energies(x) - own, strict=True):
                    found[k][t] = difference
                stop_if_asked()
                if time.monotonic() > until:
                    break
    finally:  # what was asked is kept, also where its time was up
        if any(np.isfinite(f).any() for f in found):
            _write(folder, found)
    if not any(np.isfinite(f).any() for f in found):
        raise InputError("GFN2-xTB has no energy of any frame of the rollout.")


def _write(folder: Path, found: list[FloatArray]) -> None:
    rows = [f"{k},{t},{f[t]:.6f}" for k, f in enumerate(found) for t in np.flatnonzero(~np.isnan(f)).tolist()]
    create_whole(folder / ENERGIES_NAME, "\n".join([_COLUMNS, *rows]) + "\n")


def differences(folder: Path, lengths: list[int]) -> list[FloatArray]:
    """Return the differences in a folder, an array of `lengths` a replica, NaN for frames that were not asked for.
    Raises InputError for a damaged file."""
    found, path = [np.full(n, np.nan) for n in lengths], folder / ENERGIES_NAME
    try:
        lines = content(path).decode().splitlines()[1:] if path.is_file() else []
        for replica, frame, difference in (line.split(",") for line in lines):
            k, t = int(replica), int(frame)
            if 0 <= k < len(found) and 0 <= t < len(found[k]):
                found[k][t] = float(difference)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); remove it, and `resume=True` asks anew.") from error
    return found
