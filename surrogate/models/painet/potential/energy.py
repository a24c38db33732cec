"""The potential energy that PAINET's energy-descent attention gives: a scalar, invariant and smooth.

Embeddings start from types of atoms in their bonded surroundings. Each latent step looks at an atom's neighbourhood
(sums of functions of distance and direction, and the invariants of these), then takes a step of the paper's descent
(`EnergyAttention`), in which positions are carried along: the mean of all atoms' positions under positive weights that
depend on embeddings and types is a vector that knows the whole molecule, at a cost linear in its atoms.

The energy is read from the last embeddings, from a table of pair energies, and from the latent energy that attention
descends, sum_ij rho_ij(|q_i - q_j|^2) with rho = a s - b s^2 (the paper's equation of E(H), and "Particle-type Adaptive
Mapping").
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from surrogate.models.architecture import build
from surrogate.models.painet.attention import N_SHELLS, EnergyAttention, Surroundings, TypeGroups, molecular_pairs
from surrogate.models.potential import IntegratorConfig
from surrogate.models.propagator import Molecule
from systems.errors import InputError

# Settings of PAINET as a potential.


@dataclass(frozen=True)
class PotentialConfig(IntegratorConfig):
    """Size of the network, beside the settings of the MD on it.

    `n_steps` latent steps, each a look at the neighbourhood and, between them, energy-descent attention over all atoms.
    An atom sees its neighbours by `n_scalars`, `n_vectors` and `n_tensors` sums of products of `n_radial` functions of
    the distance. `n_members`: read-outs that learn from different samples; their mean is the potential, their spread
    says where it is unsure. `attention`: 'linear' (factored over types), 'dense' (the same numbers) or 'auto'.
    """

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
        if self.attention not in ("auto", "linear", "dense"):
            raise InputError(f"attention = {self.attention!r} is unknown; choose auto, linear or dense.")
        sizes = ("width", "n_steps", "n_scalars", "n_vectors", "n_tensors", "n_heads", "head_dim", "n_members")
        for name in sizes:
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)} must be at least 1.")
        if self.n_radial < 2:
            raise InputError(f"n_radial = {self.n_radial} must be at least 2.")
        if not 0.0 < self.step < 1.0 or not 0.0 <= self.psi_limit < 1.0:
            raise InputError(f"step = {self.step:g} and psi_limit = {self.psi_limit:g} must lie between 0 and 1.")

    @staticmethod
    def from_dict(record: dict[str, Any]) -> PotentialConfig:
        """Raises InputError for an unknown key, naming the nearest."""
        return build(PotentialConfig, record)


# Ordered pairs of atoms within reach of each other, and the smooth functions of their distance that a potential sees.
# Pairs up to three bonds apart count always, others inside a cutoff, at which all they add has come down to zero with
# its first two derivatives. So the number of pairs grows with the atoms and not with their square.

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
        return self._square(values[None]) if self.dense else values[self.sender]

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

    def _square(self, values: Tensor) -> Tensor:
        return values.expand(self.n_atoms, self.n_atoms, *values.shape[2:]).flatten(0, 1)


@dataclass(frozen=True, eq=False)
class EdgeGeometry:
    """`distance_nm` (n_edges, rows) and `radial` (n_edges, rows, n_radial); `shapes`: the direction from sender to
    receiver and its products (`products`), laid out by `Edges.by_atom`."""

    distance_nm: Tensor
    radial: Tensor
    shapes: Tensor


def bonded_shells(molecule: Molecule) -> dict[tuple[int, int], int]:
    """Return how many bonds less one lie between atoms (i, j), i < j, up to three."""
    pairs = molecular_pairs(molecule, all_pairs=False)
    ends = zip(pairs.first.tolist(), pairs.second.tolist(), pairs.shell.tolist(), strict=True)
    return {(min(i, j), max(i, j)): shell for i, j, shell in ends}


def find_edges(
    shells: dict[tuple[int, int], int], positions_nm: Tensor, cutoff_nm: float, *, few: int = FEW_ATOMS
) -> Edges:
    """Return the edges of frames `(rows, n_atoms, 3)` nm of a molecule: those that any of the frames needs."""
    n_atoms = positions_nm.shape[1]
    if n_atoms <= few:
        pairs = {(i, j): N_SHELLS - 1 for i in range(n_atoms) for j in range(i + 1, n_atoms)}
    else:
        from scipy.spatial import cKDTree

        pairs = {}
        for frame in positions_nm.detach().cpu().double().numpy():
            near: np.ndarray = cKDTree(frame).query_pairs(cutoff_nm, output_type="ndarray")
            pairs |= {(int(i), int(j)): N_SHELLS - 1 for i, j in near}
    pairs |= shells
    dense = n_atoms <= few
    own = [(i, i, N_SHELLS - 1) for i in range(n_atoms)] if dense else []
    both = sorted([(i, j, s) for (i, j), s in pairs.items()] + [(j, i, s) for (i, j), s in pairs.items()] + own)
    receiver, sender, shell = torch.tensor(both, dtype=torch.int64, device=positions_nm.device).reshape(-1, 3).T
    return Edges(receiver, sender, shell, n_atoms, dense)


def measure_edges(
    positions_nm: Tensor, edges: Edges, n_radial: int, cutoff_nm: float, dtype: torch.dtype
) -> EdgeGeometry:
    """Return distances, directions and radial functions of frames `(n_atoms, rows, 3)` nm, in `dtype`.

    Radial functions are bumps (1 - (u - k)^2 / HALF_WIDTH^2)^3, zero outside, with u = log d in units of their spacing;
    without exponentials, whose tails would be denormal numbers. Distances are softened by 0.1 pm: finite at zero.
    """
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
    ranges = like.new_tensor([*SHELL_RANGES_NM, (LAST_SHELL_FROM_NM, cutoff_nm)]).log()
    return ranges[:, 0], (ranges[:, 1] - ranges[:, 0]) / (n_radial - 1)


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
NO_WALL_NM = 1e3


@dataclass(frozen=True, eq=False)
class Fabric:
    """What of a molecule does not change while it moves: the shells of its bonds, the types that are `present`, each
    type's atoms."""

    molecule: Molecule
    shells: dict[tuple[int, int], int]
    bonds: Tensor
    present: Tensor
    groups: TypeGroups
    one_hot: Tensor

    @staticmethod
    def of(molecule: Molecule) -> Fabric:
        present = torch.unique(molecule.elements)
        groups = [torch.nonzero(molecule.elements == number).flatten() for number in present]
        bonds = torch.cat([molecule.bonds.T, molecule.bonds.T.flip(0)], dim=1)
        one_hot = (present[:, None] == molecule.elements).to(torch.get_default_dtype())
        return Fabric(molecule, bonded_shells(molecule), bonds, present, groups, one_hot)


