"""Training states: what was written is what goes on; an altered byte is refused in one line."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from surrogate.training.loop import Stage, StageConfig, StagePlace, run_stage, tensor_checksum
from systems.errors import InputError

STAGE = StageConfig("toy", 4, 1e-2, steps=6, bf16=False, validate_every_s=0.0)
BY_MUON = replace(STAGE, matrix_rate=0.02)


class Stop(Exception):
    pass


def train(folder: Path, *, resume: bool, stop_at: int | None = None, stage: StageConfig = STAGE) -> torch.Tensor:
    """Return the weights after a toy training, or raise Stop once the state of step `stop_at` is on disk."""
    torch.manual_seed(0)
    module = torch.nn.Sequential(torch.nn.Linear(8, 8), torch.nn.Linear(8, 1))

    def loss_fn(generator: torch.Generator) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        x = torch.randn((4, 8), generator=generator)
        return (module(x) - x.sum(1, keepdim=True)).square().mean(), {}

    def progress(name: str, share: float, metrics: dict[str, float]) -> None:
        if stop_at is not None and share >= stop_at / 6:
            raise Stop

    run_stage(Stage(module, stage, loss_fn, dict),
              StagePlace(folder / "s.train.safetensors", folder / "l.csv", torch.device("cpu"), resume),
              progress=progress)  # fmt: skip
    return module[0].weight.detach().clone()


@pytest.fixture
def stopped(tmp_path: Path) -> Path:
    """The state of a training that was stopped half way."""
    with pytest.raises(Stop):
        train(tmp_path, resume=False, stop_at=3)
    return tmp_path / "s.train.safetensors"


def rewrite(path: Path, record: str | None = None, tensors: dict[str, torch.Tensor] | None = None, *,
            sign: bool = True) -> None:  # fmt: skip
    """Write a state anew with another record or other tensors, and with `sign` the checksum that goes with them."""
    with safe_open(path, framework="pt") as handle:
        tensors = tensors or {key: handle.get_tensor(key) for key in handle.keys()}  # noqa: SIM118
        metadata = handle.metadata()
    record = record or metadata["surromd_training"]
    checksum = tensor_checksum(record, tensors) if sign else metadata["sha256"]
    save_file(tensors, path, metadata={"surromd_training": record, "sha256": checksum})


def test_a_whole_state_goes_on(tmp_path: Path, stopped: Path) -> None:
    (tmp_path / "whole").mkdir()
    whole = train(tmp_path / "whole", resume=False)
    assert torch.equal(train(tmp_path, resume=True), whole)


def test_muon_goes_on_where_it_was_and_from_no_state_of_adam(tmp_path: Path, stopped: Path) -> None:
    with pytest.raises(InputError, match=r"has matrix_rate None, this run 0\.02"):
        train(tmp_path, resume=True, stage=BY_MUON)
    (tmp_path / "whole").mkdir()
    whole = train(tmp_path / "whole", resume=False, stage=BY_MUON)
    with pytest.raises(Stop):
        train(tmp_path, resume=False, stop_at=3, stage=BY_MUON)
    with safe_open(stopped, framework="pt") as handle:
        tensors = {key: handle.get_tensor(key) for key in handle.keys()}  # noqa: SIM118
    assert torch.equal(train(tmp_path, resume=True, stage=BY_MUON), whole)
    # Without its momentum it would go elsewhere.
    forgotten = {k: torch.zeros_like(v) if k.startswith("optimiser1.") else v for k, v in tensors.items()}
    rewrite(stopped, tensors=forgotten)
    assert not torch.equal(train(tmp_path, resume=True, stage=BY_MUON), whole)


@pytest.mark.parametrize("where", ["first tensor", "last byte"])
def test_a_flipped_bit_is_refused_and_without_the_checksum_would_not_be(
    tmp_path: Path, stopped: Path, where: str
) -> None:
    data = bytearray(stopped.read_bytes())
    start = 8 + int.from_bytes(data[:8], "little")
    data[start if where == "first tensor" else -1] ^= 1
    stopped.write_bytes(data)
    with pytest.raises(InputError, match=r"s\.train\.safetensors is damaged.*checksum.*without `resume"):
        train(tmp_path, resume=True)
    rewrite(stopped)
    train(tmp_path, resume=True)


def test_other_numbers_in_the_record_are_refused(tmp_path: Path, stopped: Path) -> None:
    with safe_open(stopped, framework="pt") as handle:
        record = handle.metadata()["surromd_training"]
    rewrite(stopped, record.replace('"step": 3', '"step": 5'), sign=False)
    with pytest.raises(InputError, match="checksum"):
        train(tmp_path, resume=True)


def test_wherever_a_byte_is_altered_the_state_is_refused_in_one_line(tmp_path: Path, stopped: Path) -> None:
    whole = stopped.read_bytes()
    rng = random.Random(0)
    length = 8 + int.from_bytes(whole[:8], "little")
    for place in [*range(8), *rng.sample(range(8, length), 60), *rng.sample(range(length, len(whole)), 60)]:
        data = bytearray(whole)
        data[place] ^= 1 << rng.randrange(8)
        stopped.write_bytes(data)
        with pytest.raises(InputError) as refused:
            train(tmp_path, resume=True)
        assert "\n" not in str(refused.value), place
        assert "`resume" in str(refused.value), place
