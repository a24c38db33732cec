"""Errors of one chunk, against harmonic wells that are solved exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from one_chunk import ChunkError, State, chunk_errors, leapfrog

from surrogate.data import QUANTUM_NM, TrainingFrames, quantise
from systems.errors import InputError
from systems.scene import Scene

STIFFNESS, LAG_PS, SPAN = 20_000.0, 0.002, 2


def harmonic(scene: Scene, t_ps: np.ndarray) -> State:
    """States of atoms tied to their places by springs, about which they swing without a bath."""
    omega = np.sqrt(STIFFNESS / scene.masses_da)[:, None]
    rng, t = np.random.default_rng(0), t_ps[:, None, None]
    amplitude, phase = 0.02 * rng.normal(size=(scene.n_atoms, 3)), rng.uniform(0, 6, size=(scene.n_atoms, 3))
    turn = omega * t + phase
    return scene.positions_nm + amplitude * np.cos(turn), -omega * amplitude * np.sin(turn)


def frames_of(scene: Scene, n: int = 200) -> TrainingFrames:
    x, v = harmonic(scene, LAG_PS * np.arange(n))
    return TrainingFrames(scene, quantise(x), np.array([0, n]), LAG_PS, False, {}, (), v.astype(np.float32))


def errors(scene: Scene, sign: float = 1.0) -> dict[str, ChunkError]:
    omega = np.sqrt(STIFFNESS / scene.masses_da)[:, None]

    def forces(x: np.ndarray) -> np.ndarray:
        return -sign * STIFFNESS * (x - scene.positions_nm)

    def exact(x: np.ndarray, v: np.ndarray) -> State:
        off, turn = x - scene.positions_nm, omega * SPAN * LAG_PS
        cos, sin = np.cos(turn), np.sin(turn)
        return scene.positions_nm + off * cos + v / omega * sin, v * cos - off * omega * sin

    rows = chunk_errors(exact, frames_of(scene), SPAN, forces, starts=40, steps=[1, 4])
    return {row.name: row for row in rows}


def test_leapfrog_is_of_second_order(alanine_dipeptide: Scene) -> None:
    time_ps = 0.004
    begin, end = (harmonic(alanine_dipeptide, t + np.linspace(0, 1, 10)) for t in (0.0, time_ps))

    def off(n: int) -> list[float]:
        found = leapfrog(*begin, lambda x: -STIFFNESS * (x - alanine_dipeptide.positions_nm),
                         alanine_dipeptide.masses_da, time_ps, n)  # fmt: skip
        return [float(np.abs(a - b).max()) for a, b in zip(found, end, strict=True)]

    for coarse, fine in zip(off(8), off(16), strict=True):
        assert coarse / fine == pytest.approx(4.0, rel=0.03)


def test_an_exact_step_is_exact_but_for_the_rounding_of_stored_frames(alanine_dipeptide: Scene) -> None:
    found = errors(alanine_dipeptide)
    # Rounding of the first and of the last frame.
    assert found["model"].position_nm == pytest.approx(QUANTUM_NM / 6**0.5, rel=0.1)
    for name in ("position_nm", "velocity_nm_ps"):
        flight, leap = (getattr(found[row], name) for row in ("straight flight", "leapfrog, 4 x 1.00 fs"))
        assert getattr(found["model"], name) <= leap < 0.2 * flight < 0.2 * getattr(found["frozen frame"], name) + 1e-9
        wrong = getattr(errors(alanine_dipeptide, sign=-1.0)["leapfrog, 4 x 1.00 fs"], name)
        assert wrong > flight, "forces of the wrong sign"


def test_frames_without_velocities_are_refused(alanine_dipeptide: Scene) -> None:
    bare = replace(frames_of(alanine_dipeptide), velocities=None)
    with pytest.raises(InputError, match="with velocities"):
        next(chunk_errors(lambda x, v: (x, v), bare, SPAN, lambda x: x, starts=4, steps=[]))
