"""MD's answer: states, free energies, maps and timescales of a molecule from many MD replicas, errors from MD alone.

Torsions -> TICA (kinetic map) -> k-means -> reversible Markov model (`surrogate.comparison.markov`). What is reported
are states that a chemist names: α, β and left-handed of each residue, and the wells of every other torsion. Frames of
a learned potential serve as well, where the energies of its reference say how much each of them counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.answer import MODEL_ERROR, Answer, Named, StateEnergy
from surrogate.comparison.markov import (
    Equilibrium,
    equilibrium,
    with_images,
    with_mean_one,
    with_prior,
)
from surrogate.comparison.measure import kinetics
from surrogate.comparison.measure.distributions import is_alpha
from surrogate.comparison.measure.movie import pick_frames
from surrogate.comparison.measure.slow_motion import SLOW_KINDS
from surrogate.comparison.measure.statistics import BoolArray, FloatArray, IntArray
from surrogate.comparison.measure.structure import Backbone, backbone
from surrogate.comparison.measure.torsions import Torsion, find_torsions, find_wells
from surrogate.comparison.pooled import pooled
from surrogate.comparison.read.ensemble import Ensemble
from systems.chemistry.geometry import column_blocks, torsion_angle
from systems.chemistry.validity import INVALID
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import frame_factors
from systems.units import GAS_CONSTANT_KJ_MOL_K, format_time_ps

_DIMENSIONS, _MICROSTATES, _FRAMES_A_MICROSTATE = 8, 100, 50
_MAP_BINS = 36
# Torsions that have states: of a ring its pucker.
_KINDS = (*SLOW_KINDS, "ring")
# What n crossings either way tell of a state of population 1/2 is off by sqrt(2 / n) / 4.
_PRIOR_CROSSINGS = 1.0 / (8.0 * MODEL_ERROR**2)
# Fewer effective frames (Kish) of a rollout that is reweighted tell no populations; where they are a smaller share of
# those asked for, asking for more does not help.
_LEAST_EFFECTIVE, _LEAST_SHARE = 50.0, 0.1
# A state that has a smaller share of a rollout is no reason to begin there.
_DRAWN_SHARE = 2e-3


class _Torsions:
    """Which torsions of a scene turn slowly, and what they are in frames."""

    def __init__(self, ensemble: Ensemble) -> None:
        scene = ensemble.scene
        self.backbone: Backbone = backbone(scene)
        self.others: list[Torsion] = [t for t in find_torsions(scene) if t.kind in _KINDS]
        rows = [self.backbone.phi, self.backbone.psi, np.array([t.quad for t in self.others]).reshape(-1, 4)]
        self.quads = np.concatenate([np.asarray(r, dtype=np.int64).reshape(-1, 4) for r in rows])
        self.fold = np.array([1] * (len(rows[0]) + len(rows[1])) + [t.fold for t in self.others])
        self.n_phi, self.n_psi = len(rows[0]), len(rows[1])
        # Of peptides tables of φ and ψ may say otherwise.
        self.has_images = not self.backbone.residues and _is_its_mirror_image(scene)

    def of(self, ensemble: Ensemble) -> list[FloatArray]:
        """Return angles `(n_frames, k)` rad per segment, times their fold; NaN where a frame is not finite."""
        out = []
        for segment in ensemble.segments:
            angles = np.empty((len(segment), len(self.quads)))
            for start in range(0, len(segment), 8192):
                block = np.asarray(segment[start : start + 8192])
                with np.errstate(invalid="ignore", over="ignore"):
                    for first, x in column_blocks(block, max(len(self.quads), 1)):
                        rows = slice(start + first, start + first + x.shape[2])
                        angles[rows] = torsion_angle(x, self.quads).T
                angles[start : start + len(block)][~np.isfinite(block).all(axis=(1, 2))] = np.nan
            folded = angles * self.fold
            out.append(np.asarray(np.arctan2(np.sin(folded), np.cos(folded))))
        return out


def _hands(angles: list[FloatArray], lag_ps: float) -> list[BoolArray] | None:
    """Return of which hand each frame is: on which side of zero in the slowest of all sums of torsions' sines (TICA),
    so that of what turns more slowly than the hand changes nothing is lost; None where MD keeps a torsion on one side
    of planar, so that nothing says that the mirror image is the same molecule."""
    from scipy.linalg import eigh

    every = np.concatenate(angles)
    if not every.shape[1] or not ((every > 0).any(0) & (every < 0).any(0)).all():
        return None
    sines = [np.nan_to_num(np.sin(a)) for a in angles]
    lag = _tica_lag(angles, lag_ps)
    now, later = (np.concatenate(x) for x in ([s[:-lag] for s in sines], [s[lag:] for s in sines]))
    both, within = now.T @ later, now.T @ now + later.T @ later
    slowest = eigh(both + both.T, within + 1e-6 * np.trace(within) * np.eye(len(within)))[1][:, -1]
    return [s @ slowest < 0 for s in sines]


def _tica_lag(angles: Sequence[FloatArray], lag_ps: float) -> int:
    """Return the lag of TICA in frames, at most a quarter of a replica."""
    return min(kinetics.tica_lag(lag_ps), max(1, int(np.median([len(a) for a in angles])) // 4))


def _is_its_mirror_image(scene: Scene) -> bool:
    """Return whether MD of a molecule reaches the mirror images of its frames, atom by atom: nothing keeps handedness,
    not even atoms with like neighbours, such as isopropyl's."""
    for element, near in zip(scene.elements, scene.neighbours(), strict=True):
        # Amines turn inside out; sulfoxides and phosphines do not.
        least = 4 if element in ("C", "N", "O") else 3
        if len(near) >= least and sum(scene.elements[k] != "H" for k in near) >= 3:
            return False
    return True


