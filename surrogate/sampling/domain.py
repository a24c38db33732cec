"""Comparison of a scene with the training domain of weights, before anything is computed."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import networkx as nx
import numpy as np
import numpy.typing as npt
import torch

from surrogate.data import in_standard_pose
from surrogate.models.architecture import architecture, shipped_weights
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.peptides.chains import FREE_ENDS
from surrogate.models.peptides.layout import PeptideConfig, chain_features, standard_peptide
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.potential import Potential
from surrogate.models.propagator import Propagator, draw_noise
from surrogate.models.weights import Chemistry, TrainingDomain, Weights, load_weights, read_header
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import STIFF_STEP_PS, backbone_torsions, bonded_graph, has_stiff_bond, match_atoms
from systems.chemistry.validity import INVALID, NOT_FINITE, Geometry, check_frames, flag_names, geometry_from_scene
from systems.errors import InputError, OutOfDomainError
from systems.scene import ATOMIC_NUMBERS, Scene
from systems.units import format_time_ps


class Deviation(NamedTuple):
    """One way in which a scene leaves the training domain: `what` (molecule, start or temperature, of an unseen peptide
    also residues, size or ends), the `reason` in words, and whether the model can be run nevertheless (`forcible`)."""

    what: str
    reason: str
    forcible: bool

    def to_dict(self) -> dict[str, Any]:
        """Return what a trajectory's record keeps of it."""
        return {"what": self.what, "reason": self.reason}


def member_of(scene: Scene, domain: TrainingDomain) -> TrainingDomain | None:
    """Return the domain of the one molecule that a scene is, of all that weights were trained on; None of another. The
    one domain of weights for one molecule is returned whatever the scene."""
    if not domain.transferable:
        return domain
    for member in domain.members:
        try:
            match_atoms(scene, member.scene)
        except OutOfDomainError:
            continue
        return replace(member, further=(), sequences=(), transferable=False)
    return None


_CAPS = ("ACE", "NME", "NH2")


def cover_peptide(
    scene: Scene, domain: TrainingDomain, config: PeptideConfig
) -> tuple[TrainingDomain, npt.NDArray[np.int64], tuple[Deviation, ...]]:
    """Return the domain of an unseen peptide, the order of its atoms in the model, and how it leaves the training.

    The molecule is the scene under standard names; a valid frame has the bond lengths and angles that such residues
    have on average in the training references. A residue, or an end of a chain, that no training peptide has cannot be
    forced; more residues than any of them has, with free ends or without, a residue at a free end that none has there,
    a strained start and a cis peptide bond can.
    """
    try:
        standard, order = standard_peptide(scene)
        chain = chain_features(standard, config)
    except InputError as error:
        return domain, np.arange(0), (Deviation("residues", str(error).rstrip("."), forcible=False),)
    found = []
    free = any(_free_ends(standard.residue_names))
    most = max((_n_amino_acids(one) for one in domain.peptides if any(_free_ends(one)) or not free), default=0)
    if (n := _n_amino_acids(standard.residue_names)) > most:
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
    if flags := _flags_of_start(standard.positions_nm, geometry):
        reason = f"the starting structure is unlike frames of such residues ({', '.join(flag_names(flags))})"
        found.append(Deviation("start", reason, forcible=True))
    omega = backbone_torsions(standard)["omega"]
    cis = np.abs(torsion(standard.positions_nm, omega)) < 0.5 * np.pi
    if any(standard.residue_names[standard.residue_of_atom[n]] != "PRO" for n in omega[cis.reshape(-1), 2].tolist()):
        found.append(Deviation("start", "a peptide bond is cis; training has trans ones alone", forcible=True))
    conditions = {
        key: value if all(member.conditions.get(key) == value for member in domain.members) else None
        for key, value in domain.conditions.items()
    }
    own = replace(
        domain, scene=in_standard_pose(standard), conditions=conditions, geometry=geometry.to_dict(), limits=None,
        further=(), sequences=(), transferable=False,
    )  # fmt: skip
    return own, order, tuple(found)


def unseen_neighbours(scene: Scene, domain: TrainingDomain) -> list[str]:
    """Return the pairs of neighbouring residues of a standard peptide that no training peptide has, as 'LEU-SER', or,
    where residues bear free ends, 'NH3+-LEU'."""
    known = {pair for one in domain.peptides for pair in _pairs(one)}
    return [f"{a}-{b}" for a, b in dict.fromkeys(_pairs(scene.residue_names)) if (a, b) not in known]


