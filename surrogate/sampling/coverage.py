"""Coverage of a scene by a training domain: a molecule that was trained on or, by weights that know atoms
by their bonds, one that looks like those from within."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.data.poses import in_standard_pose, order_along_axis
from systems.chemistry.graph import ring_bonds, rotatable_torsions
from systems.chemistry.matching import match_atoms
from systems.chemistry.symmetry import local_handedness
from systems.chemistry.validity import Geometry, geometry_from_scene
from systems.errors import OutOfDomainError
from systems.scene import Scene
from systems.selection import reordered

if TYPE_CHECKING:
    # Sampling and training know nothing of each other at run time: the api hands the weights over.
    from surrogate.data.weights import TrainingDomain

# How far a starting structure's bonds may lie outside what molecules trained on have between the same elements.
_BOND_MARGIN_NM = 0.02


@dataclass(frozen=True)
class Deviation:
    """One way in which a scene leaves the training domain.

    `what`: elements, size, charge, bond types, torsion environments, connectivity, stereo, start or temperature; of an
    unseen molecule also atom environments. `reason`: the two sides, in words. `forcible`: whether the model can be run
    nevertheless.
    """

    what: str
    reason: str
    forcible: bool

    def to_dict(self) -> dict[str, Any]:
        """Return what a trajectory's record keeps of it."""
        return {"what": self.what, "reason": self.reason}


def cover(scene: Scene, domain: TrainingDomain) -> tuple[TrainingDomain, tuple[Deviation, ...]]:
    """Return the domain of one molecule that a scene is rolled in, and how the scene leaves all that was trained on.

    Weights for one molecule have one domain, and it is returned. Of weights for several, a molecule that was trained on
    has its own; that of an unseen molecule is made of the scene itself: its positions in their standard pose are the
    template, its atoms in their order along the longest axis, so that their numbering plays no part, and its bonds and
    handedness, not a reference, say what a valid frame is. Such a molecule must be no larger than those trained on, and
    have no element, bond type, atom environment, charge, stereocentre or torsion environment that they do not have.
    """
    if not domain.transferable:
        return domain, ()
    for member in domain.members:
        try:
            match_atoms(scene, member.scene)
        except OutOfDomainError:
            continue
        return replace(member, further=(), transferable=False), ()
    scenes = [member.scene for member in domain.members]
    largest = max(known.n_atoms for known in scenes)
    found = compare_sets("elements", scene, scenes, lambda s: set(s.elements), forcible=False)
    if not np.isfinite(scene.positions_nm).all():
        found.append(Deviation("start", "the starting structure has positions that are not finite", forcible=False))
    if found or scene.interactions is not None:
        return domain, tuple(found or [Deviation("connectivity", "a model system, not a molecule", forcible=False)])
    if scene.n_atoms > largest:
        found.append(Deviation("size", f"{scene.n_atoms} atoms; trained on up to {largest}", forcible=True))
    for what, of in (("bond types", bond_types), ("atom environments", atom_environments), ("charge", charged_atoms),
                     ("torsion environments", torsion_environments), ("stereo", stereo_environments)):  # fmt: skip
        found += compare_sets(what, scene, scenes, of, forcible=True)
    found += _compare_bonds(scene, domain)
    conditions = {
        key: value if all(member.conditions.get(key) == value for member in domain.members) else None
        for key, value in domain.conditions.items()
    }
    posed = reordered(in_standard_pose(scene), order_along_axis(scene))
    geometry = geometry_from_scene(posed).to_dict()
    own = replace(domain, scene=posed, conditions=conditions, geometry=geometry, limits=None, further=(),
                  transferable=False)  # fmt: skip
    return own, tuple(found)


def compare_sets(
    what: str, scene: Scene, known: list[Scene], of: Callable[[Scene], set[str]], *, forcible: bool
) -> list[Deviation]:
    """Return a deviation that names what `of(scene)` holds and that of no known scene does."""
    new = sorted(of(scene) - set().union(*(of(one) for one in known)))
    if not new:
        return []
    listed = ", ".join(new[:6]) + (f" and {len(new) - 6} more" if len(new) > 6 else "")
    return [Deviation(what, f"{listed} not seen in training", forcible=forcible)]


