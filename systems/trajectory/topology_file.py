"""`NAME.pdb` beside a trajectory: its topology in its atom order, which other programs pair it with.

A trajectory is not read by it, so it may be missing (files of earlier versions, copies); one of somebody else is never
replaced.
"""

from __future__ import annotations

from pathlib import Path

from systems.errors import TrajectoryError
from systems.files.whole_file import create_whole
from systems.scene import Scene
from systems.trajectory.pdb_text import MOST_ATOMS, pdb_text

_OURS = b"REMARK   1 surromd scene"
_TRAJECTORIES = (".h5", ".hdf5", ".dcd")


def topology_path(trajectory: Path) -> Path:
    """Return the path of `NAME.pdb` beside a trajectory."""
    return trajectory.with_suffix(".pdb")


def is_our_topology(pdb: Path) -> bool:
    """Whether this PDB file is there and was written by us."""
    try:
        with pdb.open("rb") as file:
            return file.read(len(_OURS)) == _OURS
    except OSError:
        return False


def refuse_foreign_topology(trajectory: Path) -> None:
    """Raise TrajectoryError where `NAME.pdb` of another program would be replaced."""
    pdb = topology_path(trajectory)
    if pdb.exists() and not is_our_topology(pdb):
        raise TrajectoryError(
            f"{pdb} is not ours and would be replaced by the topology of {trajectory.name}; choose another name for it."
        )


def refuse_other_topology(trajectory: Path, scene: Scene, *, overwrite: bool) -> None:
    """Raise TrajectoryError where `NAME.pdb` is another program's, or that of other atoms and still needed: beside
    another trajectory of that name, or without `overwrite`."""
    refuse_foreign_topology(trajectory)
    pdb = topology_path(trajectory)
    if not pdb.exists() or scene.n_atoms > MOST_ATOMS or _atoms(pdb.read_bytes()) == _atoms(_bytes(scene)):
        return
    others = [trajectory.with_suffix(s) for s in _TRAJECTORIES if s != trajectory.suffix.lower()]
    beside = next((other for other in others if other.exists()), None)
    if beside is not None:
        raise TrajectoryError(f"{pdb} is the topology of {beside.name}, of other atoms; choose another name.")
    if not overwrite:
        raise TrajectoryError(f"{pdb} exists already, of other atoms; overwrite it, or choose another name.")


def write_topology(trajectory: Path, scene: Scene) -> Path:
    """Write `NAME.pdb` and return its path; nothing of scenes with more atoms than the format holds. Raises
    StorageError."""
    pdb = topology_path(trajectory)
    if scene.n_atoms <= MOST_ATOMS:
        create_whole(pdb, _bytes(scene))
    return pdb


def _bytes(scene: Scene) -> bytes:
    return pdb_text(scene).encode("ascii", "replace")


def _atoms(pdb: bytes) -> list[bytes]:
    """Return a file's atoms in order, without their positions."""
    return [line[:30] + line[54:] for line in pdb.splitlines() if line.startswith((b"ATOM", b"HETATM"))]
