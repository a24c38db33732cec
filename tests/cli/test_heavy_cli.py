"""Training with hydrogens placed and of residues, and what `rollout --atoms` writes of such weights."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from command_line import SMALL_LAM_SLIDE, TWO_SOLVER_STEPS, run
from systems.library.named_scenes import load
from systems.trajectory.codec import open_trajectory, open_writer


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reference of alanine dipeptide that shakes, and a small configuration."""
    here = tmp_path_factory.mktemp("heavy")
    (here / "small.toml").write_text(SMALL_LAM_SLIDE + "[training]\nstage_two_batch = 16\n")
    scene, rng = load("alanine-dipeptide"), np.random.default_rng(0)
    with open_writer(here / "ref.h5", scene, {"temperature_k": 300.0}) as writer:
        writer.append(scene.positions_nm + 0.003 * rng.normal(size=(160, scene.n_atoms, 3)), np.arange(1.0, 161.0))
    return here


@pytest.mark.parametrize("setting", [("hydrogens", "placed"), ("entities", "residue")])
def test_weights_of_heavy_atoms_roll_all_atoms(folder: Path, setting: tuple[str, str]) -> None:
    key, value = setting
    weights, out, config = str(folder / f"{value}.safetensors"), folder / f"{value}.h5", folder / f"{value}.toml"
    config.write_text(f'[model]\n{key} = "{value}"\n' + (folder / "small.toml").read_text())
    done = run("train", str(folder / "ref.h5"), "-o", weights, "--config", str(config), "--steps", "20", "-q")
    assert done.exit_code == 0, done.stderr
    assert json.loads(run("info", weights, "--json").stdout)["config"][key] == value
    scene = load("alanine-dipeptide")
    (folder / "coarse.toml").write_text(TWO_SOLVER_STEPS)
    for atoms, n_atoms in (("all", scene.n_atoms), ("heavy", len(scene.heavy_idx))):
        rolled = run("rollout", "alanine-dipeptide", "--weights", weights, "--time", "9ps", "-o", str(out), "--guard",
                     "off", "--config", str(folder / "coarse.toml"), "--atoms", atoms, "--overwrite", "-q")  # fmt: skip
        assert rolled.exit_code == 0, rolled.stderr
        with open_trajectory(out) as reader:
            assert reader.read().shape == (9, n_atoms, 3)
    further = run("train", str(folder / "ref.h5"), "-o", str(folder / "f.safetensors"), "--from", weights, "--steps",
                  "4", "-q", "--overwrite")  # fmt: skip
    assert further.exit_code == 0, further.stderr
    refused = run("train", str(folder / "ref.h5"), "-o", str(folder / "g.safetensors"), "--from", weights, "--steps",
                  "4", "--config", str(config))  # fmt: skip
    assert refused.exit_code == 1
    assert "leave [model] of --config out" in refused.stderr


def test_other_architectures_take_neither(folder: Path) -> None:
    for name in ("placed", "residue"):
        config = folder / f"egnn-{name}.toml"
        config.write_text('[model]\nhydrogens = "placed"\n' if name == "placed" else '[model]\nentities = "residue"\n')
        refused = run("train", str(folder / "ref.h5"), "-o", str(folder / "p.safetensors"), "--arch", "egnn", "--steps",
                      "4", "--config", str(config))  # fmt: skip
        assert refused.exit_code == 1
        assert "unknown key" in refused.stderr
    config.write_text('[model]\nhydrogens = "some"\n')
    refused = run("train", str(folder / "ref.h5"), "-o", str(folder / "x.safetensors"), "--steps", "4", "--config",
                  str(config))  # fmt: skip
    assert refused.exit_code == 1 and "choose modelled or placed" in refused.stderr
