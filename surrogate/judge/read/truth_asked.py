"""What a learned potential's rollout is worth to its truth: its frames reweighted by exp(-(U_truth - U_model) / kT)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.trajectory.codec import DIFFERENCE_COLUMN, reweighting

FloatArray = npt.NDArray[np.float64]

_LEAST = 10
# Below this share of effective frames populations of the truth and of the model are two things.
_FEW = 0.5


def reweighting_notes(
    label: str, records: Sequence[Mapping[str, Any]], scalars: Sequence[Mapping[str, FloatArray]]
) -> list[str]:
    """Return how far a learned potential's frames are those of its truth, where a rollout asked it; else nothing."""
    temperature = records[0].get("temperature_k") if records else None
    columns = [s[DIFFERENCE_COLUMN] for s in scalars if DIFFERENCE_COLUMN in s]
    if not columns or not isinstance(temperature, int | float):
        return []
    asked = np.concatenate(columns)
    asked = asked[~np.isnan(asked)]
    known = asked[np.isfinite(asked)]
    if len(known) < _LEAST:
        return []
    _, effective = reweighting(known, float(temperature))
    truth = records[0].get("force_field", "its truth")
    few = "" if effective >= _FEW * len(known) else "; so few say that populations of the two differ: train longer"
    none = f" and has no energy for {len(asked) - len(known)} more" if len(known) < len(asked) else ""
    return [
        f"{label}: {truth} was asked about {len(known)} frames{none}: U({truth}) - U(model) is {known.mean():.3g} "
        f"kJ/mol with a standard deviation of {known.std():.3g}. Reweighted by exp(-difference / kT) at "
        f"{temperature:g} K, {effective:.0f} of {len(known)} frames are effective{few}."
    ]
