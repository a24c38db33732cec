"""Bonds of a structure file: from residue templates, CONECT records or distances; and what is missing from it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

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
from systems.errors import PreparationError, counted, listed
from systems.prepare.records import AtomRecord, Bonding, Residue, by_residue
from systems.scene import IntArray, neighbours_of

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


def find_bonds(atoms: Sequence[AtomRecord], conect: Sequence[tuple[int, int]]) -> Bonding:
    """Return the bonds of these atoms.

    Standard residues take heavy-atom bonds from their template, hydrogens go to the nearest heavy atom, peptide and
    disulfide bonds are found by distance. All other residues take CONECT records if these reach each of their atoms,
    distances within 0.04 nm of the sum of covalent radii if not; to other residues only the bonds that link polymers.
    Monatomic ions have no bonds by distance, and metal ions none at all. Raises PreparationError for atoms that
    coincide, bonds of templates that are too long to be any, and hydrogens far from everything.
    """
    found = _Bonds(atoms)
    x, of_atom = found.x, found.of_atom
    for residue in found.residues:
        if residue.heavy and residue.template is not None:
            names = [*residue.template.bonds, *([("C", "OXT")] if "OXT" in residue.heavy else [])]
            found.bonds |= {_pair(residue.heavy[a], residue.heavy[b]) for a, b in names if {a, b} <= set(residue.heavy)}
    found.refuse_long(sorted(found.bonds))
    peptide = found.peptide_bonds()
    found.bonds |= {_pair(c, n) for c, n in peptide}
    metals = {i for i in found.ions if is_metal(atoms[i].element)}
    found.add_conect(conect, metals)
    free = found.free_atoms()
    found.add_by_distance(free)
    strays = found.add_hydrogens(free)
    found.add_disulfides()
    bonds = np.array(sorted(found.bonds), dtype=np.int64).reshape(-1, 2)
    _note_missing(found.residues, atoms, bonds)
    for i, away in strays.items():
        if not of_atom[i].missing:
            raise PreparationError(f"Hydrogen {atoms[i].label} is {away}; correct or remove it.")
    if strays:
        gone = listed([atoms[i].label for i in strays])
        found.notes.append(f"hydrogens removed because their heavy atoms are missing: {gone}")
    found.notes += [
        f"disulfide bond {of_atom[i].label} - {of_atom[j].label} ({10 * float(np.linalg.norm(x[i] - x[j])):.2f} Å)"
        for i, j in bonds.tolist()
        if all(of_atom[k].heavy.get("SG") == k for k in (i, j))
    ]
    lost = [(i, j) for i, j in conect if _pair(i, j) not in found.bonds and not {i, j} & metals]
    unmade = found.labels([(i, j, float(np.linalg.norm(x[i] - x[j]))) for i, j in lost])
    return Bonding(bonds, found.residues, found.notes, peptide, unmade)


def are_ions(atoms: Sequence[AtomRecord]) -> bool:
    """Whether the atoms of a residue are monatomic ions: one, or several of one name under one number."""
    return is_lone_ion(atoms[0].element) and len({a.name for a in atoms}) == 1


def links_residues(first: AtomRecord, second: AtomRecord, length_nm: float) -> bool:
    """Whether a distance between residues is one of the bonds that link them in polymers: amides, disulfides,
    thioethers, the phosphates of nucleic acids, and sugars at their anomeric carbons."""
    a, b = sorted((first, second), key=lambda atom: atom.element)
    pair = (a.element, b.element)
    if pair == ("C", "N"):
        return length_nm < (_PEPTIDE_NM if (a.name, b.name) == ("C", "N") else _AMINE_NM)
    if pair == ("C", "O"):
        return a.name in ("C1", "C2") and length_nm < _GLYCOSIDE_NM
    return length_nm < {("S", "S"): _DISULFIDE_NM, ("C", "S"): _THIOETHER_NM, ("O", "P"): _PHOSPHATE_NM}.get(pair, 0.0)


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


class _Bonds:
    """The bonds of some atoms while they are found: `near` pairs within 0.35 nm, their `lengths`, and what is known."""

    def __init__(self, atoms: Sequence[AtomRecord]) -> None:
        self.atoms = atoms
        self.x = np.array([a.position_angstrom for a in atoms], dtype=np.float64) / 10.0
        pairs = near_pairs(self.x, 0.35, "the structure")
        lengths = np.linalg.norm(self.x[pairs[:, 0]] - self.x[pairs[:, 1]], axis=1)
        self.near: list[tuple[int, int, float]] = list(zip(*pairs.T.tolist(), lengths.tolist(), strict=True))
        for i, j, d in self.near:
            if d < _COINCIDENT_NM:
                raise PreparationError(
                    f"{atoms[i].label} and {atoms[j].label} have the same coordinates ({d * 10:.2f} Å apart); "
                    "remove one of them."
                )
        self.residues = _residues(atoms)
        self.of_atom = {i: r for r in self.residues for i in r.atoms}
        self.ions = {i for r in self.residues if are_ions([atoms[i] for i in r.atoms]) for i in r.atoms}
        self.bonds: set[tuple[int, int]] = set()
        self.notes: list[str] = []

    def reach(self, i: int, j: int) -> float:
        """The sum of two atoms' covalent radii, nm."""
        return covalent_radius_nm(self.atoms[i].element) + covalent_radius_nm(self.atoms[j].element)

    def labels(self, pairs: Sequence[tuple[int, int, float]]) -> list[str]:
        return [f"{self.atoms[i].label} - {self.atoms[j].label} ({d * 10:.2f} Å)" for i, j, d in pairs]

    def refuse_long(self, bonds: Sequence[tuple[int, int]]) -> None:
        rows = np.array(bonds, dtype=np.int64)
        refuse_long_bonds([a.element for a in self.atoms], self.x, rows, lambda i: self.atoms[i].label)

    def peptide_bonds(self) -> set[tuple[int, int]]:
        """The pairs (C, N), of each carbonyl that to the nearest nitrogen."""
        best: dict[int, tuple[float, int]] = {}
        for i, j, d in self.near:
            if d >= _PEPTIDE_NM or self.of_atom[i] is self.of_atom[j]:
                continue
            for c, n in ((i, j), (j, i)):
                residue = self.of_atom[c]  # whose O may be missing from the file
                is_carbonyl = residue.heavy.get("C") == c and residue.template and "O" in residue.template.heavy
                if is_carbonyl and self.of_atom[n].heavy.get("N") == n and d < best.get(c, (1.0, 0))[0]:
                    best[c] = (d, n)
        return {(c, n) for c, (_, n) in best.items()}

    def add_conect(self, conect: Sequence[tuple[int, int]], metals: set[int]) -> None:
        """Take CONECT pairs, but those that span impossible distances, those to metal ions (which coordinate and do not
        bond), and those inside standard residues (templates know). Raises PreparationError for impossible ones inside
        others."""
        broken, n_to_metals = [], 0
        for i, j in conect:
            if self.of_atom[i] is self.of_atom[j] and self.of_atom[i].heavy:
                continue
            if {i, j} & metals:
                n_to_metals += 1
            elif float(np.linalg.norm(self.x[i] - self.x[j])) <= self.reach(i, j) + _CONECT_SLACK_NM:
                self.bonds.add(_pair(i, j))
            elif self.of_atom[i] is self.of_atom[j]:
                broken.append((i, j))
        self.refuse_long(broken)
        if n_to_metals:
            self.notes.append(f"{counted(n_to_metals, 'CONECT bond')} to metal ions ignored: ions coordinate")

    def free_atoms(self) -> set[int]:
        """Atoms whose bonds must come from distances."""
        bonded = {i for pair in self.bonds for i in pair}
        free: set[int] = set()
        for residue in self.residues:
            if residue.heavy:
                continue
            stated = len(residue.atoms) > 1 and all(i in bonded for i in residue.atoms)
            if len(residue.atoms) > 1:
                self.notes.append(f"{residue.label}: bonds from {'CONECT records' if stated else 'distances'}")
            free |= set() if stated else set(residue.atoms)
        return free

    def add_by_distance(self, free: set[int]) -> None:
        """Bonds of the free atoms: within a residue whatever is near enough, to other residues what links polymers.
        Besides, amides of side chains, and the links of residues that are components of the dictionary."""
        linkable = free | {i for r in self.residues if r.heavy and template_for(r.key[2]) is None for i in r.atoms}
        amides = []
        for i, j, d in self.near:
            first, second = self.atoms[i], self.atoms[j]
            symbols = {first.element, second.element}
            if "H" in symbols or {i, j} & self.ions or (i, j) in self.bonds:
                continue
            if first.residue_key == second.residue_key:
                if d < self.reach(i, j) + _TOLERANCE_NM and {i, j} & free:
                    self.bonds.add((i, j))
            elif {i, j} & linkable and links_residues(first, second, d):
                self.bonds.add((i, j))
            elif d < _AMIDE_NM and symbols == {"C", "N"} and not {i, j} & free:
                self.bonds.add((i, j))
                amides.append((i, j, d))
        if amides:
            self.notes.append(f"side chains bonded by distance: {listed(self.labels(amides))}")

    def add_hydrogens(self, free: set[int]) -> dict[int, str]:
        """Each hydrogen to the nearest heavy atom of its residue, or of all where the residue's names say nothing.
        Returns how far those are that are far from everything: their heavy atoms may be missing."""
        atoms, x = self.atoms, self.x
        bonded = {i for pair in self.bonds for i in pair}
        heavy = np.array([i for i, a in enumerate(atoms) if a.element != "H" and i not in self.ions], dtype=np.int64)
        strays = {}
        for i, atom in enumerate(atoms):
            if atom.element != "H" or i in bonded:
                continue
            own = np.array([j for j in self.of_atom[i].atoms if atoms[j].element != "H"], dtype=np.int64)
            parent, distance = -1, np.inf
            if i not in free and len(own):
                gaps = np.linalg.norm(x[own] - x[i], axis=1)
                parent, distance = int(own[gaps.argmin()]), float(gaps.min())
            if distance > _HYDROGEN_NM and len(heavy):
                gaps = np.linalg.norm(x[heavy] - x[i], axis=1)
                parent, distance = int(heavy[gaps.argmin()]), float(gaps.min())
            if distance <= _HYDROGEN_NM:
                self.bonds.add(_pair(i, parent))
            else:
                strays[i] = f"{distance * 10:.2f} Å from the nearest heavy atom" if parent >= 0 else "alone"
        return strays

    def add_disulfides(self) -> None:
        degree = Counter(i for pair in self.bonds for i in pair)
        for i, j, d in self.near:
            if d < _DISULFIDE_NM and all(self.of_atom[k].heavy.get("SG") == k and degree[k] == 1 for k in (i, j)):
                self.bonds.add((i, j))


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
