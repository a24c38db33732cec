"""Which state each torsion with barriers is in, drawn before the flow draws the frames that go with it.

Phi > 0 is entered a few times in a microsecond, psi and side chains turn a few times in a nanosecond. A flow that draws
barrier crossings along with everything else leaks between the states, since between two modes of noise there is always
some density. A small network of its own learns by log-likelihood how likely each torsion is to change its state from
one frame to the next (a categorical draw cannot leak). The flow is told the outcome, draws only how far each torsion is
from the middle of its state, and frames that disobey are drawn again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Beyond the second barrier phi > 0 is the far end of the strands' basin, which reaches across 180 degrees.
POSITIVE_PHI_DEG = (0.0, 130.0)
# Well inside either side, away from both barriers.
POSITIVE_CORE_DEG, NEGATIVE_CORE_DEG = (30.0, 90.0), (-175.0, -45.0)
# Of one residue: phi, psi, then those of its side chain outwards; and of one torsion.
MOST_TORSIONS, MOST_STATES = 7, 3
FIRST_OF_SIDE_CHAIN = 2
# Where the first state begins and where the next ones do, counted from there, degrees: phi (negative, positive), psi
# (strands, helices), a bond between tetrahedral atoms (gauche+, trans, gauche-), one to an aromatic ring (its sides).
# Psi's barrier lies elsewhere before a proline, whose ring is in the way of helices.
Kind = tuple[float, tuple[float, float]]
PHI = (POSITIVE_PHI_DEG[1], (360.0 - POSITIVE_PHI_DEG[1], 360.0))
PSI = (75.0, (165.0, 360.0))
PSI_BEFORE_PROLINE = (25.0, (215.0, 360.0))
THREEFOLD = (0.0, (120.0, 240.0))
RING = (0.0, (180.0, 360.0))
_WIDTH = 96
_WAVES = 8
# Before training, a torsion changes to another state once in so many frames (in logits).
_RARELY = -5.0
# A step of training moves the probabilities by so many times as much as another parameter.
_FAST = 10.0


@dataclass(frozen=True, eq=False)
class StatedTorsions:
    """The torsions of one peptide that have states: `quads` (n, 4) atoms; `residue` and `slot` (n,), where their states
    stand in `(n_residues, MOST_TORSIONS)`; `first_deg` (n,), `edges_deg` (n, 2) as of PHI."""

    quads: Tensor
    residue: Tensor
    slot: Tensor
    first_deg: Tensor
    edges_deg: Tensor
    n_residues: int

    @staticmethod
    def of(rows: list[tuple[list[int], int, int, Kind]], n_residues: int) -> StatedTorsions:
        """Return those of `rows`: four atoms, residue, slot, and PHI, PSI, THREEFOLD or RING."""
        quads, residue, slot = (torch.tensor([row[k] for row in rows], dtype=torch.long) for k in range(3))
        first = torch.tensor([kind[0] for *_, kind in rows])
        edges = torch.tensor([kind[1] for *_, kind in rows]).reshape(-1, MOST_STATES - 1)
        return StatedTorsions(quads.reshape(-1, 4), residue, slot, first, edges, n_residues)

    def to(self, device: torch.device) -> StatedTorsions:
        tensors = {f.name: getattr(self, f.name).to(device) for f in fields(self) if f.name != "n_residues"}
        return replace(self, **tensors)

    @cached_property
    def ends_deg(self) -> Tensor:
        """Where each state begins and the next one does, `(n, MOST_STATES + 1)`, degrees from `first_deg` on."""
        ends = F.pad(self.edges_deg, (1, 1))
        ends[:, -1] = 360.0
        return ends

    @property
    def middles_deg(self) -> Tensor:
        """The middle of each state, `(n, MOST_STATES)`, degrees; of no meaning where there are fewer."""
        return self.first_deg[:, None] + (self.ends_deg[:, 1:] + self.ends_deg[:, :-1]) / 2.0

    @cached_property
    def counts(self) -> Tensor:
        """How many states each torsion has, `(n_residues, MOST_TORSIONS)`; 0 where there is none."""
        found = self.residue.new_zeros(self.n_residues, MOST_TORSIONS)
        found[self.residue, self.slot] = 1 + (self.edges_deg < 360.0).sum(-1)
        return found

    def states(self, angles: Tensor) -> Tensor:
        """Angles of these torsions `(..., n)`, rad -> their states `(..., n_residues, MOST_TORSIONS)`; 0 where there is
        no torsion."""
        ahead = (angles.rad2deg() - self.first_deg) % 360.0
        found = angles.new_zeros(*angles.shape[:-1], self.n_residues, MOST_TORSIONS, dtype=torch.long)
        found[..., self.residue, self.slot] = (ahead[..., None] >= self.edges_deg).sum(-1)
        return found


def conditioning_states(states: Tensor, counts: Tensor) -> Tensor:
    """States `(..., r, MOST_TORSIONS)` -> numbers `(..., r, MOST_TORSIONS * MOST_STATES)`, 1 for the state that each
    torsion is in, 0 for others and where `counts` (r, MOST_TORSIONS) says that there is none."""
    return (F.one_hot(states, MOST_STATES) * (counts > 0)[..., None]).flatten(-2).float()


class StateJumps(nn.Module):
    """The probabilities that torsions change their states between a frame and the next.

    They follow from the residue's type, its numbers in the given frame, its states and its two neighbours' in that and
    in the frame before, its own in the one before that, the new states of its torsions before this one (side chains
    turn two torsions at once), how long after the given frame it is and how far apart the frames are. Of what a
    neighbour is only levels are learned, which add up: with numbers or types of neighbours the network would know each
    pair of training by itself.
    """

    waves: Tensor

    def __init__(self, n_slots: int, n_types: int) -> None:
        super().__init__()
        n_states = MOST_TORSIONS * MOST_STATES
        self.of_numbers = nn.Linear(n_slots, _WIDTH, bias=False)
        self.of_given = nn.ModuleList(nn.Linear(n_states, _WIDTH, bias=False) for _ in range(3))
        self.of_before = nn.ModuleList(nn.Linear(n_states, _WIDTH, bias=False) for _ in range(3))
        self.of_earlier = nn.Linear(n_states, _WIDTH, bias=False)
        self.of_type = nn.Embedding(n_types, _WIDTH)
        self.register_buffer("waves", math.pi * torch.linspace(0.25, 2.0, _WAVES), persistent=False)
        self.of_times = nn.Linear(4 * _WAVES + 2, _WIDTH)
        self.of_new = nn.ModuleList(nn.Linear(n_states, _WIDTH, bias=False) for _ in range(MOST_TORSIONS))
        self.of_torsion = nn.Embedding(MOST_TORSIONS, _WIDTH)
        self.hidden = nn.Linear(_WIDTH, _WIDTH)
        self.logits = nn.Linear(_WIDTH, MOST_STATES)
        # Of each type and torsion, from one state to another: a level, and a slope with the logarithm of time.
        self.of_change = nn.Parameter(torch.zeros(2, n_types, MOST_TORSIONS, MOST_STATES, MOST_STATES))
        # And a level of the residue before's type, and of the one after's: proline forbids what others allow.
        self.beside_change = nn.Parameter(torch.zeros(2, n_types, MOST_TORSIONS, MOST_STATES, MOST_STATES))
        nn.init.zeros_(self.logits.weight)
        nn.init.constant_(self.logits.bias, _RARELY)

    def of_known(self, known: Tensor, states: Tensor, places: Tensor, counts: Tensor) -> Tensor:
        """What all frames of a chunk have in common: `known` (b, r, slots), its `states` (b, r, MOST_TORSIONS),
        `places` (r, 3) -> (b, r, width)."""
        beside = _beside(conditioning_states(states, counts))
        h: Tensor = sum((of(x) for of, x in zip(self.of_given, beside, strict=True)), self.of_numbers(known.float()))
        return h + self.of_type(places[:, 0])

    def of_times_alone(
        self, times_ps: Tensor, apart_ps: Tensor, places: Tensor, counts: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return what follows from frames' `times_ps` and `apart_ps` (b, t), after the given frame and after the one
        before: `(b, t, width)`, and the levels of the probabilities `(b, t, MOST_TORSIONS, r, from, to)`."""
        logs = torch.stack([times_ps, apart_ps], dim=-1).float().clamp(min=1e-3).log10()
        angles = logs[..., None] * self.waves
        waves = torch.cat([angles.sin(), angles.cos()], dim=-1).flatten(-2)
        level, slope = (change[places[:, 0]].transpose(0, 1) for change in self.of_change)
        for which, change in enumerate(self.beside_change):
            level = level + _FAST * change[places[:, 1 + which]].transpose(0, 1)
        absent = torch.arange(MOST_STATES, device=counts.device) >= counts.T[..., None, None].clamp(min=1)
        levels = (level + slope * logs[..., 1, None, None, None, None]).masked_fill(absent, -torch.inf)
        return self.of_times(torch.cat([waves, logs], dim=-1)), levels

    def of_frames(self, conditioning: Tensor, earlier: Tensor) -> Tensor:
        """What `conditioning_states` returns of the frame before each, `told` (b, t, r, n), and of the one before that,
        `earlier` -> (b, t, r, width)."""
        of_all = torch.cat([of.weight for of in (*self.of_before, self.of_earlier)], dim=1)
        return F.linear(torch.cat([*_beside(conditioning), earlier], dim=-1), of_all)

    def probabilities(self, torsion: int, h: Tensor, levels: Tensor, now: Tensor, conditioning: Tensor) -> Tensor:
        """Return the logits `(b, t, r, MOST_STATES)` of the new state of one torsion of each residue.

        `h` (b, t, r, width) is what `of_known`, `of_times_alone` and `of_frames` add up to, `levels` what
        `of_times_alone` returns; `now` (b, t, r) the torsion's state in the frame before, `told` (b, t, r, n) what
        `conditioning_states` returns of the new frame, of which torsions before this one count.
        """
        n = torsion * MOST_STATES
        of_new = cast(nn.Linear, self.of_new[torsion]).weight
        h = F.silu(h + F.linear(conditioning[..., :n], of_new[:, :n], self.of_torsion.weight[torsion]))
        at = now[..., None, None].expand(*now.shape, 1, MOST_STATES)
        level = levels[:, :, torsion].expand(*now.shape, -1, -1).gather(-2, at)[..., 0, :]
        # To stay has the logit zero.
        return (self.logits(F.silu(self.hidden(h))) + level).scatter(-1, now[..., None], 0.0)

    @torch.no_grad()
    def raise_entries(self, of_type: Tensor, before: Tensor, after: Tensor) -> None:
        """Add levels `(n_types,)` to the logits of entering phi > 0, of the residue's type and of its neighbours'."""
        self.of_change[0, :, 0, 0, 1] += of_type
        self.beside_change[0, :, 0, 0, 1] += before / _FAST
        self.beside_change[1, :, 0, 0, 1] += after / _FAST

    def loss(
        self, known: Tensor, states: Tensor, places: Tensor, counts: Tensor, times_ps: Tensor, apart_ps: Tensor,
        share: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """Return the negative log-likelihood of what torsions did, per frame and torsion.

        `known` (b, r, slots); `states` (b, 1 + t, r, MOST_TORSIONS), the given frame's first; `share` (b, r,
        MOST_TORSIONS): what each torsion's change counts in a window, 1 where it is not given.
        """
        with torch.autocast(known.device.type, enabled=False):
            before, new = states[:, :-1], states[:, 1:]
            earlier = torch.cat([before[:, :1], before[:, :-1]], dim=1)
            of_times, levels = self.of_times_alone(times_ps, apart_ps, places, counts)
            h = (
                self.of_frames(conditioning_states(before, counts), conditioning_states(earlier, counts))
                + of_times[:, :, None]
            )
            h = h + self.of_known(known, states[:, 0], places, counts)[:, None]
            conditioning = conditioning_states(new, counts)
            total = known.new_zeros(())
            for torsion in torch.nonzero((counts > 0).any(0))[:, 0].tolist():
                has = counts[:, torsion] > 0
                logits = self.probabilities(torsion, h, levels, before[..., torsion], conditioning)[:, :, has]
                chosen = new[..., has, torsion]
                each = F.cross_entropy(logits.flatten(0, -2), chosen.flatten(), reduction="none").reshape(chosen.shape)
                total = total + (each if share is None else share[:, None, has, torsion] * each).sum()
            return total / (times_ps.numel() * max(1, int((counts > 0).sum())))

    def draw(
        self, known: Tensor, states: Tensor, places: Tensor, counts: Tensor, times_ps: Tensor, apart_ps: Tensor,
        uniform: Tensor,
    ) -> Tensor:  # fmt: skip
        """Return states `(b, t, r, MOST_TORSIONS)` of new frames, from the given frame's numbers and `states`
        (b, r, MOST_TORSIONS) and numbers `uniform` (b, t, r, MOST_TORSIONS) in [0, 1)."""
        with torch.autocast(known.device.type, enabled=False):
            of_times, levels = self.of_times_alone(times_ps, apart_ps, places, counts)
            common = self.of_known(known, states, places, counts)[:, None] + of_times[:, :, None]
            # What is told of a residue's torsion in each state.
            ones = torch.eye(MOST_STATES, device=known.device) * (counts > 0)[..., None, None]
            residues, most = torch.arange(len(counts), device=known.device), (counts - 1).clamp(min=0)
            torsions = torch.nonzero((counts > 0).any(0))[:, 0].tolist()
            now, found = states[:, None], []
            before = conditioning = conditioning_states(now, counts)
            for k in range(times_ps.shape[1]):
                at = slice(k, k + 1)
                h = self.of_frames(conditioning, before) + common[:, at]
                new, before, conditioning = torch.zeros_like(now), conditioning, torch.zeros_like(conditioning)
                for torsion in torsions:
                    share = (
                        self.probabilities(torsion, h, levels[:, at], now[..., torsion], conditioning)
                        .softmax(-1)
                        .cumsum(-1)
                    )
                    # Shares may end below one by rounding.
                    drawn = (uniform[:, at, :, torsion, None] >= share[..., :-1]).sum(-1).minimum(most[:, torsion])
                    new[..., torsion] = drawn
                    conditioning[..., torsion * MOST_STATES : (torsion + 1) * MOST_STATES] = ones[
                        residues, torsion, drawn
                    ]
                found.append(new)
                now = new
            return torch.cat(found, dim=1)


def times_apart(times_ps: Tensor, forgotten_ps: float) -> Tensor:
    """Return the time `(b, t)` between each frame and the one before it; frames of endless times know none before."""
    before = torch.cat([torch.zeros_like(times_ps[:, :1]), times_ps[:, :-1]], dim=1)
    return torch.where(times_ps >= forgotten_ps, times_ps, times_ps - before)


def _beside(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return of residues `(..., r, n)` each itself, the one before it and the one after it."""
    none = torch.zeros_like(x[..., :1, :])
    return x, torch.cat([none, x[..., :-1, :]], -2), torch.cat([x[..., 1:, :], none], -2)
