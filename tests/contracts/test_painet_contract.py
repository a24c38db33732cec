"""PAINET and its decoder alone, held against the contract and against their own mathematics."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from known_answers import largest_step, pair_energy
from surrogate.models.conformance import PropagatorContract, branched_chain, random_state
from surrogate.models.painet.model import (
    BOND,
    SECOND_NEIGHBOUR,
    EgnnForecaster,
    Painet,
    PainetConfig,
    dense_mean,
    linear_mean,
    molecular_graph,
)
from surrogate.models.propagator import Molecule, Propagator

SMALL = PainetConfig(n_new=3, width=24, n_heads=2, head_dim=8, n_decoder_layers=2)


def lively(config: PainetConfig, kind: type[Painet] = Painet) -> Painet:
    """A model whose small initial weights are made large enough that every path moves atoms."""
    torch.manual_seed(1)
    model = kind(config)
    with torch.no_grad():
        for name, p in model.named_parameters():
            if "factor.2.weight" in name:
                p.normal_(std=0.05)
            elif name.endswith(("e_phi", "e_psi")):
                p.normal_()
    return model.eval().requires_grad_(False)


class TestPainet(PropagatorContract):
    equivariant = reflects = permutes = noise_is_vectors = uses_velocities = True

    def make(self, n_atoms: int) -> Propagator:
        return lively(SMALL)


class TestPainetDense(TestPainet):
    def make(self, n_atoms: int) -> Propagator:
        return lively(replace(SMALL, attention="dense"))


class TestEgnnAlone(TestPainet):
    def make(self, n_atoms: int) -> Propagator:
        return lively(SMALL, EgnnForecaster)


def test_the_factored_attention_equals_the_dense_one() -> None:
    attention = lively(SMALL).steps[0].double()
    molecule = branched_chain(60)
    types = molecule.elements
    present = torch.unique(types)
    groups = [torch.nonzero(types == number).flatten() for number in present]
    q, k, v = torch.randn(3, 2, 60, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.3
    for head in range(2):
        phi, psi = (m[head].double() for m in attention.type_matrices())
        dense = dense_mean(q, k, v, phi[types][:, types], psi[types][:, types])
        linear = linear_mean(q, k, v, phi[present][:, present], psi[present][:, present], groups)
        torch.testing.assert_close(linear, dense, rtol=1e-12, atol=1e-12)
        # Negative control: Psi in Phi's place is another mean.
        swapped = linear_mean(q, k, v, psi[present][:, present], phi[present][:, present], groups)
        assert (swapped - dense).abs().max() > 1e-3


def test_a_model_answers_alike_with_either_form_of_attention() -> None:
    linear, dense = lively(SMALL), lively(replace(SMALL, attention="dense"))
    dense.load_state_dict(linear.state_dict())
    x, v = random_state(60, 2, 1)
    structure = linear.structure(branched_chain(60))
    for first, second in zip(linear(x[:, 0], v, structure), dense(x[:, 0], v, structure), strict=True):
        torch.testing.assert_close(first, second, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("seed", range(6))
def test_an_attention_step_does_not_raise_the_energy_where_that_is_proved(seed: int) -> None:
    """Symmetric phi and psi, psi >= 0 (concave rho), values equal to embeddings, eta up to the proved bound."""
    generator = torch.Generator().manual_seed(seed)
    n = 12
    h = torch.nn.functional.normalize(torch.randn(n, 5, generator=generator, dtype=torch.float64), dim=-1)
    psi = torch.rand(n, n, generator=generator, dtype=torch.float64)
    psi = 0.5 * (psi + psi.T)
    phi = psi + 0.5 * torch.rand(1, generator=generator, dtype=torch.float64)
    a, b = phi + psi, psi / 4
    weights = phi + psi * (h @ h.T)
    mean = dense_mean(h, h, h, phi, psi)
    for smoothness in (0.01, 1.0):
        bound = largest_step(weights, smoothness)
        before = pair_energy(h, h, a, b, smoothness)
        for eta in (0.1 * bound, 0.5 * bound, bound):
            after = pair_energy(h + eta * (mean - h), h, a, b, smoothness)
            assert after <= before + 1e-12, (smoothness, eta)
        # Negative controls: away from the mean, and with the sign of psi's share of the weights turned.
        assert pair_energy(h - 0.5 * bound * (mean - h), h, a, b, smoothness) > before
    # The weights are the derivative of rho at the embeddings' distances.
    squared = (h[:, None] - h[None]).square().sum(-1).requires_grad_()
    (slope,) = torch.autograd.grad((a * squared - b * squared.square()).sum(), squared)
    torch.testing.assert_close(slope, weights, rtol=1e-12, atol=1e-12)


def test_the_decoder_sees_neighbours_only_and_attention_sees_all() -> None:
    """Moving one end of a long chain: messages reach two bonds a layer, attention reaches every atom."""
    model, molecule = lively(SMALL), branched_chain(60)
    structure = model.structure(molecule)
    x, v = random_state(60, 1, 1)
    moved = v.clone()
    moved[0, 59] += 1.0
    h, h_moved = (model.embed(x[:, 0], s, molecule.elements) for s in (v, moved))
    decode = lambda s: model.decoder(h, x[:, 0], s, structure.graph, model.reach)[0]  # noqa: E731
    decoded = decode(v) - decode(moved)
    attend = lambda h: model.steps[0](h, h[..., :0], molecule.elements, structure.groups, dense=False)[0]  # noqa: E731
    attended = attend(h) - attend(h_moved)
    assert decoded[0, :40].abs().max() == 0.0
    assert decoded[0, 59].abs().max() > 1e-3
    assert attended[0, :40].abs().amax(-1).min() > 1e-6


def test_the_centre_of_mass_moves_at_its_velocity_and_momentum_is_kept() -> None:
    model, molecule = lively(SMALL), branched_chain(9)
    x, v = random_state(9, 2, 1)
    frames, velocities = model(x[:, 0], v, model.structure(molecule))
    share = molecule.masses_da / molecule.masses_da.sum()
    centre = lambda s: (share[:, None] * s).sum(-2)  # noqa: E731
    for t in range(3):
        expected = centre(x[:, 0]) + (t + 1) * SMALL.lag_ps * centre(v)
        torch.testing.assert_close(centre(frames[:, t]), expected, rtol=0, atol=1e-6)
        torch.testing.assert_close(centre(velocities[:, t]), centre(v), rtol=0, atol=1e-5)
    # Seen from a moving observer everything moves the other way and nothing else changes.
    boost = torch.tensor([1.0, -2.0, 0.5])
    seen, seen_velocities = model(x[:, 0], v + boost, model.structure(molecule))
    times = SMALL.lag_ps * torch.arange(1, 4)[:, None, None]
    torch.testing.assert_close(seen, frames + times * boost, rtol=0, atol=2e-6)
    torch.testing.assert_close(seen_velocities, velocities + boost, rtol=0, atol=1e-5)


def test_edges_are_bonds_and_second_neighbours() -> None:
    # Propane's carbons with one hydrogen on the end: H0-C1-C2-C3, and a ring of three 4-5-6.
    bonds = torch.tensor([[0, 1], [1, 2], [2, 3], [4, 5], [5, 6], [4, 6]])
    graph = molecular_graph(Molecule(torch.full((8,), 6), torch.ones(8), bonds))
    found = {(int(i), int(j)): int(k) for i, j, k in zip(graph.receiver, graph.sender, graph.kind, strict=True)}
    near = {(0, 1), (1, 2), (2, 3), (4, 5), (5, 6), (4, 6)}
    far = {(0, 2), (1, 3)}
    both = lambda pairs: pairs | {(j, i) for i, j in pairs}  # noqa: E731
    assert {p for p, k in found.items() if k == BOND} == both(near)
    assert {p for p, k in found.items() if k == SECOND_NEIGHBOUR} == both(far)
    assert graph.degree.tolist() == [2, 3, 3, 2, 2, 2, 2, 1], "an atom without edges divides by one"
    everything = molecular_graph(Molecule(torch.full((8,), 6), torch.ones(8), bonds), all_pairs=True)
    assert len(everything.kind) == 56


def test_refreshed_velocities_are_those_of_the_bath() -> None:
    model = lively(replace(SMALL, temperature_k=500.0, friction_per_ps=20.0, lag_ps=0.01))
    molecule = Molecule(torch.tensor([1, 8]), torch.tensor([1.008, 15.999]), torch.zeros((0, 2), dtype=torch.int64))
    noise = torch.randn(200_000, 2, 3, generator=torch.Generator().manual_seed(0))
    kt = 0.00831446 * 500.0
    drawn = model.refreshed(None, molecule, noise)
    again = model.refreshed(drawn, molecule, noise.flip(0))
    for v in (drawn, again):
        energy = (molecule.masses_da[:, None] * v.square()).mean((0, 2))
        torch.testing.assert_close(energy, torch.full((2,), kt), rtol=0.01, atol=0)
    # What is kept of the old velocity falls by friction times the time of the chunk: exp(-20 x 0.03).
    kept = (drawn * again).mean() / drawn.square().mean()
    assert kept == pytest.approx(0.5488, abs=0.01)
    frozen = replace(SMALL, friction_per_ps=0.0)
    assert torch.equal(lively(frozen).refreshed(drawn[:5], molecule, noise[:5]), drawn[:5]), "NVE without friction"


def test_decoding_row_by_row_is_decoding_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    from surrogate.models.painet import model as room

    model, molecule = lively(SMALL), branched_chain(9)
    x, v = random_state(9, 3, 1)
    whole = model(x[:, 0], v, model.structure(molecule))
    calls: list[int] = []
    model.decoder.register_forward_hook(lambda module, given, found: calls.append(len(given[0])))
    monkeypatch.setattr(room, "MESSAGE_NUMBERS", 1)
    single = model(x[:, 0], v, model.structure(molecule))
    assert calls == [1] * 9, "three replicas of three frames, each alone"
    for first, second in zip(whole, single, strict=True):
        torch.testing.assert_close(first, second, rtol=0, atol=1e-6)