def bond_types(scene: Scene) -> set[str]:
    """Return the kinds of bonds by elements and order: {'C-H', 'C=O', 'C:N', ...}; ~ where no order is given.

    A bond between C, N or O inside an aromatic ring or a delocalised group has the order that its source draws.
    """
    symbol = {0.0: "~", 1.0: "-", 1.5: ":", 2.0: "=", 3.0: "#"}
    kinds = set()
    for (i, j), order in zip(scene.bonds.tolist(), scene.bond_orders.tolist(), strict=True):
        a, b = sorted((scene.elements[i], scene.elements[j]))
        kinds.add(f"{a}{symbol.get(order, '~')}{b}")
    return kinds


def atom_environments(scene: Scene) -> set[str]:
    """Return each atom with its neighbours: {'C(C,H,H,H)', ...}, those in a ring marked 'ring C(C,C,H)'."""
    in_ring = set(ring_bonds(scene).ravel().tolist())
    near = scene.neighbours()
    return {
        ("ring " if i in in_ring else "")
        + f"{scene.elements[i]}({','.join(sorted(scene.elements[j] for j in around))})"
        for i, around in enumerate(near)
    }


def charged_atoms(scene: Scene) -> set[str]:
    """Return the formal charges by element: {'N+1', 'O-1'}."""
    return {f"{e}{q:+d}" for e, q in zip(scene.elements, scene.formal_charges.tolist(), strict=True) if q}


def stereo_environments(scene: Scene) -> set[str]:
    """Return the stereocentres with their neighbours and handedness, '+' or '-', '?' where neighbours look alike."""
    near, hands = scene.neighbours(), {1: "+", -1: "-", 0: "?"}
    return {
        f"{scene.elements[i]}({','.join(sorted(scene.elements[j] for j in near[i]))}){hands[sign]}"
        for i, sign in local_handedness(scene).items()
    }


def torsion_environments(scene: Scene) -> set[str]:
    """Return the surroundings of each rotatable bond: the two atoms, each with its other neighbours.

    'C(C,H,N)-C(N,O)' is psi of alanine. Names, order and positions play no part.
    """
    near = scene.neighbours()

    def end(atom: int, other: int) -> str:
        rest = Counter(scene.elements[k] for k in near[atom] if k != other)
        return f"{scene.elements[atom]}({','.join(sorted(rest.elements()))})"

    return {"-".join(sorted((end(b, c), end(c, b)))) for _, b, c, _ in rotatable_torsions(scene).tolist()}


def _compare_bonds(scene: Scene, domain: TrainingDomain) -> list[Deviation]:
    """A starting structure whose bonds are longer or shorter than any between such elements that was trained on."""
    ranges: dict[tuple[str, ...], tuple[float, float]] = {}
    for member in domain.members:
        geometry, elements = Geometry.from_dict(member.geometry), member.scene.elements
        for (i, j), mean in zip(geometry.bond_idx.tolist(), geometry.bond_mean_nm.tolist(), strict=True):
            key = tuple(sorted((elements[i], elements[j])))
            low, high = ranges.get(key, (mean, mean))
            ranges[key] = min(low, mean), max(high, mean)
    x, wrong = scene.positions_nm, 0
    for i, j in scene.bonds.tolist():
        key = tuple(sorted((scene.elements[i], scene.elements[j])))
        length = float(np.linalg.norm(x[i] - x[j]))
        low, high = ranges.get(key, (length, length))
        wrong += not low - _BOND_MARGIN_NM <= length <= high + _BOND_MARGIN_NM
    if not wrong:
        return []
    reason = f"{wrong} bonds of the starting structure are longer or shorter than any of their kind in training"
    return [Deviation("start", reason, forcible=True)]
