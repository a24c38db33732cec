"""The contracts of `surrogate.models.propagator` and `.potential` as tests that any model inherits.

    class TestMyModel(PropagatorContract):
        def make(self, n_atoms: int) -> Propagator: ...

A claim that a model does not make (`equivariant`, `uses_noise`, ...) is switched off in the subclass.
"""

from __future__ import annotations

import json
from typing import ClassVar

import torch
from torch import Tensor

from surrogate.models.architecture import architecture
from surrogate.models.potential import Potential
from surrogate.models.propagator import Chunk, Molecule, Propagator, draw_noise

# Positions in nm: what float32 arithmetic on coordinates of this size may differ by.
ROUNDING_NM = 2e-6


def branched_chain(n_atoms: int) -> Molecule:
    """Return a molecule of H, C, N and O in which every fourth atom hangs on the one two before it."""
    elements = torch.tensor([(6, 7, 1, 8, 1)[k % 5] for k in range(n_atoms)])
    masses = torch.tensor([(12.011, 14.007, 1.008, 15.999, 1.008)[k % 5] for k in range(n_atoms)])
    bonds = [(k - 2 if k % 4 == 3 else k - 1, k) for k in range(1, n_atoms)]
    return Molecule(elements, masses, torch.tensor(bonds, dtype=torch.int64).reshape(-1, 2))


def random_state(n_atoms: int, batch: int, n_frames: int, seed: int = 5) -> tuple[Tensor, Tensor]:
    """Return frames `(batch, n_frames, n_atoms, 3)` nm of unlike shapes, centred, and velocities nm/ps."""
    generator = torch.Generator().manual_seed(seed)
    walk = torch.randn(batch, 1, n_atoms, 3, generator=generator).cumsum(2) * 0.05
    frames = walk + 0.01 * torch.randn(batch, n_frames, n_atoms, 3, generator=generator)
    return frames - frames.mean(-2, keepdim=True), torch.randn(batch, n_atoms, 3, generator=generator)


def orthogonal(*, reflect: bool) -> Tensor:
    """Return a rotation `(3, 3)`, with `reflect` times a reflection."""
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(11), dtype=torch.float64))
    q = q * torch.sign(torch.diagonal(r))
    return q * (torch.sign(torch.linalg.det(q)) * (-1.0 if reflect else 1.0))


