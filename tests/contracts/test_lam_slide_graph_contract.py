"""The contract of surrogate.models.interface, held against LaM-SLidE that knows atoms by their bonds and the lag."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from surrogate.models.atom_features import features_of_graph
from surrogate.models.conformance import SurrogateContract, branched_chain
from surrogate.models.interface import Molecule, Surrogate
from surrogate.models.lam_slide.codes.atom_tags import MAX_HOPS, bonds_between, hold_hydrogens
from surrogate.models.lam_slide.config import ApproximatorConfig, AutoencoderConfig, GraphConfig, LamSlideConfig
from surrogate.models.lam_slide.model import LamSlide
from systems.errors import InputError


def small_model(*, lags: tuple[float, float] | None = None, graph: bool = True, clean: bool = False,
                latents: str = "set") -> LamSlide:  # fmt: skip
    """A model whose zero-initialised layers are filled, so that every path carries signal."""
    torch.manual_seed(3)
    model = LamSlide(
        LamSlideConfig(
            graph=graph,
            atoms=GraphConfig(width=24, n_rounds=2, latents=latents),
            autoencoder=AutoencoderConfig(n_latents=3, latent_dim=16, width=32, head_dim=8, identifier_pool=512),
            approximator=ApproximatorConfig(chunk_frames=6, latents_per_token=1, width=32, n_layers=2, n_heads=2,
                                            lag_range_ps=lags, clean_conditioning=clean),
        )
    )  # fmt: skip
    with torch.no_grad():
        for name, p in model.named_parameters():
            if p.abs().max() == 0 or "modulation" in name or "offset" in name:
                p.normal_(std=0.3)
    return model.eval().requires_grad_(False)


def chain_with_features(n_atoms: int) -> Molecule:
    """The contract's branched chain, its orders, charges and handedness unlike, on a template of its own."""
    molecule, rng = branched_chain(n_atoms), np.random.default_rng(0)
    bonds = molecule.bonds.numpy()
    features = features_of_graph(
        n_atoms, bonds, rng.choice([0.0, 1.0, 1.5, 2.0], len(bonds)), bonds[:0], rng.integers(-1, 2, n_atoms),
        rng.integers(-1, 2, n_atoms), 0.1 * rng.normal(size=(n_atoms, 3)),
    )  # fmt: skip
    return replace(molecule, atoms=features)


class TestGraph(SurrogateContract):
    permutes = True

    def make(self, n_atoms: int) -> Surrogate:
        return small_model()

    def molecule(self, n_atoms: int) -> Molecule:
        return chain_with_features(n_atoms)


class TestGraphWithLagAndCleanConditioning(TestGraph):
    def make(self, n_atoms: int) -> Surrogate:
        return small_model(lags=(1.0, 1000.0), clean=True)


class TestAtomsAsLatents(TestGraph):
    # One vector of noise for each atom and frame, so that atoms permuted want it permuted, too.
    noise_is_vectors = True

    def make(self, n_atoms: int) -> Surrogate:
        return small_model(latents="atoms")


class TestAtomsAsLatentsWithLagAndCleanConditioning(TestAtomsAsLatents):
    def make(self, n_atoms: int) -> Surrogate:
        return small_model(latents="atoms", lags=(1.0, 1000.0), clean=True)


class TestIdentifiersWithLag(SurrogateContract):
    sizes = (1, 2)

    def make(self, n_atoms: int) -> Surrogate:
        return small_model(graph=False, lags=(1.0, 100.0))


def chunk(model: LamSlide, molecule: Molecule) -> Tensor:
    frames = 0.1 * torch.randn(2, 1, molecule.n_atoms, 3, generator=torch.Generator().manual_seed(1))
    noise = torch.randn(2, *model.noise_shape(molecule.n_atoms), generator=torch.Generator().manual_seed(0))
    return model.next_chunk(frames, molecule, noise, solver_steps=3).frames_nm


