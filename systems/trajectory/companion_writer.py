"""What lies beside trajectories: `NAME.pdb` has the topology; `NAME.meta.h5` the rest, where a format holds positions
alone, as DCD and XTC do.

A trajectory is not read by its PDB, so that may be missing. The text is written here, with every bond and in the
scene's own atom order: OpenMM's PDBFile writes CONECT records of non-standard residues alone.
"""

from __future__ import annotations

from pathlib import Path

from systems.errors import InputError, TrajectoryError
from systems.prepare.structure_text import encode, pdb_atom
from systems.scene import Scene

MOST_ATOMS = 99_999
# Between these a coordinate in Å fits its columns.
_LEAST_A, _MOST_A = -999.999, 9999.999
_OURS = b"REMARK   1 surromd scene"
POSITIONS_ALONE = (".dcd", ".xtc")


def pdb_text(scene: Scene) -> str:
    """Return PDB text (ASCII) in the scene's atom order, with CONECT records for all bonds. A scene too far from the
    origin for the columns is centred. Raises InputError above 99,999 atoms (the format's limit)."""
    if scene.n_atoms > MOST_ATOMS:
        raise InputError(f"Scene {scene.name!r} has {scene.n_atoms} atoms; a PDB file holds at most {MOST_ATOMS:,}.")
    angstrom = scene.positions_nm * 10.0
    if scene.n_atoms and (angstrom.min() < _LEAST_A or angstrom.max() > _MOST_A):
        angstrom = angstrom - angstrom.mean(axis=0)
    lines = [f"REMARK   1 surromd scene {scene.name}"]
    for i, (name, element) in enumerate(zip(scene.atom_names, scene.elements, strict=True)):
        res = scene.residue_of_atom[i]
        resid = scene.residue_ids[res]
        number, insertion = (resid[:-1], resid[-1]) if resid and resid[-1].isalpha() else (resid, " ")
        if number.lstrip("-").isdigit():
            number = encode(int(number), 4) or number
        chain = (scene.chain_of_residue[res] or " ")[0]
        lines.append(pdb_atom(i + 1, name, element, scene.residue_names[res], chain, number, angstrom[i], insertion))
    lines.append("TER")
    for i, around in enumerate(scene.neighbours()):
        for start in range(0, len(around), 4):
            row = "".join(f"{j + 1:5d}" for j in around[start : start + 4])
            lines.append(f"CONECT{i + 1:5d}{row}")
    lines.append("END")
    return ("\n".join(lines) + "\n").encode("ascii", "replace").decode()


def topology_path(trajectory: Path) -> Path:
    """Return the path of `NAME.pdb` beside a trajectory."""
    return trajectory.with_suffix(".pdb")


def meta_path(trajectory: Path) -> Path:
    """Return the path of `NAME.meta.h5` beside `NAME.dcd` or `NAME.xtc`."""
    return trajectory.with_suffix(".meta.h5")


def is_our_topology(pdb: Path) -> bool:
    """Whether this PDB file is there and was written by us."""
    try:
        with pdb.open("rb") as file:
            return file.read(len(_OURS)) == _OURS
    except OSError:
        return False


def topology_bytes(scene: Scene) -> bytes:
    """Return what `NAME.pdb` holds; nothing of a scene with more atoms than the format."""
    return pdb_text(scene).encode() if scene.n_atoms <= MOST_ATOMS else b""


def _atoms(pdb: bytes) -> list[bytes]:
    """Return what PDB text says of each atom but where it is."""
    return [line[12:27] for line in pdb.splitlines() if line.startswith((b"ATOM", b"HETATM"))]


def refuse_other_companions(trajectory: Path, topology: bytes = b"") -> None:
    """Raise TrajectoryError where `NAME.pdb` is another program's, or that of a trajectory of other atoms than its new
    text `topology` has, or `NAME.meta.h5` is of another trajectory."""
    pdb, suffix = topology_path(trajectory), trajectory.suffix.lower()
    if pdb.exists() and not is_our_topology(pdb):
        raise TrajectoryError(
            f"{pdb} is not ours and would be replaced by the topology of {trajectory.name}; choose another name for it."
        )
    beside = [p for s in (".h5", ".hdf5", *POSITIONS_ALONE) if (p := trajectory.with_suffix(s)).exists()]
    if topology and pdb.exists() and beside not in ([], [trajectory]) and _atoms(pdb.read_bytes()) != _atoms(topology):
        other = next(p for p in beside if p != trajectory)
        raise TrajectoryError(f"{pdb} is the topology of {other.name}, of other atoms; choose another name.")
    for other in (trajectory.with_suffix(s) for s in POSITIONS_ALONE if suffix in POSITIONS_ALONE and s != suffix):
        if other.exists() and meta_path(other).exists():
            raise TrajectoryError(f"{meta_path(other)} is the record of {other.name}; choose another name.")
