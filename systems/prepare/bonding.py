"""Bonds of a structure file: from residue templates, CONECT records or distances; and what is missing from it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from systems.chemistry.distance_bonds import refuse_long_bonds
from systems.chemistry.element_data import covalent_radius_nm, is_lone_ion, is_metal
from systems.chemistry.geometry import near_pairs
from systems.chemistry.residues import (
    PH_OF_FEWEST,
    ResidueTemplate,
    canonical_heavy_name,
    component,
    hydrogens_of,
    known_template,
    template_for,
)
from systems.errors import PreparationError, listed
from systems.prepare.records import AtomRecord, Bonding, Residue, by_residue
from systems.scene import FloatArray, IntArray, neighbours_of

_PEPTIDE_NM = 0.20
_DISULFIDE_NM = 0.25
_HYDROGEN_NM = 0.16
_AMINE_NM = 0.16
_AMIDE_NM = 0.145
_PHOSPHATE_NM = 0.175
_THIOETHER_NM = 0.19
_GLYCOSIDE_NM = 0.155
_TOLERANCE_NM = 0.04
_COINCIDENT_NM = 0.03
_CONECT_SLACK_NM = 0.1


def find_bonds(
    atoms: Sequence[AtomRecord], conect: Sequence[tuple[int, int]], chain_ends: Collection[int] = ()
) -> Bonding:
    """Return the bonds of these atoms.

    Standard residues take heavy-atom bonds from their template, hydrogens go to the nearest heavy atom, peptide and
    disulfide bonds are found by distance. All other residues take CONECT records if these reach each of their atoms,
    distances within 0.04 nm of the sum of covalent radii if not; to other residues only the bonds that link polymers.
    Monatomic ions have no bonds by distance, and metal ions none at all. Peptide bonds across one of the `chain_ends`
    (atoms that TER follows) are noted. Raises PreparationError for atoms that coincide, bonds of templates that are too
    long to be any, and hydrogens far from everything.
    """
    x = np.array([a.position_angstrom for a in atoms], dtype=np.float64) / 10.0
    near = near_pairs(x, 0.35, "the structure")
    length = np.linalg.norm(x[near[:, 0]] - x[near[:, 1]], axis=1)
    for (i, j), d in zip(near.tolist(), length.tolist(), strict=True):
        if d < _COINCIDENT_NM:
            raise PreparationError(
                f"{atoms[i].label} and {atoms[j].label} stand on one point ({d * 10:.2f} Å apart); remove one of them."
            )
    residues = _residues(atoms)
    ions = {i for r in residues if are_ions([atoms[i] for i in r.atoms]) for i in r.atoms}
    of_atom = {i: r for r in residues for i in r.atoms}
    bonds: set[tuple[int, int]] = set()
    notes: list[str] = []
    for residue in residues:
        if residue.heavy and residue.template is not None:
            names = [*residue.template.bonds, *([("C", "OXT")] if "OXT" in residue.heavy else [])]
            bonds |= {_pair(residue.heavy[a], residue.heavy[b]) for a, b in names if {a, b} <= set(residue.heavy)}
    refuse_long_bonds([a.element for a in atoms], x, np.array(sorted(bonds), dtype=np.int64), lambda i: atoms[i].label)
    peptide = _peptide_bonds(near, length, of_atom)
    bonds |= {_pair(c, n) for c, n in peptide}
    metals = {i for i in ions if is_metal(atoms[i].element)}
    bonds |= _accepted_conect(atoms, x, conect, of_atom, metals, notes)
    free = _free_atoms(residues, bonds, notes)
    _note_bonds_across_ends(peptide, of_atom, chain_ends, notes)
    bonds |= _bonds_by_distance(atoms, near, length, free, ions, bonds, notes)
    to_parents, strays = _hydrogen_bonds_to_parents(atoms, x, bonds, of_atom, free, ions)
    bonds |= to_parents
    bonds |= _disulfides(atoms, near, length, bonds, of_atom)
    bonds |= _links_of_components(atoms, near, length, of_atom, ions)
    bonded = np.array(sorted(bonds), dtype=np.int64).reshape(-1, 2)
    _note_missing(residues, atoms, bonded)
    for i, error in strays.items():
        if not of_atom[i].missing:
            raise error
    if strays:
        notes.append(f"hydrogens left out whose atoms are missing: {listed([atoms[i].label for i in strays])}")
    unmade = [
        f"{atoms[i].label} - {atoms[j].label} ({10 * np.linalg.norm(x[i] - x[j]):.2f} Å)"
        for i, j in conect
        if _pair(i, j) not in bonds and not {i, j} & metals
    ]
    return Bonding(bonded, residues, notes, peptide, unmade)


def are_ions(atoms: Sequence[AtomRecord]) -> bool:
    """Whether the atoms of a residue are monatomic ions: one, or several of one name under one number."""
    return is_lone_ion(atoms[0].element) and len({a.name for a in atoms}) == 1


def _pair(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)


def _residues(atoms: Sequence[AtomRecord]) -> list[Residue]:
    residues = []
    for key, members in by_residue(atoms).items():
        residue = Residue(key, members, known_template(key[2]))
        if residue.template is not None:
            heavy: dict[str, int] = {}
            fits = True
            found = component(key[2]) if template_for(key[2]) is None else None
            element = {} if found is None else dict(zip(found.heavy, found.elements, strict=True))
            for i in members:
                if atoms[i].element != "H":
                    name = canonical_heavy_name(residue.template, atoms[i].name)
                    fits = fits and name is not None and name not in heavy
                    fits = fits and element.get(name or "", (name or " ")[0]) == atoms[i].element
                    heavy[name or ""] = i
            if fits:
                residue.heavy = heavy
            elif template_for(key[2]) is None:
                residue.template = None  # another molecule under the name of a component
        residues.append(residue)
    return residues


def _peptide_bonds(near: IntArray, length: FloatArray, of_atom: dict[int, Residue]) -> set[tuple[int, int]]:
    best: dict[int, tuple[float, int]] = {}
    for (i, j), d in zip(near.tolist(), length.tolist(), strict=True):
        if d >= _PEPTIDE_NM or of_atom[i] is of_atom[j]:
            continue
        for c, n in ((i, j), (j, i)):
            is_carbonyl = of_atom[c].heavy.get("C") == c and "O" in of_atom[c].heavy
            if is_carbonyl and of_atom[n].heavy.get("N") == n and d < best.get(c, (1.0, 0))[0]:
                best[c] = (d, n)
    return {(c, n) for c, (_, n) in best.items()}


def _accepted_conect(
    atoms: Sequence[AtomRecord],
    x: FloatArray,
    conect: Sequence[tuple[int, int]],
    of_atom: dict[int, Residue],
    metals: set[int],
    notes: list[str],
) -> set[tuple[int, int]]:
    """CONECT pairs, but those that span impossible distances, those to metal ions (which coordinate and do not bond),
    and those inside standard residues (templates know). Raises PreparationError for impossible ones inside others."""
    accepted = set()
    broken = []
    to_metals = 0
    for i, j in conect:
        if of_atom[i] is of_atom[j] and of_atom[i].heavy:
            continue
        if {i, j} & metals:
            to_metals += 1
            continue
        limit = covalent_radius_nm(atoms[i].element) + covalent_radius_nm(atoms[j].element) + _CONECT_SLACK_NM
        if float(np.linalg.norm(x[i] - x[j])) > limit:
            broken += [(i, j)] if of_atom[i] is of_atom[j] else []
        else:
            accepted.add(_pair(i, j))
    refuse_long_bonds([a.element for a in atoms], x, np.array(broken, dtype=np.int64), lambda i: atoms[i].label)
    if to_metals:
        notes.append(f"{to_metals} CONECT bonds to metal ions are ignored: ions coordinate")
    return accepted


def _free_atoms(residues: list[Residue], bonds: set[tuple[int, int]], notes: list[str]) -> set[int]:
    """Atoms whose bonds must come from distances."""
    bonded = {i for pair in bonds for i in pair}
    free: set[int] = set()
    for residue in residues:
        if residue.heavy:
            continue
        if len(residue.atoms) > 1 and all(i in bonded for i in residue.atoms):
            notes.append(f"{residue.label}: bonds from CONECT records")
        else:
            free |= set(residue.atoms)
            if len(residue.atoms) > 1:
                notes.append(f"{residue.label}: bonds from distances")
    return free


def _bonds_by_distance(
    atoms: Sequence[AtomRecord],
    near: IntArray,
    length: FloatArray,
    free: set[int],
    ions: set[int],
    known: set[tuple[int, int]],
    notes: list[str],
) -> set[tuple[int, int]]:
    """Bonds of the free atoms: within a residue whatever is near enough, to other residues what links polymers; and
    amides of side chains."""
    found = set()
    apart, amides = [], []
    for (i, j), d in zip(near.tolist(), length.tolist(), strict=True):
        apart_ends = atoms[i].residue_key != atoms[j].residue_key
        is_amide = apart_ends and {atoms[i].element, atoms[j].element} == {"C", "N"}
        if d < _AMIDE_NM and is_amide and not {i, j} & free and (i, j) not in known:
            found.add((i, j))
            amides.append(f"{atoms[i].label} - {atoms[j].label} ({d * 10:.2f} Å)")
        if (i in free or j in free) and not {i, j} & ions and "H" not in (atoms[i].element, atoms[j].element):
            reach = covalent_radius_nm(atoms[i].element) + covalent_radius_nm(atoms[j].element) + _TOLERANCE_NM
            if d >= reach:
                continue
            if not apart_ends or links_residues(atoms[i], atoms[j], d):
                found.add((i, j))
            elif (i, j) not in known:
                apart.append(f"{atoms[i].label} - {atoms[j].label} ({d * 10:.2f} Å)")
    if amides:
        notes.append(f"side chains bonded by distance: {listed(amides)}")
    if apart:
        notes.append(f"near and not bonded, as no CONECT or LINK record says so: {listed(apart, 3)}")
    return found


def links_residues(first: AtomRecord, second: AtomRecord, length_nm: float) -> bool:
    """Whether a distance between residues is one of the bonds that link them in polymers: amides, disulfides,
    thioethers, the phosphates of nucleic acids, and sugars at their anomeric carbons."""
    a, b = sorted((first, second), key=lambda atom: atom.element)
    pair = (a.element, b.element)
    if pair == ("C", "N"):
        return length_nm < (_PEPTIDE_NM if (a.name, b.name) == ("C", "N") else _AMINE_NM)
    if pair == ("S", "S"):
        return length_nm < _DISULFIDE_NM
    if pair == ("C", "S"):
        return length_nm < _THIOETHER_NM
    if pair == ("O", "P"):
        return length_nm < _PHOSPHATE_NM
    return pair == ("C", "O") and a.name in ("C1", "C2") and length_nm < _GLYCOSIDE_NM


def _note_bonds_across_ends(
    peptide: set[tuple[int, int]], of_atom: dict[int, Residue], chain_ends: Collection[int], notes: list[str]
) -> None:
    across = [
        f"{of_atom[c].label} - {of_atom[n].label}"
        for c, n in sorted(peptide)
        if any(min(c, n) <= end < max(c, n) for end in chain_ends if of_atom.get(end) in (of_atom[c], of_atom[n]))
    ]
    if across:
        notes.append(f"peptide bonds across the end of a chain (TER): {listed(across)}")


def _hydrogen_bonds_to_parents(
    atoms: Sequence[AtomRecord],
    x: FloatArray,
    bonds: set[tuple[int, int]],
    of_atom: dict[int, Residue],
    free: set[int],
    ions: set[int],
) -> tuple[set[tuple[int, int]], dict[int, PreparationError]]:
    """Each hydrogen to the nearest heavy atom of its residue, or of all where the residue's names say nothing; and what
    is wrong with those of standard residues that are far from everything: their heavy atoms may be missing."""
    bonded = {i for pair in bonds for i in pair}
    heavy = np.array([i for i, a in enumerate(atoms) if a.element != "H" and i not in ions], dtype=np.int64)
    tree: Any = None
    found, strays = set(), {}
    for i, atom in enumerate(atoms):
        if atom.element != "H" or i in bonded:
            continue
        own = np.array([j for j in of_atom[i].atoms if atoms[j].element != "H"], dtype=np.int64)
        parent, distance = -1, np.inf
        if i not in free and len(own):
            gaps = np.linalg.norm(x[own] - x[i], axis=1)
            parent, distance = int(own[gaps.argmin()]), float(gaps.min())
        if distance > _HYDROGEN_NM and len(heavy):
            if tree is None:  # few structures need it, and it is slow to import
                from scipy.spatial import cKDTree

                tree = cKDTree(x[heavy])
            gap, k = tree.query(x[i])
            parent, distance = int(heavy[k]), float(gap)
        if distance > _HYDROGEN_NM:
            nearest = f"{distance * 10:.2f} Å from the nearest heavy atom" if parent >= 0 else "alone"
            error = PreparationError(f"Hydrogen {atom.label} is {nearest}; correct or remove it.")
            if not of_atom[i].heavy or template_for(of_atom[i].key[2]) is None:
                raise error
            strays[i] = error
        else:
            found.add(_pair(i, parent))
    return found, strays


def _links_of_components(
    atoms: Sequence[AtomRecord],
    near: IntArray,
    length: FloatArray,
    of_atom: dict[int, Residue],
    ions: set[int],
) -> set[tuple[int, int]]:
    """Bonds that link polymers, between two residues of which one is a component of the dictionary."""
    found = set()
    for (i, j), d in zip(near.tolist(), length.tolist(), strict=True):
        if of_atom[i] is of_atom[j] or {i, j} & ions or "H" in (atoms[i].element, atoms[j].element):
            continue
        if not any(of_atom[k].heavy and template_for(of_atom[k].key[2]) is None for k in (i, j)):
            continue
        if links_residues(atoms[i], atoms[j], d):
            found.add((i, j))
    return found


def _disulfides(
    atoms: Sequence[AtomRecord],
    near: IntArray,
    length: FloatArray,
    bonds: set[tuple[int, int]],
    of_atom: dict[int, Residue],
) -> set[tuple[int, int]]:
    degree = Counter(i for pair in bonds for i in pair)
    return {
        (i, j)
        for (i, j), d in zip(near.tolist(), length.tolist(), strict=True)
        if d < _DISULFIDE_NM and all(of_atom[k].heavy.get("SG") == k and degree[k] == 1 for k in (i, j))
    }


# ---- what is missing ------------------------------------------------------------------------------------------------


def _note_missing(residues: list[Residue], atoms: Sequence[AtomRecord], bonds: IntArray) -> None:
    """Fill `missing` and `lacks_hydrogens` of the residues that are known by their names."""
    neighbours = neighbours_of(bonds, len(atoms))
    skeleton = [[j for j in around if atoms[j].element != "H"] for around in neighbours]

    def hydrogens(i: int) -> int:
        return len(neighbours[i]) - len(skeleton[i])

    for residue in residues:
        template, heavy = residue.template, residue.heavy
        if template is None or not heavy:
            continue
        links = links_of(residue, skeleton)
        absent = [a for a in template.heavy if a not in heavy and a not in template.optional]
        residue.missing = [a for a in absent if not _has_left(template, a, links, absent)]
        needed = {a: max(0, n - links.get(a, 0)) for a, n in template.hydrogens.items()}
        found = component(residue.key[2]) if template_for(residue.key[2]) is None else None
        if found is not None:
            if found.kind == "nucleotide" and "P" in heavy and "P" not in links and "OP3" not in heavy:
                residue.missing.append("OP3")
            there = {*heavy, *residue.missing}
            needed = Counter(h[1] for h in hydrogens_of(found, there, links_of(residue, neighbours), ph=PH_OF_FEWEST))
        if template.is_amino_acid and {"N", "C"} <= set(heavy):
            joined_c = any(atoms[j].element == "N" and j not in residue.atoms for j in neighbours[heavy["C"]])
            joined_n = any(atoms[j].element == "C" and j not in residue.atoms for j in neighbours[heavy["N"]])
            if not joined_c and "OXT" not in heavy and not hydrogens(heavy["C"]):
                residue.missing.append("OXT")
            if found is None:
                needed["N"] = (1 if joined_n else 2) - (template.name == "PRO")
            if template.name == "CYS" and residue.key[2].upper() != "CYM":
                needed["SG"] = 0 if "SG" in links or "SG" not in heavy else 1
        residue.lacks_hydrogens = any(hydrogens(heavy[a]) < n for a, n in needed.items() if a in heavy)
        if template.name == "HIS" and {"ND1", "NE2"} <= set(heavy):
            residue.lacks_hydrogens |= not (hydrogens(heavy["ND1"]) or hydrogens(heavy["NE2"]))


def links_of(residue: Residue, neighbours: Sequence[Sequence[int]]) -> dict[str, int]:
    """Return how many bonds each heavy atom of a residue, by its name in the template, has to other residues."""
    own = set(residue.atoms)
    counts = {name: sum(j not in own for j in neighbours[i]) for name, i in residue.heavy.items()}
    return {name: n for name, n in counts.items() if n}


def _has_left(template: ResidueTemplate, name: str, links: Mapping[str, int], absent: Sequence[str]) -> bool:
    """Whether an absent atom has made place for a bond to another residue: an oxygen of an acid that is an amide."""
    around = [b if a == name else a for a, b in template.bonds if name in (a, b)]
    if len(around) != 1 or name[0] not in "NO" or around[0] in ("C", "CA"):
        return False
    rivals = [a for a in absent if (around[0], a) in template.bonds or (a, around[0]) in template.bonds]
    return len(rivals) <= links.get(around[0], 0)
