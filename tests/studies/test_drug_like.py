"""Many molecules in one batch, and labels at half their size: what the study of drug-like molecules trains with."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from drug_like_potential import KJ_MOL_NM_PER_KCAL_MOL_A, Bucket, Labelled, Learner, energies_of_many, load, set_walls
from drug_like_states import RECOMBINED, Entry, file_of, make_compact, read_list
from recorded import Recorded
from torch import nn

from surrogate.models.painet.energy import PotentialConfig, Topology
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.propagator import Molecule

# Ethanol and acetate without its hydrogens: of two sizes, and one with a charge.
ETHANOL = ([6, 6, 8, 1, 1, 1, 1, 1, 1], [(0, 1), (1, 2), (0, 3), (0, 4), (0, 5), (1, 6), (1, 7), (2, 8)], 0)
ACETATE = ([6, 6, 8, 8], [(0, 1), (1, 2), (1, 3)], -1)


def labelled(elements: list[int], bonds: list[tuple[int, int]], charge: int, n: int = 3) -> Labelled:
    generator = torch.Generator().manual_seed(len(elements))
    molecule = Molecule(torch.tensor(elements), torch.ones(len(elements)), torch.tensor(bonds), charge=charge)
    x = 0.15 * torch.randn(n, len(elements), 3, generator=generator)
    forces = 1000.0 * torch.randn(n, len(elements), 3, generator=generator)
    entry = Entry("", "train", "", len(elements), charge)
    return Labelled(entry, Topology.of(molecule), x, torch.randn(n, generator=generator), forces)


def taught_by(teacher: PainetPotential, one: Labelled) -> Labelled:
    """Energies and forces that belong together."""
    with torch.no_grad():
        energies = teacher.members(one.positions_nm, one.topology).mean(-1).float()
    return replace(one, energies=energies, forces=teacher.member_forces(one.positions_nm, one.topology).mean(0).float())


@pytest.fixture
def model() -> PainetPotential:
    return potential(1)


def potential(seed: int) -> PainetPotential:
    torch.manual_seed(seed)
    model = PainetPotential(PotentialConfig(width=16, n_members=2))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter) / max(parameter.shape[-1:] or (1,)) ** 0.5)
    return model


def test_a_batch_of_molecules_has_the_energies_and_forces_of_each(model: PainetPotential) -> None:
    learned = [labelled(*ETHANOL), labelled(*ACETATE)]
    set_walls(model, learned)
    bucket = Bucket.of(learned, torch.ones(2, 2), torch.device("cpu"))
    chosen = torch.tensor([1, 0, 1])
    x = (1.1 * bucket.x[chosen]).requires_grad_(True)  # some of it in the walls
    found = 100.0 * energies_of_many(model.network, bucket, chosen, x)
    (gradient,) = torch.autograd.grad(found[..., 0].sum(), x)
    for k, number in enumerate(chosen.tolist()):
        one = learned[number]
        alone = x[k, :, : one.entry.n_atoms].detach().requires_grad_(True)
        expected = model.members(alone, one.topology)
        (of_alone,) = torch.autograd.grad(expected[:, 0].sum(), alone)
        assert torch.allclose(found[k].double(), expected, atol=1e-3 * expected.std().item())
        assert torch.allclose(gradient[k, :, : one.entry.n_atoms], of_alone, atol=1e-4 * of_alone.std().item())
        assert not gradient[k, :, one.entry.n_atoms :].any()
    neutral = Bucket.of([labelled(*ACETATE[:2], 0)], torch.ones(1, 2), torch.device("cpu"))
    other = 100.0 * energies_of_many(model.network, neutral, torch.tensor([0]), x[:1, :, :4])
    assert (other - found[:1]).abs().min() > 1.0


def test_training_on_a_batch_brings_the_forces_nearer(model: PainetPotential) -> None:
    teacher = potential(2)
    learned = [taught_by(teacher, labelled(*kind, n=8)) for kind in (ETHANOL, ACETATE)]
    learner = Learner(model, learned, learned, 4, 4, torch.device("cpu"))
    optimiser, generator = torch.optim.Adam(model.parameters(), 3e-3), torch.Generator().manual_seed(0)
    before = learner.errors()["validation_force_kcal"]
    for _ in range(60):
        optimiser.zero_grad()
        learner.loss(generator)[0].backward(inputs=[*model.parameters()])
        optimiser.step()
    # Nearer than no forces at all, too.
    none = float(np.mean([float(one.forces.abs().mean()) for one in learned])) / KJ_MOL_NM_PER_KCAL_MOL_A
    assert learner.errors()["validation_force_kcal"] < 0.3 * min(before, none)


def test_compact_labels_are_the_labels(tmp_path) -> None:
    number, entry = next((k, e) for k, e in enumerate(read_list()) if e.split == "test")
    rng = np.random.default_rng(0)
    arrays = {
        "positions_nm": (5.0 + 0.3 * rng.standard_normal((8, entry.n_atoms, 3))).astype(np.float32),
        "energies_kj_mol": rng.standard_normal(8),
        "forces_kj_mol_nm": (1000.0 * rng.standard_normal((8, entry.n_atoms, 3))).astype(np.float32),
        "bonds": np.array([(0, k) for k in range(1, entry.n_atoms)]),
        "numbers": np.full(entry.n_atoms, 6),
        "charges": np.zeros(entry.n_atoms),
    }
    whole = tmp_path / "whole"
    whole.mkdir()
    np.savez(whole / f"{number:04d}.npz", **arrays)
    make_compact(whole, tmp_path / "small")
    (one,), (other,) = load(whole, ["test"]), load(tmp_path / "small", ["test"])
    assert (one.positions_nm.diff(dim=1) - other.positions_nm.diff(dim=1)).abs().max() < 7e-5
    assert (one.forces - other.forces).abs().max() <= 1.01
    assert torch.equal(one.energies, other.energies)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need a GPU")
def test_a_recorded_loss_has_the_gradients_of_one_that_is_not() -> None:
    layer, x = nn.Linear(3, 2).cuda(), torch.randn(5, 3).cuda()
    recorded = Recorded(layer, lambda module, x: module(x).square().mean(), (x,))
    with torch.no_grad():
        layer.weight.mul_(2.0)
    for _ in range(2):
        x = torch.randn(5, 3).cuda()
        layer.zero_grad()
        found = recorded(x)
        found.backward()
        kept = layer.weight.grad.clone()
        layer.zero_grad()
        expected = layer(x).square().mean()
        expected.backward()
        assert torch.allclose(found, expected)
        assert torch.allclose(kept, layer.weight.grad)


def test_states_of_a_potentials_own_md_are_loaded_with_the_others(tmp_path) -> None:
    number, entry = next((k, e) for k, e in enumerate(read_list()) if e.source == RECOMBINED and k % 42 == 0)
    energies = {None: np.linspace(5.0, 6.0, 9), "by": np.array([2.0, *np.full(6, 3.0), 1e6])}
    for by, of_states in energies.items():
        n = len(of_states)
        np.savez(file_of(tmp_path, number, by), positions_nm=np.zeros((n, entry.n_atoms, 3), np.float32),
                 forces_kj_mol_nm=np.zeros((n, entry.n_atoms, 3), np.float32), energies_kj_mol=of_states,
                 bonds=np.array([(0, k) for k in range(1, entry.n_atoms)]), numbers=np.full(entry.n_atoms, 6),
                 charges=np.zeros(entry.n_atoms))  # fmt: skip
    (one,) = load(tmp_path, ["train"])
    # Energies share a zero; the state that nothing comes to is left out.
    assert one.energies.tolist() == pytest.approx([*np.linspace(3.0, 4.0, 9), 0.0, *[1.0] * 6])


def test_no_recombined_molecule_has_the_scaffold_of_one_that_is_held_out() -> None:
    from rdkit.Chem.Scaffolds.MurckoScaffold import MurckoScaffoldSmiles

    entries = read_list()
    made = {MurckoScaffoldSmiles(e.smiles) for e in entries if e.source == RECOMBINED}
    held = {MurckoScaffoldSmiles(e.smiles) for e in entries if e.split != "train"} - {""}
    assert len(made) > 100
    assert not made & held
