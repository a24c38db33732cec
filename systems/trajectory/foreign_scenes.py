"""What other programs' files state, what their readers would make up, and scenes from the topologies that they hold.

`FORMATS` is the table that the readers go by. What would be made up is not used: times are then unknown (`dt_ps`),
atoms need `top`, and units that a file does not state are said in a line.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.bond_orders import ValenceError, perceive
from systems.chemistry.distance_bonds import with_bonds_by_distance
from systems.chemistry.element_data import atomic_weight_da, element_symbol
from systems.errors import InputError, TrajectoryError, first_line
from systems.prepare.structure_text import read_structure
from systems.scene import IntArray, Scene

_NM = {"nanometer": 1.0, "nm": 1.0, "angstrom": 0.1, "a": 0.1, "å": 0.1, "bohr": 0.0529177210903, "pm": 1e-3}
_PS = {"picosecond": 1.0, "ps": 1.0, "femtosecond": 1e-3, "fs": 1e-3, "nanosecond": 1e3, "ns": 1e3, "microsecond": 1e6,
       "us": 1e6, "second": 1e12, "s": 1e12}  # fmt: skip


def nm_per(unit: Any) -> float | None:
    """Return the unit of length in nm, None for an unknown one."""
    return _NM.get(_name(unit))


def ps_per(unit: Any) -> float | None:
    """Return the unit of time in ps, None for an unknown one."""
    return _PS.get(_name(unit))


def _name(unit: Any) -> str:
    name = (unit.decode(errors="replace") if isinstance(unit, bytes) else str(unit)).strip().lower()
    return name[:-1] if len(name) > 2 and name.endswith("s") else name


# ---- the formats that are read --------------------------------------------------------------------------------------


EVERY, SOME, NONE = "stated", "where stated", "no"


@dataclass(frozen=True)
class Format:
    """One format, as the manual's table has it (docs/files.md), which also says what its library makes up. `times`:
    EVERY, SOME or NONE, as files state them. `names_atoms`: whether it needs no `top`. `unit_taken`: the unit that is
    taken, with a line, where nothing states one. `mda`: MDAnalysis' name of it, where the suffix does not say."""

    name: str
    suffixes: tuple[str, ...]
    reader: str
    times: str
    names_atoms: bool
    unit_taken: str = ""
    mda: str | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        said = f"a {self.name} file states no unit of length; {self.unit_taken} is taken."
        return (said,) if self.unit_taken else ()


XYZ_SUFFIXES = (".xyz", ".extxyz", ".xyz.gz", ".xyz.bz2", ".extxyz.gz")
FORMATS = (
    Format("surromd's and MDTraj's HDF5", (".h5", ".hdf5"), "surromd", SOME, True),
    Format("DCD", (".dcd",), "surromd", SOME, False),
    Format("XYZ, extended XYZ", XYZ_SUFFIXES, "surromd", NONE, True),
    Format("ASE", (".traj",), "ase", NONE, True),
    Format("XTC", (".xtc",), "MDTraj", EVERY, False),
    Format("TRR", (".trr",), "MDTraj", EVERY, False),
    Format("NetCDF (Amber)", (".nc", ".ncdf", ".netcdf"), "MDTraj", SOME, False),
    Format("PDB", (".pdb", ".pdb.gz"), "MDTraj", NONE, True),
    Format("PDBx/mmCIF", (".pdbx", ".cif", ".mmcif", ".pdbx.gz", ".cif.gz", ".mmcif.gz"), "MDTraj", NONE, True),
    Format("GRO", (".gro",), "MDTraj", SOME, True),
    Format("MOL2", (".mol2",), "MDTraj", NONE, True),
    Format("Tinker ARC", (".arc",), "MDTraj", NONE, True),
    Format("Desmond", (".dtr", ".stk"), "MDTraj", EVERY, False),
    Format("Amber text", (".mdcrd", ".crd"), "MDTraj", NONE, False),
    Format("Amber restart", (".ncrst",), "MDTraj", SOME, False),
    Format("Amber text restart", (".rst7", ".restrt", ".inpcrd"), "MDTraj", NONE, False),
    Format("LAMMPS text", (".lammpstrj",), "MDTraj", NONE, False, unit_taken="Å"),
    Format("MSMBuilder LH5", (".lh5",), "MDTraj", NONE, True),
    Format("HOOMD XML", (".hoomdxml",), "MDTraj", NONE, True, unit_taken="nm"),
    Format("OpenMM XML", (".xml",), "MDTraj", NONE, False),
    Format("H5MD", (".h5md",), "surromd", SOME, False),
    Format("LAMMPS dump", (".lammpsdump", ".dump"), "MDAnalysis", NONE, True, unit_taken="Å", mda="LAMMPSDUMP"),
    Format("TNG", (".tng",), "MDAnalysis", EVERY, False),
    Format("GROMOS TRC", (".trc",), "MDAnalysis", EVERY, False),
    Format("TRZ", (".trz",), "MDAnalysis", EVERY, False),
    Format("GSD", (".gsd",), "MDAnalysis", NONE, True, unit_taken="Å"),
    Format("DL_POLY", (".history",), "MDAnalysis", NONE, True, mda="HISTORY"),
    Format("DL_POLY configuration", (".config",), "MDAnalysis", NONE, True, mda="CONFIG"),
    Format("Tinker XYZ", (".txyz",), "MDAnalysis", NONE, True),
    Format("PQR", (".pqr",), "MDAnalysis", NONE, True),
)
# Whatever else MDAnalysis reads: nothing is believed beyond positions.
OTHER = Format("any other", (), "MDAnalysis", NONE, False)