def md_answer(
    md: Ensemble, temperature_k: float, *, surrogate: Ensemble | None = None,
    factors: Sequence[FloatArray] | None = None, seed: int = 0,
) -> Answer:  # fmt: skip
    """Return what MD replicas say of equilibrium, and how a surrogate's populations compare with that.

    `md`: one segment a replica; `temperature_k` of its bath; `factors`: what each frame counts at the law of a
    reference, exp(-(U_reference - U_model) / kT) up to a constant, NaN where the reference was not asked; MD under an
    umbrella potential brings them. Of a small molecule that is its own mirror image each replica counts with its mirror
    image, where MD was on either side.
    Raises InputError where no torsion of the molecule turns, so that MD has nothing to weigh, or replicas are too short
    to tell anything.
    """
    torsions = _Torsions(md)
    if not len(torsions.quads) and factors is None:
        raise InputError(f"{md.scene.name}: no torsion turns, and so there are no states to weigh.")
    if factors is None and md.differences_kj_mol is not None:
        factors = frame_factors(md.differences_kj_mol, temperature_k)
    of_md = torsions.of(md)
    hands = _hands(of_md, md.lag_ps) if torsions.has_images else None
    angles = of_md if hands is None else [np.where(h[:, None], -a, a) for a, h in zip(of_md, hands, strict=True)]
    micro = _microstates(angles, md.lag_ps)
    found = equilibrium(micro, seed=seed)
    if hands is not None:
        found = with_images(found, micro, hands)
        angles, micro = [*angles, *(-a for a in angles)], micro * 2
    counting = None if factors is None else [*factors] * (len(micro) // len(of_md))
    own = torsions.of(surrogate) if surrogate is not None else None
    states: list[StateEnergy] = []
    named = _named_states(torsions, angles, own)
    for name, labels, names, rolled in named:
        states += _energies(found, micro, (name, names), labels, rolled, temperature_k, counting)
    states = [_said_missing(s) for s in states]
    missing = [_missing_line(s, found.n_own) for s in states if s.missing]
    if not missing:
        # What is left for good has no weight, rightly.
        for lost in (x for x in found.unconnected if x.fate != "left and never entered"):
            where = _where(lost.microstates, micro, named)
            among = f"{lost.n_replicas} of {found.n_own} replicas"
            missing.append(f"not connected: part of {where} was {lost.fate} ({among})")
    if found.method == "Markov model" and not missing and found.crossings == 0 and len(found.timescales):
        missing.append("the slowest process was seen in one direction only")
    for few in found.rare:
        times = "once" if few.crossings == 1 else f"{few.crossings} times"
        missing.append(f"hardly known: {_where(few.microstates, micro, named)}, entered and left {times}")
    ps, asked, weights = md.lag_ps, (0, 0.0), found.weights
    if factors is not None and counting is not None:
        known = np.concatenate([f[np.isfinite(f)] for f in factors])
        asked = len(known), float(known.sum() ** 2 / np.square(known).sum())
        weights = _reweighted(found, micro, counting)
        if asked[1] < _LEAST_EFFECTIVE:
            why = ": a longer `budget` makes more"
            if md.differences_kj_mol is None and asked[1] < _LEAST_SHARE * asked[0]:
                why = ", the surrogate is too far off: give one of this molecule (`surromd train`) as `weights`"
            missing.append(f"only {asked[1]:.0f} of {asked[0]} frames are effective{why}")
    answer = Answer(
        method=found.method,
        n_replicas=found.n_own,
        replica_ps=float(np.median([len(m) for m in micro])) * ps,
        lag_ps=ps,
        model_lag_ps=found.lag_frames * ps,
        timescales_ps=tuple((found.timescales * ps).tolist()),
        timescale_errors_ps=tuple((found.timescale_errors * ps).tolist()),
        tests=_tests(found, ps),
        has_images=found.n_own < len(micro),
        holds=found.holds and (factors is None or asked[1] >= _LEAST_EFFECTIVE),
        states=tuple(states),
        maps=_maps(torsions, angles, weights, temperature_k),
        missing=tuple(dict.fromkeys(missing)),
        weights=with_mean_one(weights[: found.n_own]),
        energies=asked,
        under_umbrella=md.differences_kj_mol is not None,
    )
    alike = surrogate is not None and math.isclose(surrogate.lag_ps, ps, rel_tol=1e-6)
    if not (alike or answer.under_umbrella) or own is None or not answer.wants_surrogate or answer.has_images:
        return answer
    with suppress(InputError):
        if answer.under_umbrella:
            maps = partial(_maps, torsions, angles, temperature_k=temperature_k)
            joint = pooled(answer, named, maps, temperature_k)
        else:
            joint = _joint(answer, found, (angles, own), named, torsions, temperature_k, seed)
        return answer if joint.contradicts or answer.is_better_than(joint) else joint
    return answer


def _joint(
    answer: Answer, found: Equilibrium, angles: tuple[list[FloatArray], list[FloatArray]], named: list[Named],
    torsions: _Torsions, temperature_k: float, seed: int,
) -> Answer:  # fmt: skip
    """Return the answer in which a surrogate's transitions count, too; `angles` and `named` of both. Raises InputError
    where no model fits."""
    n = len(angles[0])
    micro = _microstates(angles[0], answer.lag_ps, angles[1])
    joint = with_prior(found, micro[:n], micro[n:], crossings=_PRIOR_CROSSINGS, seed=seed)
    told = {
        (s.torsion, s.state): s
        for name, labels, names, rolled in named
        for s in _energies(joint, micro, (name, names), [*labels, *(rolled or [])], rolled, temperature_k, None)
    }
    states = []
    for own in answer.states:
        s = told[own.torsion, own.state]
        states.append(replace(s, missing=own.missing, n_replicas=own.n_replicas, n_begun=own.n_begun,
                              md_share=own.share, md_error=own.error))  # fmt: skip
    weights = joint.weights[:n]
    maps = _maps(torsions, angles[0], weights, temperature_k)
    return replace(answer, states=tuple(states), maps=maps, weights=with_mean_one(weights))


def _reweighted_shares(
    found: Equilibrium, micro: list[IntArray], labels: list[IntArray], factors: Sequence[FloatArray],
    every: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the reweighted shares and their draws; `every`: those of all frames, unweighted.

    The reference was asked about some frames, and these few are off by chance. By how much is known without weights,
    from all frames, and is taken off: control variates (Hammersley and Handscomb, Monte Carlo Methods, 5.5 (1964)),
    with the coefficient that leaves the draws the least variance, between 0 and 1.
    """
    n = len(every[0])
    weighted = found.shares(micro, labels, n, factors)
    some = found.shares(micro, labels, n, [np.where(np.isfinite(f), 1.0, np.nan) for f in factors])
    off = [a - b for a, b in zip(some, every, strict=True)]
    apart, centred = (x - x.mean(0) for x in (weighted[1], off[1]))
    variance = float(np.square(centred).sum())
    share = min(max(float((apart * centred).sum()) / variance, 0.0), 1.0) if variance > 0.0 else 0.0
    shares, draws = (np.maximum(w - share * o, 0.0) for w, o in zip(weighted, off, strict=True))
    return shares / max(shares.sum(), 1e-300), draws / np.maximum(draws.sum(1, keepdims=True), 1e-300)


def _reweighted(found: Equilibrium, micro: list[IntArray], factors: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
    """Return the weights of frames with `factors`; those that have none count by the others of their microstate."""
    every, w, f = np.concatenate(micro), np.concatenate(found.weights), np.concatenate(factors)
    n = len(found.populations) + 1
    whole, asked = (np.bincount(every % n, of, n) for of in (w, w * np.isfinite(f)))  # -1, for none, is the last
    scale = np.divide(whole, asked, out=np.zeros(n), where=asked > 0)
    return tuple(w * np.nan_to_num(f) * scale[m] for w, f, m in zip(found.weights, factors, micro, strict=True))


def _tests(found: Equilibrium, ps: float) -> str:
    """Return by what weights were found and which tests that passed."""
    if found.method == "plain averages":
        return "plain averages, as replicas outlast the slowest process"
    flat = "flat" if found.flat else "not flat"
    holds = "within errors" if found.ck_holds else "beyond errors"
    return (
        f"a reversible Markov model at a lag of {format_time_ps(found.lag_frames * ps, 2)} (timescales {flat}, "
        f"Chapman-Kolmogorov off by {found.ck_error:.2g}, {holds}; crossings of the slowest process: {found.crossings})"
    )


def _microstates(angles: list[FloatArray], lag_ps: float, beside: Sequence[FloatArray] = ()) -> list[IntArray]:
    """Return the microstate of every frame: k-means in the slow space of the torsions, one where there are none; of
    frames `beside` them as well, which are clustered with them."""
    if not angles[0].shape[1]:
        return [np.zeros(len(a), dtype=np.int64) for a in (*angles, *beside)]
    features = [kinetics.circular_features(a) for a in angles]
    projection = kinetics.fit_projection(features, _tica_lag(angles, lag_ps), _DIMENSIONS, least=0.05)
    if projection is None:
        raise InputError("MD's replicas are too short to tell states apart; give them more time.")
    coordinates = [projection.project(x) for x in (*features, *(kinetics.circular_features(a) for a in beside))]
    every = np.concatenate([x[np.isfinite(x).all(axis=1)] for x in coordinates])
    n = max(2, min(_MICROSTATES, len(every) // _FRAMES_A_MICROSTATE))
    return kinetics.assign(kinetics.k_means(every, n, 100), coordinates)


def _named_states(torsions: _Torsions, angles: list[FloatArray], own: list[FloatArray] | None) -> list[Named]:
    """Return for every residue and further torsion its name, the label of each frame of MD, the names of labels, and
    the labels of the surrogate's frames."""
    found: list[Named] = []

    def both(label: Any, *columns: int) -> tuple[list[IntArray], list[IntArray] | None]:
        def of(segments: list[FloatArray]) -> list[IntArray]:
            return [np.where(np.isfinite(a).all(axis=1), label(*(a[:, c] for c in columns)), -1) for a in segments]

        return of(angles), None if own is None else of(own)

    for residue in torsions.backbone.residues:
        labels, rolled = both(
            lambda phi, psi: np.where(phi > 0, 2, np.where(is_alpha(psi), 0, 1)),
            residue.phi,
            torsions.n_phi + residue.psi,
        )
        found.append((residue.label, labels, ("α", "β", "left-handed"), rolled))
    first = torsions.n_phi + torsions.n_psi
    for k, torsion in enumerate(torsions.others):
        of_md, of_own = ([a[:, first + k] for a in segments or []] for segments in (angles, own))
        wells = find_wells(of_md, of_own)
        if len(wells.names) < 2:
            continue
        labels, rolled = wells.labels(of_md), None if own is None else wells.labels(of_own)
        values, state = np.concatenate([*of_md, *of_own]), np.concatenate([*labels, *(rolled or [])])
        names = tuple(f"{math.degrees(kinetics.circular_mean(values[state == s]) / torsion.fold):.0f}°"
                      for s in range(len(wells.names)))  # fmt: skip
        found.append((torsion.label, labels, names, rolled))
    return found


def _energies(
    found: Equilibrium, micro: list[IntArray], named: tuple[str, tuple[str, ...]], labels: list[IntArray],
    rolled: list[IntArray] | None, temperature_k: float, factors: Sequence[FloatArray] | None,
) -> list[StateEnergy]:  # fmt: skip
    """Return the states of one torsion with their free energies."""
    torsion, names = named
    n = len(names)
    shares, draws = found.shares(micro, labels, n)
    if factors is not None:
        shares, draws = _reweighted_shares(found, micro, labels, factors, (shares, draws))
    kt = GAS_CONSTANT_KJ_MOL_K * temperature_k
    best = int(np.argmax(shares))
    n_frames = sum(map(len, labels))
    # Each replica with its images.
    replicas = [labels[k :: found.n_own] for k in range(found.n_own)]
    own, own_error = (None, None) if rolled is None else _own_shares(rolled, n)
    out = []
    for s, name in enumerate(names):
        energy = error = None
        if shares[s] > 0:
            drawn = draws[(draws[:, s] > 0) & (draws[:, best] > 0)]
            energies = -kt * np.log(drawn[:, s] / drawn[:, best]) if len(drawn) else np.zeros(0)
            energy = float(-kt * math.log(shares[s] / shares[best]))
            error = float(np.std(energies, ddof=1)) if len(energies) > 1 else None
        there = sum(any(bool((x == s).any()) for x in images) for images in replicas)
        rolled_share = None if own is None else float(own[s])
        if there == 0 and not rolled_share:
            continue
        out.append(StateEnergy(
            torsion, name, float(shares[s]), max(float(draws[:, s].std()), 1.0 / n_frames), energy, error, there,
            sum(any(bool(x[0] == s) for x in images if len(x)) for images in replicas), rolled_share,
            None if own_error is None else float(own_error[s]),
            "" if shares[s] > 0 or _left(found, micro, labels, s) else "no weight is known",
        ))  # fmt: skip
    return out


def _left(found: Equilibrium, micro: list[IntArray], labels: list[IntArray], state: int) -> bool:
    """Return whether MD was in a state and left it for good, so that no weight is the right one."""
    gone = {m for lost in found.unconnected if lost.fate == "left and never entered" for m in lost.microstates}
    inside = [m[x == state] for m, x in zip(micro, labels, strict=True)]
    every = np.concatenate(inside)
    ends = sum(bool(len(x)) and bool(x[-1] == state) for x in labels)
    return len(every) > 0 and (set(np.unique(every).tolist()) <= gone or ends == 0)


def _said_missing(state: StateEnergy) -> StateEnergy:
    if not state.missing:
        return state
    if state.n_replicas == 0:
        return replace(state, missing="only the surrogate was there; no MD began there")
    begun = f"{state.n_begun} replicas began there" if state.n_begun else "it was entered"
    return replace(state, missing=f"not connected: {begun}, and no way out and back was seen")


def _missing_line(state: StateEnergy, n: int) -> str:
    """Return what is missing of a state that some of `n` replicas may have been in."""
    if state.n_replicas == 0:
        return f"{state.torsion} {state.state}: {state.missing}"
    fate = "entered and never left" if state.n_replicas > state.n_begun else "only begun in"
    return f"not connected: {state.torsion} {state.state} was {fate} ({state.n_replicas} of {n} replicas)"


def _own_shares(labels: list[IntArray], n: int) -> tuple[FloatArray, FloatArray]:
    """Return a rollout's shares `(n,)` and their standard errors, from its replicas, or from eight parts of an only
    one."""
    parts = labels if len(labels) >= 4 else [p for x in labels for p in np.array_split(x, 8)]
    each = np.array([np.bincount(x[x >= 0], minlength=n) / max(int((x >= 0).sum()), 1) for x in parts if len(x)])
    return each.mean(0), each.std(0, ddof=1) / math.sqrt(len(each)) if len(each) > 1 else np.zeros(n)


def _where(lost: Sequence[int], micro: list[IntArray], named: list[Named]) -> str:
    """Return the state of one torsion that tells unconnected microstates from the rest best."""
    inside = np.isin(np.concatenate(micro), lost)
    best, said = 0.0, "a state"
    for name, labels, names, _ in named:
        every = np.concatenate(labels)
        for s, state in enumerate(names):
            apart = float((every[inside] == s).mean() - (every[~inside] == s).mean()) if (~inside).any() else 0.0
            if apart > best:
                best, said = apart, f"{name} {state}"
    return said


def _maps(
    torsions: _Torsions, angles: list[FloatArray], weights: Sequence[FloatArray], temperature_k: float
) -> dict[str, FloatArray]:
    """Return the free energy over φ and ψ of each residue, kJ/mol, from weighted frames."""
    every, w = np.concatenate(angles), np.concatenate(weights)
    kt = GAS_CONSTANT_KJ_MOL_K * temperature_k
    found = {}
    for residue in torsions.backbone.residues:
        phi, psi = every[:, residue.phi], every[:, torsions.n_phi + residue.psi]
        good = np.isfinite(phi) & np.isfinite(psi)
        span = [(-math.pi, math.pi)] * 2
        density = np.histogram2d(phi[good], psi[good], bins=_MAP_BINS, range=span, weights=w[good])[0]
        with np.errstate(divide="ignore"):
            found[residue.label] = np.asarray(-kt * np.log(density / max(float(density.max()), 1e-300)))
    return found


def frames_over_states(ensemble: Ensemble, n: int, *, seed: int = 0) -> npt.NDArray[np.float32]:
    """Return `n` valid frames `(n, n_atoms, 3)` nm of an ensemble, drawn so that no state of any torsion is left out.

    By turns a frame from the state that was drawn least so far, and any frame: rough weights are kept where there is
    room. In this order, so that the first few cover as much as they can.
    """
    rng = np.random.default_rng(seed)
    torsions = _Torsions(ensemble)
    angles = torsions.of(ensemble)
    flags = ensemble.flags or [np.zeros(len(a), dtype=np.uint16) for a in angles]
    good = np.concatenate([(f & INVALID) == 0 for f in flags]) & np.isfinite(np.concatenate(angles)).all(axis=1)
    valid = np.flatnonzero(good) if good.any() else np.arange(len(good))
    labels = [np.concatenate(named[1])[valid] for named in _named_states(torsions, angles, None)]
    states = [(x, s) for x in labels for s in np.unique(x).tolist() if (x == s).mean() >= _DRAWN_SHARE]
    drawn = np.zeros(len(states), dtype=int)
    picks = []
    for k in range(n):
        pool = np.arange(len(valid))
        if k % 2 == 0 and states:
            x, s = states[int(np.argmin(drawn + 1e-3 * rng.random(len(states))))]
            pool = np.flatnonzero(x == s)
        pick = int(rng.choice(pool))
        drawn += [int(x[pick] == s) for x, s in states]
        picks.append(int(valid[pick]))
    return pick_frames(ensemble.segments, np.array(picks))