def _pairs(residues: tuple[str, ...]) -> list[tuple[str, str]]:
    first, last = ([end] * free for end, free in zip(FREE_ENDS, _free_ends(residues), strict=True))
    return list(pairwise([*first, *residues, *last]))


def _free_ends(residues: tuple[str, ...]) -> tuple[bool, bool]:
    """Return whether a chain's first residue bears an end of its own, and whether its last does."""
    return residues[0] not in _CAPS, residues[-1] not in _CAPS


def _n_amino_acids(residues: tuple[str, ...]) -> int:
    return sum(name not in _CAPS for name in residues)


# Copies of a molecule and chunks of MD on a potential by which its members are asked whether they know it.
_ASKED_COPIES, _ASKED_CHUNKS = 16, 2
# Answers that are kept: one command asks about a molecule in several baths.
_REMEMBERED = 8
_doubts_of: dict[tuple[object, ...], tuple[Deviation, ...]] = {}


def cover_molecule(scene: Scene, domain: TrainingDomain, known: Chemistry) -> tuple[TrainingDomain, list[Deviation]]:
    """Return the domain of a molecule that a potential was not trained on, and how it leaves the training: another
    element, a charge beyond those trained on, an odd number of electrons or several molecules cannot be forced, more
    atoms can. A valid frame has the bond lengths of the scene."""
    charge = int(scene.formal_charges.sum())
    electrons = sum(ATOMIC_NUMBERS.get(e, 0) for e in scene.elements) - charge
    least, most = known.charges
    reasons = [
        f"holds {', '.join(others)}" if (others := sorted(set(scene.elements) - set(known.elements))) else "",
        f"bears a charge of {charge:+d} e" if not least <= charge <= most else "",
        "has an odd number of electrons" if electrons % 2 else "",
        f"is {n} molecules" if (n := nx.number_connected_components(bonded_graph(scene))) > 1 else "",
    ]
    found = [Deviation("molecule", " and ".join(filter(None, reasons)), forcible=False)] if any(reasons) else []
    if scene.n_atoms > known.n_atoms:
        found.append(Deviation("size", f"{scene.n_atoms} atoms; trained on up to {known.n_atoms}", forcible=True))
    own = replace(
        domain, scene=in_standard_pose(scene), geometry=geometry_from_scene(scene).to_dict(), limits=None, further=(),
        transferable=False, chemistry=None,
    )  # fmt: skip
    return own, found


def disagreement(scene: Scene, model: PainetPotential) -> tuple[float, int]:
    """Return by how much a potential's members differ on forces in short MD of a molecule (`PainetPotential.spread`,
    kJ/mol/nm, the median of its replicas), and how many of sixteen replicas do not stay this molecule."""
    # As it will be rolled, so that its minimum is known there.
    scene = in_standard_pose(scene)
    molecule = model.featurise(scene)
    x = torch.tensor(scene.positions_nm, dtype=torch.float32).expand(_ASKED_COPIES, 1, -1, -1)
    generators = [torch.Generator().manual_seed(seed) for seed in range(_ASKED_COPIES)]
    v = None
    for _ in range(_ASKED_CHUNKS):
        chunk = model.next_chunk(x, molecule, draw_noise(model, scene.n_atoms, generators), last_velocities_nm_ps=v)
        x, v = chunk.frames_nm[:, -1:], chunk.velocities_nm_ps
    lost = check_frames(x[:, 0].numpy(), geometry_from_scene(scene)) & INVALID > 0
    return float(model.spread(x[:, 0], molecule).median()), int(lost.sum())


def _doubts(scene: Scene, model: PainetPotential, known: Chemistry) -> tuple[Deviation, ...]:
    """Return the deviation of a molecule that MD on a potential does not keep whole, or on whose forces its members
    disagree in that MD."""
    spread, n_lost = disagreement(scene, model)
    if n_lost:
        reason = f"the molecule breaks or changes in {n_lost} of {_ASKED_COPIES} short test runs"
    elif spread > known.spread_kj_mol_nm:
        limit = f"the limit is {known.spread_kj_mol_nm:.3g}"
        reason = f"the ensemble members' forces differ by {spread:.3g} kJ/mol/nm in short MD; {limit}"
    else:
        return ()
    return (Deviation("spread", reason, forcible=True),)


