"""The model of peptides, held against the contract of surrogate.models.propagator and against its own arithmetic."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from surrogate.models.conformance import PropagatorContract
from surrogate.models.peptides.chains import MOST_TORSIONS, conditioning_states
from surrogate.models.peptides.layout import PeptideConfig, chain_layout, chain_scale
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.propagator import Chunk, Molecule, Propagator
from systems.errors import InputError
from systems.prepare.peptide import build_peptide
from systems.scene import Scene

SEQUENCES = {22: "ACE-ALA-NME", 33: "ACE-ALA-SER-NME"}


@cache
def scene_of(n_atoms: int) -> Scene:
    return build_peptide(SEQUENCES[n_atoms])


def shaken(scene: Scene, *lead: int) -> Tensor:
    noise = torch.randn(*lead, scene.n_atoms, 3, generator=torch.Generator().manual_seed(4))
    return torch.tensor(scene.positions_nm.tolist()) + 0.003 * noise


@cache
def config() -> PeptideConfig:
    scenes = [scene_of(n) for n in SEQUENCES]
    scale = chain_scale((chain_layout(s), shaken(s, 50).numpy()) for s in scenes)
    types = tuple(sorted({name for s in scenes for name in s.residue_names}))
    return PeptideConfig(width=32, n_layers=2, n_heads=2, chunk_frames=5, types=types, scale=scale)


def small_model(**changes: object) -> PeptideSlide:
    """A model whose zero-initialised layers are filled, so that every path carries signal."""
    torch.manual_seed(3)
    model = PeptideSlide(replace(config(), **changes))
    with torch.no_grad():
        for name, p in model.named_parameters():
            if p.abs().max() == 0 or "modulation" in name or "offset" in name:
                p.normal_(std=0.1)
        model.correlation.copy_(
            torch.linspace(0.9, 0.0, model.correlation.shape[1])[:, None].expand_as(model.correlation)
        )
    return model.eval().requires_grad_(False)


class TestPeptideSlide(PropagatorContract):
    sizes = (22, 33)
    n_atoms = 22

    @pytest.fixture(autouse=True)
    def mirrored_from_anywhere(self, monkeypatch: pytest.MonkeyPatch) -> None:
        # Torsions of a model that learned nothing lie anywhere, and which are drawn again would hang on the last digit.
        monkeypatch.setattr("surrogate.models.peptides.chains._MIRRORED_DEG", 360.0)

    def make(self, n_atoms: int) -> Propagator:
        return small_model()

    def molecule(self, n_atoms: int) -> Molecule:
        found = small_model().featurise(scene_of(n_atoms))
        assert found.own is not None
        # Frames of a model that learned nothing overlap, and which are drawn again would hang on the last digit.
        return replace(found, own=replace(found.own, least_nm=torch.zeros_like(found.own.least_nm)))

    def state(self, n_atoms: int, batch: int, model: Propagator) -> tuple[Tensor, Tensor]:
        scene = scene_of(n_atoms)
        return shaken(scene, batch, 1), torch.zeros(batch, n_atoms, 3)


class TestPeptideSlideAdaptive(TestPeptideSlide):
    """With dopri5: rows do not depend on each other's steps."""

    sizes = (22,)
    # Steps are chosen anew in bf16.
    bf16_error = 0.1

    def call(self, model: Propagator, frames: Tensor, molecule: Molecule, noise: Tensor, velocities: Tensor) -> Chunk:
        with torch.no_grad():
            return model.next_chunk(frames, molecule, noise, solver_steps=1, solver="dopri5")


def test_innovations_come_back_and_have_unit_variance_for_a_process_of_these_correlations() -> None:
    model = small_model()
    types = torch.tensor([2, 3])
    times = torch.tensor([[1.0, 10.0, 100.0]]).expand(20_000, -1)
    rho = model.correlation_at(times[:1], types)
    assert 0.85 < float(rho[0, 0].mean()) < 0.91 and 0.2 < float(rho[0, 2].mean()) < 0.4
    generator = torch.Generator().manual_seed(0)
    n_slots = model.token_mean.shape[-1]
    known = torch.randn(20_000, 2, n_slots, generator=generator)
    later = rho * known[:, None] + (1 - rho**2).sqrt() * torch.randn(20_000, 3, 2, n_slots, generator=generator)
    y = model.innovations(later, known, times, types)
    torch.testing.assert_close(model.from_innovations(y, known, times, types), later, rtol=0, atol=1e-5)
    assert abs(float(y.var()) - 1) < 0.01
    assert abs(float((y[:, 0] * known).mean())) < 0.01
    # Without them the flow is shown the numbers as they are.
    plain = small_model(innovation=False)
    assert torch.equal(plain.innovations(later, known, times, types), later)


def test_time_and_neighbours_and_chain_order_reach_the_flow() -> None:
    model = small_model()
    chain = model.featurise(scene_of(33)).own
    assert chain is not None
    n_slots = model.token_mean.shape[-1]
    o, known = torch.randn(2, 5, 4, n_slots), torch.randn(2, 4, n_slots)
    times = torch.arange(1.0, 6.0).expand(2, -1)
    tau = torch.full((2,), 0.5)
    states = torch.zeros(2, 6, 4, MOST_TORSIONS, dtype=torch.long)
    conditioning, other_states = (conditioning_states(x, chain.stated.counts) for x in (states, 1 - states))

    def found(o: Tensor, *conditioning: Tensor) -> Tensor:
        return model.flow(o, tau, model.flow.conditioning(*conditioning))

    base = found(o, known, times, chain.places, conditioning)
    swapped = chain.places.clone()
    swapped[1, 2] = swapped[2, 2]
    for other in (
        found(o, known, 7 * times, chain.places, conditioning),
        found(o, known, times, swapped, conditioning),
        found(o, known, times, chain.places, other_states),
        found(o.flip(2), known.flip(1), times, chain.places.flip(0), conditioning).flip(2),
    ):
        assert float((other - base).abs().max()) > 1e-3


def test_a_long_lag_makes_shorter_chunks_and_none_beyond_what_was_trained() -> None:
    model = small_model()
    assert model.n_new == 5 and model.at_lag(200.0).n_new == 5 and model.at_lag(500.0).n_new == 2
    assert model.at_lag(501.0).n_new == 20, "frames so far apart are drawn each on its own"
    assert small_model(longest_ps=20.0).at_lag(15.0).n_new == 1, "where training was of short times, they are not"
    with pytest.raises(InputError, match="2000 ps"):
        model.at_lag(2000.0)


def test_a_residue_that_training_never_saw_is_refused() -> None:
    with pytest.raises(InputError, match="GLY"):
        small_model().featurise(build_peptide("ACE-GLY-NME"))
