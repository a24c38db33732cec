"""The stress test's own measures on frames whose faults are known, and the whole of it on tiny weights."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from md_reference.run.engine import Engine
from surrogate.bench.stress import (
    markdown,
    measure_bonds,
    measure_drift,
    measure_length,
    measure_odd_inputs,
    measure_openmm,
    measure_validity,
    stress,
)
from surrogate.bench.timing import openmm_of
from surrogate.models.weights import Weights
from surrogate.verbs.options import StressOptions
from systems.chemistry.validity import Geometry, geometry_from_frames
from systems.errors import InputError
from systems.scene import Scene


@pytest.fixture(scope="module")
def vibrating(alanine_dipeptide: Scene) -> np.ndarray:
    """Four replicas of 200 frames that vibrate by 0.003 nm, `(4, 200, 22, 3)` nm."""
    noise = np.random.default_rng(0).normal(scale=0.003, size=(4, 200, 22, 3))
    return alanine_dipeptide.positions_nm + noise


@pytest.fixture(scope="module")
def geometry(alanine_dipeptide: Scene, vibrating: np.ndarray) -> Geometry:
    return geometry_from_frames(alanine_dipeptide, vibrating.reshape(-1, 22, 3))


def test_broken_frames_are_counted(vibrating: np.ndarray, geometry: Geometry) -> None:
    assert measure_validity(list(vibrating), geometry) == {"valid_half_angstrom_%": 100.0, "valid_all_%": 100.0}
    broken = vibrating.copy()
    broken[1, 49, 0] += 0.3
    broken[1, 120:, 0] += 0.3
    broken[3, 9] = np.nan
    found = measure_validity(list(broken), geometry)
    assert list(found.values()) == pytest.approx([100 * (1 - 82 / 800)] * 2)


def test_bonds_tell_length_and_temperature(vibrating: np.ndarray, geometry: Geometry, alanine_dipeptide: Scene) -> None:
    frames = vibrating.reshape(-1, 22, 3)
    same = measure_bonds(frames, geometry)
    assert same["bond_shift_pm"] < 1e-6 and same["bond_variance_%"] == pytest.approx(100.0, abs=1e-6)
    longer = measure_bonds(frames * 1.01, geometry)
    assert longer["bond_shift_pm"] == pytest.approx(10.0 * geometry.bond_mean_nm.mean(), rel=0.05)
    centre = alanine_dipeptide.positions_nm
    hotter = measure_bonds(centre + np.sqrt(1.5) * (frames - centre), geometry)
    assert hotter["bond_variance_%"] == pytest.approx(150.0, abs=2.0)


def test_drift_between_first_and_last_tenth(
    vibrating: np.ndarray, geometry: Geometry, alanine_dipeptide: Scene
) -> None:
    still = measure_drift(list(vibrating), alanine_dipeptide, geometry)
    assert abs(still["first_bond_variance_%"] - still["last_bond_variance_%"]) < 25.0
    drifting = vibrating.copy()
    drifting[:, 150:, 14:] += [0.0, 0.06, 0.06]  # all atoms from C of ALA on
    moved = measure_drift(list(drifting), alanine_dipeptide, geometry)
    assert moved["last_bond_shift_pm"] > 5.0 > moved["first_bond_shift_pm"]
    assert moved["torsion_distance"] > 3.0 * moved["torsion_distance_by_chance"]
    assert still["torsion_distance"] < 2.0 * still["torsion_distance_by_chance"]


def test_odd_inputs_are_refused_with_their_reason(small_weights: Weights) -> None:
    rows = {row["input"]: row for row in measure_odd_inputs(small_weights, chunks=1)}
    assert rows["noise of 0.001 nm"]["outcome"] == "run" and rows["noise of 0.001 nm"]["forced"] == ""
    assert rows["strained: all bonds 40 % longer"]["reasons"] == "start"
    for name in ("mirrored", "heavy atoms only", "a proton less", "a coordinate that is no number"):
        assert rows[name]["outcome"] == "refused" and rows[name]["forced"] == "refused too", name
    assert rows["heavy atoms only"]["reasons"] == "molecule"
    assert "start" in rows["clashing: two far atoms 0.02 nm apart"]["reasons"]


def test_a_whole_stress_test_writes_its_tables(tmp_path: Path, small_weights: Weights) -> None:
    options = StressOptions(frames=[80], replicas=2, guards=["off"], sections=["length"], quick=True)
    shown: list[str] = []
    result = stress(small_weights, tmp_path, options, report=shown.append)
    assert shown == ["length"]
    (row,) = result["sections"]["length"]
    assert row["frames"] == 80 and 0.0 <= row["valid_half_angstrom_%"] <= 100.0
    assert json.loads((tmp_path / "stress.json").read_text())["sections"]["length"][0]["frames"] == 80
    text = (tmp_path / "stress.md").read_text()
    assert "## Long rollouts" in text and "chunks helped" in text and text == markdown(result)
    other = replace(small_weights, hash="another")
    (row,) = stress(other, tmp_path, replace(options, sections=["length"]))["sections"]["length"]
    assert "started with weights_hash" in row["outcome"], "rollouts of other weights are not taken for its own"
    with (
        pytest.raises(InputError, match="do not say their force_field"),
        openmm_of(replace(small_weights.domain, conditions={"solvent": "obc2", "temperature_k": 300.0}), 0.001, 0),
    ):
        pass
    with pytest.raises(InputError, match="ten frames"):
        stress(small_weights, tmp_path, StressOptions(frames=[100], replicas=16))


def test_a_rollout_that_was_stopped_is_measured_again(tmp_path: Path, small_weights: Weights) -> None:
    """By the guard of a model that a second's training leaves wrong."""
    rows = [measure_length(small_weights, tmp_path, 40, replicas=2, guard="flag") for _ in range(2)]
    assert "replica" in rows[0].pop("outcome") and "stopped by the guards" in rows[1].pop("outcome")
    assert rows[0] == rows[1] and rows[0]["frames"] > 0


@pytest.mark.parametrize("rigid", [True, False])
def test_openmm_moves_in_every_frame_under_the_constraints_of_the_reference(
    small_weights: Weights, rigid: bool
) -> None:
    conditions = {"force_field": "ff14SB", "solvent": "vacuum", "temperature_k": 300.0, "constrain_hydrogens": rigid}
    domain = replace(small_weights.domain, conditions=conditions, lag_ps=0.0004)
    with openmm_of(domain, 0.001, seed=1) as engine:
        frames = []
        for _ in range(20):
            engine.step(5)
            frames.append(engine.positions())
    scene = domain.scene
    light = [(i, j) for i, j in scene.bonds.tolist() if "H" in (scene.elements[i], scene.elements[j])]
    i, j = np.array(light).T
    spread = np.linalg.norm(np.array(frames)[:, i] - np.array(frames)[:, j], axis=-1).std(axis=0)
    assert (spread.max() < 1e-5) if rigid else (spread.min() > 1e-4)
    # Frames 0.4 fs apart, and steps of 1 fs and more.
    taken, usual = [], Engine.step

    def step(engine: Engine, n_steps: int) -> None:
        taken.append(n_steps)
        usual(engine, n_steps)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("surrogate.bench.stress.DISCARDED_PS", 0.05)
        patch.setattr(Engine, "step", step)
        assert measure_openmm(replace(small_weights, domain=domain), n_frames=4)[0]["timestep_fs"] == 1.0
    assert taken[:5] == [50, 1, 1, 1, 1] and min(taken) == 1
