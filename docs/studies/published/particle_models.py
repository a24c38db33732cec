"""Forecasters of small particle systems: an EGNN that jumps, and learned pair forces that are integrated.

Both are equivariant to rotations, reflections, translations and particle order. Every system of a batch has its own
types and pairs, so they stand beside the contract of `surrogate.models.propagator`, which knows one molecule a call.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from surrogate.models.painet.model import NOT_BONDED, Egnn, Graph

# Kinds of pairs that pair forces know.
N_PAIR_KINDS = 2
# The distance below which a pair's features stop changing, nm.
_NEAR_NM = 0.01


@dataclass(frozen=True)
class EgnnJumpConfig:
    """`n_types` of particles. `from_velocity` adds the last frame moved on at its velocity, so that only the change is
    learned; without it the network starts from the last frame, as Satorras (2021) does."""

    n_types: int = 3
    width: int = 64
    n_layers: int = 4
    n_new: int = 20
    lag_ps: float = 0.1
    from_velocity: bool = True


class EgnnJump(nn.Module):
    """EGNN (Satorras 2021) from the last given state to any one of the frames to come, which it is told."""

    reach: Tensor

    def __init__(self, config: EgnnJumpConfig) -> None:
        super().__init__()
        self.config = c = config
        self.embed_type = nn.Embedding(c.n_types, c.width)
        self.embed_pairs = nn.Linear(1, c.width)
        self.embed_speed = nn.Linear(1, c.width)
        self.embed_frame = nn.Embedding(c.n_new, c.width)
        self.network = Egnn(c.width, c.n_layers)
        self.register_buffer("reach", torch.ones(c.n_new))

    def forward(self, x: Tensor, v: Tensor, types: Tensor, pairs: Tensor, frame: int) -> Tensor:
        """State `x`, `v` (b, n, 3), `types` (b, n), `pairs` (b, n, n) -> positions `(b, n, 3)` of frame 0, 1, ..."""
        time_ps = self.config.lag_ps * (frame + 1)
        degree = pairs.sum(-1, keepdim=True).float()
        speed = v.square().sum(-1, keepdim=True).add(1e-8).sqrt()
        h = self.embed_type(types) + self.embed_pairs(degree) + self.embed_speed(speed)
        h = h + self.embed_frame.weight[frame]
        scale = torch.stack([self.reach[frame], torch.ones_like(self.reach[frame])])
        moved, _ = self.network(h, x, time_ps * v, all_pairs(x.shape[-2], pairs), scale)
        return moved + time_ps * v if self.config.from_velocity else moved

    def all_frames(self, x: Tensor, v: Tensor, types: Tensor, pairs: Tensor) -> Tensor:
        """The same for all frames: `(b, n_new, n, 3)`."""
        return torch.stack([self(x, v, types, pairs, frame) for frame in range(self.config.n_new)], dim=1)


def all_pairs(n: int, pairs: Tensor) -> Graph:
    """Every ordered pair of n particles as edges, with the kind `(b, n_edges)` of each system's own `pairs`: 0 none in
    particular, 1 related (a spring, like charges, second neighbours), 2 a bond."""
    index = torch.arange(n, device=pairs.device)
    edges = torch.cartesian_prod(index, index)
    edges = edges[edges[:, 0] != edges[:, 1]]
    receiver, sender = edges.unbind(1)
    degree = torch.full((n,), max(1, n - 1), device=pairs.device)
    return Graph(receiver, sender, NOT_BONDED - pairs[:, receiver, sender], degree)


@dataclass(frozen=True)
class PairForcesConfig:
    """`substeps` of the integrator between two frames: coarse ones for the first part of a training, whose losses they
    keep smooth; finer ones for the second part and for finding velocities, which resolve close encounters; what is
    learned is a force, so forecasts may be finer still. `velocity_frames`: given frames that the last one's velocity is
    found from."""

    width: int = 32
    lag_ps: float = 0.1
    training_substeps: int = 4
    fine_substeps: int = 16
    velocity_frames: int = 6
    forecast_substeps: int = 50


class PairForces(nn.Module):
    """A central force between each pair, a learned function of its distance and kind, integrated by velocity Verlet.

    F_ij = (x_i - x_j) / r * sum_p w_p(log r, kind) r^p with p = 1, 0, -1, -2: a network of the distance, given a few
    powers to weigh because forces reach over four decades. Forces are equal and opposite, so momentum is kept exactly.
    This goes beyond LaM-SLidE: it is a simulator of unit masses, not a forecast of all frames at once.
    """

    POWERS = (1.0, 0.0, -1.0, -2.0)

    def __init__(self, config: PairForcesConfig) -> None:
        super().__init__()
        self.config = c = config
        self.constant = nn.Parameter(torch.zeros(N_PAIR_KINDS, len(self.POWERS)))
        self.hidden = nn.Linear(1 + N_PAIR_KINDS, c.width)
        self.hidden_2 = nn.Linear(c.width, c.width)
        self.out = nn.Linear(c.width, len(self.POWERS))
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forces(self, x: Tensor, pairs: Tensor) -> Tensor:
        """Positions `(b, n, 3)`, kinds `(b, n, n)` -> forces `(b, n, 3)`; each pair is computed once."""
        n = x.shape[-2]
        i, j = torch.triu_indices(n, n, 1, device=x.device)
        difference = x[:, i] - x[:, j]
        r = difference.square().sum(-1).add(_NEAR_NM**2).sqrt()
        kind = pairs[:, i, j]
        one_hot = nn.functional.one_hot(kind, N_PAIR_KINDS).to(x.dtype)
        features = torch.cat([r.log()[..., None], one_hot], dim=-1)
        hidden = nn.functional.silu(self.hidden_2(nn.functional.silu(self.hidden(features))))
        weights = self.out(hidden) + self.constant[kind]
        powers = torch.stack([r**p for p in self.POWERS], dim=-1)
        pulled = difference * ((weights * powers).sum(-1) / r)[..., None]
        return torch.zeros_like(x).index_add(1, i, pulled).index_add(1, j, -pulled)

    def step(self, x: Tensor, v: Tensor, pairs: Tensor, substeps: int) -> tuple[Tensor, Tensor]:
        """Move a state on by one frame."""
        dt = self.config.lag_ps / substeps
        force = self.forces(x, pairs)
        for _ in range(substeps):
            v = v + 0.5 * dt * force
            x = x + dt * v
            force = self.forces(x, pairs)
            v = v + 0.5 * dt * force
        return x, v

    def last_velocity(self, frames: Tensor, pairs: Tensor) -> Tensor:
        """Return the velocity at the last of two or more frames `(b, n_frames, n, 3)`: that of the motion which joins
        them, found by shooting from each to the next.

        Where a close pair turns between two frames several motions join them: of that which starts along a straight
        line and that which starts as the one before arrived, each system takes the one that goes on more smoothly.
        """
        velocity = None
        for before, last in pairwise(frames.unbind(1)):
            straight = (last - before) / self.config.lag_ps
            departure, found, missed = self._shoot(before, last, straight, pairs)
            if velocity is not None:
                going_on, other, other_missed = self._shoot(before, last, velocity, pairs)
                scores = [
                    miss / self.config.lag_ps + (start - velocity).square().sum((-1, -2)).sqrt()
                    for start, miss in ((departure, missed), (going_on, other_missed))
                ]
                found = torch.where((scores[1] < scores[0])[:, None, None], other, found)
            velocity = found
        if velocity is None:
            raise ValueError("a velocity takes two frames")
        return velocity

    def _shoot(
        self, before: Tensor, last: Tensor, start: Tensor, pairs: Tensor, rounds: int = 5
    ) -> tuple[Tensor, Tensor, Tensor]:
        """From velocities `start` at `before`: velocities there and at `last` of a motion that joins the two, and the
        distance by which it misses, `(b,)`."""
        lag, n_substeps = self.config.lag_ps, self.config.fine_substeps
        missed = torch.full(last.shape[:1], float("inf"), dtype=last.dtype, device=last.device)
        departure = arrival = start
        for _ in range(rounds):
            x, v = self.step(before, start, pairs, n_substeps)
            # Past a close encounter the iteration may leave again: each system keeps its best round.
            error = (last - x).square().sum((-1, -2)).sqrt().nan_to_num(float("inf"))
            better = error < missed
            missed = torch.where(better, error, missed)
            departure = torch.where(better[:, None, None], start, departure)
            arrival = torch.where(better[:, None, None], v, arrival)
            start = torch.where(error.isfinite()[:, None, None], start + (last - x) / lag, departure)
        return departure, arrival, missed

    def forecast(self, given: Tensor, pairs: Tensor, n_new: int) -> Tensor:
        """Frames `(b, n_given, n, 3)`, positions alone -> the next n_new, `(b, n_new, n, 3)`; in the dtype of the
        parameters (float64 keeps what the frames say of velocities)."""
        x, frames = given[:, -1], []
        v = self.last_velocity(given[:, -self.config.velocity_frames :], pairs)
        for _ in range(n_new):
            x, v = self.step(x, v, pairs, self.config.forecast_substeps)
            frames.append(x)
        return torch.stack(frames, dim=1)
