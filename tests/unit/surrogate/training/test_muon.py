"""Muon: its steps are orthogonal matrices, whatever the gradient's scale, and it shares a module with AdamW."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from surrogate.training.loop import Muon, StageConfig, optimisers_of, orthogonalised


@pytest.mark.parametrize("shape", [(24, 24), (60, 16), (16, 60)])
def test_a_matrix_becomes_what_turns_as_it_does_and_stretches_nothing(shape: tuple[int, int]) -> None:
    matrices = 1e3 * torch.randn(3, *shape, generator=torch.Generator().manual_seed(0))
    found = orthogonalised(matrices)
    values = torch.linalg.svdvals(found)
    assert values.min() > 0.1 and values.max() < 1.3
    u, _, v = torch.linalg.svd(matrices, full_matrices=False)
    exact = u @ v
    likeness = (found * exact).sum((1, 2)) / (found.norm(dim=(1, 2)) * exact.norm(dim=(1, 2)))
    assert likeness.min() > 0.97
    # The gradient itself is not that: the check can fail.
    plain = (matrices * exact).sum((1, 2)) / (matrices.norm(dim=(1, 2)) * exact.norm(dim=(1, 2)))
    assert plain.max() < likeness.min()


def test_a_step_is_as_long_as_its_rate_whatever_the_gradient() -> None:
    moved = []
    for scale in (1.0, 1e-4):
        weight = nn.Parameter(torch.zeros(40, 10))
        muon = Muon([weight], lr=0.1)
        weight.grad = scale * torch.randn(40, 10, generator=torch.Generator().manual_seed(1))
        muon.step()
        moved.append(weight.detach().clone())
        assert (weight * weight.grad).sum() < 0.0, "downhill"
    assert torch.allclose(moved[0], moved[1], atol=1e-4)
    # Twice as much, the root of rows over columns.
    assert torch.linalg.svdvals(moved[0]).mean() == pytest.approx(0.2, rel=0.2)


def test_muon_takes_matrices_of_linear_layers_and_adam_the_rest() -> None:
    module = nn.Sequential(nn.Embedding(30, 16), nn.Linear(16, 16), nn.Linear(16, 2))
    stage = StageConfig("toy", 1, 1e-3, steps=1)
    assert [type(o) for o in optimisers_of(module, stage)] == [torch.optim.AdamW]
    adam, muon = optimisers_of(module, StageConfig("toy", 1, 1e-3, steps=1, matrix_rate=0.02))
    assert [p for g in muon.param_groups for p in g["params"]] == [module[1].weight]
    taken = [p for o in (adam, muon) for g in o.param_groups for p in g["params"]]
    assert sorted(map(id, taken)) == sorted(map(id, module.parameters()))