class PropagatorContract:
    """Every test of the contract. `sizes`: atom counts tried; `n_atoms`: that of the other tests."""

    sizes: ClassVar[tuple[int, ...]] = (1, 2, 500)
    n_atoms: ClassVar[int] = 9
    # Whether frames, velocities and noise turned, reflected, shifted or permuted give chunks that are so too.
    equivariant: ClassVar[bool] = False
    reflects: ClassVar[bool] = False
    permutes: ClassVar[bool] = False
    # Whether noise turns with the frames, because it is one vector per atom.
    noise_is_vectors: ClassVar[bool] = False
    uses_noise: ClassVar[bool] = True
    uses_frames: ClassVar[bool] = True
    uses_velocities: ClassVar[bool] = False
    # Largest error under bf16 autocast, as a share of the frames' deviation from the last known one; None: no network.
    bf16_error: ClassVar[float | None] = 0.03

    def make(self, n_atoms: int) -> Propagator:
        """Return a model in evaluation mode whose every path carries signal, able to take `n_atoms` atoms."""
        raise NotImplementedError

    def molecule(self, n_atoms: int) -> Molecule:
        return branched_chain(n_atoms)

    def state(self, n_atoms: int, batch: int, model: Propagator) -> tuple[Tensor, Tensor]:
        return random_state(n_atoms, batch, model.n_conditioning)

    def call(self, model: Propagator, frames: Tensor, molecule: Molecule, noise: Tensor, velocities: Tensor) -> Chunk:
        with torch.no_grad():
            return model.next_chunk(frames, molecule, noise, solver_steps=4, last_velocities_nm_ps=velocities)

    def given(self, batch: int = 3, n_atoms: int = 0) -> tuple[Propagator, Tensor, Molecule, Tensor, Tensor]:
        n_atoms = n_atoms or self.n_atoms
        model = self.make(n_atoms)
        frames, velocities = self.state(n_atoms, batch, model)
        noise = draw_noise(model, n_atoms, [torch.Generator().manual_seed(s) for s in range(batch)])
        return model, frames, self.molecule(n_atoms), noise, velocities

    def test_chunks_have_their_shape_for_every_size(self) -> None:
        for n_atoms in self.sizes:
            model, frames, molecule, noise, velocities = self.given(2, n_atoms)
            chunk = self.call(model, frames, molecule, noise, velocities)
            assert chunk.frames_nm.shape == (2, model.n_new, n_atoms, 3), f"{n_atoms} atoms: {chunk.frames_nm.shape}"
            assert chunk.frames_nm.dtype == torch.float32, f"frames are {chunk.frames_nm.dtype}"
            assert torch.isfinite(chunk.frames_nm).all(), f"{n_atoms} atoms: frames are not finite"
            assert (chunk.velocities_nm_ps is not None) == self.uses_velocities
            if chunk.velocities_nm_ps is not None:
                assert chunk.velocities_nm_ps.shape == (2, n_atoms, 3)
                assert torch.isfinite(chunk.velocities_nm_ps).all()

    def test_the_same_inputs_give_the_same_chunk_and_stay_as_they_are(self) -> None:
        model, frames, molecule, noise, velocities = self.given()
        inputs = (frames, noise, velocities, molecule.elements, molecule.masses_da, molecule.bonds)
        before = [t.clone() for t in inputs]
        first = self.call(model, frames, molecule, noise, velocities)
        second = self.call(model, frames, molecule, noise, velocities)
        assert torch.equal(first.frames_nm, second.frames_nm), "two calls with the same noise differ"
        for old, new in zip(before, inputs, strict=True):
            assert torch.equal(old, new), "an input was changed"

    def test_a_row_does_not_depend_on_its_batch(self) -> None:
        model, frames, molecule, noise, velocities = self.given()
        together = self.call(model, frames, molecule, noise, velocities)
        for k in range(len(frames)):
            row = slice(k, k + 1)
            alone = self.call(model, frames[row], molecule, noise[row], velocities[row])
            torch.testing.assert_close(alone.frames_nm[0], together.frames_nm[k], rtol=0, atol=ROUNDING_NM)
        if self.uses_frames or self.uses_noise:
            assert (together.frames_nm[0] - together.frames_nm[1]).abs().max() > 1e-4, "rows do not differ at all"

    def test_what_the_model_claims_to_use_matters(self) -> None:
        model, frames, molecule, noise, velocities = self.given()
        base = self.call(model, frames, molecule, noise, velocities).frames_nm
        other_noise = self.call(model, frames, molecule, noise.flip(0) + 0.3, velocities).frames_nm
        other_frames = self.call(model, frames.roll(1, 0), molecule, noise, velocities).frames_nm
        assert ((base - other_noise).abs().max() > 1e-5) == self.uses_noise, "noise"
        assert ((base - other_frames).abs().max() > 1e-5) == self.uses_frames, "frames"
        other = self.call(model, frames, molecule, noise, velocities.roll(1, 0)).frames_nm
        assert ((base - other).abs().max() > 1e-4) == self.uses_velocities, "velocities"

    def test_turned_and_shifted_frames_give_turned_and_shifted_chunks(self) -> None:
        if not self.equivariant:
            return
        model, frames, molecule, noise, velocities = self.given()
        base = self.call(model, frames, molecule, noise, velocities)
        for reflect in (False, True) if self.reflects else (False,):
            turn = orthogonal(reflect=reflect).float()
            shift = torch.tensor([0.3, -0.2, 0.5])
            turned_noise = noise @ turn.T if self.noise_is_vectors else noise
            moved = self.call(model, frames @ turn.T + shift, molecule, turned_noise, velocities @ turn.T)
            # Rounding grows with what the layers compute: a few float32 units of the largest coordinate.
            size = 10 * ROUNDING_NM * max(1.0, float(base.frames_nm.abs().max()))
            torch.testing.assert_close(moved.frames_nm, base.frames_nm @ turn.T + shift, rtol=0, atol=size)
            if base.velocities_nm_ps is not None and moved.velocities_nm_ps is not None:
                torch.testing.assert_close(moved.velocities_nm_ps, base.velocities_nm_ps @ turn.T, rtol=2e-5, atol=2e-5)
            assert (moved.frames_nm - base.frames_nm - shift).abs().max() > 1e-3, "the control did not turn"

    def test_permuted_atoms_give_permuted_chunks(self) -> None:
        if not self.permutes:
            return
        model, frames, molecule, noise, velocities = self.given()
        order = torch.randperm(self.n_atoms, generator=torch.Generator().manual_seed(2))
        base = self.call(model, frames, molecule, noise, velocities).frames_nm
        permuted_noise = noise[:, order] if self.noise_is_vectors else noise
        args = (frames[:, :, order], molecule.permuted(order), permuted_noise, velocities[:, order])
        permuted = self.call(model, *args).frames_nm
        torch.testing.assert_close(permuted, base[:, :, order], rtol=0, atol=10 * ROUNDING_NM)
        assert (permuted - base).abs().max() > 1e-3, "the control did not permute"

    def test_bf16_stays_close_to_fp32(self) -> None:
        if self.bf16_error is None:
            return
        model, frames, molecule, noise, velocities = self.given()
        exact = self.call(model, frames, molecule, noise, velocities).frames_nm
        with torch.autocast("cpu", dtype=torch.bfloat16):
            rough = self.call(model, frames, molecule, noise, velocities).frames_nm
        assert rough.dtype == torch.float32, f"frames are {rough.dtype} under autocast"
        scale = (exact - frames[:, -1:]).square().mean().sqrt()
        error = float((rough - exact).square().mean().sqrt() / scale)
        assert 0.0 < error < self.bf16_error, f"relative error under bf16 is {error:.3g}, allowed {self.bf16_error:g}"

    def test_configuration_and_tensors_rebuild_the_model(self) -> None:
        model, frames, molecule, noise, velocities = self.given()
        known = architecture(model.arch)
        again = known.model(known.config(json.loads(json.dumps(model.config.to_dict()))))
        again.load_state_dict(model.state_dict())
        again.eval()
        first, second = (self.call(m, frames, molecule, noise, velocities) for m in (model, again))
        assert torch.equal(first.frames_nm, second.frames_nm), "a rebuilt model answers differently"