_ROUNDING = 1e-6
# How near atoms of a start may come, of how near those of frames may.
_ROOM_OF_START = 0.85


def choose_lag(weights: Weights, lag_ps: float | None, save_every_ps: float | None) -> float:
    """Return the lag of a rollout: the one asked for, else the longest that keeps populations and that the save
    interval is a multiple of, without either the shortest. Raises InputError for a lag that the weights were not
    trained for."""
    domain, name = weights.domain, weights.path.name
    low, high = domain.lag_ps, domain.longest_lag_ps
    if not domain.jumps:
        if lag_ps is not None and not math.isclose(lag_ps, low, rel_tol=_ROUNDING):
            raise InputError(f"{name} steps {format_time_ps(low)} and takes no other lag; leave `lag_ps` out.")
        return low
    if lag_ps is None:
        if save_every_ps is None:
            return low
        model = weights.model
        longest, usual = (
            save_every_ps / max(1, math.ceil(save_every_ps / most - _ROUNDING))
            for most in (high, min(high, model.usual_lag_ps or high))
        )
        lag_ps = longest if model.keeps_populations(longest) else usual
    if not low * (1 - _ROUNDING) <= lag_ps <= high * (1 + _ROUNDING):
        raise InputError(
            f"{name} was trained for lags of {format_time_ps(low)} to {format_time_ps(high)}, not for "
            f"{format_time_ps(lag_ps)}; choose `lag_ps`, or `save_every_ps`, inside that range."
        )
    return lag_ps


def at_lag(weights: Weights, domain: TrainingDomain, lag_ps: float) -> Weights:
    """Return the weights for one molecule's `domain` with a model that steps `lag_ps`, and limits of jumps at it."""
    if not domain.jumps:
        return weights if domain is weights.domain else replace(weights, domain=domain)
    limits = domain.limits
    if limits is not None:
        lags, least, most = np.array(domain.jumps).T
        after = int(np.clip(np.searchsorted(lags, lag_ps * (1 - _ROUNDING)), 0, len(lags) - 1))
        # Between two measured lags the wider of their limits.
        around = slice(after if math.isclose(lags[after], lag_ps, rel_tol=_ROUNDING) else max(after - 1, 0), after + 1)
        limits = {**limits, "jump_min_nm": float(least[around].min()), "jump_max_nm": float(most[around].max())}
    return replace(
        weights, model=weights.model.at_lag(lag_ps), domain=replace(domain, lag_ps=lag_ps, limits=limits, jumps=())
    )


# A model that does not take the temperature as an input has one; a thermostat is set more finely than this by nobody.
TEMPERATURE_TOLERANCE_K = 0.5


class DomainMatch(NamedTuple):
    """How a scene fits weights. `order (n_atoms,)`: model atom k is scene atom `order[k]`; `domain`: training domain of
    the scene's molecule; `deviations`: those that `force` overruled; `seen`: whether the molecule was trained on;
    `nearness`: of an unseen peptide, how near to it training comes, in words."""

    order: npt.NDArray[np.int64]
    domain: TrainingDomain
    deviations: tuple[Deviation, ...] = ()
    seen: bool = True
    nearness: str = ""

    def input_notes(self, weights: str) -> tuple[str, ...]:
        """Return what is to be said before the scene is rolled with weights of this name; nothing inside the domain."""
        near = f" ({self.nearness})" if self.nearness else ""
        unseen = f"{weights} was not trained on this molecule{near}; compare with MD of it before you trust the rollout"
        beyond = (f"outside the training domain: {d.what}: {d.reason}" for d in self.deviations)
        return (*(() if self.seen else (unseen,)), *beyond)


def find_deviations(
    scene: Scene, domain: TrainingDomain, *, model: Propagator | None = None, temperature_k: float | None = None
) -> tuple[Deviation, ...]:
    """Return how a scene leaves a training domain, the gravest first; nothing where the weights cover it. `model`: of
    these weights; one that knows peptides by residues covers other sequences, too."""
    return _compare(scene, domain, None if model is None else _peptides(model), temperature_k).deviations


