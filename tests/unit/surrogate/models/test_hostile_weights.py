"""Weights files whose tensors are whole and whose record is not: one line, nothing large made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from surrogate.models.weights import Weights, load_weights
from surrogate.training.loop import tensor_checksum
from systems.errors import WeightsError


def record_of(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as handle:
        return json.loads(handle.metadata()["surromd"])


def forged(path: Path, record: Any, tensors: dict[str, Any]) -> Path:
    text = json.dumps(record)
    metadata = {"format": "surromd-weights-1", "surromd": text, "sha256": tensor_checksum(text, tensors)}
    save_file(tensors, path, metadata=metadata)
    return path


@pytest.mark.parametrize(("part", "key", "value"), [("approximator", "n_layers", 10_000),
                                                    ("approximator", "width", 10**9)])  # fmt: skip
def test_a_model_that_its_file_cannot_hold(small_weights: Weights, tmp_path: Path, part: str, key: str,
                                           value: int) -> None:  # fmt: skip
    record = record_of(small_weights.path)
    record["config"][part][key] = value
    with pytest.raises(WeightsError, match=f"{key} = {value} in a file of"):
        load_weights(forged(tmp_path / "w.safetensors", record, load_file(small_weights.path)))
