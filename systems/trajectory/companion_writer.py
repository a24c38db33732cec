"""What stands beside trajectories: `NAME.pdb` has the topology; `NAME.meta.h5` the rest, where a format holds positions
alone.

A trajectory is not read by its PDB, so that may be missing (files of earlier versions, copies); a file of another
program is never replaced. The text is written here: every bond and the scene's own atom order must stand in it, while
OpenMM's PDBFile writes CONECT records of non-standard residues alone (12 of alanine dipeptide's 21 bonds).
"""

from __future__ import annotations

import os
from abc import abstractmethod
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy.typing as npt

from systems.errors import InputError, SurromdError, TrajectoryError
from systems.files.whole_file import create_whole, refuse_existing, storage_error, write_whole
from systems.prepare.structure_text import encode
from systems.scene import Scene
from systems.trajectory.base import TrajectoryWriter, check_same_topology
from systems.trajectory.frame_store import CELLS, FRAMES, FrameBlock, FrameStore, create_store

MOST_ATOMS = 99_999
# Between these a coordinate in Å fits its columns.
_LEAST_A, _MOST_A = -999.999, 9999.999
_OURS = b"REMARK   1 surromd scene"
_TRAJECTORIES = (".h5", ".hdf5", ".dcd", ".xtc")


def pdb_text(scene: Scene) -> str:
    """Return PDB text (ASCII) in the scene's atom order, with CONECT records for all bonds.

    A scene too far from the origin for the columns is centred. Raises InputError above 99,999 atoms (the format's
    limit).
    """
    if scene.n_atoms > MOST_ATOMS:
        raise InputError(f"Scene {scene.name!r} has {scene.n_atoms} atoms; a PDB file holds at most {MOST_ATOMS:,}.")
    angstrom = scene.positions_nm * 10.0
    if scene.n_atoms and (angstrom.min() < _LEAST_A or angstrom.max() > _MOST_A):
        angstrom = angstrom - angstrom.mean(axis=0)
    lines = [f"REMARK   1 surromd scene {scene.name}"]
    for i, (name, element) in enumerate(zip(scene.atom_names, scene.elements, strict=True)):
        res = scene.residue_of_atom[i]
        padded = name[:4] if len(name) >= 4 or len(element) == 2 else f" {name}"
        x, y, z = angstrom[i]
        resid = scene.residue_ids[res]
        number, insertion = (resid[:-1], resid[-1]) if resid and resid[-1].isalpha() else (resid, " ")
        if number.lstrip("-").isdigit():
            number = encode(int(number), 4) or number
        chain = (scene.chain_of_residue[res] or " ")[0]
        lines.append(
            f"ATOM  {i + 1:5d} {padded:<4s} {scene.residue_names[res][:3]:>3s} {chain}{number[-4:]:>4s}{insertion}   "
            f"{x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00          {element:>2s}"
        )
    neighbours: dict[int, list[int]] = {}
    for i, j in scene.bonds.tolist():
        neighbours.setdefault(i, []).append(j)
        neighbours.setdefault(j, []).append(i)
    lines.append("TER")
    for i in sorted(neighbours):
        for start in range(0, len(neighbours[i]), 4):
            row = "".join(f"{j + 1:5d}" for j in sorted(neighbours[i])[start : start + 4])
            lines.append(f"CONECT{i + 1:5d}{row}")
    lines.append("END")
    return ("\n".join(lines) + "\n").encode("ascii", "replace").decode()


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


def topology_bytes(scene: Scene) -> bytes:
    """Return what `NAME.pdb` holds; nothing of a scene with more atoms than the format."""
    return pdb_text(scene).encode() if scene.n_atoms <= MOST_ATOMS else b""


def refuse_other_topology(trajectory: Path, topology: bytes, *, overwrite: bool) -> None:
    """Raise TrajectoryError where `NAME.pdb` is another program's, or not `topology` and still needed: beside another
    trajectory of that name, or without `overwrite`."""
    refuse_foreign_topology(trajectory)
    pdb = topology_path(trajectory)
    if not pdb.exists() or not topology or _atoms(pdb.read_bytes()) == _atoms(topology):
        return
    others = [trajectory.with_suffix(s) for s in _TRAJECTORIES if s != trajectory.suffix.lower()]
    beside = next((other for other in others if other.exists()), None)
    if beside is not None:
        raise TrajectoryError(f"{pdb} is the topology of {beside.name}, of other atoms; choose another name.")
    if not overwrite:
        raise TrajectoryError(f"{pdb} exists already, of other atoms; overwrite it, or choose another name.")


def write_topology(trajectory: Path, topology: bytes) -> None:
    """Write `NAME.pdb`, where there is a topology. Raises StorageError."""
    if topology:
        create_whole(topology_path(trajectory), topology)


def _atoms(pdb: bytes) -> list[bytes]:
    """Return a file's atoms in order, without their positions."""
    return [line[:30] + line[54:] for line in pdb.splitlines() if line.startswith((b"ATOM", b"HETATM"))]


# ---- writers of formats that hold positions alone -------------------------------------------------------------------


SUFFIXES = (".dcd", ".xtc")


def companions(path: Path) -> tuple[Path, Path]:
    """Return the paths of `NAME.pdb` and `NAME.meta.h5` that stand beside `NAME.dcd` or `NAME.xtc`."""
    return topology_path(path), path.with_suffix(".meta.h5")


