"""Frames of one potential as frames of another: weights, and how many frames they leave."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from systems.units import GAS_CONSTANT_KJ_MOL_K

FloatArray = npt.NDArray[np.floating[Any]]

# Scalar column of a rollout: U_truth - U_model in kJ/mol, NaN where the truth was not asked.
DIFFERENCE_COLUMN = "energy_difference_kj_mol"


def reweighting(differences_kj_mol: FloatArray, temperature_k: float) -> tuple[FloatArray, float]:
    """Return the weights `(n,)`, summing to one, that turn a potential's frames into those of the truth, and how many
    effective frames they leave (Kish: 1 / sum w^2).

    `differences_kj_mol` (n,): U_truth - U_model at the frames; w is proportional to exp(-difference / kT). Independent
    frames are assumed; correlation in time lessens the number further.
    """
    reduced = -np.asarray(differences_kj_mol, dtype=np.float64) / (GAS_CONSTANT_KJ_MOL_K * temperature_k)
    weights = np.exp(reduced - reduced.max())
    weights /= weights.sum()
    return weights, float(1.0 / np.square(weights).sum())
