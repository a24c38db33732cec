"""Modes of motion over the whole molecule, and its free rotation: what this project adds to PAINET for one state's
forecasts (`forecasters.py`).

To first order in its excursions a molecule's future is linear in its state, x(t) = <x> + A(t) (x - <x>) + B(t) v, with
all pairs of atoms in A and B: normal modes. Attention between scalar embeddings cannot carry vectors, and EGNN's
messages carry no neighbour's velocity. Here every atom has a row in each mode, known from its surroundings and its
place in the template; amplitudes are sums over atoms, and what they do to each later frame is one number per mode and
frame, the cosine and sine of a normal mode if that were all there is. The cost is linear in atoms. Superposing the
molecule on its template makes it exactly equivariant to rotations and translations; reflections are distinguished.
Where groups turn freely (a methyl on a ring) a linear map in one frame does not help.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from surrogate.models.painet.energy import Surroundings
from surrogate.models.painet.model import Painet, PainetConfig, Structure
from surrogate.models.propagator import Molecule
from systems.errors import InputError
from systems.scene import Scene


@dataclass(frozen=True)
class ModalConfig(PainetConfig):
    """PAINET's settings with `n_modes` modes of motion, 0 for none; `free_rotation` takes the rotation of the whole
    out of what is learned."""

    n_modes: int = 0
    free_rotation: bool = False


class ModalPainet(Painet):
    """PAINET with modes beside attention and decoder, and a frame that turns on with the molecule."""

    config: ModalConfig

    def __init__(self, config: ModalConfig) -> None:
        super().__init__(config)
        if config.n_modes:
            self.surroundings = Surroundings(config.width)
            self.modes = Modes(config.width, config.n_modes, config.n_new)

    def featurise(self, scene: Scene) -> Molecule:
        """See `Propagator.featurise`; `own`: the template (n_atoms, 3) nm, of a model with modes."""
        if not self.config.n_modes:
            return Molecule.of(scene)
        return Molecule.of(scene, torch.tensor(scene.positions_nm - scene.positions_nm.mean(axis=0)).float())

    def moved(self, x: Tensor, v: Tensor, structure: Structure) -> tuple[Tensor, Tensor]:
        """See `Painet.moved`."""
        molecule, spin = structure.molecule, None
        if self.config.free_rotation:
            spin = angular_velocity(x, v, molecule.masses_da)
            v = v - spun(spin, x)
        x_new, v_new = self.decoded(x, v, structure)
        if self.config.n_modes and (template := self._template(molecule)) is not None:
            bonds = torch.cat([molecule.bonds.T, molecule.bonds.T.flip(0)], dim=1)
            with torch.autocast(x.device.type, enabled=False):
                z = self.surroundings(self.embed_type(molecule.elements), bonds)
                moved, changed = self.modes(z, x, v, template, molecule.masses_da)
            x_new, v_new = x_new + self.reach[0] * moved, v_new + self.reach[1] * changed
        x_new, v_new = (structure.centred(s)[0] for s in (x_new, v_new))
        if spin is None:
            return x_new, v_new
        times = self.config.lag_ps * torch.arange(1, self.n_new + 1, device=x.device)
        turn = turns(spin, times * (self.velocity_scale_nm_ps / self.config.length_scale_nm))
        return x_new @ turn, (v_new + spun(spin, x_new)) @ turn

    def _template(self, molecule: Molecule) -> Tensor | None:
        if molecule.own is None:
            raise InputError("this model knows a template; make molecules by its `featurise`.")
        return centred_template(molecule.own, molecule.masses_da, self.config.length_scale_nm)


class ModalEgnn(ModalPainet):
    """The decoder alone, with free rotation where that is asked for."""

    arch = "egnn"

    def __init__(self, config: ModalConfig) -> None:
        super().__init__(replace(config, attention="none", n_modes=0))


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
