"""The network of PAINET as a potential: a scalar energy, invariant and smooth.

Embeddings start from types of atoms in their bonded surroundings. Each latent step looks at an atom's neighbourhood
(sums of functions of distance and direction, and the invariants of these), then takes a step of the paper's descent
(`EnergyAttention`), in which positions are carried along: their mean under positive weights that depend on embeddings
and types is a vector that knows the whole molecule, at a cost linear in its atoms. The energy is read from the last
embeddings, from a table of pair energies, and from the latent energy that attention descends (the paper's E(H)).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.painet.model import EnergyAttention, TypeGroups, bond_paths, check_attention, type_groups
from surrogate.models.potential import IntegratorConfig
from surrogate.models.propagator import Molecule
from systems.errors import InputError

SIZES = ("width", "n_steps", "n_radial", "n_scalars", "n_vectors", "n_tensors", "n_heads", "head_dim", "n_members")


@dataclass(frozen=True)
class PotentialConfig(IntegratorConfig):
    """Size of the network, beside the settings of the MD on it.

    `n_steps` latent steps, each a look at the neighbourhood and energy-descent attention over all atoms. An atom sees
    its neighbours by `n_scalars`, `n_vectors` and `n_tensors` sums of products of `n_radial` functions of the distance.
    `n_members`: read-outs that learn from different samples; their mean is the potential, their spread says where it is
    unsure. `attention`: 'linear' (factored over types), 'dense' (the same numbers) or 'auto'."""

    width: int = 64
    n_steps: int = 2
    n_radial: int = 12
    n_scalars: int = 16
    n_vectors: int = 8
    n_tensors: int = 4
    n_heads: int = 4
    head_dim: int = 8
    n_members: int = 4
    cutoff_nm: float = 0.6
    attention: str = "auto"
    # Share of the attention's mean in the next embedding, eta of the descent step.
    step: float = 0.5
    # Largest Psi / Phi: below one, weights stay positive whatever the embeddings.
    psi_limit: float = 0.95

    def __post_init__(self) -> None:
        super().__post_init__()
        check_attention(self, ("auto", "linear", "dense"))
        for name in SIZES:
            if getattr(self, name) < (least := 2 if name == "n_radial" else 1):
                raise InputError(f"{name} = {getattr(self, name)} must be at least {least}.")


# Ordered pairs of atoms, and the smooth functions of their distance that a potential sees. Pairs up to three bonds
# apart count always, others inside a cutoff, at which all they add has come to zero with its first two derivatives.

# Shells: one, two and three bonds apart, and all that lie further.
N_SHELLS = 4
# Distances in nm over which a shell's radial functions are laid, evenly in the logarithm; the last shell ends at the
# cutoff.
SHELL_RANGES_NM = ((0.07, 0.23), (0.12, 0.35), (0.16, 0.5))
LAST_SHELL_FROM_NM = 0.12
# Half the width of a radial function in units of their spacing.
HALF_WIDTH = 2.5
# Up to so many atoms all pairs are listed once and for all: those beyond the cutoff add exactly nothing.
FEW_ATOMS = 64
_SOFTENING_NM2 = 1e-8
_FAR_NM2 = 1e6
_ROOT_TWO = 2.0**0.5


@dataclass(frozen=True, eq=False)
class Edges:
    """`receiver`, `sender`, `shell` (n_edges,): each pair from either end, sorted by the receiver. `dense`: every atom
    is paired with every one in turn, itself included, so that sums and differences need no lists."""

    receiver: Tensor
    sender: Tensor
    shell: Tensor
    n_atoms: int
    dense: bool

    def sent(self, values: Tensor) -> Tensor:
        """`values` of atoms (n_atoms, ...) -> of each edge's sender (n_edges, ...)."""
        if not self.dense:
            return values[self.sender]
        return values.expand(self.n_atoms, *values.shape).flatten(0, 1)

    def apart_nm(self, positions_nm: Tensor) -> Tensor:
        """Positions `(n_atoms, rows, 3)` nm -> the way from sender to receiver `(n_edges, rows, 3)`."""
        if self.dense:
            return (positions_nm[:, None] - positions_nm[None]).flatten(0, 1)
        return positions_nm[self.receiver] - positions_nm[self.sender]

    def sum(self, values: Tensor) -> Tensor:
        """`values` (n_edges, ...) summed by receiver: (n_atoms, ...)."""
        if self.dense:
            return values.unflatten(0, (self.n_atoms, self.n_atoms)).sum(1)
        return values.new_zeros(self.n_atoms, *values.shape[1:]).index_add(0, self.receiver, values)

    def by_atom(self, shapes: Tensor) -> Tensor:
        """`shapes` (n_edges, rows, k), laid out as `sum_of_products` takes them."""
        if not self.dense:
            return shapes
        return shapes.unflatten(0, (self.n_atoms, self.n_atoms)).permute(0, 2, 3, 1).contiguous()

    def sum_of_products(self, laid: Tensor, values: Tensor) -> Tensor:
        """Shapes laid `by_atom` times `values` (n_edges, rows, c), summed by receiver: (n_atoms, rows, k, c)."""
        if not self.dense:
            return self.sum(laid[..., None] * values[..., None, :])
        return laid @ values.unflatten(0, (self.n_atoms, self.n_atoms)).transpose(1, 2)


