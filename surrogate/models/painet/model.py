"""PAINET and its training: latent steps of energy-descent attention, one per future frame, decoded by one EGNN."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, ClassVar

import networkx as nx
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.data import References, TrainingFrames
from surrogate.models import architecture as arch
from surrogate.models.architecture import ModelConfig
from surrogate.models.propagator import Chunk, Molecule, Propagator
from surrogate.models.weights import provenance_of, save_weights, training_domain
from surrogate.training.loop import ProgressFn, Stage, StageConfig, train_stages
from systems.errors import InputError
from systems.units import GAS_CONSTANT_KJ_MOL_K

# Energy-descent all-pair attention with type matrices, dense and factored (papers/PAINET, "Particle-type Adaptive
# Mapping"). With rho_ij(s) = a_ij s - b_ij s^2 and embeddings of unit length, rho'(|h_i - h_j|^2) = phi_ij + psi_ij
# h_i.h_j, where phi = a - 4 b and psi = 4 b. The attention's mean over all particles with these weights is a descent
# step of the energy sum_ij rho_ij(|h_i - h_j|^2).

# Index lists of each type's atoms: what the factored form sums over.
TypeGroups = list[Tensor]


def type_groups(elements: Tensor) -> TypeGroups:
    return [torch.nonzero(elements == number).flatten() for number in torch.unique(elements)]


def dense_mean(q: Tensor, k: Tensor, v: Tensor, phi: Tensor, psi: Tensor) -> Tensor:
    """Return sum_j w_ij v_j / sum_j w_ij with w_ij = phi_ij + psi_ij q_i.k_j.

    `q`, `k` (..., n, d), `v` (..., n, d_v); `phi`, `psi` (..., n, n) by pair of particles.
    """
    weights = phi + psi * (q @ k.transpose(-1, -2))
    return (weights @ v) / weights.sum(-1, keepdim=True)


def linear_mean(q: Tensor, k: Tensor, v: Tensor, phi: Tensor, psi: Tensor, groups: TypeGroups) -> Tensor:
    """The same mean in time linear in n: weights depend on a pair through its types and one product of vectors, so
    out_i = (sum_b phi_ab s_b + q_i sum_b psi_ab S_b) / (the same with ones), s_b = sum of v, S_b = sum of k v^T over b.

    `phi`, `psi` (..., n_types, n_types) by type; `groups[b]` the atoms of type b, every atom in one of them.
    """
    v = torch.cat([v, torch.ones_like(v[..., :1])], dim=-1)
    sums = torch.stack([v[..., group, :].sum(-2) for group in groups], dim=-2)
    products = torch.stack([k[..., group, :].transpose(-1, -2) @ v[..., group, :] for group in groups], dim=-3)
    plain = phi @ sums
    turned = torch.einsum("...ab,...bde->...ade", psi, products)
    out = v.new_empty(v.shape)
    for a, group in enumerate(groups):
        out[..., group, :] = plain[..., a, None, :] + q[..., group, :] @ turned[..., a, :, :]
    return out[..., :-1] / out[..., -1:]


def check_attention(config: Any, forms: tuple[str, ...]) -> None:
    """Raise InputError for settings of the attention that are none: `attention`, `step` and `psi_limit`."""
    if config.attention not in forms:
        raise InputError(f"attention = {config.attention!r} is unknown; choose {', '.join(forms)}.")
    if not 0.0 < config.step < 1.0 or not 0.0 <= config.psi_limit < 1.0:
        raise InputError(f"step = {config.step:g} and psi_limit = {config.psi_limit:g} must lie between 0 and 1.")


class EnergyAttention(nn.Module):
    """One latent step: h <- (1 - eta) h + eta W concat_heads(mean of values), with learned Q, K, V.

    Queries and keys have unit length. Phi = sigmoid(E_phi) and Psi = psi_limit * Phi * sigmoid(E_psi), symmetric, by
    type and head: Phi >= Psi keeps every weight positive. (A common factor of Phi and Psi, s_1 in the paper, cancels.)
    `config`: of a model, with `width`, `n_heads`, `head_dim`, eta as `step`, and `psi_limit`, the largest Psi / Phi.
    """

    def __init__(self, config: Any, n_types: int) -> None:
        super().__init__()
        self.n_heads, self.step, self.psi_limit = config.n_heads, config.step, config.psi_limit
        self.qkv = nn.Linear(config.width, 3 * config.n_heads * config.head_dim)
        self.out = nn.Linear(config.n_heads * config.head_dim, config.width)
        self.e_phi = nn.Parameter(torch.zeros(config.n_heads, n_types, n_types))
        self.e_psi = nn.Parameter(torch.zeros(config.n_heads, n_types, n_types))

    def type_matrices(self) -> tuple[Tensor, Tensor]:
        """Return Phi and Psi `(n_heads, n_types, n_types)`."""
        phi, psi = (torch.sigmoid(0.5 * _wide(e + e.transpose(-1, -2))) for e in (self.e_phi, self.e_psi))
        return phi, self.psi_limit * phi * psi

    def forward(
        self, h: Tensor, carried: Tensor, types: Tensor, groups: TypeGroups, *, dense: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Embeddings `h` (b, n, width), more values that the attention averages `carried` (b, n, c), types `(n,)` and
        their atoms `groups` -> embeddings, the means `(b, n_heads, n, c)` of what is carried, and the queries `(b,
        n_heads, n, head_dim)`, of unit length."""
        q, k, v = _wide(self.qkv(h)).unflatten(-1, (3, self.n_heads, -1)).permute(2, 0, 3, 1, 4)
        q, k = F.normalize(q, dim=-1), F.normalize(k, dim=-1)
        n_own = v.shape[-1]
        v = torch.cat([v, carried[:, None].expand(-1, self.n_heads, -1, -1)], dim=-1)
        phi, psi = self.type_matrices()
        # Sums over all atoms stay in float32: in bf16 the two forms would differ by more than rounding.
        with torch.autocast(h.device.type, enabled=False):
            if dense:
                mean = dense_mean(q, k, v, phi[:, types][:, :, types], psi[:, types][:, :, types])
            else:
                present = torch.stack([types[group[0]] for group in groups])
                phi, psi = (m[:, present][:, :, present] for m in (phi, psi))
                mean = linear_mean(q, k, v, phi, psi, groups)
        own, means = mean.split((n_own, carried.shape[-1]), dim=-1)
        return (1.0 - self.step) * h + self.step * self.out(own.transpose(1, 2).flatten(-2)), means, q


