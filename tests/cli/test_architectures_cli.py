"""Architectures beside LaM-SLidE through the command line: reference, windows, train, info, rollout."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import run
from systems.trajectory.codec import open_trajectory

TINY = "[model]\nn_new = 4\nwidth = 16\nn_heads = 2\nhead_dim = 8\nn_decoder_layers = 1\n"


def done(*arguments: str) -> Any:
    result = run(*arguments, "--quiet")
    assert result.exit_code == 0, result.output + result.stderr
    return result


def refusal(*arguments: str) -> str:
    result = run(*arguments)
    assert result.exit_code == 1, result.output
    (line,) = result.stderr.splitlines()
    return line


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ethanol with velocities as in MD17: 160 frames, 5 fs apart, natural masses."""
    path = tmp_path_factory.mktemp("moving") / "ethanol.h5"
    asked = ("--protocol", "md17", "--time", "0.8ps", "--save-velocities")
    done("reference", "ethanol", *asked, "-o", str(path))
    return path


@pytest.mark.parametrize("arch", ["painet", "egnn"])
def test_a_forecaster_is_trained_and_rolls_out(tmp_path: Path, moving: Path, arch: str) -> None:
    (tmp_path / "tiny.toml").write_text(TINY + "[training]\nbatch = 4\nnoise = 0.125\n")
    windows, weights, out = (str(tmp_path / name) for name in ("w.h5", "m.safetensors", "roll.h5"))
    done("windows", str(moving), "--velocities", "-o", windows)
    done("train", windows, "--arch", arch, "--config", str(tmp_path / "tiny.toml"), "--steps", "3", "-o", weights)
    told = json.loads(run("info", weights, "--json").stdout)
    assert told["config"]["attention"] == ("none" if arch == "egnn" else "linear")
    assert told["provenance"]["noise"] == 0.125
    assert told["config"]["temperature_k"] == 500.0
    assert told["lag_ps"] == pytest.approx(0.005)
    # Trained for a moment it hardly moves, for which guards would stop it.
    done("rollout", "ethanol", "--weights", weights, "--time", "0.1ps", "--replicas", "2", "--guard", "off", "-o", out)
    with open_trajectory(tmp_path / "roll_r1.h5") as reader:
        assert reader.n_frames == 20
        assert reader.record["model"] == arch
        assert reader.record["solver"] is None
        assert np.isfinite(reader.read()).all()
    bad = tmp_path / "bad.toml"
    bad.write_text('[sampling]\nsolver = "euler"\n')
    rolled = ["rollout", "ethanol", "--weights", weights, "--time", "0.1ps", "-o", "x.h5"]
    assert "no solver" in refusal(*rolled, "--config", str(bad))
    for line, reason in {"steps = 4": "training.steps is set on the command line",
                         "nois = 1": "unknown.*training.nois", "=": "not valid TOML"}.items():  # fmt: skip
        bad.write_text(f"{TINY}[training]\n{line}\n")
        said = refusal(
            "train", windows, "--arch", arch, "--config", str(bad), "--steps", "3", "-o", weights + ".safetensors"
        )
        assert re.search(reason, said), said


@pytest.mark.parametrize("arch", ["frozen", "normal-modes", "resampling"])
def test_a_baseline_is_fitted_and_rolls_out(tmp_path: Path, moving: Path, arch: str) -> None:
    weights, out = str(tmp_path / "b.safetensors"), tmp_path / "roll.h5"
    done("train", str(moving), "--arch", arch, "-o", weights)
    done("rollout", "ethanol", "--weights", weights, "--time", "0.2ps", "--guard", "off", "-o", str(out))
    with open_trajectory(out) as reader:
        frames = reader.read()
        assert reader.record["model"] == arch
    assert (np.abs(frames - frames[0]).max() > 1e-3) == (arch != "frozen")


def test_what_an_architecture_cannot_use_is_refused(tmp_path: Path, moving: Path) -> None:
    out = ["-o", str(tmp_path / "m.safetensors")]
    assert "Did you mean 'painet'?" in refusal("train", str(moving), "--arch", "painte", "--steps", "4", *out)
    assert "--longest-lag" in refusal("train", str(moving), "--arch", "painet", "--steps", "4", "--longest-lag", "1ps",
                                      *out)  # fmt: skip
    assert "--budget" in refusal("train", str(moving), "--arch", "frozen", "--budget", "1min", *out)
    assert "--budget 30min" in refusal("train", str(moving), "--arch", "painet", *out)
    still = str(tmp_path / "still.h5")
    done("windows", str(moving), "-o", still)
    assert "--velocities of `windows`" in refusal("train", still, "--arch", "painet", "--steps", "4", *out)
    assert not Path(out[1]).exists()
