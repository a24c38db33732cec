"""Splits: nothing held out is trained on; windows are mapped from files and need no memory of the files' size."""

from __future__ import annotations

import csv
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate import api, data
from surrogate.data import RUN, Split, TrainingFrames, collect_frames, load_frames
from surrogate.models.lam_slide.model import LamSlideConfig
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import open_writer


def write(path: Path, scene: Scene, n_frames: int, seed: int = 0) -> Path:
    rng = np.random.default_rng(seed)
    frames = scene.positions_nm + 0.003 * rng.normal(size=(n_frames, scene.n_atoms, 3))
    with open_writer(path, scene, {"temperature_k": 300.0}) as writer:
        writer.append(frames, np.arange(1, n_frames + 1) * 1.0)
    return path


def windows_in(ranges: list[tuple[int, int]]) -> set[int]:
    return {k for low, high in ranges for k in range(low, high)}


def test_splits_part_the_frames() -> None:
    starts = np.array([0, 100, 300])
    for split, held in ((Split(0.1), {*range(90, 100), *range(280, 300)}), (Split(held=(1,)), {*range(100, 300)})):
        trained = windows_in(split.ranges(starts, validation=False))
        assert windows_in(split.ranges(starts, validation=True)) == held
        assert trained == set(range(300)) - held
    with pytest.raises(InputError, match="share"):
        Split(1.0)


def test_leaks_are_refused(harmonic_frames: TrainingFrames) -> None:
    rng = np.random.default_rng(0)
    run, other = (rng.integers(-3000, 3000, size=(400, 5, 3)).astype(np.int16) for _ in range(2))

    def check(*pieces: np.ndarray, split: Split | None = None) -> None:
        starts = np.concatenate([[0], np.cumsum([len(p) for p in pieces])])
        replace(harmonic_frames, coordinates=np.concatenate(pieces), starts=starts, split=split or Split(0.1),
                sources=tuple({"file": f"run {k}"} for k in range(len(pieces)))).refuse_leaks()  # fmt: skip

    check(run, other)
    check(run, run)  # the same trajectory twice parts at the same place: wasteful, no leak
    for pieces in ((run, run[:200]), (run[100:], other, run), (other, run, run[7:380])):
        with pytest.raises(InputError, match="trained on as well"):
            check(*pieces)
    with pytest.raises(InputError, match="run 1: frame 0"):
        check(run, run[50:60], split=Split(held=(1,)))
    check(run, run[: RUN - 1], split=Split(held=(1,)))  # shorter than a run
    check(np.zeros((50, 1, 3), np.int16))  # a system that does not move holds the same frame everywhere


