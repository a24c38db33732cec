"""Modes of motion and free rotation, what this project adds to PAINET: exact where mechanics is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from painet_modes import (
    ModalConfig,
    ModalPainet,
    Modes,
    angular_velocity,
    centred_template,
    spun,
    superposing_turns,
    turns,
)

from surrogate.models.conformance import PropagatorContract, branched_chain, orthogonal, random_state
from surrogate.models.propagator import Molecule, Propagator
from systems.errors import InputError

SMALL = ModalConfig(n_new=3, width=16, n_heads=2, head_dim=8, n_decoder_layers=1, n_modes=8)


def lively(config: ModalConfig) -> ModalPainet:
    """A model whose small initial weights are made large enough that every path moves atoms."""
    torch.manual_seed(1)
    model = ModalPainet(config)
    with torch.no_grad():
        for name, p in model.named_parameters():
            if "factor.2.weight" in name:
                p.normal_(std=0.05)
    return model.eval().requires_grad_(False)


class TestPainetWithModes(PropagatorContract):
    """A frame of the molecule's own tells it from its mirror image."""

    equivariant = permutes = noise_is_vectors = uses_velocities = True
    sizes = (1, 2, 40)

    def make(self, n_atoms: int) -> Propagator:
        return lively(replace(SMALL, width=24, n_decoder_layers=2, n_modes=6, free_rotation=True))

    def molecule(self, n_atoms: int) -> Molecule:
        return replace(branched_chain(n_atoms), own=random_state(n_atoms, 1, 1, seed=8)[0][0, 0])

    def test_configuration_and_tensors_rebuild_the_model(self) -> None:
        """The study's settings are not among the architecture's."""


