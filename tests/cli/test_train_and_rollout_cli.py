"""Training and rolling from the command line, with weights of a few steps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from command_line import refused, run


def test_windows_and_weights_say_what_they_are(tiny_weights: Path) -> None:
    windows = json.loads(run("info", str(tiny_weights.with_name("windows.h5")), "--json").stdout)
    assert windows["type"] == "windows"
    assert windows["n_frames"] == 200
    weights = json.loads(run("info", str(tiny_weights), "--json").stdout)
    assert weights["type"] == "weights"
    assert weights["config"]["approximator"]["chunk_frames"] == 8
    assert weights["conditions"]["force_field"] == "ff14SB"
    assert weights["lag_ps"] == pytest.approx(0.1)


def test_training_twice_needs_overwrite(here: Path, tiny_weights: Path, short_run: Path) -> None:
    before = tiny_weights.read_bytes()
    assert "--overwrite" in refused(run("train", str(short_run), "--steps", "6", "-o", str(tiny_weights)))
    assert tiny_weights.read_bytes() == before


def test_a_reference_too_short_to_train_on_leaves_nothing(here: Path, short_run: Path) -> None:
    (here / "long.toml").write_text("[model.approximator]\nchunk_frames = 64\n")
    message = refused(run("train", str(short_run), "--config", "long.toml", "--steps", "6", "-o", "w.safetensors"))
    assert "64 frames" in message
    assert [p.name for p in here.iterdir()] == ["long.toml"]


def test_an_unknown_setting_is_named_with_its_nearest(here: Path, short_run: Path) -> None:
    (here / "typo.toml").write_text("[model.approximator]\nchunk_frame = 64\n")
    message = refused(run("train", str(short_run), "--config", "typo.toml", "--steps", "6", "-o", "w.safetensors"))
    assert "Did you mean 'chunk_frames'?" in message


def test_damaged_weights_are_refused(here: Path, tiny_weights: Path) -> None:
    whole = tiny_weights.read_bytes()
    (here / "cut.safetensors").write_bytes(whole[: len(whole) // 2])
    assert "cut.safetensors" in refused(run("info", "cut.safetensors"))
    message = refused(
        run("rollout", "alanine-dipeptide", "--weights", "cut.safetensors", "--time", "1ns", "-o", "x.h5")
    )
    assert "cut.safetensors" in message
    assert [p.name for p in here.iterdir()] == ["cut.safetensors"]


def test_rollout_streams_replicas_and_marks_chunks(here: Path, tiny_weights: Path) -> None:
    result = run(
        *["rollout", "alanine-dipeptide", "--weights", str(tiny_weights), "--time", "2ps", "--replicas", "2"],
        *["--guard", "off", "-o", "x.h5", "--json", "--quiet"],
    )
    assert result.exit_code == 0, result.stderr
    records = json.loads(result.stdout)
    assert [Path(r["file"]).name for r in records] == ["x_r0.h5", "x_r1.h5"]
    assert [r["n_frames"] for r in records] == [20, 20]
    assert all(r["type"] == "rollout trajectory" and r["invalid_frames"] is not None for r in records)


def test_a_model_that_is_wrong_is_stopped_in_one_line(here: Path, tiny_weights: Path) -> None:
    """Weights trained for no time at all: what `--guard off` lets pass is stopped by every other guard."""
    for guard in ([], ["--guard", "resample"]):
        command = ["rollout", "alanine-dipeptide", "--weights", str(tiny_weights), "--time", "1ns", "-o", "x.h5"]
        result = run(*command, *guard, "--quiet", "--overwrite")
        assert result.exit_code == 1
        assert result.stderr.startswith("error: replica 0, in its first chunk: ") and result.stderr.count("\n") == 1


def test_rollout_is_the_same_under_one_seed_and_differs_under_another(here: Path, tiny_weights: Path) -> None:
    from systems.trajectory.codec import open_trajectory

    frames = []
    for name, seed in (("a.h5", "1"), ("b.h5", "1"), ("c.h5", "2")):
        result = run(
            *["rollout", "alanine-dipeptide", "--weights", str(tiny_weights), "--time", "2ps", "--seed", seed],
            *["--guard", "off", "-o", name, "--quiet"],
        )
        assert result.exit_code == 0, result.stderr
        with open_trajectory(name) as reader:
            frames.append(reader.read())
    assert (frames[0] == frames[1]).all()
    assert abs(frames[0] - frames[2]).max() > 1e-3


def test_rollout_keeps_the_order_and_names_of_the_pdb(here: Path, tiny_weights: Path, alanine_dipeptide: Any) -> None:
    import MDAnalysis
    import mdtraj
    import numpy as np

    lines = alanine_dipeptide_lines(alanine_dipeptide)
    (here / "mine.pdb").write_text("\n".join([*lines, "END"]) + "\n")
    result = run(
        *["rollout", "mine.pdb", "--weights", str(tiny_weights), "--time", "2ps", "--guard", "off"],
        *["-o", "out.dcd", "--quiet"],
    )
    assert result.exit_code == 0, result.stderr
    names = [line[12:16].strip() for line in lines]
    trajectory = mdtraj.load("out.dcd", top="mine.pdb")
    universe = MDAnalysis.Universe("mine.pdb", "out.dcd")
    assert trajectory.xyz.shape == (20, 22, 3)
    assert [a.name for a in universe.atoms] == names
    np.testing.assert_allclose(universe.trajectory[5].positions, trajectory.xyz[5] * 10.0, atol=1e-3)
    written = [line for line in (here / "out.pdb").read_text().splitlines() if line.startswith("ATOM")]
    assert [line[12:16].strip() for line in written] == names, "the topology beside the DCD has the user's order, too"


def alanine_dipeptide_lines(scene: Any) -> list[str]:
    """The molecule as another program might write it: atoms reversed within residues, other names, no CONECT."""
    order = sorted(range(scene.n_atoms), key=lambda i: (scene.residue_of_atom[i], -i))
    lines = []
    for serial, i in enumerate(order, start=1):
        x, y, z = 10.0 * scene.positions_nm[i] + [3.0, -2.0, 5.0]
        element, residue = scene.elements[i], scene.residue_of_atom[i]
        lines.append(
            f"ATOM  {serial:5d} {element}{serial:<3d} {scene.residue_names[residue]:>3s} A{residue + 1:4d}    "
            f"{x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00          {element:>2s}"
        )
    return lines
