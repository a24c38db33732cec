"""The made-up trajectories of the comparison's benchmark are what they say, and the benchmark measures what it runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from compare_speed import (
    CENTRES_RAD,
    TRANSITIONS,
    pose,
    profile_lines,
    time_compare,
    torsion_path,
    write_trajectory,
)

from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions
from systems.scene import Scene


def test_frames_have_the_torsions_asked_for(alanine_dipeptide: Scene) -> None:
    rng = np.random.default_rng(0)
    asked = rng.uniform(-np.pi, np.pi, (500, 2))
    frames = pose(alanine_dipeptide, asked, rng)
    quads = backbone_torsions(alanine_dipeptide)
    for column, name in enumerate(("phi", "psi")):
        off = torsion(frames, np.asarray(quads[name][:1]))[:, 0] - asked[:, column]
        off -= 2 * np.pi * np.round(off / (2 * np.pi))
        # A shake of 2 pm on bonds of 150 pm turns a torsion by a degree or so.
        assert abs(off.mean()) < 0.01 and off.std() < 0.05
    bonds = np.asarray(alanine_dipeptide.bonds)
    lengths = np.linalg.norm(frames[:, bonds[:, 0]] - frames[:, bonds[:, 1]], axis=-1)
    at_rest = alanine_dipeptide.positions_nm[bonds[:, 0]] - alanine_dipeptide.positions_nm[bonds[:, 1]]
    np.testing.assert_allclose(lengths.mean(0), np.linalg.norm(at_rest, axis=-1), atol=5e-4)


def test_states_are_visited_as_the_chain_says() -> None:
    path = torsion_path(400_000, np.random.default_rng(1))
    away = path[:, None] - CENTRES_RAD
    away -= 2 * np.pi * np.round(away / (2 * np.pi))
    state = (away**2).sum(-1).argmin(1)
    values, vectors = np.linalg.eig(TRANSITIONS.T)
    stationary = np.real(vectors[:, np.argmax(values.real)])
    stationary /= stationary.sum()
    # Some 4,000 visits to each state: 2 % each way.
    np.testing.assert_allclose(np.bincount(state) / len(state), stationary, atol=0.03)


@pytest.mark.slow
def test_a_run_is_timed_and_profiled(tmp_path: Path) -> None:
    files = [write_trajectory(tmp_path / f"{k}.h5", 400, k) for k in range(3)]
    timing = time_compare(files, tmp_path / "report.html", tmp_path / "profile")
    assert (tmp_path / "report.html").is_file()
    assert timing.frames == 400 and timing.atoms == 22
    assert timing.cpu_s > 0 and 0.05 < timing.memory_gb < 4.0
    assert any("surrogate/comparison/comparison.py:compare" in line for line in profile_lines(tmp_path / "profile"))
