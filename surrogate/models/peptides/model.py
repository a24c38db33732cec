"""LaM-SLidE for peptides of any sequence: residues as entities, coded exactly, and a flow over residues and time.

An entity's identifier is its residue's type, its neighbours' types and its place in the chain; its code are the
internal coordinates of `models.peptides.chains`, so that no first stage is trained and nothing of an unseen sequence
is lost. The flow runs on innovations: of each coordinate at time t after the conditioning frame, what its correlation
with that frame leaves to learn, (z_t - ρ(t) z_0) / sqrt(1 - ρ(t)²), which has unit variance at any t. Each frame of a
chunk has its own time, so that one model serves all spacings. The states of torsions with barriers are drawn first;
their numbers count from the mean of those in their state. Frames that leave these states a little, or in which atoms
overlap, are mended by small turns; chunks with frames where that is not enough are drawn again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import ClassVar, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.lam_slide import flow
from surrogate.models.layers import ParallelBlock, TimeEmbedding, rotary_angles
from surrogate.models.peptides.chains import MOST_STATES, MOST_TORSIONS, ChainFeatures, conditioning_states, mended
from surrogate.models.peptides.layout import PeptideConfig, chain_features
from surrogate.models.propagator import Chunk, Molecule, Propagator, row_by_row
from systems.chemistry.geometry import superpose
from systems.errors import InputError
from systems.scene import Scene

# Which state each torsion with barriers is in, drawn before the flow draws the frames that go with it: a flow that
# draws barrier crossings along with everything else leaks between states, and a categorical draw does not.

_WIDTH = 96
_WAVES = 8
# Before training, a torsion changes to another state once in so many frames (in logits).
_RARELY = -5.0
# A step of training moves the probabilities by so many times as much as another parameter.
_FAST = 10.0
# Residues further apart along the chain are alike far.
_FAR = 6
_COUPLED_BLOCKS, _COUPLED_HEADS = 2, 4


class StateJumps(nn.Module):
    """The probabilities that torsions change their states between a frame and the next.

    They follow from the residue's type, its numbers in the given frame, its and its two neighbours' states in that and
    in the frame before, its own in the one before that, the new states of its torsions before this one, and both times.
    Of neighbours' types only levels are learned, which add up: else the network would know each pair of training.

    `coupled`, for trainings on many more sequences: neighbours' types count in full, attention over residues mixes what
    the given frame tells, and every other residue sees the new states of those beside it, which are drawn first.
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
            self.of_distance = nn.Embedding(2 * _FAR + 1, _COUPLED_HEADS)
            self.of_new_beside = nn.ModuleList(nn.Linear(n_states, _WIDTH, bias=False) for _ in range(2))
            # Weights that are gone on from begin as they were.
            for part in (*self.of_type_beside, *self.of_new_beside):
                nn.init.zeros_(cast(nn.Embedding | nn.Linear, part).weight)

    @property
    def turns(self) -> tuple[slice, ...]:
        """The residues whose new states are drawn at once, one part after the other."""
        return (slice(0, None, 2), slice(1, None, 2)) if self.coupled else (slice(None),)

    def of_observed(self, observed: Tensor, states: Tensor, places: Tensor, counts: Tensor) -> Tensor:
        """What all frames of a chunk have in common: `observed` (b, r, slots), its `states` (b, r, MOST_TORSIONS),
        `places` (r, 4) -> (b, r, width)."""
        beside = _beside(conditioning_states(states, counts))
        h: Tensor = sum((of(x) for of, x in zip(self.of_given, beside, strict=True)), self.of_numbers(observed.float()))
        h = h + self.of_type(places[:, 0])
        if self.coupled:
            h = h + sum(of(places[:, 1 + k]) for k, of in enumerate(self.of_type_beside))
            bias = self.of_distance(distances_along(len(places), h.device)).permute(2, 0, 1)
            still = h.new_zeros(len(h), 3, _WIDTH)
            for block in self.blocks:
                h = block(h[:, None], still, None, bias=bias)[0][:, 0]
        return h

    def of_new_states(self, conditioning: Tensor) -> Tensor | float:
        """What every other residue sees of the new states beside it: `conditioning` (b, t, r, n) of the new frame ->
        (b, t, r, width), zero for the residues of the first turn."""
        if not self.coupled:
            return 0.0
        found: Tensor = sum(
            (of(x) for of, x in zip(self.of_new_beside, _beside(conditioning)[1:], strict=True)),
            conditioning.new_zeros(()),
        )
        return found * (torch.arange(found.shape[-2], device=found.device) % 2)[:, None]

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
        self, observed: Tensor, states: Tensor, places: Tensor, counts: Tensor, times_ps: Tensor, apart_ps: Tensor,
        uniform: Tensor, shares: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """Return states `(b, t, r, MOST_TORSIONS)` of new frames, from the given frame's numbers and `states`
        (b, r, MOST_TORSIONS) and numbers `uniform` (b, t, r, MOST_TORSIONS) in [0, 1). Their probabilities are written
        to `shares` (b, t, r, MOST_TORSIONS, MOST_STATES)."""
        with torch.autocast(observed.device.type, enabled=False):
            of_times, levels = self.of_times_alone(times_ps, apart_ps, places, counts)
            common = self.of_observed(observed, states, places, counts)[:, None] + of_times[:, :, None]
            # A residue's torsion in each state, as `conditioning_states` has it.
            ones = torch.eye(MOST_STATES, device=observed.device) * (counts > 0)[..., None, None]
            residues, most = torch.arange(len(counts), device=observed.device), (counts - 1).clamp(min=0)
            turns = [(part, torch.nonzero((counts[part] > 0).any(0))[:, 0].tolist()) for part in self.turns]
            now, found = states[:, None], []
            before = conditioning = conditioning_states(now, counts)
            for k in range(times_ps.shape[1]):
                at = slice(k, k + 1)
                h = self.of_frames(conditioning, before) + common[:, at]
                new, before, conditioning = torch.zeros_like(now), conditioning, torch.zeros_like(conditioning)
                for turn, (part, torsions) in enumerate(turns):
                    seen = (h + self.of_new_states(conditioning) if turn else h)[..., part, :]
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


