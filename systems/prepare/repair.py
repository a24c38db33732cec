"""Missing heavy atoms and hydrogens of standard residues, added by PDBFixer and OpenMM."""

from __future__ import annotations

import contextlib
import io
import random
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.element_data import covalent_radius_nm
from systems.chemistry.residues import template_for
from systems.errors import PreparationError, first_line, listed
from systems.prepare.protonation import TITRATED, asked_hydrogens, protonation_summary
from systems.prepare.read.records import AtomRecord, Bonding, Residue
from systems.prepare.rotamers import resolve_side_chains
from systems.prepare.structure import atom_label

_C_OXT_ANGSTROM = 1.25
_HYDROGEN_ANGSTROM = {"C": 1.09, "N": 1.01, "O": 0.96, "S": 1.34}
_UNKNOWN = "XCC"
_CHAIN_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789"


def complete(
    atoms: Sequence[AtomRecord], bonding: Bonding, *, ph: float
) -> tuple[list[AtomRecord], npt.NDArray[np.int64], list[str]]:
    """Return atoms, bonds and a summary of what was added to structures of residues that are all known by name.

    Heavy atoms of the file keep their positions; hydrogens of residues that had all of theirs keep them too, the others
    get new ones, in the protonation that the file shows or, where it shows none, the usual one at `ph`. Names become
    the standard ones, residues stand in chain order. Raises PreparationError when PDBFixer cannot complete the
    structure.
    """
    from openmm import Platform, app, unit
    from pdbfixer import PDBFixer

    chains = _chains(bonding)
    residues = [r for chain in chains for r in chain]
    text = _heavy_atom_text(atoms, chains)
    neighbours = bonding.neighbours
    closed = {r.key for chain in chains if _is_cycle(chain, bonding) for r in (chain[0], chain[-1])}
    variants = [
        asked_hydrogens(residue, atoms, neighbours, ph=ph, in_cycle=residue.key in closed) for residue in residues
    ]
    reference = Platform.getPlatformByName("Reference")
    try:
        with fixed_random_numbers():
            fixer = PDBFixer(pdbfile=io.StringIO(text), platform=reference)
            fixer.missingResidues = {}
            fixer.findMissingAtoms()
            _forget_linked(fixer, residues)
            fixer.addMissingAtoms(seed=1)
            _add_bonds(fixer.topology, residues, bonding.bonds)
            rebuilt = _without_overlaps(fixer, residues)
            modeller = app.Modeller(fixer.topology, fixer.positions)
            modeller.addHydrogens(pH=ph, variants=variants, platform=reference)
    except PreparationError:
        raise
    except Exception as error:  # PDBFixer and OpenMM raise bare Exceptions, KeyErrors and ValueErrors alike
        raise PreparationError(f"PDBFixer could not complete the structure ({first_line(error)}).") from error
    positions_nm = np.array(modeller.positions.value_in_unit(unit.nanometer), dtype=np.float64)
    records, bonds = records_from_openmm(modeller.topology, positions_nm, [r.key for r in residues])
    _refuse_lost_bonds(records, bonds, atoms, bonding)
    names = {(r.key, a) for r in residues for a in r.heavy}
    records = _with_usual_lengths(records, bonds, names)
    records = _keep_hydrogens(records, bonds, atoms, bonding)
    summary = _summary(residues, records, ph) + rebuilt
    replaced = _with_replaced_hydrogens(residues, records, atoms)
    if replaced:
        summary.append(f"hydrogens of the file replaced on {listed(replaced)}: their atoms have others now")
    summary += protonation_summary([r.label for r in residues], [r.key for r in residues], variants, records, ph)
    if [a.name for a in records if a.element != "H"] != [a.name for a in atoms if a.element != "H"]:
        summary.append("atoms stand in the standard order under their standard names")
    return records, bonds, summary


def _forget_linked(fixer: Any, residues: Sequence[Residue]) -> None:
    """Take from PDBFixer's list what is not missing: a residue bonded to another one has lost an atom for it."""
    for residue, built in zip(residues, fixer.topology.residues(), strict=True):
        if "OXT" not in residue.missing:
            fixer.missingTerminals.pop(built, None)
        if built in fixer.missingAtoms:
            fixer.missingAtoms[built] = [a for a in fixer.missingAtoms[built] if a.name in residue.missing]


