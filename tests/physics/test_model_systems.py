"""Model systems against known answers: equipartition, frequencies, populations."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from known_answers import double_well_left_population, harmonic_answers
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from systems.library.named_scenes import double_well, harmonic_oscillator, particles
from systems.scene import FloatArray, Scene

MODEL = ForceFieldSpec("model", "vacuum")
STANDARD_ERRORS = 4.0
N_COPIES = 400


def copies(scene: Scene, n: int) -> Scene:
    """`n` independent particles in the well of a scene of one: its law acts on each."""
    law = dict(scene.interactions or {})
    return particles("copies", law, np.repeat(scene.positions_nm, n, axis=0))


def sampled(scene: Scene, temperature_k: float, *, n_frames: int, every_ps: float, discarded_ps: float) -> FloatArray:
    """Positions `(n_frames, n_copies, 3)` nm in the bath; each particle is an independent run."""
    timestep_ps = 0.02
    with Engine(
        copies(scene, N_COPIES),
        Conditions(force=MODEL, temperature_k=temperature_k, timestep_ps=timestep_ps, seed=5, platform="Reference"),
    ) as engine:
        engine.thermalise()
        engine.step(round(discarded_ps / timestep_ps))
        frames = np.empty((n_frames, N_COPIES, 3))
        for k in range(n_frames):
            engine.step(round(every_ps / timestep_ps))
            frames[k] = engine.positions()
    return frames


def agrees(per_particle: FloatArray, expected: Any) -> Any:
    """Whether the mean over independent particles `(n_copies, ...)` lies within its error of what is expected."""
    error = per_particle.std(axis=0, ddof=1) / np.sqrt(len(per_particle))
    return np.abs(per_particle.mean(axis=0) - expected) < STANDARD_ERRORS * error


# ---- one particle in a well ----------------------------------------------------------------------------------------


def test_the_harmonic_variance_is_kt_over_k_along_each_axis() -> None:
    scene = harmonic_oscillator()
    x = sampled(scene, 300.0, n_frames=40, every_ps=0.5, discarded_ps=10.0)
    squares = (x**2).mean(axis=0)  # (n_copies, 3)
    expected = harmonic_answers(scene, 300.0)["variance_nm2"]
    np.testing.assert_allclose(expected, 8.314462618e-3 * 300.0 / np.array([50.0, 100.0, 200.0]), rtol=1e-9)
    assert agrees(squares, expected).all()
    assert agrees(x.mean(axis=0), 0.0).all()
    # Negative controls: another temperature, and the axes exchanged.
    assert not agrees(squares, harmonic_answers(scene, 330.0)["variance_nm2"]).any()
    assert not agrees(squares, expected[[1, 2, 0]]).any()


def free_run(scene: Scene, time_ps: float, *, timestep_ps: float = 0.001, n_frames: int = 50) -> tuple[Any, Any, Any]:
    """Times `(n,)`, positions and velocities `(n, n_particles, 3)` without a bath, from rest."""
    stride = round(time_ps / timestep_ps / n_frames)
    positions, velocities = np.empty((2, n_frames, scene.n_atoms, 3))
    with Engine(
        scene, Conditions(force=MODEL, ensemble="nve", timestep_ps=timestep_ps, platform="Reference")
    ) as engine:
        for k in range(n_frames):
            engine.step(stride)
            state = engine.state(velocities=True)
            positions[k], velocities[k] = state.positions_nm, state.velocities_nm_ps
    return timestep_ps * stride * np.arange(1, n_frames + 1), positions, velocities


def test_the_harmonic_oscillator_has_the_frequency_root_k_over_m() -> None:
    scene = harmonic_oscillator()
    t, x, v = free_run(scene, 10.0)
    omega = harmonic_answers(scene, 300.0)["angular_frequency_per_ps"]
    np.testing.assert_allclose(omega, np.sqrt(np.array([50.0, 100.0, 200.0]) / 12.0), rtol=1e-12)

    def exact(frequency: FloatArray) -> tuple[FloatArray, FloatArray]:
        phase = t[:, None] * frequency
        return scene.positions_nm * np.cos(phase), -scene.positions_nm * frequency * np.sin(phase)

    np.testing.assert_allclose(x[:, 0], exact(omega)[0], atol=1e-5)
    np.testing.assert_allclose(v[:, 0], exact(omega)[1], atol=5e-5)
    # Negative control: one part in a thousand in the frequency, as from a mass of 12.02 Da, is seen.
    assert np.abs(x[:, 0] - exact(1.001 * omega)[0]).max() > 1e-3


@cache
def left_share(temperature_k: float) -> FloatArray:
    x = sampled(double_well(), temperature_k, n_frames=40, every_ps=1.0, discarded_ps=40.0)
    return (x[..., 0] < 0).mean(axis=0)


def test_double_well_populations_are_those_of_the_boltzmann_density() -> None:
    from scipy.integrate import quad

    scene = double_well()
    expected = double_well_left_population(scene, 300.0)

    def weight(x: float) -> float:
        return float(np.exp(-(6.0 * ((x / 0.3) ** 2 - 1.0) ** 2 + 2.5 * x) / (8.314462618e-3 * 300.0)))

    left, right = quad(weight, -2.0, 0.0)[0], quad(weight, 0.0, 2.0)[0]
    assert expected == pytest.approx(left / (left + right), abs=1e-6)
    assert 0.6 < expected < 0.7
    share = left_share(300.0)
    assert share.std() > 0.0, "no particle crossed"
    assert agrees(share, expected), f"{share.mean():.3f} against {expected:.3f}"
    # Negative controls: the tilt the other way round, no tilt, and a bath of 600 K.
    assert not agrees(share, 1.0 - expected)
    assert not agrees(share, 0.5)
    assert not agrees(share, double_well_left_population(scene, 600.0))
