"""The odds of entering phi > 0, set to those of leaving it and to how likely it is.

Runs from chosen starts show hundreds of exits from phi > 0 and hardly an entry. Read backwards, exits are entries, but
only as well weighted as a few frames are, and a rate that is three times too high shows in no loss: nearly every window
holds no entry. What is known well are the odds of leaving and the free energy of phi > 0 (umbrella sampling), and in
equilibrium as many frames enter as leave. So after training the odds of entering are moved, by a level of each
residue's type and of its neighbours', to where this holds in the mean over the frames of all training peptides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogate.models.peptides.chains import ChainFeatures, dihedral
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.peptides.peptide_subjects import PeptideSubject
from surrogate.models.peptides.torsion_states import NEGATIVE_CORE_DEG, POSITIVE_CORE_DEG, times_apart, told_states

# Frames of either side by which odds are told, drawn anew by this seed, and how long after them.
_FRAMES, _SEED = 1000, 0
_TIMES_PS = (3.0, 10.0, 30.0, 100.0)
# Of a side that fewer frames show, nothing is said.
_LEAST_FRAMES = 50
_PASSES = 4
# Holds levels that few peptides tell near zero, and what one phi may ask for within bounds.
_RIDGE, _MOST = 0.3, 3.0


@dataclass(frozen=True, eq=False)
class Phi:
    """One phi of a peptide: its `residue`, frames well on its negative and on its positive side, as numbers `known` (n,
    n_residues, n_slots) and `states` (n, n_residues, MOST_TORSIONS) each, and how likely the positive is beside the
    other."""

    chain: ChainFeatures
    residue: int
    known: tuple[Tensor, Tensor]
    states: tuple[Tensor, Tensor]
    positive: float

    @property
    def places(self) -> list[int]:
        """The numbers of its residue's type, of the one's before and of the one's after."""
        return [int(k) for k in self.chain.places[self.residue]]


@torch.no_grad()
def balance_entries(model: PeptideSlide, subjects: Sequence[PeptideSubject]) -> None:
    """Move the odds of entering phi > 0 of `model` to where detailed balance holds in the mean over `subjects`, whose
    weights say how likely phi > 0 is; those without weights play no part."""
    n_types = len(model.token_mean)
    phis = [phi for subject in subjects for phi in told_phis(model, subject)]
    if not phis:
        return
    told = torch.zeros(len(phis), 3 * n_types, dtype=torch.float64)
    for k, phi in enumerate(phis):
        for which, place in enumerate(phi.places):
            told[k, which * n_types + place] = 1.0
    held = told.T @ told + _RIDGE * torch.eye(3 * n_types, dtype=torch.float64)
    for _ in range(_PASSES):
        lacking = torch.tensor([lacking_entries(model, phi) for phi in phis], dtype=torch.float64)
        levels = torch.linalg.solve(held, told.T @ lacking.clamp(-_MOST, _MOST))
        model.jumps.raise_entries(*levels.float().to(model.token_mean.device).chunk(3))


def told_phis(model: PeptideSlide, subject: PeptideSubject) -> list[Phi]:
    """Return each phi of a peptide of which frames show both sides and weights tell how likely they are; before a
    proline that is not known well enough."""
    if subject.weights is None:
        return []
    chain, found = subject.chain, []
    types = (*chain.code.layout.types, "")
    for residue in chain.signed.tolist():
        if types[residue + 1] == "PRO":
            continue
        sides = [_side(subject, residue, state) for state in (0, 1)]
        if min(len(idx) for idx, _ in sides) < _LEAST_FRAMES:
            continue
        (known, states), (known_positive, states_positive) = (subject.seen(model, idx) for idx, _ in sides)
        both, all_states = (known, known_positive), (states, states_positive)
        found.append(Phi(chain, residue, both, all_states, sides[1][1] / sides[0][1]))
    return found


def lacking_entries(model: PeptideSlide, phi: Phi) -> float:
    """Return the logarithm of how many times too low the odds of entering phi > 0 are, in the mean over times."""
    enter, leave = (_log_odds(model, phi, state) for state in (0, 1))
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
    odds = weights if state == 0 else (weights > 0).double()
    drawn = torch.multinomial(odds, _FRAMES, replacement=True, generator=torch.Generator().manual_seed(_SEED))
    stated = subject.chain.stated.to(torch.device("cpu"))
    quad = stated.quads[(stated.residue == residue) & (stated.slot == 0)][0]
    x = torch.from_numpy(subject.frames.positions_nm(drawn.numpy()))
    phi = dihedral(*(x[:, int(atom)] for atom in quad)).rad2deg()
    low, high = (NEGATIVE_CORE_DEG, POSITIVE_CORE_DEG)[state]
    return drawn[(phi > low) & (phi < high)], total


def _log_odds(model: PeptideSlide, phi: Phi, state: int) -> Tensor:
    """Return the logarithm of how likely, in the mean over frames of one side, a phi is on the other `_TIMES_PS`
    later."""
    known, now, chain = phi.known[state], phi.states[state], phi.chain
    counts, before, found = chain.stated.counts, now[:, None], []
    told = told_states(before, counts)
    common = model.jumps.of_known(known, now, chain.places, counts)[:, None] + model.jumps.of_frames(told, told)
    for time_ps in _TIMES_PS:
        times = torch.full((len(known), 1), time_ps, device=known.device)
        apart = times_apart(times, model.config.forgotten_ps)
        of_times, levels = model.jumps.of_times_alone(times, apart, chain.places, counts)
        logits = model.jumps.odds(0, common + of_times[:, :, None], levels, before[..., 0], told)
        found.append(logits.softmax(-1)[:, 0, phi.residue, 1 - state].double().mean().log())
    return torch.stack(found)