def _add_bonds(topology: Any, residues: Sequence[Residue], bonds: npt.NDArray[np.int64]) -> None:
    """Add the bonds of heavy atoms that OpenMM does not know by the names of residues."""
    built = [{a.name: a for a in residue.atoms()} for residue in topology.residues()]
    place = {i: at[name] for r, at in zip(residues, built, strict=True) for name, i in r.heavy.items() if name in at}
    known = {frozenset((a, b)) for a, b in topology.bonds()}
    for i, j in bonds.tolist():
        if i in place and j in place and frozenset((place[i], place[j])) not in known:
            topology.addBond(place[i], place[j])


def _without_overlaps(fixer: Any, residues: Sequence[Residue]) -> list[str]:
    """Turn added side chains that stand in other atoms; return a line for each. Raises PreparationError."""
    from openmm import unit

    if not any(r.missing for r in residues):
        return []
    topology = fixer.topology
    elements = [a.element.symbol for a in topology.atoms()]
    positions_nm = np.array(fixer.positions.value_in_unit(unit.nanometer), dtype=np.float64)
    sites = [{a.name: a.index for a in residue.atoms()} for residue in topology.residues()]
    notes = resolve_side_chains(
        positions_nm,
        elements,
        [(a.index, b.index) for a, b in topology.bonds()],
        [
            (r.label, r.template.name, at, r.missing if r.template.is_amino_acid else ())
            for r, at in zip(residues, sites, strict=True)
            if r.template is not None
        ],
    )
    if notes:
        fixer.positions = positions_nm * unit.nanometer
    return notes


def records_from_openmm(
    topology: Any, positions_nm: npt.NDArray[np.float64], keys: Sequence[tuple[str, str, str]]
) -> tuple[list[AtomRecord], npt.NDArray[np.int64]]:
    """Return records and bonds of an OpenMM topology whose residues are `keys` (chain, number, name), in that order."""
    records = []
    for residue, (chain, number, name) in zip(topology.residues(), keys, strict=True):
        for atom in residue.atoms():
            x, y, z = (positions_nm[atom.index] * 10.0).tolist()
            records.append(
                AtomRecord(
                    serial=str(atom.index + 1),
                    name=atom.name,
                    altloc="",
                    residue_name=name,
                    chain=chain,
                    residue_id=number,
                    position_angstrom=(x, y, z),
                    occupancy=1.0,
                    element=atom.element.symbol,
                    hetero=False,
                )
            )
    bonds = {(min(a.index, b.index), max(a.index, b.index)) for a, b in topology.bonds()}
    return records, np.array(sorted(bonds), dtype=np.int64).reshape(-1, 2)


@contextlib.contextmanager
def fixed_random_numbers() -> Iterator[None]:
    """Make OpenMM's Modeller, which draws from Python's global generator, repeatable; then puts it back."""
    state = random.getstate()
    random.seed(1)
    try:
        yield
    finally:
        random.setstate(state)


def _chains(bonding: Bonding) -> list[list[Residue]]:
    """Residues as peptide bonds join them, from first to last, whatever their order in the file.

    A cycle is opened between residues that have no protonation to be settled, where it can be.
    """
    of_atom = {i: k for k, r in enumerate(bonding.residues) for i in r.atoms}
    following = {of_atom[c]: of_atom[n] for c, n in bonding.peptide_bonds}
    before = {n: c for c, n in following.items()}

    def burden(k: int) -> int:
        ends = (bonding.residues[k].template, bonding.residues[before.get(k, k)].template)
        return sum(t is not None and t.name in TITRATED for t in ends)

    starts = [k for k in range(len(bonding.residues)) if k not in before]
    chains: list[list[Residue]] = []
    seen: set[int] = set()
    for start in [*starts, *sorted(before, key=burden)]:
        chain, k = [], start
        while k >= 0 and k not in seen:
            seen.add(k)
            chain.append(bonding.residues[k])
            k = following.get(k, -1)
        if chain:
            chains.append(chain)
    return chains


def _is_cycle(chain: Sequence[Residue], bonding: Bonding) -> bool:
    return (chain[-1].heavy.get("C", -1), chain[0].heavy.get("N", -1)) in bonding.peptide_bonds


