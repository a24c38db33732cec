"""Where a training runs, on several processes too; how it diverges and the picture of its curves."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from surrogate.training.devices import choose_device, is_first_process
from surrogate.training.loop import (
    StageConfig,
    StagePlace,
    append_row,
    plot_curves,
    read_curves,
    run_stage,
    series,
)
from systems.errors import InputError, SimulationError

LINE = """
import sys
from pathlib import Path
import torch
from torch import nn
from surrogate.training.devices import open_fabric
from surrogate.training.loop import StageConfig, StagePlace, run_stage

folder = Path(sys.argv[1])
fabric = open_fabric("cpu", False)
torch.manual_seed(0)
model = nn.Linear(3, 1)
seen = []

def loss(generator):
    x = torch.randn(4, 3, generator=generator)
    seen.append(x)
    return (model(x) - x.sum(1, keepdim=True)).square().mean(), {}

stage = StageConfig("line", 4, 1e-2, steps=30, warmup_steps=1, bf16=False, validate_every_s=1e9)
run_stage(model, stage, loss, lambda: {},
          StagePlace(folder / "s.train.safetensors", folder / "l.csv", torch.device("cpu")))
torch.save({"x": torch.stack(seen), "weights": model.state_dict(), "world": fabric.world_size},
           folder / f"rank{fabric.global_rank}.pt")
"""


@pytest.mark.slow
def test_two_processes_train_one_model_on_twice_the_data(tmp_path: Path) -> None:
    script = tmp_path / "line.py"
    script.write_text(LINE)
    root = str(Path(__file__).parents[4])
    environment = {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    subprocess.run([*command, str(tmp_path)], env=environment, check=True, timeout=300, capture_output=True)
    first, second = (torch.load(tmp_path / f"rank{k}.pt") for k in range(2))
    assert first["world"] == 2
    assert not torch.equal(first["x"], second["x"])
    for name, tensor in first["weights"].items():
        assert torch.equal(tensor, second["weights"][name]), name
    assert len((tmp_path / "l.csv").read_text().splitlines()) == 2

    # The same as one process on both batches together.
    torch.manual_seed(0)
    model = nn.Linear(3, 1)
    batches = iter(torch.cat([first["x"], second["x"]], dim=1))

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        x = next(batches)
        return (model(x) - x.sum(1, keepdim=True)).square().mean(), {}

    one = tmp_path / "one"
    one.mkdir()
    run(one, model, loss, StageConfig("line", 8, 1e-2, steps=30, warmup_steps=1, bf16=False, validate_every_s=1e9))
    for name, tensor in model.state_dict().items():
        torch.testing.assert_close(tensor, first["weights"][name], rtol=1e-5, atol=1e-6)


def run(folder: Path, model: nn.Module, loss, stage: StageConfig) -> None:
    run_stage(model, stage, loss, dict,
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
    monkeypatch.setenv("LOCAL_RANK", "3")
    assert choose_device("auto") == "cuda:3"
    assert is_first_process()
    monkeypatch.setenv("RANK", "1")
    assert not is_first_process()


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
