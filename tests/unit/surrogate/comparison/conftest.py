"""A toy alanine dipeptide whose torsions follow a known Markov chain: fast to sample, all that the comparison looks
at."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from small_scenes import beyond, turn_frames
from surrogate.comparison.read.ensemble import Ensemble
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions
from systems.scene import Scene

# States: beta, alpha, left-handed. Rows sum to one; the slowest exchange takes some ten frames.
TRANSITIONS = np.array([[0.88, 0.10, 0.02], [0.15, 0.83, 0.02], [0.06, 0.06, 0.88]])
CENTRES_RAD = np.radians([[-75.0, 150.0], [-70.0, -20.0], [60.0, 40.0]])


def pose(scene: Scene, phi: np.ndarray, psi: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Frames `(n, 22, 3)` float32 nm with these torsions, and thermal noise of 2 pm on every coordinate."""
    quads = backbone_torsions(scene)
    x = np.repeat(scene.positions_nm[None].astype(np.float64), len(phi), axis=0)
    for quad, target in ((quads["phi"][0], phi), (quads["psi"][0], psi)):
        _, i, j, _ = (int(a) for a in quad)
        start = float(torsion(scene.positions_nm[None], quad[None])[0, 0])
        turn_frames(x, i, j, beyond(scene, i, j), target - start)
    return (x + 0.002 * rng.standard_normal(x.shape)).astype(np.float32)


def torsion_path(
    n: int, rng: np.random.Generator, transitions: np.ndarray = TRANSITIONS
) -> tuple[np.ndarray, np.ndarray]:
    """Phi and psi `(n,)` of the Markov chain, with correlated fluctuation inside a state."""
    cumulative = transitions.cumsum(1)
    draws = rng.random(n)
    state = np.empty(n, dtype=int)
    current = 0
    for t in range(n):
        current = int(np.searchsorted(cumulative[current], draws[t]))
        state[t] = current
    wiggle = np.empty((n, 2))
    kick = rng.standard_normal((n, 2)) * 0.25
    wiggle[0] = kick[0]
    for t in range(1, n):
        wiggle[t] = 0.6 * wiggle[t - 1] + 0.8 * kick[t]
    return tuple((CENTRES_RAD[state] + wiggle).T)  # type: ignore[return-value]


@pytest.fixture(scope="session")
def simulate(alanine_dipeptide: Scene) -> Callable[..., Ensemble]:
    """`simulate(seed, n_frames, n_segments=1, transitions=...)` -> an ensemble of the toy dipeptide at 1 ps."""

    def run(seed: int, n_frames: int = 12_000, n_segments: int = 1, transitions: np.ndarray = TRANSITIONS) -> Ensemble:
        rng = np.random.default_rng(seed)
        segments = [
            pose(alanine_dipeptide, *torsion_path(n_frames // n_segments, rng, transitions), rng)
            for _ in range(n_segments)
        ]
        return Ensemble(f"toy {seed}", segments, 1.0, alanine_dipeptide, record={"temperature_k": 300.0})

    return run


@pytest.fixture(scope="session")
def inputs(simulate: Callable[..., Ensemble]) -> tuple[Ensemble, Ensemble, Ensemble]:
    """Reference, an equally good candidate, and the replicate."""
    return simulate(1), simulate(2), simulate(3)
