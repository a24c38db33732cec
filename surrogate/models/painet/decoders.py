"""Decoders of PAINET's latents: EGNN, leapfrog steps, modes of the whole molecule, and its free rotation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.painet.attention import Pairs, Surroundings
from surrogate.models.propagator import Molecule

# Edges of the observed structure: bonds and second neighbours, both ways, as index arrays.

# Kinds of edges: what a message is told of the pair it runs between.
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


def molecular_graph(molecule: Molecule, *, all_pairs: bool = False) -> Graph:
    """Return bonds and pairs two bonds apart (the edges of EGNO, Xu 2024), in time linear in the atoms; with
    `all_pairs` every other pair as well, for systems without bonds."""
    n_atoms, device = molecule.n_atoms, molecule.elements.device
    bonds = torch.cat([molecule.bonds, molecule.bonds.flip(1)])
    bonds = bonds[bonds[:, 0].argsort(stable=True)]
    second = bonds.new_zeros((0, 2))
    if len(bonds):
        n_bonds = torch.bincount(bonds[:, 0], minlength=n_atoms)
        first = torch.cumsum(n_bonds, 0) - n_bonds
        # Every bond (i, j) is followed by each bond (j, k).
        reach = n_bonds[bonds[:, 1]]
        start = torch.repeat_interleave(bonds[:, 0], reach)
        step = torch.arange(int(reach.sum()), device=device) - torch.repeat_interleave(reach.cumsum(0) - reach, reach)
        end = bonds[torch.repeat_interleave(first[bonds[:, 1]], reach) + step, 1]
        second = torch.stack([start, end], 1)[start != end]
    pairs = [bonds, second]
    if all_pairs:
        index = torch.arange(n_atoms, device=device)
        full = torch.cartesian_prod(index, index)
        pairs.append(full[full[:, 0] != full[:, 1]])
    kinds = torch.cat([torch.full((len(p),), kind, device=device) for kind, p in enumerate(pairs)])
    keys = torch.cat([p[:, 0] * n_atoms + p[:, 1] for p in pairs])
    # A pair of several kinds counts as the closest: a three-membered ring's bonds are bonds.
    unique, place = torch.unique(keys, return_inverse=True)
    kind = torch.full((len(unique),), N_KINDS, device=device).scatter_reduce(0, place, kinds, "amin")
    receiver, sender = unique // n_atoms, unique % n_atoms
    degree = torch.bincount(receiver, minlength=n_atoms).clamp(min=1)
    return Graph(receiver, sender, kind, degree)


# E(n)-equivariant graph network (Satorras 2021) in EGNO's form: PAINET's decoder and, alone, the baseline.


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


# A decoder whose layers are steps of a leapfrog integrator: EGNN's update of velocities, with Newton's third law.
# EGNN's layer in its form with velocities (Satorras 2021, eq. 7) is a kick by forces along pairs of atoms and a drift.
# Here the kick acts on both atoms of a pair alike and is divided by their masses, and the drift lasts a layer's share
# of the time to the frame that is decoded, half of it before the first kick and half after the last. Whatever is
# learned, momentum and angular momentum are kept, and before anything is learned atoms fly on at their velocities.

# Distances (in the model's unit, 0.1 nm) over which a shell's radial functions are laid, evenly in the logarithm.
SHELL_RANGES = ((0.8, 2.3), (1.3, 3.5), (1.8, 5.0), (1.5, 12.0))
# Half the width of a radial function in units of their spacing.
HALF_WIDTH = 2.5
# Scale of a pair's own force: of order one for bonds where the network's numbers are.
TABLE_SCALE = 5.0
_CLOSEST_SQUARED = 1e-6


class RadialFunctions(torch.autograd.Function):
    """Bumps (1 - (u - k)^2 / HALF_WIDTH^2)^3 for k = 0, 1, ..., zero outside, where u = (log d - start) / spacing.

    Without exponentials, whose tails would be denormal numbers; the derivative is kept, not the way to it.
    """

    @staticmethod
    def forward(ctx: Any, d: Tensor, start: Tensor, spacing: Tensor, n: int) -> Tensor:
        u = ((d.log() - start[:, None]) / spacing[:, None])[..., None] - torch.arange(n, dtype=d.dtype, device=d.device)
        bump = torch.relu(1.0 - u.square() / HALF_WIDTH**2)
        squared = bump.square()
        ctx.save_for_backward(u * squared * (-6.0 / HALF_WIDTH**2) / (d * spacing[:, None])[..., None])
        return squared * bump

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (slope,) = ctx.saved_tensors
        return (grads[0] * slope).sum(-1), None, None, None


@dataclass(frozen=True, eq=False)
class PairFeatures:
    """What does not depend on positions: `first`, `second` (n_pairs, width), a pair seen from either end; `pair`
    (n_pairs, n_new, width) for each frame; where the radial functions of each pair start and how wide they stand."""

    first: Tensor
    second: Tensor
    pair: Tensor
    start: Tensor
    spacing: Tensor


class PairEncoder(nn.Module):
    """Features of pairs from types of atoms, told from their surroundings by rounds along bonds."""

    def __init__(self, width: int, n_radial: int) -> None:
        super().__init__()
        self.rounds = Surroundings(width)
        self.of_shell = nn.Embedding(len(SHELL_RANGES), width)
        self.of_pair = nn.Sequential(nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, width))
        ranges = torch.tensor(SHELL_RANGES).log()
        self.register_buffer("start", ranges[:, 0], persistent=False)
        self.register_buffer("spacing", (ranges[:, 1] - ranges[:, 0]) / (n_radial - 1), persistent=False)
        self.start: Tensor
        self.spacing: Tensor

    def forward(self, z: Tensor, of_frame: Tensor, pairs: Pairs) -> PairFeatures:
        """`z` (n_atoms, width), `of_frame` (n_new, width)."""
        shell = self.of_shell(pairs.shell)
        first, second = z[pairs.first], z[pairs.second]
        first, second = (self.of_pair(torch.cat([a + shell, b], dim=-1)) for a, b in ((first, second), (second, first)))
        both = F.silu((first + second)[:, None] + of_frame)
        return PairFeatures(F.silu(first), F.silu(second), both, self.start[pairs.shell], self.spacing[pairs.shell])


class LeapfrogLayer(nn.Module):
    """Forces along pairs, f_ij = table_ij(d_ij) + c_ij.q_i + c_ji.q_j, from positions alone.

    What an atom feels of others, q_i, comes from sums over its near neighbours, m_ij = w_ij(d_ij) (1 + P h_j), and from
    products of sums of directions, V_i = sum_j w'_ij(d_ij) (x_i - x_j) / d_ij, which hold the angles at i. Weights of
    the radial functions belong to the pair: c, w, w' and the table are linear in its features.
    """

    def __init__(self, width: int, n_radial: int, n_scalars: int, n_vectors: int) -> None:
        super().__init__()
        self.n_radial, self.n_scalars, self.n_vectors = n_radial, n_scalars, n_vectors
        self.of_neighbour = nn.Linear(width, n_radial * (n_scalars + n_vectors))
        self.send = nn.Linear(width, n_scalars)
        self.update = nn.Sequential(
            nn.Linear(width + n_scalars + n_vectors**2, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )
        self.to_force, self.to_embedding = nn.Linear(width, 2 * n_scalars), nn.Linear(width, width)
        self.of_end = nn.Linear(width, 2 * n_scalars)
        self.table = nn.Linear(width, n_radial)
        nn.init.zeros_(self.table.weight)
        nn.init.zeros_(self.table.bias)
        nn.init.zeros_(self.to_force.weight)
        nn.init.zeros_(self.to_force.bias)

    def forward(self, h: Tensor, x: Tensor, pairs: Pairs, of: PairFeatures) -> tuple[Tensor, Tensor]:
        """`h` (n, rows, width) and positions (n, rows, 3), rows frame by frame -> h, forces (n, rows, 3)."""
        (n, rows, _), near = x.shape, slice(pairs.n_near)
        n_frames = of.pair.shape[1]
        apart = pairs.differences(x)
        distance = (apart.square().sum(-1) + _CLOSEST_SQUARED).sqrt()
        radial = RadialFunctions.apply(distance, of.start, of.spacing, self.n_radial)
        n_scalars, n_weights = self.n_scalars, self.n_scalars + self.n_vectors
        ends = [self.of_neighbour(f[near]).unflatten(-1, (self.n_radial, n_weights)) for f in (of.first, of.second)]
        weights = torch.bmm(radial[near], torch.cat(ends, dim=-1))
        of_first, of_second = weights[..., :n_weights], weights[..., n_weights:]
        sent = 1.0 + self.send(h)
        felt = pairs.end_sums(
            of_first[..., :n_scalars] * sent[pairs.second[near]],
            of_second[..., :n_scalars] * sent[pairs.first[near]],
            n,
        )
        direction = (apart[near] / distance[near, :, None])[..., None]
        vectors = pairs.end_sums(
            (direction * of_first[..., None, n_scalars:]).flatten(-2),
            (-direction * of_second[..., None, n_scalars:]).flatten(-2),
            n,
        ).unflatten(-1, (3, -1))
        angles = (vectors.transpose(-1, -2) @ vectors).flatten(-2)
        found = self.update(torch.cat([h, felt, angles], dim=-1))
        q = self.to_force(found)
        table = TABLE_SCALE * self.table(of.pair)
        framed = radial.unflatten(1, (n_frames, rows // n_frames)).flatten(0, 1)
        force = torch.bmm(framed, table.flatten(0, 1)[..., None]).view(len(radial), rows)
        from_first, from_second = (self.of_end(f[near])[..., None] for f in (of.first, of.second))
        coupled = torch.bmm(q[pairs.first[near]], from_first) + torch.bmm(q[pairs.second[near]], from_second)
        force = torch.cat([force[near] + coupled[..., 0], force[pairs.n_near :]])
        return h + self.to_embedding(found), pairs.opposed_sums(force[..., None] * apart, n)


class Leapfrog(nn.Module):
    """A stack of layers, each a kick; equivariant to rotations, reflections, translations and atom order."""

    def __init__(self, width: int, n_layers: int, n_radial: int, n_scalars: int, n_vectors: int) -> None:
        super().__init__()
        self.encode = PairEncoder(width, n_radial)
        self.layers = nn.ModuleList(LeapfrogLayer(width, n_radial, n_scalars, n_vectors) for _ in range(n_layers))

    def forward(
        self, h: Tensor, x: Tensor, v: Tensor, times: Tensor, kick: Tensor, pairs: Pairs, of: PairFeatures
    ) -> tuple[Tensor, Tensor]:
        """`h` (n, rows, width), `x`, `v` (n, rows, 3), rows frame by frame; `times` (rows, 1) to each row's frame in
        units in which x changes by v times that, `kick` (n, rows, 1) what a force changes v by in a layer -> x, v."""
        drift = times / len(self.layers)
        x = x + 0.5 * drift * v
        for number, layer in enumerate(self.layers):
            h, force = layer(h, x, pairs, of)
            v = v + kick * force
            x = x + (drift if number + 1 < len(self.layers) else 0.5 * drift) * v
        return x, v


# Modes of motion that reach over the whole molecule, learned in its own frame: ours, beside PAINET's attention.
# To first order in its excursions a molecule's future is linear in its state, x(t) = <x> + A(t) (x - <x>) + B(t) v,
# with all pairs of atoms in A and B: normal modes. Attention between scalar embeddings cannot carry vectors, and EGNN's
# messages carry no neighbour's velocity. Here every atom has a row in each mode, told from its surroundings and its
# place in the template; amplitudes are sums over atoms, and what they do to each later frame is one number per mode and
# frame, the cosine and sine of a normal mode if that were all there is. The cost is linear in atoms. Superposing the
# molecule on its template makes it exactly equivariant to rotations and translations; reflections are told apart. Where
# groups turn freely (a methyl on a ring) a linear map in one frame does not help.

# Root mean square excursion from the template, in the model's unit (0.1 nm).
EXCURSION = 0.2
# Share of the shorter of a template's two long axes in the longer below which atoms lie in a line: no frame is theirs.
NARROWEST = 1e-3
OUTPUT_SCALE = 0.25


def centred_template(template_nm: Tensor, masses_da: Tensor, length_scale_nm: float) -> Tensor | None:
    """Return the template about its centre of mass in the model's unit, None where its atoms lie in a line."""
    share = (masses_da / masses_da.sum())[:, None]
    centred = (template_nm - (share * template_nm).sum(0)) / length_scale_nm
    along = torch.linalg.svdvals((share.sqrt() * centred).double())
    if len(centred) < 3 or along[1] <= NARROWEST * along[0]:
        return None
    return centred


