"""What tests of the command line share: a short reference, and weights too small to be any good."""

from __future__ import annotations

from pathlib import Path

import pytest

from command_line import run


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def short_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reference trajectory of 200 frames, made once through the command line."""
    path = tmp_path_factory.mktemp("short") / "ref.h5"
    result = run("reference", "alanine-dipeptide", "--time", "20ps", "--save-every", "100fs", "-o", str(path))
    assert result.exit_code == 0, result.stderr
    return path


TINY = """
[model.autoencoder]
latent_dim = 8
width = 16
n_heads = 2
head_dim = 8
identifier_dim = 8

[model.approximator]
chunk_frames = 8
width = 16
n_layers = 1
n_heads = 2
"""


@pytest.fixture(scope="session")
def tiny_weights(short_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a network far too small to be any good, trained for a few steps through the command line."""
    folder = tmp_path_factory.mktemp("tiny")
    (folder / "tiny.toml").write_text(TINY)
    windows, weights = folder / "windows.h5", folder / "tiny.safetensors"
    made = run("windows", str(short_run), "-o", str(windows), "--quiet")
    assert made.exit_code == 0, made.stderr
    trained = run(
        *["train", str(windows), "--config", str(folder / "tiny.toml"), "--steps", "6", "--quiet"],
        *["-o", str(weights)],
    )
    assert trained.exit_code == 0, trained.stderr
    return weights
