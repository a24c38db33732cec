"""PAINET: latent steps of energy-descent attention, one per future frame, decoded in parallel by one EGNN."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, cast

import torch
from torch import Tensor, nn

from surrogate.models.architecture import build
from surrogate.models.painet.attention import EnergyAttention, Pairs, Surroundings, TypeGroups, molecular_pairs
from surrogate.models.painet.decoders import (
    Egnn,
    Graph,
    Leapfrog,
    Modes,
    angular_velocity,
    centred_template,
    molecular_graph,
    spun,
    turns,
)
from surrogate.models.propagator import Chunk, Molecule, Propagator
from systems.errors import InputError
from systems.scene import Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K

if TYPE_CHECKING:
    pass

# PAINET's settings.


@dataclass(frozen=True)
class PainetConfig:
    """Size, horizon and physics. `n_new` frames are predicted at once, `frame_stride` reference frames apart: 1 frame
    at a large stride is state-to-state, several are state-to-trajectory.

    `attention` 'linear' (factored over types, cost linear in atoms), 'dense' (the same numbers, quadratic) or 'none'
    (the decoder alone, which is EGNN). `edges` 'bonds' (with second neighbours) or 'all' pairs. `lag_ps` between
    predicted frames, `temperature_k` and `friction_per_ps` of the bath that refreshes velocities between chunks; a
    training takes the three from its reference.

    Ours: `n_modes` modes of motion over the whole molecule beside attention and decoder (`Modes`), 0 for none;
    `free_rotation` takes the rotation of the whole out of what is learned.

    `decoder` 'egnn' (the paper's) or 'leapfrog' (ours: layers are steps of an integrator whose forces keep momentum,
    angular momentum and depend on positions alone), with `n_radial` functions of the distance per shell of pairs and
    `n_scalars` and `n_vectors` sums over an atom's neighbours.
    """

    n_new: int = 8
    frame_stride: int = 1
    width: int = 64
    n_heads: int = 4
    head_dim: int = 16
    n_decoder_layers: int = 4
    attention: str = "linear"
    edges: str = "bonds"
    n_modes: int = 0
    free_rotation: bool = False
    decoder: str = "egnn"
    n_radial: int = 12
    n_scalars: int = 8
    n_vectors: int = 6
    # Share of the attention's mean in the next embedding, eta of the descent step.
    step: float = 0.5
    # Largest Psi / Phi: below one, weights stay positive whatever the embeddings.
    psi_limit: float = 0.95
    length_scale_nm: float = 0.1
    lag_ps: float = 0.005
    temperature_k: float = 300.0
    friction_per_ps: float = 1.0

    def __post_init__(self) -> None:
        if self.attention not in ("linear", "dense", "none"):
            raise InputError(f"attention = {self.attention!r} is unknown; choose linear, dense or none.")
        if self.edges not in ("bonds", "all"):
            raise InputError(f"edges = {self.edges!r} is unknown; choose bonds or all.")
        if self.decoder not in ("egnn", "leapfrog"):
            raise InputError(f"decoder = {self.decoder!r} is unknown; choose egnn or leapfrog.")
        if self.n_modes < 0 or (self.decoder == "leapfrog" and (self.n_modes or self.free_rotation)):
            raise InputError(f"n_modes = {self.n_modes} and free_rotation = {self.free_rotation} go with decoder egnn.")
        if self.n_radial < 2 or min(self.n_scalars, self.n_vectors, self.n_decoder_layers) < 1:
            raise InputError(
                f"n_radial = {self.n_radial} must be at least 2, n_scalars = {self.n_scalars}, n_vectors = "
                f"{self.n_vectors} and n_decoder_layers = {self.n_decoder_layers} at least 1."
            )
        if self.n_new < 1 or self.frame_stride < 1:
            raise InputError(f"n_new = {self.n_new} and frame_stride = {self.frame_stride} must be at least 1.")
        if not 0.0 < self.step < 1.0 or not 0.0 <= self.psi_limit < 1.0:
            raise InputError(f"step = {self.step:g} and psi_limit = {self.psi_limit:g} must lie between 0 and 1.")

    @property
    def chunk_ps(self) -> float:
        return self.n_new * self.lag_ps

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_dict(record: dict[str, Any]) -> PainetConfig:
        """Raises InputError for an unknown key, naming the nearest."""
        return build(PainetConfig, record)


# Atomic numbers up to xenon; 0 is a particle of a model system.
N_TYPES = 55
# Numbers in one layer's messages, of all rows decoded at once. Larger arrays come anew from the system each time: then
# 10,000 atoms cost five times what 3,000 do.
MESSAGE_NUMBERS = 2_000_000


@dataclass(frozen=True, eq=False)
class Structure:
    """What of a molecule does not change from chunk to chunk: each type's atoms, `bonds` (2, n) both ways, the template
    of a model with modes, the decoder's edges or pairs."""

    molecule: Molecule
    groups: TypeGroups
    bonds: Tensor
    template: Tensor | None = None
    graph: Graph | None = None
    pairs: Pairs | None = None


