"""Detailed balance and rates of the probabilities that torsions change their states, set after training."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from surrogate.models.peptides import chains
from surrogate.models.peptides.layout import ENDS
from surrogate.models.peptides.model import PeptideSlide, times_apart
from surrogate.models.peptides.state_jumps import StateJumps
from surrogate.models.peptides.subjects import PeptideSubject

# Trained by log-likelihood alone, not quite as many frames of equilibrium go one way as the other, and populations err
# by as much; and a training that is short, as one on little data must be, has not moved rates far. So after it the
# levels of residues' types are moved, for every change of every torsion: both directions alike to where as many are
# expected as runs show, and one against the other to where fluxes are equal, in the mean over training peptides.
#
# Runs from chosen starts show hundreds of exits from phi > 0 and hardly an entry, and a rate that is three times too
# high shows in no loss. There the probabilities of entering alone are moved, given those of leaving and the free energy
# of phi > 0 (umbrella sampling).

# Frames of either side at which probabilities are read, drawn anew by this seed, and how long after them.
_SIDE_FRAMES, _SIDE_SEED = 1000, 0
_TIMES_PS = (3.0, 10.0, 30.0, 100.0)
# Of a side that fewer frames show, nothing is said.
_LEAST_FRAMES = 50
_PASSES = 4
# Holds levels that few peptides show near zero, and what one torsion may ask for within bounds.
_RIDGE, _MOST = 0.3, 3.0
# Of changes between other states: frames of equilibrium by which they are counted, and after how many steps of a
# rollout: in one step many go back and forth over a barrier. How often levels are moved, how far, squared, what one
# level says for all peptides is from each, and what holds levels near zero. Steps after which runs are as far on their
# way to equilibrium as the first number says do not tell how fast.
_FRAMES, _STEP_PS, _STEPS = 1000, 10.0, (2, 10)
_MIXED, _CHANGES_PASSES, _MOLECULES_DIFFER, _CHANGES_RIDGE = 0.8, 3, 0.1, 5.0
# Variances of how far logarithms of ratios of populations are off in another solvent: between types of residues, and of
# what all have alike. With more for types, pairs that are left out come out worse (docs/results/water.md).
_TYPES_DIFFER, _LACKING_ALIKE = 0.1, 1.0
# Where psi stands among torsions.
_PSI = 1
# Neighbours that are no residues: free ends and caps.
_ENDS = (*ENDS, "ACE", "NME")


class Phi(NamedTuple):
    """One phi of a peptide: its `residue`; frames well on its negative and on its positive side, `observed` (n,
    n_residues, n_slots) and `states` (n, n_residues, MOST_TORSIONS) of each; and how likely `positive` is beside the
    other."""

    chain: chains.ChainFeatures
    residue: int
    observed: tuple[Tensor, ...]
    states: tuple[Tensor, ...]
    positive: float


class Change(NamedTuple):
    """Two states of one torsion of a residue: the `types` of the residue and of those beside it, which `torsion`, both
    states, the logarithm of how many more frames go back from the second than to it, and how far, squared, it errs; and
    how many changes of either direction are `expected` and `seen` in as many windows as the runs hold end to end,
    those included that went back."""

    types: tuple[int, int, int]
    torsion: int
    states: tuple[int, int]
    lacking: float
    variance: float
    expected: float = 0.0
    seen: float = 0.0

    @property
    def slow(self) -> float:
        """The logarithm of how many times too rare it is."""
        return math.log((self.seen + 0.5) / (self.expected + 0.5))

    @property
    def counted(self) -> float:
        """The inverse of how far, squared, `lacking` and `slow` err, and since molecules differ."""
        return 1.0 / (self.variance + _MOLECULES_DIFFER)


@torch.no_grad()
def balance(model: PeptideSlide, subjects: Sequence[PeptideSubject]) -> None:
    """Move the probabilities of changes of `model` to where detailed balance holds in the mean over `subjects` in each
    solvent, whose weights say how likely states are; those without weights play no part."""
    for solvent, jumps in enumerate(model.all_jumps):
        _balance(model, cast(StateJumps, jumps), [s for s in subjects if s.chain.solvent == solvent])


def _ends(model: PeptideSlide) -> list[int]:
    """Return the types that are no residues."""
    return [k for k, name in enumerate((*ENDS, *model.config.types)) if name in _ENDS]


def _balance(model: PeptideSlide, jumps: StateJumps, subjects: Sequence[PeptideSubject]) -> None:
    """Do so in one solvent."""
    ends = torch.tensor(_ends(model))
    for _ in range(_CHANGES_PASSES):
        found: dict[tuple[int, int, int], list[Change]] = {}
        for change in (change for subject in subjects for change in changes(model, subject)):
            found.setdefault((change.torsion, *change.states), []).append(change)
        for (torsion, a, b), some in found.items():
            levels = _own_levels(jumps, ends, some, [c.lacking for c in some]) / 2
            rates = _own_levels(jumps, ends, some, [c.slow for c in some])
            jumps.raise_change(torsion, a, b, rates + levels)
            jumps.raise_change(torsion, b, a, rates - levels)
    phis = [phi for subject in subjects for phi in weighted_phis(model, subject)]
    types = [phi.chain.places[phi.residue, :3].tolist() for phi in phis]
    for _ in range(_PASSES if phis else 0):
        jumps.raise_change(
            0, 0, 1, levels_of_types(jumps, types, [lacking_entries(model, phi) for phi in phis], _RIDGE)
        )


@torch.no_grad()
def set_pace(model: PeptideSlide, subjects: Sequence[PeptideSubject]) -> None:
    """Move how often psi changes its state beside other residues, by one factor for any residue before it and one for
    any after, to what the runs of `subjects` in a solvent show. A few ns of each say no more: not which side is
    likelier, nor how residues differ. Residues between caps keep their pace."""
    ends = _ends(model)
    for solvent, jumps in enumerate(cast(list[StateJumps], list(model.all_jumps))):
        some = [s for s in subjects if s.chain.solvent == solvent]
        for _ in range(_CHANGES_PASSES if some else 0):
            found = [change for subject in some for change in changes(model, subject) if change.torsion == _PSI]
            beside = torch.tensor([[kind not in ends for kind in c.types[1:]] for c in found]).double().reshape(-1, 2)
            factors = _nearest(beside, found, [change.slow for change in found])
            levels = jumps.of_change.new_zeros(3, jumps.of_change.shape[1])
            levels[1:] = factors[:, None]
            levels[1:, ends] = 0.0
            for a, b in ((0, 1), (1, 0)):
                jumps.raise_change(_PSI, a, b, levels)


@torch.no_grad()
def transfer(model: PeptideSlide, subjects: Sequence[PeptideSubject]) -> None:
    """Give other solvents the probabilities of the first, changes as often as they have them: by one factor for every
    two states of a kind of torsion, and for psi one more beside a residue before and one beside a residue after.
    Little MD tells these factors, in the mean over frames of `subjects` in a solvent, and not what each type does."""
    ends = _ends(model)
    for solvent, jumps in enumerate(cast(list[StateJumps], list(model.all_jumps))):
        some = [s for s in subjects if s.chain.solvent == solvent and solvent > 0]
        if not some:
            continue
        wanted = [_paces(model, subject) for subject in some]
        jumps.load_state_dict(model.jumps.state_dict())
        for _ in range(_CHANGES_PASSES):
            found: dict[tuple[int, int, int], list[tuple[list[float], float]]] = {}
            for subject, own in zip(some, wanted, strict=True):
                types = subject.chain.places[:, 1:3].tolist()
                for (r, torsion, a, b), pace in _paces(model, subject).items():
                    beside = [float(torsion == _PSI and kind not in ends) for kind in types[r]]
                    found.setdefault((torsion, a, b), []).append(([1.0, *beside], own[r, torsion, a, b] - pace))
            for (torsion, a, b), each in found.items():
                parts, lacking = (torch.tensor(x).double() for x in zip(*each, strict=True))
                held = parts.T @ parts + _RIDGE * torch.eye(3)
                levels = (
                    torch.linalg.solve(held, parts.T @ lacking).float()[:, None].repeat(1, jumps.of_change.shape[1])
                )
                levels[1:, ends] = 0.0
                jumps.raise_change(torsion, a, b, levels.to(jumps.of_change.device))
                jumps.raise_change(torsion, b, a, levels.to(jumps.of_change.device))


def _paces(model: PeptideSlide, subject: PeptideSubject) -> dict[tuple[int, int, int, int], float]:
    """Return the logarithm of how often each torsion of each residue changes between two states, by (residue, torsion,
    state, state), either direction, from frames of a peptide evenly drawn."""
    generator = torch.Generator().manual_seed(_SIDE_SEED)
    idx = torch.randint(subject.frames.n_frames, (_FRAMES,), generator=generator)
    flux, _, held = _fluxes(model, subject, idx, generator)
    return {(r, k, a, b): float(flux[r, k, a, b] + flux[r, k, b, a]) / 2
            for r, k, a, b in _pairs_of_states(subject, held, signs=True)}  # fmt: skip


def population_levels(model: PeptideSlide, some: Sequence[Change]) -> dict[tuple[int, int, int], Tensor]:
    """Return, by (torsion, state, state), the levels `(3, n_types)` of residues, of those before and of those after by
    which the second state should become likelier beside the first: what each type lacks, and of psi what residues lack
    alike beside one before, and beside one after. They are the likeliest where these scatter about zero as
    `_TYPES_DIFFER` and `_LACKING_ALIKE` say."""
    ends, found = _ends(model), {}
    for key in dict.fromkeys((c.torsion, *c.states) for c in some):
        each = [c for c in some if (c.torsion, *c.states) == key]
        has = F.one_hot(torch.tensor([c.types[0] for c in each]), model.config.n_types).double()
        beside = [[key[0] == _PSI and kind not in ends for kind in c.types[1:]] for c in each]
        part = torch.cat([has, torch.tensor(beside).double()], dim=1)
        scatter = torch.tensor([_TYPES_DIFFER] * has.shape[1] + [_LACKING_ALIKE] * 2).double()
        weighed = torch.tensor([c.counted for c in each]).double() * part.T
        lacking = torch.tensor([c.lacking for c in each]).double()
        levels = torch.linalg.solve(weighed @ part + torch.diag(1.0 / scatter), weighed @ lacking).float()
        found[key] = torch.cat([levels[None, :-2], levels[-2:, None].expand(-1, has.shape[1])]).clone()
        found[key][1:, ends] = 0.0
    return found


@torch.no_grad()
def raise_populations(model: PeptideSlide, solvent: int, levels: Mapping[tuple[int, int, int], Tensor]) -> None:
    """Move changes between two states in a solvent, one direction against the other, by levels as of
    `population_levels`: the pace stays."""
    jumps = cast(StateJumps, model.all_jumps[solvent])
    for (torsion, a, b), each in levels.items():
        jumps.raise_change(torsion, a, b, each.to(jumps.of_change.device) / 2)
        jumps.raise_change(torsion, b, a, -each.to(jumps.of_change.device) / 2)


def levels_of_types(
    jumps: StateJumps, types: Sequence[Sequence[int]], lacking: Sequence[float], ridge: float
) -> Tensor:
    """Return levels `(3, n_types)` of residues, of those before and of those after, whose sums come nearest to what is
    `lacking` where residues have these `types` (n, 3)."""
    has = F.one_hot(torch.tensor(types), jumps.of_change.shape[1]).flatten(1).double()
    held = has.T @ has + ridge * torch.eye(has.shape[1], dtype=torch.float64)
    found = torch.linalg.solve(held, has.T @ torch.tensor(lacking, dtype=torch.float64).clamp(-_MOST, _MOST))
    return found.reshape(3, -1).float().to(jumps.of_change.device)


def _own_levels(jumps: StateJumps, ends: Tensor, some: Sequence[Change], lacking: Sequence[float]) -> Tensor:
    """Return levels `(3, n_types)` that come near to what is `lacking` (n,): first all residues move alike, then those
    beside caps and at free ends, which have the types `ends`, then each. Levels of other neighbours stay: moved so,
    they bring peptides that are left out farther from what they lack."""
    has = F.one_hot(torch.tensor([c.types for c in some]), jumps.of_change.shape[1]).double()
    left, levels = [max(-_MOST, min(x, _MOST)) for x in lacking], torch.zeros(3, has.shape[2])
    found = []
    for part in (has[:, 0].sum(1, keepdim=True), has[:, 1:][..., ends].flatten(1), has[:, 0]):
        found.append(_nearest(part, some, left))
        left = (torch.tensor(left, dtype=torch.float64) - part @ found[-1].double()).tolist()
    levels[0] = found[0] + found[2]
    levels[1:, ends] = found[1].reshape(2, -1)
    return levels.to(jumps.of_change.device)


def _nearest(part: Tensor, some: Sequence[Change], lacking: Sequence[float]) -> Tensor:
    """Return what of each column of `part` (n, k), float64, adds up nearest to what is `lacking` (n,): least squares,
    held near zero."""
    weighed = torch.tensor([c.counted for c in some], dtype=torch.float64) * part.T
    held = weighed @ part + _CHANGES_RIDGE * torch.eye(part.shape[1], dtype=torch.float64)
    return torch.linalg.solve(held, weighed @ torch.tensor(lacking, dtype=torch.float64)).float()


@torch.no_grad()
def changes(model: PeptideSlide, subject: PeptideSubject) -> list[Change]:
    """Return every two states of a peptide's torsions that enough frames of equilibrium show, but the signs of phi;
    none where no run is long enough."""
    if subject.weights is None:
        return []
    generator = torch.Generator().manual_seed(_SIDE_SEED)
    idx, ends_to_end = subject.in_turn(_FRAMES, _step(subject) * _STEPS[-1], generator)
    if not len(idx):
        return []
    flux, shares, held = _fluxes(model, subject, idx, generator)
    both, lags = torch.zeros(2, *flux.shape), torch.zeros(flux.shape)
    is_now = F.one_hot(subject.states(idx), chains.MOST_STATES).float()
    now = is_now.mean(0)
    for k, ours in zip(_STEPS, shares, strict=True):
        then = F.one_hot(subject.states(idx + _step(subject) * k), chains.MOST_STATES).float()
        fluxes = torch.stack([torch.einsum("nrka,nrkb->rkab", is_now, later) for later in (ours, then)]) / _FRAMES
        either = fluxes + fluxes.mT
        mixed = (either / (2.0 * now[..., :, None] * now[..., None, :]).clamp(min=1e-6)).clamp(1e-6, _MIXED)
        tells = (mixed[1] < _MIXED) | (lags == 0)
        # Two states mix exponentially: those that went over and came back are counted as well.
        both += tells * ends_to_end * _STEPS[-1] / k * either * -torch.log1p(-mixed) / mixed
        lags += tells
    both /= lags
    types, found = subject.chain.places[:, :3].tolist(), []
    for r, k, a, b in _pairs_of_states(subject, held):
        expected, seen = both[:, r, k, a, b].tolist()
        lacking = float(flux[r, k, b, a] - flux[r, k, a, b])
        found.append(Change((*types[r],), k, (a, b), lacking, 2.0 / (seen + expected + 1.0), expected, seen))
    return found


def _step(subject: PeptideSubject) -> int:
    return max(1, round(_STEP_PS / subject.frames.lag_ps))


def _pairs_of_states(
    subject: PeptideSubject, held: Tensor, *, signs: bool = False
) -> list[tuple[int, int, int, int]]:  # fmt: skip
    """Return residue, torsion and every two of its states that enough frames are in, with or without the signs of
    phi."""
    counts = subject.chain.stated.counts
    return [
        (r, k, a, b)
        for r, k in torch.nonzero(counts > 1).tolist() if k or signs or r not in subject.chain.signed
        for a, b in combinations(range(int(counts[r, k])), 2) if min(held[r, k, a], held[r, k, b]) >= _LEAST_FRAMES
    ]  # fmt: skip


def _fluxes(
    model: PeptideSlide, subject: PeptideSubject, idx: Tensor, generator: torch.Generator
) -> tuple[Tensor, list[Tensor], Tensor]:
    """Return the logarithm of how many of the frames `idx` (n,) the model takes from each state of each torsion to each
    other, in the mean over `_STEPS`; how likely each state is after each of these; how many frames are in each."""
    chain, counts, step = subject.chain, subject.chain.stated.counts, _step(subject)
    observed, now = subject.seen(model, idx)
    ahead = step * torch.arange(1, _STEPS[-1] + 1)
    times = (ahead * subject.frames.lag_ps).float().expand(len(idx), -1).to(observed.device)
    uniform = torch.rand(len(idx), len(ahead), *counts.shape, generator=generator).to(observed.device)
    shares = torch.zeros(*uniform.shape, chains.MOST_STATES, device=observed.device)
    apart = times_apart(times, model.config.forgotten_ps)
    model.jumps_of(chain).draw(observed, now, chain.places, counts, times, apart, uniform, shares)
    is_now = F.one_hot(now.long(), chains.MOST_STATES).float().cpu()
    then = [shares[:, k - 1].cpu() for k in _STEPS]
    logs = [torch.einsum("nrka,nrkb->rkab", is_now, later).clamp(min=1e-6).log() for later in then]
    return torch.stack(logs).mean(0), then, is_now.sum(0)


def weighted_phis(model: PeptideSlide, subject: PeptideSubject) -> list[Phi]:
    """Return each phi of a peptide of which frames show both sides and weights say how likely they are; none before a
    proline."""
    found: list[Phi] = []
    for residue in subject.chain.signed if subject.weights is not None else ():
        sides = [_side(subject, residue, state) for state in (0, 1)]
        if min(len(idx) for idx, _ in sides) >= _LEAST_FRAMES:
            observed, states = zip(*(subject.seen(model, idx) for idx, _ in sides), strict=True)
            found.append(Phi(subject.chain, residue, observed, states, sides[1][1] / sides[0][1]))
    return found


def lacking_entries(model: PeptideSlide, phi: Phi) -> float:
    """Return the logarithm of how many times too low the probabilities of entering phi > 0 are, in the mean over
    times."""
    enter, leave = (_log_probabilities(model, phi, state) for state in (0, 1))
    return float((leave - enter).mean()) + math.log(phi.positive)


def _side(subject: PeptideSubject, residue: int, state: int) -> tuple[Tensor, float]:
    """Return frames well on one side of a phi, and how likely this side is. Of the rare side all frames count alike:
    the weights within it rest on few."""
    assert subject.weights is not None
    idx = torch.arange(len(subject.weights))
    weights = torch.from_numpy(subject.weights) * (subject.states(idx)[:, residue, 0] == state)
    total = float(weights.sum())
    if total == 0.0:
        return idx[:0], total
    generator = torch.Generator().manual_seed(_SIDE_SEED)
    drawn = torch.multinomial(
        weights if state == 0 else (weights > 0).double(), _SIDE_FRAMES, True, generator=generator
    )
    stated = subject.chain.stated.to(torch.device("cpu"))
    quad = stated.quads[(stated.residue == residue) & (stated.slot == 0)][0]
    x = torch.from_numpy(subject.frames.positions_nm(drawn.numpy()))
    phi = chains.dihedral(*(x[:, int(atom)] for atom in quad)).rad2deg()
    low, high = (chains.NEGATIVE_CORE_DEG, chains.POSITIVE_CORE_DEG)[state]
    return drawn[(phi > low) & (phi < high)], total


def _log_probabilities(model: PeptideSlide, phi: Phi, state: int) -> Tensor:
    """Return the logarithm of how likely, in the mean over frames of one side, a phi is on the other `_TIMES_PS`
    later."""
    observed, now, chain = phi.observed[state], phi.states[state], phi.chain
    jumps, counts, before, found = model.jumps_of(chain), chain.stated.counts, now[:, None], []
    conditioning = chains.conditioning_states(before, counts)
    common = jumps.of_observed(observed, now, chain.places, counts)[:, None]
    common = common + jumps.of_frames(conditioning, conditioning) + jumps.of_new_states(conditioning)
    for time_ps in _TIMES_PS:
        times = torch.full((len(observed), 1), time_ps, device=observed.device)
        apart = times_apart(times, model.config.forgotten_ps)
        of_times, levels = jumps.of_times_alone(times, apart, chain.places, counts)
        logits = jumps.probabilities(0, common + of_times[:, :, None], levels, before[..., 0], conditioning)
        found.append(logits.softmax(-1)[:, 0, phi.residue, 1 - state].double().mean().log())
    return torch.stack(found)
