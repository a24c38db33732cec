"""The odds of entering phi > 0, set to those of leaving it and to how likely it is.

Runs from chosen starts show hundreds of exits from phi > 0 and hardly an entry. Read backwards, exits are entries, but
only as well weighted as a few frames are, and a rate that is three times too high shows in no loss: nearly every window
holds no entry. What is known well are the odds of leaving and the free energy of phi > 0 (umbrella sampling), and in
equilibrium as many frames enter as leave. So after training the odds of entering are moved, by a level of each
residue's type and of its neighbours', to where this holds in the mean over the frames of all training peptides.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from surrogate.models.peptides.chains import dihedral
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.peptides.peptide_subjects import PeptideSubject
from surrogate.models.peptides.torsion_states import NEGATIVE_CORE_DEG, POSITIVE_CORE_DEG, times_apart

# Frames of either side by which odds are told, drawn anew by this seed, and how long after them.
_FRAMES, _SEED = 3000, 0
_TIMES_PS = (3.0, 10.0, 30.0, 100.0)
# Of a side that fewer frames show, nothing is said.
_LEAST_FRAMES = 50
_PASSES = 3
# Holds levels that few peptides tell near zero.
_RIDGE = 0.3


class Imbalance(NamedTuple):
    """Of one phi of one peptide: numbers of its residue's type and its neighbours', and the logarithm of by how much
    the odds of entering phi > 0 are too low."""

    residue: int
    before: int
    after: int
    lacking: float


@torch.no_grad()
def balance_entries(model: PeptideSlide, subjects: Sequence[PeptideSubject]) -> None:
    """Move the odds of entering phi > 0 of `model` to where detailed balance holds in the mean over `subjects`, whose
    weights say how likely phi > 0 is; those without weights play no part."""
    n_types = len(model.token_mean)
    for _ in range(_PASSES):
        rows = [row for subject in subjects for row in imbalances(model, subject)]
        if not rows:
            return
        told = torch.zeros(len(rows), 3 * n_types, dtype=torch.float64)
        for k, row in enumerate(rows):
            told[k, [row.residue, n_types + row.before, 2 * n_types + row.after]] = 1.0
        lacking = torch.tensor([row.lacking for row in rows], dtype=torch.float64)
        levels = torch.linalg.solve(
            told.T @ told + _RIDGE * torch.eye(3 * n_types, dtype=torch.float64), told.T @ lacking
        )
        model.jumps.raise_entries(*levels.float().to(model.token_mean.device).chunk(3))


def imbalances(model: PeptideSlide, subject: PeptideSubject) -> list[Imbalance]:
    """Return how far each phi of a peptide is from balance, as far as its frames show both of its sides."""
    if subject.weights is None:
        return []
    chain, found = subject.chain, []
    places = chain.places.tolist()
    for residue in chain.signed.tolist():
        sides = [_side(subject, residue, state) for state in (0, 1)]
        if min(len(idx) for idx, _ in sides) < _LEAST_FRAMES:
            continue
        enter, leave = (_log_odds(model, subject, residue, idx, state) for state, (idx, _) in enumerate(sides))
        balance = torch.log(torch.tensor(sides[1][1] / sides[0][1]))
        kind, before, after = places[residue]
        found.append(Imbalance(kind, before, after, float((leave + balance - enter).mean())))
    return found


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


def _log_odds(model: PeptideSlide, subject: PeptideSubject, residue: int, idx: Tensor, state: int) -> Tensor:
    """Return the logarithm of how likely phi is on the other side `_TIMES_PS` after frames `idx` (n,), of their
    mean."""
    chain = subject.chain
    known, now = subject.seen(model, idx)
    counts, before, found = chain.stated.counts, now[:, None], []
    common = model.jumps.of_known(known, now, chain.places, counts)
    for time_ps in _TIMES_PS:
        times = torch.full((len(idx), 1), time_ps, device=known.device)
        apart = times_apart(times, model.config.forgotten_ps)
        h, logs = model.jumps.of_frames(common, before, before, times, apart, counts)
        logits = model.jumps.odds(0, h, logs, before, torch.zeros_like(before), chain.places, counts)
        found.append(logits.softmax(-1)[:, 0, residue, 1 - state].double().mean().log())
    return torch.stack(found)