@pytest.mark.parametrize("latents", ["set", "atoms"])
def test_everything_that_is_said_of_atoms_and_bonds_matters(latents: str) -> None:
    model, molecule = small_model(latents=latents), chain_with_features(9)
    base, atoms = chunk(model, molecule), molecule.atoms
    assert atoms is not None
    others = {
        "charge": replace(atoms, of_atoms=atoms.of_atoms + torch.eye(9)[2][:, None] * torch.eye(16)[7]),
        "handedness": replace(atoms, of_atoms=atoms.of_atoms + torch.eye(9)[2][:, None] * torch.eye(16)[8]),
        "ring": replace(atoms, of_atoms=atoms.of_atoms + torch.eye(9)[2][:, None] * torch.eye(16)[6]),
        "bond order": replace(atoms, of_bonds=atoms.of_bonds.roll(1, 0)),
        "template": replace(atoms, template_nm=atoms.template_nm * 1.1),
    }
    for name, other in others.items():
        assert (chunk(model, replace(molecule, atoms=other)) - base).abs().max() > 1e-4, name
    rewired = molecule.bonds.clone()
    rewired[-1, 0] = 0
    assert (chunk(model, replace(molecule, bonds=rewired)) - base).abs().max() > 1e-4, "bonds"
    # Masses play no part.
    assert torch.equal(chunk(model, replace(molecule, masses_da=2 * molecule.masses_da)), base)


def test_bonds_between_atoms_of_a_ring_with_a_tail_and_of_a_second_molecule() -> None:
    ring = [[0, 1], [1, 2], [2, 3], [3, 0], [3, 4]]
    hops = bonds_between(torch.tensor([*ring, [5, 6]]), 7)
    assert torch.equal(hops, hops.T)
    assert hops[0].tolist() == [0, 1, 2, 1, 2, MAX_HOPS, MAX_HOPS]
    assert hops[1, 4] == 3 and hops[5].tolist() == [MAX_HOPS] * 5 + [0, 1]
    line = bonds_between(torch.stack([torch.arange(9), torch.arange(1, 10)], dim=1), 10)
    assert line[0].tolist() == [min(k, MAX_HOPS) for k in range(10)]


def test_how_many_bonds_lie_between_atoms_matters_by_itself() -> None:
    model, molecule = small_model(latents="atoms"), chain_with_features(9)
    base = chunk(model, molecule)
    with torch.no_grad():
        for layer in model.approximator.layers:
            layer.of_hops.weight.zero_()
    assert (chunk(model, molecule) - base).abs().max() > 1e-4


def test_latents_that_are_atoms_come_back_as_they_went_in() -> None:
    model, molecule = small_model(latents="atoms"), chain_with_features(9)
    model.latent_scale.fill_(0.7)
    atoms = model.atoms_of(molecule)
    frames = 0.1 * torch.randn(2, 3, 9, 3, generator=torch.Generator().manual_seed(1))
    latents = model.encode(frames, molecule.elements, atoms)
    assert latents.shape == (2, 3, 9, 3)
    torch.testing.assert_close(model.decode(latents, 9, atoms), frames, rtol=0, atol=1e-7)
    rest = torch.zeros(1, 1, 9, 3)
    assert atoms is not None
    torch.testing.assert_close(model.decode(rest, 9, atoms)[0, 0], 0.2 * atoms.template[0], rtol=0, atol=1e-7)
    with pytest.raises(InputError, match="choose set or atoms"):
        LamSlideConfig(atoms=GraphConfig(latents="all"))


def test_hydrogens_are_held_at_the_templates_length_along_the_bond_that_was_drawn() -> None:
    model, molecule = small_model(latents="atoms"), chain_with_features(9)
    assert molecule.atoms is not None
    template = molecule.atoms.template_nm
    ends = [*molecule.bonds.tolist(), *molecule.bonds.flip(1).tolist()]
    degree = [sum(a == k for a, _ in ends) for k in range(9)]
    leaf, parent = next((a, b) for a, b in ends if degree[a] == 1)
    elements = molecule.elements.clone()
    elements[leaf], elements[(inner := max(range(9), key=degree.__getitem__))] = 1, 1
    molecule = replace(molecule, elements=elements)
    free = chunk(model, molecule)
    held = LamSlide(replace(model.config, atoms=replace(model.config.atoms, rigid_hydrogens=True))).eval()
    held.load_state_dict(model.state_dict())
    rigid = chunk(held, molecule)
    drawn, made = (x[..., leaf, :] - x[..., parent, :] for x in (free, rigid))
    length = (template[leaf] - template[parent]).norm()
    torch.testing.assert_close(made.norm(dim=-1), length.expand(made.shape[:-1]), rtol=0, atol=1e-6)
    torch.testing.assert_close(made / length, drawn / drawn.norm(dim=-1, keepdim=True), rtol=0, atol=1e-5)
    assert (drawn.norm(dim=-1) - length).abs().max() > 1e-3, "the control: they were not of that length"
    others = [k for k in range(9) if elements[k] != 1]
    assert torch.equal(rigid[..., [*others, inner], :], free[..., [*others, inner], :]), "all others stay"
    together = free.clone()
    together[..., leaf, :] = together[..., parent, :]
    assert torch.equal(hold_hydrogens(together, molecule)[..., leaf, :], together[..., leaf, :])


