"""PAINET as a potential: the contract of surrogates, and what a scalar energy with exact forces must keep."""

from __future__ import annotations

import copy
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from known_answers import pair_energy
from surrogate.models.conformance import PotentialContract, branched_chain
from surrogate.models.painet import energy as room
from surrogate.models.painet import simd
from surrogate.models.painet.energy import PotentialConfig, bonded_shells, find_edges, latent_energy
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.painet.simd import simd_potential_of
from surrogate.models.potential import Own, RigidBonds
from surrogate.models.propagator import Molecule, Propagator
from systems.errors import InputError

SMALL = PotentialConfig(width=16, n_radial=8, n_scalars=4, n_vectors=3, n_tensors=2, n_heads=2, head_dim=4,
                        n_members=2, n_new=2, lag_ps=0.002, timestep_ps=0.001, hydrogen_mass_da=None)  # fmt: skip


def lively(config: PotentialConfig = SMALL) -> PainetPotential:
    """A potential whose every path carries signal."""
    torch.manual_seed(1)
    model = PainetPotential(config)
    with torch.no_grad():
        for name, p in model.named_parameters():
            if "table" in name or name.endswith(("e_phi", "e_psi", "latent")):
                p.normal_(std=0.3)
    return model.eval().requires_grad_(False)


def walks(n_atoms: int, rows: int = 2) -> Tensor:
    """Frames `(rows, n_atoms, 3)` nm of chains whose atoms keep their distance."""
    generator = torch.Generator().manual_seed(4)
    along = 0.1 * torch.arange(n_atoms)[:, None] * torch.tensor([1.0, 0.3, 0.0])
    return (along + 0.05 * torch.randn(rows, n_atoms, 3, generator=generator)).double()


class TestPotential(PotentialContract):
    sizes = (1, 2, 80)

    def make(self, n_atoms: int) -> Propagator:
        return lively()

    def state(self, n_atoms: int, batch: int, model: Propagator) -> tuple[Tensor, Tensor]:
        generator = torch.Generator().manual_seed(7)
        x = walks(n_atoms, batch).float()[:, None]
        return x - x.mean(-2, keepdim=True), torch.randn(batch, n_atoms, 3, generator=generator)


class TestWithoutABath(TestPotential):
    # Of the velocities alone, which the test gives.
    uses_noise = False

    def make(self, n_atoms: int) -> Propagator:
        return lively(replace(SMALL, ensemble="nve"))


def evaluated(model: PainetPotential, x: Tensor, molecule: Molecule) -> tuple[Tensor, Tensor]:
    found = model.evaluate(x, molecule)
    return found.energy_kj_mol, found.forces_kj_mol_nm


SIZES = [
    pytest.param(SMALL, id="small"),
    pytest.param(replace(SMALL, n_steps=1, n_members=1, n_vectors=1, n_tensors=1), id="one step"),
    pytest.param(replace(SMALL, n_steps=3, n_heads=3, n_radial=5, width=10), id="three steps"),
    pytest.param(PotentialConfig(), id="as trained"),
]
needs_compiler = pytest.mark.skipif(not (shutil.which("g++") or shutil.which("c++")), reason="no C++ compiler")


@needs_compiler
@pytest.mark.parametrize("config", SIZES)
@pytest.mark.parametrize("rows", [1, 5, 33])
def test_forces_by_simd_are_those_of_torch(config: PotentialConfig, rows: int) -> None:
    molecule, model, x = branched_chain(9), lively(config), walks(9, rows)
    # Walls that some pairs stand in.
    model.network.nearest_nm.fill_(0.12)
    model.network.farthest_nm.fill_(0.4)
    by_simd = model.gradient(x, molecule)
    members, gradient = by_simd(x)
    exact = lively(config)
    exact.load_state_dict(model.state_dict())
    exact = exact.double()
    expected = exact.evaluate(x, molecule)
    scale = expected.forces_kj_mol_nm.abs().mean()
    assert scale > 100.0
    torch.testing.assert_close(members, expected.members_kj_mol, rtol=1e-5, atol=1e-2)
    assert (gradient + expected.forces_kj_mol_nm).abs().max() < 1e-4 * scale
    # A frame does not depend on those beside it.
    torch.testing.assert_close(by_simd(x[:1].repeat(rows, 1, 1))[1][-1], gradient[0], rtol=0, atol=0)
    # Negative control: torch's own single precision is no nearer.
    plain = model.evaluate(x, molecule).forces_kj_mol_nm
    assert 0.0 < (plain - expected.forces_kj_mol_nm).abs().max() < 1e-4 * scale


