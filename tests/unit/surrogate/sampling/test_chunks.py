"""Chunks: their pose, threads, and networks that are compiled."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from surrogate.models.painet.model import Painet, PainetConfig
from surrogate.models.propagator import Propagator
from surrogate.models.weights import Weights
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory


@pytest.fixture(params=["lam-slide", "painet"])
def weights(request: pytest.FixtureRequest, small_weights: Weights) -> Weights:
    if request.param == "lam-slide":
        return small_weights
    torch.manual_seed(0)
    model: Propagator = Painet(PainetConfig(n_new=3, width=16, n_heads=2, head_dim=8, n_decoder_layers=2)).eval()
    return replace(small_weights, model=model)


def test_a_chunk_turns_and_moves_with_its_molecule(weights: Weights) -> None:
    sampler = ChunkSampler(weights, solver_steps=2 if weights.model.solvers else 20, precision="fp32")
    here = weights.domain.scene.positions_nm.astype(np.float64)[None, None]
    turn = Rotation.random(random_state=1).as_matrix()
    there = here @ turn.T + np.array([1.0, -2.0, 3.0])
    first, second = (sampler.draw(x, [5]) for x in (here, there))
    expected = first.frames_nm @ turn.T + np.array([1.0, -2.0, 3.0])
    assert np.abs(second.frames_nm - expected).max() < 1e-6
    if first.velocities_nm_ps is not None and second.velocities_nm_ps is not None:
        assert np.abs(second.velocities_nm_ps - first.velocities_nm_ps @ turn.T).max() < 1e-5
    # The controls: it moved, and another seed moves it otherwise.
    assert np.abs(first.frames_nm - here).max() > 1e-4
    assert np.abs(sampler.draw(here, [6]).frames_nm - first.frames_nm).max() > 1e-4


@pytest.mark.parametrize(("rows", "threads"), [(1, 1), (16, 1), (17, 2)])
def test_few_rows_take_one_thread(
    small_weights: Weights, monkeypatch: pytest.MonkeyPatch, rows: int, threads: int
) -> None:
    sampler = ChunkSampler(small_weights, solver_steps=1, precision="fp32")
    seen: list[int] = []
    draw = ChunkSampler._draw

    def counted(self: ChunkSampler, *told: Any) -> Any:
        seen.append(torch.get_num_threads())
        return draw(self, *told)

    monkeypatch.setattr(ChunkSampler, "_draw", counted)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        start = small_weights.domain.scene.positions_nm
        last = np.repeat(start[None, None], sampler.n_conditioning, axis=1).repeat(rows, axis=0)
        sampler.batch = rows
        sampler.draw(last, list(range(rows)))
        assert seen == [threads] and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


CONFIG = RolloutConfig(time_ps=21.0, solver_steps=2, precision="fp32", seed=3, guard="off")


def frames_of(path: Path) -> np.ndarray:
    with open_trajectory(path) as reader:
        return reader.read()


@pytest.fixture
def rows_compiled(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Rows of each call that goes through a compiled approximator; what is compiled computes as before."""
    rows: list[int] = []

    class Compiled(torch.nn.Module):
        def __init__(self, module: torch.nn.Module) -> None:
            super().__init__()
            self.module = module

        def __getattr__(self, name: str) -> Any:
            return super().__getattr__(name) if name == "module" else getattr(self.module, name)

        def forward(self, *args: Any, **kwargs: Any) -> Any:
            rows.append(len(args[0]))
            return self.module(*args, **kwargs)

    monkeypatch.setattr(torch, "compile", lambda module, **_: Compiled(module))
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    return rows


def test_the_first_batch_alone_is_compiled(small_weights: Weights, rows_compiled: list[int]) -> None:
    sampler = ChunkSampler(small_weights, solver_steps=2, precision="fp32", compile=True)
    lean = ChunkSampler(small_weights, solver_steps=2, precision="fp32")
    start = small_weights.domain.scene.positions_nm
    last = np.repeat(start[None, None], sampler.n_conditioning, axis=1).repeat(3, axis=0)
    whole = sampler.draw(last, [1, 2, 3]).frames_nm
    one = sampler.draw(last[:1], [1]).frames_nm
    assert rows_compiled == [3, 3], "two steps of the whole batch, none of the row drawn again"
    # Compiled is the plain approximator, not its lean form, which differs by rounding.
    np.testing.assert_allclose(whole, lean.draw(last, [1, 2, 3]).frames_nm, rtol=0, atol=1e-5)
    assert np.array_equal(one, lean.draw(last[:1], [1]).frames_nm)
    assert not any(type(module).__name__ == "Compiled" for module in small_weights.model.modules())


def test_resume_asks_for_the_same(
    tmp_path: Path, alanine_dipeptide: Scene, small_weights: Weights, rows_compiled: list[int]
) -> None:
    out, whole, fast = tmp_path / "a.h5", tmp_path / "whole.h5", replace(CONFIG, compile=True)

    def stop(done: int, total: int, note: str) -> None:
        if done >= 2 * total // 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rollout(alanine_dipeptide, small_weights, [out], fast, progress=stop, flush_every_s=0.0)
    with pytest.raises(InputError, match=r"started with compile = True, not False"):
        rollout(alanine_dipeptide, small_weights, [out], CONFIG, resume=True)
    rollout(alanine_dipeptide, small_weights, [out], fast, resume=True)
    rollout(alanine_dipeptide, small_weights, [whole], fast)
    assert rows_compiled
    assert np.array_equal(frames_of(out), frames_of(whole))
    with open_trajectory(out) as reader:
        assert reader.record["compile"] is True


def test_without_a_compiler_one_line_says_so(small_weights: Weights, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(InputError, match=r"C\+\+ compiler"):
        ChunkSampler(small_weights, compile=True)


@pytest.mark.slow
def test_compiled_frames_are_the_same_but_for_rounding(
    tmp_path: Path, alanine_dipeptide: Scene, small_weights: Weights
) -> None:
    rollout(alanine_dipeptide, small_weights, [tmp_path / "a.h5"], CONFIG)
    rollout(alanine_dipeptide, small_weights, [tmp_path / "b.h5"], replace(CONFIG, compile=True))
    a, b = frames_of(tmp_path / "a.h5"), frames_of(tmp_path / "b.h5")
    assert np.abs(a - b).max() < 1e-4
