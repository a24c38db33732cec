"""Campaigns on two worker processes: killed workers, failures, changed files; the same frames whatever happens."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from md_reference.campaign.campaign_file import Campaign, read_campaign
from md_reference.campaign.cluster import open_client
from md_reference.campaign.manifest import (
    COMPLETE,
    FAILED,
    MANIFEST_NAME,
    Manifest,
    campaign_trajectories,
    read_manifest,
)
from md_reference.campaign.scheduler import CampaignProgress, open_campaign, run_campaign
from systems.errors import InputError
from systems.trajectory.codec import open_trajectory

FOUR_RUNS = """
scenes = ["alanine-dipeptide"]
temperatures = ["300K", "330K"]
replicas = 2
time = "20ps"
save_every = "200fs"
timestep = "2fs"
equilibrate = "200fs"
solvent = "vacuum"
platform = "Reference"
"""


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    with open_client(workers=2) as client:
        yield client


def _campaign(folder: Path, text: str = FOUR_RUNS, out: str = "out") -> Campaign:
    path = folder / "campaign.toml"
    path.write_text(text)
    return read_campaign(path, folder=folder / out)


def _hashes(manifest: Manifest) -> dict[str, str]:
    return {name: run.frames_sha256 for name, run in manifest.runs.items()}


def _killing_once() -> Callable[[CampaignProgress], None]:
    """Kill a worker, as the system does when memory is short, while it is in the middle of a run."""
    killed: list[int] = []

    def look(progress: CampaignProgress) -> None:
        for pid, runs in progress.active.items():
            if not killed and any(0 < frames < 100 for frames in runs.values()):
                killed.append(pid)
                os.kill(pid, signal.SIGKILL)

    look.killed = killed  # type: ignore[attr-defined]
    return look


@pytest.fixture(scope="module")
def undisturbed(client: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    campaign = _campaign(tmp_path_factory.mktemp("undisturbed"))
    run_campaign(campaign, client)
    return campaign.folder


def test_a_campaign_leaves_trajectories_and_a_manifest(undisturbed: Path) -> None:
    manifest = read_manifest(undisturbed)
    assert manifest.counts() == {COMPLETE: 4}
    assert len(set(_hashes(manifest).values())) == 4
    files, left_out = campaign_trajectories(undisturbed, verify=True)
    assert (len(files), left_out) == (4, 0)
    for run, file in zip(manifest.runs.values(), files, strict=True):
        assert run.platform == "Reference"
        assert {"python", "openmm"} <= set(run.programs)
        with open_trajectory(file) as reader:
            assert reader.n_frames == run.n_frames == 100
            assert reader.record["seed"] == run.seed
            assert reader.record["temperature_k"] == run.temperature_k
            assert reader.record["completed"] is True


def test_a_killed_worker_changes_no_bit(client: Any, undisturbed: Path, tmp_path: Path) -> None:
    for attempt in range(5):  # where runs are over in no time, none may be caught in the middle of one
        kill = _killing_once()
        folder = tmp_path / str(attempt)
        folder.mkdir()
        manifest = run_campaign(_campaign(folder), client, progress=kill, poll_every_s=0.05)
        if kill.killed:  # type: ignore[attr-defined]
            break
    assert kill.killed, "no worker was caught in the middle of a run"  # type: ignore[attr-defined]
    assert manifest.counts() == {COMPLETE: 4}
    assert _hashes(manifest) == _hashes(read_manifest(undisturbed))


def test_nothing_finished_is_done_again_and_a_campaign_may_grow(client: Any, tmp_path: Path) -> None:
    short = FOUR_RUNS.replace("20ps", "2ps").replace("replicas = 2", "replicas = 1")
    campaign = _campaign(tmp_path, short)
    first = run_campaign(campaign, client)
    files = [campaign.folder / run.file for run in first.runs.values()]
    before = [(file.stat().st_mtime_ns, file.stat().st_ino) for file in files]
    grown = run_campaign(_campaign(tmp_path, short.replace("replicas = 1", "replicas = 2")), client)
    assert grown.counts() == {COMPLETE: 4}
    assert [(file.stat().st_mtime_ns, file.stat().st_ino) for file in files] == before
    assert _hashes(first).items() <= _hashes(grown).items()
    # One that is gone is made again, the same; one that was tampered with is not taken for a result.
    files[0].unlink()
    files[1].write_bytes(files[1].read_bytes() + b"x")
    reasons: dict[str, str] = {}
    again = run_campaign(
        _campaign(tmp_path, short.replace("replicas = 1", "replicas = 2")), client, failed=reasons.__setitem__
    )
    name = next(iter(first.runs))
    assert again.runs[name].frames_sha256 == first.runs[name].frames_sha256
    assert again.counts()[COMPLETE] >= 3


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('timestep = "2fs"', 'timestep = "1fs"', "timestep_ps of scene alanine-dipeptide is 0.002"),
        ("replicas = 2", "replicas = 1", "runs of scene alanine-dipeptide is .with"),
        ('["300K", "330K"]', '["300K"]', "runs of scene alanine-dipeptide is .with"),
        ("replicas = 2", "replicas = 2\nseed = 9", "seed is 0, in this file 9"),
        ('["alanine-dipeptide"]', '["sequence:ACE-GLY-NME"]', "scenes is 'alanine-dipeptide'"),
        ("replicas = 2", "replicas = 2\nformat = 'dcd'", r"file of alanine-dipeptide_300K_r0 is .*\.h5"),
    ],
)
def test_the_folder_of_another_campaign_is_refused(undisturbed: Path, old: str, new: str, said: str) -> None:
    before = (undisturbed / MANIFEST_NAME).read_bytes()
    changed = _campaign(undisturbed.parent, FOUR_RUNS.replace(old, new))
    with pytest.raises(InputError, match=said):
        open_campaign(changed)
    assert (undisturbed / MANIFEST_NAME).read_bytes() == before
    open_campaign(_campaign(undisturbed.parent))


def test_a_folder_with_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="not empty and no campaign's folder"):
        open_campaign(_campaign(tmp_path))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]


def test_what_fails_is_reported_and_the_rest_goes_on(client: Any, tmp_path: Path) -> None:
    text = """
    time = "40fs"
    save_every = "20fs"
    timestep = "2fs"
    equilibrate = "20fs"
    solvent = "vacuum"
    platform = "Reference"
    retries = 1
    [[scenes]]
    scene = "alanine-dipeptide"
    [[scenes]]
    scene = "alanine-dipeptide"
    name = "too-fast"
    timestep = "20fs"
    constrain_hydrogens = false
    time = "4ps"
    [[scenes]]
    scene = "sequence:ACE-XYZ-NME"
    """
    reasons: dict[str, str] = {}
    manifest = run_campaign(_campaign(tmp_path, text), client, failed=reasons.__setitem__)
    states = {run.scene: run for run in manifest.runs.values()}
    assert states["alanine-dipeptide"].status == COMPLETE
    assert states["too-fast"].status == FAILED
    assert states["too-fast"].attempts == 2  # tried again, as it might have been the machine
    assert "Try a shorter `timestep_ps`" in states["too-fast"].reason
    assert states["ACE-XYZ-NME"].status == FAILED
    assert "XYZ" in states["ACE-XYZ-NME"].reason
    assert set(reasons) == {"too-fast_300K_r0", "ACE-XYZ-NME"}
    assert all("\n" not in reason for reason in reasons.values())


def test_two_processes_cannot_run_one_campaign(client: Any, tmp_path: Path) -> None:
    campaign = _campaign(tmp_path)
    refused: list[str] = []

    def second(_: CampaignProgress) -> None:
        if not refused:
            with pytest.raises(InputError, match="another process runs this campaign") as caught:
                run_campaign(campaign, client)
            refused.append(str(caught.value))
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match=r"of 4 runs .* run the same command to continue"):
        run_campaign(campaign, client, progress=second)
    assert refused


def test_an_interrupted_campaign_goes_on_to_the_same_frames(client: Any, undisturbed: Path, tmp_path: Path) -> None:
    def interrupt(progress: CampaignProgress) -> None:
        if any(progress.active.values()) or 0 < progress.runs_complete < 4:
            signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt, match=r"of 4 runs in .* are complete"):
            run_campaign(_campaign(tmp_path), client, progress=interrupt, poll_every_s=0.05)
    finally:
        signal.signal(signal.SIGINT, before)
    stopped = read_manifest(tmp_path / "out")
    assert stopped.counts().get(COMPLETE, 0) < 4
    began = time.monotonic()
    manifest = run_campaign(_campaign(tmp_path), client)
    assert manifest.counts() == {COMPLETE: 4}, time.monotonic() - began
    assert _hashes(manifest) == _hashes(read_manifest(undisturbed))
