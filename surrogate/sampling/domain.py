"""Comparison of a scene with the training domain of weights, before anything is computed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from surrogate.sampling.coverage import Deviation, bond_types, compare_sets, member_of, torsion_environments
from surrogate.sampling.lags import at_lag, choose_lag
from surrogate.sampling.peptide_coverage import cover_peptide, unseen_neighbours
from systems.chemistry.graph import bonded_graph
from systems.chemistry.matching import match_atoms
from systems.chemistry.validity import INVALID, NOT_FINITE, Geometry, check_frames, flag_names
from systems.errors import OutOfDomainError
from systems.scene import Scene

if TYPE_CHECKING:
    # Sampling and training know nothing of each other at run time: the api hands the weights over.
    from surrogate.data.weights import TrainingDomain, Weights
    from surrogate.models.interface import Surrogate
    from surrogate.models.peptides.model import PeptideConfig

__all__ = [
    "Deviation", "DomainMatch", "bond_types", "find_deviations", "fit_weights", "match_domain",
    "match_known", "match_scene",
    "torsion_environments",
]  # fmt: skip
# A model that does not take the temperature as an input has one; a thermostat is set more finely than this by nobody.
TEMPERATURE_TOLERANCE_K = 0.5


@dataclass(frozen=True, eq=False)
class DomainMatch:
    """How a scene fits weights. `order (n_atoms,)`: model atom k is scene atom `order[k]`; `domain`: training domain of
    the scene's molecule; `deviations`: those that `force` overruled; `seen`: whether the molecule was trained on;
    `nearness`: of an unseen peptide, how near to it training comes, in words."""

    order: npt.NDArray[np.int64]
    domain: TrainingDomain
    deviations: tuple[Deviation, ...] = ()
    seen: bool = True
    nearness: str = ""

    def remarks(self, weights: str) -> tuple[str, ...]:
        """Return what is to be said before the scene is rolled with weights of this name; nothing inside the domain."""
        near = f" ({self.nearness})" if self.nearness else ""
        unseen = f"{weights} was not trained on this molecule{near}; compare with MD of it before you trust the rollout"
        beyond = (f"outside the training domain: {d.what}: {d.reason}" for d in self.deviations)
        return (*(() if self.seen else (unseen,)), *beyond)


def find_deviations(
    scene: Scene, domain: TrainingDomain, *, model: Surrogate | None = None, temperature_k: float | None = None
) -> tuple[Deviation, ...]:
    """Return how a scene leaves a training domain, the gravest first; nothing where the weights cover it.

    `model`: of these weights; one that knows peptides by residues covers other sequences, too.

    Compared are elements, the number of atoms, the total charge, bond types (elements and order), the surroundings of
    rotatable bonds, connectivity, stereo, the starting structure (by the validity of the training reference's frames)
    and the temperature, where one is asked for.
    """
    return _compare(scene, domain, None if model is None else _peptides(model), temperature_k).deviations


def match_domain(
    scene: Scene, weights: Weights, *, temperature_k: float | None = None, force: bool = False
) -> DomainMatch:
    """Return the order of a scene's atoms in the model, and what of the training domain it leaves under `force`.

    A model has one place for each atom of its template, so a scene with other atoms or bonds cannot be forced; another
    stereoisomer, a strained start and another temperature can, and the rollout's record says so.
    Raises OutOfDomainError, which says how the scene differs, what the weights cover and what to run instead.
    """
    return match_known(scene, weights.domain, weights.path.name, _peptides(weights.model),
                       temperature_k=temperature_k, force=force)  # fmt: skip


def match_known(
    scene: Scene, domain: TrainingDomain, name: str, peptides: PeptideConfig | None = None, *,
    temperature_k: float | None = None, force: bool = False,
) -> DomainMatch:  # fmt: skip
    """`match_domain` for weights that are not loaded, of which a file's header tells all that counts: `peptides` are
    the settings of a model that knows peptides by their residues."""
    found = _compare(scene, domain, peptides, temperature_k)
    deviations = found.deviations
    barred = [d for d in deviations if not d.forcible]
    if not barred and (force or not deviations):
        return found
    reasons = "; ".join(f"{d.what}: {d.reason}" for d in deviations)
    advice = (
        "Run `surromd reference` for this molecule, then `surromd train` on it."
        if barred
        else "Run `surromd reference` for it instead, or roll with `force=True`: the trajectory is then marked."
    )
    raise OutOfDomainError(
        f"{name} does not cover {scene.name}: {reasons}. These weights cover {domain.describe()}. {advice}",
        brief=f"{name} does not cover it: {reasons}",
        forcible=not barred,
    )


def fit_weights(
    scene: Scene,
    weights: Weights,
    *,
    temperature_k: float | None = None,
    force: bool = False,
    lag_ps: float | None = None,
    save_every_ps: float | None = None,
) -> tuple[Weights, DomainMatch]:
    """Return weights as a rollout of this scene takes them, for one molecule at one lag, and the match to that.

    Raises OutOfDomainError as `match_domain` does, InputError for a lag that the weights were not trained for.
    """
    match = match_domain(scene, weights, temperature_k=temperature_k, force=force)
    return at_lag(weights, match.domain, choose_lag(weights, lag_ps, save_every_ps)), match


def in_bath(weights: Weights, asked: dict[str, Any]) -> Weights:
    """Return weights that integrate as asked (`RolloutConfig.bath`), where they are a potential; a temperature asked
    of others is compared with theirs (`match_domain`). Raises InputError for anything else asked of these."""
    if not weights.model.integrates:
        asked = {name: value for name, value in asked.items() if name != "temperature_k"}
    if not asked:
        return weights
    model, domain = weights.model.in_bath(asked), weights.domain
    told = {name: value for name, value in asked.items() if name in domain.conditions}
    if "constrain_hydrogens" in domain.conditions:
        told["constrain_hydrogens"] = model.config.constrain_hydrogens
    return replace(weights, model=model, domain=replace(domain, conditions={**domain.conditions, **told}))


def match_scene(scene: Scene, weights: Weights) -> npt.NDArray[np.int64]:
    """Return `order (n_atoms,)` of a scene that the weights cover: model atom k is scene atom order[k].

    Raises OutOfDomainError; see `match_domain`.
    """
    return match_domain(scene, weights).order


def _peptides(model: Surrogate) -> PeptideConfig | None:
    return model.config if model.knows_chains else None


def _compare(
    scene: Scene, domain: TrainingDomain, peptides: PeptideConfig | None, temperature_k: float | None
) -> DomainMatch:
    member = member_of(scene, domain)
    own, order, nearness = member or domain, np.arange(0), ""
    if member is None and peptides is not None:
        own, order, beyond = cover_peptide(scene, domain, peptides)
        found = list(beyond)
        new = unseen_neighbours(own.scene, domain) if not any(not d.forcible for d in found) else []
        nearness = f"residues that it never saw side by side: {', '.join(new)}" if new else "each pair of residues seen"
    elif member is None:
        found = [Deviation("connectivity", "another molecule than those trained on", forcible=False)]
    else:
        order, found = _compare_molecules(scene, own.scene)
        if not any(not d.forcible for d in found):
            found += _compare_start(scene, order, Geometry.from_dict(own.geometry))
    trained_k = domain.conditions.get("temperature_k")
    asked_k = trained_k if temperature_k is None else temperature_k
    if trained_k is not None and abs(asked_k - trained_k) > TEMPERATURE_TOLERANCE_K:
        reason = f"{asked_k:g} K, trained at {trained_k:g} K, and this model takes no temperature"
        found.append(Deviation("temperature", reason, forcible=True))
    return DomainMatch(order, own, tuple(found), member is not None, nearness)


def _compare_molecules(scene: Scene, template: Scene) -> tuple[npt.NDArray[np.int64], list[Deviation]]:
    """Return the order of atoms and what differs; the order means nothing where that cannot be forced."""
    try:
        return match_atoms(scene, template), []
    except OutOfDomainError as error:
        refusal = str(error).rstrip(".")
    found = [
        *compare_sets("elements", scene, [template], lambda s: set(s.elements), forcible=False),
        *_compare_sizes(scene, template),
        *compare_sets("bond types", scene, [template], bond_types, forcible=False),
        *compare_sets("torsion environments", scene, [template], torsion_environments, forcible=False),
    ]
    if found or scene.interactions != template.interactions:
        return np.arange(0), found or [Deviation("connectivity", refusal, forcible=False)]
    order = _order_without_stereo(scene, template)
    if order is None:
        return np.arange(0), [Deviation("connectivity", refusal, forcible=False)]
    return order, [Deviation("stereo", refusal, forcible=True)]


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
