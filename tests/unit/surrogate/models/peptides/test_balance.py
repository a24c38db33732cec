"""Probabilities of changes of states after balancing: as many frames go one way as the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from small_scenes import with_phi_turned
from surrogate.data import TrainingFrames, canonicalise, quantise
from surrogate.models.peptides.balance import (
    Change,
    _fluxes,
    _paces,
    _pairs_of_states,
    balance,
    changes,
    lacking_entries,
    population_levels,
    raise_populations,
    set_pace,
    transfer,
    weighted_phis,
)
from surrogate.models.peptides.layout import PeptideConfig, chain_features
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.peptides.subjects import PeptideSubject
from surrogate.models.peptides.trainer import with_scale
from systems.prepare.peptide import build_peptide

SHARE = 0.02
EACH = 400
# Frames of either side by turns.
MIXED = np.arange(2 * EACH).reshape(2, EACH).T.ravel()


def _frames(sequence: str, kind: str = "phi") -> TrainingFrames:
    """As many frames on either side of the residues' phi, or another torsion, as on the other, trembling."""
    scene = build_peptide(sequence)
    sides = np.stack([scene.positions_nm, with_phi_turned(scene, kind)]).repeat(EACH, axis=0)
    sides = sides + 0.002 * np.random.default_rng(0).normal(size=sides.shape)
    return TrainingFrames(scene, quantise(canonicalise(sides, scene)), np.array([0, EACH, 2 * EACH]), 1.0, True, {}, ())


def _jumping(frames: TrainingFrames, often: float, rarely: float) -> TrainingFrames:
    """The frames in another order, 10 ps apart: a run that goes from the first side to the second `rarely` and back
    `often`."""
    rng, sides, order = np.random.default_rng(1), [0], []
    for place in range(2 * EACH):
        order.append(sides[-1] * EACH + place % EACH)
        sides.append(sides[-1] ^ int(rng.random() < (rarely, often)[sides[-1]]))
    return replace(frames, coordinates=frames.coordinates[order], starts=np.array([0, 2 * EACH]), lag_ps=10.0)


def _subject(frames: TrainingFrames, config: PeptideConfig) -> PeptideSubject:
    weights = np.repeat([1.0 - SHARE, SHARE], EACH) * 2.0
    return PeptideSubject(frames, chain_features(frames.scene, config), weights)


def test_as_many_frames_enter_as_leave() -> None:
    sets = [_frames(f"ACE-{name}-NME") for name in ("ALA", "SER", "ALA-SER", "SER-ALA")]
    config = with_scale(PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4), sets)
    subjects = [_subject(frames, config) for frames in sets]
    torch.manual_seed(0)
    model = PeptideSlide(config).requires_grad_(False)
    model.jumps.of_change[0, :, 0, 0, 1] = torch.randn(len(model.token_mean))
    model.jumps.beside_change[:, :, 0, 0, 1] = 0.1 * torch.randn(2, len(model.token_mean))
    model.jumps.logits.weight.normal_(std=0.05)
    before = [lacking_entries(model, phi) for subject in subjects for phi in weighted_phis(model, subject)]
    assert len(before) == 6 and max(map(abs, before)) > 2.0
    leaving = model.jumps.of_change[:, :, :, 1].clone()
    balance(model, subjects)
    after = [lacking_entries(model, phi) for subject in subjects for phi in weighted_phis(model, subject)]
    assert max(map(abs, after)) < 0.35
    assert torch.equal(model.jumps.of_change[:, :, :, 1], leaving), "the probabilities of leaving are what they were"


def _weighed(model: PeptideSlide, subjects: list[PeptideSubject]) -> list[tuple[float, float]]:
    """Of every change of psi what balance lacks, and the logarithm of how many more are seen than expected."""
    found = [change for subject in subjects for change in changes(model, subject) if change.torsion == 1]
    return [(abs(change.lacking), abs(np.log(change.seen / change.expected))) for change in found]