class PotentialContract(PropagatorContract):
    """What a potential owes beside what any propagator does."""

    uses_velocities = True
    equivariant = reflects = permutes = noise_is_vectors = True
    # Always in the precision of its weights, as bf16 would make steps of energies.
    bf16_error = None
    # Largest error of a force against the energy's finite differences, as a share of the largest force.
    force_error: ClassVar[float] = 1e-5

    def potential(self) -> tuple[Potential, Tensor, Molecule]:
        """Return a potential in double precision, and frames `(3, n_atoms, 3)` nm of a molecule."""
        model = self.make(self.n_atoms).double()
        assert isinstance(model, Potential)
        return model, self.state(self.n_atoms, 3, model)[0][:, -1].double(), self.molecule(self.n_atoms)

    def test_forces_are_the_gradient_of_the_energy(self) -> None:
        model, x, molecule = self.potential()
        found = model.evaluate(x, molecule)
        assert found.members_kj_mol.shape[0] == len(x) and found.energy_kj_mol.dtype == torch.float64
        torch.testing.assert_close(found.members_kj_mol.mean(-1), found.energy_kj_mol)
        step, largest = 1e-5, float(found.forces_kj_mol_nm.abs().max())
        for atom in (0, self.n_atoms - 1):
            shift = torch.zeros_like(x)
            shift[:, atom, 1] = step
            ahead, behind = (model.evaluate(x + sign * shift, molecule).energy_kj_mol for sign in (1.0, -1.0))
            off = (behind - ahead) / (2.0 * step) - found.forces_kj_mol_nm[:, atom, 1]
            assert float(off.abs().max()) < self.force_error * largest, f"atom {atom}: forces are no gradient"
        assert largest > 1.0, "the control feels no force"

    def test_energy_is_a_scalar_and_momentum_and_angular_momentum_are_kept(self) -> None:
        model, x, molecule = self.potential()
        found, turn = model.evaluate(x, molecule), orthogonal(reflect=True)
        moved = model.evaluate(x @ turn.T + torch.tensor([1.0, -2.0, 0.5]), molecule)
        torch.testing.assert_close(moved.energy_kj_mol, found.energy_kj_mol, rtol=1e-10, atol=1e-8)
        forces = found.forces_kj_mol_nm
        torch.testing.assert_close(moved.forces_kj_mol_nm, forces @ turn.T, rtol=1e-8, atol=1e-7)
        assert forces.sum(1).abs().max() < 1e-8 * forces.abs().max(), "forces have a sum"
        assert torch.linalg.cross(x, forces).sum(1).abs().max() < 1e-8 * forces.abs().max(), "forces have a torque"
        # Negative controls: single torques do not vanish; a squeezed molecule has another energy.
        assert torch.linalg.cross(x, forces).abs().max() > 1e-2 * forces.abs().max()
        assert (model.evaluate(0.98 * x, molecule).energy_kj_mol - found.energy_kj_mol).abs().min() > 1e-3