def times_apart(times_ps: Tensor, forgotten_ps: float) -> Tensor:
    """Return the time `(b, t)` between each frame and the one before it; frames of endless times know none before."""
    before = torch.cat([torch.zeros_like(times_ps[:, :1]), times_ps[:, :-1]], dim=1)
    return torch.where(times_ps >= forgotten_ps, times_ps, times_ps - before)


def distances_along(n: int, device: torch.device) -> Tensor:
    """Return how far `n` residues are apart along the chain, as numbers from 0 to 2 * _FAR, `(n, n)`."""
    place = torch.arange(n, device=device)
    return (place[:, None] - place).clamp(-_FAR, _FAR) + _FAR


def _beside(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return of residues `(..., r, n)` each itself, the one before it and the one after it."""
    none = torch.zeros_like(x[..., :1, :])
    return x, torch.cat([none, x[..., :-1, :]], -2), torch.cat([x[..., 1:, :], none], -2)


# More random numbers than a chunk's noise holds: pairs of numbers of its first frame, which nothing else uses, seed
# generators, a row's from its own. Where the pair stands that seeds each use:
REDRAWS, STATES = 1, 5


def generators(noise: Tensor, place: int, attempt: int = 0) -> list[torch.Generator]:
    """Return one generator a row of `noise`, seeded by its two numbers from `place` on and by `attempt`."""
    found = []
    for row in noise:
        low, high = row[0].flatten()[place : place + 2].float().cpu().view(torch.int32).tolist()
        seed = ((low & 0xFFFFFFFF) << 31) ^ ((high & 0xFFFFFFFF) << 8) ^ attempt
        found.append(torch.Generator().manual_seed(seed))
    return found


_MOST_CORRELATED = 0.995
_LONGEST_WAVE = 4.0
# Chunks that disobey the states that were drawn for them, or whose atoms overlap, are drawn again so often.
MAX_REDRAWS = 8
# Where atoms overlap so many times, there may be no room for them in these states, and these are drawn again, too.
_OVERLAPS = 2


class TypedLinear(nn.Module):
    """A linear map that all residue types share, and to it each type's own, which begins at zero."""

    def __init__(self, n_in: int, n_out: int, n_types: int, *, zero: bool = False) -> None:
        super().__init__()
        self.shared = nn.Linear(n_in, n_out)
        self.own = nn.Parameter(torch.zeros(n_types, n_in, n_out))
        if zero:
            nn.init.zeros_(self.shared.weight)
            nn.init.zeros_(self.shared.bias)

    def forward(self, x: Tensor, types: Tensor) -> Tensor:
        """`x` (b, t, r, n_in), `types` (r,) -> (b, t, r, n_out)."""
        own = torch.einsum("btri,rio->btro", x, self.own[types].to(x.dtype))
        return self.shared(x) + own


class Conditioning(NamedTuple):
    """What the evaluations of a chunk have in common: `types` (r,), `of_type` (r, width), `given` (b, 1, r, width) the
    embedded frame, `of_frames` (b, t, r, width) the frames' times and states, `rope` of the frames, of each layer the
    `biases` between residues, and what the solvent adds to flow time's embedding, `of_solvent` (width,).
    """

    types: Tensor
    of_type: Tensor
    given: Tensor
    of_frames: Tensor
    rope: tuple[Tensor, Tensor]
    biases: list[Tensor]
    of_solvent: Tensor | float


class PeptideLayer(nn.Module):
    """One block over the residues of a frame, one over the frames of a residue (Algorithm 5)."""

    def __init__(self, width: int, n_heads: int) -> None:
        super().__init__()
        self.spatial = ParallelBlock(width, n_heads)
        self.temporal = ParallelBlock(width, n_heads)
        self.of_distance = nn.Embedding(2 * _FAR + 1, n_heads)

    def forward(self, h: Tensor, modulation: Tensor, rope: tuple[Tensor, Tensor], bias: Tensor) -> Tensor:
        """`h` (b, r, t, width); `bias` (n_heads, r, r): of scores, by how far apart residues are (`of_distance`)."""
        h = self.spatial(h.transpose(1, 2), modulation[:, :3], None, bias=bias)[0].transpose(1, 2)
        return self.temporal(h, modulation[:, 3:], rope)[0]


class PeptideFlow(nn.Module):
    """Data prediction: noisy innovations of a chunk, flow time, the given frame, each frame's time -> innovations."""

    def __init__(self, config: PeptideConfig, n_slots: int) -> None:
        super().__init__()
        c, n_types = config, config.n_types
        self.config = config
        self.of_noisy = TypedLinear(n_slots, c.width, n_types)
        self.of_known = TypedLinear(n_slots, c.width, n_types)
        self.of_type = nn.ModuleList(nn.Embedding(n_types, c.width) for _ in range(3))
        self.of_given = nn.Parameter(torch.randn(c.width) * 0.02)
        self.of_states = TypedLinear(MOST_TORSIONS * MOST_STATES, c.width, n_types)
        n_waves = 16
        self.waves = nn.Buffer(math.pi * torch.linspace(1.0 / _LONGEST_WAVE, 4.0, n_waves), persistent=False)
        self.of_time = nn.Sequential(nn.Linear(2 * n_waves, c.width), nn.SiLU(), nn.Linear(c.width, c.width))
        self.embed_tau = TimeEmbedding(c.width)
        self.of_solvent = nn.Embedding(len(c.solvents), c.width) if len(c.solvents) > 1 else None
        if self.of_solvent is not None:
            nn.init.zeros_(self.of_solvent.weight)
        self.layers = nn.ModuleList(PeptideLayer(c.width, c.n_heads) for _ in range(c.n_layers))
        self.modulation = nn.Linear(c.width, 6 * c.width)
        self.final_modulation = nn.Linear(c.width, 2 * c.width)
        self.final = TypedLinear(c.width, n_slots, n_types, zero=True)
        for module in (self.modulation, self.final_modulation):
            nn.init.zeros_(module.weight)
            nn.init.zeros_(module.bias)

    def forward(self, o: Tensor, tau: Tensor, conditioning: Conditioning) -> Tensor:
        """`o` (b, t, r, slots), `tau` (b,), or (1,) of all -> like `o`."""
        skip, out, scale_in = (flow.expand(v, o) for v in flow.preconditioning(tau))
        return skip * o + out * self._network(o * scale_in, tau, conditioning)

    def conditioning(self, observed: Tensor, times_ps: Tensor, places: Tensor, states: Tensor) -> Conditioning:
        """Return what all evaluations of a chunk have in common, of the given frame's numbers `observed` (b, r, slots),
        `times_ps` (b, t), `places` (r, 4), and the `conditioning_states` (b, 1 + t, r, n) of that frame and the
        others."""
        types = places[:, 0]
        of_states = self.of_states(states, types)
        of_type: Tensor = sum((table(places[:, k]) for k, table in enumerate(self.of_type)), torch.zeros(()))
        angles = rotary_angles(times_ps.shape[1] + 1, self.config.width // self.config.n_heads).to(observed.device)
        apart = distances_along(len(types), observed.device)
        given = self.of_known(observed[:, None], types) + of_states[:, :1] + self.of_given
        of_frames = self._of_times(times_ps)[:, :, None] + of_states[:, 1:]
        biases = [cast(PeptideLayer, layer).of_distance(apart).permute(2, 0, 1) for layer in self.layers]
        of_solvent = 0.0 if self.of_solvent is None else self.of_solvent(places[0, 3])
        return Conditioning(types, of_type, given, of_frames, (angles.cos(), angles.sin()), biases, of_solvent)

    def _network(self, o: Tensor, tau: Tensor, conditioning: Conditioning) -> Tensor:
        noisy = self.of_noisy(o, conditioning.types) + conditioning.of_frames
        h = torch.cat([conditioning.given, noisy], dim=1) + conditioning.of_type
        time = F.silu(self.embed_tau(tau) + conditioning.of_solvent)
        modulation = self.modulation(time).unflatten(-1, (6, -1))
        h = h.transpose(1, 2)
        for layer, bias in zip(self.layers, conditioning.biases, strict=True):
            h = layer(h, modulation, conditioning.rope, bias)
        shift, scale = self.final_modulation(time)[:, None, None, :].chunk(2, dim=-1)
        h = F.layer_norm(h.transpose(1, 2)[:, 1:], h.shape[-1:]) * (1.0 + scale) + shift
        found: Tensor = self.final(h, conditioning.types)
        return found.float()

    def _of_times(self, times_ps: Tensor) -> Tensor:
        with torch.autocast(times_ps.device.type, enabled=False):
            angles = times_ps.float().clamp(min=1e-3).log10()[..., None] * self.waves
            return self.of_time(torch.cat([angles.sin(), angles.cos()], dim=-1))


class PeptideSlide(Propagator):
    """The flow between frames of a peptide, behind the contract of `surrogate.models.propagator`.

    The flow serves all solvents. Each has probabilities of states of its own, those of further solvents than the first
    in `jumps_elsewhere`.
    `token_mean` (kinds, states, slots), `token_scale` (kinds, slots): what makes a coordinate's numbers centred, for
    each state of its torsion where that has states (else all are the first), and of unit variance;
    `correlation` (kinds, lags, slots): with the same coordinate of an earlier frame, at the configuration's lags. A
    kind is a residue type in a solvent.
    """

    arch: ClassVar[str] = "lam-slide-peptides"
    float32_layers: tuple[str, ...] = ("flow.of_time", "jumps")
    usual_lag_ps: float | None = 100.0
    # Changes that are rarer by a factor than in the first are right for steps short beside a torsion's relaxation.
    usual_lag_elsewhere_ps: float | None = 20.0
    config: PeptideConfig

    def __init__(self, config: PeptideConfig) -> None:
        super().__init__()
        if config.scale is None or not config.types:
            raise InputError("a model of peptides needs the scale of their coordinates and their residue types.")
        self.config = config
        if config.usual_solver not in flow.SOLVERS:
            raise InputError(f"usual_solver = {config.usual_solver!r} is none of {', '.join(flow.SOLVERS)}.")
        self.solvers = tuple(dict.fromkeys((config.usual_solver, *flow.SOLVERS)))
        self.usual_steps = config.usual_steps
        n_slots, n_solvents = config.scale.n_slots, max(1, len(config.solvents))
        self.flow = PeptideFlow(config, n_slots)
        self.jumps, *elsewhere = (
            StateJumps(n_slots, config.n_types, coupled=config.coupled) for _ in range(n_solvents)
        )
        self.jumps_elsewhere = nn.ModuleList(elsewhere)
        self.lag_range_ps = config.shortest_ps, config.longest_ps
        self.lag_ps = config.shortest_ps
        n_kinds = config.n_types * n_solvents
        self.token_mean = nn.Buffer(torch.zeros(n_kinds, MOST_STATES, n_slots))
        self.token_scale = nn.Buffer(torch.ones(n_kinds, n_slots))
        self.correlation = nn.Buffer(torch.zeros(n_kinds, len(config.lags_ps), n_slots))

    def featurise(self, scene: Scene) -> Molecule:
        """See `Propagator.featurise`; `own`: the chain's `ChainFeatures`. Raises InputError for a scene that is no
        chain of residues that training saw."""
        return Molecule.of(scene, chain_features(scene, self.config, self.solvent))

    @property
    def n_new(self) -> int:
        assert self.lag_ps is not None
        return max(1, min(self.config.chunk_frames, int(self.config.longest_ps / self.lag_ps * (1 + 1e-6))))

    def normalised(self, frames_nm: Tensor, chain: ChainFeatures) -> tuple[Tensor, Tensor]:
        """Frames `(..., n_atoms, 3)` nm -> numbers `(..., n_residues, n_slots)`, zero in empty places, and the states
        `(..., n_residues, MOST_TORSIONS)` of torsions."""
        states = chain.states(frames_nm)
        centred = chain.code.encode(frames_nm) - self.middle(states, chain)
        return torch.where(chain.code.filled, centred / self.token_scale[self.kinds(chain)], 0.0), states

    @property
    def all_jumps(self) -> nn.ModuleList:
        """The probabilities of states in every solvent."""
        return nn.ModuleList([self.jumps, *self.jumps_elsewhere])

    def jumps_of(self, chain: ChainFeatures) -> StateJumps:
        """Return the probabilities of states in the solvent that a chain is in."""
        return cast(StateJumps, self.all_jumps[chain.solvent])

    def kinds(self, chain: ChainFeatures) -> Tensor:
        """Return each residue's type in its solvent `(n_residues,)`, as the tables have them."""
        return chain.places[:, 0] + self.config.n_types * chain.solvent

    def middle(self, states: Tensor, chain: ChainFeatures) -> Tensor:
        """Return from where numbers count, `(..., n_residues, n_slots)`, in `states` (..., n_residues,
        MOST_TORSIONS)."""
        own = chain.state_of_numbers(states)
        mean = self.token_mean[self.kinds(chain)]
        found = mean[:, 0].expand_as(own)
        for state in range(1, MOST_STATES):
            found = torch.where(own == state, mean[:, state], found)
        return found

    def _tokens(self, numbers: Tensor, states: Tensor, chain: ChainFeatures) -> Tensor:
        return numbers.float() * self.token_scale[self.kinds(chain)] + self.middle(states, chain)

    @staticmethod
    def _laid(frames: Tensor, chain: ChainFeatures) -> Tensor:
        flat = frames.flatten(0, -3).double().cpu().numpy()
        laid = superpose(flat, chain.template_nm, idx=chain.fitted)
        return torch.from_numpy(laid).float().reshape(frames.shape).to(frames.device)

    def correlation_at(self, times_ps: Tensor, kinds: Tensor) -> Tensor:
        """Return the correlations `(b, t, r, slots)` with the given frame, linear in log t between the lags kept; none
        at `forgotten_ps`."""
        if not self.config.innovation:
            return self.correlation.new_zeros(*times_ps.shape, len(kinds), self.correlation.shape[-1])
        lags = self.config.lags_ps.to(times_ps.device).log()
        at = times_ps.float().log().clamp(float(lags[0]), float(lags[-1]))
        right = torch.searchsorted(lags, at).clamp(1, len(lags) - 1)
        share = ((at - lags[right - 1]) / (lags[right] - lags[right - 1]))[..., None, None]
        table = self.correlation[kinds].transpose(0, 1)  # (lags, r, slots)
        found = (table[right - 1] * (1 - share) + table[right] * share).clamp(0.0, _MOST_CORRELATED)
        return torch.where((times_ps >= self.config.forgotten_ps)[..., None, None], 0.0, found)

    def innovations(self, later: Tensor, observed: Tensor, times_ps: Tensor, kinds: Tensor) -> Tensor:
        """Numbers `(b, t, r, slots)` at `times_ps` (b, t) after `observed` (b, r, slots) -> innovations."""
        rho = self.correlation_at(times_ps, kinds)
        return (later - rho * observed[:, None]) / (1.0 - rho.square()).sqrt()

    def from_innovations(self, y: Tensor, observed: Tensor, times_ps: Tensor, kinds: Tensor) -> Tensor:
        """The inverse of `innovations`."""
        rho = self.correlation_at(times_ps, kinds)
        return rho * observed[:, None] + (1.0 - rho.square()).sqrt() * y

    def solved(
        self, observed: Tensor, now: Tensor, states: Tensor, times_ps: Tensor, chain: ChainFeatures, drawn: Tensor, *,
        solver: str, solver_steps: int,
    ) -> tuple[Tensor, int]:  # fmt: skip
        """Return coordinates `(b, t, r, slots)`, as `ChainCode.encode` gives them, at `times_ps` (b, t) after a frame
        with numbers `observed` (b, r, slots) and states `now` (b, r, MOST_TORSIONS), in `states` (b, t, r,
        MOST_TORSIONS), from noise `drawn` (b, t, r, slots); and how often the flow was evaluated."""
        of_states = conditioning_states(torch.cat([now[:, None], states], dim=1), chain.stated.counts)
        conditioning, evaluations = self.flow.conditioning(observed, times_ps, chain.places, of_states), 0

        def predict(o: Tensor, tau: Tensor) -> Tensor:
            nonlocal evaluations
            evaluations += 1
            return torch.where(chain.code.filled, self.flow(o, tau, conditioning), 0.0)

        y = flow.SOLVERS[solver](predict, drawn, solver_steps)
        return self._tokens(self.from_innovations(y, observed, times_ps, self.kinds(chain)), states, chain), evaluations

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        # At least as many numbers as a frame has coordinates that vary.
        return (self.n_new, n_atoms, 4)

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 10,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        chain: ChainFeatures | None = molecule.own
        if chain is None:
            raise InputError("this model knows peptides by residues; make molecules by its `featurise`.")
        solver = solver or self.solvers[0]
        if solver in flow.ADAPTIVE and len(noise) > 1:
            draw = partial(self.next_chunk, solver_steps=solver_steps, solver=solver)
            return row_by_row(lambda x, own: draw(x, molecule, own), last_frames_nm, noise)
        filled = chain.code.filled
        observed, now = self.normalised(last_frames_nm[:, -1], chain)
        assert self.lag_ps is not None
        ahead = self.lag_ps * torch.arange(1, self.n_new + 1, device=observed.device)
        times = ahead.expand(len(observed), -1).float()
        drawn = observed.new_zeros(*noise.shape[:2], *filled.shape)
        drawn[..., filled] = noise.flatten(2)[..., : int(filled.sum())].to(observed)
        counts, apart = chain.stated.counts, times_apart(times, self.config.forgotten_ps)
        shape, jumps = (self.n_new, *counts.shape), self.jumps_of(chain)

        def draw_states(rows: Tensor, attempt: int) -> Tensor:
            seeds = generators(noise[rows], STATES, attempt)
            uniform = torch.stack([torch.rand(shape, generator=g) for g in seeds]).to(observed)
            return jumps.draw(observed[rows], now[rows], chain.places, counts, times[rows], apart[rows], uniform)

        rows = torch.arange(len(observed), device=observed.device)
        states = draw_states(rows, 0)
        evaluations = 0.0

        def solve(rows: Tensor, drawn: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            """Return frames, and in which rows some disobey their states and some overlap, all that could be done."""
            nonlocal evaluations
            given = observed[rows], now[rows], states[rows], times[rows]
            tokens, n = self.solved(*given, chain, drawn, solver=solver, solver_steps=solver_steps)
            evaluations += n * len(rows) / len(observed)
            resolved = mended(tokens.flatten(0, 1), states[rows].flatten(0, 1), chain)
            frames, astray, crowded = (x.unflatten(0, tokens.shape[:2]) for x in resolved)
            return self._laid(frames, chain), astray.any(-1), crowded.any(-1)

        frames, astray, crowded = solve(rows, drawn)
        for attempt in range(MAX_REDRAWS):
            wrong = astray | crowded
            rows, overlap = rows[wrong], crowded[wrong]
            if not len(rows):
                break
            if attempt >= _OVERLAPS and overlap.any():
                states[rows[overlap]] = draw_states(rows[overlap], attempt)
            again = drawn.new_zeros(len(rows), *drawn.shape[1:])
            seeds = generators(noise[rows], REDRAWS, attempt)
            fresh = (*drawn.shape[1:2], int(filled.sum()))
            again[..., filled] = torch.stack([torch.randn(fresh, generator=g) for g in seeds]).to(again)
            frames[rows], astray, crowded = solve(rows, again)
        return Chunk(frames, evaluations=evaluations)