def test_as_many_frames_change_one_way_as_the_other_and_as_often_as_runs_show() -> None:
    sets = [_frames(f"ACE-{name}-NME", kind="psi") for name in ("ALA", "SER", "ALA-SER", "SER-ALA")]
    sets = [_jumping(frames, often, often / 4) for frames, often in zip(sets, (0.05, 0.2, 0.05, 0.1), strict=True)]
    config = with_scale(PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4), sets)
    subjects = [PeptideSubject(f, chain_features(f.scene, config), np.ones(2 * EACH)) for f in sets]
    torch.manual_seed(0)
    model = PeptideSlide(config).requires_grad_(False)
    model.jumps.of_change[0, :, 1].normal_()
    before = np.array(_weighed(model, subjects))
    assert len(before) >= 4 and before.max(axis=0).min() > 1.0
    balance(model, subjects)
    after = np.array(_weighed(model, subjects))
    # Residues of several peptides go by all of them, which differ.
    assert (after.max(axis=0) < 0.3 * before.max(axis=0)).all()
    assert (after.mean(axis=0) < 0.3 * before.mean(axis=0)).all()
    # Among neighbours only caps have levels of their own.
    beside = model.jumps.beside_change[:, :, 1].abs().flatten(2).sum(-1)
    names = [2 + config.types.index(name) for name in ("ALA", "SER", "ACE", "NME")]
    assert (beside[:, names[:2]] == 0).all() and beside[0, names[2]] > 0 and beside[1, names[3]] > 0


def test_a_residue_that_is_not_seen_moves_with_all_others() -> None:
    sets = [_jumping(_frames(f"ACE-{name}-NME", kind="psi"), 0.2, 0.1) for name in ("ALA", "SER", "THR")]
    config = with_scale(PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4), sets)
    config = replace(config, types=(*config.types, "ASN"))
    model = PeptideSlide(config).requires_grad_(False)
    start = model.jumps.of_change.clone()
    balance(model, [PeptideSubject(f, chain_features(f.scene, config), np.ones(f.n_frames)) for f in sets])
    moved = (model.jumps.of_change - start)[0, :, 1].flatten(1)
    shown = [moved[2 + config.types.index(name), 1] for name in ("ALA", "SER", "THR")]
    assert moved[-1, 1] == pytest.approx(np.mean(shown), rel=0.2) and moved[-1, 1] > 1.0


def test_a_solvent_is_balanced_by_frames_in_it() -> None:
    frames = _jumping(_frames("ACE-ALA-NME", kind="psi"), 0.2, 0.05)
    config = PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4, solvents=("obc2", "tip3p"))
    config = with_scale(config, [frames])
    wet = PeptideSubject(frames, chain_features(frames.scene, config, "tip3p"), np.ones(2 * EACH))
    torch.manual_seed(0)
    model = PeptideSlide(config).requires_grad_(False)
    dry, water = model.jumps.of_change.clone(), model.jumps_elsewhere[0].of_change.clone()
    before = [abs(change.lacking) for change in changes(model, wet)]
    balance(model, [wet])
    assert torch.equal(model.jumps.of_change, dry)
    assert not torch.equal(model.jumps_elsewhere[0].of_change, water)
    assert max(abs(change.lacking) for change in changes(model, wet)) < 0.5 * max(before)


def test_the_pace_beside_other_residues_is_one_factor_a_side() -> None:
    sets = [_jumping(_frames(f"ACE-{name}-NME", kind="psi"), often, 0.05)
            for name, often in (("ALA-SER", 0.1), ("SER-ALA", 0.2), ("SER", 0.2))]  # fmt: skip
    config = PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4, solvents=("obc2", "tip3p"))
    config = with_scale(config, sets)
    subjects = [PeptideSubject(f, chain_features(f.scene, config, "tip3p"), np.ones(2 * EACH)) for f in sets]
    torch.manual_seed(0)
    model = PeptideSlide(config).requires_grad_(False)
    jumps, start = model.jumps_elsewhere[0], {name: x.clone() for name, x in model.named_parameters()}

    def slow(some: list[PeptideSubject]) -> float:
        return float(np.mean([change.slow for subject in some for change in changes(model, subject)]))

    pairs, alone = slow(subjects[:2]), slow(subjects[2:])
    assert min(pairs, alone) > 1.0
    set_pace(model, subjects[:2])
    assert abs(slow(subjects[:2])) < 0.2 * pairs and slow(subjects[2:]) == alone, "beside caps it stays"
    moved = {name for name, x in model.named_parameters() if not torch.equal(x, start[name])}
    assert moved == {"jumps_elsewhere.0.beside_change"}
    of = {name: jumps.beside_change[:, 2 + config.types.index(name), 1] for name in config.types}
    assert of["ALA"].equal(of["SER"]) and not of["ACE"].any() and not of["NME"].any()
    assert of["ALA"][:, 0, 1].equal(of["ALA"][:, 1, 0]), "either direction alike"


