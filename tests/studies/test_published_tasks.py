"""Forecast tasks: errors by hand, splits that share nothing, data that goes on, models that know their symmetries."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import forecaster_training
import md17
import numpy as np
import pytest
import reproduce as study
import torch
from forecast_errors import forecast_errors
from forecast_methods import N_GIVEN, N_NEW, Settings, extrapolate, polynomial_weights
from md17_methods import METHODS as MOLECULE_METHODS
from md17_views import LinearForecast
from molecule_windows import MoleculeWindows, pair_kinds, split_windows
from n_body import reproduce, table_lines
from n_body_data import make_sets, make_systems, split_seeds
from n_body_generator import N_BODY, NBodySystem, generate_n_body, n_body
from n_body_methods import METHODS
from n_body_views import ParticleView, WindowView
from particle_flow import Given, ParticleFlow, ParticleFlowConfig
from particle_models import PairForces, PairForcesConfig
from particle_sets import ParticleSet, check_disjoint, read_set
from scipy.spatial.transform import Rotation

from surrogate.models.lam_slide.trainer import random_rotations
from systems.errors import InputError

SPAN = N_GIVEN + N_NEW
COUNTS = {"train": 8, "validation": 3, "test": 4}


@pytest.fixture(scope="module")
def springs() -> ParticleSet:
    return make_systems("n-body-spring", range(12))


@pytest.fixture(scope="module")
def charges() -> ParticleSet:
    return make_systems("n-body-charged", range(6))


# ---- errors --------------------------------------------------------------------------------------------------------


def test_errors_equal_those_computed_by_hand() -> None:
    reference = np.zeros((2, 2, 2, 3))
    predicted = np.zeros((2, 2, 2, 2, 3))
    predicted[0, 0, 0, 0] = [3.0, 4.0, 0.0]  # sample 0, trajectory 0, frame 0, particle 0: off by 5
    predicted[1, 0, 1, 1] = [0.0, 0.0, 2.0]  # sample 1, trajectory 0, last frame, particle 1: off by 2
    predicted[:, 1] += [1.0, 2.0, 2.0]  # trajectory 1: off by 3 everywhere
    ade, fde = forecast_errors(predicted, reference)
    np.testing.assert_allclose(ade, [(5.0 + 2.0) / 8, 3.0], rtol=1e-14)
    np.testing.assert_allclose(fde, [2.0 / 4, 3.0], rtol=1e-14)
    # Negative controls: neither the best sample nor the root mean square nor the sum of coordinates gives these.
    distance = np.linalg.norm(predicted - reference, axis=-1)
    assert not np.allclose(distance.mean((2, 3)).min(0), ade)
    assert not np.allclose(np.sqrt((distance**2).mean((0, 2, 3))), ade)
    assert not np.allclose(np.abs(predicted - reference).sum(-1).mean((0, 2, 3)), ade)


# ---- the generator -------------------------------------------------------------------------------------------------


def plain_forces(system: NBodySystem, x: np.ndarray) -> np.ndarray:
    """The law's forces in plain NumPy."""
    law = system.law
    away = x[:, None] - x[None]
    r2 = (away**2).sum(axis=-1)
    np.fill_diagonal(r2, 1.0)
    if law["kind"] == "coulomb":
        q = np.array(law["charges_e"])
        size = law["coulomb_constant"] * q[:, None] * q[None] / r2**1.5
    elif law["kind"] == "springs":
        size = np.zeros_like(r2)
        for i, j in law["pairs"]:
            size[i, j] = size[j, i] = -law["force_constant_kj_mol_nm2"]
    else:
        size = -law["gravitational_constant"] / (r2 + law["softening_nm"] ** 2) ** 1.5
    return (size[..., None] * away).sum(axis=1)


