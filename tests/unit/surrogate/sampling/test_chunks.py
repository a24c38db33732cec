"""Chunks: their pose and threads."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from surrogate.models.painet.model import Painet, PainetConfig
from surrogate.models.propagator import Propagator
from surrogate.models.weights import Weights
from surrogate.sampling.chunks import ChunkSampler


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
