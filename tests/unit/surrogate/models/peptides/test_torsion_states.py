"""States of torsions: which they are, probabilities of changes learned by log-likelihood, draws that follow them, and
frames set right by small turns: torsions mirrored at the end of their states, overlapping atoms turned apart."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from small_scenes import with_phi_turned
from surrogate.models.peptides import chains
from surrogate.models.peptides import model as module
from surrogate.models.peptides.chains import (
    MOST_TORSIONS,
    PHI,
    PSI,
    RING,
    THREEFOLD,
    ChainFeatures,
    StateBounds,
    StatedTorsions,
    conditioning_states,
    dihedral,
    mended,
    mirrored,
)
from surrogate.models.peptides.layout import PeptideConfig, chain_features, chain_layout, chain_scale
from surrogate.models.peptides.model import PeptideSlide, times_apart
from surrogate.models.peptides.state_jumps import StateJumps
from surrogate.models.peptides.trainer import state_loss
from systems.chemistry.geometry import torsion
from systems.prepare.peptide import build_peptide
from systems.scene import Scene


@pytest.mark.parametrize(
    ("bounds", "degrees", "states"),
    [
        # Strands that reach across 180 degrees are not left-handed.
        (PHI, [-170.0, -60.0, -1.0, 1.0, 60.0, 129.0, 131.0, 179.0], [0, 0, 0, 1, 1, 1, 0, 0]),
        (PSI, [-179.0, -121.0, -119.0, -40.0, 74.0, 76.0, 140.0], [0, 0, 1, 1, 1, 0, 0]),
        (THREEFOLD, [-179.0, -121.0, -119.0, -60.0, -1.0, 1.0, 119.0, 121.0, 180.0], [1, 1, 2, 2, 2, 0, 0, 1, 1]),
        (RING, [-179.0, -1.0, 1.0, 179.0], [1, 1, 0, 0]),
    ],
)
def test_states_of_angles(bounds: StateBounds, degrees: list[float], states: list[int]) -> None:
    stated = StatedTorsions.of([([0, 1, 2, 3], 1, 2, bounds)], 3)
    found = stated.states(torch.tensor(degrees).deg2rad()[:, None])
    assert found.shape == (len(degrees), 3, MOST_TORSIONS)
    assert found[:, 1, 2].tolist() == states and found.sum() == sum(states)
    assert int(stated.counts.sum()) == int(stated.counts[1, 2]) == max(states) + 1
    middles = stated.middles_deg[0, : max(states) + 1]
    assert stated.states(middles.deg2rad()[:, None])[:, 1, 2].tolist() == list(range(max(states) + 1))


def test_the_states_of_frames_are_those_of_their_torsions() -> None:
    """Glycine has psi alone; strands whose phi is turned by half a circle are left-handed; lysine has four and its
    ammonium's rotor, of glutamate's three the last is flat, of phenylalanine's the second has two sides."""
    scene = build_peptide("ACE-GLY-LYS-GLU-PHE-NME")
    chain = chain_features(scene, _config(scene))
    assert chain.stated.counts.tolist() == [
        [0, 0, 0, 0, 0, 0, 0], [0, 2, 0, 0, 0, 0, 0], [2, 2, 3, 3, 3, 3, 3], [2, 2, 3, 3, 0, 0, 0],
        [2, 2, 3, 2, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0],
    ]  # fmt: skip
    assert chain.signed == [2, 3, 4]
    both = np.stack([scene.positions_nm, with_phi_turned(scene)])
    found = chain.states(torch.tensor(both))
    quads = [_quad(scene, residue, names) for residue, names in ((2, ("CA", "CB", "CG", "CD")), (3, _CHI1))]
    degrees = np.degrees(torsion(both, quads)) % 360.0
    np.testing.assert_array_equal(found[:, 2, 3], degrees[:, 0] // 120.0)
    np.testing.assert_array_equal(found[:, 3, 2], degrees[:, 1] // 120.0)
    assert (found[0, 2:5, 0] != found[1, 2:5, 0]).all()
    conditioning = conditioning_states(found, chain.stated.counts)
    assert conditioning.sum(-1).tolist() == [[0, 1, 7, 4, 4, 0]] * 2


_CHI1 = ("N", "CA", "CB", "CG")


def _quad(scene: Scene, residue: int, names: tuple[str, ...]) -> list[int]:
    at = {name: i for i, name in enumerate(scene.atom_names) if scene.residue_of_atom[i] == residue}
    return [at[name] for name in names]


def _counts(*rows: list[int]) -> torch.Tensor:
    return torch.tensor([row + [0] * (MOST_TORSIONS - len(row)) for row in rows])


def _config(scene: Scene) -> PeptideConfig:
    layout = chain_layout(scene)
    rng = np.random.default_rng(0)
    frames = (scene.positions_nm + 0.002 * rng.normal(size=(50, scene.n_atoms, 3))).astype(np.float32)
    return PeptideConfig(
        width=16, n_layers=1, n_heads=1, chunk_frames=4, types=tuple(sorted(set(layout.types))),
        scale=chain_scale([(layout, frames)]),
    )  # fmt: skip


def test_numbers_count_from_the_middle_of_the_state_and_come_back() -> None:
    scene = build_peptide("ACE-VAL-NME")
    chain = chain_features(scene, _config(scene))
    model = PeptideSlide(_config(scene)).requires_grad_(False)
    model.token_mean.normal_(generator=torch.Generator().manual_seed(0))
    frames = torch.tensor(scene.positions_nm)[None]
    numbers, states = model.normalised(frames, chain)
    stated = chain.state_at[1] == 2
    assert int(stated.sum()) == 2, "cosine and sine of chi1"
    other = (states + torch.tensor([0, 0, 1, 0, 0, 0, 0])) % 3
    moved = (model.middle(other, chain) != model.middle(states, chain))[0]
    assert torch.equal(moved[1], stated) and not moved[[0, 2]].any()
    back = chain.code.encode(chain.code.decode(model._tokens(numbers, states, chain)))
    torch.testing.assert_close(back, chain.code.encode(frames), rtol=0, atol=1e-4)


def test_the_loss_is_the_negative_log_likelihood_of_what_was_done() -> None:
    """Probabilities are set by hand: of two states and of three, one residue without any."""
    jumps, counts = StateJumps(4, 2), _counts([2, 3], [])
    with torch.no_grad():
        jumps.logits.bias.zero_()
        jumps.of_change[0, 0, 0, 0, 1] = 1.0  # phi from negative to positive
        jumps.of_change[1, 0, 0, 0, 1] = 0.5  # and with time
        jumps.of_change[0, 0, 1, 2, :] = torch.tensor([-1.0, 2.0, 9.0])  # the last is not to change
    states = torch.zeros(1, 2, 2, MOST_TORSIONS, dtype=torch.long)
    states[:, :, 0] = torch.stack([_counts([0, 2])[0], _counts([1, 1])[0]])
    time = torch.full((1, 1), 100.0)
    places = torch.tensor([[0, 1, 1], [1, 0, 0]])
    found = jumps.loss(torch.zeros(1, 2, 4), states, places, counts, time, time).detach()
    crosses = 1.0 / (1.0 + np.exp(-(1.0 + 0.5 * 2.0)))
    turns = np.exp(2.0) / (np.exp(-1.0) + np.exp(2.0) + 1.0)
    assert float(found) == pytest.approx((-np.log(crosses) - np.log(turns)) / 2.0, rel=1e-5)
    # What the neighbours' types say comes on top, before and after: this residue's are both of type 1.
    with torch.no_grad():
        jumps.beside_change[1, 1, 0, 0, 1] = -0.2
        jumps.beside_change[:, 0] = 5.0
    forbidden = jumps.loss(torch.zeros(1, 2, 4), states, places, counts, time, time).detach()
    crosses = 1.0 / (1.0 + np.exp(-(1.0 + 0.5 * 2.0 - 10.0 * 0.2)))
    assert float(forbidden) == pytest.approx((-np.log(crosses) - np.log(turns)) / 2.0, rel=1e-5)


def test_hidden_numbers_are_left_out_at_random_as_often_as_told() -> None:
    scene = build_peptide("ACE-VAL-NME")
    config = replace(_config(scene), conditioning_noise=0.0)
    chain, model = chain_features(scene, config), PeptideSlide(config).requires_grad_(False)
    model.jumps.logits.weight.normal_(generator=torch.Generator().manual_seed(0))
    numbers, states = model.normalised(torch.tensor(scene.positions_nm)[None].repeat(64, 1, 1), chain)

    def loss(seed: int, dropped: float = 0.2) -> float:
        generator, times = torch.Generator().manual_seed(seed), torch.full((64, 1), 10.0)
        given = numbers, torch.stack([states, states], dim=1), times, generator
        return float(state_loss(model, chain, *given, dropped=dropped))

    assert loss(0) == loss(0) != loss(1)
    assert loss(0, 0.0) == loss(1, 0.0)
    assert abs(loss(0) / loss(0, 0.0) - 1.0) > 0.001


def test_draws_change_as_often_as_their_probabilities_say_and_turn_two_torsions_at_once() -> None:
    """Of three states each is left for the next at a known rate; the second torsion turns when the first has."""
    jumps, counts = StateJumps(4, 2).requires_grad_(False), _counts([0, 3, 3])
    jumps.logits.bias.fill_(-30.0)
    rates = {(0, 1): 0.02, (1, 2): 0.1, (2, 0): 0.3}
    for (a, b), rate in rates.items():
        jumps.of_change[0, 0, 1, a, b] = 30.0 + float(np.log(rate / (1 - rate)))
    seen = jumps.of_new[2].weight
    n, frames = 400, 200
    time = torch.ones(n, frames)
    uniform = torch.rand(n, frames, 1, MOST_TORSIONS, generator=torch.Generator().manual_seed(0))
    known, places = torch.zeros(n, 1, 4), torch.tensor([[0, 1, 1]])
    start = torch.zeros(n, 1, MOST_TORSIONS, dtype=torch.long)
    drawn = jumps.draw(known, start, places, counts, time, time, uniform)[:, :, 0]
    assert drawn.shape == (n, frames, MOST_TORSIONS) and not drawn[..., [0, *range(2, MOST_TORSIONS)]].any()
    before, after = drawn[:, :-1, 1], drawn[:, 1:, 1]
    for a in range(3):
        for b in set(range(3)) - {a}:
            share = float(((before == a) & (after == b)).sum() / (before == a).sum())
            assert share == pytest.approx(rates.get((a, b), 0.0), rel=0.1, abs=1e-9)
    assert seen.shape[1] == conditioning_states(start, counts).shape[-1]


def test_the_second_torsion_sees_the_new_state_of_the_first_and_not_its_own() -> None:
    torch.manual_seed(0)
    jumps, counts = StateJumps(4, 2).requires_grad_(False), _counts([2, 3, 3])
    torch.nn.init.normal_(jumps.logits.weight)
    before = torch.zeros(1, 1, 1, MOST_TORSIONS, dtype=torch.long)
    places, time = torch.tensor([[0, 1, 1]]), torch.ones(1, 1)
    common = jumps.of_observed(torch.zeros(1, 1, 4), before[:, 0], places, counts)
    of_times, levels = jumps.of_times_alone(time, time, places, counts)
    conditioning = conditioning_states(before, counts)
    h = jumps.of_frames(conditioning, conditioning) + common[:, None] + of_times[:, :, None]

    def probabilities(**moved: int) -> torch.Tensor:
        new = before.clone()
        for name, state in moved.items():
            new[..., int(name[1:])] = state
        return jumps.probabilities(1, h, levels, before[..., 1], conditioning_states(new, counts))

    assert not torch.equal(probabilities(), probabilities(t0=1))
    assert torch.equal(probabilities(), probabilities(t1=2)) and torch.equal(probabilities(), probabilities(t2=1))


def test_times_between_frames_and_endless_ones() -> None:
    times = torch.tensor([[1.0, 3.0, 7.0], [1e4, 1e4, 1e4]])
    assert times_apart(times, 1e4).tolist() == [[1.0, 2.0, 4.0], [1e4, 1e4, 1e4]]


def test_rates_of_two_residue_types_are_learned() -> None:
    """One type leaves phi > 0 ten times as often as the other; frames of 1 and of 10 ps, probabilities accordingly."""
    torch.manual_seed(0)
    net, counts = StateJumps(6, 4), _counts([2], [2])
    places = torch.tensor([[2, 0, 3], [3, 2, 1]])
    leaves = torch.tensor([0.002, 0.02])
    optimiser = torch.optim.Adam(net.parameters(), lr=0.01)
    generator = torch.Generator().manual_seed(1)
    for _ in range(300):
        times = torch.where(torch.rand(1024, 1, generator=generator) < 0.5, 1.0, 10.0)
        states = torch.zeros(1024, 2, 2, MOST_TORSIONS, dtype=torch.long)
        states[:, 0, :, 0] = 1
        states[:, 1, :, 0] = (torch.rand(1024, 2, generator=generator) >= leaves * times).long()
        known = torch.randn(1024, 2, 6, generator=generator)
        loss = net.loss(known, states, places, counts, times, times)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    up = states[:1, 0]
    for apart_ps in (1.0, 10.0):
        time = torch.tensor([[apart_ps]])
        common = net.of_observed(torch.zeros(1, 2, 6), up, places, counts)
        of_times, levels = net.of_times_alone(time, time, places, counts)
        conditioning = conditioning_states(up[:, None], counts)
        h = net.of_frames(conditioning, conditioning) + common[:, None] + of_times[:, :, None]
        probabilities = net.probabilities(0, h, levels, up[:, None, :, 0], conditioning)[0, 0].softmax(-1)[:, 0]
        np.testing.assert_allclose(probabilities.detach(), leaves * apart_ps, rtol=0.35)


def _middles(model: PeptideSlide, chain: ChainFeatures) -> torch.Tensor:
    """Return means `(kinds, states, slots)` that are the middles of states."""
    found = torch.zeros_like(model.token_mean)
    for residue, slot, middles in zip(
        chain.stated.residue.tolist(), chain.stated.slot.tolist(), chain.stated.middles_deg.deg2rad(), strict=True
    ):
        at = int(torch.nonzero(chain.state_at[residue] == slot)[0])
        kind = model.kinds(chain)[residue]
        found[kind, :, at], found[kind, :, at + 1] = middles.cos(), middles.sin()
    return found


def test_a_chunk_is_drawn_again_where_it_disobeys_and_rows_do_not_depend_on_others() -> None:
    """With numbers that scatter widely about the middles of states, many frames disobey; with the probabilities of
    changes at nothing more of them stay in the given states after drawing again, or where torsions are mirrored at the
    end of their states, and a row alone is drawn as it is in a batch."""
    scene = build_peptide("ACE-ALA-NME")
    torch.manual_seed(0)
    model = PeptideSlide(_config(scene)).eval().requires_grad_(False)
    model.lag_ps = 1.0
    torch.nn.init.constant_(model.jumps.logits.bias, -30.0)
    molecule = model.featurise(scene)
    chain = molecule.own
    assert chain is not None
    last = torch.tensor(scene.positions_nm).float().expand(60, 1, -1, -1)
    noise = torch.randn(60, *model.noise_shape(scene.n_atoms), generator=torch.Generator().manual_seed(3))
    own = chain.states(last[0, 0])
    model.token_scale[chain.places[1, 0]] = 0.75
    model.token_mean.copy_(_middles(model, chain))
    shares = []
    for most, mirrored_deg in ((0, 0.0), (module.MAX_REDRAWS, 0.0), (0, chains._MIRRORED_DEG)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "MAX_REDRAWS", most)
            patch.setattr(chains, "_MIRRORED_DEG", mirrored_deg)
            frames = model.next_chunk(last, molecule, noise, solver_steps=2).frames_nm
        obeys = (chain.states(frames) == own).flatten(1).all(dim=1)
        shares.append(float(obeys.float().mean()))
    assert shares[0] < 0.7 and min(shares[1:]) > shares[0] + 0.15
    alone = model.next_chunk(last[7:8], molecule, noise[7:8], solver_steps=2).frames_nm
    torch.testing.assert_close(alone[0], frames[7], rtol=0, atol=1e-5)


@pytest.mark.parametrize("again", [False, True])
def test_states_in_which_atoms_always_overlap_are_drawn_again(monkeypatch: pytest.MonkeyPatch, again: bool) -> None:
    """Psi changes as often as not, and its other state is said to have no room."""
    if not again:
        monkeypatch.setattr(module, "_OVERLAPS", module.MAX_REDRAWS)
    scene = build_peptide("ACE-ALA-NME")
    torch.manual_seed(0)
    model = PeptideSlide(replace(_config(scene), chunk_frames=1)).eval().requires_grad_(False)
    model.lag_ps = 100.0
    molecule = model.featurise(scene)
    chain = molecule.own
    assert chain is not None
    model.token_mean.copy_(_middles(model, chain))
    model.token_scale.fill_(0.01)
    model.jumps.logits.bias[:] = -30.0
    model.jumps.of_change[0, :, 1] = 30.0
    last = torch.tensor(scene.positions_nm).float().expand(64, 1, -1, -1)
    own = chain.states(last[0, 0])[1, 1]
    monkeypatch.setattr(ChainFeatures, "overlap", lambda self, x: self.states(x)[..., 1, 1] != own)
    noise = torch.randn(64, *model.noise_shape(scene.n_atoms), generator=torch.Generator().manual_seed(3))
    chunk = model.next_chunk(last, molecule, noise, solver_steps=2)
    stayed = (chain.states(chunk.frames_nm)[..., 1, 1] == own).all(1).float().mean()
    assert 0.35 < stayed < 0.65 if not again else stayed > 0.9
    assert chunk.evaluations > 2 * (1.5 if again else 4)


def test_each_solvent_has_probabilities_of_its_own() -> None:
    """Psi changes as often as not in water, and never in OBC2."""
    scene = build_peptide("ACE-ALA-NME")
    torch.manual_seed(0)
    model = (
        PeptideSlide(replace(_config(scene), chunk_frames=1, solvents=("obc2", "tip3p"))).eval().requires_grad_(False)
    )
    model.lag_ps = 100.0
    for jumps in model.all_jumps:
        jumps.logits.bias[:] = -30.0
    model.jumps_elsewhere[0].of_change[0, :, 1] = 30.0
    last = torch.tensor(scene.positions_nm).float().expand(64, 1, -1, -1)
    noise = torch.randn(64, *model.noise_shape(scene.n_atoms), generator=torch.Generator().manual_seed(3))
    stayed = {}
    for solvent in ("obc2", "tip3p"):
        model.solvent = solvent
        molecule = model.featurise(scene)
        chain = molecule.own
        assert chain is not None
        model.token_scale.fill_(0.01)
        model.token_mean.copy_(_middles(model, chain))
        frames = model.next_chunk(last, molecule, noise, solver_steps=2).frames_nm
        stayed[solvent] = float((chain.states(frames) == chain.states(last[0, 0])).flatten(1).all(1).float().mean())
    assert stayed["obc2"] == 1.0 and 0.35 < stayed["tip3p"] < 0.65


def test_atoms_overlap_where_they_are_nearer_than_md_lets_them_and_no_few_bonds_apart() -> None:
    scene = build_peptide("ACE-ALA-NME")
    chain = chain_features(scene, _config(scene))
    at = {(int(r), name): i for i, (r, name) in enumerate(zip(scene.residue_of_atom, scene.atom_names, strict=True))}
    x = torch.tensor(scene.positions_nm).float().repeat(2, 3, 1, 1)
    oxygen, far = at[0, "O"], at[2, "C"]
    x[1, 2, far] = x[1, 2, oxygen] + torch.tensor([0.0, 0.0, 0.23])
    x[0, 1, far] = x[0, 1, oxygen] + torch.tensor([0.0, 0.0, 0.25])
    x[0, 0, at[0, "C"]] = x[0, 0, oxygen]  # bonded: for other checks
    # A methyl hydrogen makes no hydrogen bond, whose length an amide's may have.
    methyl, amide = at[2, "H1"], at[2, "H"]
    x[1, 0, methyl] = x[1, 0, oxygen] + torch.tensor([0.0, 0.0, 0.19])
    x[1, 1, amide] = x[1, 1, oxygen] + torch.tensor([0.0, 0.0, 0.19])
    assert chain.overlap(x).tolist() == [[False, False, False], [True, False, True]]


def test_a_chunk_whose_atoms_overlap_is_drawn_again_in_the_same_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of what is drawn a frame of the first of three rows overlaps twice: that row alone is drawn three times."""
    scene = build_peptide("ACE-ALA-NME")
    model = PeptideSlide(_config(scene)).eval().requires_grad_(False)
    model.lag_ps = 1.0
    model.token_scale.fill_(1e-3)
    molecule = model.featurise(scene)
    chain = molecule.own
    assert chain is not None
    model.token_mean.copy_(_middles(model, chain))
    seen: list[int] = []

    def resolved(tokens: torch.Tensor, *conditioning: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        frames, astray, crowded = mended(tokens, *conditioning)
        seen.append(len(frames) // model.n_new)
        crowded[model.n_new - 1] = len(seen) < 3
        return frames, astray, crowded

    monkeypatch.setattr(module, "mended", resolved)
    last = torch.tensor(scene.positions_nm).float().expand(3, 1, -1, -1)
    noise = torch.randn(3, *model.noise_shape(scene.n_atoms), generator=torch.Generator().manual_seed(3))
    chunk = model.next_chunk(last, molecule, noise, solver_steps=2)
    assert seen == [3, 1, 1]
    assert chunk.evaluations == pytest.approx(2 * (3 + 1 + 1) / 3)


Crowded = tuple[ChainFeatures, torch.Tensor, torch.Tensor]


@pytest.mark.parametrize(
    ("bounds", "state", "drawn", "expected"),
    [
        (PHI, 0, [-60.0, 5.0, 29.0, -5.0, 125.0, 131.0], [-60.0, -5.05, -29.05, -5.0, 135.05, 131.0]),
        (PHI, 1, [60.0, -5.0, 140.0, -29.0], [60.0, 5.05, 119.95, 29.05]),
        (PSI, 0, [80.0, 70.0, -121.0, -110.0], [80.0, 80.05, -121.0, -130.05]),
        (THREEFOLD, 2, [-60.0, 10.0, -130.0], [-60.0, -10.05, -109.95]),
        (RING, 1, [-90.0, 20.0, 170.0], [-90.0, -20.05, -169.95]),
    ],
)
def test_a_torsion_a_little_beyond_its_state_is_mirrored(
    bounds: StateBounds, state: int, drawn: list[float], expected: list[float]
) -> None:
    stated = StatedTorsions.of([([0, 1, 2, 3], 0, 1, bounds)], 1)
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
def crowded() -> Crowded:
    """Lysine and glutamate with torsions at random, of which a good part overlap; each in the states that it is in."""
    scene = build_peptide("ACE-LYS-GLU-NME")
    chain = chain_features(scene, _config(scene))
    tokens = chain.code.encode(torch.tensor(scene.positions_nm).float()).expand(200, -1, -1).clone()
    at, flat = chain.code.turning_at, tokens.flatten(-2)
    angles = torch.atan2(flat[:, at + 1], flat[:, at])
    angles = angles + 0.9 * torch.randn(angles.shape, generator=torch.Generator().manual_seed(0))
    tokens = chains._with_torsions(tokens, at, angles)
    return chain, tokens, chain.states(chain.code.decode(tokens))


def test_overlapping_atoms_are_turned_apart_and_nothing_else_is(
    crowded: Crowded,
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
    stiff = chain.code.filled_stiff.flatten()
    torch.testing.assert_close(
        conditioning[0].flatten(-2)[:, stiff], conditioning[1].flatten(-2)[:, stiff], rtol=0, atol=2e-3
    )
    # Each frame by itself.
    one = int(torch.nonzero(overlap)[3])
    torch.testing.assert_close(mended(tokens[one : one + 1], states[one : one + 1], chain)[0][0], frames[one],
                               rtol=0, atol=1e-5)  # fmt: skip


def test_without_turns_they_stay_where_they_are(crowded: Crowded, monkeypatch: pytest.MonkeyPatch) -> None:
    chain, tokens, states = crowded
    monkeypatch.setattr(chains, "_TURNS", 0)
    frames, astray, still = mended(tokens, states, chain)
    assert torch.equal(still, chain.overlap(chain.code.decode(tokens))) and not astray.any()
    torch.testing.assert_close(frames, chain.code.decode(tokens), rtol=0, atol=1e-6)


def _turned_deg(chain: ChainFeatures, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    quads = torch.tensor(chain.code.layout.turning)
    angles = [dihedral(*(x[..., quads[:, k], :] for k in range(4))) for x in (before, after)]
    return ((angles[1] - angles[0]).rad2deg() + 180.0).remainder(360.0).sub(180.0).abs()


@pytest.mark.parametrize("coupled", [True, False])
def test_torsions_of_neighbours_that_turn_together_are_drawn_together(coupled: bool) -> None:
    """The second residue's torsion is always in the state that the first one's has just turned to."""
    torch.manual_seed(0)
    net, counts = StateJumps(6, 4, coupled=coupled), _counts([2], [2], [2])
    places, n, frames = torch.tensor([[2, 0, 3], [3, 2, 2], [2, 3, 1]]), 256, 4
    optimiser = torch.optim.Adam(net.parameters(), lr=0.01)
    generator = torch.Generator().manual_seed(1)
    time = torch.ones(n, frames)
    for _ in range(150):
        states = torch.zeros(n, 1 + frames, 3, MOST_TORSIONS, dtype=torch.long)
        states[:, :, [0, 2], 0] = torch.randint(2, (n, 1 + frames, 2), generator=generator)
        states[:, :, 1, 0] = states[:, :, 0, 0]
        loss = net.loss(torch.zeros(n, 3, 6), states, places, counts, time, time)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    uniform = torch.rand(n, 20, 3, MOST_TORSIONS, generator=generator)
    with torch.no_grad():
        drawn = net.draw(torch.zeros(n, 3, 6), states[:, 1], places, counts, *(torch.ones(n, 20),) * 2, uniform)
    first, second, third = drawn[..., 0].unbind(-1)
    assert float((first == third).double().mean()) == pytest.approx(0.5, abs=0.05), "these know nothing of each other"
    assert float((first == second).double().mean()) == pytest.approx(1.0 if coupled else 0.5, abs=0.05)


def test_the_given_frame_reaches_residues_that_are_not_neighbours_where_states_are_coupled() -> None:
    torch.manual_seed(0)
    places, counts = torch.tensor([[2, 0, 3], [3, 2, 2], [2, 3, 3], [3, 2, 1]]), _counts([2], [2], [2], [2])
    observed = torch.randn(1, 4, 6)
    other = observed + torch.tensor([0.0, 0.0, 0.0, 1.0])[:, None]
    states = torch.zeros(1, 4, MOST_TORSIONS, dtype=torch.long)
    for coupled in (True, False):
        net = StateJumps(6, 4, coupled=coupled).requires_grad_(False)
        for block in getattr(net, "blocks", ()):
            block.offset.fill_(1.0)
        one, two = (net.of_observed(x, states, places, counts)[0, 0] for x in (observed, other))
        assert torch.equal(one, two) != coupled


def test_coupled_states_begin_as_the_weights_gone_on_from() -> None:
    torch.manual_seed(0)
    net, coupled = StateJumps(6, 4), StateJumps(6, 4, coupled=True)
    torch.nn.init.normal_(net.logits.weight)
    coupled.load_state_dict(net.state_dict(), strict=False)
    for part in (net, coupled):
        part.requires_grad_(False)
    places, counts = torch.tensor([[2, 0, 3], [3, 2, 2], [2, 3, 1]]), _counts([2], [2], [2])
    states = torch.randint(2, (5, 4, 3, MOST_TORSIONS)) * (torch.arange(MOST_TORSIONS) == 0)
    one, two = (
        x.loss(torch.ones(5, 3, 6), states, places, counts, torch.ones(5, 3), torch.ones(5, 3)) for x in (net, coupled)
    )
    assert float(one) == float(two) > 0.0
    coupled.of_type_beside[0].weight.data += 1.0
    assert float(coupled.loss(torch.ones(5, 3, 6), states, places, counts, torch.ones(5, 3), torch.ones(5, 3))) != one
