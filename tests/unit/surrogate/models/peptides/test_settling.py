"""Frames set right by small turns: torsions mirrored at the end of their states, overlapping atoms turned apart."""

from __future__ import annotations

import pytest
import torch

from surrogate.models.peptides import chains as settling
from surrogate.models.peptides.chains import (
    MOST_TORSIONS,
    PHI,
    PSI,
    RING,
    THREEFOLD,
    ChainFeatures,
    StatedTorsions,
    dihedral,
    mended,
    mirrored,
)
from surrogate.models.peptides.layout import PeptideConfig, chain_features, chain_layout, chain_scale
from systems.prepare.peptide import build_peptide
from systems.scene import Scene


@pytest.mark.parametrize(
    ("kind", "state", "drawn", "expected"),
    [
        (PHI, 0, [-60.0, 5.0, 29.0, -5.0, 125.0, 131.0], [-60.0, -5.05, -29.05, -5.0, 135.05, 131.0]),
        (PHI, 1, [60.0, -5.0, 140.0, -29.0], [60.0, 5.05, 119.95, 29.05]),
        (PSI, 0, [80.0, 70.0, -121.0, -110.0], [80.0, 80.05, -121.0, -130.05]),
        (THREEFOLD, 2, [-60.0, 10.0, -130.0], [-60.0, -10.05, -109.95]),
        (RING, 1, [-90.0, 20.0, 170.0], [-90.0, -20.05, -169.95]),
    ],
)
def test_a_torsion_a_little_beyond_its_state_is_mirrored(
    kind: tuple[float, tuple[float, float]], state: int, drawn: list[float], expected: list[float]
) -> None:
    stated = StatedTorsions.of([([0, 1, 2, 3], 0, 1, kind)], 1)
    states = torch.zeros(len(drawn), 1, MOST_TORSIONS, dtype=torch.long)
    states[:, 0, 1] = state
    found, far = mirrored(torch.tensor(drawn).deg2rad()[:, None], states, stated)
    turned = (found[:, 0].rad2deg() - torch.tensor(expected) + 180.0) % 360.0 - 180.0
    torch.testing.assert_close(turned, torch.zeros(len(drawn)), rtol=0, atol=1e-3)
    assert not far.any()
    assert (stated.states(found)[:, 0, 1] == state).all()


def test_a_torsion_far_beyond_its_state_is_left_to_be_drawn_again() -> None:
    stated = StatedTorsions.of([([0, 1, 2, 3], 0, 0, PHI)], 1)
    angles = torch.tensor([31.0, 90.0]).deg2rad()[:, None]
    found, far = mirrored(angles, torch.zeros(2, 1, MOST_TORSIONS, dtype=torch.long), stated)
    assert far.tolist() == [[True], [True]] and torch.equal(found, angles)


@pytest.fixture(scope="module")
def crowded() -> tuple[ChainFeatures, torch.Tensor, torch.Tensor]:
    """Lysine and glutamate with torsions at random, of which a good part overlap; each in the states that it is in."""
    scene = build_peptide("ACE-LYS-GLU-NME")
    chain = chain_features(scene, _config(scene))
    tokens = chain.code.encode(torch.tensor(scene.positions_nm).float()).expand(200, -1, -1).clone()
    at, flat = chain.code.turning_at, tokens.flatten(-2)
    angles = torch.atan2(flat[:, at + 1], flat[:, at])
    angles = angles + 0.9 * torch.randn(angles.shape, generator=torch.Generator().manual_seed(0))
    tokens = settling._with_torsions(tokens, at, angles)
    return chain, tokens, chain.states(chain.code.decode(tokens))


def test_overlapping_atoms_are_turned_apart_and_nothing_else_is(
    crowded: tuple[ChainFeatures, torch.Tensor, torch.Tensor],
) -> None:
    chain, tokens, states = crowded
    before = chain.code.decode(tokens)
    overlap = chain.overlap(before)
    assert 0.2 < overlap.float().mean() < 0.9
    with torch.inference_mode():  # as in rollouts
        frames, astray, still = mended(tokens, states, chain)
    torch.testing.assert_close(frames[~overlap], before[~overlap], rtol=0, atol=1e-6)
    assert torch.equal(still, chain.overlap(frames)) and still.sum() < 0.15 * overlap.sum()
    right = ~astray & ~still
    assert (chain.states(frames[right]) == states[right]).all()
    turned = _turned_deg(chain, before[overlap & right], frames[overlap & right])
    assert turned.max(1).values.median() < 25.0
    # Bonds, angles and handedness are what they were.
    conditioning = [chain.code.encode(x[overlap]) for x in (before, frames)]
    stiff = chain.code.filled.flatten().clone()
    stiff[chain.code.turning_at] = stiff[chain.code.turning_at + 1] = False
    torch.testing.assert_close(
        conditioning[0].flatten(-2)[:, stiff], conditioning[1].flatten(-2)[:, stiff], rtol=0, atol=2e-3
    )
    # Each frame by itself.
    one = int(torch.nonzero(overlap)[3])
    torch.testing.assert_close(mended(tokens[one : one + 1], states[one : one + 1], chain)[0][0], frames[one],
                               rtol=0, atol=1e-5)  # fmt: skip


def test_without_turns_they_stay_where_they_are(
    crowded: tuple[ChainFeatures, torch.Tensor, torch.Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    chain, tokens, states = crowded
    monkeypatch.setattr(settling, "_TURNS", 0)
    frames, astray, still = mended(tokens, states, chain)
    assert torch.equal(still, chain.overlap(chain.code.decode(tokens))) and not astray.any()
    torch.testing.assert_close(frames, chain.code.decode(tokens), rtol=0, atol=1e-6)


def _turned_deg(chain: ChainFeatures, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    quads = torch.tensor(chain.code.layout.turning)
    angles = [dihedral(*(x[..., quads[:, k], :] for k in range(4))) for x in (before, after)]
    return ((angles[1] - angles[0]).rad2deg() + 180.0).remainder(360.0).sub(180.0).abs()


def _config(scene: Scene) -> PeptideConfig:
    layout = chain_layout(scene)
    shaken = torch.tensor(scene.positions_nm).float() + 0.005 * torch.randn(
        64, scene.n_atoms, 3, generator=torch.Generator().manual_seed(1)
    )
    return PeptideConfig(types=tuple(sorted(set(layout.types))), scale=chain_scale([(layout, shaken.numpy())]))
