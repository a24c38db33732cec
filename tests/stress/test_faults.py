"""Faults injected into rollouts, each with its outcome: nothing written is lost, nothing wrong is written."""

from __future__ import annotations

import errno
import os
import pickle
import random
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rollout_child import CHUNKS_UNTIL_STOPPED, FAILED, INTERRUPTED, start, until_stopped, within_file_size
from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.runner import Progress, RolloutConfig, packed_progress, progress_of, rollout
from systems.errors import InputError, StorageError, SurromdError, TrajectoryError, WeightsError
from systems.scene import Scene
from systems.trajectory.checkpoint import checkpoint_path, read_checkpoint
from systems.trajectory.codec import open_trajectory, open_writer

N_CHUNKS = 180


@pytest.fixture(scope="module")
def config(small_weights: Weights) -> RolloutConfig:
    time_ps = float(N_CHUNKS * small_weights.model.n_new)
    # The weights have had a second of training: no guard lets a frame of theirs pass.
    return RolloutConfig(time_ps=time_ps, solver_steps=2, precision="fp32", seed=6, guard="off")


def outs_in(folder: Path) -> list[Path]:
    """Two replicas, one in each format."""
    folder.mkdir(exist_ok=True)
    return [folder / "a.h5", folder / "b.dcd"]


def everything(path: Path) -> dict[str, Any]:
    """All that a finished file holds, but for times of day and seconds spent."""
    with open_trajectory(path) as reader:
        assert reader.flags is not None and reader.chunk_idx is not None
        summary = {key: value for key, value in reader.record["interventions"].items() if key != "seconds"}
        return {
            "frames": reader.read().tobytes(),
            "columns": [reader.time_ps.tobytes(), reader.flags.tobytes(), reader.chunk_idx.tobytes()],
            "scalars": {name: values.tobytes() for name, values in reader.scalars.items()},
            "summary": summary,
            "completed": reader.record["completed"],
        }


def frames_of(path: Path) -> np.ndarray:
    with open_trajectory(path) as reader:
        return reader.read()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, alanine_dipeptide: Scene, small_weights: Weights,
                config: RolloutConfig) -> list[Path]:  # fmt: skip
    outs = outs_in(tmp_path_factory.mktemp("whole"))
    return rollout(alanine_dipeptide, small_weights, outs, config)


@pytest.mark.parametrize(("number", "times"), [(signal.SIGKILL, 20), (signal.SIGINT, 5), (signal.SIGTERM, 5)])
def test_stopped_at_random_moments_it_goes_on_bit_for_bit(
    number: signal.Signals, times: int, tmp_path: Path, alanine_dipeptide: Scene, small_weights: Weights,
    small_weights_file: Path, config: RolloutConfig, undisturbed: list[Path],
) -> None:  # fmt: skip
    outs, rng = outs_in(tmp_path / "run"), random.Random(int(number))
    state = checkpoint_path(outs[0])
    promised, chunk = 0, small_weights.model.n_new
    # SIGTERM ends a process that has not come so far as to heed it.
    expected = {signal.SIGKILL: [-9], signal.SIGINT: [INTERRUPTED], signal.SIGTERM: [INTERRUPTED, -15]}[number]
    assert times * CHUNKS_UNTIL_STOPPED < N_CHUNKS
    for stopped in range(times):
        child = start(until_stopped, small_weights_file, outs, config)
        # In turn: while it starts, and after a chunk.
        if stopped % 2:
            child.wait_for_chunk()
        time.sleep(rng.uniform(0.0, 0.15 if stopped % 2 else 0.5))
        child.stop(number)
        status, said = child.end()
        assert status in expected, said or status
        known = progress_of(state, read_checkpoint(state), None).steps if state.exists() else 0
        assert known >= promised, "what a checkpoint has seen stays"
        # A kill between the append and its checkpoint leaves one chunk more, which is cut and computed again.
        assert all(known <= len(frames_of(path)) <= known + chunk for path in outs if known or path.exists())
        promised = known
    assert 0 < promised < N_CHUNKS * chunk
    rollout(alanine_dipeptide, small_weights, outs, config, resume=True)
    for ours, whole in zip(outs, undisturbed, strict=True):
        assert everything(ours) == everything(whole)
    assert not state.exists()