def body(n_atoms: int = 7) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions `(1, n, 3)` about the centre of mass, and masses, in float64."""
    generator = torch.Generator().manual_seed(3)
    x = torch.randn(1, n_atoms, 3, generator=generator, dtype=torch.float64)
    masses = 1.0 + torch.rand(n_atoms, generator=generator, dtype=torch.float64)
    return x - (masses / masses.sum()) @ x, masses


def with_template(molecule: Molecule, template_nm: np.ndarray) -> Molecule:
    return replace(molecule, own=torch.tensor(template_nm, dtype=torch.float32))


def test_a_rigid_body_turns_as_its_angular_velocity_says() -> None:
    x, masses = body()
    omega = torch.tensor([[0.7, -1.3, 0.4]], dtype=torch.float64)
    v = spun(omega, x)
    torch.testing.assert_close(angular_velocity(x, v, masses), omega, rtol=1e-4, atol=1e-4)
    # About a fixed axis a point follows the solution of x' = omega x x, here by small steps.
    times = torch.tensor([0.1, 0.5], dtype=torch.float64)
    turned = x[:, None] @ turns(omega, times)
    stepped, n = x.clone(), 20_000
    for _ in range(n):
        middle = stepped + 0.25 / n * spun(omega, stepped)
        stepped = stepped + 0.5 / n * spun(omega, middle)
    torch.testing.assert_close(turned[:, 1], stepped, rtol=1e-6, atol=1e-6)
    assert (turned[:, 1] - x[:, None] @ turns(-omega, times)[:, 1]).abs().max() > 0.5, "turned the other way"


def test_a_model_leaves_rotation_to_mechanics() -> None:
    """A molecule whose atoms only turn about a principal axis is forecast almost exactly before any training."""
    torch.manual_seed(0)
    x, masses = body()
    _, axes = torch.linalg.eigh(torch.einsum("n,bni,bnj->ij", masses, x, x))
    v = spun(20.0 * axes[:, 2][None], x)
    molecule = replace(branched_chain(7), masses_da=masses.float())
    errors = {}
    for free in (True, False):
        model = ModalPainet(replace(SMALL, n_modes=0, free_rotation=free, lag_ps=0.01)).eval()
        model.set_scales(10.0, 0.01, 1.0)
        with torch.no_grad():
            found, velocities = model(0.1 * x.float(), 0.1 * v.float(), model.structure(molecule))
        turn = turns(20.0 * axes[:, 2][None], 0.01 * torch.arange(1, 4, dtype=torch.float64))
        errors[free] = (
            float((found.double() - 0.1 * x[:, None] @ turn).abs().max()),
            float((velocities.double() - 0.1 * v[:, None] @ turn).abs().max()),
        )
    assert errors[True][0] < 0.03 * errors[False][0]
    assert errors[True][1] < 0.1 * errors[False][1]


@pytest.mark.parametrize("n_atoms", [1, 2])
def test_atoms_and_lines_have_no_frame_and_no_modes(n_atoms: int) -> None:
    molecule = with_template(branched_chain(n_atoms), np.arange(3.0 * n_atoms).reshape(-1, 3))
    model = ModalPainet(replace(SMALL, free_rotation=True)).eval()
    structure = model.structure(molecule)
    x, v = random_state(n_atoms, 2, 1)
    assert all(torch.isfinite(found).all() for found in model(x[:, 0], v, structure))
    line = torch.arange(4.0)[:, None] * torch.tensor([1.0, 2.0, -1.0])
    assert centred_template(line, torch.ones(4), 0.1) is None
    assert centred_template(line + 0.1 * torch.eye(4, 3), torch.ones(4), 0.1) is not None


def test_superposing_turns_bring_a_turned_molecule_back() -> None:
    x, masses = body()
    for reflect in (False, True):
        turn = orthogonal(reflect=reflect)
        found = superposing_turns(x @ turn.T, x[0], masses)
        torch.testing.assert_close(torch.linalg.det(found), torch.ones(1, dtype=torch.float64))
        assert torch.allclose(x @ turn.T @ found, x, atol=1e-10) != reflect, "a mirror image is not turned into itself"


def test_a_molecule_without_a_template_is_refused() -> None:
    with pytest.raises(InputError, match="knows a template"):
        lively(SMALL).moved(torch.zeros(1, 5, 3), torch.zeros(1, 5, 3), lively(SMALL).structure(branched_chain(5)))


def test_modes_learn_a_molecule_that_is_harmonic() -> None:
    """The future of springs is linear in excursions and velocities, with as many modes as the molecule has."""
    torch.manual_seed(1)
    n, times, masses = 4, torch.tensor([0.4, 0.8])[:, None, None], torch.ones(4)
    template = torch.randn(n, 3)
    template -= template.mean(0)
    rigid = torch.cat([torch.eye(3).repeat(n, 1), torch.cat([spun(torch.eye(3)[k][None], template[None])[0].flatten()
                                                             [:, None] for k in range(3)], 1)], 1)  # fmt: skip
    # Six vibrations: a basis of all that neither moves nor turns the whole, under stiffnesses of their own.
    vibrations = torch.linalg.svd(rigid)[0][:, 6:] @ torch.linalg.qr(torch.randn(3 * n - 6, 3 * n - 6))[0]
    omega = torch.linspace(1.0, 3.0, 3 * n - 6)
    z, modes = torch.randn(n, 16), Modes(16, 24, len(times))
    optimiser = torch.optim.Adam(modes.parameters(), 5e-3)

    def loss_and_size(rows: int) -> tuple[torch.Tensor, torch.Tensor]:
        p, s = 0.1 * torch.randn(rows, 3 * n - 6), 0.2 * torch.randn(rows, 3 * n - 6)
        off, v, moved = (
            (amplitudes @ vibrations.T).unflatten(-1, (n, 3))
            for amplitudes in (p, s, p * torch.cos(omega * times) + s / omega * torch.sin(omega * times) - p)
        )
        found, _ = modes(z, template + off, v, template, masses)
        return (found - moved.transpose(0, 1)).square().mean(), moved.square().mean()

    for _ in range(300):
        loss, size = loss_and_size(64)
        optimiser.zero_grad()
        (loss / size).backward()
        optimiser.step()
    loss, size = loss_and_size(512)
    assert loss < 0.02 * size
