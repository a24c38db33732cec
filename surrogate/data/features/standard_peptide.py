"""A peptide under the names and in the atom order of `systems.prepare.peptide`, whichever program wrote its file."""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt

from systems.chemistry.matching import match_atoms
from systems.chemistry.residues import template_for
from systems.errors import InputError, OutOfDomainError, PreparationError
from systems.prepare.peptide import build_peptide
from systems.scene import Scene

# Forms of a residue that differ in hydrogens alone, the commonest at pH 7 first.
_FORMS = {"HIS": ("HIE", "HID", "HIP"), "ASP": ("ASP", "ASH"), "GLU": ("GLU", "GLH"), "LYS": ("LYS", "LYN")}
# Hydrogens of a whole peptide tell most forms apart; of what is left, so many are tried.
_MOST_TRIED = 8


def standard_peptide(scene: Scene) -> tuple[Scene, npt.NDArray[np.int64]]:
    """Return the peptide as `build_peptide` makes it, at the positions of `scene`, and the order of its atoms.

    Its atom k is atom `order[k]` of `scene`, `order` (n_atoms,). The sequence is read from the residues' names, those
    of Amber, CHARMM and GROMACS included; atoms are matched by their bonds and handedness, so that their names and
    order play no part. Raises InputError for a scene that is no single chain of the twenty amino acids between their
    usual ends, or has another handedness than L.
    """
    names = [template.name if (template := template_for(name)) else name for name in scene.residue_names]
    hydrogens = sum(element == "H" for element in scene.elements)
    refusal = ""
    for forms in list(product(*(_FORMS.get(name, (name,)) for name in names)))[:_MOST_TRIED]:
        try:
            built = build_peptide("-".join(forms))
        except PreparationError as error:
            refusal = refusal or str(error)
            continue
        if sum(element == "H" for element in built.elements) != hydrogens:
            continue
        try:
            order = match_atoms(scene, built)
        except OutOfDomainError as error:
            refusal = str(error)
            continue
        return built.with_positions(scene.positions_nm[order]), order
    raise InputError(
        f"{scene.name} is no chain of standard residues with usual ends: {refusal or 'its hydrogens fit no usual form'}"
    )