def match_domain(
    scene: Scene, weights: Weights, *, temperature_k: float | None = None, force: bool = False
) -> DomainMatch:
    """Return the order of a scene's atoms in the model, and what of the training domain it leaves under `force`: a
    strained start and another temperature can be forced, another molecule or stereoisomer cannot. A potential takes
    any temperature, and its members are asked in MD at that.

    Raises OutOfDomainError, which says how the scene differs, what the weights cover and what to run instead.
    """
    if isinstance(weights.model, Potential) and temperature_k not in (None, weights.model.config.temperature_k):
        weights = in_bath(weights, {"temperature_k": temperature_k})
    name, known = weights.path.name, weights.domain.chemistry
    match = match_known(scene, weights.domain, name, _peptides(weights.model), temperature_k=temperature_k,
                        force=force)  # fmt: skip
    if known is None or match.seen:
        return match
    model = in_step(weights, scene).model
    assert isinstance(model, PainetPotential)
    asked = weights.hash, known, model.config, scene.topology_hash, scene.positions_nm.tobytes()
    if asked not in _doubts_of:  # one command asks several times, for seconds each
        if len(_doubts_of) >= _REMEMBERED:
            _doubts_of.clear()
        _doubts_of[asked] = _doubts(scene, model, known)
    found = match
    if doubts := _doubts_of[asked]:
        found = match._replace(deviations=(*match.deviations, *doubts), nearness="")
    return _refused(scene, found, weights.domain, name, force=force)


def match_known(
    scene: Scene, domain: TrainingDomain, name: str, peptides: PeptideConfig | None = None, *,
    temperature_k: float | None = None, force: bool = False,
) -> DomainMatch:  # fmt: skip
    """`match_domain` for weights that are not loaded; `peptides`: the settings of a model that knows peptides by their
    residues."""
    return _refused(scene, _compare(scene, domain, peptides, temperature_k), domain, name, force=force)


def _refused(scene: Scene, found: DomainMatch, domain: TrainingDomain, name: str, *, force: bool) -> DomainMatch:
    """Return the match where nothing speaks against it. Raises OutOfDomainError."""
    deviations = found.deviations
    barred = [d for d in deviations if not d.forcible]
    if not barred and (force or not deviations):
        return found
    reasons = "; ".join(f"{d.what}: {d.reason}" for d in deviations)
    advice = "Run `surromd reference` for it instead, or roll with `force=True`: the trajectory is then marked."
    if barred:
        advice = "Run `surromd reference` for this molecule, then `surromd train` on it."
    raise OutOfDomainError(
        f"{name} does not cover {scene.name}: {reasons}. These weights cover {domain.describe()}. {advice}",
        brief=f"{name} does not cover it: {reasons}",
        forcible=not barred,
    )


def fit_weights(
    scene: Scene, weights: Weights, *, temperature_k: float | None = None, force: bool = False,
    lag_ps: float | None = None, save_every_ps: float | None = None, solvent: str | None = None,
) -> tuple[Weights, DomainMatch]:  # fmt: skip
    """Return weights as a rollout of this scene takes them, for one molecule in one solvent at one lag, and the match
    to that. Raises OutOfDomainError as `match_domain` and `under_conditions` do, InputError for a lag that the weights
    were not trained for."""
    weights = in_step(under_conditions(weights, {"solvent": solvent}), scene)
    match = match_domain(scene, weights, temperature_k=temperature_k, force=force)
    return at_lag(weights, match.domain, choose_lag(weights, lag_ps, save_every_ps)), match


def in_bath(weights: Weights, asked: dict[str, Any]) -> Weights:
    """Return weights that integrate as asked (`RolloutConfig.bath`), where they are a potential; a temperature asked
    of others is compared with theirs (`match_domain`). Raises InputError for anything else asked of these."""
    if not isinstance(weights.model, Potential):
        if others := sorted(asked.keys() - {"temperature_k"}):
            named = ", ".join(f"`{name}`" for name in others)
            raise InputError(f"{weights.model.arch} learned its bath with its frames; leave {named} out.")
        return weights
    if not asked:
        return weights
    model, domain = weights.model.in_bath(asked), weights.domain
    changed = {name: value for name, value in asked.items() if name in domain.conditions}
    if "constrain_hydrogens" in domain.conditions:
        changed["constrain_hydrogens"] = model.config.constrain_hydrogens
    return replace(weights, model=model, domain=replace(domain, conditions={**domain.conditions, **changed}))


