"""Trajectories as objects of MDTraj and MDAnalysis, through memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.cell_shape import lengths_and_angles
from systems.elements import PARTICLE
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import TrajectoryReader, open_trajectory


def to_mdtraj(
    source: str | Path | TrajectoryReader, *, start: int = 0, stop: int | None = None, stride: int = 1
) -> Any:
    """Return frames `start:stop:stride` of a trajectory, a path or one that is open, as an `mdtraj.Trajectory`.

    Positions, times, bonds and the cell are taken over. Raises InputError for a file without topology,
    TrajectoryError for a damaged one.
    """
    import mdtraj

    scene, positions, times, cells = _read(source, start, stop, stride)
    lengths, angles = (None, None) if cells is None else lengths_and_angles(cells)
    return mdtraj.Trajectory(
        positions, scene.to_mdtraj_topology(), time=times, unitcell_lengths=lengths, unitcell_angles=angles
    )


def to_mdanalysis(
    source: str | Path | TrajectoryReader, *, start: int = 0, stop: int | None = None, stride: int = 1
) -> Any:
    """Return frames `start:stop:stride` of a trajectory as an `MDAnalysis.Universe` in memory, in its units (Å, ps).

    Names, elements, masses, charges, residues, chains (segments) and bonds are taken over. Its reader knows one time
    step: frames that are unevenly spaced are refused. Raises InputError, TrajectoryError.
    """
    import MDAnalysis
    from MDAnalysis.coordinates.memory import MemoryReader

    scene, positions, times, cells = _read(source, start, stop, stride)
    gaps = np.diff(times)
    if len(gaps) and not np.allclose(gaps, gaps[0], rtol=1e-6):
        raise InputError(f"frames between {times[0]:g} and {times[-1]:g} ps are unevenly spaced; take a range that is.")
    chains = list(dict.fromkeys(scene.chain_of_residue))
    universe = MDAnalysis.Universe.empty(
        scene.n_atoms,
        n_residues=len(scene.residue_names),
        n_segments=len(chains),
        atom_resindex=scene.residue_of_atom,
        residue_segindex=[chains.index(c) for c in scene.chain_of_residue],
        trajectory=False,
    )
    elements = ["" if e == PARTICLE else e for e in scene.elements]
    attributes = {
        "names": list(scene.atom_names), "types": elements, "elements": elements, "masses": scene.masses_da,
        "formalcharges": scene.formal_charges, "resnames": list(scene.residue_names),
        "resids": np.arange(1, len(scene.residue_names) + 1), "resnums": _numbers(scene), "segids": chains,
    }  # fmt: skip
    for name, values in attributes.items():
        universe.add_TopologyAttr(name, values)
    universe.add_TopologyAttr("bonds", [tuple(pair) for pair in scene.bonds.tolist()])
    dimensions = None
    if cells is not None:
        lengths, angles = lengths_and_angles(cells)
        dimensions = np.concatenate([lengths * 10.0, angles], axis=1).astype(np.float32)
    step_ps = float(gaps[0]) if len(gaps) else 1.0
    first_ps = float(times[0]) if len(times) else 0.0
    universe.load_new(
        positions * np.float32(10.0), format=MemoryReader, order="fac", dimensions=dimensions, dt=step_ps,
        time_offset=first_ps,
    )  # fmt: skip
    return universe


def _read(
    source: str | Path | TrajectoryReader, start: int, stop: int | None, stride: int
) -> tuple[Scene, npt.NDArray[np.float32], npt.NDArray[np.float64], npt.NDArray[np.float64] | None]:
    if not isinstance(source, TrajectoryReader):
        with open_trajectory(source) as reader:
            return _read(reader, start, stop, stride)
    if source.scene is None:
        raise InputError(f"{source.path} carries no topology; open it with top= and convert the reader.")
    positions = source.read(start, stop, stride)
    return source.scene, positions, source.time_ps[start:stop:stride], source.read_cells(start, stop, stride)


def _numbers(scene: Scene) -> list[int]:
    """Residue numbers of the file, its position in the scene where it has none."""
    found = []
    for k, name in enumerate(scene.residue_ids, start=1):
        digits = "".join(c for c in name if c.isdigit())
        found.append(int(digits) if digits else k)
    return found