@pytest.mark.parametrize("exits", [0.2, 0.05])
def test_how_often_states_change_is_told_by_steps_that_equilibrium_is_far_from(exits: float) -> None:
    """However much of the way to equilibrium runs go in 20 and in 100 ps."""
    frames = _jumping(_frames("ACE-ALA-NME", kind="psi"), exits, exits)
    config = with_scale(PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4), [frames])
    model = PeptideSlide(config).requires_grad_(False)
    model.jumps.logits.bias.zero_()
    model.jumps.of_change[0, :, 1] = float(np.log(exits / 2 / (1 - exits / 2)))
    subject = PeptideSubject(frames, chain_features(frames.scene, config), np.ones(2 * EACH))
    states = subject.states(torch.arange(2 * EACH))[:, 1, 1]
    shown = float((states[1:] != states[:-1]).double().mean())
    # Both go back and forth: exponential in time.
    wanted = np.log(np.log(1 - 2 * shown) / np.log(1 - exits))
    assert [c.slow for c in changes(model, subject) if c.torsion == 1] == pytest.approx([wanted], abs=0.15)


def lacking_of_psi(model: PeptideSlide, subject: PeptideSubject) -> list[Change]:
    """Psi's two states in frames drawn by their weights, with no error."""
    generator = torch.Generator().manual_seed(0)
    idx = torch.multinomial(torch.from_numpy(subject.weights), 1000, True, generator=generator)
    flux, _, held = _fluxes(model, subject, idx, generator)
    types = subject.chain.places[:, :3].tolist()
    return [Change((*types[r],), k, (a, b), float(flux[r, k, b, a] - flux[r, k, a, b]), 0.0)
            for r, k, a, b in _pairs_of_states(subject, held) if k == 1]  # fmt: skip


def test_populations_from_elsewhere_are_taken_over() -> None:
    """Of psi, whose first side has 80 % of the weight."""
    config = PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4, solvents=("obc2", "tip3p"))
    sets = [_frames(f"ACE-{name}-NME", kind="psi") for name in ("ALA-SER", "SER-ALA", "SER")]
    sets = [replace(f, coordinates=f.coordinates[MIXED]) for f in sets]
    config = with_scale(config, sets)
    subjects = [
        PeptideSubject(f, chain_features(f.scene, config, "tip3p"), np.tile([0.8, 0.2], EACH) * 2.0) for f in sets
    ]
    torch.manual_seed(0)
    model = PeptideSlide(config).requires_grad_(False)
    model.jumps_elsewhere[0].of_change[0, :, 1].normal_()
    jumps, start = model.jumps_elsewhere[0], {name: x.clone() for name, x in model.named_parameters()}

    def lacking(some: list[PeptideSubject]) -> list[float]:
        return [change.lacking for subject in some for change in lacking_of_psi(model, subject)]

    before, alone = np.abs(lacking(subjects[:2])), lacking(subjects[2:])
    shift = change_of(jumps, config, "ALA")
    assert len(before) == 4 and before.mean() > 0.5
    for _ in range(3):
        found = [change for subject in subjects[:2] for change in lacking_of_psi(model, subject)]
        raise_populations(model, 1, population_levels(model, found))
    assert np.abs(lacking(subjects[:2])).mean() < 0.2 * before.mean()
    moved = {name for name, x in model.named_parameters() if not torch.equal(x, start[name])}
    assert moved == {"jumps_elsewhere.0.of_change", "jumps_elsewhere.0.beside_change"}
    assert change_of(jumps, config, "ALA") == pytest.approx(shift, abs=1e-5), "the pace stays"
    caps = [2 + config.types.index(name) for name in ("ACE", "NME")]
    assert not (jumps.beside_change[:, caps] - start["jumps_elsewhere.0.beside_change"][:, caps]).any()
    own = abs(lacking(subjects[2:])[0] - alone[0])
    assert own < before.mean(), "a residue between caps moves by what its type lacks beyond the others, no more"


def test_levels_are_the_likeliest_by_what_is_lacking_and_how_it_errs() -> None:
    config = PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4)
    config = with_scale(config, [_frames(f"ACE-{name}-NME") for name in ("ALA-SER", "VAL")])
    model = PeptideSlide(config)
    alanine, serine, valine, ace, nme = (2 + config.types.index(name) for name in ("ALA", "SER", "VAL", "ACE", "NME"))
    side = population_levels(model, [Change((serine, alanine, nme), 2, (0, 1), 1.0, 0.4)])
    # One residue: N(1, 0.4 + 0.1) beside N(0, 0.1).
    assert side[2, 0, 1][0, serine] == pytest.approx(1 / 6) and side[2, 0, 1].abs().sum() == pytest.approx(1 / 6)
    # Of psi what lies beside a residue is asked as well: N(0, 0.1 + 1).
    psi = population_levels(model, [Change((serine, alanine, nme), 1, (0, 1), 1.0, 0.4)])[1, 0, 1]
    assert psi[0, serine] == pytest.approx(1 / 16) and psi[1, alanine] == psi[1, valine] == pytest.approx(10 / 16)
    assert not psi[1:, [ace, nme]].any() and not psi[2].any()
    capped = population_levels(model, [Change((serine, ace, nme), 1, (0, 1), 1.0, 0.4)])[1, 0, 1]
    assert capped[0, serine] == pytest.approx(1 / 6) and not capped[1:].any()
    sure = [Change((kind, ace, nme), 2, (0, 2), x, 0.0) for kind in (serine, valine) for x in (1.0, 3.0)]
    both = population_levels(model, sure)[2, 0, 2][0, [serine, valine]]
    assert both.tolist() == pytest.approx([2.0 * 20.0 / 30.0] * 2), "the mean of two, held by their own scatter"