@dataclass(frozen=True, eq=False)
class Prepared:
    """Weights that depend on the molecule alone, made once for chunk after chunk: `of_atom` (n_atoms, width), `looks`
    of each step (n_edges, n_radial, ...), `table` (n_edges, n_radial, n_members), walls (n_edges, 1)."""

    edges: Edges
    of_atom: Tensor
    looks: tuple[Tensor, ...]
    table: Tensor
    nearest_nm: Tensor
    farthest_nm: Tensor


class Look(nn.Module):
    """An atom's neighbourhood as invariants: sums over neighbours of scalars, directions and their products."""

    def __init__(self, c: PotentialConfig, n_carried: int, *, first: bool) -> None:
        super().__init__()
        self.c, n = c, c.n_scalars + c.n_vectors + c.n_tensors
        self.of_edge = nn.Linear(c.width, c.n_radial * n)
        self.send = None if first else nn.Linear(c.width, c.n_scalars + c.n_vectors)
        n_vectors = c.n_vectors + n_carried
        n_invariants = c.n_scalars + n_vectors**2 + c.n_tensors * (c.n_tensors + n_vectors)
        self.update = nn.Sequential(
            nn.Linear(c.width + n_invariants, c.width), nn.SiLU(), nn.Linear(c.width, c.width), nn.SiLU(),
            nn.Linear(c.width, c.width),
        )  # fmt: skip

    def weights(self, of_edge: Tensor) -> Tensor:
        """Features of edges (n_edges, width) -> weights of their radial functions."""
        c = self.c
        return self.of_edge(of_edge).unflatten(-1, (c.n_radial, -1)) * (2.0 / c.n_radial**0.5)

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
        self.register_buffer("nearest_nm", torch.zeros(N_SHELLS, N_TYPES, N_TYPES))
        self.register_buffer("farthest_nm", torch.full((N_SHELLS, N_TYPES, N_TYPES), NO_WALL_NM))
        self.nearest_nm: Tensor
        self.farthest_nm: Tensor

    def set_walls(self, positions_nm: Tensor, fabric: Fabric) -> None:
        """Stand walls a little beyond the distances of samples `(n, n_atoms, 3)` nm: the shortest of all pairs of like
        types and as many bonds apart, the longest of those one or two bonds apart."""
        elements = fabric.molecule.elements
        self.nearest_nm.zero_()
        self.farthest_nm.fill_(NO_WALL_NM)
        pairs = {(i, j): N_SHELLS - 1 for i in range(len(elements)) for j in range(i + 1, len(elements))}
        nearest: dict[tuple[int, int, int], float] = {}
        farthest: dict[tuple[int, int, int], float] = {}
        for (i, j), shell in (pairs | fabric.shells).items():
            distance = (positions_nm[:, i] - positions_nm[:, j]).norm(dim=-1)
            low, high = sorted((int(elements[i]), int(elements[j])))
            kind = (shell, low, high)
            nearest[kind] = min(nearest.get(kind, NO_WALL_NM), float(distance.min()))
            farthest[kind] = max(farthest.get(kind, 0.0), float(distance.max()))
        for (shell, low, high), shortest in nearest.items():
            longest = farthest[shell, low, high]
            for a, b in ((low, high), (high, low)):
                self.nearest_nm[shell, a, b] = shortest / WALL_MARGIN
                if shell < WALLED_SHELLS:
                    self.farthest_nm[shell, a, b] = longest * WALL_MARGIN

    def prepare(self, fabric: Fabric, positions_nm: Tensor) -> Prepared:
        """Return what depends on the molecule, and on frames `(rows, n_atoms, 3)` nm by who is near whom."""
        edges = find_edges(fabric.shells, positions_nm, self.config.cutoff_nm)
        elements = fabric.molecule.elements
        z = self.surroundings(self.embed_type(elements), fabric.bonds)
        of_edge = self.of_pair(torch.cat([z[edges.receiver] + self.of_shell(edges.shell), z[edges.sender]], dim=-1))
        types = edges.shell, elements[edges.receiver], elements[edges.sender]
        # An atom is as far from itself as no wall stands.
        farthest = torch.where(edges.receiver == edges.sender, torch.inf, self.farthest_nm[types])
        return Prepared(
            edges,
            z,
            tuple(look.weights(of_edge) for look in cast(Iterable[Look], self.looks)),
            self.table(of_edge).unflatten(-1, (self.config.n_radial, -1)),
            self.nearest_nm[types][:, None],
            farthest[:, None],
        )

    def forward(self, positions_nm: Tensor, fabric: Fabric, made: Prepared) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> energies `(rows, n_members)`."""
        c, kind = self.config, made.of_atom.dtype
        x = positions_nm.transpose(0, 1)
        seen = measure_edges(x, made.edges, c.n_radial, c.cutoff_nm, kind)
        # Vectors in units of 0.1 nm, about the mean, before they lose digits.
        x = ((x - x.mean(0)) * 10.0).to(kind).transpose(0, 1)
        h = made.of_atom[:, None].expand(-1, len(positions_nm), -1)
        carried = latent = None
        dense = c.attention == "dense" or (c.attention == "auto" and x.shape[1] <= FEW_ATOMS)
        steps = cast(Iterable[EnergyAttention], self.steps)
        for look, step, weights in zip(self.looks, steps, made.looks, strict=True):
            h = look(h, carried, seen, made.edges, weights)
            new, means, q = step.carry(h.transpose(0, 1), x, fabric.molecule.elements, fabric.groups, dense=dense)
            h = new.transpose(0, 1)
            # (rows, n_heads, n, 3) -> (n, rows, 3, n_heads)
            carried = (means - x[:, None]).permute(2, 0, 3, 1)
            phi, psi = step.type_matrices()
            latent = latent_energy(q, phi, psi, fabric)
        energy = self.site(h).sum(0) + 0.5 * torch.bmm(seen.radial, made.table).sum(0)
        if latent is not None:
            energy = energy + latent @ self.latent
        return energy + self._walls(seen.distance_nm, made)[:, None]

    def _walls(self, distance_nm: Tensor, made: Prepared) -> Tensor:
        """Energy `(rows,)` of pairs nearer or farther than any that training saw; zero inside, with two derivatives."""
        near = torch.relu(1.0 - distance_nm / made.nearest_nm.clamp(min=1e-3))
        far = torch.relu(distance_nm / made.farthest_nm - 1.0)
        return WALL * (near.pow(3) + far.pow(3)).sum(0)


def latent_energy(q: Tensor, phi: Tensor, psi: Tensor, fabric: Fabric) -> Tensor:
    """Return sum_ij rho_ij(|q_i - q_j|^2) / n^2 by head, `(rows, n_heads)`, in time linear in atoms.

    `q` (rows, n_heads, n, d) of unit length, so that s = 2 - 2 q_i.q_j; `phi` = a - 4 b and `psi` = 4 b (n_heads,
    n_types, n_types). Sums over pairs of types need sums of q and of q q^T over each type alone.
    """
    phi, psi = (m[:, fabric.present][:, :, fabric.present] for m in (phi, psi))
    b = 0.25 * psi
    a = phi + psi
    z = fabric.one_hot.to(q.dtype)
    sums = torch.einsum("tn,rhnd->rhtd", z, q)
    squares = torch.einsum("tn,rhnd,rhne->rhtde", z, q, q).flatten(-2)
    first = sums @ sums.transpose(-1, -2)
    second = squares @ squares.transpose(-1, -2)
    count = z.sum(-1)[:, None] * z.sum(-1)
    rho = a * (2.0 * count - 2.0 * first) - b * (4.0 * count - 8.0 * first + 4.0 * second)
    return rho.sum((-1, -2)) / z.sum().square()
