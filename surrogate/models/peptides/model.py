"""LaM-SLidE for peptides of any sequence: residues as entities, coded exactly, and a flow over residues and time.

An entity's identifier is its residue's type, its neighbours' types and its place in the chain; its code are the
internal coordinates of `models.peptides.chains`, so that no first stage is trained and nothing of an unseen sequence
is lost. The flow runs on innovations: of each coordinate at time t after the conditioning frame, what its correlation
with that frame leaves to learn, (z_t - ρ(t) z_0) / sqrt(1 - ρ(t)²), which has unit variance at any t. Each frame of a
chunk has its own time, so that one model serves all spacings. The states of torsions with barriers are drawn first;
their numbers count from the mean of those in their state. Frames that leave these states a little, or in which atoms
overlap, are mended by small turns; chunks with frames where that is not enough are drawn again, and of frames far
apart, which do not depend on one another, these alone.
"""

from __future__ import annotations

import math
from functools import partial
from typing import ClassVar, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.lam_slide import flow
from surrogate.models.layers import ParallelBlock, TimeEmbedding, rotary_angles
from surrogate.models.peptides.chains import MOST_STATES, MOST_TORSIONS, ChainFeatures, conditioning_states, mended
from surrogate.models.peptides.layout import PeptideConfig, chain_features
from surrogate.models.peptides.state_jumps import FAR, StateJumps, distances_along
from surrogate.models.propagator import Chunk, Molecule, Propagator, row_by_row
from systems.chemistry.geometry import superpose
from systems.errors import InputError
from systems.scene import Scene


def times_apart(times_ps: Tensor, forgotten_ps: float) -> Tensor:
    """Return the time `(b, t)` between each frame and the one before it; frames of endless times know none before."""
    before = torch.cat([torch.zeros_like(times_ps[:, :1]), times_ps[:, :-1]], dim=1)
    return torch.where(times_ps >= forgotten_ps, times_ps, times_ps - before)


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
# Frames further apart than this are drawn each on its own, and as many times as many make a chunk.
_FAR_APART_PS, _FAR_APART_FRAMES = 500.0, 4
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
        self.of_distance = nn.Embedding(2 * FAR + 1, n_heads)

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
        most, within = self.config.chunk_frames, int(self.config.longest_ps / self.lag_ps * (1 + 1e-6))
        return _FAR_APART_FRAMES * most if self.far_apart(self.lag_ps) else max(1, min(most, within))

    def far_apart(self, lag_ps: float) -> bool:
        """Whether the numbers of a frame say next to nothing of the next. Then all frames of a chunk count as the first
        after the given one, and states follow from those of the frame before alone."""
        return lag_ps > _FAR_APART_PS * (1 + 1e-6)

    def keeps_populations(self, lag_ps: float) -> bool:
        in_first = self.solvent in (None, *self.config.solvents[:1])
        return super().keeps_populations(lag_ps) or (in_first and self.far_apart(lag_ps))

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
        filled, counts = chain.code.filled, chain.stated.counts
        observed, now = self.normalised(last_frames_nm[:, -1], chain)
        lag_ps = self.lag_ps
        assert lag_ps is not None
        n_new, far_apart, device = self.n_new, self.far_apart(lag_ps), observed.device
        ahead = torch.ones(n_new) if far_apart else torch.arange(1, n_new + 1)
        times = (lag_ps * ahead.to(observed)).expand(len(observed), -1)
        apart = times if far_apart else times_apart(times, self.config.forgotten_ps)
        drawn = observed.new_zeros(*noise.shape[:2], *filled.shape)
        drawn[..., filled] = noise.flatten(2)[..., : int(filled.sum())].to(observed)
        jumps = self.jumps_of(chain)

        def draw_states(rows: Tensor, before: Tensor, attempt: int) -> Tensor:
            seeds = generators(noise[rows], STATES, attempt)
            uniform = torch.stack([torch.rand(n_new, *counts.shape, generator=g) for g in seeds]).to(observed)
            given = None if far_apart else observed[rows]
            return jumps.draw(given, before, chain.places, counts, times[rows], apart[rows], uniform)

        states = draw_states(torch.arange(len(observed)), now, 0)
        frames = observed.new_empty(*times.shape, *last_frames_nm.shape[-2:])
        # What is yet to be drawn, and where atoms overlapped.
        todo, crowded = torch.ones_like(times, dtype=torch.bool), torch.zeros_like(times, dtype=torch.bool)
        evaluations = 0.0
        for attempt in range(-1, MAX_REDRAWS):
            if attempt >= _OVERLAPS:
                for row in torch.nonzero((todo & crowded).any(1)).flatten().tolist():
                    first = int(crowded[row].int().argmax()) if far_apart else 0
                    own, before = torch.tensor([row]), states[row, first - 1] if first else now[row]
                    states[row, first:] = draw_states(own, before[None], attempt)[0, : n_new - first]
                    todo[row, first:] = True
            rows = torch.nonzero(todo.any(1))[:, 0]
            if not len(rows):
                break
            if attempt >= 0:
                seeds, fresh = generators(noise[rows], REDRAWS, attempt), (n_new, int(filled.sum()))
                again = drawn[rows]
                again[..., filled] = torch.stack([torch.randn(fresh, generator=g) for g in seeds]).to(again)
                drawn[rows] = torch.where(todo[rows][..., None, None], again, drawn[rows])
            # Frames far apart are drawn each on its own, else whole chunks.
            start, frame = torch.nonzero(todo).T if far_apart else (rows, torch.arange(n_new, device=device))
            at = start[:, None], frame[:, None] if far_apart else frame
            tokens, n = self.solved(
                observed[start], now[start], states[at], times[at], chain, drawn[at],
                solver=solver, solver_steps=solver_steps,
            )  # fmt: skip
            evaluations += n * len(start) * tokens.shape[1] / todo.numel()
            resolved = mended(tokens.flatten(0, 1), states[at].flatten(0, 1), chain)
            placed, astray, crowded[at] = (x.unflatten(0, tokens.shape[:2]) for x in resolved)
            frames[at] = self._laid(placed, chain)
            todo[at] = (astray | crowded[at]).any(1, keepdim=True)
        return Chunk(frames, evaluations=evaluations)