def _wide(s: Tensor) -> Tensor:
    """`s` in float32, or as it is where that is float64."""
    return s.to(torch.promote_types(s.dtype, torch.float32))


# E(n)-equivariant graph network (Satorras 2021) in EGNO's form: PAINET's decoder and, alone, the baseline.

# Kinds of edges: of the pairs that messages run between.
BOND, SECOND_NEIGHBOUR, NOT_BONDED = 0, 1, 2
N_KINDS = 3


@dataclass(frozen=True, eq=False)
class Graph:
    """Directed edges `receiver`, `sender`, `kind` (n_edges,) of one molecule, sorted by receiver, each pair both ways;
    `degree` (n_atoms,) edges that end in an atom, at least one, so that a mean over none is zero."""

    receiver: Tensor
    sender: Tensor
    kind: Tensor
    degree: Tensor


def bond_paths(molecule: Molecule, longest: int) -> dict[tuple[int, int], int]:
    """Return how many bonds lie between atoms (i, j), i < j, where they are at most `longest`."""
    paths = nx.all_pairs_shortest_path_length(nx.Graph(molecule.bonds.tolist()), cutoff=longest)
    return {(i, j): n for i, ends in paths for j, n in ends.items() if i < j}


def molecular_graph(molecule: Molecule, *, all_pairs: bool = False) -> Graph:
    """Return bonds and pairs two bonds apart (the edges of EGNO, Xu 2024), in time linear in the atoms; with
    `all_pairs` every other pair as well."""
    n_atoms = molecule.n_atoms
    pairs = dict.fromkeys(combinations(range(n_atoms), 2), NOT_BONDED) if all_pairs else {}
    pairs |= {pair: BOND if n == 1 else SECOND_NEIGHBOUR for pair, n in bond_paths(molecule, 2).items()}
    both = sorted([(i, j, k) for (i, j), k in pairs.items()] + [(j, i, k) for (i, j), k in pairs.items()])
    edges = torch.tensor(both, dtype=torch.int64, device=molecule.elements.device).reshape(-1, 3)
    receiver, sender, kind = edges.T.contiguous()
    return Graph(receiver, sender, kind, torch.bincount(receiver, minlength=n_atoms).clamp(min=1))


