"""The MD17 protocol: splits by time, forecasts that turn with the molecule, linear ones that are exact where they can
be, and the whole way to the table."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from surrogate.bench.reproduce.forecast_errors import block_means, forecast_errors
from surrogate.bench.reproduce.forecast_methods import N_GIVEN, N_NEW, SWITCHES, Settings, without_switches
from surrogate.bench.reproduce.md17 import MoleculeReproduction, reproduce_molecules, table_lines
from surrogate.bench.reproduce.md17_data import read_md17_ethanol
from surrogate.bench.reproduce.md17_methods import METHODS, lam_slide_model
from surrogate.bench.reproduce.md17_views import AtomView, BodyFrame, LinearForecast, MoleculeView
from surrogate.bench.reproduce.published import PUBLISHED_MD17
from surrogate.cli.main import app
from surrogate.data.molecule_windows import MoleculeWindows, pair_kinds, split_windows
from systems.errors import InputError, UnknownNameError
from systems.library import named_scenes

SPAN = N_GIVEN + N_NEW


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


# ---- windows -------------------------------------------------------------------------------------------------------


def test_splits_share_no_frame_and_count_what_is_independent() -> None:
    chosen, every, blocks = split_windows(1000, 30, {"train": 50, "validation": 10_000, "test": 40}, "x")
    frames = {split: set((starts[:, None] + np.arange(30)).ravel().tolist()) for split, starts in every.items()}
    assert not frames["train"] & frames["validation"]
    assert not frames["validation"] & frames["test"]
    assert [min(f) for f in frames.values()] == [0, 600, 800]
    assert max(frames["test"]) == 999
    assert [len(s) for s in chosen.values()] == [50, 171, 40]
    for split in chosen:
        assert set(chosen[split]) <= set(every[split])
    assert set(blocks["test"]) == set(range(6))
    with pytest.raises(InputError, match="do not hold a window"):
        split_windows(100, 30, {"train": 5, "validation": 5, "test": 5}, "x")


def test_intervals_know_that_windows_overlap() -> None:
    errors = np.repeat(np.random.default_rng(0).normal(size=20), 50)
    np.testing.assert_allclose(block_means(errors, np.repeat(np.arange(20), 50)), errors[::50])
    np.testing.assert_allclose(block_means(np.array([1.0, 3.0, 5.0]), np.array([4, 4, 9])), [2.0, 5.0])


def test_pairs_are_bonds_second_neighbours_and_others() -> None:
    kinds = pair_kinds(4, np.array([[0, 1], [1, 2], [2, 3]]))
    np.testing.assert_array_equal(kinds, [[0, 2, 1, 0], [2, 0, 2, 1], [1, 2, 0, 2], [0, 1, 2, 0]])


# ---- forecasts -----------------------------------------------------------------------------------------------------


def test_the_body_frame_takes_the_pose_away_and_gives_it_back() -> None:
    m = vibrating()
    given, _ = _split(m)
    rotation = Rotation.random(random_state=2).as_matrix()
    turned = given @ rotation.T + np.array([1.0, -2.0, 0.5])
    here, there = BodyFrame.of(m, given), BodyFrame.of(m, turned)
    np.testing.assert_allclose(here.enter(given), there.enter(turned), rtol=0, atol=1e-9)
    np.testing.assert_allclose(there.leave(there.enter(turned)), turned, rtol=0, atol=1e-9)
    last = here.enter(given)[:, -1, :3]
    np.testing.assert_allclose(last, np.broadcast_to(m.template_nm[:3], last.shape), rtol=0, atol=1e-6)
    mirrored = given * np.array([1.0, 1.0, -1.0])
    assert np.abs(BodyFrame.of(m, mirrored).enter(mirrored) - here.enter(given)).max() > 0.01


def test_the_linear_forecast_is_exact_for_vibrations_and_not_for_anharmonic_ones() -> None:
    m = vibrating()
    given, truth = _split(m)
    fitted = LinearForecast.fit(m)
    error = forecast_errors(fitted.forecast(m, given)[None], truth)[0].mean()
    assert error < 2e-5  # nm; the atom that vibrates moves by 0.01
    rotation = Rotation.random(random_state=2).as_matrix()
    np.testing.assert_allclose(
        fitted.forecast(m, given @ rotation.T), fitted.forecast(m, given) @ rotation.T, atol=1e-8
    )
    bent = vibrating(anharmonic=0.5)
    given, truth = _split(bent)
    assert forecast_errors(LinearForecast.fit(bent).forecast(bent, given)[None], truth)[0].mean() > error
    # Negative control: fitted to one molecule's motion it does not know another's.
    other = vibrating(seed=5)
    shuffled = replace(other, frames_nm=np.random.default_rng(0).permutation(other.frames_nm))
    assert forecast_errors(LinearForecast.fit(shuffled).forecast(m, given)[None], truth)[0].mean() > 100 * error


@pytest.mark.parametrize("canonical", [True, False])
@pytest.mark.parametrize("corrects", [True, False])
def test_windows_come_back_from_what_the_model_sees(canonical: bool, corrects: bool) -> None:
    m = vibrating(anharmonic=0.5)
    view = MoleculeView.of(m, canonical=canonical, linear=LinearForecast.fit(m) if corrects else None)
    windows = m.windows(m.starts["test"])
    given = windows[:, :N_GIVEN]
    seen = view.to_model(windows)
    np.testing.assert_allclose(view.from_model(given, seen[:, N_GIVEN:]), windows[:, N_GIVEN:], rtol=0, atol=1e-9)
    np.testing.assert_allclose(view.given(given), seen[:, :N_GIVEN], rtol=0, atol=1e-9)
    # What is given carries nothing of the future.
    other = windows.copy()
    other[:, N_GIVEN:] += 1.0
    np.testing.assert_array_equal(view.to_model(other)[:, :N_GIVEN], seen[:, :N_GIVEN])
    rotation = Rotation.random(random_state=2).as_matrix()
    other = (view.to_model(windows @ rotation.T) - seen) * view.scales[:, None, None]
    same = np.abs(other).max() < 1e-8  # nm
    assert same == canonical


def test_atoms_come_back_from_their_view_and_know_no_pose_and_no_future() -> None:
    m = vibrating(anharmonic=0.5)
    bare = MoleculeView.of(m, canonical=True, linear=LinearForecast.fit(m))
    view = AtomView(bare, (0.1, 0.01, 0.01))
    windows = m.windows(m.starts["test"])
    given = windows[:, :N_GIVEN]
    seen = view.to_model(windows)
    back = view.from_model(given, seen.ahead.double().numpy())
    np.testing.assert_allclose(back, windows[:, N_GIVEN:], rtol=0, atol=1e-7)
    # The last position stands first, in units of 0.1 nm about the centre of all atoms; types and pairs are the atoms'.
    last = BodyFrame.of(m, given).enter(given)[:, -1]
    last = 10.0 * (last - last.mean(axis=1, keepdims=True))
    np.testing.assert_allclose(seen.given.features[..., :3].numpy(), last, rtol=0, atol=1e-5)
    assert seen.given.types[0].tolist() == [1, 3, 0, 0]
    assert seen.given.pairs[-1].tolist() == m.kinds.tolist()
    rotation = Rotation.random(random_state=2).as_matrix()
    turned = view.to_model(windows @ rotation.T + 2.0)
    torch.testing.assert_close(turned.given.features, seen.given.features, rtol=0, atol=1e-4)
    other = windows.copy()
    other[:, N_GIVEN:] += 1.0
    assert torch.equal(view.known(other[:, :N_GIVEN]).features, seen.given.features)
    # Negative control: a mirrored molecule is another.
    assert (view.known(given * [1.0, 1.0, -1.0]).features - seen.given.features).abs().max() > 0.1


def test_normal_modes_follow_vibrations_and_keep_the_pose() -> None:
    m = vibrating(drift=0.0)
    given, truth = _split(m)
    fitted = METHODS["normal-modes"]([m], Settings(Path()))
    found = forecast_errors(fitted.forecast(m, given, 1), truth)[0].mean()
    frozen = forecast_errors(METHODS["frozen"]([m], Settings(Path())).forecast(m, given, 1), truth)[0].mean()
    assert found < 0.8 * frozen


def test_switches_are_known_by_name() -> None:
    plain = without_switches(Settings(Path()), SWITCHES)
    assert not (plain.extrapolate or plain.any_start or plain.from_velocity or plain.canonical or plain.predicted_only)
    one = without_switches(Settings(Path()), ["canonical"])
    assert (one.extrapolate, one.canonical) == (True, False)
    with pytest.raises(UnknownNameError, match="Did you mean 'canonical'"):
        without_switches(Settings(Path()), ["canonicl"])


# ---- the whole way -------------------------------------------------------------------------------------------------


@pytest.fixture
def real_ethanol(shared_data: Path) -> Path:
    return shared_data / "md17-ethanol" / "md17_ethanol_first1600.npz"


def test_the_whole_way_to_the_table(tmp_path: Path) -> None:
    settings = Settings(tmp_path, budget_s=None, steps=3, solver_steps=2)
    asked = {"train": 20, "validation": 8, "test": 8}

    def run(settings: Settings, *methods: str) -> MoleculeReproduction:
        return reproduce_molecules(
            settings,
            molecules=["ethanol"],
            methods=methods or tuple(METHODS),
            time_ps=1.0,
            windows=asked,
        )

    result = run(settings)
    assert [a.method for a in result.accounts] == list(METHODS)
    lines = table_lines(result)
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


def test_md17s_own_ethanol_is_read_in_our_atom_order(real_ethanol: Path) -> None:
    m = read_md17_ethanol(real_ethanol, SPAN)
    assert m.name == "ethanol" != m.label
    assert m.n_independent("test") == 5
    windows = m.windows(m.starts["test"])
    bonds = named_scenes.load("ethanol").bonds
    lengths = np.linalg.norm(windows[..., bonds[:, 0], :] - windows[..., bonds[:, 1], :], axis=-1)
    assert 0.08 < lengths.min() < lengths.max() < 0.18
    # Frames of a window are 5 fs apart, none jumps from one series to the next.
    assert np.linalg.norm(np.diff(windows, axis=1), axis=-1).max() < 0.06


def test_clean_conditioning_reaches_the_network_and_is_told() -> None:
    for clean in (True, False):
        settings = Settings(Path(), clean_conditioning=clean)
        assert lam_slide_model(settings, large=False).config.approximator.clean_conditioning is clean
    with pytest.raises(InputError, match="clean_conditioning"):
        lam_slide_model(Settings(Path(), clean_conditioning=True, predicted_only=False), large=False)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["md17", "--molecule", "ethanl"], "Did you mean 'ethanol'?"),
        (["md17", "--method", "pair-forces"], "unknown method 'pair-forces'"),
        (["md17", "--without", "canon"], "unknown switch 'canon'"),
        (["md18"], "n-body-charged"),
        (["n-body-spring", "--clean-conditioning"], "--clean-conditioning: n-body-spring does not know it"),
    ],
)
def test_bad_names_are_refused_in_one_line(arguments: list[str], expected: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["reproduce", *arguments, "-o", str(tmp_path / "new")])
    assert result.exit_code == 1
    assert expected in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "new").exists()


def test_published_rows_are_complete() -> None:
    assert len(PUBLISHED_MD17) == 8
    assert {tuple(rows) for rows in PUBLISHED_MD17.values()} == {tuple(PUBLISHED_MD17["ethanol"])}
    assert PUBLISHED_MD17["aspirin"]["LaM-SLidE"] == (0.059, 0.098)
    assert PUBLISHED_MD17["uracil"]["EqMotion"] == (0.088, 0.116)