@needs_compiler
def test_simd_is_finite_where_a_unit_is_as_far_below_zero_as_exponentials_go() -> None:
    """An exponential that overflowed made no number of a quotient, and ended MD."""
    molecule, model, x = branched_chain(9), lively(), walks(9, 16)
    model.network.looks[0].update[0].bias.sub_(torch.linspace(0.0, 200.0, SMALL.width))
    members, gradient = model.gradient(x, molecule)(x)
    exact = lively()
    exact.load_state_dict(model.state_dict())
    expected = exact.double().evaluate(x, molecule)
    torch.testing.assert_close(members, expected.members_kj_mol, rtol=1e-5, atol=1e-2)
    assert (gradient + expected.forces_kj_mol_nm).abs().max() < 1e-4 * expected.forces_kj_mol_nm.abs().mean()


@needs_compiler
@pytest.mark.parametrize("rows", [2, 19])
@pytest.mark.parametrize("timestep_ps", [0.001, 0.004])
def test_steps_by_simd_are_those_of_torch(timestep_ps: float, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(SMALL, timestep_ps=timestep_ps, lag_ps=timestep_ps, hydrogen_mass_da=3.0, friction_per_ps=20.0)
    elements = torch.tensor([6, 6, 8, 1, 1, 1, 1, 1, 1])
    bonds = torch.tensor([(0, 1), (1, 2), (0, 3), (0, 4), (0, 5), (1, 6), (1, 7), (2, 8)])
    generator = torch.Generator().manual_seed(5)
    x = 0.1 * torch.eye(9, 3).cumsum(0) + 0.1 * torch.rand(9, 3, generator=generator)
    x = (x + 0.002 * torch.randn(rows, 9, 3, generator=generator)).double()
    bare = Molecule(elements, torch.where(elements == 1, 1.008, 14.0), bonds)
    masses = lively(config).masses_da(bare)
    rigid = RigidBonds.of(x[0], bonds[2:], masses)
    molecule = Molecule(elements, bare.masses_da, bonds, own=Own(rigid, None))
    is_rigid = timestep_ps > 0.002
    x = rigid.place(x, x) if is_rigid else x
    # A bath of its own for each.
    thermal = (torch.linspace(1.0, 4.0, rows)[:, None, None] / masses[:, None]).sqrt()
    v = thermal * torch.randn(x.shape, generator=generator, dtype=x.dtype)
    draw = torch.randn(rows, 9, 3, 3, generator=generator)

    def moved(model: PainetPotential) -> tuple[Tensor, Tensor]:
        return model.langevin(x, v, molecule, masses[:, None], thermal, draw)

    found = moved(lively(config))
    with monkeypatch.context() as without:
        without.setattr("surrogate.models.painet.painet_potential.simd_potential_of", lambda *_, **__: None)
        expected = moved(lively(config))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-4 * float((other - other.mean(0)).abs().max()))
    assert (expected[0] - x).abs().max() > 1e-3
    off = rigid.length2 - (found[0][:, rigid.first] - found[0][:, rigid.second]).square().sum(-1)
    assert (off.abs().max() < 1e-8 * rigid.length2.max()) == is_rigid
    assert (masses[:, None] * found[1]).sum(1).abs().max() < 1e-6, "at rest as a whole"


@needs_compiler
@pytest.mark.parametrize("rows", [4, 5, 16, 32])
def test_frames_stay_as_they_were_when_the_next_are_made(rows: int) -> None:
    # A whole block of copies lies in memory as the program wants it: it must not be moved on in place.
    molecule, model = branched_chain(9), lively(replace(SMALL, n_new=3))
    start = walks(9, rows).float()[:, None]
    noise = torch.randn(rows, *model.noise_shape(9), generator=torch.Generator().manual_seed(6))
    frames = model.next_chunk(start, molecule, noise).frames_nm
    assert (frames.diff(dim=1).abs().amax((2, 3)) > 1e-5).all()
    one_more = model.next_chunk(start[:1], molecule, noise[:1]).frames_nm
    torch.testing.assert_close(frames[:1], one_more, rtol=0, atol=1e-6)


