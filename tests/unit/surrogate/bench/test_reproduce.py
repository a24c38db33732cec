"""Forecast tasks: errors by hand, splits that share nothing, data that goes on, models that know their symmetries."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from surrogate.bench.reproduce.forecast_errors import estimate, forecast_errors, ratio
from surrogate.bench.reproduce.forecast_methods import N_GIVEN, Settings, extrapolate, polynomial_weights
from surrogate.bench.reproduce.n_body import reproduce, table_lines
from surrogate.bench.reproduce.n_body_data import make_sets, make_systems, split_seeds
from surrogate.bench.reproduce.n_body_methods import METHODS, best_polynomial, set_forecaster
from surrogate.bench.reproduce.n_body_views import ParticleView, WindowView
from surrogate.bench.reproduce.published import PUBLISHED
from surrogate.cli.main import app
from surrogate.data.particle_sets import ParticleSet, append_systems, check_disjoint, n_complete, read_set
from surrogate.models.lam_slide.losses import autoencoder_loss, random_rotations
from surrogate.models.particles.flow_trainer import sample_ahead
from surrogate.models.particles.model import EgnnJump, EgnnJumpConfig, PairForces, PairForcesConfig
from surrogate.models.particles.particle_flow import Given, ParticleFlow, ParticleFlowConfig
from surrogate.models.particles.trainer import turned_windows
from systems.errors import InputError, UnknownNameError

COUNTS = {"train": 8, "validation": 3, "test": 4}


@pytest.fixture(scope="module")
def springs() -> ParticleSet:
    return make_systems("n-body-spring", range(12))


@pytest.fixture(scope="module")
def charges() -> ParticleSet:
    return make_systems("n-body-charged", range(6))


# ---- errors --------------------------------------------------------------------------------------------------------


def test_errors_equal_those_computed_by_hand() -> None:
    truth = np.zeros((2, 2, 2, 3))
    predicted = np.zeros((2, 2, 2, 2, 3))
    predicted[0, 0, 0, 0] = [3.0, 4.0, 0.0]  # sample 0, trajectory 0, frame 0, particle 0: off by 5
    predicted[1, 0, 1, 1] = [0.0, 0.0, 2.0]  # sample 1, trajectory 0, last frame, particle 1: off by 2
    predicted[:, 1] += [1.0, 2.0, 2.0]  # trajectory 1: off by 3 everywhere
    ade, fde = forecast_errors(predicted, truth)
    np.testing.assert_allclose(ade, [(5.0 + 2.0) / 8, 3.0], rtol=1e-14)
    np.testing.assert_allclose(fde, [2.0 / 4, 3.0], rtol=1e-14)
    # Negative controls: neither the best sample nor the root mean square nor the sum of coordinates gives these.
    distance = np.linalg.norm(predicted - truth, axis=-1)
    assert not np.allclose(distance.mean((2, 3)).min(0), ade)
    assert not np.allclose(np.sqrt((distance**2).mean((0, 2, 3))), ade)
    assert not np.allclose(np.abs(predicted - truth).sum(-1).mean((0, 2, 3)), ade)


def test_errors_of_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        forecast_errors(np.zeros((5, 2, 4, 3)), np.zeros((2, 4, 3, 3)))
    with pytest.raises(ValueError, match="do not fit"):
        forecast_errors(np.zeros((1, 3, 20, 5, 3)), np.zeros((2, 20, 5, 3)))


def test_intervals_shrink_with_trajectories_and_ratios_are_paired() -> None:
    errors = np.random.default_rng(1).exponential(size=400)
    found = estimate(errors)
    assert found.low < found.value < found.high
    assert (found.high - found.low) == pytest.approx(2 * 1.96 / 20, rel=0.25)  # an exponential's deviation is one
    twice = ratio(2 * errors, errors)
    assert (twice.low, twice.value, twice.high) == pytest.approx((2.0, 2.0, 2.0))
    shuffled = ratio(2 * errors[::-1], errors)
    assert shuffled.high - shuffled.low > 0.1


# ---- data ----------------------------------------------------------------------------------------------------------


def test_sets_are_made_once_go_on_and_share_nothing(tmp_path: Path) -> None:
    path = tmp_path / "set" / "n-body-spring.h5"
    make_sets("n-body-spring", path, {"train": 3, "validation": 3, "test": 0}, workers=1)
    before = read_set(path, "train")
    seen: list[tuple[int, int]] = []
    make_sets(
        "n-body-spring", path, COUNTS, workers=1, progress=lambda done, total, note=None: seen.append((done, total))
    )
    assert seen[-1] == (15, 15)
    assert len(seen) == 2  # the rest of training, and test: validation was there
    sets = [read_set(path, split) for split in COUNTS]
    assert [len(s) for s in sets] == list(COUNTS.values())
    np.testing.assert_array_equal(sets[0].positions_nm[:3], before.positions_nm)
    np.testing.assert_array_equal(sets[0].positions_nm, make_systems("n-body-spring", range(8)).positions_nm)
    assert list(sets[2].seeds) == list(split_seeds("test", 4))
    check_disjoint(sets)
    with pytest.raises(InputError, match="share trajectories"):
        check_disjoint([sets[0], sets[0].first(1)])
    # The same system under another seed is found by where it starts.
    with pytest.raises(InputError, match="share trajectories"):
        check_disjoint([sets[0], replace(sets[0], seeds=sets[0].seeds + 500)])
    with pytest.raises(InputError, match="differ"):
        make_sets("n-body-charged", path, COUNTS, workers=1)
    with pytest.raises(InputError, match="holds 4 test trajectories, not 9"):
        read_set(path, "test", 9)


def test_a_half_written_block_is_written_again(tmp_path: Path, springs: ParticleSet) -> None:
    import h5py

    path = tmp_path / "s.h5"
    make_sets("n-body-spring", path, {"train": 2, "validation": 0, "test": 0}, workers=1)
    with h5py.File(path, "r+") as handle:  # as a killed run leaves it: rows, but not yet counted
        handle["train/positions_nm"].resize(5, axis=0)
        handle["train/positions_nm"][2:] = np.nan
    append_systems(path, "train", replace(springs.first(4), seeds=springs.seeds[:4] + 2))
    assert n_complete(path, "train") == 6
    assert np.isfinite(read_set(path, "train").positions_nm).all()
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InputError, match="cannot be read"):
        n_complete(path, "train")


def test_kinds_of_pairs_follow_charges_and_springs(springs: ParticleSet, charges: ParticleSet) -> None:
    i, j = np.nonzero(~np.eye(5, dtype=bool))
    same = charges.types[:, i] == charges.types[:, j]
    np.testing.assert_array_equal(charges.pairs[:, i, j].astype(bool), same)
    assert set(np.unique(charges.types)) == {1, 2}
    assert (springs.pairs == springs.pairs.transpose(0, 2, 1)).all()
    assert 0.2 < springs.pairs[:, i, j].mean() < 0.8


# ---- methods -------------------------------------------------------------------------------------------------------


def test_extrapolation_is_exact_for_its_polynomial_and_not_beyond() -> None:
    t = 0.1 * np.arange(30)
    cubic = np.stack([1 - t + t**3, 2 * t**2, 0.5 - t**3], axis=-1)[None, :, None, :]
    given, truth = cubic[:, :N_GIVEN], cubic[:, N_GIVEN:]
    for n_points in (4, 7):
        np.testing.assert_allclose(extrapolate(given, polynomial_weights(3, n_points)), truth, rtol=0, atol=1e-10)
    assert np.abs(extrapolate(given, polynomial_weights(2, 4)) - truth).max() > 1.0
    np.testing.assert_allclose(extrapolate(given, polynomial_weights(1, 2))[:, 0], 2 * given[:, -1] - given[:, -2])
    with pytest.raises(ValueError, match="degree 4"):
        polynomial_weights(4, 4)


def test_springs_are_polynomials_to_beyond_the_published_errors(springs: ParticleSet) -> None:
    degree, _, weights = best_polynomial(springs)
    ade, _ = forecast_errors(extrapolate(springs.positions_nm[:, :N_GIVEN], weights)[None],
                             springs.positions_nm[:, N_GIVEN:])  # fmt: skip
    assert degree >= 5
    assert ade.mean() < 1e-4 < min(entry[0] for entry in PUBLISHED["n-body-spring"].values())


@pytest.mark.parametrize("relative", [True, False])
def test_windows_come_back_from_the_models_view(charges: ParticleSet, relative: bool) -> None:
    x = charges.positions_nm
    view = WindowView.of(charges, polynomial_weights(1, 2) if relative else None)
    seen = view.to_model(x)
    np.testing.assert_allclose(view.from_model(x[:, :N_GIVEN], seen[:, N_GIVEN:]), x[:, N_GIVEN:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(view.given(x[:, :N_GIVEN]), seen[:, :N_GIVEN], rtol=0, atol=1e-12)
    # What is given must not carry the future: other predicted frames leave it as it is.
    other = x.copy()
    other[:, N_GIVEN:] += 1.0
    np.testing.assert_array_equal(view.to_model(other)[:, :N_GIVEN], seen[:, :N_GIVEN])
    if relative:
        np.testing.assert_allclose((seen[:, N_GIVEN:] ** 2).mean(axis=(0, 2, 3)), 1.0, rtol=1e-12)


def _turned(data: ParticleSet) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(4)
    rotation = random_rotations(1, generator)[0].double()
    order = torch.randperm(5, generator=generator)
    x, v = (torch.from_numpy(s) for s in (data.positions_nm, data.velocities_nm_ps))
    return rotation, order, x, v, torch.from_numpy(data.types), torch.from_numpy(data.pairs)


def test_egnn_turns_and_permutes_with_its_input_and_sees_pairs(charges: ParticleSet) -> None:
    torch.manual_seed(0)
    model = EgnnJump(EgnnJumpConfig(width=16, n_layers=2))
    rotation, order, x, v, types, pairs = (t.float() if t.is_floating_point() else t for t in _turned(charges))
    plain = model(x[:, 9], v[:, 9], types, pairs, 7)
    turned = model(x[:, 9] @ rotation.T + 2.0, v[:, 9] @ rotation.T, types, pairs, 7)
    torch.testing.assert_close(turned, plain @ rotation.T + 2.0, rtol=0, atol=2e-5)
    moved = model(x[:, 9][:, order], v[:, 9][:, order], types[:, order], pairs[:, order][:, :, order], 7)
    torch.testing.assert_close(moved, plain[:, order], rtol=0, atol=2e-5)
    assert (model(x[:, 9], v[:, 9], types, 1 - pairs, 7) - plain).abs().max() > 1e-3


def test_pair_forces_are_the_true_law_when_given_it_and_keep_momentum(charges: ParticleSet) -> None:
    model = PairForces(PairForcesConfig(forecast_substeps=20)).double()
    with torch.no_grad():
        model.constant[0, 3], model.constant[1, 3] = -1.0, 1.0  # Coulomb: 1/r^2, unlike charges attract
    _, _, x, v, _, pairs = _turned(charges)
    given, truth = x[:, :N_GIVEN], x[:, N_GIVEN:]
    forecast = model.forecast(given, pairs, 20)
    errors = (forecast - truth).norm(dim=-1).mean((1, 2))
    assert errors.median() < 5e-3
    velocity = model.last_velocity(x[:, 4:10], pairs)
    assert (velocity - v[:, 9]).norm(dim=-1).median() < 5e-3
    torch.testing.assert_close(model.forces(x[:, 0], pairs).sum(1), torch.zeros(len(x), 3).double(), atol=1e-9, rtol=0)
    with torch.no_grad():
        model.constant.neg_()  # negative control: the wrong sign
    wrong = (model.forecast(given, pairs, 20) - truth).norm(dim=-1).mean((1, 2))
    assert wrong.median() > 0.3


def test_the_velocity_of_a_pair_that_turns_between_two_frames_needs_more_than_two() -> None:
    model = PairForces(PairForcesConfig(fine_substeps=100)).double()
    pairs = torch.zeros(1, 2, 2, dtype=torch.int64)
    x = torch.tensor([[[0.15, 0.0, 0.0], [-0.15, 0.0, 0.0]]]).double()
    v = torch.tensor([[[0.0, 0.5, 0.0], [0.0, -0.5, 0.0]]]).double()
    frames = [x]
    with torch.no_grad():
        model.constant[0, 3] = -1.0  # unlike charges on an ellipse, the nearest point between the last two frames
        for _ in range(5):
            x, v = model.step(x, v, pairs, 400)
            frames.append(x)
        given = torch.stack(frames, 1)
        assert (model.last_velocity(given, pairs) - v).norm() < 0.01
        # Negative control: a straight line between the last two starts the search on the wrong side.
        assert (model.last_velocity(given[:, -2:], pairs) - v).norm() > 1.0
    with pytest.raises(ValueError, match="two frames"):
        model.last_velocity(given[:, :1], pairs)


def test_particles_come_back_from_their_view_and_given_frames_carry_no_future(charges: ParticleSet) -> None:
    x = charges.positions_nm
    view = ParticleView.of(charges, polynomial_weights(1, 3))
    seen = view.to_model(x, charges)
    back = view.from_model(x[:, :N_GIVEN], seen.ahead.double().numpy())
    np.testing.assert_allclose(back, x[:, N_GIVEN:], rtol=0, atol=1e-5)
    other = x.copy()
    other[:, N_GIVEN:] += 1.0
    torch.testing.assert_close(view.to_model(other, charges).given.features, seen.given.features, rtol=0, atol=0)
    # The last step stands where pair messages look for it, and its size is one.
    step = x[:, 9] - x[:, 8]
    step = (step - step.mean(1, keepdims=True)) / view.sizes_nm[1]
    np.testing.assert_allclose(seen.given.features[..., 3:6].numpy(), step, rtol=0, atol=1e-5)
    # Where the system is and how fast it moves as a whole is not told, and comes back all the same.
    flown = x + 3.0 + 0.2 * np.arange(30)[:, None, None]
    moved = view.to_model(flown, charges)
    torch.testing.assert_close(moved.given.features, seen.given.features, rtol=0, atol=1e-4)
    torch.testing.assert_close(moved.ahead, seen.ahead, rtol=0, atol=1e-4)


def test_mirrored_windows_are_turned_reflected_and_run_backwards(charges: ParticleSet) -> None:
    view = ParticleView.of(charges, polynomial_weights(1, 3))
    one = charges.first(1)
    forwards, backwards = (view.to_model(x, one).given.features for x in (one.positions_nm, one.positions_nm[:, ::-1]))

    def lengths(features: torch.Tensor) -> torch.Tensor:
        return features.unflatten(-1, (-1, 3)).norm(dim=-1)

    for mirrored, n_kinds in ((True, 2), (False, 1)):
        drawn = view.drawn(one, mirrored=mirrored)(64, torch.Generator().manual_seed(0)).given.features
        ahead = (lengths(drawn) - lengths(forwards)).abs().amax((1, 2)) < 1e-3
        back = (lengths(drawn) - lengths(backwards)).abs().amax((1, 2)) < 1e-3
        assert (ahead | back).all()
        assert bool(back.any()) == mirrored
        # Handedness of the last positions and steps tells a reflection from a turn.
        sense = torch.linalg.det(drawn[ahead, 0, :9].unflatten(-1, (3, 3))).sign()
        assert len(sense.unique()) == n_kinds


@pytest.mark.parametrize(("frames_per_token", "pair_messages"), [(20, True), (20, False), (5, True)])
def test_particle_flow_permutes_with_its_particles(
    charges: ParticleSet, frames_per_token: int, pair_messages: bool
) -> None:
    torch.manual_seed(0)
    view = ParticleView.of(charges, polynomial_weights(1, 3))
    given = view.known(charges.positions_nm[:, :N_GIVEN], charges)
    n_features = given.features.shape[-1]
    config = ParticleFlowConfig(
        n_features, frames_per_token=frames_per_token, width=32, n_layers=2, pair_messages=pair_messages
    )
    model = ParticleFlow(config)
    noise, tau = torch.randn(len(charges), 5, 20, 3), torch.rand(len(charges))
    assert (model(noise, tau, given) == 0).all()  # a fresh network predicts the mean of what it learns
    for p in model.parameters():
        torch.nn.init.normal_(p, std=0.2)
    plain = model(noise, tau, given)
    order = torch.randperm(5)
    turned = Given(given.features[:, order], given.types[:, order], given.pairs[:, order][:, :, order])
    torch.testing.assert_close(model(noise[:, order], tau, turned), plain[:, order], rtol=0, atol=1e-4)
    # Negative controls: kinds left behind, and what the flow time, the pairs and each given frame say.
    assert (model(noise, tau, Given(given.features, given.types.flip(1), given.pairs)) - plain).abs().max() > 1e-3
    assert (model(noise, 1 - tau, given) - plain).abs().max() > 1e-3
    other = model(noise, tau, Given(given.features, given.types, 1 - given.pairs))
    assert bool((other - plain).abs().max() > 1e-3) == pair_messages
    features = given.features.clone()
    features[..., -1] += 1.0
    assert (model(noise, tau, Given(features, given.types, given.pairs)) - plain).abs().max() > 1e-3


def test_samples_of_particles_in_blocks_are_those_of_each(charges: ParticleSet) -> None:
    torch.manual_seed(0)
    view = ParticleView.of(charges, polynomial_weights(1, 3))
    given = view.known(charges.positions_nm[:, :N_GIVEN], charges)
    model = ParticleFlow(ParticleFlowConfig(given.features.shape[-1], width=32, n_layers=1))
    torch.nn.init.normal_(model.final.weight, std=0.2)
    drawn = sample_ahead(model, given, 3, torch.Generator().manual_seed(1))
    again = sample_ahead(model, given, 3, torch.Generator().manual_seed(1))
    assert torch.equal(drawn, again)
    assert not torch.equal(drawn, sample_ahead(model, given, 3, torch.Generator().manual_seed(2)))
    with pytest.raises(InputError, match="frames_per_token = 7"):
        ParticleFlowConfig(54, frames_per_token=7)


def test_the_code_of_a_frame_is_asked_for_charges(charges: ParticleSet) -> None:
    """Without it the code leaves them out, and the forecast does not know who attracts whom (results page)."""
    seen = torch.from_numpy(WindowView.of(charges, None).to_model(charges.positions_nm)).float()
    draw = turned_windows(seen, torch.from_numpy(charges.types))
    for paper_size in (False, True):
        model = set_forecaster(Settings(Path(), paper_size=paper_size), 5)
        generator = torch.Generator().manual_seed(0)
        x, kinds = draw(8, generator)
        _, terms = autoencoder_loss(model, x[:, 0], kinds, generator)
        assert "type" in terms
        assert model.config.autoencoder.type_weight > 0
    approximator = model.config.approximator
    assert (model.config.autoencoder.n_latents, approximator.width, approximator.n_layers) == (16, 256, 6)  # Table 10
    assert (approximator.uniform_tau, approximator.precondition) == (True, False)


# ---- the whole way -------------------------------------------------------------------------------------------------


def test_the_whole_way_prints_our_rows_under_the_published(tmp_path: Path) -> None:
    settings = Settings(tmp_path, budget_s=None, steps=3, solver_steps=2)
    sizes = {"train": 6, "validation": 2, "test": 3}
    run = lambda s: reproduce("n-body-spring", s, sizes=sizes, workers=1)  # noqa: E731
    result = run(settings)
    assert {row.method for row in result.rows} == set(METHODS)
    lines = table_lines(result)
    assert any("EGNN" in line and "0.0101" in line and "0.0231" in line for line in lines)
    assert all(any(line.strip().startswith(method) for line in lines) for method in METHODS)
    by_name = {row.method: row for row in result.rows}
    assert by_name["egnn"].over_egnn is not None
    assert by_name["egnn"].over_egnn.value == 1.0
    assert by_name["constant-velocity"].ade.value < by_name["frozen"].ade.value
    saved = json.loads((tmp_path / "n-body-spring.json").read_text())
    assert saved["rows"][0]["ade"]["value"] == result.rows[0].ade.value
    # A finished training resumed trains no more and forecasts the same.
    again = run(replace(settings, resume=True))
    for one, other in zip(result.rows, again.rows, strict=True):
        assert (one.method, one.ade, one.fde) == (other.method, other.ade, other.fde)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["n-body-charge"], "Did you mean 'n-body-charged'?"),
        (["n-body-spring", "--method", "egn"], "Did you mean 'egnn'?"),
        (["n-body-spring", "--budget", "10"], "--budget"),
    ],
)
def test_bad_names_are_refused_in_one_line_with_the_nearest(
    arguments: list[str], expected: str, tmp_path: Path
) -> None:
    result = CliRunner().invoke(app, ["reproduce", *arguments, "-o", str(tmp_path / "new")])
    assert result.exit_code == 1
    assert expected in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "new").exists()


def test_unknown_names_are_refused_in_python_too(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="unknown task 'md17'"):
        reproduce("md17", Settings(tmp_path))
    with pytest.raises(InputError, match="1 train trajectories"):
        reproduce("n-body-spring", Settings(tmp_path), sizes={"train": 1, "validation": 2, "test": 2})