def superposing_turns(x: Tensor, template: Tensor, masses_da: Tensor) -> Tensor:
    """Return rotations `(b, 3, 3)` for which x @ turn lies best on the template (Kabsch 1976), both centred."""
    share = masses_da / masses_da.sum()
    u, _, vt = torch.linalg.svd(torch.einsum("n,bni,nj->bij", share, x, template).double())
    hand = torch.sign(torch.linalg.det(u @ vt))
    u = torch.cat([u[:, :, :2], u[:, :, 2:] * hand[:, None, None]], dim=-1)
    return (u @ vt).to(x.dtype)


class Modes(nn.Module):
    """Changes of positions and velocities over `n_new` frames, in units of what they change by over a chunk."""

    def __init__(self, width: int, n_modes: int, n_new: int) -> None:
        super().__init__()
        self.n_modes, self.n_new = n_modes, n_new
        self.of_place = nn.Sequential(nn.Linear(3, 64), nn.SiLU(), nn.Linear(64, width))
        self.mix = nn.Sequential(nn.Linear(width, width), nn.SiLU())
        # Rows of an atom in the modes: of its excursion, of its velocity, and of what they do to it.
        self.into, self.out_of = nn.Linear(width, 6 * n_modes), nn.Linear(width, 3 * n_modes)
        # What excursions and velocities (third axis) do to positions and velocities (second axis).
        self.over_time = nn.Parameter(0.1 * torch.randn(n_new, 2, 2, n_modes))
        self.mean = nn.Linear(width, 3 * n_new)
        nn.init.zeros_(self.mean.weight)
        nn.init.zeros_(self.mean.bias)

    def forward(self, z: Tensor, x: Tensor, v: Tensor, template: Tensor, masses_da: Tensor) -> tuple[Tensor, Tensor]:
        """Types `(n, width)`, centred states `(b, n, 3)`, the template `(n, 3)` -> two of `(b, n_new, n, 3)`."""
        turn = superposing_turns(x, template, masses_da)
        z = self.mix(z + self.of_place(template / EXCURSION))
        state = torch.stack([(x @ turn - template) / EXCURSION, v @ turn], dim=-2)
        into = self.into(z).unflatten(-1, (2, 3, self.n_modes)) / len(z) ** 0.5
        out_of = OUTPUT_SCALE * self.out_of(z).unflatten(-1, (3, self.n_modes))
        amplitudes = torch.einsum("bnwi,nwid->bwd", state, into)
        later = torch.einsum("bwd,tswd->btsd", amplitudes, self.over_time)
        moved = torch.einsum("btsd,nid->btsni", later, out_of)
        mean = self.mean(z).unflatten(-1, (self.n_new, 3)).transpose(0, 1)
        back = turn.transpose(-1, -2)[:, None]
        return (moved[:, :, 0] + mean) @ back, moved[:, :, 1] @ back