def format_of(path: Path) -> Format:
    """Return the format that the end of a file's name, or the whole of it (`HISTORY`), stands for, OTHER where no line
    of the table has it."""
    name = "." + path.name.lower()
    return next((f for f in FORMATS if name.endswith(f.suffixes)), OTHER)


# ---- scenes from topologies -----------------------------------------------------------------------------------------


def scene_from_mdtraj_topology(
    topology: Any,
    positions_nm: npt.ArrayLike,
    *,
    name: str = "trajectory",
    source: str = "",
    elements: Sequence[str] | None = None,
) -> Scene:
    """Return a Scene with the atoms, bonds and bond orders of an `mdtraj.Topology`, at positions `(n_atoms, 3)` nm.
    `elements` replaces the topology's. Where no bond order is stated, orders and charges are perceived; they stay 0
    where the bonds fit no valence (missing hydrogens). Raises InputError when the numbers of atoms differ."""
    positions = np.array(positions_nm, dtype=np.float64)
    if positions.shape != (topology.n_atoms, 3):
        raise InputError(f"{source or name}: {topology.n_atoms} atoms in the topology, positions {positions.shape}.")
    atoms, residues = list(topology.atoms), list(topology.residues)
    rows = sorted(
        (min(b.atom1.index, b.atom2.index), max(b.atom1.index, b.atom2.index), float(b.order or b.type or 0))
        for b in topology.bonds
    )
    symbols = list(elements) if elements is not None else [a.element.symbol if a.element else "VS" for a in atoms]
    bonds = np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2)
    orders = np.array([row[2] for row in rows], dtype=np.float64)
    numbers = [r.resSeq for r in residues]
    if numbers == list(range(len(residues))):  # no numbers were stated; people count from one
        numbers = [n + 1 for n in numbers]
    charges = np.array([getattr(a, "formal_charge", None) or 0 for a in atoms], dtype=np.int64)
    if not orders.any():
        with contextlib.suppress(ValenceError):
            orders, charges = perceive(symbols, bonds)
    return Scene(
        name=name,
        atom_names=tuple(a.name for a in atoms),
        elements=tuple(symbols),
        residue_of_atom=np.array([a.residue.index for a in atoms], dtype=np.int64),
        residue_names=tuple(r.name for r in residues),
        residue_ids=tuple(map(str, numbers)),
        chain_of_residue=tuple(str(r.chain.chain_id or chr(ord("A") + r.chain.index % 26)) for r in residues),
        bonds=bonds,
        bond_orders=orders,
        formal_charges=charges,
        masses_da=np.array([_mass_da(s, a) for s, a in zip(symbols, atoms, strict=True)], dtype=np.float64),
        positions_nm=positions,
        provenance={"source": source} if source else {},
    )


