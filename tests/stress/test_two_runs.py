"""Two runs started on one output at the same time: one writes it, the other is refused; nothing is lost."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from systems.errors import TrajectoryError
from systems.files.whole_file import OutputLock
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer

COMMAND = [sys.executable, "-m", "surrogate.cli.main", "reference", "double-well", "--time", "4ps", "--save-every",
           "200fs", "--timestep", "20fs", "--equilibrate", "1ps", "--platform", "Reference", "--quiet"]  # fmt: skip


def both(out: Path, repository: Path, *more: str) -> list[tuple[int, int, str]]:
    """Start two runs with seeds 1 and 2; return (seed, exit status, what it said) of each."""
    runs = [subprocess.Popen([*COMMAND, "-o", str(out), "--seed", str(seed), *more], cwd=repository, text=True,
                             stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) for seed in (1, 2)]  # fmt: skip
    said = [run.communicate(timeout=300)[1] for run in runs]
    return [(seed, run.returncode, text) for seed, run, text in zip((1, 2), runs, said, strict=True)]


def outcome(out: Path, repository: Path, *more: str) -> str:
    ended = both(out, repository, *more)
    done = [seed for seed, status, _ in ended if status == 0]
    with open_trajectory(out) as reader:
        seed, whole = reader.record["seed"], reader.record["completed"] and reader.n_frames == 20
        reader.verify(20)
    refused = all(text.startswith("error: ") and text.count("\n") == 1 for _, status, text in ended if status)
    # With --overwrite both may run, one after the other.
    fine = whole and refused and seed in done and (len(done) == 1 or "--overwrite" in more)
    return "exact" if fine else f"lost: {ended}"


def test_a_lock_is_held_against_everybody(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    out = tmp_path / "a.h5"
    with OutputLock(out):
        with pytest.raises(TrajectoryError, match="being written by another process"):
            OutputLock(tmp_path / "." / "a.h5")
        with pytest.raises(TrajectoryError, match="being written by another process"):
            open_writer(out, alanine_dipeptide, {}, overwrite=True)
        OutputLock(tmp_path / "b.h5").close()
    (tmp_path / "link.h5").symlink_to(out)
    with open_writer(out, alanine_dipeptide, {}), pytest.raises(TrajectoryError, match="another process"):
        OutputLock(tmp_path / "link.h5")
    OutputLock(out).close()
    assert not list(tmp_path.glob(".*"))


def test_a_lock_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / ".a.h5.lock").symlink_to(tmp_path / "precious")
    with pytest.raises(Exception, match="Cannot write"):
        OutputLock(tmp_path / "a.h5")
    assert (tmp_path / "precious").read_text() == "mine"


@pytest.mark.slow
def test_two_runs_on_one_output(tmp_path: Path, repository: Path) -> None:
    found = {}
    for trial in range(12):
        folder = tmp_path / str(trial)
        folder.mkdir()
        found[trial] = outcome(folder / "a.h5", repository, *(["--overwrite"] if trial % 2 else []))
        assert not [p for p in folder.iterdir() if "checkpoint" in p.name or "journal" in p.name]
    assert Counter(found.values()) == {"exact": 12}, found
