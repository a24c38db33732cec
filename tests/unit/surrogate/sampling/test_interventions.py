"""Guards and what they do about caught frames: a scripted model with faults on purpose, real OpenMM beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import Tensor

from scripted_model import (
    LAG_PS,
    N_NEW,
    Rolled,
    Scripted,
    invert,
    roll,
    scatter,
    stretch,
    weights_of,
)
from surrogate.models.propagator import Propagator
from surrogate.models.weights import TrainingDomain
from surrogate.sampling.chunks import (
    CAUGHT,
    DRAWN_AGAIN,
    MD_AFTER_FAILURE,
    REPAIRED,
    Interventions,
    Tally,
    none_through,
)
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.chemistry.validity import CHIRALITY, CLASH, INVALID, limits_from_frames
from systems.errors import InputError, SimulationError
from systems.scene import Scene
from systems.trajectory.checkpoint import frames_in
from systems.trajectory.codec import open_trajectory


def test_a_sound_model_is_left_alone_under_every_guard(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    frames = []
    for guard in ("off", "flag", "resample", "repair", "fallback"):
        found = roll(tmp_path / f"{guard}.h5", scene, weights_of(domain), guard)
        assert not found.marks.any() and found.summary["chunks"] == 4 and found.summary["chunks_caught"] == 0
        assert not (found.flags & np.uint16(CAUGHT)).any()
        frames.append(found.frames)
    assert all(np.array_equal(frames[0], other) for other in frames[1:])


def test_flag_marks_the_frame_and_changes_nothing(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, stretch), "flag")
    bad = np.flatnonzero(found.flags & np.uint16(INVALID))
    assert len(bad) and (bad % N_NEW == 5).all(), "the frames that the script breaks, and no other"
    assert not found.marks.any()
    assert found.summary["chunks_caught"] == len(bad)
    assert found.summary["reasons"]["bond more than 0.5 Å off"] == len(bad)
    assert found.summary["bias"] == []


def test_resample_draws_again_from_the_last_valid_frame(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    flagged = roll(tmp_path / "flag.h5", scene, weights_of(domain, stretch), "flag", n_chunks=1, solver_steps=3)
    assert flagged.flags[5] & INVALID, "this seed is unlucky in its first chunk"
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, stretch), "resample")
    assert not (found.flags & np.uint16(CAUGHT)).any()
    assert np.array_equal(found.frames[:5], flagged.frames[:5]), "what was valid stays"
    assert found.marks[:N_NEW].tolist() == [0] * 5 + [DRAWN_AGAIN] * 3
    assert np.abs(found.frames[5] - found.frames[4]).max() < 0.02, "and the new frames follow from it"
    summary = found.summary
    assert summary["draws"] >= summary["chunks_caught"] >= 1
    assert summary["frames"] == {"drawn again": int((found.marks == DRAWN_AGAIN).sum())}
    assert len(summary["bias"]) == 1 and "visited less" in summary["bias"][0]
    assert found.record["cost"]["network_evaluations"] == summary["chunks"] + summary["draws"]


def test_repair_restores_the_bond_and_leaves_the_other_frames(
    tmp_path: Path, scene: Scene, domain: TrainingDomain
) -> None:
    flagged = roll(tmp_path / "flag.h5", scene, weights_of(domain, stretch), "flag")
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, stretch), "repair")
    assert not (found.flags & np.uint16(CAUGHT)).any()
    bad = np.flatnonzero(flagged.flags & np.uint16(CAUGHT))
    assert np.array_equal(np.flatnonzero(found.marks), bad) and (found.marks[bad] == REPAIRED).all()
    good = np.delete(np.arange(len(found.frames)), bad)
    np.testing.assert_allclose(found.frames[good], flagged.frames[good], rtol=0, atol=1e-6)
    length = np.linalg.norm(found.frames[bad, 5] - found.frames[bad, 4], axis=1)
    assert np.abs(length - 0.1229).max() < 0.004, "C=O of ff14SB"
    assert np.linalg.norm(found.frames[bad] - flagged.frames[bad], axis=2).max() < 0.12
    assert found.summary["seconds"]["relax"] > 0 and found.summary["draws"] == 0


def test_what_cannot_be_repaired_is_drawn_again(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    flagged = roll(tmp_path / "flag.h5", scene, weights_of(domain, invert), "flag")
    assert (flagged.flags & np.uint16(CHIRALITY)).any()
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, invert), "repair")
    assert not (found.flags & np.uint16(CAUGHT)).any()
    assert found.summary["draws"] > 0
    assert set(found.marks.tolist()) <= {0, DRAWN_AGAIN, REPAIRED} and DRAWN_AGAIN in found.marks


def test_fallback_runs_md_to_the_end_of_the_chunk(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    flagged = roll(tmp_path / "flag.h5", scene, weights_of(domain, stretch), "flag", n_chunks=1)
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, stretch), "fallback")
    assert not (found.flags & np.uint16(INVALID)).any()
    assert np.array_equal(found.frames[:5], flagged.frames[:5])
    assert found.marks[:N_NEW].tolist() == [0] * 5 + [MD_AFTER_FAILURE] * 3
    # The frames are MD: bonds to hydrogen have their one length, which the trembling model's have not.
    hydrogens = np.array([(i, j) for i, j in scene.bonds.tolist() if "H" in (scene.elements[i], scene.elements[j])])
    length = np.linalg.norm(found.frames[:, hydrogens[:, 0]] - found.frames[:, hydrogens[:, 1]], axis=2)
    is_md = found.marks == MD_AFTER_FAILURE
    assert np.ptp(length[is_md], axis=0).max() < 1e-5 < np.ptp(length[~is_md], axis=0).min()
    # They lie where the molecule was, and the surrogate goes on from the last of them.
    assert np.abs(found.frames.mean(axis=1) - scene.positions_nm.mean(axis=0)).max() < 0.02
    assert np.abs(found.frames[N_NEW] - found.frames[N_NEW - 1]).max() < 0.02
    again = roll(tmp_path / "b.h5", scene, weights_of(domain, stretch), "fallback")
    assert np.array_equal(again.frames, found.frames)


@pytest.mark.parametrize("guard", ["flag", "resample", "repair", "fallback"])
def test_a_wrong_model_is_stopped_within_one_chunk(
    tmp_path: Path, scene: Scene, domain: TrainingDomain, guard: str
) -> None:
    out = tmp_path / "a.h5"
    with pytest.raises(SimulationError, match=r"replica 0, in its first chunk: .*(valid|passes)"):
        roll(out, scene, weights_of(domain, scatter), guard, n_chunks=50)
    if guard == "flag":
        with open_trajectory(out) as reader:
            assert reader.record["completed"] is False
            assert reader.record["interventions"]["chunks_caught"] == 1
            assert reader.n_frames == N_NEW and (reader.flags & np.uint16(INVALID)).all()
        out.unlink()
        out.with_suffix(".pdb").unlink()
    assert list(tmp_path.iterdir()) == [], "no invalid frame is written, and no file without frames is left"


def tear(frames: Tensor, noise: Tensor) -> Tensor:
    """Two frames of every chunk have a carbonyl bond that is 0.08 nm too long."""
    for k in (2, 5):
        step = frames[k, 5] - frames[k, 4]
        frames[k, 5] += 0.08 * step / step.norm()
    return frames


@pytest.mark.parametrize(("asked", "drawn"), [(50, 8), (3, 3), (1, 1)])
def test_a_model_that_gets_no_chunk_through_does_not_end_well(
    tmp_path: Path, scene: Scene, domain: TrainingDomain, asked: int, drawn: int
) -> None:
    """None of its chunks is broken throughout, and none is whole: it stops after some, or at its end."""
    said = f"every one of {drawn} chunks was caught" if drawn > 1 else "the only chunk contains invalid frames"
    with pytest.raises(SimulationError, match=rf"{said} \((25|38) %( of frames)?: bond .*are marked in"):
        roll(tmp_path / "a.h5", scene, weights_of(domain, tear), "flag", n_chunks=asked)
    with open_trajectory(tmp_path / "a.h5") as reader:
        assert reader.n_frames == drawn * N_NEW and reader.record["completed"] is False
        assert (reader.flags & np.uint16(INVALID)).any()
    assert roll(tmp_path / "b.h5", scene, weights_of(domain, tear), "off").record["completed"]


def test_one_chunk_got_through_and_few_frames_caught_prove_a_model() -> None:
    def tallies(chunks: int, caught: int, frames: int) -> list[Tally]:
        return [Tally(chunks, caught, frames, {"clash": frames}), Tally(chunks, chunks, frames)]

    assert none_through(tallies(8, 8, 100), 64, at_end=False) == (
        0,
        "every one of 16 chunks was caught (20 % of frames: clash)",
    )
    assert none_through(tallies(8, 7, 100), 64, at_end=True) is None
    assert none_through(tallies(7, 7, 100), 64, at_end=False) is None
    assert none_through(tallies(8, 8, 8), 64, at_end=True) is None, "a frame in each chunk of 64"


@pytest.mark.parametrize(("guard", "mark"), [("resample", DRAWN_AGAIN), ("fallback", MD_AFTER_FAILURE)])
def test_a_proven_model_is_helped_through_a_chunk_without_a_valid_frame(
    tmp_path: Path, scene: Scene, domain: TrainingDomain, guard: str, mark: int
) -> None:
    """Chunks of two frames may well have none that passes, twice; the same in the first chunk says more."""
    drawn = 0

    def scatter_some(frames: Tensor, noise: Tensor) -> Tensor:
        nonlocal drawn
        drawn += 1
        return scatter(frames, noise) if first <= drawn < first + 2 else frames

    first = 2
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, scatter_some), guard)
    assert not (found.flags & np.uint16(INVALID)).any()
    assert found.marks.tolist() == [0] * N_NEW + [mark] * N_NEW + [0] * 2 * N_NEW
    assert found.summary["chunks_caught"] == 1 and found.summary["draws"] == (2 if guard == "resample" else 1)
    drawn, first = 0, 1
    with pytest.raises(SimulationError, match=r"in its first chunk: two draws gave no frame that passes"):
        roll(tmp_path / "b.h5", scene, weights_of(domain, scatter_some), guard)


@pytest.mark.parametrize("arch", ["lam-slide", "painet"])
def test_random_weights_of_a_real_architecture_are_stopped(
    tmp_path: Path, scene: Scene, domain: TrainingDomain, md: np.ndarray, small_model_config: Any, arch: str
) -> None:
    from surrogate.models.lam_slide.model import LamSlide
    from surrogate.models.painet.model import Painet, PainetConfig

    torch.manual_seed(0)
    small = PainetConfig(n_new=N_NEW, width=16, n_heads=2, head_dim=8, n_decoder_layers=2, lag_ps=LAG_PS)
    model: Propagator = LamSlide(small_model_config) if arch == "lam-slide" else Painet(small)
    limits = limits_from_frames(scene, md[:-1], md[1:])
    weights = replace(weights_of(domain), model=model.eval(), domain=replace(domain, limits=limits.to_dict()))
    for guard in ("flag", "repair", "fallback"):
        with pytest.raises(SimulationError, match="replica 0, in its first chunk"):
            roll(tmp_path / f"{guard}.h5", scene, weights, guard, n_chunks=50, solver_steps=2)
        assert frames_in(tmp_path / f"{guard}.h5") <= weights.model.n_new


def test_off_goes_on_whatever_comes(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, scatter), "off")
    assert len(found.frames) == 4 * N_NEW and (found.flags & np.uint16(INVALID)).all()


def test_a_rollout_with_interventions_resumes_bit_for_bit(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    for guard in ("resample", "repair", "fallback"):
        config = RolloutConfig(time_ps=6 * N_NEW * LAG_PS, guard=guard, precision="fp32", seed=4)
        outs = [tmp_path / f"{guard}_whole{k}.h5" for k in range(2)]
        rollout(scene, weights_of(domain, stretch), outs, config)

        def kill(done: int, total: int, note: str) -> None:
            if done > total // 2:
                raise MemoryError("killed")

        cut = [tmp_path / f"{guard}_cut{k}.h5" for k in range(2)]
        with pytest.raises(MemoryError):
            rollout(scene, weights_of(domain, stretch), cut, config, progress=kill, flush_every_s=0.0)
        rollout(scene, weights_of(domain, stretch), cut, config, resume=True)
        for a, b in zip(outs, cut, strict=True):
            whole, resumed = Rolled(a), Rolled(b)
            assert np.array_equal(whole.frames, resumed.frames)
            assert np.array_equal(whole.marks, resumed.marks) and whole.marks.any()
            for key in ("chunks", "chunks_caught", "frames", "reasons", "draws"):
                assert whole.summary[key] == resumed.summary[key]


def test_replicas_begin_where_they_are_told(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    config = RolloutConfig(time_ps=N_NEW * LAG_PS, guard="off", precision="fp32", seed=4)

    def distances(x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(x[..., :, None, :] - x[..., None, :, :], axis=-1)

    other = scene.positions_nm.copy()
    other[:, 0] *= 1.2
    starts = np.stack([scene.positions_nm, other])
    outs = [tmp_path / f"{k}.h5" for k in range(2)]
    rollout(scene, weights_of(domain), outs, config, starts_nm=starts)
    for out, start in zip(outs, starts, strict=True):
        assert np.abs(distances(Rolled(out).frames[0].astype(np.float64)) - distances(start)).max() < 0.02
    assert np.abs(distances(other) - distances(scene.positions_nm)).max() > 0.1
    with pytest.raises(InputError, match=r"begin at \(2, \d+, 3\)"):
        rollout(scene, weights_of(domain), outs, config, starts_nm=starts[:1], overwrite=True)


def test_a_batch_that_memory_does_not_hold_is_halved(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    config = RolloutConfig(time_ps=3 * N_NEW * LAG_PS, precision="fp32", seed=4)
    whole = [tmp_path / f"whole{k}.h5" for k in range(6)]
    rollout(scene, weights_of(domain), whole, config)
    cramped, model = weights_of(domain), Scripted()
    model.largest_batch = 2
    halved = [tmp_path / f"halved{k}.h5" for k in range(6)]
    rollout(scene, replace(cramped, model=model), halved, config)
    assert model.rows == [2, 2, 2] * 3, "six do not go, nor three; two do, from then on"
    for a, b in zip(whole, halved, strict=True):
        np.testing.assert_allclose(Rolled(a).frames, Rolled(b).frames, rtol=0, atol=2e-6)
    assert Rolled(halved[0]).record["cost"]["batch"] == 2
    model.largest_batch = 0
    with pytest.raises(SimulationError, match="memory does not suffice for one replica"):
        rollout(scene, replace(cramped, model=model), [tmp_path / "one.h5"], config)


def test_chunks_of_one_frame_end_a_rollout_only_when_several_in_a_row_are_invalid() -> None:
    flags = np.zeros((1, 1), dtype=np.uint16)
    helper = SimpleNamespace(
        chunk=SimpleNamespace(flags=flags, frames_nm=np.zeros((1, 1, 3, 3)), failure=None),
        config=SimpleNamespace(guard="flag"), state=SimpleNamespace(last_frames=[None], tallies=[Tally()]),
        _reasons=lambda row: "clash",
    )  # fmt: skip
    failed = []
    for invalid in (1, 1, 1, 0, 1, 1, 1, 1):
        flags[:] = CLASH if invalid else 0
        Interventions.compare(cast(Interventions, helper))
        failed.append(helper.chunk.failure is not None)
    assert failed == [False] * 7 + [True]
    assert helper.chunk.failure == (0, "4 frames and no valid one (clash)")
