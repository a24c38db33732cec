"""The probabilities that torsions change their states, and states drawn by them.

Which state each torsion with barriers is in is drawn before the flow draws the frames that go with it: a flow that
draws barrier crossings along with everything else leaks between states, and a categorical draw does not. A frame's
states are drawn one after the other, by a C++ program (`state_jumps.cpp`), else by torch.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.layers import ParallelBlock
from surrogate.models.peptides.chains import MOST_STATES, MOST_TORSIONS, conditioning_states
from systems.files.native import CompilerError, compiled_program

_WIDTH = 96
_WAVES = 8
# Before training, a torsion changes to another state once in so many frames (in logits).
_RARELY = -5.0
# A step of training moves the probabilities by so many times as much as another parameter.
_FAST = 10.0
# Residues further apart along the chain are alike far.
FAR = 6
_COUPLED_BLOCKS, _COUPLED_HEADS = 2, 4


class StateJumps(nn.Module):
    """The probabilities that torsions change their states between a frame and the next.

    They follow from the residue's type, its numbers in the given frame, its and its two neighbours' states in that and
    in the frame before, its own in the one before that, the new states of its torsions before this one, and both times.
    Of neighbours' types only levels are learned, which add up: else the network would know each pair of training.

    `coupled`, for trainings on many more sequences: neighbours' types count in full, attention over residues mixes what
    the given frame tells, every other residue sees the new states of those beside it, which are drawn first, and each
    those of the residue two before it: turns of a helix come together.
    """

    def __init__(self, n_slots: int, n_types: int, *, coupled: bool = False) -> None:
        super().__init__()
        self.coupled = coupled
        n_states = MOST_TORSIONS * MOST_STATES
        self.of_numbers = nn.Linear(n_slots, _WIDTH, bias=False)
        self.of_given = nn.ModuleList(nn.Linear(n_states, _WIDTH, bias=False) for _ in range(3))
        self.of_before = nn.ModuleList(nn.Linear(n_states, _WIDTH, bias=False) for _ in range(3))
        self.of_earlier = nn.Linear(n_states, _WIDTH, bias=False)
        self.of_type = nn.Embedding(n_types, _WIDTH)
        self.waves = nn.Buffer(math.pi * torch.linspace(0.25, 2.0, _WAVES), persistent=False)
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
        if coupled:
            self.of_type_beside = nn.ModuleList(nn.Embedding(n_types, _WIDTH) for _ in range(2))
            self.blocks = nn.ModuleList(ParallelBlock(_WIDTH, _COUPLED_HEADS) for _ in range(_COUPLED_BLOCKS))
            self.of_distance = nn.Embedding(2 * FAR + 1, _COUPLED_HEADS)
            self.of_new_beside = nn.ModuleList(nn.Linear(n_states, _WIDTH, bias=False) for _ in range(2))
            self.of_new_two_before = nn.Linear(n_states, _WIDTH, bias=False)
            # Weights that are gone on from begin as they were.
            for part in (*self.of_type_beside, *self.of_new_beside, self.of_new_two_before):
                nn.init.zeros_(cast(nn.Embedding | nn.Linear, part).weight)
            self.register_load_state_dict_pre_hook(_knowing_two_before)

    def turns(self, n_residues: int) -> tuple[slice, ...]:
        """The residues whose new states are drawn at once, one part after the other."""
        order = (*range(0, n_residues, 2), *range(1, n_residues, 2))
        return tuple(slice(r, r + 1) for r in order) if self.coupled else (slice(None),)

    def of_observed(self, observed: Tensor, states: Tensor, places: Tensor, counts: Tensor) -> Tensor:
        """What all frames of a chunk have in common: `observed` (b, r, slots), its `states` (b, r, MOST_TORSIONS),
        `places` (r, 4) -> (b, r, width)."""
        beside = _beside(conditioning_states(states, counts))
        h: Tensor = sum((of(x) for of, x in zip(self.of_given, beside, strict=True)), self.of_numbers(observed.float()))
        of_types, bias = self._of_types(places)
        h = h + of_types
        if bias is not None:
            still = h.new_zeros(len(h), 3, _WIDTH)
            for block in self.blocks:
                h = block(h[:, None], still, None, bias=bias)[0][:, 0]
        return h

    def _of_types(self, places: Tensor) -> tuple[Tensor, Tensor | None]:
        """What types tell `(r, width)`, and the scores of `blocks` (heads, r, r) by how far residues are apart."""
        of_types: Tensor = self.of_type(places[:, 0])
        if not self.coupled:
            return of_types, None
        beside = sum(of(places[:, 1 + k]) for k, of in enumerate(self.of_type_beside))
        return of_types + beside, self.of_distance(distances_along(len(places), places.device)).permute(2, 0, 1)

    def of_new_states(self, conditioning: Tensor) -> Tensor | float:
        """What residues see of the new states of others: of the one two before, and every other residue of those beside
        it: `conditioning` (b, t, r, n) of the new frame -> (b, t, r, width)."""
        if not self.coupled:
            return 0.0
        found: Tensor = sum(
            (of(x) for of, x in zip(self.of_new_beside, _beside(conditioning)[1:], strict=True)),
            conditioning.new_zeros(()),
        )
        two_before = F.pad(conditioning, (0, 0, 2, 0))[..., : conditioning.shape[-2], :]
        second = (torch.arange(found.shape[-2], device=found.device) % 2)[:, None]
        return found * second + self.of_new_two_before(two_before)

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
        """`conditioning_states` of the frame before each, (b, t, r, n), and of the one before that, `earlier` -> (b, t,
        r, width)."""
        of_all = torch.cat([of.weight for of in (*self.of_before, self.of_earlier)], dim=1)
        return F.linear(torch.cat([*_beside(conditioning), earlier], dim=-1), of_all)

    def probabilities(self, torsion: int, h: Tensor, levels: Tensor, now: Tensor, conditioning: Tensor) -> Tensor:
        """Return the logits `(b, t, r, MOST_STATES)` of the new state of one torsion of each residue.

        `h` (b, t, r, width) is what `of_observed`, `of_times_alone` and `of_frames` add up to, `levels` what
        `of_times_alone` returns; `now` (b, t, r) the torsion's state in the frame before, `conditioning` (b, t, r, n)
        the `conditioning_states` of the new frame, of which torsions before this one count.
        """
        n = torsion * MOST_STATES
        of_new = cast(nn.Linear, self.of_new[torsion]).weight
        h = F.silu(h + F.linear(conditioning[..., :n], of_new[:, :n], self.of_torsion.weight[torsion]))
        at = now[..., None, None].expand(*now.shape, 1, MOST_STATES)
        level = levels[:, :, torsion].expand(*now.shape, -1, -1).gather(-2, at)[..., 0, :]
        # To stay has the logit zero.
        return (self.logits(F.silu(self.hidden(h))) + level).scatter(-1, now[..., None], 0.0)

    @torch.no_grad()
    def raise_change(self, torsion: int, start: int, end: int, levels: Tensor) -> None:
        """Add `levels` (3, n_types) to the logits of one change, of the residue's type, of that before and of that
        after."""
        self.of_change[0, :, torsion, start, end] += levels[0]
        self.beside_change[:, :, torsion, start, end] += levels[1:] / _FAST

    def loss(
        self, observed: Tensor, states: Tensor, places: Tensor, counts: Tensor, times_ps: Tensor, apart_ps: Tensor,
        share: Tensor | None = None, kept: Tensor | float = 1.0,
    ) -> Tensor:  # fmt: skip
        """Return the negative log-likelihood of what torsions did, per frame and torsion.

        `observed` (b, r, slots); `states` (b, 1 + t, r, MOST_TORSIONS), the given frame's first; `share` (b, r,
        MOST_TORSIONS): what each torsion's change counts in a window, 1 where it is not given; `kept` (b, 1, r, width):
        factors of hidden numbers.
        """
        total = observed.new_zeros(())
        for torsion, has, logits in self.of_windows(observed, states, places, counts, times_ps, apart_ps, kept):
            chosen = states[:, 1:, has, torsion]
            each = F.cross_entropy(logits.flatten(0, -2), chosen.flatten(), reduction="none").reshape(chosen.shape)
            total = total + (each if share is None else share[:, None, has, torsion] * each).sum()
        return total / (times_ps.numel() * max(1, int((counts > 0).sum())))

    def of_windows(
        self, observed: Tensor, states: Tensor, places: Tensor, counts: Tensor, times_ps: Tensor, apart_ps: Tensor,
        kept: Tensor | float = 1.0,
    ) -> Iterator[tuple[int, Tensor, Tensor]]:  # fmt: skip
        """Yield each torsion, the residues `(n,)` that have it, and the logits `(b, t, n, MOST_STATES)` of its new
        states in windows as `loss` takes them."""
        with torch.autocast(observed.device.type, enabled=False):
            before, new = states[:, :-1], states[:, 1:]
            earlier = torch.cat([before[:, :1], before[:, :-1]], dim=1)
            of_times, levels = self.of_times_alone(times_ps, apart_ps, places, counts)
            h = self.of_frames(conditioning_states(before, counts), conditioning_states(earlier, counts))
            h = h + of_times[:, :, None] + self.of_observed(observed, states[:, 0], places, counts)[:, None]
            conditioning = conditioning_states(new, counts)
            h = kept * (h + self.of_new_states(conditioning))
            for torsion in torch.nonzero((counts > 0).any(0))[:, 0].tolist():
                has = torch.nonzero(counts[:, torsion])[:, 0]
                earlier_torsions = conditioning[..., : torsion * MOST_STATES].index_select(2, has)
                own = h.index_select(2, has), levels.index_select(3, has), before[..., has, torsion], earlier_torsions
                yield torsion, has, self.probabilities(torsion, *own)

    def draw(
        self, observed: Tensor | None, states: Tensor, places: Tensor, counts: Tensor, times_ps: Tensor,
        apart_ps: Tensor, uniform: Tensor, shares: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """Return states `(b, t, r, MOST_TORSIONS)` of new frames, from the given frame's numbers and `states`
        (b, r, MOST_TORSIONS) and numbers `uniform` (b, t, r, MOST_TORSIONS) in [0, 1). Their probabilities are written
        to `shares` (b, t, r, MOST_TORSIONS, MOST_STATES). Without `observed` each frame follows from the states of the
        one before alone, as the first after a frame whose numbers are their means."""
        with torch.autocast(times_ps.device.type, enabled=False):
            program = _program() if shares is None and times_ps.device.type == "cpu" else None
            if observed is None and program is None:
                none, found = times_ps.new_zeros(*states.shape[:2], self.of_numbers.in_features), [states[:, None]]
                for one in zip(*(x.split(1, dim=1) for x in (times_ps, apart_ps, uniform)), strict=True):
                    found.append(self.draw(none, found[-1][:, 0], places, counts, *one))
                return torch.cat(found[1:], dim=1)
            of_times, levels = self.of_times_alone(times_ps, apart_ps, places, counts)
            common = of_times[:, :, None].expand(-1, -1, len(places), -1)
            if observed is not None:
                common = common + self.of_observed(observed, states, places, counts)[:, None]
            if program is not None:
                apart = observed is None
                return self._drawn(program, states, places, counts, common, levels, uniform, apart=apart)
            # A residue's torsion in each state, as `conditioning_states` has it.
            ones = torch.eye(MOST_STATES, device=counts.device) * (counts > 0)[..., None, None]
            residues, most = torch.arange(len(counts), device=counts.device), (counts - 1).clamp(min=0)
            turns = [
                (part, torch.nonzero((counts[part] > 0).any(0))[:, 0].tolist()) for part in self.turns(len(counts))
            ]
            now, found = states[:, None], []
            before = conditioning = conditioning_states(now, counts)
            for k in range(times_ps.shape[1]):
                at = slice(k, k + 1)
                h = self.of_frames(conditioning, before) + common[:, at]
                new, before, conditioning = torch.zeros_like(now), conditioning, torch.zeros_like(conditioning)
                for part, torsions in turns:
                    seen = (h + self.of_new_states(conditioning))[..., part, :]
                    for torsion in torsions:
                        logits = self.probabilities(
                            torsion, seen, levels[:, at, :, part], now[..., part, torsion], conditioning[..., part, :]
                        )
                        share = logits.softmax(-1)
                        if shares is not None:
                            shares[:, at, part, torsion] = share
                        share = share.cumsum(-1)
                        # Shares may end below one by rounding.
                        drawn = (uniform[:, at, part, torsion, None] >= share[..., :-1]).sum(-1)
                        new[..., part, torsion] = drawn.minimum(most[part, torsion])
                        own = slice(torsion * MOST_STATES, (torsion + 1) * MOST_STATES)
                        conditioning[..., part, own] = ones[residues[part], torsion, new[..., part, torsion]]
                found.append(new)
                now = new
            return torch.cat(found, dim=1)

    def _drawn(
        self, program: ctypes.CDLL, states: Tensor, places: Tensor, counts: Tensor, *numbers: Tensor, apart: bool
    ) -> Tensor:
        """Return what `draw` does, by the program, which reads weights where they are."""
        kept: list[Tensor] = []

        def at(tensor: Tensor) -> int:
            kept.append(tensor.detach().contiguous())
            return kept[-1].data_ptr()

        def linear(layer: nn.Module) -> _Linear:
            bias = cast(Tensor | None, layer.bias)
            return _Linear(at(cast(Tensor, layer.weight)), None if bias is None else at(bias))

        of_types, distances = self._of_types(places)
        net = _Net(len(places), self.coupled, at(counts))
        for name, layers in (("given", self.of_given), ("before", self.of_before), ("fresh", self.of_new)):
            getattr(net, name)[:] = [linear(layer) for layer in layers]
        net.earlier, net.hidden, net.logits = (linear(layer) for layer in (self.of_earlier, self.hidden, self.logits))
        net.torsion, net.types = at(self.of_torsion.weight), at(of_types)
        if distances is not None:
            net.distances = at(distances)
            net.beside[:] = [linear(layer) for layer in (*self.of_new_beside, self.of_new_two_before)]
            for k, block in enumerate(cast(list[ParallelBlock], list(self.blocks))):
                parts = block.proj_in, block.attention_out, block.mlp_out
                net.blocks[k] = _Block(at(block.offset), *(linear(part) for part in parts))
        common, levels, uniform = numbers
        found = states.new_empty(uniform.shape)
        arrays = at(common), at(levels), at(states), at(uniform), found.data_ptr()
        sizes = (ctypes.c_int64(n) for n in (*uniform.shape[:2], apart))
        program.draw(ctypes.byref(net), *sizes, *(ctypes.c_void_p(x) for x in arrays))
        return found


# The program, and what it takes, as `state_jumps.cpp` declares it.


class _Linear(ctypes.Structure):
    _fields_ = [("weight", ctypes.c_void_p), ("bias", ctypes.c_void_p)]


class _Block(ctypes.Structure):
    _fields_ = [("offset", ctypes.c_void_p), *((name, _Linear) for name in ("proj_in", "attention_out", "mlp_out"))]


class _Net(ctypes.Structure):
    _fields_ = [
        ("n_residues", ctypes.c_int64), ("coupled", ctypes.c_int64), ("counts", ctypes.c_void_p),
        ("given", 3 * _Linear), ("before", 3 * _Linear), ("earlier", _Linear), ("beside", 3 * _Linear),
        ("fresh", MOST_TORSIONS * _Linear), ("hidden", _Linear), ("logits", _Linear),
        *((name, ctypes.c_void_p) for name in ("torsion", "types", "distances")), ("blocks", _COUPLED_BLOCKS * _Block),
    ]  # fmt: skip


def _knowing_two_before(net: nn.Module, state: dict[str, Tensor], prefix: str, *_: object) -> None:
    """Weights from before `of_new_two_before` know nothing of it."""
    name = "of_new_two_before.weight"
    state.setdefault(prefix + name, torch.zeros_like(net.get_parameter(name)))


@cache
def _program() -> ctypes.CDLL | None:
    """Return the program; None where it cannot be compiled."""
    sizes = {"WIDTH": _WIDTH, "STATES": MOST_STATES, "TORSIONS": MOST_TORSIONS, "HEADS": _COUPLED_HEADS,
             "BLOCKS": _COUPLED_BLOCKS}  # fmt: skip
    try:
        return compiled_program(Path(__file__).with_suffix(".cpp"), sizes)
    except (CompilerError, OSError):
        return None


def distances_along(n: int, device: torch.device) -> Tensor:
    """Return how far `n` residues are apart along the chain, as numbers from 0 to 2 * FAR, `(n, n)`."""
    place = torch.arange(n, device=device)
    return (place[:, None] - place).clamp(-FAR, FAR) + FAR


def _beside(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return of residues `(..., r, n)` each itself, the one before it and the one after it."""
    none = torch.zeros_like(x[..., :1, :])
    return x, torch.cat([none, x[..., :-1, :]], -2), torch.cat([x[..., 1:, :], none], -2)
