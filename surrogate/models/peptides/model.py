"""LaM-SLidE for peptides of any sequence: residues as entities, coded exactly, and a flow over residues and time.

An entity's identifier is its residue's type, its neighbours' types and its place in the chain; its code are the
internal coordinates of `models.peptides.chains`, so that no first stage is trained and nothing of an unseen sequence
is lost. The flow runs on innovations: of each coordinate at time t after the conditioning frame, what its correlation
with that frame leaves to learn, (z_t - ρ(t) z_0) / sqrt(1 - ρ(t)²), which has unit variance at any t. Each frame of a
chunk has its own time, so that one model serves all spacings. The states of torsions with high barriers are drawn first
(`models.peptides.torsion_states`); numbers of such a torsion count from the mean of those in its state. Frames that
leave these states a little, or in which atoms overlap as they never do in MD, are set right by small turns
(`models.peptides.chains`); chunks with frames where that is not enough are drawn again, in the same states and then
in others.
"""

from __future__ import annotations

import copy
import math
from typing import ClassVar, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.lam_slide import flow
from surrogate.models.layers import ParallelBlock, TimeEmbedding, rotary_angles
from surrogate.models.peptides.chains import ChainFeatures, resolve_settings
from surrogate.models.peptides.layout import ENDS, PeptideConfig, chain_features
from surrogate.models.peptides.torsion_states import (
    MOST_STATES,
    MOST_TORSIONS,
    StateJumps,
    conditioning_states,
    times_apart,
)
from surrogate.models.propagator import Chunk, Molecule, Propagator
from systems.chemistry.geometry import superpose
from systems.errors import InputError
from systems.scene import Scene

# More random numbers than a chunk's noise holds, from numbers in it that nothing else uses.
# The conditioning frames' place in the noise (b, T, L, dim) is taken by their clean latents, so numbers of its first
# frame are free: pairs of them seed generators, a row's from its own, so that no row depends on those beside it.

# Where the pair of numbers stands that seeds each use.
REDRAWS, STATES = 1, 5


def generators(noise: Tensor, place: int, attempt: int = 0) -> list[torch.Generator]:
    """Return one generator a row of `noise`, seeded by its two numbers from `place` on and by `attempt`."""
    found = []
    for row in noise:
        low, high = row[0].flatten()[place : place + 2].float().cpu().view(torch.int32).tolist()
        seed = ((low & 0xFFFFFFFF) << 31) ^ ((high & 0xFFFFFFFF) << 8) ^ attempt
        found.append(torch.Generator().manual_seed(seed))
    return found