class EdgeGeometry(NamedTuple):
    """`distance_nm` (n_edges, rows) and `radial` (n_edges, rows, n_radial); `shapes`: the direction from sender to
    receiver and its products (`products`), laid out by `Edges.by_atom`."""

    distance_nm: Tensor
    radial: Tensor
    shapes: Tensor


def bonded_shells(molecule: Molecule) -> dict[tuple[int, int], int]:
    """Return how many bonds less one lie between atoms (i, j), i < j, up to three."""
    return {pair: n - 1 for pair, n in bond_paths(molecule, N_SHELLS - 1).items()}


def find_edges(
    shells: dict[tuple[int, int], int], positions_nm: Tensor, cutoff_nm: float, *, few: int = FEW_ATOMS
) -> Edges:
    """Return the edges of frames `(rows, n_atoms, 3)` nm of a molecule: those that any of the frames needs."""
    n_atoms = positions_nm.shape[1]
    dense = n_atoms <= few
    if dense:
        pairs = _all_pairs(n_atoms)
    else:
        from scipy.spatial import cKDTree

        trees = map(cKDTree, positions_nm.detach().cpu().double().numpy())
        pairs = {pair: N_SHELLS - 1 for tree in trees for pair in tree.query_pairs(cutoff_nm)}
    pairs |= shells
    own = [(i, i, N_SHELLS - 1) for i in range(n_atoms)] if dense else []
    both = sorted([(i, j, s) for (i, j), s in pairs.items()] + [(j, i, s) for (i, j), s in pairs.items()] + own)
    receiver, sender, shell = torch.tensor(both, dtype=torch.int64, device=positions_nm.device).reshape(-1, 3).T
    return Edges(receiver, sender, shell, n_atoms, dense)


def _all_pairs(n_atoms: int) -> dict[tuple[int, int], int]:
    return dict.fromkeys(combinations(range(n_atoms), 2), N_SHELLS - 1)


def measure_edges(
    positions_nm: Tensor, edges: Edges, n_radial: int, cutoff_nm: float, dtype: torch.dtype
) -> EdgeGeometry:
    """Return distances, directions and radial functions of frames `(n_atoms, rows, 3)` nm, in `dtype`: bumps
    (1 - (u - k)^2 / HALF_WIDTH^2)^3, zero outside, with u = log d in units of their spacing (exponentials would have
    denormal tails). Distances are softened by 0.1 pm: finite at zero."""
    apart = edges.apart_nm(positions_nm).to(dtype)
    # An atom is to itself as one far beyond the cutoff.
    alone = torch.where(edges.receiver == edges.sender, _FAR_NM2, _SOFTENING_NM2).to(dtype)
    distance = (apart.square().sum(-1) + alone[:, None]).sqrt()
    begin, spacing = radial_grid(n_radial, cutoff_nm, apart)
    u = ((distance.log() - begin[edges.shell, None]) / spacing[edges.shell, None])[..., None]
    u = (u - torch.arange(n_radial, dtype=dtype, device=apart.device)) / HALF_WIDTH
    bump = torch.relu(1.0 - u * u)
    far = (edges.shell == N_SHELLS - 1)[:, None]
    inside = torch.where(far, torch.relu(1.0 - (distance / cutoff_nm).square()), 1.0)
    direction = apart / distance[..., None]
    shapes = edges.by_atom(torch.cat([direction, products(direction)], dim=-1))
    return EdgeGeometry(distance, bump * bump * bump * (inside * inside * inside)[..., None], shapes)