class EgnnLayer(nn.Module):
    """One round of messages: m_ij = MLP(h_i, h_j, kind_ij, d_ij^2), h_i += MLP(h_i, sum_j m_ij),
    x_i += phi_v(h_i) v_i + mean_j (x_i - x_j) phi_x(m_ij), and the same with own factors for the velocity u_i.

    v is the initial velocity, which stays. `reach` scales what is added to x and to u, so that the factors are of
    order one whatever the horizon; their last layers start small: a fresh layer hardly moves.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        # The message's first layer by parts: what depends on one atom is computed once per atom, not per edge.
        self.receive = nn.Linear(width, width)
        self.send = nn.Linear(width, width, bias=False)
        self.of_distance = nn.Linear(1, width, bias=False)
        self.of_kind = nn.Embedding(N_KINDS, width)
        self.message = nn.Linear(width, width)
        of_pair, of_own = nn.Linear(width, 2, bias=False), nn.Linear(width, 2)
        self.pair_factor = nn.Sequential(nn.Linear(width, width), nn.SiLU(), of_pair)
        self.own_factor = nn.Sequential(nn.Linear(width, width), nn.SiLU(), of_own)
        self.update = nn.Sequential(nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, width))
        for factor in (of_pair, of_own):
            nn.init.xavier_uniform_(factor.weight, gain=0.01)
        nn.init.zeros_(of_own.bias)

    def forward(
        self, h: Tensor, x: Tensor, u: Tensor, v: Tensor, graph: Graph, reach: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """`h` (b, n, width), positions `x`, velocities `u` and `v` (b, n, 3), `reach` (2,) -> h, x, u."""
        difference = x[:, graph.receiver] - x[:, graph.sender]
        squared = difference.square().sum(-1, keepdim=True)
        pre = self.receive(h)[:, graph.receiver] + self.send(h)[:, graph.sender]
        pre = pre + self.of_distance(squared.to(pre.dtype)) + self.of_kind(graph.kind)
        message = F.silu(self.message(F.silu(pre)))
        own = self.own_factor(h).float()
        pair = self.pair_factor(message).float()
        moved = torch.cat([difference * pair[..., :1], difference * pair[..., 1:]], dim=-1)
        moved = gather_sum(moved, graph.receiver, x.shape[1]) / graph.degree[:, None]
        x_new = x + reach[0] * (own[..., :1] * v + moved[..., :3])
        u_new = u + reach[1] * (own[..., 1:] * v + moved[..., 3:])
        gathered = gather_sum(message, graph.receiver, x.shape[1])
        return h + self.update(torch.cat([h, gathered], dim=-1)), x_new, u_new


class Egnn(nn.Module):
    """A stack of layers; all of it is equivariant to rotations, reflections, translations and atom order."""

    def __init__(self, width: int, n_layers: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(EgnnLayer(width) for _ in range(n_layers))

    def forward(self, h: Tensor, x: Tensor, v: Tensor, graph: Graph, reach: Tensor) -> tuple[Tensor, Tensor]:
        """Embeddings `(b, n, width)`, positions and velocities `(b, n, 3)` -> positions, velocities `(b, n, 3)`."""
        u = v
        for layer in self.layers:
            h, x, u = layer(h, x, u, v, graph, reach)
        return x, u


def gather_sum(values: Tensor, receiver: Tensor, n_atoms: int) -> Tensor:
    """Sum edge values `(b, n_edges, d)` over the edges that end in each atom: `(b, n_atoms, d)`."""
    out = values.new_zeros(values.shape[0], n_atoms, values.shape[-1])
    return out.index_add(1, receiver, values)


# The forecaster.

# Atomic numbers up to xenon; 0 is a particle of a model system.
N_TYPES = 55
# Numbers in one layer's messages, of all rows decoded at once. Larger arrays come anew from the system each time: then
# 10,000 atoms cost five times what 3,000 do.
MESSAGE_NUMBERS = 2_000_000


@dataclass(frozen=True)
class PainetConfig(ModelConfig):
    """Size, horizon and physics. `n_new` frames are predicted at once, `frame_stride` reference frames apart.

    `attention` 'linear' (factored over types, cost linear in atoms), 'dense' (the same numbers, quadratic) or 'none'
    (the decoder alone, which is EGNN). `lag_ps` between predicted frames, `temperature_k` and `friction_per_ps` of the
    bath that refreshes velocities between chunks; a training takes the three from its reference.
    """

    n_new: int = 8
    frame_stride: int = 1
    width: int = 64
    n_heads: int = 4
    head_dim: int = 16
    n_decoder_layers: int = 4
    attention: str = "linear"
    # Share of the attention's mean in the next embedding, eta of the descent step.
    step: float = 0.5
    # Largest Psi / Phi: below one, weights stay positive whatever the embeddings.
    psi_limit: float = 0.95
    length_scale_nm: float = 0.1
    lag_ps: float = 0.005
    temperature_k: float = 300.0
    friction_per_ps: float = 1.0

    def __post_init__(self) -> None:
        check_attention(self, ("linear", "dense", "none"))
        for name in ("n_new", "frame_stride", "n_decoder_layers"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)} must be at least 1.")

    @property
    def chunk_ps(self) -> float:
        return self.n_new * self.lag_ps


@dataclass(frozen=True, eq=False)
class Structure:
    """What of a molecule does not change from chunk to chunk: each type's atoms and the decoder's edges."""

    molecule: Molecule
    groups: TypeGroups
    graph: Graph

    def centred(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return `values` (..., n, 3) relative to the centre of mass's, and these (..., 1, 3)."""
        masses = self.molecule.masses_da
        centre = ((masses / masses.sum())[:, None] * values).sum(-2, keepdim=True)
        return values - centre, centre