def by_scheme(name: str, seed: int, scheme: str, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The published scheme in plain NumPy, masses 1, step 0.001."""
    system, limit = n_body(name, seed), N_BODY[name].max_force or np.inf
    x, v = system.positions_nm.copy(), system.velocities_nm_ps.copy()
    for _ in range(n_steps):
        if scheme == "kick-drift":
            v += 1e-3 * plain_forces(system, x).clip(-limit, limit)
            x += 1e-3 * v
        else:
            v += 5e-4 * plain_forces(system, x)
            x += 1e-3 * v
            v += 5e-4 * plain_forces(system, x)
    return x, v


@pytest.mark.parametrize("name", N_BODY)
def test_trajectories_are_those_of_the_published_scheme(name: str) -> None:
    made = generate_n_body(name, [11, 12], n_frames=4)
    protocol = N_BODY[name]
    assert made.positions_nm.shape == (2, 4, protocol.n_particles, 3)
    np.testing.assert_allclose(made.time_ps, protocol.first_frame_ps + 0.1 * np.arange(4))
    for row, seed in enumerate(made.seeds):
        for frame in (0, 3):
            x, v = by_scheme(name, seed, protocol.integrator, round(made.time_ps[frame] / 1e-3))
            np.testing.assert_allclose(made.positions_nm[row, frame], x, atol=1e-9)
            np.testing.assert_allclose(made.velocities_nm_ps[row, frame], v, atol=1e-9)
    # Negative control: the other scheme is not within a thousand times that.
    other = "kick-drift-kick" if protocol.integrator == "kick-drift" else "kick-drift"
    x, _ = by_scheme(name, 12, other, round(made.time_ps[3] / 1e-3))
    assert np.abs(x - made.positions_nm[1, 3]).max() > 1e-6


@pytest.mark.parametrize(("name", "std"), [("n-body-charged", 1.0), ("n-body-spring", 0.5), ("n-body-gravity", 1.0)])
def test_starting_conditions_are_the_published_ones(name: str, std: float) -> None:
    drawn = [n_body(name, seed) for seed in range(400)]
    x, v = (np.array([getattr(s, key) for s in drawn]) for key in ("positions_nm", "velocities_nm_ps"))
    error = (x**2).std() / np.sqrt(x.size)
    assert abs((x**2).mean() - std**2) < 4 * error < abs((x**2).mean() - 1.1 * std**2)
    if name == "n-body-gravity":
        np.testing.assert_allclose(v.mean(axis=1), 0.0, atol=1e-12)
    else:
        np.testing.assert_allclose(np.linalg.norm(v, axis=-1), 0.5, rtol=1e-12)


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


# ---- methods -------------------------------------------------------------------------------------------------------


def test_extrapolation_is_exact_for_its_polynomial_and_not_beyond() -> None:
    t = 0.1 * np.arange(30)
    cubic = np.stack([1 - t + t**3, 2 * t**2, 0.5 - t**3], axis=-1)[None, :, None, :]
    given, reference = cubic[:, :N_GIVEN], cubic[:, N_GIVEN:]
    for n_points in (4, 7):
        np.testing.assert_allclose(extrapolate(given, polynomial_weights(3, n_points)), reference, rtol=0, atol=1e-10)
    assert np.abs(extrapolate(given, polynomial_weights(2, 4)) - reference).max() > 1.0
    np.testing.assert_allclose(extrapolate(given, polynomial_weights(1, 2))[:, 0], 2 * given[:, -1] - given[:, -2])
    with pytest.raises(ValueError, match="degree 4"):
        polynomial_weights(4, 4)


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


def test_pair_forces_are_the_true_law_when_given_it_and_keep_momentum(charges: ParticleSet) -> None:
    model = PairForces(PairForcesConfig(forecast_substeps=20)).double()
    with torch.no_grad():
        model.constant[0, 3], model.constant[1, 3] = -1.0, 1.0  # Coulomb: 1/r^2, unlike charges attract
    _, _, x, v, _, pairs = _turned(charges)
    given, reference = x[:, :N_GIVEN], x[:, N_GIVEN:]
    forecast = model.forecast(given, pairs, 20)
    errors = (forecast - reference).norm(dim=-1).mean((1, 2))
    assert errors.median() < 5e-3
    velocity = model.last_velocity(x[:, 4:10], pairs)
    assert (velocity - v[:, 9]).norm(dim=-1).median() < 5e-3
    torch.testing.assert_close(model.forces(x[:, 0], pairs).sum(1), torch.zeros(len(x), 3).double(), atol=1e-9, rtol=0)
    with torch.no_grad():
        model.constant.neg_()  # negative control: the wrong sign
    wrong = (model.forecast(given, pairs, 20) - reference).norm(dim=-1).mean((1, 2))
    assert wrong.median() > 0.3


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


# ---- molecules ------------------------------------------------------------------------------------------------------


def vibrating(n_frames: int = 3000, seed: int = 0, anharmonic: float = 0.0, drift: float = 3.0) -> MoleculeWindows:
    """Four atoms that vibrate in three modes of 9 to 30 fs about a shape which tumbles slowly."""
    rng = np.random.default_rng(seed)
    shape = np.array([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.0, 0.12, 0.0], [0.05, 0.04, 0.14]])
    shape = shape - shape[:3].mean(0)
    # Modes that neither move nor turn the three fitted atoms' frame: along the fourth atom alone.
    t = 0.005 * np.arange(n_frames)
    moved = np.zeros((n_frames, 4, 3))
    for axis, period in enumerate((0.0093, 0.017, 0.031)):
        wave = 0.01 * np.sin(2 * np.pi * t / period + rng.uniform(0, 6))
        moved[:, 3, axis] = wave + anharmonic * 100 * wave**2
    body = shape + moved
    turn = 2 * np.pi * t / 11.0
    zero, one = np.zeros_like(t), np.ones_like(t)
    rotation = np.stack(
        [np.cos(turn), -np.sin(turn), zero, np.sin(turn), np.cos(turn), zero, zero, zero, one], -1
    ).reshape(-1, 3, 3)
    frames = np.einsum("tij,taj->tai", rotation, body) + drift * t[:, None, None]
    chosen, every, blocks = split_windows(n_frames, SPAN, {"train": 500, "validation": 50, "test": 40}, "made up")
    return MoleculeWindows(
        name="made up",
        label="made up",
        elements=np.array([6, 8, 1, 1]),
        kinds=pair_kinds(4, np.array([[0, 1], [0, 2], [1, 3]])),
        template_nm=shape,
        fitted_idx=np.arange(3),
        frames_nm=frames,
        lag_ps=0.005,
        span=SPAN,
        starts=chosen,
        every_start=every,
        blocks=blocks,
    )


def _split(m: MoleculeWindows, split: str = "test") -> tuple[np.ndarray, np.ndarray]:
    windows = m.windows(m.starts[split])
    return windows[:, :N_GIVEN], windows[:, N_GIVEN:]


def test_the_linear_forecast_is_exact_for_vibrations_and_not_for_anharmonic_ones() -> None:
    m = vibrating()
    given, reference = _split(m)
    fitted = LinearForecast.fit(m)
    error = forecast_errors(fitted.forecast(m, given)[None], reference)[0].mean()
    assert error < 2e-5  # nm; the atom that vibrates moves by 0.01
    rotation = Rotation.random(random_state=2).as_matrix()
    np.testing.assert_allclose(
        fitted.forecast(m, given @ rotation.T), fitted.forecast(m, given) @ rotation.T, atol=1e-8
    )
    bent = vibrating(anharmonic=0.5)
    given, reference = _split(bent)
    assert forecast_errors(LinearForecast.fit(bent).forecast(bent, given)[None], reference)[0].mean() > error
    # Negative control: fitted to one molecule's motion it does not know another's.
    other = vibrating(seed=5)
    shuffled = replace(other, frames_nm=np.random.default_rng(0).permutation(other.frames_nm))
    assert forecast_errors(LinearForecast.fit(shuffled).forecast(m, given)[None], reference)[0].mean() > 100 * error


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


@pytest.mark.slow
def test_md17_goes_the_whole_way_to_the_table(tmp_path: Path) -> None:
    settings = Settings(tmp_path, budget_s=None, steps=3, solver_steps=2)
    asked = {"train": 20, "validation": 8, "test": 8}

    def run(settings: Settings, *methods: str) -> md17.MoleculeReproduction:
        return md17.reproduce_molecules(
            settings,
            molecules=["ethanol"],
            methods=methods or tuple(MOLECULE_METHODS),
            time_ps=1.0,
            windows=asked,
        )

    result = run(settings)
    assert [a.method for a in result.summaries] == list(MOLECULE_METHODS)
    lines = md17.table_lines(result)
    assert any("LaM-SLidE, published" in line and "0.087" in line and "0.167" in line for line in lines)
    by_name = {row.method: row for row in result.rows if row.molecule == "ethanol"}
    assert by_name["frozen"].n_independent == 1
    assert by_name["linear"].ade.value < by_name["constant-velocity"].ade.value
    saved = json.loads((tmp_path / "md17.json").read_text())
    assert saved["rows"][0]["ade"]["value"] == result.rows[0].ade.value
    # What is there is kept, a finished training resumed trains no more and forecasts the same.
    before = (tmp_path / "ethanol.h5").stat().st_mtime_ns
    again = run(replace(settings, resume=True), "egnn", "lam-slide", "lam-slide-particles")
    assert (tmp_path / "ethanol.h5").stat().st_mtime_ns == before
    for row in again.rows:
        assert (row.ade, row.fde) == (by_name[row.method].ade, by_name[row.method].fde)


@pytest.mark.parametrize(
    ("form", "more_than"),
    [pytest.param("--paper-size", 5_000_000, marks=pytest.mark.slow), ("--paper-form", 1_500_000)],
)
def test_the_paper_size_and_form_run_in_calls_until_their_epochs_are_done(
    form: str, more_than: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The commands with fewer steps and smaller batches; sizes are theirs."""
    monkeypatch.setattr(forecaster_training, "PAPER_SIZES", replace(forecaster_training.PAPER_SIZES, batches=(4, 2)))
    monkeypatch.setattr(forecaster_training, "PAPER_STEPS", 4)
    asked = ["n-body-charged", "--method", "lam-slide", form, "--device", "cpu", "--call", "0.001s"]
    asked += ["--solver-steps", "1", "-o", str(tmp_path), "--workers", "1", "--quiet"]
    asked += ["--train", "4", "--validation", "2", "--test", "2"]
    ended = []
    for resumed in ([], ["--resume"], ["--resume"], ["--resume"]):
        try:
            study.main([*asked, *resumed])
            break
        except SystemExit as stopped:
            ended.append(str(stopped))
    assert 2 <= len(ended) < 4 and all("this call's time is up" in text for text in ended)
    assert "lam-slide" in capsys.readouterr().out
    with (tmp_path / "lam-slide.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    assert {row["stage"]: int(row["step"]) for row in rows} == {"autoencoder": 2, "flow": 2}
    record = json.loads((tmp_path / "n-body-charged.json").read_text())
    assert record["rows"][0]["n_parameters"] > more_than


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["n-body-charge"], "Did you mean 'n-body-charged'?"),
        (["n-body-spring", "--method", "egn"], "Did you mean 'egnn'?"),
        (["n-body-spring", "--budget", "10"], "--budget"),
        (["n-body-spring", "--clean-conditioning"], "n-body-spring does not know it"),
        (["md17", "--molecule", "ethanl"], "Did you mean 'ethanol'?"),
        (["md17", "--without", "canon"], "unknown switch 'canon'"),
    ],
)
def test_bad_names_are_refused_in_one_line(arguments: list[str], expected: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as refused:
        study.main([*arguments, "-o", str(tmp_path / "new")])
    assert expected in str(refused.value) and "\n" not in str(refused.value)
    assert not (tmp_path / "new").exists()
