"""The recipe of the shipped weights: averages of two trainings."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from alanine_dipeptide import average

from surrogate.data.weights import Weights, load_weights, save_weights
from surrogate.models.lam_slide.model import LamSlide


def test_an_average_lies_between_its_two_weights(tmp_path: Path, small_weights: Weights) -> None:
    torch.manual_seed(0)
    assert isinstance(small_weights.model, LamSlide)
    config = small_weights.model.config
    before, after = LamSlide(config), LamSlide(config)
    paths = [tmp_path / f"{name}.safetensors" for name in "ab"]
    for path, model in zip(paths, (before, after), strict=True):
        save_weights(path, model, small_weights.domain, small_weights.provenance)
    found = load_weights(average(*paths, 0.25, tmp_path / "c.safetensors"))
    a, b = before.state_dict(), after.state_dict()
    moved = 0
    for name, value in found.model.state_dict().items():
        torch.testing.assert_close(value, (0.75 * a[name] + 0.25 * b[name]).to(value.dtype))
        moved += not torch.equal(value, b[name])
    assert moved > 20
    assert found.provenance["average"]["share"] == pytest.approx(0.25)
    assert found.provenance["average"]["of"] == [load_weights(path).hash for path in paths]