@needs_compiler
def test_simd_is_for_single_precision_few_atoms_and_a_model_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    def by_simd(model: PainetPotential, n_atoms: int) -> bool:
        x, molecule = walks(n_atoms), branched_chain(n_atoms)
        made = model.network.prepare(topology := model.topology(molecule), x)
        found = simd_potential_of(model.network, topology, made, len(x)) is not None
        torch.testing.assert_close(
            model.forces(x, molecule).float(), evaluated(model, x, molecule)[1].float(), rtol=1e-4, atol=0.05
        )
        return found

    assert by_simd(lively(), 9)
    assert not by_simd(lively().double(), 9) and not by_simd(lively(), 80)
    monkeypatch.setenv("PATH", "")
    simd._program.cache_clear()
    assert not by_simd(lively(), 9), "without a compiler"


@needs_compiler
def test_weights_that_changed_and_copies_are_not_rolled_by_what_was_made_before() -> None:
    molecule, model, x = branched_chain(9), lively(), walks(9)
    before, copied = model.forces(x, molecule), copy.deepcopy(model)
    for changed in (model, copied):
        with torch.no_grad():
            changed.network.table.weight.mul_(0.5)
        changed.train().eval()
        assert (changed.forces(x, molecule) - before).abs().max() > 1.0
        torch.testing.assert_close(
            changed.forces(x, molecule), evaluated(changed, x, molecule)[1], rtol=1e-4, atol=0.01
        )


def test_like_atoms_may_be_exchanged() -> None:
    # Methane: any two hydrogens.
    bonds = torch.tensor([(0, k) for k in range(1, 5)])
    molecule = Molecule(torch.tensor([6, 1, 1, 1, 1]), torch.tensor([12.011, *[1.008] * 4]), bonds)
    model, x = lively().double(), walks(5)
    energy, _ = evaluated(model, x, molecule)
    torch.testing.assert_close(evaluated(model, x[:, [0, 2, 1, 3, 4]], molecule)[0], energy)
    assert (evaluated(model, x[:, [1, 0, 2, 3, 4]], molecule)[0] - energy).abs().min() > 1e-3


def test_total_energy_fluctuates_with_the_square_of_the_step() -> None:
    molecule, n_fs = branched_chain(9), 20
    wobble = {}
    for step_ps in (0.0005, 0.001):
        model = lively(replace(SMALL, ensemble="nve", timestep_ps=step_ps, lag_ps=step_ps,
                               n_new=round(n_fs * 1e-3 / step_ps))).double()  # fmt: skip
        masses = model.masses_da(molecule)[:, None]
        x, v = walks(9)[:1], torch.randn(1, 9, 3, generator=torch.Generator().manual_seed(3)).double() * 0.3
        totals = []
        draw = torch.zeros(1, 9, 1, 3)
        for _ in range(model.n_new):
            x, v = model.verlet(x, v, molecule, masses, masses, draw)
            totals.append(float(evaluated(model, x, molecule)[0]) + float((0.5 * masses * v.square()).sum()))
        wobble[step_ps] = np.std(totals)
    slope = np.log2(wobble[0.001] / wobble[0.0005])
    assert 1.7 < slope < 2.3
    assert wobble[0.0005] > 1e-7


def test_energy_is_finite_and_smooth_where_atoms_meet_and_at_the_cutoff() -> None:
    molecule, model = branched_chain(9), lively().double()
    x = walks(9, 1)
    x[:, 5] = x[:, 3]
    energy, forces = evaluated(model, x, molecule)
    assert torch.isfinite(energy).all() and torch.isfinite(forces).all()
    # Two atoms without a bond, apart by the cutoff more or less: forces fade with the square of what is left.
    pair = Molecule(torch.tensor([8, 6]), torch.tensor([16.0, 12.0]), torch.zeros(0, 2, dtype=torch.int64))
    cutoff = SMALL.cutoff_nm
    distances = cutoff + torch.tensor([0.02, 0.0, -0.002, -0.02, -0.2])
    frames = torch.zeros(5, 2, 3, dtype=torch.float64)
    frames[:, 1, 0] = distances
    radial = room.measure_edges(frames.transpose(0, 1), find_edges({}, frames, cutoff), 8, cutoff, torch.float64).radial
    largest = radial.abs().amax((0, 2))
    assert (largest[:2] == 0.0).all()
    assert largest[2] < 2e-3 * largest[3] < largest[4]
    assert torch.isfinite(evaluated(model, frames, pair)[1]).all()


