"""MD that a scripted model would have been trained on, and its domain."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from scripted_model import (
    CONDITIONS,
    LAG_PS,
)
from surrogate.models.weights import TrainingDomain
from systems.chemistry.geometry import superpose
from systems.chemistry.validity import geometry_from_frames, limits_from_frames
from systems.scene import Scene


@pytest.fixture(scope="module")
def md(alanine_dipeptide: Scene) -> Iterator[np.ndarray]:
    """30 ps of MD, frames 0.1 ps apart, superposed: what the scripted model would have been trained on."""
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.config import Conditions
    from md_reference.run.engine import Engine

    with Engine(
        alanine_dipeptide, Conditions(force=ForceFieldSpec("ff14SB", "obc2", 3.0), timestep_ps=0.002, seed=3)
    ) as engine:
        engine.minimise(max_iterations=100)
        engine.thermalise()
        engine.step(1000)
        frames = []
        for _ in range(300):
            engine.step(50)
            frames.append(engine.positions())
    yield superpose(np.stack(frames), alanine_dipeptide.positions_nm, idx=alanine_dipeptide.heavy_idx)


@pytest.fixture(scope="module")
def scene(alanine_dipeptide: Scene, md: np.ndarray) -> Scene:
    return alanine_dipeptide.with_positions(md[-1] + [3.0, 0.0, -2.0])


@pytest.fixture(scope="module")
def domain(alanine_dipeptide: Scene, md: np.ndarray) -> TrainingDomain:
    geometry = geometry_from_frames(alanine_dipeptide, md)
    # The scripted model trembles less than MD moves; what is to be caught of it is its faults.
    limits = replace(limits_from_frames(alanine_dipeptide, md[:-1], md[1:]), jump_min_nm=1e-9)
    return TrainingDomain(alanine_dipeptide, LAG_PS, CONDITIONS, geometry.to_dict(), limits.to_dict())
