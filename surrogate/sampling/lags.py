"""Lag of a rollout, the time between its frames: the weights' one spacing, or any in the range of their training."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from systems.errors import InputError
from systems.units import format_time_ps

if TYPE_CHECKING:
    from surrogate.data.weights import TrainingDomain, Weights

_ROUNDING = 1e-6


def choose_lag(weights: Weights, lag_ps: float | None, save_every_ps: float | None) -> float:
    """Return the lag of a rollout: the one asked for, else the longest that the save interval is a multiple of, so that
    no frame is computed that nobody keeps; without either the shortest. Weights for one lag have that one.

    Raises InputError for a lag that the weights were not trained for.
    """
    domain, name = weights.domain, weights.path.name
    low, high = domain.lag_ps, domain.longest_lag_ps
    if not domain.jumps:
        if lag_ps is not None and not math.isclose(lag_ps, low, rel_tol=_ROUNDING):
            raise InputError(f"{name} steps {format_time_ps(low)} and takes no other lag; leave `lag_ps` out.")
        return low
    if lag_ps is None:
        if save_every_ps is None:
            return low
        lag_ps = save_every_ps / max(1, math.ceil(save_every_ps / high - _ROUNDING))
    if not low * (1 - _ROUNDING) <= lag_ps <= high * (1 + _ROUNDING):
        raise InputError(
            f"{name} was trained for lags of {format_time_ps(low)} to {format_time_ps(high)}, not for "
            f"{format_time_ps(lag_ps)}; choose `lag_ps`, or `save_every_ps`, inside that range."
        )
    return lag_ps


def at_lag(weights: Weights, domain: TrainingDomain, lag_ps: float) -> Weights:
    """Return the weights with a model that steps `lag_ps`, for one molecule's `domain`, with limits of jumps at that
    lag."""
    if not domain.jumps:
        return weights if domain is weights.domain else replace(weights, domain=domain)
    limits = domain.limits
    if limits is not None:
        lags, least, most = np.array(domain.jumps).T
        after = int(np.clip(np.searchsorted(lags, lag_ps * (1 - _ROUNDING)), 0, len(lags) - 1))
        # Between two measured lags the wider of their limits.
        around = slice(after if math.isclose(lags[after], lag_ps, rel_tol=_ROUNDING) else max(after - 1, 0), after + 1)
        limits = {**limits, "jump_min_nm": float(least[around].min()), "jump_max_nm": float(most[around].max())}
    return replace(
        weights, model=weights.model.at_lag(lag_ps), domain=replace(domain, lag_ps=lag_ps, limits=limits, jumps=())
    )
