"""Missing heavy atoms and hydrogens of the residues that are known by their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from systems.chemistry.components import PH_OF_FEWEST, Component, component, hydrogens_of
from systems.chemistry.residues import ResidueTemplate, template_for
from systems.prepare.bonded_residues import Residue
from systems.prepare.read.records import AtomRecord


def note_missing(residues: list[Residue], atoms: Sequence[AtomRecord], bonds: npt.NDArray[np.int64]) -> None:
    """Fill `missing` and `lacks_hydrogens` of the residues that are known by their names."""
    neighbours: list[list[int]] = [[] for _ in atoms]
    for i, j in bonds.tolist():
        neighbours[i].append(j)
        neighbours[j].append(i)

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
            needed = _least_hydrogens(residue, found, neighbours)
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


def _least_hydrogens(residue: Residue, found: Component, neighbours: list[list[int]]) -> dict[str, int]:
    """Return the least number of hydrogens on each heavy atom of a component, at any pH."""
    present = {*residue.heavy, *residue.missing}
    least: dict[str, int] = {}
    for _, parent in hydrogens_of(found, present, links_of(residue, neighbours), ph=PH_OF_FEWEST):
        least[parent] = least.get(parent, 0) + 1
    return least
