"""Training on several peptides and `--longest-lag`, `rollout` of an unseen one and `--lag`, at the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from command_line import TWO_SOLVER_STEPS, run
from systems.library.named_scenes import prepare
from systems.trajectory.codec import open_trajectory, open_writer

SMALL = "[model]\nwidth = 16\nn_layers = 1\nn_heads = 2\nchunk_frames = 4\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two references, and weights of both for lags of 1 to 10 ps."""
    here = tmp_path_factory.mktemp("molecules")
    (here / "small.toml").write_text(SMALL)
    for sequence in ("ACE-ALA-SER-NME", "ACE-SER-NME"):
        scene, rng = prepare(f"sequence:{sequence}"), np.random.default_rng(0)
        with open_writer(here / f"{sequence}.h5", scene, {"temperature_k": 300.0}) as writer:
            frames = scene.positions_nm + 0.004 * rng.normal(size=(120, scene.n_atoms, 3))
            writer.append(frames, np.arange(1.0, 121.0))
    references = [str(here / "ACE-ALA-SER-NME.h5"), str(here / "ACE-SER-NME.h5")]
    weights = ["-o", str(here / "w.safetensors"), "--config", str(here / "small.toml"), "--steps", "8", "-q"]
    done = run("train", *references, *weights, "--longest-lag", "10ps")
    assert done.exit_code == 0, done.stderr
    return here


def test_info_names_all_molecules(folder: Path) -> None:
    found = json.loads(run("info", str(folder / "w.safetensors"), "--json").stdout)
    assert len(found["molecules"]) == 2 and "ACE-ALA-SER-NME" in found["molecules"][0]
    assert found["covers_unseen_molecules"] is True
    assert found["lag_ps"] == 1.0 and 9.0 <= found["longest_lag_ps"] <= 10.0


def test_an_unseen_molecule_rolls_at_the_lag_that_is_kept(folder: Path) -> None:
    out = folder / "unseen.h5"
    coarse = folder / "coarse.toml"
    coarse.write_text(TWO_SOLVER_STEPS)
    weights = str(folder / "w.safetensors")
    common = ["--weights", weights, "-o", str(out), "--guard", "off", "--config", str(coarse), "-q"]
    done = run("rollout", "sequence:ACE-SER-ALA-NME", *common, "--time", "45ps", "--save-every", "9ps")
    assert done.exit_code == 0, done.stderr
    with open_trajectory(out) as reader:
        assert np.allclose(reader.time_ps, 9.0 * np.arange(1, 6))
        assert reader.record["unseen_molecule"] and reader.record["lag_ps"] == 9.0
    told = run("rollout", "sequence:ACE-SER-ALA-NME", *common[:-1], "--time", "60ps", "--overwrite")
    assert "ACE-SER-ALA-NME: w.safetensors was not trained on this molecule" in told.stderr
    assert "a molecule that the weights were not trained on" in told.stdout
    assert "a molecule that the weights were not trained on" in run("info", str(out)).stdout
    seen = run("rollout", "sequence:ACE-SER-NME", *common[:-1], "--time", "60ps", "--overwrite")
    assert "not trained" not in seen.stderr + seen.stdout
    for scene, more, why in (
        ("sequence:ACE-SER-ALA-NME", ["--lag", "50ps"], "lags of 1 ps to"),
        ("sequence:ACE-SER-ALA-SER-NME", [], "size"),
        ("sequence:ACE-GLY-NME", ["--force"], "residues"),
        ("smiles:CCO", ["--force"], "residues"),
    ):
        refused = run("rollout", scene, *common, "--time", "100ps", "--overwrite", *more)
        assert refused.exit_code == 1 and why in refused.stderr and refused.stderr.count("\n") == 1, refused.stderr
    forced = run(
        "rollout", "sequence:ACE-SER-ALA-SER-NME", *common, "--time", "10ps", "--lag", "5ps", "--overwrite", "--force"
    )
    assert forced.exit_code == 0, forced.stderr
    assert "outside the training domain (--force): size: 3 amino acids" in run("info", str(out)).stdout


def test_stress_takes_the_molecule_to_try(folder: Path) -> None:
    common = ["stress", str(folder / "w.safetensors"), "-o", str(folder / "stress"), "--section", "openmm", "--quick"]
    done = run(*common, "--scene", "sequence:ACE-SER-ALA-NME", "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["scene"] == "ACE-SER-ALA-NME" and list(found["sections"]) == ["openmm"]
    first = json.loads(run(*common, "--json").stdout)
    assert first["scene"] == "ACE-ALA-SER-NME"
    for text, why in (("sequence:ACE-GLY-NME", "residues"), ("smiles:C((", "smiles")):
        refused = run(*common, "--scene", text)
        assert refused.exit_code == 1 and why in refused.stderr.lower() and refused.stderr.count("\n") == 1


def test_other_architectures_and_further_training_take_neither(folder: Path) -> None:
    reference, out = str(folder / "ACE-SER-NME.h5"), str(folder / "x.safetensors")
    lags = ["--steps", "4", "--longest-lag", "10ps"]
    refused = run("train", reference, "-o", out, "--arch", "painet", *lags)
    assert refused.exit_code == 1 and "--longest-lag" in refused.stderr
    refused = run("train", reference, "-o", out, "--from", str(folder / "w.safetensors"), *lags)
    assert refused.exit_code == 1 and "leave --longest-lag out" in refused.stderr
    further = run("train", reference, "-o", out, "--from", str(folder / "w.safetensors"), "--steps", "4", "-q")
    assert further.exit_code == 0, further.stderr
