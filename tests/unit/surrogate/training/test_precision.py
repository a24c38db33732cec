"""bf16 where its products are faster, and said so; a rollout that goes on keeps what it began with."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from surrogate.models.architecture import weights_path
from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.runner import RolloutConfig, rollout
from surrogate.training import devices as precision
from surrogate.training.devices import bf16_pays, choose_precision, product_speed
from surrogate.verbs.info import describe_file
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.checkpoint import checkpoint_path, read_checkpoint
from systems.trajectory.codec import open_trajectory

FAST, SLOW = (70.0, 280.0), (70.0, 14.0)


def processor(monkeypatch: pytest.MonkeyPatch, speed: tuple[float, float]) -> None:
    monkeypatch.setattr(precision, "product_speed", lambda: speed)


def test_bf16_is_chosen_where_its_products_are_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    processor(monkeypatch, FAST)
    chosen = choose_precision("auto")
    assert (chosen.bf16, chosen.name) == (True, "bf16")
    assert chosen.reason == "products in bf16 are 4 times as fast as in fp32 here"
    assert bf16_pays("cpu")
    assert not choose_precision("auto", suits=False).bf16, "a model that is integrated is left alone"
    processor(monkeypatch, SLOW)
    chosen = choose_precision("auto")
    assert (chosen.bf16, chosen.name) == (False, "fp32")
    assert chosen.reason == "products in bf16 are 0.2 times as fast as in fp32 here"
    assert not bf16_pays("cpu")
    assert choose_precision("bf16").bf16 and choose_precision("bf16").reason == "as asked for"
    with pytest.raises(InputError, match="precision 'fp16' is unknown"):
        choose_precision("fp16")


def test_products_are_slower_in_bf16_where_the_processor_may_not_use_its_units() -> None:
    here = product_speed()
    assert here is product_speed(), "measured once"
    assert min(here) > 0.0
    if choose_precision("auto").bf16 and "ONEDNN_MAX_CPU_ISA" not in os.environ:
        code = "from surrogate.training.devices import choose_precision as c; print(c('auto').name)"
        held_back = os.environ | {"ONEDNN_MAX_CPU_ISA": "AVX2", "PYTHONPATH": str(Path(__file__).parents[4])}
        said = subprocess.run([sys.executable, "-c", code], env=held_back, capture_output=True, text=True, check=True)
        assert said.stdout == "fp32\n"


def test_bf16_and_fp32_draw_the_same_chunk() -> None:
    """Shipped weights: from one noise the frames differ by a hundredth of what they move by."""
    weights = load_weights(weights_path("alanine-dipeptide"))
    start = weights.domain.scene.positions_nm[None, None]
    frames = {}
    for name in ("fp32", "bf16"):
        sampler = ChunkSampler(weights, precision=name)
        last = np.repeat(start, sampler.n_conditioning, axis=1)
        frames[name] = sampler.draw(np.repeat(last, 2, axis=0), [1, 2]).frames_nm
    moved = np.sqrt(((frames["fp32"] - start) ** 2).mean())
    apart = np.sqrt(((frames["bf16"] - frames["fp32"]) ** 2).mean())
    assert moved > 0.02 and 1e-5 < apart / moved < 0.03, (moved, apart)


def test_the_record_says_which_and_why_and_resume_keeps_it(
    tmp_path: Path, alanine_dipeptide: Scene, small_weights: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    length_ps = 8.0 * small_weights.model.n_new * small_weights.domain.lag_ps
    config = RolloutConfig(time_ps=length_ps, solver_steps=2, guard="off")
    begun, whole = tmp_path / "begun.h5", tmp_path / "whole.h5"
    processor(monkeypatch, SLOW)
    rollout(alanine_dipeptide, small_weights, [whole], config)

    class Stop(BaseException):
        pass

    def stop(done: int, total: int, note: str | None = None) -> None:
        if done >= total // 4:
            raise Stop

    with pytest.raises(Stop):
        rollout(alanine_dipeptide, small_weights, [begun], config, progress=stop, flush_every_s=0.0)
    assert read_checkpoint(checkpoint_path(begun))[0]["settings"]["bf16"] is False
    processor(monkeypatch, FAST)
    rollout(alanine_dipeptide, small_weights, [begun], config, resume=True)
    with open_trajectory(begun) as ours, open_trajectory(whole) as undisturbed:
        assert ours.record["precision"] == "fp32"
        np.testing.assert_array_equal(ours.read(), undisturbed.read())
    fresh = tmp_path / "fresh.h5"
    rollout(alanine_dipeptide, small_weights, [fresh], config)
    with open_trajectory(fresh) as reader:
        assert reader.record["precision"] == "bf16"
        assert "4 times as fast" in reader.record["precision_reason"]
    assert "network in bf16: products in bf16 are 4 times" in describe_file(fresh)["details"][0]


def test_measuring_leaves_random_numbers_alone() -> None:
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    product_speed.__wrapped__()
    assert torch.equal(torch.rand(2), expected)


def test_steps_are_computed_on_the_number_of_cores_that_is_fastest(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock of its own; one step in ten takes a second longer, as a validation does."""
    clock, count, cost_s = [0.0], [1], {1: 0.03, 2: 0.02, 4: 0.05}
    monkeypatch.setattr(precision.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(torch, "set_num_threads", lambda n: count.__setitem__(0, n))
    monkeypatch.setattr(torch, "get_num_threads", lambda: count[0])

    def run(threads: precision.StepThreads, n_steps: int) -> list[int]:
        taken = []
        for k in range(n_steps):
            taken.append(threads.next_step())
            clock[0] += cost_s[taken[-1]] + (1.0 if k % 10 == 3 else 0.0)
        return taken

    threads = precision.StepThreads(6)
    assert set(run(threads, 24)) == {1, 2, 4} and set(run(threads, 400)) == {2}
    cost_s[2] = 0.1  # another program has come
    assert set(run(threads, 600)[-200:]) == {1}
    assert set(run(precision.StepThreads(1), 50)) == {1}
