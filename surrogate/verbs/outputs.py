"""Files that verbs write and read: checked before the work starts, reported at its end, replicas found by pattern."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from glob import glob
from pathlib import Path

from md_reference.campaign.manifest import campaign_folder, campaign_trajectories
from surrogate.verbs.options import Trajectories
from systems.errors import InputError
from systems.trajectory.checkpoint import checkpoint_path, frames_in
from systems.trajectory.codec import WRITTEN
from systems.trajectory.companion_writer import refuse_other_companions


def check_outputs(
    paths: Sequence[Path], suffixes: Sequence[str], *, resume: bool = False, overwrite: bool = False
) -> None:
    """Refuse outputs that cannot be meant, before anything is computed.

    Raises InputError for another suffix, a folder that does not exist, an existing file (unless `resume` or
    `overwrite`), or both switches at once; TrajectoryError where a trajectory's NAME.pdb is another program's.
    """
    if resume and overwrite:
        raise InputError("`resume` and `overwrite` exclude each other.")
    for path in paths:
        if "\0" in str(path):
            raise InputError(f"{str(path)!r} is no name for a file: it holds a NUL.")
        if path.suffix.lower() not in suffixes:
            raise InputError(f"{path}: the output must end in {' or '.join(suffixes)}.")
        if not path.parent.is_dir():
            raise InputError(f"{path}: its folder does not exist; create {path.parent} first.")
        if path.is_dir():
            raise InputError(f"{path} is a folder; name a file.")
        if path.exists() and not (resume or overwrite):
            raise InputError(f"{path} exists; add `overwrite=True` to replace it, or choose another name.")
        if path.suffix.lower() in WRITTEN and suffixes == WRITTEN and not resume:
            refuse_other_companions(path)


@contextmanager
def summarised_outputs(paths: Sequence[Path], *, resumable: str = "") -> Iterator[None]:
    """Run a verb that writes trajectories; on Ctrl-C say what is kept, as the message of KeyboardInterrupt.
    `resumable`: what the user does to go on, said when there is something to go on from."""
    try:
        yield
    except KeyboardInterrupt:
        counts = {path: frames_in(path) for path in paths if path.exists() or checkpoint_path(path).exists()}
        raise KeyboardInterrupt(f"{_kept(counts)}; {resumable}" if counts else "nothing was written") from None


def _kept(counts: dict[Path, int]) -> str:
    if len(counts) <= 2:
        return ", ".join(f"{path} holds {frames} frames" for path, frames in counts.items())
    first, *_, last = counts
    fewest, most = min(counts.values()), max(counts.values())
    return f"{first} to {last.name} hold {most if fewest == most else f'{fewest} to {most}'} frames each"


def find_trajectories(spec: Trajectories, *, verify: bool = False) -> list[Path]:
    """Return the files that a user means by a path, a folder, a glob pattern, a comma-separated list or a sequence.

    A folder stands for the trajectories in it (HDF5 before DCD, if it holds both); one of a campaign, or within it, for
    the runs that its manifest calls complete, whose hashes are checked if `verify`. Raises InputError when nothing is
    found, TrajectoryError when a hash differs.
    """
    if not isinstance(spec, (str, Path)):
        return [path for part in spec for path in find_trajectories(part, verify=verify)]
    path = Path(spec)
    if path.is_dir() and campaign_folder(path) is not None:
        found, left_out = campaign_trajectories(path, verify=verify)
        if left_out:
            sys.stderr.write(f"{path}: {left_out} runs of this campaign are not complete and left out\n")
        return found
    if path.is_dir():
        files = [p for p in sorted(path.iterdir()) if not p.name.endswith(".meta.h5")]
        for suffixes in ((".h5", ".hdf5"), (".dcd",), (".xtc",)):
            found = [p for p in files if p.suffix.lower() in suffixes]
            if found:
                return found
        raise InputError(f"{path}: no trajectory (.h5, .dcd, .xtc) in this folder.")
    if path.exists():
        return [path]
    text = str(spec)
    if "," in text:
        parts = [part.strip() for part in text.split(",") if part.strip()]
        return [p for part in parts for p in find_trajectories(part, verify=verify)]
    if any(c in text for c in "*?["):
        found = [Path(p) for p in sorted(glob(text)) if not p.endswith(".meta.h5")]
        if found:
            return found
        raise InputError(f"{text}: no file matches.")
    raise InputError(f"{text}: no such file.")