def in_step(weights: Weights, scene: Scene) -> Weights:
    """Return weights whose potential, if they are one, takes no longer steps than MD of this scene does."""
    model = weights.model
    too_long = isinstance(model, Potential) and model.config.timestep_ps > STIFF_STEP_PS and has_stiff_bond(scene)
    return in_bath(weights, {"timestep_ps": STIFF_STEP_PS}) if too_long else weights


def _peptides(model: Propagator) -> PeptideConfig | None:
    return model.config if isinstance(model, PeptideSlide) else None


def _compare(
    scene: Scene, domain: TrainingDomain, peptides: PeptideConfig | None, temperature_k: float | None
) -> DomainMatch:
    member = member_of(scene, domain)
    own, order, nearness, seen = member or domain, np.arange(0), "", member is not None
    if member is None and peptides is not None:
        own, order, beyond = cover_peptide(scene, domain, peptides)
        found, seen = list(beyond), own.scene.residue_names in domain.peptides
        new = ", ".join(unseen_neighbours(own.scene, domain)) if not any(not d.forcible for d in found) else ""
        nearness = f"neighbouring residues not seen in training: {new}" if new else "each pair of residues seen"
    elif member is None and domain.chemistry is not None:
        own, found = cover_molecule(scene, domain, domain.chemistry)
        order = np.arange(scene.n_atoms)
        nearness = "its ensemble members agree on the forces"
    elif member is None:
        found = [Deviation("molecule", "another one than those trained on", forcible=False)]
    else:
        try:
            order = match_atoms(scene, own.scene)
            found = _compare_start(scene, order, Geometry.from_dict(own.geometry))
        except OutOfDomainError as error:
            found = [Deviation("molecule", str(error).rstrip("."), forcible=False)]
    trained_k = domain.conditions.get("temperature_k")
    asked_k = trained_k if temperature_k is None else temperature_k
    if trained_k is not None and abs(asked_k - trained_k) > TEMPERATURE_TOLERANCE_K:
        reason = f"{asked_k:g} K, trained at {trained_k:g} K, and this model takes no temperature"
        found.append(Deviation("temperature", reason, forcible=True))
    return DomainMatch(order, own, tuple(found), seen, nearness)


def _compare_start(scene: Scene, order: npt.NDArray[np.int64], geometry: Geometry) -> list[Deviation]:
    if not (flags := _flags_of_start(scene.positions_nm[order], geometry)):
        return []
    reason = f"the starting structure is no frame of the training reference ({', '.join(flag_names(flags))})"
    return [Deviation("start", reason, forcible=not flags & NOT_FINITE)]


def _flags_of_start(positions_nm: npt.NDArray[np.float64], geometry: Geometry) -> int:
    """Return the flags of a start, whose atoms may be somewhat nearer than those of frames: it is no frame of MD."""
    roomy = replace(geometry, clash_min_nm=_ROOM_OF_START * geometry.clash_min_nm)
    return int(check_frames(positions_nm, roomy)[0]) & INVALID