def test_stopped_between_its_first_frames_and_their_checkpoint_it_goes_on(
    tmp_path: Path, alanine_dipeptide: Scene, small_weights: Weights, config: RolloutConfig, undisturbed: list[Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    outs = outs_in(tmp_path / "run")

    class Killed(BaseException):
        pass

    def killed_after_frames(progress: Progress) -> tuple[dict[str, Any], bytes]:
        if progress.steps:
            raise Killed
        return packed_progress(progress)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr("surrogate.sampling.runner.packed_progress", killed_after_frames)
        rollout(alanine_dipeptide, small_weights, outs, config, flush_every_s=0.0)
    assert len(frames_of(outs[0])) == small_weights.model.n_new
    rollout(alanine_dipeptide, small_weights, outs, config, resume=True)
    for ours, whole in zip(outs, undisturbed, strict=True):
        assert everything(ours) == everything(whole)


def test_a_full_disk_loses_nothing(
    tmp_path: Path, alanine_dipeptide: Scene, small_weights: Weights, small_weights_file: Path, config: RolloutConfig,
    undisturbed: list[Path],
) -> None:  # fmt: skip
    outs = outs_in(tmp_path / "run")
    whole = [frames_of(path) for path in undisturbed]
    reached = []
    for limit in (300_000, 420_000):
        status, said = start(within_file_size, small_weights_file, outs, config, limit).end()
        assert status == FAILED
        first = said.splitlines()[0]
        assert first.startswith("StorageError") and "is full" in first and "complete and readable" in first
        reached.append([len(frames_of(path)) for path in outs])
        for path, expected in zip(outs, whole, strict=True):
            found = frames_of(path)
            assert 0 < len(found) < len(expected) and np.array_equal(found, expected[: len(found)])
    assert min(reached[1]) > min(reached[0]), "a little more space, a little more trajectory"
    rollout(alanine_dipeptide, small_weights, outs, config, resume=True)
    for ours, finished in zip(outs, undisturbed, strict=True):
        assert everything(ours) == everything(finished)


def test_a_folder_that_cannot_be_written_is_named(
    tmp_path: Path, alanine_dipeptide: Scene, small_weights: Weights, config: RolloutConfig,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    outs, usual = outs_in(tmp_path / "run"), os.open

    def read_only(path: Any, flags: int, *rest: Any, **more: Any) -> int:
        if str(path).startswith(str(tmp_path / "run")) and flags & (os.O_WRONLY | os.O_RDWR):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return usual(path, flags, *rest, **more)

    monkeypatch.setattr(os, "open", read_only)
    with pytest.raises(StorageError, match=r"a\.h5: the folder or the file is not writable"):
        rollout(alanine_dipeptide, small_weights, outs, config)
    assert list((tmp_path / "run").iterdir()) == []


@pytest.fixture
def half_done(tmp_path: Path, alanine_dipeptide: Scene, small_weights: Weights, config: RolloutConfig) -> list[Path]:
    """A rollout that was stopped half way, with its checkpoint."""
    outs = outs_in(tmp_path / "run")

    class Stop(BaseException):
        pass

    def stop(done: int, total: int, note: str) -> None:
        if done >= total // 8:
            raise Stop

    with pytest.raises(Stop):
        rollout(alanine_dipeptide, small_weights, outs, config, progress=stop, flush_every_s=0.0)
    return outs


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("how", ["bytes", "frames", "gone"])
def test_a_cut_trajectory_is_not_gone_on_from(
    which: int, how: str, half_done: list[Path], alanine_dipeptide: Scene, small_weights: Weights,
    config: RolloutConfig, undisturbed: list[Path],
) -> None:  # fmt: skip
    path = half_done[which]
    whole = {p: p.read_bytes() for p in path.parent.iterdir()}
    if how == "bytes":
        path.write_bytes(whole[path][: len(whole[path]) * 2 // 3])
    elif how == "frames":
        with open_writer(path, alanine_dipeptide, {}, append=True) as writer:
            writer.truncate(writer.n_frames - 10)
    else:
        path.unlink()
    before = {p: p.read_bytes() for p in path.parent.iterdir()}
    with pytest.raises(SurromdError, match=rf"{path.name}.*(restore|overwrite|is not there|does not exist)") as caught:
        rollout(alanine_dipeptide, small_weights, half_done, config, resume=True)
    assert isinstance(caught.value, TrajectoryError | InputError) and "\n" not in str(caught.value)
    assert {p: p.read_bytes() for p in path.parent.iterdir()} == before, "nothing is changed"
    for p, data in whole.items():
        p.write_bytes(data)
    rollout(alanine_dipeptide, small_weights, half_done, config, resume=True)
    assert everything(path) == everything(undisturbed[which])


def test_a_damaged_checkpoint_is_refused_and_nothing_changed(
    half_done: list[Path], alanine_dipeptide: Scene, small_weights: Weights, config: RolloutConfig,
) -> None:  # fmt: skip
    state = checkpoint_path(half_done[0])
    good = state.read_bytes()
    before = [path.read_bytes() for path in half_done]
    for bad in (b"", good[:-40], good[:300] + bytes([good[300] ^ 4]) + good[301:], b"PK\x03\x04 nothing of ours"):
        state.write_bytes(bad)
        with pytest.raises(InputError, match=r"checkpoint .* cannot be read .*`overwrite|is none of this version's"):
            rollout(alanine_dipeptide, small_weights, half_done, config, resume=True)
    assert [path.read_bytes() for path in half_done] == before
    state.unlink()
    with pytest.raises(InputError, match="its checkpoint is gone"):
        rollout(alanine_dipeptide, small_weights, half_done, config, resume=True)


class _Harm:
    """Unpickled, it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def test_no_code_runs_from_a_hostile_file(tmp_path: Path) -> None:
    harm, file = tmp_path / "harm", tmp_path / "hostile"
    with open(file, "wb") as handle:
        np.savez(handle, last_frames=np.array([_Harm(harm)], dtype=object))
    with pytest.raises(InputError, match="cannot be read"):
        progress_of(file, ({"settings": {}, "progress": {}}, file.read_bytes()), {})
    for data in (file.read_bytes(), pickle.dumps(_Harm(harm))):
        file.write_bytes(data)
        with pytest.raises(SurromdError):
            read_checkpoint(file)
    torch.save({"model": _Harm(harm)}, tmp_path / "w.safetensors")
    with pytest.raises(WeightsError, match="damaged or not a weights file"):
        load_weights(tmp_path / "w.safetensors")
    assert not harm.exists()
    pickle.loads(pickle.dumps(_Harm(harm)))
    assert harm.exists(), "the same file does harm where it is unpickled"
