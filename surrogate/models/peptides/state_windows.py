"""Windows from which the odds of changes of states are learned: what is rare is drawn more often than it occurs.

What a torsion in a rare state does next may be learned from as many windows as there are: its odds are conditional on
the state that it starts from, however often windows start there. Changes that are rare themselves may be drawn more
often, too, if each then counts less in the loss, in proportion, and so may windows chosen for another torsion's sake:
the loss stays what it was, but no longer rests on the few batches that happen to hold such a change.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogate.models.peptides.model import PeptideConfig
from surrogate.models.peptides.peptide_subjects import PeptideSubject
from surrogate.models.peptides.torsion_states import MOST_TORSIONS

_POOL = 16_384
# Changes are to be in this share of the windows that could hold them; nothing is drawn more than so much too often.
_SOUGHT, _MOST = 0.05, 50.0
# Of all windows, those drawn so; the others are drawn evenly, so that none counts many times.
_FOR_RARE = 0.6
_SEED = 0


@dataclass(frozen=True, eq=False)
class StateWindows:
    """Windows of one sequence: frames `idx` (n, 1 + t), `times_ps` (n, t), how likely each is drawn, summed up (n,),
    and what it then counts for each torsion, `share` (n, n_residues, MOST_TORSIONS)."""

    idx: Tensor
    times_ps: Tensor
    cumulative: Tensor
    share: Tensor

    @staticmethod
    def of(subject: PeptideSubject, config: PeptideConfig) -> StateWindows:
        """Return windows drawn as `PeptideSubject.windows` does, and their odds."""
        idx, times = subject.windows(_POOL, config, torch.Generator().manual_seed(_SEED))
        stated = subject.chain.stated
        states = subject.states(idx)[..., stated.residue.cpu(), stated.slot.cpu()]
        started = balanced_starts(states[:, 0])
        odds = rare_changes(states) * started.max(dim=1).values
        odds = 1.0 - _FOR_RARE + _FOR_RARE * odds / odds.mean()
        share = torch.zeros(len(idx), stated.n_residues, MOST_TORSIONS)
        share[:, stated.residue, stated.slot] = (odds.sum() / started.sum(0) * started / odds[:, None]).float()
        return StateWindows(idx, times, odds.cumsum(0), share)

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Return frames `(n, 1 + t)`, times `(n, t)` ps and what each counts `(n, n_residues, MOST_TORSIONS)`."""
        place = torch.rand(n, generator=generator, dtype=torch.float64) * self.cumulative[-1]
        at = torch.searchsorted(self.cumulative, place, right=True).clamp(max=len(self.cumulative) - 1)
        return self.idx[at], self.times_ps[at], self.share[at]


def balanced_starts(first: Tensor) -> Tensor:
    """States `(n, torsions)` that windows start from -> how much more often `(n, torsions)`, float64, each should be
    drawn for the rarer states of a torsion to be as frequent as its others."""
    odds = torch.ones(first.shape, dtype=torch.float64)
    for k in range(first.shape[1]):
        _, which, counts = first[:, k].unique(return_inverse=True, return_counts=True)
        odds[:, k] = (len(first) / (len(counts) * counts.double()))[which]
    return odds.clamp(1.0, _MOST)


def rare_changes(states: Tensor) -> Tensor:
    """States `(n, 1 + t, torsions)` of windows -> how much more often `(n,)`, float64, each should be drawn for the
    rarest change from one state to another that it holds."""
    found = torch.ones(len(states), dtype=torch.float64)
    before, after = states[:, :-1], states[:, 1:]
    n_states = int(states.max()) + 1 if states.numel() else 0
    for one in range(n_states):
        for other in range(n_states):
            if one == other:
                continue
            held = ((before == one) & (after == other)).any(1)  # (n, torsions)
            could = (before == one).any(1).sum(0)
            wanted = (_SOUGHT * could / held.sum(0).clamp(min=1)).clamp(1.0, _MOST).double()
            found = torch.maximum(found, torch.where(held, wanted, 1.0).max(1).values)
    return found
