"""Bonds to hydrogen held rigid in rollouts of a potential: lengths, momentum, the bath's temperature, energy kept."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from surrogate.models.architecture import weights_path
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.potential import RigidBonds
from surrogate.models.propagator import Molecule
from surrogate.models.weights import load_weights
from systems.scene import Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K


def methyl() -> tuple[Tensor, Tensor, Tensor]:
    """Four bonds that share atoms: three hydrogens on a carbon that is itself bound, as if rigidly, to another atom."""
    x = torch.tensor([[0.0, 0, 0], [0.15, 0, 0], [-0.04, 0.1, 0], [-0.04, -0.05, 0.09], [-0.04, -0.05, -0.09]])
    bonds = torch.tensor([[2, 0], [3, 0], [0, 4], [0, 1]])
    return x.double(), bonds, torch.tensor([12.0, 16.0, 1.0, 1.0, 3.0]).double()


def lengths(x: Tensor, bonds: Tensor) -> Tensor:
    return (x[..., bonds[:, 0], :] - x[..., bonds[:, 1], :]).norm(dim=-1)


def test_disturbed_positions_and_velocities_are_mended_and_momentum_is_kept() -> None:
    rest, bonds, masses = methyl()
    rigid = RigidBonds.of(rest, bonds, masses)
    generator = torch.Generator().manual_seed(0)
    free = rest + 0.01 * torch.randn(50, 5, 3, generator=generator, dtype=torch.float64)
    before = rest + 0.001 * torch.randn(50, 5, 3, generator=generator, dtype=torch.float64)
    found = rigid.place(free, before)
    torch.testing.assert_close(lengths(found, bonds), lengths(rest, bonds).expand(50, -1), rtol=1e-8, atol=0)
    assert float((lengths(free, bonds) - lengths(rest, bonds)).abs().max()) > 0.01
    moved = (masses[:, None] * (found - free)).sum(1)
    torch.testing.assert_close(moved, torch.zeros_like(moved), rtol=0, atol=1e-12)
    v = torch.randn(50, 5, 3, generator=generator, dtype=torch.float64)
    projected = rigid.project(v, found)
    along = (found[:, bonds[:, 0]] - found[:, bonds[:, 1]]) * (projected[:, bonds[:, 0]] - projected[:, bonds[:, 1]])
    assert float(along.sum(-1).abs().max()) < 1e-8
    torch.testing.assert_close((masses[:, None] * projected).sum(1), (masses[:, None] * v).sum(1))
    again = rigid.project(projected, found)
    torch.testing.assert_close(again, projected, rtol=0, atol=1e-8)


@pytest.fixture(scope="module")
def paracetamol() -> tuple[PainetPotential, Scene]:
    weights = load_weights(weights_path("paracetamol-gfn2-xtb"))
    return weights.model, weights.domain.scene


def rolled(model: PainetPotential, scene: Scene, rows: int, seed: int = 0) -> tuple[Tensor, Tensor, Molecule]:
    """Frames `(rows, n_new, n_atoms, 3)` and last velocities of a chunk from the scene's structure."""
    molecule = model.featurise(scene)
    noise = torch.randn(rows, *model.noise_shape(scene.n_atoms), generator=torch.Generator().manual_seed(seed))
    last = torch.tensor(scene.positions_nm).float().expand(rows, 1, -1, -1)
    chunk = model.next_chunk(last, molecule, noise)
    assert chunk.velocities_nm_ps is not None
    return chunk.frames_nm, chunk.velocities_nm_ps, molecule


def test_bonds_to_hydrogen_are_rigid_above_2_fs_alone(paracetamol: tuple[PainetPotential, Scene]) -> None:
    """At 4 fs they are as long in all frames, and as at the minimum; at 2 fs they vibrate."""
    model, scene = paracetamol
    bath = {"timestep_ps": 0.004, "hydrogen_mass_da": 3.0}
    frames, velocities, molecule = rolled(replace_lag(model.in_bath(bath), 0.02, 3), scene, 2)
    bonds = torch.tensor([[i, j] for i, j in scene.bonds.tolist() if "H" in (scene.elements[i], scene.elements[j])])
    found = lengths(frames.double(), bonds)
    torch.testing.assert_close(found, found[:1, :1].expand_as(found), rtol=1e-6, atol=0)
    assert float(found.min()) > 0.094 and float(found.max()) < 0.112
    x, v = frames[:, -1].double(), velocities.double()
    along = ((x[:, bonds[:, 0]] - x[:, bonds[:, 1]]) * (v[:, bonds[:, 0]] - v[:, bonds[:, 1]])).sum(-1)
    # The bath kicks along bonds, too; what is left after a step stays within a few thermal velocities.
    assert float(along.abs().max()) < 0.5 and molecule.own.rigid is not None
    flexible = replace_lag(model.in_bath({**bath, "timestep_ps": 0.002}), 0.02, 3)
    frames, _, molecule = rolled(flexible, scene, 2)
    assert molecule.own.rigid is None and float(lengths(frames, bonds).std(dim=(0, 1)).min()) > 1e-4


