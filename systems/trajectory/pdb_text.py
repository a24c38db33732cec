"""A Scene as PDB text. Written here because every bond must stand in it: other programs' order and names survive."""

from __future__ import annotations

from systems.errors import InputError
from systems.prepare.read.hybrid36 import encode
from systems.scene import Scene

MOST_ATOMS = 99_999
# Between these a coordinate in Å fits its columns.
_LEAST_A, _MOST_A = -999.999, 9999.999


def pdb_text(scene: Scene) -> str:
    """Return PDB text in the scene's atom order, with CONECT records for all bonds.

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
    return "\n".join(lines) + "\n"
