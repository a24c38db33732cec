"""Chunks of few replicas are drawn by one thread, of many by all, and the number is what it was afterwards."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from surrogate.models.weights import Weights
from surrogate.sampling.chunks import ChunkSampler


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