class CompanionWriter(TrajectoryWriter):
    """Writes frames and their companions; see `systems.trajectory.codec.open_writer` for the arguments and errors.

    Frames go to the file first and to `NAME.meta.h5` then: what lies behind the frames that it counts was in flight.
    """

    def __init__(
        self, path: Path, scene: Scene, record: dict[str, Any], *, append: bool, overwrite: bool, run_id: str = ""
    ) -> None:
        self.path, self.scene, self._fd = path, scene, -1
        self._pdb, self._meta = companions(path)
        if not append:
            self._create(record, overwrite, run_id)
        if not self._meta.exists():
            raise TrajectoryError(f"{path} has no {self._meta.name} beside it and cannot be continued.")
        self._store = FrameStore(self._meta)
        try:
            check_same_topology(path, self._store.scene, scene)
            self._adopt()
            self.n_frames, self.last_time_ps = self._store.n_frames, self._store.last_time_ps
            new = {key: value for key, value in record.items() if key not in self._store.record}
            if append and new:
                self._store.update_record(new)
            try:
                self._fd = os.open(path, os.O_RDWR | getattr(os, "O_CLOEXEC", 0))
                self._set_length(self.n_frames)
            except OSError as error:
                raise storage_error(path, error, "nothing was changed") from error
        except BaseException:
            self.close()
            raise

    def _create(self, record: dict[str, Any], overwrite: bool, run_id: str) -> None:
        for file in (self.path, self._meta):
            refuse_existing(file, overwrite)
        for suffix in SUFFIXES:
            other = self.path.with_suffix(suffix)
            if suffix != self.path.suffix.lower() and other.exists() and self._meta.exists():
                raise TrajectoryError(f"{self._meta} is the record of {other.name}; choose another name.")
        topology = topology_bytes(self.scene)
        refuse_other_topology(self.path, topology, overwrite=overwrite)
        made = [file for file in (self._meta, self._pdb, self.path) if not file.exists()]
        try:
            create_store(
                self._meta,
                self.scene,
                record,
                self._lay_out,
                overwrite=overwrite,
                run_id=run_id,
                checksums=(FRAMES,) if self.scene.cell_nm is None else (FRAMES, CELLS),
            )
            write_topology(self.path, topology)
            create_whole(self.path, self._head())
        except SurromdError:
            for file in made:
                with suppress(OSError):
                    file.unlink(missing_ok=True)
            raise

    @abstractmethod
    def _lay_out(self, file: h5py.File) -> None:
        """Make the columns of `NAME.meta.h5` that this format needs."""

    @abstractmethod
    def _head(self) -> bytes:
        """Return what a file without frames holds."""

    @abstractmethod
    def _adopt(self) -> None:
        """Learn how the file is laid out. Raises TrajectoryError where it is not ours, or lacks recorded frames."""

    @abstractmethod
    def _encoded(self, block: FrameBlock) -> tuple[bytes, dict[str, npt.NDArray[Any]], dict[str, npt.NDArray[Any]]]:
        """Return a block as the file has it, the columns that go with it, and what has a checksum (`FrameStore`).

        Raises InputError for frames that the format cannot hold.
        """

    @abstractmethod
    def _offset(self, n_frames: int) -> int:
        """Return where in the file the first `n_frames` frames end, bytes."""

    def _restate(self, n_frames: int) -> None:
        """Make the header say so many frames, where there is one: one small write, which is atomic. Raises OSError."""

    def _append(self, block: FrameBlock) -> None:
        self._refuse_closed()
        self._store.check_flags(block)
        kind = self.path.suffix[1:].upper()
        if block.velocities_nm_ps is not None or block.forces_kj_mol_nm is not None:
            raise InputError(
                f"{self.path}: {kind} files hold positions only; write an .h5 to keep velocities or forces."
            )
        if block.cell_nm is not None and self.scene.cell_nm is None:
            raise InputError(f"{self.path}: {self.scene.name!r} has no periodic cell, but frames came with one.")
        data, columns, stored = self._encoded(block)
        try:
            start = self._offset(self.n_frames)
            write_whole(self._fd, data, start)
            self._written(block, columns)
            self._restate(self.n_frames + len(block))
            os.ftruncate(self._fd, start + len(data))
            os.fsync(self._fd)
            self._store.append(block, columns, stored)
        except BaseException as error:
            # Taking space back needs none, so this also succeeds on a full disk; and frames too many do no harm.
            self._forgotten(self.n_frames)
            with suppress(OSError):
                self._set_length(self.n_frames)
            failed = self._store.failed(error) if isinstance(error, OSError) else error
            self.close()
            raise failed from error

    def _written(self, block: FrameBlock, columns: dict[str, npt.NDArray[Any]]) -> None:
        """Remember what later frames depend on."""

    def _forgotten(self, n_frames: int) -> None:
        """Forget what is remembered of frames behind the first `n_frames`."""

    def _set_length(self, n_frames: int) -> None:
        """Make header and file size say `n_frames`."""
        self._restate(n_frames)
        os.ftruncate(self._fd, self._offset(n_frames))

    def truncate(self, n_frames: int) -> None:
        self._refuse_closed()
        self._store.truncate(n_frames)
        self._forgotten(n_frames)
        try:
            self._set_length(n_frames)
        except OSError as error:
            raise self._store.failed(error) from error
        self.n_frames, self.last_time_ps = n_frames, self._store.last_time_ps

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        super().close()