def scene_of_mdtraj_hdf5(path: Path, positions_nm: npt.ArrayLike) -> Scene:
    """Return the Scene of MDTraj's topology in an HDF5 file. Raises TrajectoryError when it is damaged."""
    from mdtraj.formats import HDF5TrajectoryFile

    try:
        with warnings.catch_warnings(), HDF5TrajectoryFile(str(path)) as file:
            warnings.simplefilter("ignore")  # a topology may number no residues
            topology = file.topology
    except Exception as error:  # PyTables and MDTraj raise errors of their own
        raise TrajectoryError(f"{path} is damaged: its /topology cannot be understood ({error}).") from error
    return scene_from_mdtraj_topology(topology, positions_nm, name=path.stem, source=path.name)


def scene_from_structure(top: Path, *, name: str) -> Scene:
    """Return the Scene of a structure or topology file given with a trajectory, by MDTraj or MDAnalysis.

    Bonds are MDTraj's (its residue templates and CONECT records); atoms that it leaves without one are bonded by their
    distances. Elements of PDB and mmCIF files are read here: where the element column is empty MDTraj takes CA for
    calcium and HG for mercury. Files without positions (PSF, prmtop) give positions of zero.
    Raises InputError when neither library reads the file.
    """
    import mdtraj

    if not is_mdtraj_format(top) or top.suffix.lower() in (".xyz", ".gsd"):
        if top.suffix.lower() in (".psf", ".prmtop", ".parm7", ".top"):
            with contextlib.suppress(Exception):  # MDAnalysis is asked next, and says what is wrong
                bare = mdtraj.load_topology(str(top))
                return scene_from_mdtraj_topology(bare, np.zeros((bare.n_atoms, 3)), name=name, source=top.name)
        return scene_from_universe(top, name=name)
    try:
        structure = mdtraj.load(str(top))
    except Exception as error:  # each MDTraj reader raises errors of its own
        raise InputError(f"{top} cannot be read as a structure: {first_line(error)}.") from error
    topology = structure.topology
    elements = None
    with contextlib.suppress(InputError):
        records = read_structure(top).atoms
        # MDTraj renames atoms, so only positions show whether both readers kept the same ones.
        read_nm = np.array([r.position_angstrom for r in records]) / 10.0
        if read_nm.shape == structure.xyz[0].shape and np.allclose(read_nm, structure.xyz[0], atol=1e-4):
            elements = [r.element for r in records]
    scene = scene_from_mdtraj_topology(topology, structure.xyz[0], name=name, source=top.name, elements=elements)
    return with_bonds_by_distance(scene)


def scene_from_universe(top: Path, *, name: str) -> Scene:
    """Return the Scene of a topology that MDAnalysis reads (TPR, GSD, XYZ, LAMMPS data, ...). Bonds are the file's, or
    by covalent radii where it holds none; positions are zero where it holds none. Raises InputError when it cannot be
    read, or an element is not known."""
    import MDAnalysis

    format_ = "XYZ" if top.suffix.lower() == ".extxyz" else format_of(top).mda
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            universe = MDAnalysis.Universe(str(top), **({} if format_ is None else {"topology_format": format_}))
    except Exception as error:  # each of its parsers raises errors of its own
        raise InputError(f"{top} cannot be read as a topology: {first_line(error)}.") from error
    atoms = universe.atoms
    has_positions = hasattr(universe, "trajectory") and universe.trajectory.n_frames > 0
    angstrom = atoms.positions if has_positions else np.zeros((len(atoms), 3))
    # What the topology does not say is an AttributeError of MDAnalysis.
    names = [str(x) for x in getattr(atoms, "names", getattr(atoms, "types", ["X"] * len(atoms)))]
    residues = [str(x) for x in getattr(atoms.residues, "resnames", ["UNK"] * len(atoms.residues))]
    of_atom = np.unique(atoms.resindices, return_inverse=True)[1].astype(np.int64)
    written = [str(x) for x in getattr(atoms, "elements", [""] * len(atoms))]
    elements = []
    for i, (atom, element) in enumerate(zip(names, written, strict=True)):
        # XYZ files hold symbols or PDB names: CA in capitals is an alpha carbon, which MDAnalysis takes for calcium.
        guessed = "xyz" in top.suffix.lower() and len(element) == 2 and atom.isupper() and atom not in ("CL", "BR")
        symbol = element_symbol(atom, residues[of_atom[i]], "" if guessed else element)
        if symbol is None:
            raise InputError(f"{top}: the element of atom {i} ({atom}) is not known; give a PDB file with `top`.")
        elements.append(symbol)
    bonds = np.empty((0, 2), dtype=np.int64)
    if hasattr(atoms, "bonds"):
        bonds = np.unique(np.sort(np.asarray(atoms.bonds.to_indices()).reshape(-1, 2), axis=1), axis=0).astype(np.int64)
    ids = [str(x) for x in getattr(atoms.residues, "resids", range(1, len(residues) + 1))]
    positions_nm = np.asarray(angstrom, dtype=np.float64) * _NM["angstrom"]
    scene = _scene_of_names(top, names, elements, positions_nm, of_atom, residues, ids, bonds)
    return with_orders(with_bonds_by_distance(replace(scene, name=name)))