def _heavy_atom_text(atoms: Sequence[AtomRecord], chains: Sequence[Sequence[Residue]]) -> str:
    lines: list[str] = []
    number = 0
    for k, chain in enumerate(chains):
        letter = _CHAIN_LETTERS[k % len(_CHAIN_LETTERS)]
        for residue in chain:
            number += 1
            name_of = {i: a for a, i in residue.heavy.items()}
            residue_name = _name_for_openmm(residue)
            for i in residue.atoms:
                atom = atoms[i]
                if atom.element == "H":
                    continue
                name = name_of.get(i, atom.name)
                padded = name[:4] if len(name) >= 4 or len(atom.element) == 2 else f" {name}"
                head = f"ATOM  {len(lines) % 100000:5d} {padded:<4s} {residue_name[:3]:>3s} {letter}{number % 10000:4d}"
                x, y, z = atom.position_angstrom
                lines.append(f"{head}    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00          {atom.element.upper():>2s}")
            for name, (x, y, z) in _built(residue, atoms).items():
                head = f"ATOM  {len(lines) % 100000:5d}  {name:<3s} {residue_name[:3]:>3s} {letter}{number % 10000:4d}"
                lines.append(f"{head}    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00           {name[0]}")
        lines.append("TER")
    return "\n".join([*lines, "END", ""])


def _name_for_openmm(residue: Residue) -> str:
    """The standard name; for a component one that OpenMM knows nothing about, and therefore leaves alone."""
    standard = template_for(residue.key[2])
    return _UNKNOWN if standard is None else standard.name


def _built(residue: Residue, atoms: Sequence[AtomRecord]) -> dict[str, list[float]]:
    """Positions in Å of a missing CB (of an L residue) and OXT, from the backbone.

    PDBFixer superposes its template on N, CA, C and O, which are nearly in one plane, and then and now comes out with a
    D residue; an OXT it adds may stand 3 Å from its carbon.
    """
    heavy = {a: np.array(atoms[i].position_angstrom) for a, i in residue.heavy.items()}
    out: dict[str, list[float]] = {}
    if "CB" in residue.missing and {"N", "CA", "C"} <= set(heavy):
        b, d = heavy["CA"] - heavy["N"], heavy["C"] - heavy["CA"]
        # Ideal geometry: the coefficients of ProteinMPNN (Dauparas et al., Science 378, 49, 2022).
        out["CB"] = (-0.58273431 * np.cross(b, d) + 0.56802827 * b - 0.54067466 * d + heavy["CA"]).tolist()
    if "OXT" in residue.missing and {"CA", "C", "O"} <= set(heavy):
        away = sum((heavy["C"] - heavy[a]) / np.linalg.norm(heavy["C"] - heavy[a]) for a in ("CA", "O"))
        out["OXT"] = (heavy["C"] + _C_OXT_ANGSTROM * away / np.linalg.norm(away)).tolist()
    return out


def _with_usual_lengths(
    records: list[AtomRecord], bonds: npt.NDArray[np.int64], kept: set[tuple[tuple[str, str, str], str]]
) -> list[AtomRecord]:
    """Put each added hydrogen at the usual distance from its atom (Modeller leaves some 10 % too much), and on a carbon
    with two other neighbours into their plane (beside residues that it does not know Modeller may not find it); refuse
    heavy atoms that were put nowhere near theirs. `kept`: residue and name of the atoms that the file had.
    """
    out = list(records)
    neighbours: dict[int, list[int]] = {}
    for a, b in bonds.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    for i, j in bonds.tolist():
        if records[i].element == "H":
            i, j = j, i
        if {(records[k].residue_key, records[k].name) for k in (i, j)} <= kept:
            continue
        x, y = (np.array(records[k].position_angstrom) for k in (i, j))
        length = float(np.linalg.norm(y - x))
        usual = _HYDROGEN_ANGSTROM.get(records[i].element)
        if records[j].element == "H" and usual is not None and length > 0:
            away = (y - x) / length
            others = [np.array(records[k].position_angstrom) - x for k in neighbours[i] if records[k].element != "H"]
            if records[i].element == "C" and len(neighbours[i]) == 3 and len(others) == 2:
                away = -sum(arm / np.linalg.norm(arm) for arm in others)
                away = away / np.linalg.norm(away)
            x_new, y_new, z_new = (x + usual * away).tolist()
            out[j] = replace(records[j], position_angstrom=(x_new, y_new, z_new))
            continue
        expected = 10.0 * (covalent_radius_nm(records[i].element) + covalent_radius_nm(records[j].element))
        if not 0.75 * expected < length < 1.25 * expected:
            raise PreparationError(
                f"{atom_label(records[i])} and {atom_label(records[j])} came out {length:.2f} Å apart when missing "
                "atoms were added; give the residue with all its heavy atoms."
            )
    return out