def choose_weights(
    scene: Scene, *, temperature_k: float | None = None, conditions: Mapping[str, Any] | None = None
) -> tuple[Weights, str]:
    """Return the shipped weights that cover a scene, and why these: trained on the molecule before those that know
    molecules like it, drawing frames before potentials, which take far longer, for several lags before one.

    `conditions`: force field and solvent that they must have been trained under, if any. Raises OutOfDomainError, which
    says what the nearest lack, when none covers the scene.
    """
    found, refusals, levels, loaded, at_other_k = [], [], {}, {}, False
    asked = conditions or {}
    for name, path in shipped_weights().items():
        header = read_header(path)
        arch = architecture(header.arch)
        config = arch.config(header.config)
        peptides = config if isinstance(config, PeptideConfig) else None
        is_potential = isinstance(arch.model, type) and issubclass(arch.model, Potential)
        asked_k = None if is_potential else temperature_k
        general, level = header.domain.chemistry is not None, header.domain.conditions.get("force_field")
        if general and asked.get("force_field") != level:
            with suppress(OutOfDomainError):
                match_known(scene, header.domain, path.name, peptides, temperature_k=asked_k)
                said = f"{name}, where its level is asked for: `level='{level}'`."
                refusals.append((True, 0, name, OutOfDomainError(said, brief=f"{name} is of another level")))
            continue
        apart = False  # of conditions
        try:
            match = match_known(scene, header.domain, path.name, peptides, temperature_k=asked_k)
            apart = True
            domain = domain_under(header.domain, asked, path.name)
            apart = False
            if domain is not header.domain:
                match = match_known(scene, domain, path.name, peptides, temperature_k=asked_k)
            if general:  # by MD: last
                bath = {} if temperature_k is None else {"temperature_k": temperature_k}
                loaded[name] = in_bath(load_weights(path), bath)
                match_domain(scene, loaded[name])
        except OutOfDomainError as error:
            if asked_k is not None:
                with suppress(OutOfDomainError):
                    match_known(scene, header.domain, path.name, peptides)
                    domain_under(header.domain, asked, path.name)
                    at_other_k = True
            n_reasons = 0 if general else len(error.args[0].split("; "))
            refusals.append((*((False, 0) if apart else (not error.forcible, n_reasons)), name, error))
            continue
        levels[name] = header.domain.conditions.get("force_field")
        found.append((not match.seen, is_potential, not header.domain.jumps, name, path))
    # No potential, of another level, for the temperature alone.
    if not found or (at_other_k and all(is_potential for _, is_potential, *_ in found)):
        nearest = min(refusals, key=lambda one: one[:3])[3] if refusals else OutOfDomainError("none are shipped.")
        raise OutOfDomainError(
            f"no shipped weights cover {scene.name}, and none are named. The nearest: {nearest}", brief=nearest.brief
        )
    unseen, *_, name, path = min(found)
    others = sorted(other for other, level in levels.items() if other != name and level == levels[name])
    why = "cover this molecule although it was not in their training set" if unseen else "were trained on this molecule"
    beside = f"; {', '.join(others)} would also work" if others else ""
    # Those that were asked know the molecule's minimum.
    weights = loaded.get(name) or load_weights(path)
    solvent = f"; {said}" if (said := assumed_solvent(weights.domain, asked)) else ""
    said = f"no weights named: using the shipped {name}, which {why}{beside}{solvent}"
    return under_conditions(weights, asked), said


def assumed_solvent(domain: TrainingDomain, asked: Mapping[str, Any]) -> str:
    """Return which solvent is meant where none is asked for and weights know several, else nothing."""
    first, *others = map(str, domain.solvents)
    if asked.get("solvent") or not others:
        return ""
    return f"no solvent named: taken to be in {first}; known too: {' and '.join(others)}"


def under_conditions(weights: Weights, asked: Mapping[str, Any]) -> Weights:
    """Return weights as those of the solvent that is asked for, the first where there are several and none is named.
    Raises OutOfDomainError where they were trained under other conditions."""
    domain, model = domain_under(weights.domain, asked, weights.path.name), weights.model
    solvent = domain.conditions.get("solvent")
    if solvent != model.solvent and isinstance(model, PeptideSlide) and model.config.solvents:
        model = copy.copy(model)
        model.solvent = solvent
        if solvent != model.config.solvents[0]:
            model.usual_lag_ps = model.usual_lag_elsewhere_ps
    return (
        weights if domain is weights.domain and model is weights.model else replace(weights, model=model, domain=domain)
    )


def domain_under(domain: TrainingDomain, asked: Mapping[str, Any], name: str) -> TrainingDomain:
    """Return the domain of the molecules that weights of that name saw in one solvent, as `under_conditions` does."""
    members, solvents = domain.members, domain.solvents
    if len(solvents) > 1:
        solvent = asked.get("solvent") or solvents[0]
        members = tuple(m for m in members if m.conditions.get("solvent") == solvent)
        if not members:
            raise OutOfDomainError(f"{name} was trained in {' and '.join(map(str, solvents))}, not in {solvent}")
    known = members[0].conditions
    apart = [f"{key} {known[key]}, not {value}" for key, value in asked.items()
             if value is not None and known.get(key) not in (None, value)]  # fmt: skip
    if apart:
        raise OutOfDomainError(f"{name} was trained under other conditions: {', '.join(apart)}")
    if len(solvents) == 1:
        return domain
    return replace(members[0], further=members[1:], transferable=domain.transferable, chemistry=domain.chemistry)
