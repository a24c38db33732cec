"""Training the model of peptides: windows of any spacing, what is measured before, and a loss that falls."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from peptide_distil import distil
from torch import Tensor

import surrogate as sm
from small_scenes import with_phi_turned
from surrogate.data import Split, TrainingFrames, canonicalise, quantise
from surrogate.models.architecture import TrainingRequest
from surrogate.models.peptides import subjects as peptide_subjects
from surrogate.models.peptides import trainer as peptide_trainer
from surrogate.models.peptides.chains import ChainFeatures
from surrogate.models.peptides.layout import ENDS, PeptideConfig, chain_features
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.peptides.subjects import PeptideSubject
from surrogate.models.peptides.trainer import (
    PeptideTrainer,
    PeptideTraining,
    normalise,
    state_loss,
    train_peptides,
    with_scale,
)
from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.domain import under_conditions
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.errors import InputError, OutOfDomainError
from systems.prepare.peptide import build_peptide
from systems.trajectory.codec import open_trajectory

SMALL = PeptideConfig(width=32, n_layers=1, n_heads=2, chunk_frames=4, longest_ps=40.0)
CONDITIONS = {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0}


@pytest.fixture(scope="module")
def frames() -> TrainingFrames:
    """Four runs in which every atom trembles with correlation 0.9 from frame to frame."""
    scene = build_peptide("ACE-ALA-NME")
    rng = np.random.default_rng(0)
    x = np.zeros((4, 200, scene.n_atoms, 3))
    x[:, 0] = rng.normal(size=x[:, 0].shape)
    for k in range(1, 200):
        x[:, k] = 0.9 * x[:, k - 1] + 0.436 * rng.normal(size=x[:, 0].shape)
    posed = canonicalise(scene.positions_nm + 0.004 * x.reshape(-1, scene.n_atoms, 3), scene)
    return TrainingFrames(scene, quantise(posed), np.arange(5) * 200, 1.0, True, CONDITIONS, (), split=Split(0.2))


def in_water(frames: TrainingFrames) -> TrainingFrames:
    """Return runs in which atoms tremble twice as far, and forget at once."""
    x = frames.scene.positions_nm + 0.008 * np.random.default_rng(1).normal(size=(800, frames.scene.n_atoms, 3))
    coordinates = quantise(canonicalise(x, frames.scene))
    return replace(frames, coordinates=coordinates, conditions=CONDITIONS | {"solvent": "tip3p"})


@pytest.fixture(scope="module")
def config(frames: TrainingFrames) -> PeptideConfig:
    return with_scale(SMALL, [frames])


@pytest.mark.parametrize("validation", [False, True])
def test_windows_stay_within_a_run_and_its_part(
    frames: TrainingFrames, config: PeptideConfig, validation: bool
) -> None:
    subject = PeptideSubject(frames, chain_features(frames.scene, config))
    idx, times = subject.windows(500, config, torch.Generator().manual_seed(1), validation=validation)
    assert idx.shape == (500, 5) and times.shape == (500, 4)
    assert (idx // 200 == idx[:, :1] // 200).all(), "all of one run"
    part = idx % 200
    assert ((part >= 160) == validation).all(), "and of one side of the split"
    assert ((idx[:, 1:] - idx[:, :1]).float() == times).all()
    assert (times.diff(dim=1) > 0).all() and times.min() >= 1 and times.max() <= 40
    lags = times[(times[:, 1:2] == 2 * times[:, :1]).ravel() & (times[:, 3:] == 4 * times[:, :1]).ravel(), 0]
    assert len(lags) > 150 and len(lags.unique()) > 4, "half of them evenly spaced, at several lags"


def test_windows_read_backwards_came_from_where_equilibrium_is(frames: TrainingFrames, config: PeptideConfig) -> None:
    """Runs hold the third and fourth stretch too often: windows start there forwards, in the others backwards."""
    weights = np.zeros(800)
    weights[:160], weights[200:360], weights[400:560], weights[600:760] = 1.0, 2.5, 0.25, 0.25
    subject = PeptideSubject(frames, chain_features(frames.scene, config), weights)
    idx, times = subject.windows(4000, config, torch.Generator().manual_seed(1))
    endless = times[:, 0] == config.forgotten_ps
    assert 300 < int(endless.sum()) < 500
    assert (times[endless] == config.forgotten_ps).all()
    drawn = np.bincount(idx[endless, 1:].flatten() // 200, minlength=4)
    assert drawn / drawn.sum() == pytest.approx(np.array([1.0, 2.5, 0.25, 0.25]) / 4.0, abs=0.04)
    idx, times = idx[~endless], times[~endless]
    assert (idx // 200 == idx[:, :1] // 200).all() and (idx % 200 < 160).all()
    assert ((idx[:, 1:] - idx[:, :1]).abs().float() == times).all()
    backwards = idx[:, 1] < idx[:, 0]
    assert 1600 < int(backwards.sum()) < 2000
    of_run = np.bincount(idx[backwards, -1] // 200, minlength=4)
    assert of_run[2] == of_run[3] == 0
    assert of_run[1] / of_run[0] == pytest.approx(2.5, rel=0.2)
    assert set((idx[~backwards, 0] // 200).tolist()) == {2, 3}


def test_entries_are_as_likely_as_detailed_balance_asks(config: PeptideConfig, frames: TrainingFrames) -> None:
    """Half of the runs start in a rare state and leave it at a known rate, none enters: what windows show to a network
    that starts in the common state is the entry rate of detailed balance, which averaging with runs from there halves.
    """
    rng = np.random.default_rng(0)
    leaves, share, n_runs, length = 0.03, 0.1, 1000, 60
    left = rng.geometric(leaves, n_runs // 2)
    rare = np.concatenate([np.arange(length) < left[:, None], np.zeros((n_runs // 2, length), dtype=bool)])
    weights = np.where(rare, share / rare.mean(), (1 - share) / (1 - rare.mean())).ravel()
    none = np.zeros((rare.size, *frames.coordinates.shape[1:]), dtype=np.int16)
    many = replace(frames, coordinates=none, starts=np.arange(n_runs + 1) * length, split=Split(0.01))
    subject = PeptideSubject(many, chain_features(frames.scene, config), weights)
    idx, times = subject.windows(8000, replace(config, longest_ps=20.0), torch.Generator().manual_seed(2), later=1)
    state = torch.from_numpy(rare.ravel())
    short = times[:, 0] < 50.0
    common = ~state[idx[:, 0]] & short
    entered = state[idx[:, 1]] & common
    # of one step: leaves * share / (1 - share); of t steps t times that, but for what leaves again
    t = times[common, 0].double()
    expected = share / (1 - share) * (1 - (1 - leaves) ** t)
    assert float(entered.sum() / common.sum()) == pytest.approx(float(expected.mean()), rel=0.25)


def test_batches_are_of_every_length_that_a_chunk_has(frames: TrainingFrames, config: PeptideConfig) -> None:
    subject = PeptideSubject(frames, chain_features(frames.scene, config))
    generator = torch.Generator().manual_seed(0)
    lengths = np.bincount([subject.batch(2, config, generator)[1].shape[1] for _ in range(200)], minlength=5)
    assert lengths[0] == 0 and (lengths[1:4] > 10).all() and 100 < lengths[4] < 150
    idx, times = subject.windows(300, config, generator, later=1)
    assert idx.shape == (300, 2) and times.max() == 40, "a single frame lies as far as the longest time"


def test_positive_phi_weighs_what_metadynamics_says() -> None:
    """Two runs at either sign of phi of both residues: each of the four patterns weighs what its residues'
    probabilities say."""
    scene = build_peptide("ACE-ALA-VAL-NME")
    turned = with_phi_turned(scene)
    rng = np.random.default_rng(0)
    x = np.stack([scene.positions_nm, turned])[np.arange(8) % 2][:, None] + 0.002 * rng.normal(
        size=(8, 100, scene.n_atoms, 3)
    )
    posed = canonicalise(x.reshape(-1, scene.n_atoms, 3), scene)
    frames = TrainingFrames(scene, quantise(posed), np.arange(9) * 100, 1.0, True, CONDITIONS, (), split=Split(0.2))
    subject = PeptideSubject(frames, chain_features(scene, with_scale(SMALL, [frames])))
    weights = subject.in_equilibrium({"ALA": 1.0, "VAL": 2.0}).weights
    assert weights is not None
    of_run = weights.reshape(8, 100)
    assert (of_run[:, 80:] == 0).all(), "held out"
    ratio = of_run[1::2].sum() / of_run[::2].sum()
    assert np.log(ratio) == pytest.approx(-3.0, abs=1e-6)


def test_positive_phi_before_a_proline_is_left_to_the_runs() -> None:
    for sequence, patterns in (("ACE-ALA-VAL-NME", 4), ("ACE-ALA-PRO-NME", 1)):
        scene = build_peptide(sequence)
        x = scene.positions_nm + 0.002 * np.random.default_rng(0).normal(size=(60, scene.n_atoms, 3))
        frames = TrainingFrames(scene, quantise(canonicalise(x, scene)), np.array([0, 60]), 1.0, True, CONDITIONS, ())
        subject = PeptideSubject(frames, chain_features(scene, with_scale(SMALL, [frames])))
        assert len(subject._signs_of_phi(np.arange(60), {"ALA": 1.0, "VAL": 2.0})[1]) == patterns


def test_correlations_are_those_of_the_process(frames: TrainingFrames, config: PeptideConfig) -> None:
    model = PeptideSlide(config)
    normalise(model, [PeptideSubject(frames, chain_features(frames.scene, config))], 0)
    types = torch.tensor([config.types.index("ALA") + 2])
    chain = chain_features(frames.scene, config)
    filled = chain.code.filled[1]
    found = model.correlation_at(torch.tensor([[1.0, 5.0, 40.0]]), types)[0, :, 0, filled].mean(-1)
    np.testing.assert_allclose(found, [0.9, 0.9**5, 0.9**40], atol=0.08)
    numbers, _ = PeptideSubject(frames, chain).seen(model, torch.arange(0, 160))
    assert float(numbers[:, 1, filled].std()) == pytest.approx(1.0, abs=0.15)


def test_frames_far_apart_say_nothing_of_shorter_times(frames: TrainingFrames, config: PeptideConfig) -> None:
    """Every tenth frame beside all: at 1 ps the correlation stays that of all, and is no mean with that at 10 ps."""
    chain = chain_features(frames.scene, config)
    sparse = replace(frames, coordinates=frames.coordinates[::10], starts=frames.starts // 10, lag_ps=10.0)
    types = torch.tensor([config.types.index("ALA") + 2])

    def correlations(*sets: TrainingFrames) -> torch.Tensor:
        model = PeptideSlide(config)
        normalise(model, [PeptideSubject(f, chain) for f in sets], 0)
        return model.correlation_at(torch.tensor([[1.0, 10.0]]), types)[0, :, 0, chain.code.filled[1]].mean(-1)

    alone, both = correlations(frames), correlations(frames, sparse)
    assert float(both[0]) == pytest.approx(float(alone[0]), abs=0.01)
    np.testing.assert_allclose(both, [0.9, 0.9**10], atol=0.08)


def test_batches_show_crossings_of_phi_apart_from_what_is_likely(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs that stand on one side of phi and, from frame 50 on, on the other: half of the windows made to hold the
    crossing are read backwards, and then only from runs whose frames equilibrium has."""
    scene = build_peptide("ACE-ALA-NME")
    rng = np.random.default_rng(0)
    side = (np.arange(8) % 2)[:, None] ^ (np.arange(100) >= 50)
    x = np.stack([scene.positions_nm, with_phi_turned(scene)])[side]
    x = x + 0.002 * rng.normal(size=x.shape)
    posed = canonicalise(x.reshape(-1, scene.n_atoms, 3), scene)
    frames = TrainingFrames(scene, quantise(posed), np.arange(9) * 100, 1.0, True, CONDITIONS, (), split=Split(0.2))
    config = with_scale(SMALL, [frames])
    weights = np.repeat([1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0], 100)
    subject = PeptideSubject(frames, chain_features(scene, config), weights)
    idx, times = subject.batch(4000, config, torch.Generator().manual_seed(0))
    with monkeypatch.context() as patch:
        patch.setattr(peptide_subjects, "_CROSSING_SHARE", 0.0)
        drawn, same = subject.batch(4000, config, torch.Generator().manual_seed(0))
    assert torch.equal(times, same), "spacings are kept"
    crossing = (idx != drawn).any(1) & (times[:, 0] < config.forgotten_ps)
    assert (idx[crossing] // 100 == idx[crossing, :1] // 100).all() and (idx[crossing] % 100 < 80).all()
    assert (((idx[crossing] % 100) < 50).any(1) & ((idx[crossing] % 100) >= 50).any(1)).all()
    assert ((idx[crossing, 1:] - idx[crossing, :1]).abs().float() == times[crossing]).all()
    assert 0.1 < float(crossing.float().mean()) < 0.16
    backwards = idx[crossing, -1] < idx[crossing, 0]
    assert 0.3 < float(backwards.float().mean()) < 0.6
    runs = idx[crossing, 0] // 100
    assert set(runs[~backwards].tolist()) == set(range(8))
    assert set(runs[backwards].tolist()) == {0, 1, 4, 5, 6, 7}
    # Of what stays on its side no window is made.
    still = replace(frames, coordinates=np.repeat(frames.coordinates[:1], 800, axis=0))
    calm = PeptideSubject(still, subject.chain, weights)
    found = calm.batch(50, config, torch.Generator().manual_seed(1))[0]
    monkeypatch.setattr(peptide_subjects, "_CROSSING_SHARE", 0.0)
    assert torch.equal(found, calm.batch(50, config, torch.Generator().manual_seed(1))[0])


def test_a_training_learns_and_its_weights_roll_at_any_lag(tmp_path: Path, frames: TrainingFrames) -> None:
    seen: list[dict[str, float]] = []
    training = PeptideTraining(steps=200, batch=32, learning_rate=3e-3, validate_every_s=1e9)
    out = train_peptides(
        [frames], tmp_path / "w.safetensors", replace(SMALL, conditioning_noise=0.0), training,
        progress=lambda stage, share, metrics: seen.append(metrics) if metrics else None,
    )  # fmt: skip
    flow, jumps = (
        [metrics[key] for metrics in seen if key in metrics] for key in ("validation_flow", "validation_jumps")
    )
    assert flow[-1] < 0.999 and 0.0 < jumps[-1] < 0.1, "states that never change are hardly likely to"
    assert not list(tmp_path.glob("*.train.*"))
    weights = load_weights(out)
    with out.with_suffix(".csv").open() as curves:
        ends = {row["stage"]: float(row["spent_s"]) for row in csv.DictReader(curves)}
    assert list(ends) == ["flow", "jumps", "ending"] and all(ends.values())
    assert weights.domain.longest_lag_ps == pytest.approx(40.0, rel=0.1)
    for lag_ps in (1.0, 20.0):
        trajectory = tmp_path / f"{lag_ps:g}.h5"
        rollout(
            frames.scene, weights, [trajectory],
            RolloutConfig(time_ps=6 * lag_ps, lag_ps=lag_ps, precision="fp32", solver_steps=3, guard="off"),
        )  # fmt: skip
        with open_trajectory(trajectory) as reader:
            assert reader.n_frames == 6
            assert np.isfinite(reader.read()).all()


def test_hidden_numbers_are_left_out_until_the_end_of_a_training(
    tmp_path: Path, frames: TrainingFrames, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[float] = []

    def spied(*args: Any, dropped: float = 0.0, **more: Any) -> Tensor:
        told.append(dropped)
        return state_loss(*args, dropped=dropped, **more)

    monkeypatch.setattr(peptide_trainer, "state_loss", spied)
    train_peptides(
        [frames], tmp_path / "a.safetensors", SMALL, PeptideTraining(steps=10, batch=4, validate_every_s=1e9)
    )
    # Validations follow the nine steps and the last.
    assert told == [0.2] * 9 + [0.0] * (len(told) - 9) and len(told) > 10


def test_a_training_goes_on_from_weights_with_their_scales(tmp_path: Path, frames: TrainingFrames) -> None:
    """A few steps at a rate of nothing leave all as it was; new frames would have other scales."""
    first = PeptideTraining(steps=3, batch=8, validate_every_s=1e9)
    start = load_weights(train_peptides([frames], tmp_path / "a.safetensors", SMALL, first))
    calmer = replace(frames, coordinates=np.repeat(frames.coordinates[:400], 2, axis=0))
    still = replace(first, learning_rate=1e-12)
    found = load_weights(train_peptides([calmer], tmp_path / "b.safetensors", SMALL, still, start=start))
    anew = load_weights(train_peptides([calmer], tmp_path / "c.safetensors", SMALL, still))
    for name, value in start.model.state_dict().items():
        torch.testing.assert_close(found.model.state_dict()[name], value, rtol=0, atol=2e-3)
    assert not torch.equal(anew.model.correlation, start.model.correlation)
    assert found.model.config == start.model.config


def test_a_training_goes_on_with_peptides_that_have_coordinates_of_which_its_start_knew_nothing(
    tmp_path: Path, frames: TrainingFrames, config: PeptideConfig
) -> None:
    """Both ends of a free chain: what is known keeps its place, its scale and its weights, what is new gets those of
    its frames, and an end that one residue bore is known of all."""
    scene = build_peptide("ALA-ALA")
    x = scene.positions_nm + 0.004 * np.random.default_rng(1).normal(size=(800, scene.n_atoms, 3))
    free = replace(frames, scene=scene, coordinates=quantise(canonicalise(x, scene)))
    assert config.scale is not None
    still = PeptideTraining(steps=1, batch=4, learning_rate=1e-12, validate_every_s=1e9)
    start = load_weights(train_peptides([frames], tmp_path / "a.safetensors", config, still))
    found = load_weights(train_peptides([free], tmp_path / "b.safetensors", config, still, start=start))
    known, more = start.model.config.scale, found.model.config.scale
    assert known.slots.items() < more.slots.items() and known.mean.items() < more.mean.items()
    chain = chain_features(scene, found.model.config)
    numbers, _ = found.model.normalised(torch.from_numpy(x.astype(np.float32)), chain)
    new = numbers[..., chain.code.filled][:, [key not in known.slots for key in _numbered(chain)]]
    assert 0.5 < float(new.square().mean()) < 2.0
    assert more.n_slots > known.n_slots
    for name, before in start.model.state_dict().items():
        kept = found.model.state_dict()[name][tuple(slice(n) for n in before.shape)]
        if name in ("token_mean", "token_scale", "correlation"):
            slots = [slot for key, slot in known.slots.items() if key.startswith("ALA ")]
            kept, before = kept[..., slots], before[..., slots]
        torch.testing.assert_close(kept, before, rtol=0, atol=2e-3)
    for name in ("token_mean", "token_scale", "correlation"):
        of_ends = found.model.state_dict()[name][..., known.n_slots :]
        assert of_ends.std() > 0.0
        torch.testing.assert_close(of_ends, of_ends[:1].expand_as(of_ends))


def _numbered(chain: ChainFeatures) -> list[str]:
    """Return the keys of a chain's numbers, in the order of its residues and slots."""
    layout, code = chain.code.layout, chain.code
    keys = dict(zip(code.stiff_at.tolist(), [layout.keys[k] for k in code.stiff.tolist()], strict=True))
    for at, k in zip(code.turning_at.tolist(), code.turning.tolist(), strict=True):
        keys[at] = keys[at + 1] = layout.keys[k]
    return [keys[at] for at in sorted(keys)]


def test_what_goes_on_from_weights_takes_their_configuration(tmp_path: Path, frames: TrainingFrames) -> None:
    out = train_peptides([frames], tmp_path / "a.safetensors", SMALL, PeptideTraining(steps=1, batch=4))
    request = TrainingRequest("lam-slide-peptides", tmp_path / "b.safetensors", steps=2, start_from=out)
    trainer = PeptideTrainer()
    trainer.check(request)
    assert trainer.settings(request).model == load_weights(out).model.config
    with pytest.raises(InputError, match=r"leave \[model\] of `config` out"):
        trainer.check(replace(request, model={"width": 64}))
    with pytest.raises(InputError, match="holds lam-slide-peptides, not lam-slide"):
        sm.explain_training([tmp_path / "ref.h5"], arch="lam-slide", start_from=out, steps=2)


def test_a_flow_is_taught_to_end_in_two_evaluations_where_it_ended_in_six(
    tmp_path: Path, frames: TrainingFrames
) -> None:
    """Nearer than its own two steps come, with the same probabilities of states; the weights say how many steps they
    take."""
    training = PeptideTraining(steps=100, batch=32, learning_rate=3e-3, validate_every_s=1e9)
    start = train_peptides([frames], tmp_path / "a.safetensors", SMALL, training)
    labeller = load_weights(start)
    apart = {}
    for name, rate, n in (("still", 1e-12, 1), ("taught", 1e-3, training.steps)):
        taught = replace(training, learning_rate=rate, steps=n)
        out = distil([frames], load_weights(start), tmp_path / f"{name}.safetensors", taught, steps=2)
        with out.with_suffix(".csv").open() as curves:
            apart[name] = [float(row["validation_apart"]) for row in csv.DictReader(curves)][-1]
    assert apart["taught"] < 0.5 * apart["still"]
    found = load_weights(out)
    assert (labeller.model.usual_steps, found.model.usual_steps) == (6, 2)
    assert (labeller.model.solvers[0], found.model.solvers[0]) == ("gaussian", "angular")
    assert sorted(labeller.model.solvers) == sorted(found.model.solvers)
    with pytest.raises(InputError, match="usual_solver = 'angle' is none of gaussian, angular"):
        PeptideSlide(replace(found.model.config, usual_solver="angle"))
    for name, tensor in labeller.model.jumps.state_dict().items():
        torch.testing.assert_close(found.model.jumps.state_dict()[name], tensor)
    assert found.provenance["distilled_to_steps"] == 2
    last = torch.from_numpy(frames.positions_nm(np.arange(0, 800, 50)))[:, None]
    noise = torch.randn(len(last), *labeller.model.noise_shape(frames.scene.n_atoms))

    def rolled(weights: Weights, steps: int) -> torch.Tensor:
        model = weights.model
        chunk = model.next_chunk(last, model.featurise(frames.scene), noise, solver_steps=steps, solver="angular")
        return chunk.frames_nm

    there = rolled(labeller, 6)
    ours, its_own = ((rolled(weights, 2) - there).square().mean() for weights in (found, labeller))
    assert ours < 0.5 * its_own
    # Taught again, by what the labeller has become, it begins changed as much as that.
    further, once = load_weights(start), replace(training, steps=1, learning_rate=1e-12)
    for p in further.model.flow.parameters():
        p.data += 0.01
    again = distil([frames], further, tmp_path / "again.safetensors", once, steps=2, earlier=(found, labeller))
    for name, tensor in load_weights(again).model.flow.named_parameters():
        torch.testing.assert_close(tensor, found.model.flow.get_parameter(name) + 0.01)
    # What learns further from it ends in two evaluations no more.
    request = TrainingRequest("lam-slide-peptides", tmp_path / "on.safetensors", steps=1, start_from=out)
    model, once = PeptideTrainer().settings(request).model, replace(training, steps=1)
    on = load_weights(train_peptides([frames], request.out, model, once, start=found)).model
    assert (on.usual_steps, on.solvers[0]) == (6, "gaussian")


def test_runs_too_short_to_hold_a_chunk_out_are_trained_on_without(frames: TrainingFrames, tmp_path: Path) -> None:
    short = replace(frames, split=Split(0.01))
    once = PeptideTraining(steps=1)
    load_weights(train_peptides([frames, short], tmp_path / "a.safetensors", SMALL, once))
    with pytest.raises(InputError, match="hold no window of 4 frames"):
        train_peptides([short], tmp_path / "b.safetensors", SMALL, once)


def test_probabilities_of_states_or_the_flow_can_be_trained_alone(frames: TrainingFrames, tmp_path: Path) -> None:
    first = train_peptides(
        [frames], tmp_path / "a.safetensors", replace(SMALL, usual_steps=3), PeptideTraining(steps=2)
    )
    start, alone = load_weights(first), PeptideTraining(steps=2, tuned="states")
    with pytest.raises(InputError, match="goes on from weights"):
        train_peptides([frames], tmp_path / "b.safetensors", SMALL, alone)
    coupled = replace(SMALL, coupled=True)
    found = load_weights(train_peptides([frames], tmp_path / "b.safetensors", coupled, alone, start=start)).model
    before, after = start.model.state_dict(), found.state_dict()
    assert all(torch.equal(tensor, after[name]) == (not name.startswith("jumps.of_given")) for name, tensor in
               before.items() if name.startswith(("flow", "token", "correlation", "jumps.of_given")))  # fmt: skip
    assert any(name.startswith("jumps.blocks") for name in after) and found.usual_steps == 3
    on = load_weights(train_peptides([frames], tmp_path / "c.safetensors", SMALL, alone, start=load_weights(first)))
    assert not any(name.startswith("jumps.blocks") for name in on.model.state_dict())
    alone = replace(alone, tuned="flow")
    on = load_weights(train_peptides([frames], tmp_path / "d.safetensors", SMALL, alone, start=load_weights(first)))
    after = on.model.state_dict()
    moved = {name.split(".")[0] for name, tensor in before.items() if not torch.equal(tensor, after[name])}
    assert moved == {"flow"} and on.model.usual_steps == 6


def test_weights_of_two_solvents_know_which_is_meant(frames: TrainingFrames, tmp_path: Path) -> None:
    """What training saw in the other stays."""
    wet = in_water(frames)
    first = load_weights(train_peptides([frames], tmp_path / "a.safetensors", SMALL, PeptideTraining(steps=2)))
    assert first.model.config.solvents == () and first.model.flow.of_solvent is None
    found = {
        tuned: load_weights(
            train_peptides([wet], tmp_path / f"{tuned}.safetensors", SMALL,
                           PeptideTraining(steps=20, tuned=tuned), start=first)
        )
        for tuned in ("states", "all")
    }  # fmt: skip
    model, n = found["states"].model, len(first.model.token_mean)
    assert model.config.solvents == ("obc2", "tip3p") and len(model.token_mean) == 2 * n
    # What was known of the first solvent stays, and the flow too where only states are trained.
    for name in ("token_mean", "token_scale", "correlation"):
        assert torch.equal(getattr(model, name)[:n], getattr(first.model, name))
    before = dict(first.model.named_parameters())
    moved = {
        tuned: {
            name for name, p in one.model.named_parameters()
            if name in before and not torch.equal(before[name], p[tuple(map(slice, before[name].shape))])
        }
        for tuned, one in found.items()
    }  # fmt: skip
    assert not moved["states"] and moved["all"] and all(name.startswith("flow") for name in moved["all"])
    (elsewhere,) = model.jumps_elsewhere
    assert not torch.equal(elsewhere.of_change, first.model.jumps.of_change)
    assert bool(found["all"].model.flow.of_solvent.weight[-1].any())
    covered = {tuned: [m.conditions["solvent"] for m in one.domain.members] for tuned, one in found.items()}
    assert covered == {"states": ["obc2", "tip3p"], "all": ["tip3p"]}
    assert torch.equal(model.token_scale[n:], model.token_scale[:n]), "as the flow, which stays, was trained with"
    # Residue types that are not in the water data have there what they have elsewhere.
    model = found["all"].model
    ala, gone = (n + (*ENDS, *model.config.types).index(name) for name in ("ALA", "NME"))
    assert float((model.token_scale[ala] / model.token_scale[ala - n]).median()) > 1.5
    assert torch.equal(model.token_mean[n], model.token_mean[0]) and not torch.equal(
        model.token_mean[gone], model.token_mean[gone - n]
    )


def test_a_rollout_says_in_which_solvent_of_its_weights(
    frames: TrainingFrames, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wet = in_water(frames)
    both = train_peptides([frames, wet], tmp_path / "w.safetensors", SMALL, PeptideTraining(steps=2))
    told = sm.info(both)
    assert told["molecules"] == ["ACE-ALA-NME"] and "obc2 or tip3p" in told["summary"]
    assert "ff14SB/tip3p" in told["solvents"]["tip3p"]
    for solvent in (None, "tip3p"):
        sm.rollout(frames.scene, both, tmp_path / f"{solvent}_short.h5", time_ps=8.0, solvent=solvent, guard="off")
        assert ("no solvent named: taken to be in obc2" in capsys.readouterr().err) == (solvent is None)
    deviations = {}
    for solvent in (None, "obc2", "tip3p"):
        out = tmp_path / f"{solvent}.h5"
        config = RolloutConfig(time_ps=120.0, save_every_ps=1.0, guard="off", solvent=solvent)
        rollout(frames.scene, load_weights(both), [out], config)
        with open_trajectory(out) as reader:
            assert reader.record["solvent"] == (solvent or "obc2")
            apart = np.diff(reader.read()[:, [6, 10]], axis=1)  # N and C about CA
            deviations[solvent] = float(np.linalg.norm(apart, axis=-1).std())
    assert deviations[None] == deviations["obc2"] < 0.8 * deviations["tip3p"]
    with pytest.raises(OutOfDomainError, match="was trained in obc2 and tip3p, not in opc"):
        under_conditions(load_weights(both), {"solvent": "opc"})
    # Trained on in water alone, weights are of water.
    on = train_peptides([wet], tmp_path / "on.safetensors", SMALL, PeptideTraining(steps=2), start=load_weights(both))
    assert under_conditions(load_weights(on), {}).model.solvent == "tip3p"
    assert "ff14SB/tip3p" in sm.info(on)["summary"] and "solvents" not in sm.info(on)
    sm.rollout(frames.scene, on, tmp_path / "on.h5", time_ps=8.0, guard="off")
    assert "no solvent named" not in capsys.readouterr().err
    with pytest.raises(OutOfDomainError, match="solvent tip3p, not obc2"):
        under_conditions(load_weights(on), {"solvent": "obc2"})