# The rotation of a molecule as a whole, taken out before anything is learned and put back: that of a free rigid body.
# Like the centre of mass, which moves on at its velocity: within a chunk the molecule turns on at its angular velocity,
# and only the motion in the turning frame is learned.

# Added to the moments of inertia, as a share of their sum: a line of atoms has none about itself.
_LEAST_INERTIA = 1e-5


def angular_velocity(x: Tensor, v: Tensor, masses_da: Tensor) -> Tensor:
    """Return omega `(b, 3)` of centred positions and velocities `(b, n, 3)`: that of a rigid body of their angular
    momentum."""
    m = (masses_da / masses_da.sum())[:, None]
    moments = torch.einsum("bni,bnj->bij", m * x, x)
    trace = moments.diagonal(dim1=-1, dim2=-2).sum(-1)[:, None, None]
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    inertia = ((1.0 + _LEAST_INERTIA) * trace + 1e-9) * eye - moments
    solved: Tensor = torch.linalg.solve(inertia, (m * torch.linalg.cross(x, v)).sum(-2))
    return solved


def spun(omega: Tensor, x: Tensor) -> Tensor:
    """Return omega x x for omega `(b, 3)` and x `(b, ..., 3)`."""
    return torch.linalg.cross(omega.view(-1, *[1] * (x.dim() - 2), 3).expand_as(x), x)


def turns(omega: Tensor, times: Tensor) -> Tensor:
    """Return exp([omega] t) transposed, `(b, len(times), 3, 3)`: x @ it is x after turning on for each time."""
    zero = torch.zeros_like(omega[:, 0])
    a, b, c = omega.unbind(-1)
    generator = torch.stack([zero, c, -b, -c, zero, a, b, -a, zero], dim=-1).view(-1, 1, 3, 3)
    turned: Tensor = torch.matrix_exp(generator * times[:, None, None])
    return turned