def change_of(jumps: torch.nn.Module, config: PeptideConfig, name: str) -> float:
    """Both directions of psi of a residue together."""
    levels = jumps.of_change[0, 2 + config.types.index(name), 1]
    return float(levels[0, 1] + levels[1, 0])


def test_a_solvent_takes_over_what_types_do_and_keeps_its_mean_pace() -> None:
    config = PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4, solvents=("obc2", "tip3p"))
    names = ("ALA", "SER", "ALA-SER", "SER-ALA")
    sets = [_frames(f"ACE-{name}-NME", kind="psi") for name in names]
    config = with_scale(config, sets)
    dry, wet = ([PeptideSubject(f, chain_features(f.scene, config, solvent), np.ones(2 * EACH)) for f in sets]
                for solvent in ("obc2", "tip3p"))  # fmt: skip
    torch.manual_seed(0)
    model = PeptideSlide(config).requires_grad_(False)
    for jumps, slower in ((model.jumps, 1.0), (model.jumps_elsewhere[0], 2.5)):
        jumps.of_change[0, :, 1, :2, :2] = torch.randn(len(model.token_mean) // 2, 2, 2) - slower
    start = {name: x.clone() for name, x in model.jumps.named_parameters()}

    def paces(some: list[PeptideSubject]) -> np.ndarray:
        return np.array([pace for s in some for (_, k, *_), pace in _paces(model, s).items() if k == 1])

    def lacking(some: list[PeptideSubject]) -> np.ndarray:
        return np.array([c.lacking for s in some for c in lacking_of_psi(model, s)])

    before, of_wet, of_dry = paces(wet), lacking(wet), lacking(dry)
    assert abs((before - paces(dry)).mean()) > 0.7
    transfer(model, wet)
    assert paces(wet).mean() == pytest.approx(before.mean(), abs=0.1) and len(before) == 6
    # What goes back and forth within 100 ps lacks less.
    after = lacking(wet)
    assert np.abs(after - of_dry).mean() < 0.4 * np.abs(of_wet - of_dry).mean(), "populations are the first's"
    assert np.corrcoef(after, of_dry)[0, 1] > 0.97
    assert all(torch.equal(x, start[name]) for name, x in model.jumps.named_parameters())


def test_how_likely_the_rare_side_is_sets_the_probabilities() -> None:
    frames = _frames("ACE-ALA-NME")
    config = with_scale(PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4), [frames])
    subject = _subject(frames, config)
    model = PeptideSlide(config).requires_grad_(False)
    (phi,) = weighted_phis(model, subject)
    # Probabilities are the same from either side at first.
    assert lacking_entries(model, phi) == pytest.approx(np.log(SHARE / (1.0 - SHARE)), abs=1e-3)
    assert [config.types[place - 2] for place in phi.chain.places[phi.residue, :3].tolist()] == ["ALA", "ACE", "NME"]


def test_before_a_proline_nothing_is_said() -> None:
    frames = _frames("ACE-ALA-PRO-ALA-NME")
    config = with_scale(PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4), [frames])
    phis = weighted_phis(PeptideSlide(config).requires_grad_(False), _subject(frames, config))
    assert [phi.residue for phi in phis] == [3]


def test_a_side_without_frames_or_weights_says_nothing() -> None:
    frames = _frames("ACE-ALA-NME")
    config = with_scale(PeptideConfig(width=16, n_layers=1, n_heads=1, chunk_frames=4), [frames])
    model = PeptideSlide(config).requires_grad_(False)
    one_sided = PeptideSubject(frames, chain_features(frames.scene, config), np.repeat([2.0, 0.0], EACH))
    alone = PeptideSubject(frames, chain_features(frames.scene, config))
    assert weighted_phis(model, one_sided) == [] and weighted_phis(model, alone) == []
    kept = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    balance(model, [one_sided, alone])
    assert all(torch.equal(tensor, kept[name]) for name, tensor in model.state_dict().items())
