"""The leapfrog decoder: what it keeps whatever it has learned, and the pairs its forces run along."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from surrogate.models.conformance import branched_chain, random_state
from surrogate.models.painet import attention as pairs_module
from surrogate.models.painet.attention import molecular_pairs
from surrogate.models.painet.decoders import RadialFunctions
from surrogate.models.painet.model import Painet, PainetConfig
from surrogate.models.propagator import Molecule
from systems.errors import InputError

CONFIG = PainetConfig(n_new=2, width=16, n_heads=2, head_dim=8, n_decoder_layers=3, decoder="leapfrog", edges="all",
                      n_radial=6, n_scalars=3, n_vectors=2)  # fmt: skip


def fresh(config: PainetConfig = CONFIG) -> Painet:
    torch.manual_seed(2)
    return Painet(config).double().eval().requires_grad_(False)


def lively(config: PainetConfig = CONFIG) -> Painet:
    model = fresh(config)
    for name, p in model.named_parameters():
        if name.endswith(("table.weight", "to_force.weight")):
            p.normal_(std=0.3)
    return model


def state(n_atoms: int, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    x, v = random_state(n_atoms, batch, 1)
    return x[:, 0].double(), v.double()


def test_before_it_has_learned_anything_atoms_fly_straight_on() -> None:
    model, molecule = fresh(), branched_chain(7)
    x, v = state(7)
    frames, velocities = model(x, v, model.structure(molecule))
    times = CONFIG.lag_ps * torch.arange(1, 3, dtype=torch.float64)[:, None, None]
    torch.testing.assert_close(frames, x[:, None] + times * v[:, None], rtol=0, atol=1e-8)
    torch.testing.assert_close(velocities, v[:, None].expand_as(velocities), rtol=0, atol=1e-6)
    # Negative control.
    moved, _ = lively()(x, v, model.structure(molecule))
    assert (moved - frames).abs().max() > 1e-5


def test_momentum_and_angular_momentum_are_kept_whatever_it_has_learned() -> None:
    model, molecule = lively(), branched_chain(9)
    masses = molecule.masses_da.double()[:, None]
    x, v = state(9)
    frames, velocities = model(x, v, model.structure(molecule))
    momentum = lambda u: (masses * u).sum(-2)  # noqa: E731
    turning = lambda y, u: (masses * torch.linalg.cross(y, u)).sum(-2)  # noqa: E731
    for t in range(2):
        torch.testing.assert_close(momentum(velocities[:, t]), momentum(v), rtol=0, atol=1e-5)
        torch.testing.assert_close(turning(frames[:, t], velocities[:, t]), turning(x, v), rtol=0, atol=1e-5)
    # Negative control: the decoder of the paper keeps the first and not the second.
    free = Painet(replace(CONFIG, decoder="egnn")).double().eval().requires_grad_(False)
    for name, p in free.named_parameters():
        if "factor.2.weight" in name:
            p.normal_(std=0.3)
    frames, velocities = free(x, v, free.structure(molecule))
    assert (turning(frames[:, -1], velocities[:, -1]) - turning(x, v)).abs().max() > 1e-3


def test_radial_functions_have_the_derivative_they_say() -> None:
    d = torch.linspace(0.85, 2.4, 11, dtype=torch.float64).requires_grad_()
    start, spacing = torch.full((11,), -0.2, dtype=torch.float64), torch.full((11,), 0.1, dtype=torch.float64)
    functions = lambda s: RadialFunctions.apply(s[:, None], start, spacing, 8)  # noqa: E731
    assert torch.autograd.gradcheck(functions, (d,))
    assert (functions(d) > 0).any(-1).any(-1).sum() >= 8


def test_pairs_are_told_by_the_bonds_between_and_sums_agree_however_they_are_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # 0-1-2-3-4 with 5 on 1, and 6 by itself.
    bonds = torch.tensor([[0, 1], [1, 2], [2, 3], [3, 4], [1, 5]])
    molecule = Molecule(torch.full((7,), 6), torch.ones(7), bonds)
    near = molecular_pairs(molecule, all_pairs=False)
    shells = {(int(i), int(j)): int(k) for i, j, k in zip(near.first, near.second, near.shell, strict=True)}
    assert shells == {
        (0, 1): 0, (1, 2): 0, (2, 3): 0, (3, 4): 0, (1, 5): 0,
        (0, 2): 1, (1, 3): 1, (2, 4): 1, (0, 5): 1, (2, 5): 1,
        (0, 3): 2, (1, 4): 2, (3, 5): 2,
    }  # fmt: skip
    every = molecular_pairs(molecule, all_pairs=True)
    assert len(every.first) == 21 and every.n_near == 13
    assert set(every.shell[13:].tolist()) == {3}
    monkeypatch.setattr(pairs_module, "DENSE_NUMBERS", 0)
    scattered = molecular_pairs(molecule, all_pairs=True)
    assert scattered.signed is None
    x = torch.randn(7, 4, 3, dtype=torch.float64)
    values = torch.randn(21, 4, 3, dtype=torch.float64)
    torch.testing.assert_close(every.differences(x), scattered.differences(x))
    torch.testing.assert_close(every.opposed_sums(values, 7), scattered.opposed_sums(values, 7))
    ends = (values[:13], values[:13] ** 2)
    torch.testing.assert_close(every.end_sums(*ends, 7), scattered.end_sums(*ends, 7))
    assert every.opposed_sums(values, 7).sum(0).abs().max() < 1e-12
    assert (every.end_sums(*ends, 7) - every.end_sums(*ends[::-1], 7)).abs().max() > 0.1


def test_unknown_decoders_and_sizes_are_refused(tmp_path: Path) -> None:
    for wrong, said in (({"decoder": "verlet"}, "egnn or leapfrog"), ({"n_radial": 1}, "at least 2")):
        with pytest.raises(InputError, match=said):
            PainetConfig.from_dict(wrong)