def test_equivalent_atoms_are_told_apart_by_the_template_alone() -> None:
    """Without it, the hydrogens of a methyl group would be decoded onto one another."""
    model = small_model()
    bonds = torch.tensor([[0, 1], [0, 2], [0, 3]])
    molecule = Molecule(torch.tensor([6, 1, 1, 1]), torch.ones(4), bonds)
    place = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    none, empty = np.zeros(4), bonds[:0].numpy()
    apart = replace(molecule, atoms=features_of_graph(4, bonds.numpy(), np.ones(3), empty, none, none, place))
    same = replace(molecule, atoms=features_of_graph(4, bonds.numpy(), np.ones(3), empty, none, none, 0 * place))
    z = torch.randn(1, 3, 16, generator=torch.Generator().manual_seed(0))
    of = [model.decode(z, 4, model.atoms_of(m))[0] for m in (apart, same)]
    # Beyond where the template has them: displacements differ, too.
    moved = of[0] - torch.from_numpy(place).float()
    assert (moved[1] - moved[2]).abs().max() > 1e-4
    torch.testing.assert_close(of[1][1], of[1][2], rtol=0, atol=1e-7)


def test_the_lag_changes_the_chunk_and_its_embedding_is_what_does_it() -> None:
    model, molecule = small_model(lags=(1.0, 1000.0)), chain_with_features(7)
    short, long = chunk(model.at_lag(1.0), molecule), chunk(model.at_lag(1000.0), molecule)
    assert torch.equal(chunk(model, molecule), short), "without a word the shortest"
    assert (long - short).abs().max() > 1e-3
    near = chunk(model.at_lag(1.001), molecule)
    assert 0.0 < (near - short).abs().max() < 0.02 * (long - short).abs().max(), "the embedding is smooth"
    conditioning = model.approximator.conditioning
    assert conditioning is not None
    with torch.no_grad():  # the negative control: without the embedding's last layer lags are all alike
        conditioning.of_lag[-1].weight.zero_()
    assert torch.equal(chunk(model.at_lag(1.0), molecule), chunk(model.at_lag(1000.0), molecule))


def test_lags_outside_the_range_and_missing_features_are_refused() -> None:
    model = small_model(lags=(1.0, 1000.0))
    for lag in (0.5, 1001.0):
        with pytest.raises(InputError, match="none that this model was trained for"):
            model.at_lag(lag)
    with pytest.raises(InputError, match="none that this model"):
        small_model().at_lag(1.0)
    with pytest.raises(InputError, match="by their bonds"):
        chunk(model, branched_chain(5))
    with pytest.raises(InputError, match="canonical"):
        LamSlideConfig(graph=True, canonical=False)


def test_configurations_of_earlier_weights_stay_as_they_were() -> None:
    record = LamSlideConfig().to_dict()
    for key in ("graph", "atoms"):
        record.pop(key)
    record["approximator"].pop("lag_range_ps")
    assert LamSlideConfig.from_dict(record) == LamSlideConfig()
    told = replace(LamSlideConfig(), approximator=replace(ApproximatorConfig(), lag_range_ps=(1.0, 10.0)))
    assert LamSlideConfig.from_dict(told.to_dict()) == told
    # No tensor more than before: shipped weights load as they are.
    names = set(LamSlide(LamSlideConfig()).state_dict())
    assert not any("atom_encoder" in name or "conditioning." in name for name in names if "embed" not in name)