def radial_grid(n_radial: int, cutoff_nm: float, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return, by shell, the logarithm of the distance at which radial functions begin, and their spacing."""
    ends = zip(*SHELL_RANGES_NM, (LAST_SHELL_FROM_NM, cutoff_nm), strict=True)
    first, last = (torch.stack([like.new_full((), nm) for nm in each]).log() for each in ends)
    return first, (last - first) / (n_radial - 1)


def products(v: Tensor) -> Tensor:
    """`v` (..., 3) -> (..., 6), so that sums of products of two results are squares of the vectors' product."""
    x, y, z = v.unbind(-1)
    return torch.stack([x * x, y * y, z * z, _ROOT_TWO * x * y, _ROOT_TWO * y * z, _ROOT_TWO * x * z], dim=-1)


# Atomic numbers up to radon, as GFN2-xTB has them.
N_TYPES = 87
# Beyond what training has seen pairs are held by a wall: so steep, in units of the energy's scale.
WALL = 500.0
WALL_MARGIN = 1.03
WALLED_SHELLS = 2
NO_WALL_NM, LEAST_NM = 1e3, 1e-3


@dataclass(frozen=True, eq=False)
class Topology:
    """What of a molecule does not change while it moves: the shells of its bonds, the types that are `present`, each
    type's atoms."""

    molecule: Molecule
    shells: dict[tuple[int, int], int]
    bonds: Tensor
    present: Tensor
    groups: TypeGroups
    one_hot: Tensor

    @staticmethod
    def of(molecule: Molecule) -> Topology:
        present = torch.unique(molecule.elements)
        bonds = torch.cat([molecule.bonds.T, molecule.bonds.T.flip(0)], dim=1)
        one_hot = (present[:, None] == molecule.elements).to(torch.get_default_dtype())
        groups = type_groups(molecule.elements)
        return Topology(molecule, bonded_shells(molecule), bonds, present, groups, one_hot)


class EdgeWeights(NamedTuple):
    """Weights that depend on the molecule alone, made once for chunk after chunk: `of_atom` (n_atoms, width), `looks`
    of each step (n_edges, n_radial, ...), `table` (n_edges, n_radial, n_members), walls (n_edges, 1)."""

    edges: Edges
    of_atom: Tensor
    looks: tuple[Tensor, ...]
    table: Tensor
    nearest_nm: Tensor
    farthest_nm: Tensor


class Surroundings(nn.ModuleList):
    """Embeddings of elements -> embeddings of elements in their surroundings, up to three bonds away."""

    def __init__(self, width: int) -> None:
        super().__init__(
            nn.Sequential(nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, width)) for _ in range(3)
        )

    def forward(self, of_element: Tensor, bonds: Tensor) -> Tensor:
        """`of_element` (n_atoms, width), `bonds` (2, n_bonds) both ways -> (n_atoms, width)."""
        z = of_element
        for round_ in self:
            z = z + round_(torch.cat([z, torch.zeros_like(z).index_add(0, bonds[0], z[bonds[1]])], dim=-1))
        return z


class Look(nn.Module):
    """An atom's neighbourhood as invariants: sums over neighbours of scalars, directions and their products."""

    def __init__(self, c: PotentialConfig, n_carried: int, *, first: bool) -> None:
        super().__init__()
        self.c, n = c, c.n_scalars + c.n_vectors + c.n_tensors
        self.of_edge = nn.Linear(c.width, c.n_radial * n)
        self.send = None if first else nn.Linear(c.width, c.n_scalars + c.n_vectors)
        self.n_vectors = n_vectors = c.n_vectors + n_carried
        n_invariants = c.n_scalars + n_vectors**2 + c.n_tensors * (c.n_tensors + n_vectors)
        self.update = nn.Sequential(
            nn.Linear(c.width + n_invariants, c.width), nn.SiLU(), nn.Linear(c.width, c.width), nn.SiLU(),
            nn.Linear(c.width, c.width),
        )  # fmt: skip

    def weights(self, of_edge: Tensor) -> Tensor:
        """Features of edges (n_edges, width) -> weights of their radial functions."""
        c = self.c
        return self.of_edge(of_edge).unflatten(-1, (c.n_radial, -1)) * (2.0 / c.n_radial**0.5)

    def once(self) -> Tensor:
        """Return the first weights of `update` where none of the invariants comes twice: of products i <= j alone."""
        c, n = self.c, self.n_vectors
        sizes = c.width + c.n_scalars, n * n, c.n_tensors * (c.n_tensors + n)
        plain, of_vectors, of_tensors = cast(Tensor, self.update[0].weight).split(sizes, dim=1)
        both = (_once(of_vectors.unflatten(1, (n, n))), _once(of_tensors.unflatten(1, (c.n_tensors, -1))))
        return torch.cat([plain, *both], dim=1)

    def forward(self, h: Tensor, carried: Tensor | None, seen: EdgeGeometry, edges: Edges, weights: Tensor) -> Tensor:
        """`h` (n, rows, width), `carried` vectors (n, rows, 3, n_carried) -> h."""
        c = self.c
        found = torch.bmm(seen.radial, weights)
        n_seen = c.n_scalars + c.n_vectors
        if self.send is not None:
            sent = 1.0 + edges.sent(self.send(h))
            found = torch.cat([found[..., :n_seen] * sent, found[..., n_seen:]], dim=-1)
        felt = edges.sum(found[..., : c.n_scalars])
        shaped = edges.sum_of_products(seen.shapes, found[..., c.n_scalars :])
        v, t = shaped[..., :3, : c.n_vectors], shaped[..., 3:, c.n_vectors :]
        if carried is not None:
            v = torch.cat([v, carried], dim=-1)
        squares = products(v.transpose(-1, -2)).transpose(-1, -2)
        invariants = (_gram(v, v), _gram(t, torch.cat([t, squares], dim=-1)))
        return h + self.update(torch.cat([h, felt, *(i.flatten(-2) for i in invariants)], dim=-1))


