"""LaM-SLidE, both stages joined: frames -> latents -> next latents -> frames."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor, nn

from surrogate.models.interface import Chunk, Molecule, Surrogate
from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.codes.atom_code import AtomCode
from surrogate.models.lam_slide.codes.atom_tags import AtomEncoder, Atoms, Told, bonds_between, hold_hydrogens
from surrogate.models.lam_slide.codes.autoencoder import Autoencoder
from surrogate.models.lam_slide.codes.base import Code
from surrogate.models.lam_slide.codes.residue_autoencoder import ResidueAutoencoder
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.further_noise import REDRAWS, generators
from surrogate.models.lam_slide.kinds import kinds_of_windows
from surrogate.models.lam_slide.transformer import Approximator
from systems.errors import InputError
from systems.imposed import RIGID_BONDS

# Redraws of a chunk that is not of the kind that was drawn. Kinds that a network hardly follows would cost as much
# as all others.
MAX_REDRAWS = 12


def code_of(config: LamSlideConfig) -> Code:
    """Return the code that a configuration asks for: of atoms or residues in a few latents, or the atoms themselves."""
    if config.latents_are_atoms:
        return AtomCode()
    if config.residues is not None:
        return ResidueAutoencoder(config.autoencoder, config.residues, config.position_scale_nm)
    return Autoencoder(config.autoencoder)


class LamSlide(Surrogate):
    """Encoder, approximator and decoder (section 3), behind the contract of `surrogate.models.interface`.

    Latents are used as (z - mean) / scale with a mean per latent component and one common scale, both measured on the
    training frames: LayerNorm bounds their power but leaves constant offsets that carry no information.
    """

    arch: ClassVar[str] = "lam-slide"
    float32_layers: tuple[str, ...] = ("autoencoder.to_position", "approximator.odds")
    config: LamSlideConfig
    latent_mean: Tensor
    latent_scale: Tensor

    def __init__(self, config: LamSlideConfig) -> None:
        super().__init__()
        self.config = config
        self.solvers = flow.solvers_for(config.approximator.interpolant)
        ae = config.autoencoder
        self.atom_encoder = AtomEncoder(config.atoms, ae.identifier_dim) if config.graph else None
        tag_dim = ae.identifier_dim if config.graph else 0
        self.autoencoder = code_of(config)
        n_latents, latent_dim = self.autoencoder.n_latents, self.autoencoder.latent_dim
        self.approximator = Approximator(
            config.approximator, n_latents, latent_dim, tag_dim, of_atoms=config.latents_are_atoms
        )
        # Spacing of the frames that `next_chunk` returns: the shortest of the range, until `at_lag` sets another.
        self.lag_ps = config.approximator.lag_range_ps[0] if config.approximator.lag_range_ps else None
        self.register_buffer("latent_mean", torch.zeros(n_latents, latent_dim))
        self.register_buffer("latent_scale", torch.ones(()))

    @property
    def canonical(self) -> bool:
        return self.config.canonical

    @property
    def n_conditioning(self) -> int:
        return self.config.approximator.n_conditioning

    @property
    def n_new(self) -> int:
        return self.config.approximator.chunk_frames - self.n_conditioning

    def identifiers(self, n_atoms: int) -> Tensor:
        """The canonical assignment `(n_entities,)`: identifier k for the template's atom (or residue) k. Permuting a
        scene's atoms permutes identifiers with them: scenes are matched to the template before they get here."""
        return torch.arange(self.autoencoder.n_entities(n_atoms), device=self.latent_mean.device)

    @property
    def first_stage(self) -> nn.Module | None:
        """What stage one trains and stage two leaves as it is; None where latents are atoms."""
        if self.config.latents_are_atoms:
            return None
        if self.atom_encoder is None:
            return self.autoencoder
        return nn.ModuleDict({"autoencoder": self.autoencoder, "atom_encoder": self.atom_encoder})

    @property
    def second_stage(self) -> nn.Module:
        """What stage two trains."""
        if self.config.latents_are_atoms and self.atom_encoder is not None:
            return nn.ModuleDict({"approximator": self.approximator, "atom_encoder": self.atom_encoder})
        return self.approximator

    def at_lag(self, lag_ps: float) -> LamSlide:
        """Return this model, its weights shared, with frames `lag_ps` apart. Raises InputError outside its range."""
        known = self.config.approximator.lag_range_ps
        if known is None or not known[0] * (1 - 1e-6) <= lag_ps <= known[1] * (1 + 1e-6):
            raise InputError(f"a lag of {lag_ps:g} ps is none that this model was trained for.")
        model = copy.copy(self)
        model.lag_ps = lag_ps
        return model

    @property
    def imposed(self) -> tuple[str, ...]:
        return (RIGID_BONDS,) if self.config.graph and self.config.atoms.rigid_hydrogens else ()

    @property
    def knows_bonds(self) -> bool:
        return self.config.graph

    def atoms_of(self, molecule: Molecule, turns: Tensor | None = None) -> Atoms | None:
        """Return what the network is told of a molecule's atoms, with `turns` (b, 3, 3) in b poses; None of a model
        that goes by identifiers."""
        if self.atom_encoder is None:
            return None
        if molecule.atoms is None:
            raise InputError("this model knows atoms by their bonds; make molecules by `data.descriptions.describe`.")
        template = molecule.atoms.template_nm[None] / self.config.position_scale_nm
        template = template if turns is None else template @ turns.mT
        hops = bonds_between(molecule.bonds, molecule.n_atoms)
        return Atoms(self.atom_encoder(molecule, molecule.atoms, template), template, hops)

    def told(self, atoms: Atoms | None, lag_ps: Tensor | None, rows: int) -> Told | None:
        """Return what the latent flow is told, in so many rows, of the molecule and of the lags `(rows,)` asked for
        (the model's own where None); None of a model that is told neither."""
        conditioning = self.approximator.conditioning
        if conditioning is None:
            return None
        if lag_ps is None and self.lag_ps is not None:
            lag_ps = torch.full((rows,), self.lag_ps, device=self.latent_mean.device)
        whole: Tensor = conditioning(atoms, lag_ps).expand(rows, -1)
        if atoms is None or not self.config.latents_are_atoms:
            return Told(whole)
        return Told(whole, atoms.tags.expand(rows, -1, -1), atoms.hops)

    def encode(self, frames_nm: Tensor, elements: Tensor, atoms: Atoms | None = None) -> Tensor:
        """Frames `(..., n_atoms, 3)` nm -> latents `(..., n_latents, latent_dim)`. `atoms`: of each leading row, or one
        for all."""
        lead, n_atoms = frames_nm.shape[:-2], frames_nm.shape[-2]
        x = frames_nm.reshape(-1, n_atoms, 3).float() / self.config.position_scale_nm
        rows = x.shape[0]
        tags = self.identifiers(n_atoms).expand(rows, -1)
        if atoms is not None:
            each = atoms.spread(lead)
            x, tags = x - each.template, each.tags
        z = self.autoencoder.encode(x, elements.expand(rows, n_atoms), tags)
        return ((z - self.latent_mean) / self.latent_scale).unflatten(0, lead)

    def decode(self, latents: Tensor, n_atoms: int, atoms: Atoms | None = None) -> Tensor:
        """Latents `(..., n_latents, latent_dim)` -> frames `(..., n_atoms, 3)` nm; `atoms` as for `encode`."""
        lead = latents.shape[:-2]
        z = latents.reshape(-1, *latents.shape[-2:]) * self.latent_scale + self.latent_mean
        if atoms is None:
            # Identifiers are those of all frames: what follows from them alone is computed once.
            x = self.autoencoder.decode(z, self.identifiers(n_atoms)[None]).positions
        else:
            each = atoms.spread(lead)
            x = self.autoencoder.decode(z, each.tags).positions + each.template
        return (x * self.config.position_scale_nm).unflatten(0, lead)

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        ae = self.config.autoencoder
        if self.config.latents_are_atoms:
            return (n_atoms, self.config.approximator.chunk_frames, 3)
        return (self.config.approximator.chunk_frames, ae.n_latents, ae.latent_dim)

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 10,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Surrogate.next_chunk`. Velocities play no part."""
        solver = solver or self.solvers[0]
        if solver in flow.ADAPTIVE and len(noise) > 1:
            pairs = zip(last_frames_nm.split(1), noise.split(1), strict=True)
            rows = [self.next_chunk(x, molecule, n, solver_steps=solver_steps, solver=solver) for x, n in pairs]
            mean = sum(row.evaluations or 0.0 for row in rows) / len(rows)
            return Chunk(torch.cat([row.frames_nm for row in rows]), evaluations=mean)
        c = self.config.approximator
        noise = noise.transpose(1, 2) if self.config.latents_are_atoms else noise
        atoms = self.atoms_of(molecule)
        known = self.encode(last_frames_nm, molecule.elements, atoms)
        of_molecule = self.told(atoms, None, len(known))
        kind = self.approximator.draw_kinds(known, noise)
        evaluations = 0.0

        def solve(rows: Tensor, noise: Tensor) -> Tensor:
            told = None if kind is None else kind[rows]
            before = known[rows]
            about = None if of_molecule is None else of_molecule.rows(rows)
            memory = self.approximator.remember(before, about) if c.clean_conditioning else None

            def predict(o: Tensor, tau: Tensor) -> Tensor:
                nonlocal evaluations
                evaluations += len(rows) / len(known)
                return self.approximator(o, tau, before, memory, told, about)

            latents = flow.SOLVERS[solver](predict, noise, solver_steps, c.interpolant)
            frames = self.decode(latents[:, self.n_conditioning :], last_frames_nm.shape[-2], atoms)
            return hold_hydrogens(frames, molecule) if self.config.atoms.rigid_hydrogens else frames

        frames = solve(torch.arange(len(noise), device=noise.device), noise)
        if kind is not None:
            self._hold_to_kinds(frames, last_frames_nm, kind, noise, solve)
        return Chunk(frames, evaluations=evaluations)

    def _hold_to_kinds(self, frames: Tensor, last_frames_nm: Tensor, kind: Tensor, noise: Tensor,
                       solve: Callable[[Tensor, Tensor], Tensor]) -> None:  # fmt: skip
        """Draw the rows of `frames` (b, n_new, n_atoms, 3) that are not of their `kind` again, up to MAX_REDRAWS times.

        What remains of each kind is a plain draw given that kind (rejection sampling), so that rare states are entered
        and left as often as the odds say, however loosely the network follows what it was told.
        """
        kinds = self.config.approximator.rare_kinds
        rows = torch.arange(len(frames), device=frames.device)
        for attempt in range(MAX_REDRAWS + 1):
            windows = torch.cat([last_frames_nm[rows].to(frames.dtype), frames[rows]], dim=1).float().cpu().numpy()
            wrong = torch.from_numpy(kinds_of_windows(windows, kinds)).to(kind.device) != kind[rows]
            rows = rows[wrong]
            if attempt == MAX_REDRAWS or not len(rows):
                return
            drawn = generators(noise[rows], REDRAWS, attempt)
            fresh = torch.stack([torch.randn(noise.shape[1:], generator=g) for g in drawn]).to(noise)
            frames[rows] = solve(rows, fresh).to(frames.dtype)
