"""PAINET's forecaster and its ablations: seeds side by side, and what each method leaves out."""

from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
import torch
from forecaster_ablations import METHODS, build, n_parameters, train
from torch import Tensor

from surrogate.models.painet.model import Painet, PainetConfig, Structure
from surrogate.models.propagator import Molecule

SMALL = PainetConfig(n_new=3, width=16, n_heads=2, head_dim=8, n_decoder_layers=1, attention="dense")


@pytest.fixture
def structure() -> Structure:
    molecule = Molecule(torch.tensor([6, 6, 8, 6, 7]), torch.ones(5), torch.tensor([(0, 1), (1, 2), (2, 3), (3, 4)]))
    return Painet(SMALL).structure(molecule)


def decoded(method: str, structure: Structure, x: Tensor, v: Tensor) -> Tensor:
    torch.manual_seed(3)
    model = build(method, SMALL, structure)
    with torch.no_grad():
        for p in model.parameters():
            p.add_(0.1 * torch.randn_like(p))
        return model.decoded(x, v, structure)[0]


def test_each_method_leaves_out_what_it_says(structure: Structure) -> None:
    x, v = torch.randn(2, 1, 5, 3, generator=torch.Generator().manual_seed(0))
    far = x.clone()
    far[0, 4] += 0.3  # four bonds from the first atom, out of reach of one decoder layer
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
    reach = {}
    for method in METHODS:
        found = decoded(method, structure, x, v)
        assert found.shape == (1, 3, 5, 3)
        turned = decoded(method, structure, x @ turn, v @ turn)
        assert torch.allclose(turned, found @ turn, atol=1e-4) == (method != "mlp")
        reach[method] = float((decoded(method, structure, far, v) - found)[0, 0, 0].abs().max())
    sizes = {method: n_parameters(build(method, SMALL, structure)) for method in METHODS}
    assert sizes["painet"] <= sizes["egnn"] < 1.2 * sizes["painet"]
    assert sizes["none"] < sizes["painet"]
    assert not any(p.requires_grad for n, p in build("fixed", SMALL, structure).named_parameters() if "e_p" in n)
    assert {method for method, moved in reach.items() if moved == 0.0} == {"egnn", "none"}


def test_local_attention_is_of_neighbours_alone(structure: Structure) -> None:
    model = build("local", SMALL, structure)
    h = torch.randn(1, 5, 16, generator=torch.Generator().manual_seed(0)).requires_grad_(True)
    new, _, _ = model.steps[0](h, h[..., :0], structure.molecule.elements, structure.groups, dense=True)
    (gradient,) = torch.autograd.grad(new[0, 0].sum(), h)
    assert gradient[0, :3].abs().sum(-1).gt(0).all()
    assert not gradient[0, 3:].any()


def test_seeds_differ_and_each_of_them_learns(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    start = rng.normal(size=(48, 1, 4, 3))
    v = rng.normal(size=(48, 1, 4, 3))
    times = 0.0625 * np.arange(30)[None, :, None, None]
    frames = np.concatenate([0.1 * start + 0.05 * times * v, 0.05 * v + 0.0 * times], axis=-1).astype(np.float32)
    path = tmp_path / "chain.npz"
    bonds = np.array([(0, 1), (1, 2), (2, 3)])
    np.savez(path, frames=frames, bonds=bonds, numbers=np.array([6, 6, 8, 6]), masses=np.ones(4))

    def errors(seeds: int, steps: int) -> np.ndarray:
        given = Namespace(device="cpu", width=16, seeds=seeds, batch=20, rate=2e-3, steps=steps, patience=10_000,
                          every=steps, ends=float("inf"))  # fmt: skip
        going = train(path, "painet", "s2s", given)
        with pytest.raises(StopIteration) as ended:
            while True:
                next(going)
        return np.array(ended.value.value["error"]) / ended.value.value["frozen"]

    few, many = errors(2, 1), errors(2, 60)
    assert few[0] != pytest.approx(few[1], rel=1e-6)
    assert (many < 0.6 * few).all()
