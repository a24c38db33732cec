"""The contract of surrogate.models.interface for LaM-SLidE on heavy atoms, and with residues as entities."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from surrogate.models.conformance import SurrogateContract
from surrogate.models.hydrogens import HydrogenPlan, Site
from surrogate.models.interface import Molecule, Surrogate, draw_noise
from surrogate.models.lam_slide.codes.residue_code import N_SLOTS, RESIDUE_TYPES, ResidueLayout
from surrogate.models.lam_slide.config import ApproximatorConfig, AutoencoderConfig, LamSlideConfig
from surrogate.models.lam_slide.heavy_atoms import HeavyLamSlide
from systems.errors import InputError

CONFIG = LamSlideConfig(
    hydrogens="placed",
    autoencoder=AutoencoderConfig(n_latents=3, latent_dim=16, width=32, head_dim=8, identifier_pool=512),
    approximator=ApproximatorConfig(chunk_frames=6, latents_per_token=1, width=32, n_layers=2, n_heads=2),
)


def n_heavy(n_atoms: int) -> int:
    return n_atoms if n_atoms < 5 else (n_atoms + 1) // 2


def chain(n_atoms: int) -> Molecule:
    """A chain of carbons with a hydrogen on each but perhaps the last; four atoms or fewer have none."""
    m = n_heavy(n_atoms)
    bonds = [(k, k + 1) for k in range(m - 1)] + [(k - m, k) for k in range(m, n_atoms)]
    elements = torch.tensor([6] * m + [1] * (n_atoms - m))
    return Molecule(
        elements, torch.where(elements == 6, 12.011, 1.008), torch.tensor(bonds, dtype=torch.int64).reshape(-1, 2)
    )


def plan(n_atoms: int) -> HydrogenPlan:
    m = n_heavy(n_atoms)

    def site(k: int) -> Site:
        if 0 < k < m - 1:
            return Site(k, (m + k,), (k - 1, k + 1), turns=False)
        around = (1, 2) if k == 0 else (m - 2, m - 3)
        return Site(k, (m + k,), around, turns=True)

    return HydrogenPlan(n_atoms, tuple(site(k) for k in range(n_atoms - m)))


def filled(config: LamSlideConfig) -> HeavyLamSlide:
    """A model whose every path carries signal, hydrogens included."""
    torch.manual_seed(3)
    model = HeavyLamSlide(config)
    with torch.no_grad():
        for name, p in model.named_parameters():
            if p.abs().max() == 0 or "modulation" in name or "offset" in name:
                p.normal_(std=0.3)
        for group in model.hydrogens.groups:
            group.shape.copy_(torch.rand(group.shape.shape) + 0.5)
            group.swing.copy_(0.01 * torch.rand(group.swing.shape))
            mostly_stays = 0.9 * torch.eye(group.n_states) + 0.1 / group.n_states
            group.moves.copy_(mostly_stays.expand(group.moves.shape))
    return model.eval().requires_grad_(False)


class TestHeavyLamSlide(SurrogateContract):
    # Hydrogens hang on directions between atoms, which errors of their own size turn.
    bf16_error = 0.06

    def make(self, n_atoms: int) -> Surrogate:
        return filled(replace(CONFIG, hydrogen_plan=plan(n_atoms)))

    def molecule(self, n_atoms: int) -> Molecule:
        return chain(n_atoms)


def layout(n_atoms: int) -> ResidueLayout:
    rows = [list(range(start, min(start + N_SLOTS, n_atoms))) for start in range(0, n_atoms, N_SLOTS)]
    return ResidueLayout(
        n_atoms,
        tuple(k % len(RESIDUE_TYPES) for k in range(len(rows))),
        tuple(tuple(row + [-1] * (N_SLOTS - len(row))) for row in rows),
        ((0, 1, 2),) if n_atoms > 2 else (),
        ((0, 1, 2, 3),) if n_atoms > 3 else (),
    )


class TestResidueLamSlide(SurrogateContract):
    bf16_error = 0.06

    def make(self, n_atoms: int) -> Surrogate:
        heavy = n_heavy(n_atoms)
        return filled(replace(CONFIG, entities="residue", hydrogen_plan=plan(n_atoms), residues=layout(heavy)))

    def molecule(self, n_atoms: int) -> Molecule:
        return chain(n_atoms)


def test_hydrogens_follow_the_heavy_atoms_of_their_own_frame() -> None:
    model = filled(replace(CONFIG, hydrogen_plan=plan(9)))
    frames = torch.randn(2, 1, 9, 3, generator=torch.Generator().manual_seed(0)) * 0.2
    noise = draw_noise(model, 9, [torch.Generator().manual_seed(s) for s in range(2)])
    chunk = model.next_chunk(frames, chain(9), noise, solver_steps=3).frames_nm
    bonds = chunk[:, :, 5:] - chunk[:, :, :4]
    torch.testing.assert_close(bonds.norm(dim=-1), torch.full(bonds.shape[:-1], 0.1), atol=1e-6, rtol=0)
    # Heavy atoms are what the network says of heavy atoms: hydrogens of the last frame do not reach it.
    other = frames.clone()
    other[:, :, 5:] += 0.3
    again = model.next_chunk(other, chain(9), noise, solver_steps=3).frames_nm
    assert torch.equal(again[:, :, :5], chunk[:, :, :5])
    assert (again[:, :, 5:] - chunk[:, :, 5:]).abs().max() > 1e-3, "rotors go on from the last frame"


def test_models_of_heavy_atoms_refuse_what_they_cannot_do() -> None:
    with pytest.raises(InputError, match="training finds it"):
        HeavyLamSlide(CONFIG)
    model = filled(replace(CONFIG, hydrogen_plan=plan(9)))
    with pytest.raises(InputError, match="among 9 atoms, not 7"):
        model.next_chunk(torch.zeros(1, 1, 7, 3), chain(7), torch.zeros(1, *model.noise_shape(7)))
    with pytest.raises(InputError, match="choose modelled or placed"):
        replace(CONFIG, hydrogens="some")
    with pytest.raises(InputError, match="choose atom or residue"):
        replace(CONFIG, entities="chain")
    with pytest.raises(InputError, match="for one alone"):
        replace(CONFIG, graph=True)
