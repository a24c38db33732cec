"""Rollouts: resumable, independent replicas, marked frames, other people's atom order, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surrogate.models.lam_slide.model import LamSlide
from surrogate.models.weights import Weights
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.chemistry.validity import INVALID, NOT_FINITE
from systems.errors import InputError, OutOfDomainError, SimulationError, UnitError
from systems.options import options_of
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

# Weights of a second's training, no frame of which a guard lets pass.
CONFIG = RolloutConfig(time_ps=40.0, solver_steps=2, precision="fp32", guard="off")


def roll(scene: Scene, weights: Weights, *outs: Path, config: RolloutConfig = CONFIG, **switches: bool) -> np.ndarray:
    """Roll and return the first replica's frames."""
    rollout(scene, weights, list(outs), config, **switches)
    with open_trajectory(outs[0]) as reader:
        assert np.array_equal(reader.time_ps, np.arange(1, reader.n_frames + 1) * reader.time_ps[0])
        return reader.read()


def test_file_says_what_it_is(tmp_path: Path, small_weights: Weights, alanine_dipeptide: Scene) -> None:
    out = tmp_path / "a.h5"
    roll(alanine_dipeptide, small_weights, out)
    with open_trajectory(out) as reader:
        assert reader.n_frames == 40
        chunk = small_weights.model.n_new
        assert np.array_equal(reader.chunk_idx, np.arange(40) // chunk)
        assert reader.flags is not None
        record = reader.record
    assert record["kind"] == "rollout"
    assert record["completed"] is True
    assert record["weights_hash"] == small_weights.hash
    assert record["cost"]["network_evaluations"] == -(-40 // chunk) * CONFIG.solver_steps
    assert not (tmp_path / "a.h5.checkpoint").exists()
    said = record | record["interventions"] | {"time_ps": 40.0, "atoms": "all", "select": None}
    assert said.keys() >= options_of(RolloutConfig).keys()
    assert (said["guard"], said["seed"], said["solver_steps"]) == ("off", 0, 2)
    assert not {"guard", "atoms", "select", "time_ps"} & record.keys()


def test_a_replica_does_not_depend_on_its_batch(
    tmp_path: Path, small_weights: Weights, alanine_dipeptide: Scene
) -> None:
    alone = roll(alanine_dipeptide, small_weights, tmp_path / "a.h5")
    beside = roll(alanine_dipeptide, small_weights, *(tmp_path / f"b{k}.h5" for k in range(3)))
    np.testing.assert_allclose(beside, alone, rtol=0, atol=2e-5)
    with open_trajectory(tmp_path / "b1.h5") as reader:
        assert np.abs(reader.read() - alone).max() > 1e-4, "replicas must differ from each other"


def test_save_interval_picks_frames_of_the_same_rollout(tmp_path: Path, small_weights: Weights,
                                                        alanine_dipeptide: Scene) -> None:  # fmt: skip
    every = roll(alanine_dipeptide, small_weights, tmp_path / "a.h5")
    third = roll(alanine_dipeptide, small_weights, tmp_path / "b.h5",
                 config=replace(CONFIG, time_ps=39.0, save_every_ps=3.0))  # fmt: skip
    assert np.array_equal(third, every[2:39:3])
    with pytest.raises(UnitError, match="whole multiple"):
        roll(alanine_dipeptide, small_weights, tmp_path / "c.h5", config=replace(CONFIG, save_every_ps=1.5))
    assert not (tmp_path / "c.h5").exists()


def test_an_interrupted_rollout_resumes_bit_for_bit(tmp_path: Path, small_weights: Weights,
                                                    alanine_dipeptide: Scene) -> None:  # fmt: skip
    whole = roll(alanine_dipeptide, small_weights, tmp_path / "whole.h5")

    class Killed(BaseException):
        pass

    def kill(done: int, total: int, note: str) -> None:
        if done > total // 2:
            raise Killed

    cut = tmp_path / "cut.h5"
    with pytest.raises(Killed):
        rollout(alanine_dipeptide, small_weights, [cut], CONFIG, progress=kill, flush_every_s=0.0)
    with open_trajectory(cut) as reader:
        assert 0 < reader.n_frames < 40
        assert reader.record["completed"] is False
    with pytest.raises(InputError, match="seed"):
        rollout(alanine_dipeptide, small_weights, [cut], replace(CONFIG, seed=5), resume=True)
    assert np.array_equal(roll(alanine_dipeptide, small_weights, cut, resume=True), whole)
    moved = alanine_dipeptide.with_positions(alanine_dipeptide.positions_nm + 1e-3)
    for other, asked in ((moved, {}), (alanine_dipeptide, {"solver_steps": 3}), (alanine_dipeptide, {"guard": "flag"})):
        key = next(iter(asked), "start")
        with pytest.raises(InputError, match=rf"this rollout was started with {key} = .*, not "):
            rollout(other, small_weights, [cut], replace(CONFIG, **asked), resume=True)
    # Asked again, a complete rollout is left as it is.
    before = cut.stat().st_mtime_ns
    rollout(alanine_dipeptide, small_weights, [cut], CONFIG, resume=True)
    assert cut.stat().st_mtime_ns == before


@pytest.mark.parametrize("resumed", [False, True])
def test_evaluations_that_differ_from_chunk_to_chunk_are_counted_over_all(
    tmp_path: Path, small_weights: Weights, alanine_dipeptide: Scene, monkeypatch: pytest.MonkeyPatch, resumed: bool
) -> None:
    counts: list[float] = []
    whole = LamSlide.next_chunk

    def as_if_adaptive(*args: object, **options: object) -> object:
        counts.append(10.0 + 3.5 * len(counts))
        return replace(whole(*args, **options), evaluations=counts[-1])

    class Killed(BaseException):
        pass

    def kill(done: int, total: int, note: str) -> None:
        if done > total // 2:
            raise Killed

    monkeypatch.setattr(LamSlide, "next_chunk", as_if_adaptive)
    outs = [tmp_path / "a.h5", tmp_path / "b.h5"]
    if resumed:
        with pytest.raises(Killed):
            rollout(alanine_dipeptide, small_weights, outs, CONFIG, progress=kill, flush_every_s=0.0)
        assert 0 < len(counts) < -(-40 // small_weights.model.n_new)
    rollout(alanine_dipeptide, small_weights, outs, CONFIG, resume=resumed)
    assert len(counts) == -(-40 // small_weights.model.n_new)
    for out in outs:
        with open_trajectory(out) as reader:
            assert reader.record["cost"]["network_evaluations"] == round(sum(counts))


def test_frames_that_are_not_finite_are_marked_and_stop_the_rollout(tmp_path: Path, small_weights: Weights,
                                                                    alanine_dipeptide: Scene) -> None:  # fmt: skip
    model = LamSlide(small_weights.model.config)
    model.load_state_dict(small_weights.model.state_dict())
    with torch.no_grad():
        model.approximator.final.bias.fill_(float("nan"))
    broken = replace(small_weights, model=model.eval().requires_grad_(False))
    out = tmp_path / "a.h5"
    with pytest.raises(SimulationError, match="the coordinates became NaN or infinite"):
        rollout(alanine_dipeptide, broken, [out], CONFIG)
    with open_trajectory(out) as reader:
        assert reader.n_frames == model.n_new
        assert (reader.flags & NOT_FINITE).all(), "not one frame of it passes as valid"
        assert (reader.flags & INVALID).all()


def test_a_molecule_outside_the_domain_is_refused_with_what_to_do(tmp_path: Path, small_weights: Weights) -> None:
    from systems.library.named_scenes import prepare

    with pytest.raises(OutOfDomainError, match=r"cover alanine-dipeptide .*22 atoms.*surromd reference"):
        rollout(prepare("sequence:ACE-GLY-NME"), small_weights, [tmp_path / "a.h5"], CONFIG)
    assert list(tmp_path.iterdir()) == []


def test_the_mirror_image_is_refused(tmp_path: Path, small_weights: Weights, alanine_dipeptide: Scene) -> None:
    mirrored = alanine_dipeptide.with_positions(alanine_dipeptide.positions_nm * [1, 1, -1])
    with pytest.raises(OutOfDomainError):
        rollout(mirrored, small_weights, [tmp_path / "a.h5"], CONFIG)
    assert list(tmp_path.iterdir()) == []
