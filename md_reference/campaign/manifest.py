"""The manifest of a campaign: what runs a folder of trajectories holds, how each was made, and the hashes of files."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from systems.errors import InputError, TrajectoryError
from systems.files.outside import content
from systems.files.schema import built, parsed
from systems.files.whole_file import create_whole

MANIFEST_NAME = "manifest.json"
FORMAT = 1

Status = Literal["waiting", "running", "complete", "failed"]
WAITING: Final = "waiting"
RUNNING: Final = "running"
COMPLETE: Final = "complete"
FAILED: Final = "failed"


@dataclass(frozen=True)
class SceneEntry:
    """A scene of the campaign: what the user wrote (`source`), the hash of the file it names, what became of it."""

    name: str
    source: str
    source_sha256: str = ""
    preparation: dict[str, Any] = field(default_factory=dict)
    status: Status = WAITING
    reason: str = ""
    n_atoms: int | None = None
    formula: str | None = None
    topology_hash: str | None = None
    molecule_key: str | None = None
    force: dict[str, Any] = field(default_factory=dict)
    repairs: tuple[str, ...] = ()
    starts: str = ""


@dataclass(frozen=True)
class RunEntry:
    """One replica of one scene at one temperature; paths are relative to the campaign's folder. `sha256`: of each file
    the run wrote; `frames_sha256`: of what was simulated, the same for the same run on another day. `settings` are
    those the run was asked for, in our units."""

    name: str
    scene: str
    temperature_k: float
    replica: int
    seed: int
    file: str
    settings: dict[str, float | bool | str | None]
    n_frames_wanted: int
    status: Status = WAITING
    reason: str = ""
    attempts: int = 0
    n_frames: int = 0
    size_bytes: int = 0
    sha256: dict[str, str] = field(default_factory=dict)
    frames_sha256: str = ""
    platform: str = ""
    programs: dict[str, str] = field(default_factory=dict)
    host: str = ""
    wall_s: float = 0.0

    def __post_init__(self) -> None:
        for name in (self.file, *self.sha256):
            if Path(name).is_absolute() or ".." in Path(name).parts:
                raise InputError(f"run {self.name}: {name} lies outside the campaign's folder.")

    @property
    def simulated_ps(self) -> float:
        """What of its time is simulated."""
        every_ps = self.settings.get("save_every_ps")
        return self.n_frames * every_ps if isinstance(every_ps, float) else 0.0


@dataclass(frozen=True)
class Manifest:
    """All scenes and runs of a campaign, in the order of its file."""

    name: str
    seed: int
    scenes: dict[str, SceneEntry]
    runs: dict[str, RunEntry]
    programs: dict[str, str] = field(default_factory=dict)
    started: str = ""

    def counts(self) -> dict[str, int]:
        """Return how many runs are in each state; states without runs are left out."""
        states = [entry.status for entry in self.runs.values()]
        return {state: states.count(state) for state in (COMPLETE, RUNNING, WAITING, FAILED) if state in states}


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write `manifest.json` into the folder, whole or not at all. Raises StorageError."""
    record = {"format": FORMAT, **asdict(manifest)}
    # Lists read better than tables whose keys repeat a name that each entry has.
    record["scenes"], record["runs"] = list(record["scenes"].values()), list(record["runs"].values())
    create_whole(folder / MANIFEST_NAME, json.dumps(record, indent=1) + "\n")


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a campaign's folder. Raises InputError when there is none or it cannot be read."""
    path = folder / MANIFEST_NAME
    try:
        record = dict(parsed(content(path)))
        if record.pop("format", None) != FORMAT:
            raise InputError(f"{path} was written by another version of surromd (its format is not {FORMAT}).")
        for key in ("scenes", "runs"):
            record[key] = {entry["name"]: entry for entry in record[key]}
        return built(Manifest, record)
    except FileNotFoundError:
        raise InputError(f"{folder} holds no {MANIFEST_NAME}: it is no campaign's folder.") from None
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path} cannot be read as a campaign's manifest ({error}).") from error


def campaign_folder(path: Path) -> Path | None:
    """Return the campaign's folder that `path` is or lies in, or None."""
    return next((folder for folder in (path, *path.resolve().parents) if (folder / MANIFEST_NAME).is_file()), None)


def campaign_trajectories(path: Path, *, verify: bool = False) -> tuple[list[Path], int]:
    """Return the complete trajectories of a campaign, or of a part of it, and how many runs there are not complete.
    `path`: the campaign's folder or one within it (a scene, a temperature). Only the manifest says what is complete.
    Raises InputError when nothing is; with `verify` TrajectoryError when a file is not the one that was written."""
    folder = campaign_folder(path)
    if folder is None:
        raise InputError(f"{path} holds no {MANIFEST_NAME}: it is no campaign's folder.")
    base, part = folder.resolve(), path.resolve()
    entries = [run for run in read_manifest(folder).runs.values() if (base / run.file).is_relative_to(part)]
    complete = [run for run in entries if run.status == COMPLETE]
    if not complete:
        raise InputError(f"{path}: none of the {len(entries)} runs of this campaign here is complete.")
    for name, expected in [item for run in complete for item in run.sha256.items()] if verify else ():
        file = folder / name
        if not file.is_file() or file_sha256(file) != expected:
            raise TrajectoryError(
                f"{file} is gone, or not the file that the campaign wrote (its sha256 differs from {MANIFEST_NAME}); "
                "delete it and run the campaign again to remake it."
            )
    return [folder / run.file for run in complete], len(entries) - len(complete)


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def frames_sha256(path: Path) -> str:
    """Return a SHA-256 of a trajectory's frames, all that is kept of each, whatever the file around them."""
    from systems.trajectory.codec import open_trajectory

    with open_trajectory(path) as reader:
        return reader.digest(reader.n_frames)