def replace_lag(model: PainetPotential, lag_ps: float, n_new: int) -> PainetPotential:
    return model.in_bath({"lag_ps": lag_ps, "n_new": n_new})


def test_rigid_bonds_are_those_of_the_nearest_minimum_which_is_looked_for_once(
    paracetamol: tuple[PainetPotential, Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, scene = copy.deepcopy(paracetamol[0]), paracetamol[1]
    evaluated: list[Tensor] = []
    members = model.members
    monkeypatch.setattr(model, "members", lambda x, *of: evaluated.append(x) or members(x, *of))
    molecule = model.featurise(scene)
    n = len(evaluated)
    assert n > 10
    (at,), forces = evaluated[-1].detach().double(), model.evaluate(evaluated[-1].detach(), molecule)[1]
    assert float(forces.abs().max()) < 30.0 < float(model.evaluate(evaluated[0].detach(), molecule)[1].abs().max())
    assert molecule.own is not None and molecule.own.rigid is not None
    rigid: RigidBonds = molecule.own.rigid
    bonds = torch.stack([rigid.first, rigid.second], dim=1)
    torch.testing.assert_close(lengths(at, bonds), rigid.length2.sqrt().flatten(), rtol=1e-3, atol=0)
    n = len(evaluated)
    model.in_bath({"temperature_k": 400.0}).featurise(scene)
    assert len(evaluated) == n, "kept"
    with torch.no_grad():
        next(model.parameters()).mul_(1.001)
    model.featurise(scene)
    assert len(evaluated) > n, "other weights"
    n = len(evaluated)
    model.featurise(replace(scene, elements=tuple("S" if e == "O" else e for e in scene.elements)))
    assert len(evaluated) > n, "another molecule in the same place"
    n = len(evaluated)
    bent = 0.01 * np.sin(np.arange(3.0 * scene.n_atoms)).reshape(-1, 3)
    model.featurise(scene.with_positions(scene.positions_nm + bent))
    assert len(evaluated) > n, "another structure"


def test_energy_is_kept_at_4_fs_without_a_bath(paracetamol: tuple[PainetPotential, Scene]) -> None:
    """Kinetic and potential energy of a molecule with rigid bonds, whose kinetic energy is that of its motions left."""
    model, scene = paracetamol
    free = replace_lag(
        model.in_bath({"timestep_ps": 0.004, "hydrogen_mass_da": 3.0, "ensemble": "nve"}), 0.004, 1
    )  # fmt: skip
    molecule = free.featurise(scene)
    noise = torch.randn(1, *free.noise_shape(scene.n_atoms), generator=torch.Generator().manual_seed(1))
    masses = free.masses_da(molecule)[:, None]

    def totals(molecule: Molecule, n: int) -> Tensor:
        x, v, found = torch.tensor(scene.positions_nm)[None, None], None, []
        for _ in range(n):
            chunk = free.next_chunk(x, molecule, noise, last_velocities_nm_ps=v)
            x, v = chunk.frames_nm, chunk.velocities_nm_ps
            assert v is not None
            kinetic = 0.5 * (masses * v.double().square()).sum()
            found.append(kinetic + free.evaluate(x[:, -1].double(), molecule).energy_kj_mol[0])
        return torch.stack(found)

    resolved = totals(molecule, 80)[20:]
    # Of the thermal kinetic energy of all atoms.
    bound = 0.02 * 0.5 * GAS_CONSTANT_KJ_MOL_K * 300.0 * 3 * scene.n_atoms
    assert float(resolved.std()) < bound and abs(float(resolved[-20:].mean() - resolved[:20].mean())) < 1.0
    assert float(totals(replace(molecule, own=None), 40).std()) > bound, "with bonds that vibrate it is not"
