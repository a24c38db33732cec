"""Weights files whose tensors are whole and whose record is not: one line, nothing large made."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from surrogate.data.tensor_checksums import tensor_checksum
from surrogate.data.weights import Weights, load_weights
from systems.errors import WeightsError

WRONG: tuple[Any, ...] = (None, 3, -1, 10**30, float("inf"), "x", [], {}, [[1]], True)


def record_of(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as handle:
        return json.loads(handle.metadata()["surromd"])


def forged(path: Path, record: Any, tensors: dict[str, Any]) -> Path:
    text = json.dumps(record)
    metadata = {"format": "surromd-weights-1", "surromd": text, "sha256": tensor_checksum(text, tensors)}
    save_file(tensors, path, metadata=metadata)
    return path


def paths_in(record: Any, depth: int = 3) -> list[tuple[str, ...]]:
    if not isinstance(record, dict) or not depth:
        return [()]
    return [()] + [(key, *rest) for key, value in record.items() for rest in paths_in(value, depth - 1)]


def test_values_of_the_wrong_type_or_size(small_weights: Weights, tmp_path: Path) -> None:
    whole, tensors = record_of(small_weights.path), load_file(small_weights.path)
    assert load_weights(forged(tmp_path / "whole.safetensors", whole, tensors)).domain.lag_ps > 0
    refused = 0
    places = [place for place in paths_in(whole, 2) if place and place[0] != "provenance"]
    for number, place in enumerate(places):
        record = copy.deepcopy(whole)
        inner = record
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = WRONG[number % len(WRONG)]
        path = forged(tmp_path / "w.safetensors", record, tensors)
        try:
            load_weights(path)
        except WeightsError as error:
            assert "\n" not in str(error), place
            refused += 1
    assert refused > 0.7 * len(places)


@pytest.mark.parametrize(("part", "key", "value"), [("approximator", "n_layers", 10_000),
                                                    ("approximator", "width", 10**9)])  # fmt: skip
def test_a_model_that_its_file_cannot_hold(small_weights: Weights, tmp_path: Path, part: str, key: str,
                                           value: int) -> None:  # fmt: skip
    record = record_of(small_weights.path)
    record["config"][part][key] = value
    with pytest.raises(WeightsError, match=f"{key} = {value} in a file of"):
        load_weights(forged(tmp_path / "w.safetensors", record, load_file(small_weights.path)))
