"""Crossings of phi's barrier: odds that are learned by log-likelihood, and draws that follow them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from small_scenes import with_phi_turned
from surrogate.data.features.peptide_chains import chain_features
from surrogate.models.peptides.model import PeptideConfig, PeptideSlide
from surrogate.models.peptides.phi_signs import (
    PhiCrossings,
    crossing_loss,
    draw_sides,
    is_positive,
    sides_of,
    times_apart,
)
from systems.chemistry.geometry import torsion
from systems.prepare.peptide import build_peptide


def test_strands_that_reach_across_180_degrees_are_not_left_handed() -> None:
    phi = torch.tensor([-170.0, -60.0, -1.0, 1.0, 60.0, 129.0, 131.0, 179.0])
    assert is_positive(torch.deg2rad(phi)).tolist() == [False, False, False, True, True, True, False, False]


def test_the_sides_of_frames_are_those_of_their_torsions() -> None:
    """Glycine has none; strands whose phi is turned by half a circle are left-handed."""
    scene = build_peptide("ACE-GLY-VAL-ALA-NME")
    chain = chain_features(scene, _config(scene))
    assert chain.signed.tolist() == [2, 3]
    both = np.stack([scene.positions_nm, with_phi_turned(scene)])
    phi = torsion(both, chain.phi_quads.numpy())
    expected = (phi > 0) & (phi < np.radians(130.0))
    assert expected.any(axis=0).all() and not expected.all(axis=0).any()
    found = chain.positive_phi(torch.tensor(both))
    assert found.shape == (2, 5) and not found[:, [0, 1, 4]].any()
    np.testing.assert_array_equal(found[:, 2:4], expected)
    assert sides_of(found[:, None], chain.signed)[:, 0, 1].tolist() == [0.0, 0.0]
    assert torch.equal(sides_of(found[:, None], chain.signed)[:, 0, 2] > 0, found[:, 2])


def _config(scene: object) -> PeptideConfig:
    from surrogate.data.features.peptide_chains import chain_layout, chain_scale
    from systems.scene import Scene

    assert isinstance(scene, Scene)
    layout = chain_layout(scene)
    rng = np.random.default_rng(0)
    frames = (scene.positions_nm + 0.002 * rng.normal(size=(50, scene.n_atoms, 3))).astype(np.float32)
    return PeptideConfig(
        width=16, n_layers=1, n_heads=1, chunk_frames=4, types=tuple(sorted(set(layout.types))),
        scale=chain_scale([(layout, frames)]),
    )  # fmt: skip


def test_the_loss_is_the_negative_log_likelihood_of_what_was_done() -> None:
    logits = torch.zeros(1, 2, 2, 2)
    logits[0, :, 0] = torch.tensor([-2.0, 1.0])
    positive = torch.tensor([[[False, True], [True, True], [True, False]]])
    # Residue 0 crosses from below, then stays above; residue 1 does not count.
    expected = -np.log(1 / (1 + np.exp(2.0))) - np.log(1 - 1 / (1 + np.exp(-1.0)))
    found = crossing_loss(logits, positive, torch.tensor([[1.0, 0.0]]))
    assert float(found) == pytest.approx(expected / 2, rel=1e-5)


def test_draws_leave_and_enter_as_often_as_their_odds_say() -> None:
    logits = torch.tensor([0.02, 0.3]).logit().expand(400, 200, 1, 2)
    uniform = torch.rand(400, 200, 1, generator=torch.Generator().manual_seed(0))
    drawn = draw_sides(logits, torch.zeros(400, 1, dtype=torch.bool), uniform)
    assert drawn.shape == (400, 200, 1)
    before, after = drawn[:, :-1], drawn[:, 1:]
    assert float((~before & after).sum() / (~before).sum()) == pytest.approx(0.02, rel=0.1)
    assert float((before & ~after).sum() / before.sum()) == pytest.approx(0.3, rel=0.1)


def test_times_between_frames_and_endless_ones() -> None:
    times = torch.tensor([[1.0, 3.0, 7.0], [1e4, 1e4, 1e4]])
    assert times_apart(times, 1e4).tolist() == [[1.0, 2.0, 4.0], [1e4, 1e4, 1e4]]


def test_rates_of_two_residue_types_are_learned() -> None:
    """One type leaves phi > 0 ten times as often as the other; frames of 1 and of 10 ps, odds accordingly."""
    torch.manual_seed(0)
    net = PhiCrossings(6, 4)
    places = torch.tensor([[2, 0, 3], [3, 2, 1]])
    leaves = torch.tensor([0.002, 0.02])
    optimiser = torch.optim.Adam(net.parameters(), lr=0.01)
    generator = torch.Generator().manual_seed(1)
    for _ in range(300):
        times = torch.where(torch.rand(256, 1, generator=generator) < 0.5, 1.0, 10.0) * torch.arange(1, 5)
        apart = times_apart(times, 1e4)
        crossed = torch.rand(256, 4, 2, generator=generator) < leaves * apart[..., None]
        positive = torch.cat([torch.ones(256, 1, 2, dtype=torch.bool), ~crossed], 1)
        positive[:, :-1] = True  # each frame's odds by themselves
        both = torch.stack([positive[:, :-1], ~crossed], dim=2).flatten(0, 1)
        known = torch.randn(256, 2, 6, generator=generator)
        logits = net(known, places, times, apart)
        loss = crossing_loss(logits.flatten(0, 1)[:, None], both, torch.ones(len(both), 2))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    for apart_ps in (1.0, 10.0):
        times = torch.tensor([[apart_ps]])
        odds = net(torch.zeros(1, 2, 6), places, times, times)[0, 0, :, 1].sigmoid()
        np.testing.assert_allclose(odds.detach(), leaves * apart_ps, rtol=0.35)


def test_a_chunk_is_drawn_again_where_it_disobeys_and_rows_do_not_depend_on_others() -> None:
    """The flow returns its noise, whose phi is as often wrong as right: with the odds at nothing, nearly all frames of
    one residue stay on the given side after drawing again, and a row alone is drawn as it is in a batch."""
    from surrogate.data.descriptions import describe
    from surrogate.models.peptides import model as module

    scene = build_peptide("ACE-ALA-NME")
    torch.manual_seed(0)
    model = PeptideSlide(_config(scene)).eval().requires_grad_(False)
    model.lag_ps = 1.0
    torch.nn.init.constant_(model.crossings.logits.bias, -30.0)
    molecule = describe(model, scene)
    chain = molecule.chain
    assert chain is not None
    last = torch.tensor(scene.positions_nm).float().expand(60, 1, -1, -1)
    noise = torch.randn(60, *model.noise_shape(scene.n_atoms), generator=torch.Generator().manual_seed(3))
    own = bool(chain.positive_phi(last[0, 0])[1])
    shares = []
    for most in (0, module.MAX_REDRAWS):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "MAX_REDRAWS", most)
            frames = model.next_chunk(last, molecule, noise, solver_steps=2).frames_nm
        obeys = (chain.positive_phi(frames)[..., 1] == own).all(dim=1)
        shares.append(float(obeys.float().mean()))
    assert shares[0] < 0.7 and shares[1] > shares[0] + 0.15
    alone = model.next_chunk(last[7:8], molecule, noise[7:8], solver_steps=2).frames_nm
    torch.testing.assert_close(alone[0], frames[7], rtol=0, atol=1e-5)


def test_hydrogens_named_either_way_stay_where_the_given_frame_has_them() -> None:
    """In the data HB2 and HB3 of serine stand on either side of its torsion; with one name they would not be kept."""
    from dataclasses import replace

    from surrogate.data.descriptions import describe

    scene = build_peptide("ACE-SER-NME")
    config = _config(scene)
    assert config.scale is not None
    wide = {key: 1.0 if key.startswith("SER dihedral HB") else value for key, value in config.scale.deviation.items()}
    torch.manual_seed(0)
    last = torch.tensor(scene.positions_nm).float().expand(2, 1, -1, -1)
    between = []
    for deviation in (wide, config.scale.deviation):
        model = PeptideSlide(replace(config, scale=replace(config.scale, deviation=deviation)))
        model = model.eval().requires_grad_(False)
        model.lag_ps = 1.0
        molecule = describe(model, scene)
        assert molecule.chain is not None
        kept = molecule.chain.code.kept
        assert int(kept.sum()) == (2 if deviation is wide else 0) and not kept[[0, 2]].any()
        noise = torch.randn(2, *model.noise_shape(scene.n_atoms), generator=torch.Generator().manual_seed(3))
        frames = model.next_chunk(last, molecule, noise, solver_steps=2).frames_nm[0].double().numpy()
        at = {name: i for i, name in enumerate(scene.atom_names) if scene.residue_of_atom[i] == 1}
        quads = [[at[name], at["CB"], at["CA"], at["OG"]] for name in ("HB2", "HB3")]
        between.append(
            np.abs(np.angle(np.exp(1j * (torsion(frames, quads) - torsion(scene.positions_nm, quads))))).max()
        )
    assert between[0] < 1e-3 < between[1]
