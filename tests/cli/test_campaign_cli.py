"""`surromd campaign`, and what `info`, `windows` and `train` make of its folder; killed and interrupted, it goes on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import run
from md_reference.campaign.manifest import (
    COMPLETE,
    FAILED,
    MANIFEST_NAME,
    Manifest,
    RunEntry,
    SceneEntry,
    file_sha256,
    frames_sha256,
    read_manifest,
    write_manifest,
)
from systems.scene import Scene
from systems.trajectory.codec import open_writer

SURROMD = [sys.executable, "-m", "surrogate.cli.main"]
LONG = """
scenes = ["alanine-dipeptide"]
replicas = 3
time = "200ps"
save_every = "100fs"
equilibrate = "1ps"
solvent = "vacuum"
platform = "Reference"
"""


@pytest.fixture
def finished(alanine_dipeptide: Scene, tmp_path: Path) -> Path:
    """A campaign's folder as one leaves it: two complete runs of alanine dipeptide, and one that failed."""
    rng = np.random.default_rng(0)
    folder, runs = tmp_path / "c", {}
    (folder / "ala").mkdir(parents=True)
    for k in range(3):
        name, file = f"ala_300K_r{k}", f"ala/ala_300K_r{k}.h5"
        positions = alanine_dipeptide.positions_nm + 0.002 * rng.normal(size=(60, alanine_dipeptide.n_atoms, 3))
        with open_writer(folder / file, alanine_dipeptide, {"kind": "reference", "seed": k}) as writer:
            writer.append(positions, np.arange(1.0, 61.0))
        entry = RunEntry(name, "ala", 300.0, k, k, file, {"save_every_ps": 1.0}, 60, COMPLETE)
        if k == 2:
            runs[name] = replace(entry, status=FAILED, reason="it blew up")
            continue
        hashes = {file: file_sha256(folder / file)}
        runs[name] = replace(entry, n_frames=60, sha256=hashes, frames_sha256=frames_sha256(folder / file))
    write_manifest(folder, Manifest("c", 0, {"ala": SceneEntry("ala", "alanine-dipeptide")}, runs))
    return folder


def test_info_tells_what_is_complete_and_why_the_rest_is_not(finished: Path) -> None:
    shown = run("info", str(finished))
    assert shown.exit_code == 0
    assert "2 of 3 runs complete, 1 failed, 120 ps simulated" in shown.stdout
    assert "ala_300K_r2  it blew up" in shown.stdout
    record = json.loads(run("info", str(finished), "--json").stdout)
    assert record["n_frames"] == 120
    assert record["runs"] == {"complete": 2, "failed": 1}


def test_training_data_are_the_complete_runs_with_the_right_hashes(finished: Path, tmp_path: Path) -> None:
    made = run("windows", str(finished), "-o", str(tmp_path / "w.h5"))
    assert made.exit_code == 0, made.output
    assert "120 frames" in made.stdout
    assert "from 2 trajectories" in made.stdout
    assert "1 runs of this campaign are not complete and left out" in made.stderr
    file = finished / "ala/ala_300K_r1.h5"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    for verb in (["windows"], ["train", "--steps", "4"]):
        suffix = "h5" if verb == ["windows"] else "safetensors"
        refused = run(*verb, str(finished), "-o", str(tmp_path / f"x.{suffix}"))
        assert refused.exit_code == 1
        assert "ala_300K_r1.h5 is gone, or not the file that the campaign wrote" in refused.stderr
        assert not (tmp_path / f"x.{suffix}").exists()


def test_one_trains_on_a_campaign_s_folder(finished: Path, tmp_path: Path) -> None:
    settings = tmp_path / "small.toml"
    settings.write_text(
        "[model.autoencoder]\nlatent_dim = 12\nwidth = 64\nhead_dim = 16\nrandom_identifiers = 0.0\n"
        "[model.approximator]\nchunk_frames = 2\nwidth = 64\nn_layers = 1\nn_heads = 2\nauxiliary_frames = 1\n"
    )
    out = tmp_path / "w.safetensors"
    trained = run("train", str(finished), "-o", str(out), "--steps", "4", "--config", str(settings), "--quiet")
    assert trained.exit_code == 0, trained.output
    sources = json.loads(run("info", str(out), "--json").stdout)["provenance"]
    assert "ala_300K_r0.h5" in json.dumps(sources)
    assert "ala_300K_r2.h5" not in json.dumps(sources)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (LONG + "temprature = '1K'", "unknown key 'temprature'. Did you mean 'temperature'?"),
        ("scenes = [", "is not valid TOML"),
    ],
)
def test_a_file_that_cannot_be_meant_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "c.toml"
    file.write_text(text)
    refused = run("campaign", str(file))
    assert refused.exit_code == 1
    assert said in refused.stderr
    assert refused.stderr.count("\n") == 1
    assert not (tmp_path / "c" / MANIFEST_NAME).exists()


def test_a_dry_run_lists_the_runs_and_starts_nothing(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text(LONG)
    shown = run("campaign", str(file), "--dry-run")
    assert shown.exit_code == 0, shown.output
    assert "3 runs of 1 scenes, 600 ps in all" in shown.stdout
    assert "alanine-dipeptide_300K_r2  200 ps, seed" in shown.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["c.toml"]


def _start(folder: Path) -> subprocess.Popen[str]:
    (folder / "c.toml").write_text(LONG)
    arguments = [*SURROMD, "campaign", "c.toml", "--workers", "2", "--quiet"]
    return subprocess.Popen(arguments, cwd=folder, stderr=subprocess.PIPE, text=True, start_new_session=True)


def _wait_for_frames(folder: Path, timeout_s: float = 300.0) -> None:
    """Return when some run has written frames (its file has grown) and none is complete."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if any(file.stat().st_size > 60_000 for file in folder.glob("c/*/*/*.h5")):
            return
        time.sleep(0.05)
    raise AssertionError("no run began")


def _descendants(pid: int) -> list[int]:
    import psutil

    return [child.pid for child in psutil.Process(pid).children(recursive=True)]


def _gone(pids: list[int], timeout_s: float = 60.0) -> bool:
    import psutil

    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if not any(psutil.pid_exists(pid) for pid in pids):
            return True
        time.sleep(0.1)
    return False


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_killed_and_interrupted_a_campaign_goes_on_to_the_same_frames(tmp_path: Path) -> None:
    hashes = []
    for case in ("undisturbed", "killed", "interrupted"):
        folder = tmp_path / case
        folder.mkdir()
        process = _start(folder)
        if case != "undisturbed":
            _wait_for_frames(folder)
            workers = _descendants(process.pid)
        if case == "killed":
            process.kill()
            process.wait()
            assert _gone(workers), "workers outlive the campaign that started them"
        if case == "interrupted":
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the workers, too
            _, said = process.communicate(timeout=120)
            assert process.returncode == 130
            assert "of 3 runs in c are complete" in said
            assert "run the same command to continue" in said
            assert said.count("\n") == 1, said
            assert _gone(workers)
        if case != "undisturbed":
            assert read_manifest(folder / "c").counts().get(COMPLETE, 0) < 3
            process = _start(folder)
        _, said = process.communicate(timeout=600)
        assert process.returncode == 0, said
        manifest = read_manifest(folder / "c")
        assert manifest.counts() == {COMPLETE: 3}
        hashes.append({name: run.frames_sha256 for name, run in manifest.runs.items()})
    assert hashes[0] == hashes[1] == hashes[2]
