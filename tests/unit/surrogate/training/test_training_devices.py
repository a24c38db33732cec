"""Where a training runs; curves, Muon, and the progress that is shown."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from surrogate.progress import progress_bar
from surrogate.training.devices import choose_device
from surrogate.training.loop import (
    Muon,
    Stage,
    StageConfig,
    StagePlace,
    append_row,
    optimisers_of,
    orthogonalised,
    plot_curves,
    read_curves,
    run_stage,
    series,
)
from systems.errors import InputError, SimulationError


def run(folder: Path, model: nn.Module, loss, stage: StageConfig) -> None:
    run_stage(Stage(model, stage, loss, dict),
              StagePlace(folder / "s.train.safetensors", folder / "l.csv", torch.device("cpu")))  # fmt: skip


def test_devices_are_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto") == choose_device("cpu") == "cpu"
    with pytest.raises(InputError, match="no CUDA"):
        choose_device("cuda")
    with pytest.raises(InputError, match="unknown"):
        choose_device("tpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert (choose_device("auto"), choose_device("cpu")) == ("cuda", "cpu")


def test_training_that_diverges_says_where(tmp_path: Path) -> None:
    model, step = nn.Linear(2, 1), 0

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        nonlocal step
        step += 1
        return model(torch.ones(1, 2)).sum() * (1.0 if step < 40 else float("nan")), {}

    stage = StageConfig("toy", 1, 1e-4, steps=100, bf16=False, validate_every_s=1e9)
    with pytest.raises(SimulationError, match=r"step 39; lower the learning rate"):
        run(tmp_path, model, loss, stage)


def test_curves_are_drawn(tmp_path: Path) -> None:
    path = tmp_path / "m.csv"
    for step in (10, 20):
        append_row(path, {"stage": "autoencoder", "step": step, "train_position": 1.0 / step})
    for step in (5, 15, 25):
        append_row(path, {"stage": "flow", "step": step, "train_flow": 2.0 / step, "validation_flow": 3.0 / step})
    stages = read_curves(path)
    assert list(stages) == ["autoencoder", "flow"]
    assert series(stages["flow"], "validation_flow") == ([5.0, 15.0, 25.0], [0.6, 0.2, 0.12])
    assert series(stages["flow"], "train_position") == ([], [])
    out = plot_curves(path)
    assert out.name == "m.svg"
    assert out.read_text().startswith("<?xml")


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


def test_brackets_are_no_markup_and_long_labels_are_cut(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for label, shown in (("OpenMM c1cc[nH]c1", "c1cc[nH]c1"), ("C" * 99, "C" * 41 + "...")):
        with progress_bar(label, quiet=False) as advance:
            assert advance is not None
            advance(1, 1)
        assert shown in capsys.readouterr().err


def test_a_stage_before_the_count_does_not_slow_the_speed(capsys: pytest.CaptureFixture[str],
                                                          monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    clock = [0.0]
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    with progress_bar("MD", quiet=False, ps_per_frame=1.0) as advance:
        assert advance is not None
        advance(400, 1000, "equilibrating")
        clock[0] = 1000.0
        advance(0, 100)
        clock[0] = 1010.0
        advance(100, 100)
    shown = capsys.readouterr().err
    # 100 ps in the ten seconds after the equilibration: 0.864 µs/day; with its thousand seconds it would be 0.00855.
    assert "0.864 µs/day" in shown
