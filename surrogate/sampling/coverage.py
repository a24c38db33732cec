"""Coverage of a scene by a training domain, and the ways in which one leaves it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from systems.chemistry.graph import rotatable_torsions
from systems.chemistry.matching import match_atoms
from systems.errors import OutOfDomainError
from systems.scene import Scene

if TYPE_CHECKING:
    # Sampling and training know nothing of each other at run time: the api hands the weights over.
    from surrogate.data.weights import TrainingDomain


@dataclass(frozen=True)
class Deviation:
    """One way in which a scene leaves the training domain.

    `what`: elements, size, charge, bond types, torsion environments, connectivity, stereo, start or temperature, of an
    unseen peptide also residues or ends. `reason`: the two sides, in words. `forcible`: whether the model can be run
    nevertheless.
    """

    what: str
    reason: str
    forcible: bool

    def to_dict(self) -> dict[str, Any]:
        """Return what a trajectory's record keeps of it."""
        return {"what": self.what, "reason": self.reason}


def member_of(scene: Scene, domain: TrainingDomain) -> TrainingDomain | None:
    """Return the domain of the one molecule that a scene is, of all that weights were trained on; None of another.

    Weights for one molecule have one domain, and it is returned whatever the scene.
    """
    if not domain.transferable:
        return domain
    for member in domain.members:
        try:
            match_atoms(scene, member.scene)
        except OutOfDomainError:
            continue
        return replace(member, further=(), transferable=False)
    return None


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


def torsion_environments(scene: Scene) -> set[str]:
    """Return the surroundings of each rotatable bond: the two atoms, each with its other neighbours.

    'C(C,H,N)-C(N,O)' is psi of alanine. Names, order and positions play no part.
    """
    near = scene.neighbours()

    def end(atom: int, other: int) -> str:
        rest = Counter(scene.elements[k] for k in near[atom] if k != other)
        return f"{scene.elements[atom]}({','.join(sorted(rest.elements()))})"

    return {"-".join(sorted((end(b, c), end(c, b)))) for _, b, c, _ in rotatable_torsions(scene).tolist()}
