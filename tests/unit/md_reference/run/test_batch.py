"""SIMD replicas: files as `simulate` writes them, resumed bit for bit, stopped and refused in one line."""

from __future__ import annotations

import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from md_reference.forces.spec import ForceFieldSpec
from md_reference.run import replicas
from md_reference.run.config import MDConfig
from md_reference.run.plan import make_plan
from md_reference.run.replicas import simulate_batch, simulate_replicas, where_left
from md_reference.simd.force_field import n_replicas
from systems.errors import InputError, SimulationError
from systems.prepare.peptide import build_peptide
from systems.trajectory.checkpoint import checkpoint_path
from systems.trajectory.codec import open_trajectory

pytestmark = pytest.mark.skipif(not (shutil.which("g++") or shutil.which("c++")), reason="no C++ compiler")
SCENE = build_peptide("ACE-GLY-NME")
CONFIG = MDConfig(
    time_ps=6.0, equilibrate_ps=1.0, seed=4, platform="simd", force=ForceFieldSpec("ff14SB", "obc2")
)  # fmt: skip


def _frames(path: Path) -> np.ndarray:
    with open_trajectory(path) as reader:
        return np.asarray(reader.read())


def test_replicas_differ_and_say_how_they_were_made(tmp_path: Path) -> None:
    outs = [tmp_path / f"a{k}.h5" for k in range(3)]
    simulate_replicas(SCENE, replace(CONFIG, starts="one"), outs)
    for k, out in enumerate(outs):
        with open_trajectory(out) as reader:
            assert reader.n_frames == 6 and np.allclose(reader.time_ps, np.arange(1, 7))
            assert reader.record["completed"] and reader.record["replica"] == k
            assert reader.record["platform"] == "simd" and "temperature_k" in reader.record["summary"]
    assert not np.allclose(_frames(outs[0]), _frames(outs[1]))
    assert not list(tmp_path.glob("*.checkpoint"))
    again = [tmp_path / "b0.h5", tmp_path / "b1.h5"]
    simulate_batch(SCENE, CONFIG, again)
    assert np.array_equal(_frames(again[1]), _frames(outs[1])), "the same seed gives the same frames"


def test_what_was_stopped_goes_on_as_if_it_had_not_been(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, parts = [tmp_path / "w0.h5", tmp_path / "w1.h5"], [tmp_path / "p0.h5", tmp_path / "p1.h5"]
    simulate_batch(SCENE, CONFIG, whole)
    monkeypatch.setattr(replicas._Batch, "block_s", 0.0)

    def stop(done: int, total: int, note: str | None = None) -> None:
        if note is None and done >= 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_batch(SCENE, CONFIG, parts, progress=stop)
    assert len(_frames(parts[1])) == 3 and checkpoint_path(parts[0]).exists()
    left_nm = where_left(SCENE, CONFIG, parts)
    last = np.stack([_frames(part)[-1] for part in parts])
    assert np.allclose(left_nm, last, atol=1e-6) and not np.allclose(left_nm[0], left_nm[1])
    assert len(where_left(SCENE, CONFIG, whole)) == 0, "they have ended"
    with pytest.raises(InputError, match="friction"):
        simulate_batch(SCENE, replace(CONFIG, friction_per_ps=2.0), parts, resume=True)
    simulate_batch(SCENE, CONFIG, parts, resume=True)
    for a, b in zip(whole, parts, strict=True):
        assert np.array_equal(_frames(a), _frames(b))
    simulate_batch(SCENE, CONFIG, parts, resume=True)  # nothing is left to do
    parts[1].unlink()
    with pytest.raises(InputError, match=r"p1\.h5 is not there"):
        simulate_batch(SCENE, CONFIG, parts, resume=True)


def test_a_long_frame_is_stopped_within_and_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(CONFIG, save_every_ps=6.0, time_ps=12.0)
    simulate_batch(SCENE, replace(config, save_every_ps=2.0), [tmp_path / "w.h5"])
    steps, count = replicas.SimdReplicas.step, []

    def interrupted(self: replicas.SimdReplicas, n: int) -> None:
        steps(self, n)
        count.append(n)
        if len(count) == 6:  # one of equilibration, three of a frame
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(replicas.SimdReplicas, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulate_batch(SCENE, config, [tmp_path / "p.h5"])
    assert len(count) == 6 and len(_frames(tmp_path / "p.h5")) == 1
    simulate_batch(SCENE, config, [tmp_path / "p.h5"], resume=True)
    assert np.array_equal(_frames(tmp_path / "p.h5"), _frames(tmp_path / "w.h5")[2::3])


def test_a_replica_that_blows_up_leaves_the_frames_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = replicas.SimdReplicas.step
    count = []

    def fails(self: replicas.SimdReplicas, n: int) -> None:
        count.append(n)
        if len(count) > 4:
            raise SimulationError("a copy of the molecule blew up")
        steps(self, n)

    monkeypatch.setattr(replicas.SimdReplicas, "step", fails)
    out = [tmp_path / "x.h5"]
    with pytest.raises(SimulationError, match="blew up after 3 ps; 3 good frames"):
        simulate_batch(SCENE, CONFIG, out)
    with open_trajectory(out[0]) as reader:
        assert reader.n_frames == 3 and reader.record["completed"] is False


@pytest.mark.parametrize("change", [{"ensemble": "nve"}, {"save_velocities": True}])
def test_what_simd_cannot_do_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    config: MDConfig = replace(CONFIG, **change)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="platform simd supports only nvt"):
        simulate_batch(SCENE, config, [tmp_path / "x.h5"])
    with pytest.raises(InputError, match="platform simd supports only nvt"):
        make_plan(SCENE, config, timed=False)
    assert not list(tmp_path.iterdir())


def test_terms_that_simd_does_not_have_are_refused_before_any_md(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replicas, "many_starts", lambda *_: pytest.fail("hot MD was begun"))
    config = replace(CONFIG, force=ForceFieldSpec("ff14SB", "gbn2"))
    with pytest.raises(SimulationError, match="does not support CustomGBForce"):
        simulate_replicas(SCENE, config, [tmp_path / "a.h5", tmp_path / "b.h5"])


def test_replicas_are_counted_across_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replicas, "n_replicas", lambda: 2)
    outs = [tmp_path / f"{k}.h5" for k in range(3)]
    simulate_replicas(SCENE, replace(CONFIG, time_ps=1.0, starts="one"), outs)
    with open_trajectory(outs[2]) as reader:
        record = reader.record
    assert (record["replica"], record["of_replicas"], record["batch"], record["seed"]) == (2, 3, [0, 1], 6)


def test_the_plan_counts_replicas_that_run_at_once() -> None:
    n = n_replicas()
    one, many = (make_plan(SCENE, CONFIG, replicas=k) for k in (1, n))
    assert many.rows["platform"] == "simd" and one.us_per_step is not None and many.us_per_step is not None
    assert n / 2 < one.us_per_step / many.us_per_step < 2 * n