def test_walls_stand_only_beyond_what_training_saw() -> None:
    molecule, model = branched_chain(9), lively().double()
    x = walks(9, 1)
    free, _ = evaluated(model, x, molecule)
    model.network.nearest_nm.fill_(0.01)
    model.network.farthest_nm.fill_(5.0)
    torch.testing.assert_close(evaluated(model, x, molecule)[0], free, rtol=0, atol=0)
    model.network.nearest_nm.fill_(0.3)
    assert float(evaluated(model, x, molecule)[0] - free) > 100.0


def test_neighbour_lists_and_factored_attention_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    molecule, x = branched_chain(40), walks(40)
    dense = evaluated(lively(replace(SMALL, attention="dense")).double(), x, molecule)
    monkeypatch.setattr(room, "find_edges", lambda shells, frames, cutoff: find_edges(shells, frames, cutoff, few=0))
    factored = evaluated(lively(replace(SMALL, attention="linear")).double(), x, molecule)
    for a, b in zip(dense, factored, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-7)


def test_pairs_grow_with_the_atoms_and_not_with_their_square() -> None:
    counts = {}
    for n in (200, 400):
        molecule = branched_chain(n)
        counts[n] = len(find_edges(bonded_shells(molecule), walks(n, 1), 0.6).shell) / n
    assert counts[400] < 1.1 * counts[200]


def test_latent_energy_is_that_of_the_paper() -> None:
    model, molecule = lively().double(), branched_chain(9)
    topology, step = model.topology(molecule), lively().double().network.steps[0]
    q = torch.nn.functional.normalize(torch.randn(2, 2, 9, 4, dtype=torch.float64), dim=-1)
    phi, psi = step.type_matrices()
    found = latent_energy(q, phi, psi, topology)
    types = molecule.elements
    for head in range(2):
        b = 0.25 * psi[head][types][:, types]
        a = phi[head][types][:, types] + 4.0 * b
        paper = pair_energy(q[:, head], q[:, head], a, b, 1.0) / 81
        torch.testing.assert_close(found[:, head], paper)


def test_members_agree_with_the_potential_and_differ_from_each_other() -> None:
    molecule, model = branched_chain(9), lively().double()
    x = walks(9)
    _, forces = evaluated(model, x, molecule)
    members = model.member_forces(x, model.topology(molecule))
    torch.testing.assert_close(members.mean(0), forces)
    assert (members[0] - members[1]).abs().max() > 1.0


@pytest.mark.parametrize("charge", [-1, 1])
def test_a_charge_changes_energies_and_none_changes_nothing(charge: int) -> None:
    model, neutral, x = lively(), branched_chain(9), walks(9)
    ion = replace(neutral, charge=charge)
    energies = {one.charge: model.energies(x, one) for one in (neutral, ion)}
    assert not torch.allclose(energies[0], energies[charge], rtol=1e-3)
    members, gradient = model.gradient(x, ion)(x)
    torch.testing.assert_close(members, energies[charge], rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(-gradient, model.evaluate(x, ion).forces_kj_mol_nm, rtol=1e-3, atol=0.5)
    with torch.no_grad():
        model.network.embed_type.weight[0] += 1.0
    assert torch.equal(model.energies(x, replace(neutral)), energies[0])
    assert not torch.equal(model.energies(x, replace(ion)), energies[charge])
    order = torch.randperm(9)
    assert ion.permuted(order).charge == ion.to(torch.device("cpu")).charge == charge


def test_impossible_settings_are_refused() -> None:
    for wrong in ({"ensemble": "npt"}, {"attention": "sparse"}, {"n_members": 0}, {"n_radial": 1}, {"step": 1.0}):
        with pytest.raises(InputError):
            PotentialConfig(**wrong)
    heavy = Molecule(torch.tensor([90]), torch.tensor([232.0]), torch.zeros(0, 2, dtype=torch.int64))
    with pytest.raises(InputError, match="90"):
        lively().topology(heavy)


def test_heavy_hydrogens_take_their_mass_from_their_neighbours() -> None:
    water = Molecule(torch.tensor([1, 8, 1]), torch.tensor([1.008, 15.999, 1.008]), torch.tensor([(0, 1), (1, 2)]))
    masses = lively(replace(SMALL, hydrogen_mass_da=3.0)).masses_da(water)
    assert masses.tolist() == pytest.approx([3.0, 18.015 - 6.0, 3.0], abs=1e-5)
    assert lively().masses_da(water).tolist() == pytest.approx([1.008, 15.999, 1.008], abs=1e-5)