class Painet(Propagator):
    """X0, V0 -> X(1..T) and V(T), equivariant to rotations, reflections, translations and atom order.

    Embeddings start from invariants of the state: element, speed, distance to the centre of mass and the angle between
    the two. A learned vector per frame tells the decoder which one it decodes. Velocities are learned in units of
    `velocity_scale_nm_ps`; `reach` (2,) is what positions and velocities change by over a chunk, in the model's units:
    both are measured on the training frames. The centre of mass moves on at its velocity, exactly: only
    the motion about it is learned, with `free_rotation` that in the frame that turns on with the molecule.
    """

    arch: ClassVar[str] = "painet"
    config: PainetConfig
    velocity_scale_nm_ps: Tensor
    reach: Tensor

    def __init__(self, config: PainetConfig) -> None:
        super().__init__()
        self.config = c = config
        self.embed_type = nn.Embedding(N_TYPES, c.width)
        self.embed_state = nn.Sequential(nn.Linear(3, c.width), nn.SiLU(), nn.Linear(c.width, c.width))
        self.embed_frame = nn.Parameter(torch.randn(c.n_new, c.width) * 0.1)
        n_attention = 0 if c.attention == "none" else c.n_new
        self.steps = nn.ModuleList(EnergyAttention(c, N_TYPES) for _ in range(n_attention))
        if c.n_modes:
            self.surroundings = Surroundings(c.width)
            self.modes = Modes(c.width, c.n_modes, c.n_new)
        self.decoder: Egnn | Leapfrog = Egnn(c.width, c.n_decoder_layers)
        if c.decoder == "leapfrog":
            self.decoder = Leapfrog(c.width, c.n_decoder_layers, c.n_radial, c.n_scalars, c.n_vectors)
        self._known: Structure | None = None
        self.register_buffer("velocity_scale_nm_ps", torch.ones(()))
        self.register_buffer("reach", torch.ones(2))

    def featurise(self, scene: Scene) -> Molecule:
        """See `Propagator.featurise`; `own`: the template (n_atoms, 3) nm, of a model with modes."""
        if not self.config.n_modes:
            return Molecule.of(scene)
        return Molecule.of(scene, torch.tensor(scene.positions_nm - scene.positions_nm.mean(axis=0)).float())

    @property
    def n_conditioning(self) -> int:
        return 1

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
        present = torch.unique(molecule.elements)
        groups = [torch.nonzero(molecule.elements == number).flatten() for number in present]
        all_pairs, template = self.config.edges == "all", None
        if self.config.n_modes:
            if molecule.own is None:
                raise InputError("this model knows a template; make molecules by its `featurise`.")
            template = centred_template(molecule.own, molecule.masses_da, self.config.length_scale_nm)
        bonds = torch.cat([molecule.bonds.T, molecule.bonds.T.flip(0)], dim=1)
        if self._integrates:
            pairs = molecular_pairs(molecule, all_pairs=all_pairs)
            return Structure(molecule, groups, bonds, template, pairs=pairs)
        return Structure(molecule, groups, bonds, template, graph=molecular_graph(molecule, all_pairs=all_pairs))

    def _structure_of(self, molecule: Molecule) -> Structure:
        """`structure`, made once for chunk after chunk of one molecule."""
        if self._known is None or self._known.molecule is not molecule:
            self._known = self.structure(molecule)
        return self._known

    def embed(self, x: Tensor, v: Tensor, elements: Tensor) -> Tensor:
        """H(0) `(b, n, width)` from scaled, centred positions and velocities `(b, n, 3)`."""
        speed, radius = ((t.square().sum(-1) + 1e-6).sqrt() for t in (v, x))
        state = torch.stack([speed, radius, (x * v).sum(-1) / (1.0 + radius)], dim=-1)
        return self.embed_type(elements) + self.embed_state(state)

    def forward(self, positions_nm: Tensor, velocities_nm_ps: Tensor, structure: Structure) -> tuple[Tensor, Tensor]:
        """States `(b, n, 3)` -> positions and velocities `(b, n_new, n, 3)` of all future frames, nm and nm/ps."""
        scale = self.config.length_scale_nm
        share = (structure.molecule.masses_da / structure.molecule.masses_da.sum())[:, None]
        centre, drift = ((share * s).sum(-2, keepdim=True) for s in (positions_nm, velocities_nm_ps))
        x = (positions_nm - centre) / scale
        v = (velocities_nm_ps - drift) / self.velocity_scale_nm_ps
        spin = None
        if self.config.free_rotation:
            spin = angular_velocity(x, v, structure.molecule.masses_da)
            v = v - spun(spin, x)
        # Leapfrog's forces know positions alone.
        seen = torch.zeros_like(v) if self._integrates else v
        h = self.embed(x, seen, structure.molecule.elements)
        latents = []
        for t in range(self.n_new):
            if self.steps:
                h = self.steps[t](h, structure.molecule.elements, structure.groups)
            latents.append(h + self.embed_frame[t])
        frames = torch.stack(latents, dim=1)
        decode = self._integrate if self._integrates else self._decode
        x_new, v_new = decode(frames, x, v, structure)
        if structure.template is not None:
            moved, changed = self._carried(x, v, structure.template, structure)
            x_new, v_new = x_new + self.reach[0] * moved, v_new + self.reach[1] * changed
        x_new, v_new = (s - (share * s).sum(-2, keepdim=True) for s in (x_new, v_new))
        times = self.config.lag_ps * torch.arange(1, self.n_new + 1, device=x.device)
        if spin is not None:
            turn = turns(spin, times * (self.velocity_scale_nm_ps / scale))
            v_new = (v_new + spun(spin, x_new)) @ turn
            x_new = x_new @ turn
        centres = centre[:, None] + times[:, None, None] * drift[:, None]
        return x_new * scale + centres, v_new * self.velocity_scale_nm_ps + drift[:, None]

    def _carried(self, x: Tensor, v: Tensor, template: Tensor, structure: Structure) -> tuple[Tensor, Tensor]:
        """What the modes do to states `(b, n, 3)`: two of `(b, n_new, n, 3)`, always in the precision of the states."""
        with torch.autocast(x.device.type, enabled=False):
            z = self.surroundings(self.embed_type(structure.molecule.elements), structure.bonds)
            return self.modes(z, x, v, template, structure.molecule.masses_da)

    @property
    def _integrates(self) -> bool:
        # Not by the decoder's class: a compiled decoder is of another.
        return self.config.decoder == "leapfrog"

    def _decode(self, frames: Tensor, x: Tensor, v: Tensor, structure: Structure) -> tuple[Tensor, Tensor]:
        """EGNN on latents `(b, n_new, n, width)` and states `(b, n, 3)` -> both `(b, n_new, n, 3)`: so many rows at
        once as keep its messages in the cache."""
        graph = structure.graph
        assert graph is not None
        rows = max(1, MESSAGE_NUMBERS // (self.config.width * max(1, len(graph.receiver))))
        x, v = (s[:, None].expand(-1, self.n_new, -1, -1).flatten(0, 1) for s in (x, v))
        parts = zip(frames.flatten(0, 1).split(rows), x.split(rows), v.split(rows), strict=True)
        found = [self.decoder(*part, graph, self.reach) for part in parts]
        x_new, v_new = (torch.cat([part[k] for part in found]) for k in range(2))
        return x_new.unflatten(0, (-1, self.n_new)), v_new.unflatten(0, (-1, self.n_new))

    def _integrate(self, frames: Tensor, x: Tensor, v: Tensor, structure: Structure) -> tuple[Tensor, Tensor]:
        """The same by the leapfrog decoder, always in the precision of the states: bf16 would round positions."""
        c, pairs, masses = self.config, structure.pairs, structure.molecule.masses_da.to(x.dtype)
        assert pairs is not None
        decoder = cast(Leapfrog, self.decoder)
        with torch.autocast(x.device.type, enabled=False):
            frames = frames.to(x.dtype)
            z = decoder.encode.rounds(self.embed_type(structure.molecule.elements), structure.bonds)
            of = decoder.encode(z, self.embed_frame, pairs)
            # Atoms first, then frames, then the batch.
            h = (frames + z).permute(2, 1, 0, 3).flatten(1, 2)
            x, v = (s.transpose(0, 1)[:, None].expand(-1, c.n_new, -1, -1).flatten(1, 2) for s in (x, v))
            share = torch.arange(1, c.n_new + 1, device=x.device, dtype=x.dtype) / c.n_new
            share = share.repeat_interleave(len(frames))[:, None]
            times = share * (c.chunk_ps * self.velocity_scale_nm_ps / c.length_scale_nm)
            x, v = decoder(h, x, v, times, share * self.reach[1] / masses[:, None, None], pairs, of)
        x, v = (s.unflatten(1, (c.n_new, -1)).permute(2, 1, 0, 3) for s in (x, v))
        return x, v

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Propagator.next_chunk`: one evaluation from velocities that the bath has refreshed."""
        start = self.refreshed(last_velocities_nm_ps, molecule, noise)
        x, v = self(last_frames_nm[:, -1], start, self._structure_of(molecule))
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
        super().__init__(replace(config, attention="none", n_modes=0))
