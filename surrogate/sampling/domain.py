"""Is this scene what the weights were trained for? Asked before anything is computed."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from systems.chemistry import bonded_graph, rotatable_torsions
from systems.errors import OutOfDomainError
from systems.matching import match_atoms
from systems.scene import Scene
from systems.validity import INVALID, NOT_FINITE, Geometry, check_frames, flag_names

if TYPE_CHECKING:
    # Sampling and training know nothing of each other at run time: the api hands the weights over.
    from surrogate.data.weights import TrainingDomain, Weights

# A model that does not take the temperature as an input has one; a thermostat is set more finely than this by nobody.
TEMPERATURE_TOLERANCE_K = 0.5


@dataclass(frozen=True)
class Deviation:
    """One way in which a scene leaves the training domain.

    `what`: elements, size, charge, bond types, torsion environments, connectivity, stereo, start or temperature.
    `reason`: the two sides, in words. `forcible`: whether the model can be run nevertheless.
    """

    what: str
    reason: str
    forcible: bool

    def to_dict(self) -> dict[str, Any]:
        """Return what a trajectory's record keeps of it."""
        return {"what": self.what, "reason": self.reason}


@dataclass(frozen=True, eq=False)
class DomainMatch:
    """Model atom k is scene atom `order[k]`, `(n_atoms,)`; `deviations` are those that were overruled."""

    order: npt.NDArray[np.int64]
    deviations: tuple[Deviation, ...] = ()


def find_deviations(
    scene: Scene, domain: TrainingDomain, *, temperature_k: float | None = None
) -> tuple[Deviation, ...]:
    """Return how a scene leaves a training domain, the gravest first; nothing where the weights cover it.

    Compared are elements, the number of atoms, the total charge, bond types (elements and order), the surroundings of
    rotatable bonds, connectivity, stereo, the starting structure (by the validity of the training reference's frames)
    and the temperature, where one is asked for.
    """
    return _compare(scene, domain, temperature_k)[1]


def match_domain(
    scene: Scene, weights: Weights, *, temperature_k: float | None = None, force: bool = False
) -> DomainMatch:
    """Return the order of a scene's atoms in the model, and what of the training domain it leaves under `force`.

    A model has one place for each atom of its template, so a scene with other atoms or bonds cannot be forced; another
    stereoisomer, a strained start and another temperature can, and the rollout's record says so.
    Raises OutOfDomainError, which says how the scene differs, what the weights cover and what to run instead.
    """
    order, deviations = _compare(scene, weights.domain, temperature_k)
    barred = [d for d in deviations if not d.forcible]
    if order is not None and not barred and (force or not deviations):
        return DomainMatch(order, deviations)
    reasons = "; ".join(f"{d.what}: {d.reason}" for d in deviations)
    advice = (
        "Run `surromd reference` for this molecule, then `surromd train` on it."
        if barred
        else "Run `surromd reference` for it instead, or roll with --force: the trajectory is then marked."
    )
    raise OutOfDomainError(
        f"{weights.path.name} does not cover {scene.name}: {reasons}. These weights cover "
        f"{weights.domain.describe()}. {advice}"
    )


def match_scene(scene: Scene, weights: Weights) -> npt.NDArray[np.int64]:
    """Return `order (n_atoms,)` of a scene that the weights cover: model atom k is scene atom order[k].

    Raises OutOfDomainError; see `match_domain`.
    """
    return match_domain(scene, weights).order


def _compare(
    scene: Scene, domain: TrainingDomain, temperature_k: float | None
) -> tuple[npt.NDArray[np.int64] | None, tuple[Deviation, ...]]:
    order, found = _compare_molecules(scene, domain.scene)
    if order is not None:
        found += _compare_start(scene, order, Geometry.from_dict(domain.geometry))
    trained_k = domain.conditions.get("temperature_k")
    asked_k = trained_k if temperature_k is None else temperature_k
    if trained_k is not None and abs(asked_k - trained_k) > TEMPERATURE_TOLERANCE_K:
        reason = f"{asked_k:g} K, trained at {trained_k:g} K, and this model takes no temperature"
        found.append(Deviation("temperature", reason, forcible=True))
    return order, tuple(found)


def _compare_molecules(scene: Scene, template: Scene) -> tuple[npt.NDArray[np.int64] | None, list[Deviation]]:
    try:
        return match_atoms(scene, template), []
    except OutOfDomainError as error:
        refusal = str(error).rstrip(".")
    found = [
        *_compare_sets("elements", set(scene.elements), set(template.elements)),
        *_compare_sizes(scene, template),
        *_compare_sets("bond types", bond_types(scene), bond_types(template)),
        *_compare_sets("torsion environments", torsion_environments(scene), torsion_environments(template)),
    ]
    if found or scene.interactions != template.interactions:
        return None, found or [Deviation("connectivity", refusal, forcible=False)]
    order = _order_without_stereo(scene, template)
    if order is None:
        return None, [Deviation("connectivity", refusal, forcible=False)]
    return order, [Deviation("stereo", refusal, forcible=True)]


def _compare_sets(what: str, ours: set[str], theirs: set[str]) -> list[Deviation]:
    new = sorted(ours - theirs)
    if not new:
        return []
    listed = ", ".join(new[:6]) + (f" and {len(new) - 6} more" if len(new) > 6 else "")
    return [Deviation(what, f"{listed} not seen in training", forcible=False)]


def _compare_sizes(scene: Scene, template: Scene) -> list[Deviation]:
    found = []
    if sorted(scene.elements) != sorted(template.elements):
        ours, theirs = (f"{s.n_atoms} atoms, {s.formula}" for s in (scene, template))
        found.append(Deviation("size", f"{ours}; trained on {theirs}", forcible=False))
    charges = int(scene.formal_charges.sum()), int(template.formal_charges.sum())
    if charges[0] != charges[1]:
        found.append(Deviation("charge", f"{charges[0]:+d}; trained on {charges[1]:+d}", forcible=False))
    return found


def _compare_start(scene: Scene, order: npt.NDArray[np.int64], geometry: Geometry) -> list[Deviation]:
    flags = int(check_frames(scene.positions_nm[order], geometry)[0]) & INVALID
    if not flags:
        return []
    reason = f"the starting structure is no frame of the training reference ({', '.join(flag_names(flags))})"
    return [Deviation("start", reason, forcible=not flags & NOT_FINITE)]


def _order_without_stereo(scene: Scene, template: Scene) -> npt.NDArray[np.int64] | None:
    """Return an order that keeps elements and bonds, and every handedness of the mirror image where that fits."""
    mirrored = scene.with_positions(scene.positions_nm * np.array([1.0, 1.0, -1.0]))
    try:
        return match_atoms(mirrored, template)
    except OutOfDomainError:
        pass
    from networkx.algorithms.isomorphism import GraphMatcher, categorical_node_match

    matcher = GraphMatcher(
        bonded_graph(template), bonded_graph(scene), node_match=categorical_node_match("element", None)
    )
    image = next(matcher.isomorphisms_iter(), None)
    return None if image is None else np.array([image[k] for k in range(template.n_atoms)], dtype=np.int64)


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
    near: list[list[int]] = [[] for _ in range(scene.n_atoms)]
    for i, j in scene.bonds.tolist():
        near[i].append(j)
        near[j].append(i)

    def end(atom: int, other: int) -> str:
        rest = Counter(scene.elements[k] for k in near[atom] if k != other)
        return f"{scene.elements[atom]}({','.join(sorted(rest.elements()))})"

    return {"-".join(sorted((end(b, c), end(c, b)))) for _, b, c, _ in rotatable_torsions(scene).tolist()}
