"""Manifests come back as written, say what is complete, and notice files that are not what was written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from md_reference.campaign.manifest import (
    COMPLETE,
    FAILED,
    MANIFEST_NAME,
    Manifest,
    RunEntry,
    SceneEntry,
    campaign_trajectories,
    file_sha256,
    frames_sha256,
    read_manifest,
    write_manifest,
)
from systems.errors import InputError, TrajectoryError
from systems.scene import Scene
from systems.trajectory.codec import open_writer


def _run(name: str, file: str, **entries: object) -> RunEntry:
    entry = RunEntry(name, "a", 300.0, 0, 7, file, {"time_ps": 0.1 + 0.2}, 3)
    return replace(entry, **entries)  # type: ignore[arg-type]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two complete runs at two temperatures and a failed one."""
    runs = []
    for k, label in enumerate(("300K", "350K")):
        (tmp_path / "a" / label).mkdir(parents=True)
        file = f"a/{label}/a_{label}_r0.h5"
        (tmp_path / file).write_bytes(b"frames %d" % k)
        runs.append(_run(f"a_{label}_r0", file, status=COMPLETE, sha256={file: file_sha256(tmp_path / file)}))
    runs.append(_run("a_300K_r1", "a/300K/a_300K_r1.h5", status=FAILED, reason="it blew up"))
    (tmp_path / "a/300K/a_300K_r1.h5").write_bytes(b"half")
    scene = SceneEntry("a", "x.pdb", repairs=("one", "two"))
    write_manifest(tmp_path, Manifest("test", 3, {"a": scene}, {r.name: r for r in runs}, {"openmm": "8"}))
    return tmp_path


def test_a_manifest_comes_back_as_it_was_written(folder: Path) -> None:
    first = read_manifest(folder)
    assert first.runs["a_300K_r1"].reason == "it blew up"
    assert first.runs["a_300K_r0"].settings == {"time_ps": 0.1 + 0.2}
    assert first.scenes["a"].repairs == ("one", "two")
    assert first.counts() == {"complete": 2, "failed": 1}
    write_manifest(folder, first)
    assert read_manifest(folder) == first
    assert [path.name for path in folder.iterdir() if path.is_file()] == [MANIFEST_NAME]


def test_only_complete_runs_are_given_of_the_whole_or_a_part(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files, left_out = campaign_trajectories(folder, verify=True)
    assert [file.name for file in files] == ["a_300K_r0.h5", "a_350K_r0.h5"]
    assert left_out == 1
    assert campaign_trajectories(folder / "a" / "350K") == ([folder / "a/350K/a_350K_r0.h5"], 0)
    monkeypatch.chdir(folder / "a")
    files, left_out = campaign_trajectories(Path("300K"), verify=True)
    assert [file.resolve() for file in files] == [folder / "a/300K/a_300K_r0.h5"]
    assert left_out == 1


def test_a_changed_or_missing_file_is_noticed_when_verified(folder: Path) -> None:
    file = folder / "a/350K/a_350K_r0.h5"
    file.write_bytes(b"frames 2")  # as long as it was
    campaign_trajectories(folder)
    with pytest.raises(TrajectoryError, match=r"a_350K_r0\.h5 is gone, or not the file"):
        campaign_trajectories(folder, verify=True)
    campaign_trajectories(folder / "a/300K", verify=True)
    file.unlink()
    with pytest.raises(TrajectoryError, match=r"a_350K_r0\.h5 is gone"):
        campaign_trajectories(folder, verify=True)


@pytest.mark.parametrize(
    ("text", "said"),
    [("{", "cannot be read"), ('{"format": 99}', "another version"), ('{"format": 1}', "cannot be read")],
)
def test_a_damaged_manifest_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / MANIFEST_NAME).write_text(text)
    with pytest.raises(InputError, match=said) as caught:
        read_manifest(tmp_path)
    assert "\n" not in str(caught.value)


def test_no_manifest_and_nothing_complete_are_refused(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(InputError, match=r"holds no manifest\.json"):
        campaign_trajectories(tmp_path.parent)
    first = read_manifest(folder)
    runs = {name: replace(run, status=FAILED) for name, run in first.runs.items()}
    write_manifest(folder, replace(first, runs=runs))
    with pytest.raises(InputError, match="none of the 3 runs"):
        campaign_trajectories(folder)


def test_the_hash_of_frames_sees_positions_times_and_scalars_and_nothing_else(
    alanine_dipeptide: Scene, tmp_path: Path
) -> None:
    def write(name: str, shift: float = 0.0, later: float = 0.0, warmer: float = 0.0, note: str = "") -> str:
        positions = np.repeat(alanine_dipeptide.positions_nm[None], 3, axis=0)
        positions[1, 4, 2] += shift
        with open_writer(tmp_path / name, alanine_dipeptide, {"kind": "reference", "started": note}) as writer:
            scalars = {"temperature_k": np.array([300.0, 301.0, 302.0 + warmer])}
            writer.append(positions, np.array([1.0, 2.0, 3.0 + later]), scalars=scalars)
        return frames_sha256(tmp_path / name)

    first = write("a.h5", note="today")
    assert write("b.h5", note="tomorrow") == first
    assert file_sha256(tmp_path / "a.h5") != file_sha256(tmp_path / "b.h5")
    others = {write("c.h5", shift=1e-6), write("d.h5", later=1e-9), write("e.h5", warmer=1e-9)}
    assert len(others | {first}) == 4

    def moving(name: str, faster: float) -> str:
        positions = np.repeat(alanine_dipeptide.positions_nm[None], 2, axis=0)
        with open_writer(tmp_path / name, alanine_dipeptide, {}, columns=["velocities"]) as writer:
            writer.append(positions, np.array([1.0, 2.0]), velocities_nm_ps=positions + faster)
        return frames_sha256(tmp_path / name)

    assert moving("f.h5", 0.0) == moving("g.h5", 0.0) != moving("h.h5", 1e-6)