def test_training_refuses_a_trajectory_given_whole_and_in_part(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    long = write(tmp_path / "long.h5", alanine_dipeptide, 300)
    with pytest.raises(InputError, match="trained on as well"):
        api.train([long], tmp_path / "m.safetensors", validation=[long], steps=4, quiet=True)
    with pytest.raises(InputError, match="trained on as well"):
        api.windows([long], tmp_path / "w.h5", validation=long)
    assert not (tmp_path / "w.h5").exists()


def test_a_trajectory_is_held_out_whole(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    first, second = (write(tmp_path / f"{k}.h5", alanine_dipeptide, 60 + k, seed=k) for k in range(2))
    frames = collect_frames([first], held=[second])
    assert frames.window_starts(60, validation=False).tolist() == [0]
    assert frames.window_starts(60, validation=True).tolist() == [60, 61]
    api.windows([first], tmp_path / "w.h5", validation=second)
    again = load_frames(tmp_path / "w.h5")
    assert again.split == frames.split
    assert np.array_equal(again.coordinates, frames.coordinates)


def test_times_that_passed_through_float32_are_even(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    def written(name: str, time_ps: np.ndarray, **conditions: float) -> Path:
        noise = np.random.default_rng(0).normal(0.0, 0.01, (len(time_ps), alanine_dipeptide.n_atoms, 3))
        with open_writer(tmp_path / name, alanine_dipeptide, {"temperature_k": 300.0, **conditions}) as writer:
            writer.append(alanine_dipeptide.positions_nm + noise, time_ps)
        return tmp_path / name

    late = (1e5 + 0.1 * np.arange(50)).astype(np.float32).astype(np.float64)
    assert np.ptp(np.diff(late)) > 0.005
    assert collect_frames([written("late.h5", late)]).lag_ps == pytest.approx(0.1, rel=1e-3)
    with pytest.raises(InputError, match="not evenly spaced"):
        collect_frames([written("uneven.h5", np.cumsum([1.0, 1.0, 1.0, 1.01, 1.0]))])
    colder = written("colder.h5", late, temperature_k=280.0)
    with pytest.raises(InputError, match=r"conditions \(temperature_k 280.0\) than .*late.h5 \(temp\w* 300.0"):
        collect_frames([tmp_path / "late.h5", colder])


def test_frames_beyond_memory_are_mapped(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    path = write(tmp_path / "t.h5", alanine_dipeptide, 20_000)
    kept = collect_frames([path])
    tracemalloc.start()
    mapped = collect_frames([path], memory_bytes=1000, spool=tmp_path)
    mapped.positions_nm(mapped.window_starts(16, validation=False)[:8, None] + np.arange(16))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert isinstance(mapped.coordinates, np.memmap)
    assert not isinstance(kept.coordinates, np.memmap)
    assert np.array_equal(mapped.coordinates, kept.coordinates)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.h5", "t.pdb"]
    # Blocks of 8192 frames pass through memory in float64, several copies at a time, the whole never.
    assert peak < 8192 * 22 * 24 * 8, f"{peak / 1e6:.0f} MB"


def test_training_without_a_cache_of_latents_is_the_same(tmp_path: Path, harmonic_frames: TrainingFrames,
                                                         small_model_config: LamSlideConfig,
                                                         monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    config = TrainingConfig(stage_one_steps=6, stage_two_steps=6, stage_one_batch=8, stage_two_batch=4, bf16=False,
                            validate_every_s=1e9)  # fmt: skip
    harmonic_frames.save(tmp_path / "w.h5")
    curves = []
    for name, limit in (("kept", 10**9), ("drawn", 0)):
        monkeypatch.setattr("surrogate.models.lam_slide.trainer.LATENT_CACHE_BYTES", limit)
        out = train_lam_slide(load_frames(tmp_path / "w.h5"), tmp_path / f"{name}.safetensors", small_model_config,
                              config)  # fmt: skip
        curves.append(list(csv.DictReader(out.with_suffix(".csv").open())))
    for key in ("train_flow", "validation_flow"):
        kept, drawn = (float(curve[-1][key]) for curve in curves)
        assert kept == pytest.approx(drawn, rel=1e-4)
    # The first stage's rows know nothing of the second's columns, and the other way round.
    assert [row["train_flow"] == "" for row in curves[0]] == [True, False]
    assert [row["validation_rmsd_nm"] == "" for row in curves[0]] == [False, True]


def test_written_windows_equal_collected_frames(
    tmp_path: Path, alanine_dipeptide: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [write(tmp_path / f"{k}.h5", alanine_dipeptide, 30 + k, seed=k) for k in range(3)]
    for canonical in (True, False):
        api.windows(paths, tmp_path / "w.h5", canonical=canonical, overwrite=True)
        found, expected = load_frames(tmp_path / "w.h5"), collect_frames(paths, canonical=canonical)
        assert np.array_equal(found.coordinates, expected.coordinates)
        assert (found.lag_ps, found.split, found.sources) == (expected.lag_ps, expected.split, expected.sources)
        assert np.array_equal(found.starts, [0, 30, 61, 93])
    monkeypatch.setattr(data, "QUANTUM_NM", 1e-4)
    with pytest.raises(InputError, match=r"units of 0\.0002 nm, not 0\.0001"):
        load_frames(tmp_path / "w.h5")
