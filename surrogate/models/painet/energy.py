"""PAINET as a potential: a scalar energy, invariant and smooth, and its exact gradient, by torch and by SIMD.

Embeddings start from types of atoms in their bonded surroundings. Each latent step looks at an atom's neighbourhood
(sums of functions of distance and direction, and the invariants of these), then takes a step of the paper's descent
(`EnergyAttention`), in which positions are carried along: their mean under positive weights that depend on embeddings
and types is a vector that knows the whole molecule, at a cost linear in its atoms. The energy is read from the last
embeddings, from a table of pair energies, and from the latent energy that attention descends (the paper's E(H)).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from md_reference import simd as engine
from surrogate.models.painet.model import EnergyAttention, TypeGroups, bond_paths, check_attention, type_groups
from surrogate.models.potential import TOLERANCE, Bath, GradientFn, IntegratorConfig, Potential, at_rest, gradient_of
from surrogate.models.propagator import Molecule
from systems.errors import InputError
from systems.files.native import CompilerError, compiled_program

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
    """Embeddings of elements -> embeddings of elements in their surroundings, as far as there are rounds."""

    def __init__(self, width: int, n_rounds: int = 3) -> None:
        super().__init__(
            nn.Sequential(nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, width)) for _ in range(n_rounds)
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


# The potential by SIMD: copies of a molecule at once, each in its own element of the processor's vector registers.
# `simd.cpp` computes energies and their mean's gradient as `EnergyNetwork` and torch do, in single precision, and moves
# the copies by it with the bath and rigid bonds of md_reference.simd. It is compiled at first use, in seconds.

_SOURCE = Path(__file__).with_name("simd.cpp")
# Copies at once: of a whole register, and where no more are asked for; of the register in bytes.
_WIDTH, _FEW, _ALIGNED = 16, 4, 64


class _Linear(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("weight", "turned", "bias")]


class _Step(ctypes.Structure):
    _fields_ = [
        *((name, _Linear) for name in ("send", "first", "second", "third", "qkv", "out")),
        *((name, ctypes.c_void_p) for name in ("phi", "psi")),
    ]


class _Bath(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int32) for name in ("n_atoms", "n_bonds")),
        *((name, ctypes.c_void_p) for name in ("atoms", "bonds", "lengths")),
        *((name, ctypes.c_double) for name in ("timestep", "keep", "noise", "tolerance")),
    ]


class SimdPotential:
    """Frames `(rows, n_atoms, 3)` nm of one molecule -> the members' energies `(rows, n_members)` in kJ/mol and the
    gradient `(rows, n_atoms, 3)` of their mean, by the network's weights as they are now, times `unit` and from `zero`,
    both in kJ/mol."""

    def __init__(self, network: EnergyNetwork, topology: Topology, made: EdgeWeights, unit: float, zero: float) -> None:
        config, n = network.config, topology.molecule.n_atoms
        self.config, self.n_atoms, self.unit, self.zero = config, n, unit, zero
        self._work: dict[tuple[int, int], npt.NDArray[Any]] = {}
        # The program reads these arrays in place.
        self._kept: list[npt.NDArray[Any]] = []
        types = topology.molecule.elements
        steps = []
        looks, attentions = cast(Iterable[Look], network.looks), cast(Iterable[EnergyAttention], network.steps)
        for look, attention in zip(looks, attentions, strict=True):
            phi, psi = (m[:, types][:, :, types] for m in attention.type_matrices())
            dense = (look.update[0], look.update[2], look.update[4], attention.qkv, attention.out)
            linear = [self._linear(layer) for layer in (look.send, *dense)]
            linear[1] = self._linear(look.update[0], look.once())
            steps.append(_Step(*linear, self._array(phi), self._array(psi)))
        edges, shell = made.edges, made.edges.shell
        begin, spacing = radial_grid(config.n_radial, config.cutoff_nm, made.of_atom)
        per_cutoff2 = torch.where(shell == N_SHELLS - 1, config.cutoff_nm**-2, 0.0)
        pairs = (begin[shell], 1.0 / spacing[shell], per_cutoff2, 1.0 / made.nearest_nm[:, 0].clamp(min=LEAST_NM),
                 1.0 / made.farthest_nm[:, 0])  # fmt: skip
        seen = torch.cat(made.looks, dim=-1)
        of_pair = 0.5 * made.table.unflatten(0, (n, n))
        tables = of_pair + of_pair.transpose(0, 1)
        tables = torch.cat([tables, tables.mean(-1, keepdim=True)], dim=-1)
        last = cast(nn.Linear, network.site[2])
        members = torch.cat([last.weight, last.bias[:, None], network.latent.T / n**2], dim=-1)
        assert edges.dense

        class Network(ctypes.Structure):
            _fields_ = [
                ("n", ctypes.c_int64), ("steps", _Step * config.n_steps), ("site", _Linear),
                *((name, ctypes.c_void_p) for name in ("members", "of_atom", "edges", "tables", "pairs")),
                ("eta", ctypes.c_float), ("wall", ctypes.c_float),
            ]  # fmt: skip

        read_out = torch.cat([members, members.mean(0, keepdim=True)])
        arrays = (read_out, made.of_atom, seen, tables, torch.stack(pairs, dim=-1))
        places = (self._array(array) for array in arrays)
        self._network = Network(
            n, (_Step * config.n_steps)(*steps), self._linear(network.site[0]), *places, config.step, WALL
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> SimdPotential:
        return self  # pointers into arrays that never change

    @torch.no_grad()
    def __call__(self, positions_nm: Tensor) -> tuple[Tensor, Tensor]:
        rows, width = len(positions_nm), _width_for(len(positions_nm))
        x = _laid(positions_nm.double(), width)
        energy = torch.empty(len(x), self.config.n_members, width)
        gradient = torch.empty(len(x), self.n_atoms, 3, width)

        def compute(block: int, program: ctypes.CDLL, work: int) -> None:
            places = (x[block].data_ptr(), energy[block].data_ptr(), gradient[block].data_ptr(), work)
            program.evaluate(ctypes.byref(self._network), *map(ctypes.c_void_p, places))

        self._each_block(len(x), width, compute)
        members = energy.transpose(1, 2).flatten(0, 1)[:rows].double()
        return self.zero + self.unit * members, self.unit * _back(gradient, rows).double()

    @torch.no_grad()
    def langevin(self, x: Tensor, v: Tensor, draw: Tensor, bath: Bath) -> tuple[Tensor, Tensor]:
        """Return positions nm and velocities nm/ps `(rows, n_atoms, 3)` after the steps that `draw` (rows, n_atoms,
        n_steps, 3) holds normal numbers for."""
        rows, width, n_steps = len(x), _width_for(len(x)), draw.shape[2]
        at, moving = _laid(x.double(), width), _laid(v.double(), width)
        drawn = _laid((bath.lost[..., None] * draw).transpose(1, 2).float(), width)
        # What the bath gives is drawn: no thermal speeds.
        atoms = torch.cat([1.0 / bath.masses, torch.zeros_like(bath.masses)], dim=-1)
        if (rigid := bath.rigid) is None:
            bonds, lengths = torch.zeros(0, 2, dtype=torch.int32), atoms
        else:
            bonds = torch.stack([rigid.first, rigid.second], dim=-1).to(torch.int32)
            lengths = rigid.length2.sqrt()
        places = (array.data_ptr() for array in (atoms, bonds, lengths))
        settings = _Bath(self.n_atoms, len(bonds), *places, bath.timestep_ps, bath.kept, 1.0, TOLERANCE)

        def compute(block: int, program: ctypes.CDLL, work: int) -> None:
            of_block = [ctypes.c_void_p(array[block].data_ptr()) for array in (at, moving, drawn)]
            program.langevin(ctypes.byref(self._network), ctypes.byref(settings), ctypes.c_double(self.unit), *of_block,
                             ctypes.c_int64(n_steps), ctypes.c_void_p(work))  # fmt: skip

        self._each_block(len(at), width, compute)
        return _back(at, rows), _back(moving, rows)

    def _each_block(self, n_blocks: int, width: int, compute: Callable[[int, ctypes.CDLL, int], None]) -> None:
        """Call `compute(block, program, room to work in)` for each block of copies, on as many cores as torch takes."""
        program, n_threads = _program(self.config, width), min(torch.get_num_threads(), n_blocks)

        def some(thread: int) -> None:
            if (work := self._work.get((width, thread))) is None:
                work = _aligned(int(program.work_floats(ctypes.c_int64(self.n_atoms))))
                self._work[width, thread] = work
            for block in range(thread, n_blocks, n_threads):
                compute(block, program, work.ctypes.data)

        if n_threads == 1:
            some(0)
        else:
            list(_pool(n_threads).map(some, range(n_threads)))

    def _array(self, values: Tensor) -> int:
        self._kept.append(np.ascontiguousarray(values.detach().numpy(), dtype=np.float32))
        return self._kept[-1].ctypes.data

    def _linear(self, layer: Any, weight: Tensor | None = None) -> _Linear:
        if layer is None:
            return _Linear()
        weight = layer.weight if weight is None else weight
        return _Linear(self._array(weight), self._array(weight.T), self._array(layer.bias))


def simd_potential_of(network: EnergyNetwork, topology: Topology, made: EdgeWeights, rows: int, unit: float = 1.0,
                      zero: float = 0.0) -> SimdPotential | None:  # fmt: skip
    """Return the potential by SIMD, compiled for so many frames; None where it does not run so: not in single precision
    on this processor, for so many atoms that pairs change from frame to frame, or without a C++ compiler."""
    if made.of_atom.dtype != torch.float32 or made.of_atom.device.type != "cpu" or not made.edges.dense:
        return None
    try:
        _program(network.config, _width_for(rows))
    except (CompilerError, OSError):
        return None
    return SimdPotential(network, topology, made, unit, zero)


def _width_for(rows: int) -> int:
    return _WIDTH if rows > _FEW else _FEW


def _laid(values: Tensor, width: int) -> Tensor:
    """`values` (rows, ..) -> (blocks, .., width), a copy, which the program moves in place; places that have no row
    hold the last."""
    n_blocks = -(-len(values) // width)
    if n_blocks * width > len(values):
        values = values[torch.arange(n_blocks * width).clamp(max=len(values) - 1)]
    # One whole block that comes `_back` from here lies as it is wanted: `contiguous` would not copy it.
    return values.unflatten(0, (n_blocks, width)).movedim(1, -1).clone(memory_format=torch.contiguous_format)


def _back(laid: Tensor, rows: int) -> Tensor:
    return laid.movedim(-1, 1).flatten(0, 1)[:rows]


@lru_cache(maxsize=8)
def _program(config: PotentialConfig, width: int) -> ctypes.CDLL:
    sizes = {name.upper(): getattr(config, name) for name in SIZES}
    program = compiled_program(_SOURCE, {"W": width, **sizes}, Path(engine.__path__[0]))
    program.work_floats.restype = ctypes.c_int64
    return program


@lru_cache(maxsize=1)
def _pool(n_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(n_threads, "simd")


def _aligned(n_floats: int) -> npt.NDArray[Any]:
    """Return an array that begins where a register may be loaded from."""
    raw = np.empty(4 * n_floats + _ALIGNED, dtype=np.uint8)
    begin = -raw.ctypes.data % _ALIGNED
    return raw[begin : begin + 4 * n_floats].view(np.float32)


class PainetPotential(Potential):
    """A scalar energy, invariant to rotations, reflections, translations and the order of like atoms, and smooth:
    `energy_offset_kj_mol` plus the network's times `energy_scale_kj_mol`, both of training."""

    arch: ClassVar[str] = "painet-potential"
    config: PotentialConfig

    def __init__(self, config: PotentialConfig) -> None:
        super().__init__()
        self.config = config
        self.network = EnergyNetwork(config)
        self.energy_offset_kj_mol = nn.Buffer(torch.zeros(()))
        self.energy_scale_kj_mol = nn.Buffer(torch.full((), 100.0))
        self._made: tuple[Molecule, GradientFn] | None = None
        self._topology: Topology | None = None

    def train(self, mode: bool = True) -> PainetPotential:
        """As any module; what was made of earlier weights is forgotten."""
        self._made = None
        super().train(mode)
        return self

    def topology(self, molecule: Molecule) -> Topology:
        """Return what the network needs of a molecule, made once for call after call. Raises InputError for elements
        beyond radon."""
        if self._topology is None or self._topology.molecule is not molecule:
            heaviest = int(molecule.elements.max())
            if heaviest >= N_TYPES:
                raise InputError(f"PAINET has types up to atomic number {N_TYPES - 1}; this molecule holds {heaviest}.")
            with torch.inference_mode(False):
                self._topology = Topology.of(molecule)
        return self._topology

    def energies(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        return self.members(positions_nm, self.topology(molecule))

    def members(self, positions_nm: Tensor, topology: Topology, made: EdgeWeights | None = None) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> the members' energies `(rows, n_members)` in kJ/mol, in float64."""
        made = made or self.network.prepare(topology, positions_nm)
        energy = self.network(positions_nm, topology, made)
        return self.energy_offset_kj_mol.double() + self.energy_scale_kj_mol.double() * energy.double()

    def member_forces(self, positions_nm: Tensor, topology: Topology) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> each member's forces `(n_members, rows, n_atoms, 3)` kJ/mol/nm."""
        with torch.inference_mode(False), torch.enable_grad():
            x = positions_nm.detach().clone().requires_grad_(True)
            totals = self.members(x, topology).sum(0)
            return -torch.stack([torch.autograd.grad(total, x, retain_graph=True)[0] for total in totals])

    def spread(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> `(rows,)` kJ/mol/nm, the root mean square deviation of the members' forces
        from their mean, the largest of a frame's atoms."""
        found = []
        for part in positions_nm.double().split(256):
            forces = self.member_forces(part, self.topology(molecule))
            found.append((forces - forces.mean(0)).square().sum(-1).mean(0).sqrt().amax(-1))
        return torch.cat(found)

    def gradient(self, positions_nm: Tensor, molecule: Molecule) -> GradientFn:
        """Return what computes the members' energies and their mean's gradient at frames like these: by SIMD where
        they run, else by torch."""
        # Above so many atoms pairs change from frame to frame.
        fixed = molecule.n_atoms <= FEW_ATOMS and not self.training
        if fixed and self._made is not None and self._made[0] is molecule:
            return self._made[1]
        topology, simd = self.topology(molecule), None
        with torch.inference_mode(False), torch.no_grad():
            made = self.network.prepare(topology, positions_nm)
        if not self.training:
            unit, zero = float(self.energy_scale_kj_mol), float(self.energy_offset_kj_mol)
            simd = simd_potential_of(self.network, topology, made, len(positions_nm), unit=unit, zero=zero)
        self._made = molecule, simd or gradient_of(lambda x: self.members(x, topology, made))
        return self._made[1]

    def langevin(self, x: Tensor, v: Tensor, molecule: Molecule, masses: Tensor, thermal: Tensor, draw: Tensor, *,
                 timestep_ps: float | None = None) -> tuple[Tensor, Tensor]:  # fmt: skip
        """See `Potential.langevin`; all steps by SIMD where that runs."""
        if isinstance(simd := self.gradient(x, molecule), SimdPotential):
            return simd.langevin(x, at_rest(v, masses), draw, self.bath(molecule, masses, thermal, timestep_ps))
        return super().langevin(x, v, molecule, masses, thermal, draw, timestep_ps=timestep_ps)

    def set_scales(self, energies_kj_mol: Tensor, forces_kj_mol_nm: Tensor) -> None:
        """Take the units of what is learned from samples: mean energy, and the root mean square force over 0.1 nm."""
        self.energy_offset_kj_mol.fill_(float(energies_kj_mol.mean()))
        self.energy_scale_kj_mol.fill_(max(0.1 * float(forces_kj_mol_nm.square().mean().sqrt()), 1e-3))

    def set_offset(self, positions_nm: Tensor, energies_kj_mol: Tensor, topology: Topology) -> None:
        """Take the zero of energies from samples `(n, n_atoms, 3)` nm, and leave the scale that was learned with."""
        with torch.no_grad():
            found = torch.cat([self.members(x, topology).mean(-1) for x in positions_nm.split(256)])
        self.energy_offset_kj_mol.add_(float((energies_kj_mol - found).mean()))