def _once(weight: Tensor) -> Tensor:
    """`weight` (.., n, m) of n x m products of which the first n x n are symmetric -> (.., those with i <= j)."""
    n, m = weight.shape[-2:]
    below = weight[..., :n].tril(-1).transpose(-1, -2)
    i, j = torch.triu_indices(n, m)
    return (weight + F.pad(below, (0, m - n)))[..., i, j]


def _gram(a: Tensor, b: Tensor) -> Tensor:
    """`a` (..., k, m), `b` (..., k, n) -> sums over k of products (..., m, n)."""
    return a.transpose(-1, -2) @ b


class EnergyNetwork(nn.Module):
    """Positions -> the members' energies, in units of a scale that training measures."""

    def __init__(self, config: PotentialConfig) -> None:
        super().__init__()
        self.config = c = config
        self.embed_type = nn.Embedding(N_TYPES, c.width)
        self.surroundings = Surroundings(c.width)
        self.of_shell = nn.Embedding(N_SHELLS, c.width)
        self.of_pair = nn.Sequential(nn.Linear(2 * c.width, c.width), nn.SiLU(), nn.Linear(c.width, c.width), nn.SiLU())
        self.looks = nn.ModuleList(Look(c, 0 if k == 0 else c.n_heads, first=k == 0) for k in range(c.n_steps))
        self.steps = nn.ModuleList(EnergyAttention(c, N_TYPES) for _ in range(c.n_steps))
        self.site = nn.Sequential(nn.Linear(c.width, c.width), nn.SiLU(), nn.Linear(c.width, c.n_members))
        self.table = nn.Linear(c.width, c.n_radial * c.n_members)
        self.latent = nn.Parameter(torch.zeros(c.n_heads, c.n_members))
        nn.init.zeros_(self.table.weight)
        nn.init.zeros_(self.table.bias)
        # The shortest and the longest distance of training, by shell and types: beyond them stands a wall.
        self.nearest_nm = nn.Buffer(torch.zeros(N_SHELLS, N_TYPES, N_TYPES))
        self.farthest_nm = nn.Buffer(torch.full((N_SHELLS, N_TYPES, N_TYPES), NO_WALL_NM))

    def set_walls(self, positions_nm: Tensor, topology: Topology, *, widen: bool = False) -> None:
        """Stand walls a little beyond the distances of samples `(n, n_atoms, 3)` nm: the shortest of all pairs of like
        types and as many bonds apart, the longest of those one or two bonds apart; `widen`: and no nearer to what is
        known than they stood."""
        elements = topology.molecule.elements
        if not widen:
            self.nearest_nm.zero_()
            self.farthest_nm.fill_(NO_WALL_NM)
        extremes: dict[tuple[int, int, int], tuple[float, float]] = {}
        for (i, j), shell in (_all_pairs(len(elements)) | topology.shells).items():
            distance = (positions_nm[:, i] - positions_nm[:, j]).norm(dim=-1)
            low, high = sorted((int(elements[i]), int(elements[j])))
            least, most = extremes.get((shell, low, high), (NO_WALL_NM, 0.0))
            extremes[shell, low, high] = min(least, float(distance.min())), max(most, float(distance.max()))
        for (shell, a, b), (shortest, longest) in extremes.items():
            near, far = float(self.nearest_nm[shell, a, b]), float(self.farthest_nm[shell, a, b])
            self.nearest_nm[shell, [a, b], [b, a]] = min(shortest / WALL_MARGIN, near or NO_WALL_NM)
            if shell < WALLED_SHELLS:
                self.farthest_nm[shell, [a, b], [b, a]] = max(longest * WALL_MARGIN, far if far < NO_WALL_NM else 0.0)

    def prepare(self, topology: Topology, positions_nm: Tensor) -> EdgeWeights:
        """Return what depends on the molecule, and on frames `(rows, n_atoms, 3)` nm by who is near whom."""
        edges = find_edges(topology.shells, positions_nm, self.config.cutoff_nm)
        elements = topology.molecule.elements
        # Row 0, of no element, is what an elementary charge of the molecule adds to all its atoms.
        of_element = self.embed_type(elements) + topology.molecule.charge * self.embed_type.weight[0]
        z = self.surroundings(of_element, topology.bonds)
        of_edge = self.of_pair(torch.cat([z[edges.receiver] + self.of_shell(edges.shell), z[edges.sender]], dim=-1))
        types = edges.shell, elements[edges.receiver], elements[edges.sender]
        # An atom is as far from itself as no wall stands.
        farthest = torch.where(edges.receiver == edges.sender, torch.inf, self.farthest_nm[types])
        looks = tuple(look.weights(of_edge) for look in cast(Iterable[Look], self.looks))
        table = self.table(of_edge).unflatten(-1, (self.config.n_radial, -1))
        return EdgeWeights(edges, z, looks, table, self.nearest_nm[types][:, None], farthest[:, None])

    def forward(self, positions_nm: Tensor, topology: Topology, made: EdgeWeights) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> energies `(rows, n_members)`."""
        c, dtype = self.config, made.of_atom.dtype
        x = positions_nm.transpose(0, 1)
        seen = measure_edges(x, made.edges, c.n_radial, c.cutoff_nm, dtype)
        # Vectors in units of 0.1 nm, about the mean, before they lose digits.
        x = ((x - x.mean(0)) * 10.0).to(dtype).transpose(0, 1)
        h = made.of_atom[:, None].expand(-1, len(positions_nm), -1)
        carried = None
        dense = c.attention == "dense" or (c.attention == "auto" and x.shape[1] <= FEW_ATOMS)
        steps = cast(Iterable[EnergyAttention], self.steps)
        for look, step, weights in zip(self.looks, steps, made.looks, strict=True):
            h = look(h, carried, seen, made.edges, weights)
            new, means, q = step(h.transpose(0, 1), x, topology.molecule.elements, topology.groups, dense=dense)
            h = new.transpose(0, 1)
            # (rows, n_heads, n, 3) -> (n, rows, 3, n_heads)
            carried = (means - x[:, None]).permute(2, 0, 3, 1)
        energy = self.site(h).sum(0) + 0.5 * torch.bmm(seen.radial, made.table).sum(0)
        energy = energy + latent_energy(q, *step.type_matrices(), topology) @ self.latent
        # The walls: zero inside, with two derivatives.
        near = torch.relu(1.0 - seen.distance_nm / made.nearest_nm.clamp(min=LEAST_NM))
        far = torch.relu(seen.distance_nm / made.farthest_nm - 1.0)
        return energy + (WALL * (near.pow(3) + far.pow(3)).sum(0))[:, None]


def latent_energy(q: Tensor, phi: Tensor, psi: Tensor, topology: Topology) -> Tensor:
    """Return sum_ij rho_ij(|q_i - q_j|^2) / n^2 by head, `(rows, n_heads)`, in time linear in atoms: `q` (rows,
    n_heads, n, d) of unit length, so that s = 2 - 2 q_i.q_j; `phi` = a - 4 b and `psi` = 4 b (n_heads, n_types,
    n_types)."""
    phi, psi = (m[:, topology.present][:, :, topology.present] for m in (phi, psi))
    b = 0.25 * psi
    a = phi + psi
    z = topology.one_hot.to(q.dtype)
    sums = torch.einsum("tn,rhnd->rhtd", z, q)
    squares = torch.einsum("tn,rhnd,rhne->rhtde", z, q, q).flatten(-2)
    first = sums @ sums.transpose(-1, -2)
    second = squares @ squares.transpose(-1, -2)
    count = z.sum(-1)[:, None] * z.sum(-1)
    rho = a * (2.0 * count - 2.0 * first) - b * (4.0 * count - 8.0 * first + 4.0 * second)
    return rho.sum((-1, -2)) / z.sum().square()
