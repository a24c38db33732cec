"""Checkpoints: what a run goes on from, believed only as far as its trajectories support it."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

from systems.errors import InputError, StorageError, SurromdError, TrajectoryError
from systems.files.schema import fitted
from systems.files.whole_file import OutputLock, create_whole, packed, refuse_existing, storage_error, unpacked
from systems.scene import Scene
from systems.trajectory.base import TrajectoryWriter
from systems.trajectory.codec import companions, open_trajectory, open_writer

_MAGIC = b"surromd checkpoint 3\n"
# Of a run's time no more than one part in so many should go into waiting for the medium.
FLUSH_SHARE = 50
Checkpoint = tuple[dict[str, Any], bytes]


def checkpoint_path(out: Path) -> Path:
    """Where the checkpoint of a run lies whose first trajectory is `out`: beside it, until the run is complete."""
    return out.with_name(out.name + ".checkpoint")


def new_header(n_files: int, *, overwrite: bool) -> dict[str, Any]:
    """Return what a checkpoint says of a run of `n_files` trajectories that has not begun: `run_id`, `files`, ...
    `overwrite`: whether other files may lie where those of the run are to be. `files`: of each trajectory how many
    frames it has, and their digest."""
    return {"run_id": uuid.uuid4().hex, "overwrite": overwrite, "files": [{"n_frames": 0, "digest": ""}] * n_files}


class _Written(TypedDict):
    n_frames: Annotated[int, range(2**63)]
    digest: str


class _Header(TypedDict):
    """What every checkpoint says, see `new_header`."""

    run_id: str
    overwrite: bool
    files: list[_Written]
    n_frames_wanted: NotRequired[Annotated[int, range(2**63)]]


def write_checkpoint(path: Path, header: dict[str, Any], blob: bytes) -> None:
    """Replace the checkpoint as a whole; it is on the medium when this returns, as are the frames that it has seen.
    `header`: a `new_header` kept up to date, and more that is JSON. Raises StorageError: the old one stays."""
    create_whole(path, _MAGIC + packed(header, blob))


def read_checkpoint(path: Path) -> Checkpoint:
    """Return the state `(header, blob)` in a checkpoint. Raises InputError when it is damaged."""
    try:
        content = path.read_bytes()
        if not content.startswith(_MAGIC):
            raise ValueError("it is of another version of surromd, or no checkpoint")
        header, blob = unpacked(content[len(_MAGIC) :])
        fitted(header, _Header, "header")
    except (OSError, ValueError) as error:
        raise InputError(f"checkpoint {path} cannot be read ({error}); start again with `overwrite=True`.") from error
    return header, blob


def supported_checkpoint(path: Path, outs: Sequence[Path]) -> Checkpoint:
    """Return the state in a checkpoint, if the frames in the run's trajectories support it, all of them read. Raises
    InputError when the checkpoint is damaged, or a trajectory is gone, damaged, or not the one this run wrote."""
    header, blob = read_checkpoint(path)
    if len(header["files"]) != len(outs):
        raise InputError(f"checkpoint {path} is not of {len(outs)} trajectories; take as many as it was begun with.")
    begun = any(entry["n_frames"] for entry in header["files"])
    for k, out in enumerate(outs):
        if reason := _unsupported(out, header, k, begun=begun):
            raise InputError(f"{reason}; restore it, or start again with `overwrite=True`.")
    return header, blob


def writer_at(out: Path, scene: Scene, record: dict[str, Any], header: dict[str, Any], k: int = 0, *, resumed: bool,
              columns: Sequence[str] = ()) -> TrajectoryWriter:  # fmt: skip
    """Return the writer of a run's k-th trajectory, holding the frames that the run's checkpoint has seen, no more.
    Without frames it begins anew: when `resumed`, what lies there is the run's own, or may be replaced."""
    n_frames = header["files"][k]["n_frames"]
    how: dict[str, Any] = {"append": True} if n_frames else {"overwrite": resumed or header["overwrite"]}
    writer = open_writer(out, scene, record, columns=columns, run_id=header["run_id"], locked=True, **how)
    try:
        writer.truncate(n_frames)
        if writer.record["completed"]:
            writer.update_record({"completed": False})
    except BaseException:
        writer.close()
        raise
    return writer


def _unsupported(out: Path, header: dict[str, Any], k: int, *, begun: bool) -> str:
    """Return why a trajectory does not hold what a checkpoint has seen of it, or nothing."""
    if not begun and (header["overwrite"] or not out.exists()):
        return ""
    if not out.exists():
        return f"{out} is not there to go on from, though its checkpoint is"
    n_frames, digest = header["files"][k]["n_frames"], header["files"][k]["digest"]
    try:
        with open_trajectory(out) as reader:
            if reader.run_id != header["run_id"]:
                return f"{out} is not the file that this run wrote, but another's in its place"
            if reader.n_frames < n_frames:
                return f"{out} holds {reader.n_frames} frames, its checkpoint has seen {n_frames}: it was cut short"
            if n_frames and reader.digest(n_frames) != digest:
                return f"{out} holds other frames than its checkpoint has seen"
            reader.verify(n_frames)
    except TrajectoryError as error:
        return str(error).rstrip(".")
    return ""


@contextmanager
def locked_outputs(outs: Sequence[Path], *, may_exist: bool) -> Iterator[None]:
    """Lock a run's trajectories; when it fails, remove those it made that have no frames.

    What there is to go on from is kept when the run was stopped, or the disk is full: files of a run with a checkpoint.
    Raises what `OutputLock` raises, TrajectoryError where one exists unless it `may_exist`, InputError where another
    file lies in the place of the checkpoint, StorageError for an OSError of the run's own.
    """
    with ExitStack() as stack:
        for out in outs:
            stack.enter_context(OutputLock(out))
        path = checkpoint_path(outs[0])
        if path.is_file() and not path.read_bytes().startswith(_MAGIC):
            raise InputError(f"{path} lies where the checkpoint goes and is none of this version's; move it away.")
        for out in outs:
            refuse_existing(out, may_exist)
        before = {member for out in outs for member in family(out) if member.exists()}
        try:
            yield
        except BaseException as error:
            resumable = isinstance(error, KeyboardInterrupt | StorageError) and path.exists()
            for out in outs if not resumable else ():
                with suppress(SurromdError, OSError):  # what cannot be read may hold frames
                    if not frames_in(out):
                        for member in set(family(out)) - before:
                            member.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise storage_error(outs[0], error, "the frames written before are complete and readable") from error
            raise


def family(out: Path) -> list[Path]:
    """Return the paths of a trajectory and of what is written beside it."""
    return [out, checkpoint_path(out), *companions(out)]


def frames_in(out: Path) -> int:
    """Return how many frames a trajectory holds, 0 where it is not there. Raises TrajectoryError."""
    if not out.exists():
        return 0
    with open_trajectory(out) as reader:
        return reader.n_frames
