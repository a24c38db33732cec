"""`NAME.pdb` beside a trajectory: its topology in its atom order, which other programs pair it with.

A trajectory is not read by it, so it may be missing (files of earlier versions, copies); a file of another program is
never replaced. The text is written here: every bond and the scene's own atom order must stand in it, while OpenMM's
PDBFile writes CONECT records of non-standard residues alone (12 of alanine dipeptide's 21 bonds).
"""

from __future__ import annotations

from pathlib import Path

from systems.errors import InputError, TrajectoryError
from systems.files.whole_file import create_whole
from systems.prepare.read.hybrid36 import encode
from systems.scene import Scene

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
