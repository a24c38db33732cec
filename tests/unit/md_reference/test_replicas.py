"""Several replicas: names, failures told apart, what is finished stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from md_reference.replicas import replica_paths, simulate_replicas
from md_reference.simulate import MDConfig
from systems.errors import SimulationError
from systems.scene import Scene
from systems.trajectory import open_trajectory

SHORT = MDConfig(time_ps=0.8, save_every_ps=0.2, equilibrate_ps=0.4, platform="Reference")


def test_names_of_replicas() -> None:
    assert replica_paths(Path("a/b.h5"), 1) == [Path("a/b.h5")]
    assert replica_paths(Path("a/b.dcd"), 2) == [Path("a/b_r0.dcd"), Path("a/b_r1.dcd")]


def test_a_failed_replica_is_named_and_the_others_are_kept(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    outs = [tmp_path / "a.h5", tmp_path / "missing" / "b.h5"]
    told: list[tuple[int, int]] = []
    with pytest.raises(SimulationError, match=r"1 of 2 replicas failed; replica 1: .*missing") as caught:
        simulate_replicas(alanine_dipeptide, SHORT, outs, progress=lambda *done: told.append(done))
    assert "\n" not in str(caught.value)
    with open_trajectory(outs[0]) as reader:
        assert reader.record["completed"] is True
        assert reader.record["seed"] == 0
        assert reader.n_frames == 4
    assert told[-1][1] == 8


def test_replicas_resume_and_keep_what_is_complete(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    outs = [tmp_path / "a.h5", tmp_path / "b.h5"]
    simulate_replicas(alanine_dipeptide, SHORT, outs[:1])
    before = outs[0].read_bytes()
    assert simulate_replicas(alanine_dipeptide, SHORT, outs, resume=True) == outs
    assert outs[0].read_bytes() == before
    with open_trajectory(outs[1]) as reader:
        assert reader.record["seed"] == 1
    with pytest.raises(SimulationError, match=r"replica 0: .*temperature_k"):
        simulate_replicas(alanine_dipeptide, replace(SHORT, temperature_k=310.0), outs, resume=True)