def is_mdtraj_format(path: Path) -> bool:
    """Whether MDTraj has a reader for files of this suffix."""
    return format_of(path).reader in ("MDTraj", "surromd")


def named_scene(
    path: Path,
    names: Sequence[str],
    elements: Sequence[str],
    positions_nm: npt.ArrayLike,
    cell_nm: npt.ArrayLike | None,
) -> Scene:
    """Return the Scene of atoms that a file only names, one residue; bonds by distance, across the cell `(3, 3)` nm
    too, orders by valence."""
    one, no_bonds = np.zeros(len(elements), dtype=np.int64), np.empty((0, 2), dtype=np.int64)
    scene = _scene_of_names(path, names, elements, positions_nm, one, ["MOL"], ["1"], no_bonds)
    return with_orders(with_bonds_by_distance(scene, cell_nm))


def _scene_of_names(
    path: Path,
    names: Sequence[str],
    elements: Sequence[str],
    positions_nm: npt.ArrayLike,
    residue_of_atom: IntArray,
    residue_names: Sequence[str],
    residue_ids: Sequence[str],
    bonds: IntArray,
) -> Scene:
    """Return the Scene of one chain; bond orders and charges are 0."""
    return Scene(
        name=path.stem,
        atom_names=tuple(names),
        elements=tuple(elements),
        residue_of_atom=residue_of_atom,
        residue_names=tuple(residue_names),
        residue_ids=tuple(residue_ids),
        chain_of_residue=("A",) * len(residue_names),
        bonds=bonds,
        bond_orders=np.zeros(len(bonds)),
        formal_charges=np.zeros(len(elements), dtype=np.int64),
        masses_da=np.array([atomic_weight_da(e) for e in elements]),
        positions_nm=np.asarray(positions_nm, dtype=np.float64),
        provenance={"source": path.name},
    )


def _mass_da(symbol: str, atom: Any) -> float:
    try:
        return atomic_weight_da(symbol)
    except KeyError:  # an element without a table entry, or a virtual site
        return float(atom.element.mass) if atom.element is not None else 0.0


def bonds_completed(scene: Scene, cells_nm: npt.NDArray[np.float64] | None) -> Scene:
    """Return the scene with bonds by distance where residues lack them, and orders then; cells `(1, 3, 3)` nm."""
    completed = with_bonds_by_distance(scene, None if cells_nm is None else cells_nm[0])
    return scene if len(completed.bonds) == len(scene.bonds) else with_orders(completed)


def with_orders(scene: Scene) -> Scene:
    """Return the scene with bond orders and charges by valence, unchanged where they cannot be perceived."""
    try:
        orders, charges = perceive(list(scene.elements), scene.bonds)
    except ValenceError:
        return scene
    return replace(scene, bond_orders=orders, formal_charges=charges)