# Residues further apart along the chain are alike far.
_FAR = 6
_SOLVERS = ("gaussian", "angular", *flow.solvers_for("linear"))
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
    embedded frame, `of_frames` (b, t, r, width) the frames' times and states, `rope` of the frames, and of each layer
    the `biases` between residues.
    """

    types: Tensor
    of_type: Tensor
    given: Tensor
    of_frames: Tensor
    rope: tuple[Tensor, Tensor]
    biases: list[Tensor]


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

    waves: Tensor

    def __init__(self, config: PeptideConfig, n_slots: int) -> None:
        super().__init__()
        c, n_types = config, len(config.types) + len(ENDS)
        self.config = config
        self.of_noisy = TypedLinear(n_slots, c.width, n_types)
        self.of_known = TypedLinear(n_slots, c.width, n_types)
        self.of_type = nn.ModuleList(nn.Embedding(n_types, c.width) for _ in range(3))
        self.of_given = nn.Parameter(torch.randn(c.width) * 0.02)
        self.of_states = TypedLinear(MOST_TORSIONS * MOST_STATES, c.width, n_types)
        n_waves = 16
        self.register_buffer("waves", math.pi * torch.linspace(1.0 / _LONGEST_WAVE, 4.0, n_waves), persistent=False)
        self.of_time = nn.Sequential(nn.Linear(2 * n_waves, c.width), nn.SiLU(), nn.Linear(c.width, c.width))
        self.embed_tau = TimeEmbedding(c.width)
        self.layers = nn.ModuleList(PeptideLayer(c.width, c.n_heads) for _ in range(c.n_layers))
        self.modulation = nn.Linear(c.width, 6 * c.width)
        self.final_modulation = nn.Linear(c.width, 2 * c.width)
        self.final = TypedLinear(c.width, n_slots, n_types, zero=True)
        for module in (self.modulation, self.final_modulation):
            nn.init.zeros_(module.weight)
            nn.init.zeros_(module.bias)

    def forward(self, o: Tensor, tau: Tensor, conditioning: Conditioning) -> Tensor:
        """`o` (b, t, r, slots), `tau` (b,), or (1,) of all, `told` what the method of that name returns -> like `o`."""
        skip, out, scale_in = (flow.expand(v, o) for v in flow.preconditioning(tau, "linear"))
        return skip * o + out * self._network(o * scale_in, tau, conditioning)

    def conditioning(self, known: Tensor, times_ps: Tensor, places: Tensor, states: Tensor) -> Conditioning:
        """Return what all evaluations of a chunk have in common, of the given frame `known` (b, r, slots), `times_ps`
        (b, t), `places` (r, 3), and `states` (b, 1 + t, r, n) of the given frame and the others
        (`conditioning_states`)."""
        types = places[:, 0]
        of_states = self.of_states(states, types)
        of_type: Tensor = sum((table(places[:, k]) for k, table in enumerate(self.of_type)), torch.zeros(()))
        angles = rotary_angles(times_ps.shape[1] + 1, self.config.width // self.config.n_heads).to(known.device)
        place = torch.arange(len(types), device=known.device)
        apart = (place[:, None] - place).clamp(-_FAR, _FAR) + _FAR
        return Conditioning(
            types,
            of_type,
            self.of_known(known[:, None], types) + of_states[:, :1] + self.of_given,
            self._of_times(times_ps)[:, :, None] + of_states[:, 1:],
            (angles.cos(), angles.sin()),
            [cast(PeptideLayer, layer).of_distance(apart).permute(2, 0, 1) for layer in self.layers],
        )

    def _network(self, o: Tensor, tau: Tensor, conditioning: Conditioning) -> Tensor:
        h = (
            torch.cat([conditioning.given, self.of_noisy(o, conditioning.types) + conditioning.of_frames], dim=1)
            + conditioning.of_type
        )
        time = F.silu(self.embed_tau(tau))
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

    `token_mean` (types, states, slots), `token_scale` (types, slots): what makes a coordinate's numbers centred, for
    each state of its torsion where that has states (else all are the first), and of unit variance;
    `correlation` (types, lags, slots): with the same coordinate of an earlier frame, at the configuration's lags.
    """

    arch: ClassVar[str] = "lam-slide-peptides"
    float32_layers: tuple[str, ...] = ("flow.of_time", "jumps")
    config: PeptideConfig
    token_mean: Tensor
    token_scale: Tensor
    correlation: Tensor

    def __init__(self, config: PeptideConfig) -> None:
        super().__init__()
        if config.scale is None or not config.types:
            raise InputError("a model of peptides needs the scale of their coordinates and their residue types.")
        self.config = config
        if config.usual_solver not in _SOLVERS:
            raise InputError(f"usual_solver = {config.usual_solver!r} is none of {', '.join(_SOLVERS)}.")
        self.solvers = tuple(dict.fromkeys((config.usual_solver, *_SOLVERS)))
        self.usual_steps = config.usual_steps
        n_types, n_slots = len(config.types) + len(ENDS), config.scale.n_slots
        self.flow = PeptideFlow(config, n_slots)
        self.jumps = StateJumps(n_slots, n_types)
        self.lag_ps = config.shortest_ps
        self.register_buffer("token_mean", torch.zeros(n_types, MOST_STATES, n_slots))
        self.register_buffer("token_scale", torch.ones(n_types, n_slots))
        self.register_buffer("correlation", torch.zeros(n_types, len(config.lags_ps), n_slots))

    def featurise(self, scene: Scene) -> Molecule:
        """See `Propagator.featurise`; `own`: the chain's `ChainFeatures`. Raises InputError for a scene that is no
        chain of residues that training saw."""
        return Molecule.of(scene, chain_features(scene, self.config))

    @property
    def n_conditioning(self) -> int:
        return 1

    @property
    def n_new(self) -> int:
        assert self.lag_ps is not None
        return max(1, min(self.config.chunk_frames, int(self.config.longest_ps / self.lag_ps * (1 + 1e-6))))

    def at_lag(self, lag_ps: float) -> PeptideSlide:
        """Return this model, its weights shared, with frames `lag_ps` apart. Raises InputError outside its range."""
        c = self.config
        if not c.shortest_ps * (1 - 1e-6) <= lag_ps <= c.longest_ps * (1 + 1e-6):
            raise InputError(f"a lag of {lag_ps:g} ps is none that this model was trained for.")
        model = copy.copy(self)
        model.lag_ps = lag_ps
        return model

    def normalised(self, frames_nm: Tensor, chain: ChainFeatures) -> tuple[Tensor, Tensor]:
        """Frames `(..., n_atoms, 3)` nm -> numbers `(..., n_residues, n_slots)`, zero in empty places, and the states
        `(..., n_residues, MOST_TORSIONS)` of torsions."""
        types, states = chain.places[:, 0], chain.states(frames_nm)
        centred = chain.code.encode(frames_nm) - self.middle(states, chain)
        return torch.where(chain.code.filled, centred / self.token_scale[types], 0.0), states

    def middle(self, states: Tensor, chain: ChainFeatures) -> Tensor:
        """Return from where numbers count, `(..., n_residues, n_slots)`, in `states` (..., n_residues,
        MOST_TORSIONS)."""
        at = chain.state_at.expand(*states.shape[:-1], -1)
        own = torch.where(at < 0, 0, states.gather(-1, at.clamp(min=0)))
        mean = self.token_mean[chain.places[:, 0]]
        found = mean[:, 0].expand_as(own)
        for state in range(1, MOST_STATES):
            found = torch.where(own == state, mean[:, state], found)
        return found

    def frames_of(self, numbers: Tensor, states: Tensor, chain: ChainFeatures) -> Tensor:
        """The inverse of `normalised`, each frame laid on the template by heavy atoms."""
        return self._laid(chain.code.decode(self._tokens(numbers, states, chain)), chain)

    def _tokens(self, numbers: Tensor, states: Tensor, chain: ChainFeatures) -> Tensor:
        return numbers.float() * self.token_scale[chain.places[:, 0]] + self.middle(states, chain)

    @staticmethod
    def _laid(frames: Tensor, chain: ChainFeatures) -> Tensor:
        flat = frames.flatten(0, -3).double().cpu().numpy()
        laid = superpose(flat, chain.template_nm, idx=chain.fitted)
        return torch.from_numpy(laid).float().reshape(frames.shape).to(frames.device)

    def correlation_at(self, times_ps: Tensor, types: Tensor) -> Tensor:
        """Return the correlations `(b, t, r, slots)` with the given frame, linear in log t between the lags kept; none
        at `forgotten_ps`."""
        if not self.config.innovation:
            return self.correlation.new_zeros(*times_ps.shape, len(types), self.correlation.shape[-1])
        lags = self.config.lags_ps.to(times_ps.device).log()
        at = times_ps.float().log().clamp(float(lags[0]), float(lags[-1]))
        right = torch.searchsorted(lags, at).clamp(1, len(lags) - 1)
        share = ((at - lags[right - 1]) / (lags[right] - lags[right - 1]))[..., None, None]
        table = self.correlation[types].transpose(0, 1)  # (lags, r, slots)
        found = (table[right - 1] * (1 - share) + table[right] * share).clamp(0.0, _MOST_CORRELATED)
        return torch.where((times_ps >= self.config.forgotten_ps)[..., None, None], 0.0, found)

    def innovations(self, later: Tensor, known: Tensor, times_ps: Tensor, types: Tensor) -> Tensor:
        """Numbers `(b, t, r, slots)` at `times_ps` (b, t) after `known` (b, r, slots) -> innovations."""
        rho = self.correlation_at(times_ps, types)
        return (later - rho * known[:, None]) / (1.0 - rho.square()).sqrt()

    def from_innovations(self, y: Tensor, known: Tensor, times_ps: Tensor, types: Tensor) -> Tensor:
        """The inverse of `innovations`."""
        rho = self.correlation_at(times_ps, types)
        return rho * known[:, None] + (1.0 - rho.square()).sqrt() * y

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        # At least as many numbers as a frame has coordinates that vary.
        return (self.n_new, n_atoms, 4)

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 10,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Propagator.next_chunk`. Raises InputError for a molecule not told as a chain."""
        chain: ChainFeatures | None = molecule.own
        if chain is None:
            raise InputError("this model knows peptides by residues; make molecules by its `featurise`.")
        types, filled = chain.places[:, 0], chain.code.filled
        known, now = self.normalised(last_frames_nm[:, -1], chain)
        assert self.lag_ps is not None
        ahead = self.lag_ps * torch.arange(1, self.n_new + 1, device=known.device)
        times = ahead.expand(len(known), -1).float()
        drawn = known.new_zeros(*noise.shape[:2], *filled.shape)
        drawn[..., filled] = noise.flatten(2)[..., : int(filled.sum())].to(known)
        counts, apart = chain.stated.counts, times_apart(times, self.config.forgotten_ps)
        shape = (self.n_new, *counts.shape)

        def draw_states(rows: Tensor, attempt: int) -> Tensor:
            seeds = generators(noise[rows], STATES, attempt)
            uniform = torch.stack([torch.rand(shape, generator=g) for g in seeds]).to(known)
            return self.jumps.draw(known[rows], now[rows], chain.places, counts, times[rows], apart[rows], uniform)

        rows = torch.arange(len(known), device=known.device)
        states = draw_states(rows, 0)
        evaluations = 0.0

        def solve(rows: Tensor, drawn: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            """Return frames, and in which rows some disobey their states and some overlap, all that could be done."""
            of_states = conditioning_states(torch.cat([now[rows, None], states[rows]], dim=1), counts)
            conditioning = self.flow.conditioning(known[rows], times[rows], chain.places, of_states)

            def predict(o: Tensor, tau: Tensor) -> Tensor:
                nonlocal evaluations
                evaluations += len(rows) / len(known)
                return torch.where(filled, self.flow(o, tau, conditioning), 0.0)

            y = flow.SOLVERS[solver or self.solvers[0]](predict, drawn, solver_steps, "linear")
            tokens = self._tokens(self.from_innovations(y, known[rows], times[rows], types), states[rows], chain)
            resolved = resolve_settings(tokens.flatten(0, 1), states[rows].flatten(0, 1), chain)
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