class Painet(Propagator):
    """X0, V0 -> X(1..T) and V(T), equivariant to rotations, reflections, translations and atom order.

    Embeddings start from invariants of the state: element, speed, distance to the centre of mass and the angle between
    the two. A learned vector per frame says which one is decoded. Velocities are learned in units of
    `velocity_scale_nm_ps`; `reach` (2,) is what positions and velocities change by over a chunk, in the model's units:
    both are measured on the training frames. The centre of mass moves on at its velocity, exactly: only the motion
    about it is learned.
    """

    arch: ClassVar[str] = "painet"
    config: PainetConfig

    def __init__(self, config: PainetConfig) -> None:
        super().__init__()
        self.config = c = config
        self.embed_type = nn.Embedding(N_TYPES, c.width)
        self.embed_state = nn.Sequential(nn.Linear(3, c.width), nn.SiLU(), nn.Linear(c.width, c.width))
        self.embed_frame = nn.Parameter(torch.randn(c.n_new, c.width) * 0.1)
        n_attention = 0 if c.attention == "none" else c.n_new
        self.steps = nn.ModuleList(EnergyAttention(c, N_TYPES) for _ in range(n_attention))
        self.decoder = Egnn(c.width, c.n_decoder_layers)
        self._known: Structure | None = None
        self.velocity_scale_nm_ps = nn.Buffer(torch.ones(()))
        self.reach = nn.Buffer(torch.ones(2))

    @property
    def n_new(self) -> int:
        return self.config.n_new

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (n_atoms, 3)

    def set_scales(self, velocity_nm_ps: float, displacement_nm: float, change_nm_ps: float) -> None:
        """Set the units of what is learned: root mean square velocity, displacement and change of velocity over a
        chunk."""
        self.velocity_scale_nm_ps.fill_(velocity_nm_ps)
        self.reach[0], self.reach[1] = displacement_nm / self.config.length_scale_nm, change_nm_ps / velocity_nm_ps

    def structure(self, molecule: Molecule) -> Structure:
        """Return what `forward` needs of a molecule. Raises InputError for elements beyond xenon."""
        heaviest = int(molecule.elements.max())
        if heaviest >= N_TYPES:
            raise InputError(f"PAINET has types up to atomic number {N_TYPES - 1}; this molecule holds {heaviest}.")
        return Structure(molecule, type_groups(molecule.elements), molecular_graph(molecule))

    def embed(self, x: Tensor, v: Tensor, elements: Tensor) -> Tensor:
        """H(0) `(b, n, width)` from scaled, centred positions and velocities `(b, n, 3)`."""
        speed, radius = ((t.square().sum(-1) + 1e-6).sqrt() for t in (v, x))
        state = torch.stack([speed, radius, (x * v).sum(-1) / (1.0 + radius)], dim=-1)
        return self.embed_type(elements) + self.embed_state(state)

    def forward(self, positions_nm: Tensor, velocities_nm_ps: Tensor, structure: Structure) -> tuple[Tensor, Tensor]:
        """States `(b, n, 3)` -> positions and velocities `(b, n_new, n, 3)` of all future frames, nm and nm/ps."""
        (x, centre), (v, drift) = structure.centred(positions_nm), structure.centred(velocities_nm_ps)
        scale = self.config.length_scale_nm
        x_new, v_new = self.moved(x / scale, v / self.velocity_scale_nm_ps, structure)
        times = self.config.lag_ps * torch.arange(1, self.n_new + 1, device=x.device)
        centres = centre[:, None] + times[:, None, None] * drift[:, None]
        return x_new * scale + centres, v_new * self.velocity_scale_nm_ps + drift[:, None]

    def moved(self, x: Tensor, v: Tensor, structure: Structure) -> tuple[Tensor, Tensor]:
        """The same about the centre of mass, in the model's units."""
        return tuple(structure.centred(s)[0] for s in self.decoded(x, v, structure))  # type: ignore[return-value]

    def decoded(self, x: Tensor, v: Tensor, structure: Structure) -> tuple[Tensor, Tensor]:
        """The decoder's frames `(b, n_new, n, 3)`: so many rows at once as keep its messages in the cache."""
        elements, graph = structure.molecule.elements, structure.graph
        h = self.embed(x, v, elements)
        latents = []
        for t in range(self.n_new):
            if self.steps:
                h = self.steps[t](h, h[..., :0], elements, structure.groups, dense=self.config.attention == "dense")[0]
            latents.append(h + self.embed_frame[t])
        rows = max(1, MESSAGE_NUMBERS // (self.config.width * max(1, len(graph.receiver))))
        x, v = (s[:, None].expand(-1, self.n_new, -1, -1).flatten(0, 1) for s in (x, v))
        parts = zip(torch.stack(latents, dim=1).flatten(0, 1).split(rows), x.split(rows), v.split(rows), strict=True)
        found = [self.decoder(*part, graph, self.reach) for part in parts]
        x_new, v_new = (torch.cat([part[k] for part in found]) for k in range(2))
        return x_new.unflatten(0, (-1, self.n_new)), v_new.unflatten(0, (-1, self.n_new))

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Propagator.next_chunk`: one evaluation from velocities that the bath has refreshed."""
        start = self.refreshed(last_velocities_nm_ps, molecule, noise)
        if self._known is None or self._known.molecule is not molecule:
            self._known = self.structure(molecule)
        x, v = self(last_frames_nm[:, -1], start, self._known)
        return Chunk(x, v[:, -1])

    def refreshed(self, velocities: Tensor | None, molecule: Molecule, noise: Tensor) -> Tensor:
        """The bath acts on velocities `(b, n, 3)` for the time of one chunk (exact Ornstein-Uhlenbeck step); None are
        drawn from the Maxwell-Boltzmann distribution, all from `noise` (b, n, 3)."""
        c = self.config
        thermal = (GAS_CONSTANT_KJ_MOL_K * c.temperature_k / molecule.masses_da).sqrt()[:, None] * noise
        if velocities is None:
            return thermal
        kept = math.exp(-c.friction_per_ps * c.chunk_ps)
        return kept * velocities + math.sqrt(1.0 - kept * kept) * thermal


class EgnnForecaster(Painet):
    """PAINET's decoder alone: every future frame from H(0), messages along observed edges only."""

    arch: ClassVar[str] = "egnn"

    def __init__(self, config: PainetConfig) -> None:
        super().__init__(replace(config, attention="none"))


@dataclass(frozen=True)
class PainetTraining:
    """The optimisation. `noise`: standard deviation of what is added to the state a training window starts from, as a
    share of what positions and velocities change by over a chunk (Sanchez-Gonzalez 2020). `pushforward`: share of
    windows that start where the model itself arrives after one chunk from the reference, with no gradient through that
    chunk (Brandstetter 2022). `velocity_weight`: of the last frame's velocity beside the positions."""

    budget_s: float | None = None
    steps: int | None = None
    batch: int = 32
    learning_rate: float = 2e-3
    noise: float = 0.02
    pushforward: float = 0.3
    velocity_weight: float = 0.5
    seed: int = 0
    bf16: bool = False
    device: str = "cpu"
    validate_every_s: float = 60.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.pushforward <= 1.0:
            raise InputError(f"pushforward is a share of windows, between 0 and 1, not {self.pushforward:g}.")


def for_frames(config: PainetConfig, frames: TrainingFrames) -> PainetConfig:
    """Return the configuration with frame spacing, temperature and friction of the reference."""
    bath = frames.conditions
    return replace(
        config,
        lag_ps=frames.lag_ps * config.frame_stride,
        temperature_k=float(bath.get("temperature_k") or config.temperature_k),
        friction_per_ps=float(bath.get("friction_per_ps") or 0.0),
    )


def train_painet(
    frames: TrainingFrames, out: str | Path, model_config: PainetConfig, config: PainetTraining, *,
    model_class: type[Painet] = Painet, resume: bool = False, progress: ProgressFn | None = None,
) -> Path:  # fmt: skip
    """Train on `frames` and write `out` (.safetensors) with a CSV of the curves beside it. Raises InputError when they
    carry no velocities or are too short, SimulationError when training diverges."""
    out = Path(out)
    if frames.velocities is None:
        raise InputError(f"{model_class.arch} learns from velocities; these frames carry none.")
    model_config = for_frames(model_config, frames)
    torch.manual_seed(config.seed)
    device = torch.device(config.device)
    model = model_class(model_config).to(device)
    structure = model.structure(model.featurise(frames.scene).to(device))
    windows = StateWindows(frames, model_config, device)
    model.set_scales(windows.velocity_scale_nm_ps, windows.position_scale_nm, windows.change_scale_nm_ps)
    stage = StageConfig("forecast", config.batch, config.learning_rate, config.budget_s, config.steps,
                        seed=config.seed, bf16=config.bf16, validate_every_s=config.validate_every_s)  # fmt: skip
    domain = training_domain(frames, stride=model_config.frame_stride)

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        return forecast_loss(model, structure, windows, config, generator)

    @torch.no_grad()
    def validate() -> dict[str, float]:
        return forecast_errors(model, structure, windows)

    def write(spent_s: list[float]) -> None:
        settings = {"seed": config.seed, "noise": config.noise, "pushforward": config.pushforward,
                    "training_s": round(sum(spent_s), 1)}  # fmt: skip
        save_weights(out, model, domain, provenance_of(frames.origin, settings))

    stages = [Stage(model, stage, loss_fn, validate)]
    train_stages(stages, out, write, device=device, resume=resume, progress=progress)
    return out


class StateWindows:
    """States and their futures, cut from frames: two chunks long, so that a pushforward has a reference.
    `position_scale_nm`, `change_scale_nm_ps`: root mean square displacement and change of velocity over a chunk, what
    errors are measured in; `velocity_scale_nm_ps`: root mean square velocity."""

    def __init__(self, frames: TrainingFrames, config: PainetConfig, device: torch.device) -> None:
        assert frames.velocities is not None
        self.frames, self.config, self.device = frames, config, device
        self.velocities = frames.velocities
        self.span = config.n_new * config.frame_stride
        self.starts = frames.window_starts(2 * self.span + 1, validation=False)
        self.held = frames.spread_starts(128, self.span + 1, validation=True)
        sample = frames.spread_starts(512, 2 * self.span + 1)
        (x, v), (x_new, v_new) = self.state(sample), self.future(sample)
        self.position_scale_nm = max(float((x_new - x[:, None]).square().mean().sqrt()), 1e-6)
        self.change_scale_nm_ps = max(float((v_new - v).square().mean().sqrt()), 1e-6)
        self.velocity_scale_nm_ps = max(float(v.square().mean().sqrt()), 1e-6)

    def state(self, first: np.ndarray) -> tuple[Tensor, Tensor]:
        """Positions and velocities `(b, n_atoms, 3)` at frames `first`."""
        x, v = self.frames.positions_nm(first), self.velocities[first]
        return torch.from_numpy(x).to(self.device), torch.from_numpy(v).to(self.device)

    def future(self, first: np.ndarray) -> tuple[Tensor, Tensor]:
        """Positions `(b, n_new, n_atoms, 3)` of the chunk after `first`, velocities `(b, n_atoms, 3)` at its end."""
        idx = first[:, None] + self.config.frame_stride * np.arange(1, self.config.n_new + 1)
        x, v = self.frames.positions_nm(idx), self.velocities[idx[:, -1]]
        return torch.from_numpy(x).to(self.device), torch.from_numpy(v).to(self.device)


def forecast_loss(model: Painet, structure: Structure, windows: StateWindows, config: PainetTraining,
                  generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
    """Mean square error of all predicted frames and of the last velocity, each over its scale squared."""
    picked = torch.randint(len(windows.starts), (config.batch,), generator=generator).numpy()
    first = windows.starts[picked]
    x, v = windows.state(first)
    noise = torch.randn(2, *x.shape, generator=generator).to(x.device)
    pushed = torch.rand(config.batch, generator=generator) < config.pushforward
    x = x + config.noise * windows.position_scale_nm * noise[0]
    v = v + config.noise * windows.change_scale_nm_ps * noise[1]
    if bool(pushed.any()):
        with torch.no_grad():
            x_far, v_far = model(x[pushed], v[pushed], structure)
        x[pushed], v[pushed] = x_far[:, -1], v_far[:, -1]
        first = np.where(pushed.numpy(), first + windows.span, first)
    x_true, v_true = windows.future(first)
    x_new, v_new = model(x, v, structure)
    position = (x_new - x_true).square().mean() / windows.position_scale_nm**2
    velocity = (v_new[:, -1] - v_true).square().mean() / windows.change_scale_nm_ps**2
    loss = position + config.velocity_weight * velocity
    return loss, {"position": position.detach(), "velocity": velocity.detach()}


def forecast_errors(model: Painet, structure: Structure, windows: StateWindows) -> dict[str, float]:
    """Errors on held-out windows: A-MSE over all predicted frames and F-MSE of the last, per coordinate in Å^2, beside
    the frozen frame's A-MSE, and the last velocity's root mean square error in nm/ps."""
    (x, v), (x_true, v_true) = windows.state(windows.held), windows.future(windows.held)
    x_new, v_new = model(x, v, structure)
    error = 100.0 * (x_new - x_true).square()
    return {
        "validation_a_mse_a2": float(error.mean()),
        "validation_f_mse_a2": float(error[:, -1].mean()),
        "frozen_a_mse_a2": float(100.0 * (x[:, None] - x_true).square().mean()),
        "validation_velocity_nm_ps": float((v_new[:, -1] - v_true).square().mean().sqrt()),
    }


class PainetTrainer(arch.Trainer):
    """Trains PAINET, or its decoder alone, as `model_class` says."""

    def __init__(self, model_class: type[Painet]) -> None:
        self.model_class = model_class

    def settings(self, request: arch.TrainingRequest) -> arch.Settings:
        """See `Trainer.settings`. Frame spacing and bath are the reference's (`for_frames`)."""
        resolved = arch.RESOLVED | {"lag_ps", "temperature_k", "friction_per_ps"}
        return arch.Settings(PainetConfig.from_dict(request.model), request.settings(PainetTraining), resolved)

    def prepare(self, references: References, request: arch.TrainingRequest) -> arch.Prepared:
        """See `Trainer.prepare`. Raises InputError for references without velocities."""
        settings = self.settings(request)
        frames = references.frames(canonical=False, velocities=True)
        span = settings.model.n_new * settings.model.frame_stride
        frames.window_starts(2 * span + 1, validation=False)
        frames.window_starts(span + 1, validation=True)

        def run(advance: arch.AdvanceFn) -> Path:
            return train_painet(
                frames, request.out, settings.model, settings.training, model_class=self.model_class,
                resume=request.resume, progress=lambda stage, share, metrics: advance(stage, share),
            )  # fmt: skip

        return arch.Prepared(frames.scene.name, run)


PAINET = arch.Architecture("painet", PainetConfig.from_dict, Painet, partial(PainetTrainer, Painet))
EGNN = arch.Architecture("egnn", PainetConfig.from_dict, EgnnForecaster, partial(PainetTrainer, EgnnForecaster))
