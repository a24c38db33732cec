"""Peptides that weights by residues cover: any chain of residues that were trained on, whatever its sequence."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from surrogate.data.features.peptide_chains import chain_features
from surrogate.data.features.standard_peptide import standard_peptide
from surrogate.data.poses import in_standard_pose
from surrogate.models.peptides.chains import FREE_ENDS
from surrogate.sampling.coverage import Deviation
from systems.chemistry.validity import INVALID, check_frames, flag_names, geometry_from_scene
from systems.errors import InputError

if TYPE_CHECKING:
    from surrogate.data.weights import TrainingDomain
    from surrogate.models.peptides.model import PeptideConfig
    from systems.scene import Scene

_CAPS = ("ACE", "NME", "NH2")


def cover_peptide(
    scene: Scene, domain: TrainingDomain, config: PeptideConfig
) -> tuple[TrainingDomain, npt.NDArray[np.int64], tuple[Deviation, ...]]:
    """Return the domain of an unseen peptide, the order of its atoms in the model, and how it leaves the training.

    The molecule is the scene under standard names; a valid frame has the bond lengths and angles that residues of its
    kinds have on average in the training references. A residue, or an end of a chain, that no training peptide has
    cannot be forced; more residues than any of them has, and a strained start, can. So can a residue at a free end that
    none has there, whose side chain the charge turns elsewhere, and more residues between free ends than any has, since
    what charges do to each other reaches along a chain.
    """
    try:
        standard, order = standard_peptide(scene)
        chain = chain_features(standard, config)
    except InputError as error:
        return domain, np.arange(0), (Deviation("residues", str(error).rstrip("."), forcible=False),)
    found = []
    free = any(_free_ends(standard))
    alike = [member.scene for member in domain.members if any(_free_ends(member.scene)) or not free]
    most = max((_n_amino_acids(scene) for scene in alike), default=0)
    if (n := _n_amino_acids(standard)) > most:
        what = f"{n} amino acids{' with free ends' if free else ''}; trained on up to {most}"
        found.append(Deviation("size", what, forcible=True))
    first, last = FREE_ENDS
    if unborne := [x for x in unseen_neighbours(standard, domain) if x.startswith(first) or x.endswith(last)]:
        found.append(Deviation("ends", f"free ends that no training peptide has: {', '.join(unborne)}", forcible=True))
    tokens = chain.code.encode(torch.tensor(standard.positions_nm))
    turning = torch.zeros(tokens.numel(), dtype=torch.bool)
    turning[chain.code.turning_at] = turning[chain.code.turning_at + 1] = True
    usual = chain.code.decode(torch.where(turning, tokens.flatten(), 0.0).reshape(tokens.shape))
    geometry = geometry_from_scene(standard.with_positions(usual.double().numpy()))
    flags = int(check_frames(standard.positions_nm, geometry)[0]) & INVALID
    if flags:
        reason = f"the starting structure is unlike frames of such residues ({', '.join(flag_names(flags))})"
        found.append(Deviation("start", reason, forcible=True))
    conditions = {
        key: value if all(member.conditions.get(key) == value for member in domain.members) else None
        for key, value in domain.conditions.items()
    }
    own = replace(
        domain, scene=in_standard_pose(standard), conditions=conditions, geometry=geometry.to_dict(), limits=None,
        further=(), transferable=False,
    )  # fmt: skip
    return own, order, tuple(found)


def unseen_neighbours(scene: Scene, domain: TrainingDomain) -> list[str]:
    """Return the pairs of neighbouring residues of a standard peptide that no training peptide has, as 'LEU-SER', or,
    where residues bear free ends, 'NH3+-LEU'."""
    known = {pair for member in domain.members for pair in _pairs(member.scene)}
    return [f"{a}-{b}" for a, b in dict.fromkeys(_pairs(scene)) if (a, b) not in known]


def _pairs(scene: Scene) -> list[tuple[str, str]]:
    first, last = ([end] * free for end, free in zip(FREE_ENDS, _free_ends(scene), strict=True))
    return list(pairwise([*first, *scene.residue_names, *last]))


def _free_ends(scene: Scene) -> tuple[bool, bool]:
    """Return whether a chain's first residue bears an end of its own, and whether its last does."""
    return scene.residue_names[0] not in _CAPS, scene.residue_names[-1] not in _CAPS


def _n_amino_acids(scene: Scene) -> int:
    return sum(name not in _CAPS for name in scene.residue_names)
