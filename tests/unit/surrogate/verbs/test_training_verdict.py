"""A training ends with a word: what its weights do in a short rollout, and what would help where that is not enough."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate import api
from surrogate.data import TrainingFrames
from surrogate.models.architecture import weights_path
from surrogate.models.weights import Weights, load_weights, save_weights
from surrogate.verbs.train import TrainingVerdict, compare_training, word_of
from systems.scene import Scene
from systems.trajectory.codec import open_writer

SMALL = """
[model.autoencoder]
latent_dim = 12
width = 64
head_dim = 16
[model.approximator]
chunk_frames = 8
width = 64
n_layers = 2
n_heads = 2
auxiliary_frames = 2
"""


@pytest.fixture(scope="module")
def references(
    harmonic_frames: TrainingFrames, alanine_dipeptide: Scene, tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    folder = tmp_path_factory.mktemp("references")
    record = {"kind": "reference", "force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0}
    paths = []
    for k in range(2):
        paths.append(folder / f"r{k}.h5")
        with open_writer(paths[-1], alanine_dipeptide, record) as writer:
            writer.append(
                harmonic_frames.positions_nm(np.arange(400 * k, 400 * (k + 1))), 10.0 * (np.arange(400) + 1.0)
            )
    return paths


def test_too_short_a_training_is_called_unusable_and_told_what_would_help(
    tmp_path: Path, references: list[Path], capfd: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "small.toml"
    config.write_text(SMALL)
    out = api.train(references, tmp_path / "m.safetensors", config=config, steps=10)
    said = capfd.readouterr().err
    verdict = json.loads((tmp_path / "m.verdict.json").read_text())
    assert verdict["word"] == "not usable" and verdict["percent_valid"] < 50.0
    assert verdict["steps"] == {"autoencoder": 2, "flow": 8} and verdict["validation"]["flow"]["validation_flow"] > 0
    assert "autoencoder 2 steps, flow 8 steps; validation error" in said and "not usable as it is" in said
    advice = " ".join(verdict["advice"])
    assert "more minutes" in advice and "800 frames are few" in advice
    assert out.exists() and not list(tmp_path.glob("*.h5"))


def test_weights_that_are_good_are_called_usable(tmp_path: Path) -> None:
    path = tmp_path / "good.safetensors"
    shutil.copy(weights_path("alanine-dipeptide"), path)
    verdict = compare_training(path)
    assert verdict.word == "usable" and verdict.percent_valid > 99.0 and verdict.advice == ()
    assert "usable; whether populations" in verdict.lines()[-1]


def test_weights_that_stand_still_are_not(tmp_path: Path, small_weights: Weights) -> None:
    """Valid as molecules go, and no motion: the guards' limit of stillness set above what this network moves."""
    limits = small_weights.domain.limits
    assert limits is not None
    domain = replace(small_weights.domain, limits={**limits, "jump_min_nm": 1.0, "jump_max_nm": 10.0})
    path = tmp_path / "still.safetensors"
    save_weights(path, small_weights.model, domain, small_weights.provenance)
    verdict = compare_training(path)
    assert verdict.word == "not usable" and any("hardly a change" in reason for reason in verdict.reasons)
    assert load_weights(path).domain.limits is not None


@pytest.mark.parametrize(("percent", "stopped", "said"), [
    (99.5, "", "usable; whether"), (95.0, "", "usable with `guard"), (69.0, "", "not usable"),
    (99.5, "replica 0, in its first chunk", "not usable"),
])  # fmt: skip
def test_the_words(percent: float, stopped: str, said: str) -> None:
    word = word_of(percent, stopped)
    verdict = TrainingVerdict({"flow": 5}, {"flow": {"validation_flow": 0.25}}, 744.0, 744, percent, {}, stopped, word,
                              ("more minutes",))  # fmt: skip
    assert said in verdict.lines()[-1] and "validation error: flow 0.25" in verdict.lines()[0]
    assert (stopped in "\n".join(verdict.lines())) and ("what would help" in verdict.lines()[-1]) == (word != "usable")
