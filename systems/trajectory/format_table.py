"""The formats that are read: what a file states, and what its reader would make up where the file says nothing.

The readers go by this table, and the manual prints it (`markdown`). What would be made up is not used: times are then
unknown (`dt_ps`), atoms need `top`, and units that a file does not state are said in a line.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

EVERY, SOME, NONE = "stated", "where stated", "no"


@dataclass(frozen=True)
class Format:
    """One format. `reader`: the library; `mda`: MDAnalysis' name of it, where the suffix does not say.

    `positions`, `times`, `cell`: EVERY, SOME or NONE, as files state them. `units`: of lengths, as the format fixes
    them or files state them. `unit_taken`: the unit that is taken, with a line, where nothing states one. `names`:
    what tells the atoms. `made_up`: what the library puts where a file says nothing. `streamed`: read block by block.
    `tried`: the programs whose files it was tried with, empty where only the reader's own could be had.
    """

    name: str
    suffixes: tuple[str, ...]
    reader: str
    times: str
    units: str
    cell: str
    names: str
    made_up: str = ""
    positions: str = EVERY
    unit_taken: str = ""
    streamed: bool = False
    mda: str | None = None
    tried: str = ""

    @property
    def names_atoms(self) -> bool:
        """Whether atoms are named in the file, so that it needs no `top`."""
        return self.names != NONE


XYZ_SUFFIXES = (".xyz", ".extxyz", ".xyz.gz", ".xyz.bz2", ".extxyz.gz")
_ALL, _BONDS = "names, residues, elements", "names, residues, elements, bonds"
_COUNTED = "times 0, 1, 2, ... ps"
_STEP = "a time step of 1 ps"

FORMATS = (
    Format("surromd's and MDTraj's HDF5", (".h5", ".hdf5"), "surromd", SOME, "as stated", SOME, _BONDS, _COUNTED,
           tried="MDTraj"),
    Format("DCD", (".dcd",), "surromd", SOME, "Å", SOME, NONE, "times of 1 AKMA unit; LAMMPS counts in fs",
           tried="CHARMM, NAMD, OpenMM, cpptraj"),
    Format("XYZ, extended XYZ", XYZ_SUFFIXES, "surromd", NONE, "Å", SOME, "names or elements", _COUNTED,
           tried="ASE, cpptraj"),
    Format("ASE", (".traj",), "ase", NONE, "Å", SOME, "elements", _COUNTED, tried="ASE"),
    Format("XTC", (".xtc",), "MDTraj", EVERY, "nm", SOME, NONE, streamed=True, tried="GROMACS, OpenMM, cpptraj"),
    Format("TRR", (".trr",), "MDTraj", EVERY, "nm", SOME, NONE, "positions of frames that have only velocities",
           positions=SOME, streamed=True, tried="GROMACS, cpptraj"),
    Format("NetCDF (Amber)", (".nc", ".ncdf", ".netcdf"), "MDTraj", SOME, "as stated, else Å", SOME, NONE,
           _COUNTED + "; Å and ps whatever is stated", streamed=True, tried="cpptraj"),
    Format("PDB", (".pdb", ".pdb.gz"), "MDTraj", NONE, "Å", SOME, _BONDS, _COUNTED + "; the first model's atoms",
           tried="OpenMM, cpptraj, the PDB's NMR ensembles"),
    Format("PDBx/mmCIF", (".pdbx", ".cif", ".mmcif", ".pdbx.gz", ".cif.gz", ".mmcif.gz"), "MDTraj", NONE, "Å", SOME,
           _BONDS, _COUNTED, tried="OpenMM, the PDB"),
    Format("GRO", (".gro",), "MDTraj", SOME, "nm", EVERY, "names, residues", _COUNTED + "; the first frame's atoms",
           tried="GROMACS"),
    Format("MOL2", (".mol2",), "MDTraj", NONE, "Å", NONE, _BONDS, _COUNTED, tried="cpptraj"),
    Format("Tinker ARC", (".arc",), "MDTraj", NONE, "Å", SOME, "names, bonds", _COUNTED + "; the first frame's atoms",
           tried="Tinker"),
    Format("Desmond", (".dtr", ".stk"), "MDTraj", EVERY, "Å", EVERY, NONE),
    Format("Amber text", (".mdcrd", ".crd"), "MDTraj", NONE, "Å", SOME, NONE, _COUNTED, tried="cpptraj"),
    Format("Amber restart", (".ncrst",), "MDTraj", SOME, "Å", SOME, NONE, tried="cpptraj"),
    Format("Amber text restart", (".rst7", ".restrt", ".inpcrd"), "MDTraj", NONE, "Å", SOME, NONE, "a time of 0 ps",
           tried="cpptraj, ParmEd"),
    Format("LAMMPS text", (".lammpstrj",), "MDTraj", NONE, NONE, EVERY, NONE, _COUNTED + "; Å", unit_taken="Å",
           tried="LAMMPS"),
    Format("MSMBuilder LH5", (".lh5",), "MDTraj", NONE, "nm", NONE, _ALL, _COUNTED),
    Format("HOOMD XML", (".hoomdxml",), "MDTraj", NONE, NONE, EVERY, "types, bonds",
           _COUNTED + "; nm", unit_taken="nm", tried="HOOMD-blue"),
    Format("OpenMM XML", (".xml",), "MDTraj", NONE, "nm", SOME, NONE, _COUNTED, tried="OpenMM"),
    Format("H5MD", (".h5md",), "surromd", SOME, "as stated", SOME, NONE, _STEP, tried="pyh5md, MDAnalysis"),
    Format("LAMMPS dump", (".lammpsdump", ".dump"), "MDAnalysis", NONE, NONE, EVERY, "elements", _STEP + "; Å",
           unit_taken="Å", mda="LAMMPSDUMP", tried="LAMMPS"),
    Format("TNG", (".tng",), "MDAnalysis", EVERY, "as stated", SOME, NONE, positions=SOME, tried="GROMACS"),
    Format("GROMOS TRC", (".trc",), "MDAnalysis", EVERY, "nm", SOME, NONE, tried="GROMOS11"),
    Format("TRZ", (".trz",), "MDAnalysis", EVERY, "nm", EVERY, NONE, tried="IBIsCO"),
    Format("GSD", (".gsd",), "MDAnalysis", NONE, NONE, EVERY, "types, bonds", _STEP + "; Å", unit_taken="Å",
           tried="HOOMD-blue"),
    Format("DL_POLY", (".history",), "MDAnalysis", NONE, "Å", SOME, "names", _STEP, mda="HISTORY", tried="DL_POLY"),
    Format("DL_POLY configuration", (".config",), "MDAnalysis", NONE, "Å", SOME, "names", _STEP, mda="CONFIG",
           tried="DL_POLY"),
    Format("Tinker XYZ", (".txyz",), "MDAnalysis", NONE, "Å", NONE, "names, bonds", _STEP, tried="Tinker"),
    Format("PQR", (".pqr",), "MDAnalysis", NONE, "Å", NONE, "names, residues", _STEP, tried="PDB2PQR"),
)  # fmt: skip
# Whatever else MDAnalysis reads: nothing is believed beyond positions.
OTHER = Format("any other", (), "MDAnalysis", NONE, "as MDAnalysis reads them", SOME, NONE, _STEP, tried="none")


def format_of(path: Path) -> Format:
    """Return the format that the end of a file's name, or the whole of it (`HISTORY`), stands for, OTHER where no line
    of the table has it."""
    name = "." + path.name.lower()
    return next((f for f in FORMATS if name.endswith(f.suffixes)), OTHER)


def markdown() -> str:
    """Return the table as the manual prints it."""
    head = (
        "format",
        "read by",
        "positions",
        "times",
        "unit of length",
        "cell",
        "atoms",
        "made up, not used",
        "tried with files of",
    )
    rows = [
        (f"{f.name} ({', '.join(f'`{s}`' for s in f.suffixes)})" if f.suffixes else f.name, f.reader, f.positions,
         f.times, f"{f.units}; {f.unit_taken} taken, with a line" if f.unit_taken else f.units, f.cell, f.names,
         f.made_up or "nothing", f.tried or f"{f.reader} alone")
        for f in (*FORMATS, OTHER)
    ]  # fmt: skip
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ("---",) * len(head), *rows))