def _refuse_lost_bonds(
    records: Sequence[AtomRecord],
    bonds: npt.NDArray[np.int64],
    atoms: Sequence[AtomRecord],
    bonding: Bonding,
) -> None:
    """Every heavy-atom bond of the file must be there after the repair: cross-links other than disulfides are not."""
    name_of = {i: (r.key, a) for r in bonding.residues for a, i in r.heavy.items()}
    made = {frozenset((a.residue_key, a.name) for a in (records[i], records[j])) for i, j in bonds.tolist()}
    for i, j in bonding.bonds.tolist():
        if i in name_of and j in name_of and frozenset((name_of[i], name_of[j])) not in made:
            raise PreparationError(
                f"atoms are missing, and the bond {atom_label(atoms[i])} - {atom_label(atoms[j])} would be lost in "
                "adding them; give the structure with all hydrogens."
            )


def _keep_hydrogens(
    records: list[AtomRecord], bonds: npt.NDArray[np.int64], atoms: Sequence[AtomRecord], bonding: Bonding
) -> list[AtomRecord]:
    """Put the file's hydrogens back where a heavy atom has as many as before."""
    whole = {r.key: r for r in bonding.residues if r.heavy and not r.lacks_hydrogens}
    old_at: dict[int, list[int]] = {}
    for i, j in bonding.bonds.tolist():
        for a, b in ((i, j), (j, i)):
            if atoms[b].element == "H":
                old_at.setdefault(a, []).append(b)
    new_at: dict[int, list[int]] = {}
    for i, j in bonds.tolist():
        for a, b in ((i, j), (j, i)):
            if records[b].element == "H":
                new_at.setdefault(a, []).append(b)
    out = list(records)
    for parent, new in new_at.items():
        residue = whole.get(records[parent].residue_key)
        old = old_at.get(residue.heavy.get(records[parent].name, -1), []) if residue is not None else []
        if len(old) != len(new):
            continue
        chosen = min(permutations(old), key=lambda p: _distance(p, new, atoms, records))
        for a, b in zip(new, chosen, strict=True):
            out[a] = replace(records[a], position_angstrom=atoms[b].position_angstrom)
    return out


def _with_replaced_hydrogens(
    residues: Sequence[Residue], records: Sequence[AtomRecord], atoms: Sequence[AtomRecord]
) -> list[str]:
    """Labels of residues that had all their hydrogens and did not keep them: an end that became one, say."""
    kept = {(a.residue_key, a.position_angstrom) for a in records if a.element == "H"}
    return [
        r.label
        for r in residues
        if not r.lacks_hydrogens
        and any(atoms[i].element == "H" and (r.key, atoms[i].position_angstrom) not in kept for i in r.atoms)
    ]


def _distance(old: Sequence[int], new: Sequence[int], atoms: Sequence[AtomRecord], records: list[AtomRecord]) -> float:
    gaps = [
        np.subtract(atoms[i].position_angstrom, records[j].position_angstrom) for i, j in zip(old, new, strict=True)
    ]
    return float(np.square(gaps).sum())


def _summary(residues: Sequence[Residue], records: Sequence[AtomRecord], ph: float) -> list[str]:
    notes = []
    for residue in residues:
        if residue.missing:
            end = " (the chain ends here, as a carboxylate)" if "OXT" in residue.missing else ""
            notes.append(f"{residue.label}: added {' '.join(residue.missing)}{end}")
    short = [r.label for r in residues if r.lacks_hydrogens]
    by_dictionary = [r.label for r in residues if r.lacks_hydrogens and template_for(r.key[2]) is None]
    if by_dictionary:
        notes.append(
            f"their hydrogens by the chemical component dictionary, groups charged as at pH {ph:g}: "
            f"{listed(by_dictionary)}"
        )
    if short:
        of_short = {r.key for r in residues if r.lacks_hydrogens}
        n = sum(a.element == "H" and a.residue_key in of_short for a in records)
        notes.append(f"hydrogens placed on {listed(short)}: {n}")
    return notes
