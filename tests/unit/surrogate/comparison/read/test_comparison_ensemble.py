"""Reading files as ensembles: atom order, time axes, replicas, records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surrogate.comparison.read.ensemble import Ensemble, alike, load_ensemble
from surrogate.data import collect_frames
from surrogate.verbs.inputs import find_trajectories
from surrogate.verbs.run.stages import notable
from systems.chemistry.geometry import torsion
from systems.errors import InputError, OutOfDomainError, TrajectoryError
from systems.scene import Scene
from systems.trajectory.codec import open_writer
from systems.trajectory.joined import join

Save = Callable[..., Path]


def permuted(scene: Scene, order: np.ndarray) -> Scene:
    """The same molecule with atom k of the result = atom order[k], under other names."""
    back = np.argsort(order)
    bonds = np.sort(back[scene.bonds], axis=1)
    return Scene(
        name="other program's",
        atom_names=tuple(f"X{k}" for k in range(scene.n_atoms)),
        elements=tuple(scene.elements[k] for k in order),
        residue_of_atom=np.zeros(scene.n_atoms, dtype=np.int64),
        residue_names=("UNK",),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=bonds,
        bond_orders=scene.bond_orders.copy(),
        formal_charges=scene.formal_charges[order],
        masses_da=scene.masses_da[order],
        positions_nm=scene.positions_nm[order],
    )


@pytest.fixture
def frames(simulate: Callable[..., Ensemble]) -> np.ndarray:
    return simulate(21, 60).segments[0]


@pytest.fixture
def save(tmp_path: Path, alanine_dipeptide: Scene) -> Save:
    """`save(name, frames, times, scene=..., record=..., chunk_idx=...)` -> the path of a trajectory file of ours."""

    def write(name: str, x: np.ndarray, times: np.ndarray, *, scene: Scene = alanine_dipeptide,
              record: dict[str, Any] | None = None, chunk: int = 0) -> Path:  # fmt: skip
        path = tmp_path / name
        with open_writer(path, scene, record or {"kind": "rollout"}) as writer:
            if chunk:
                for k, start in enumerate(range(0, len(x), chunk)):
                    writer.append(x[start : start + chunk], times[start : start + chunk], chunk_idx=k)
            else:
                writer.append(x, times, flags=np.zeros(len(x), dtype=np.uint16))
        return path

    return write


def steps(n: int, lag: float = 1.0, start: float = 0.0) -> np.ndarray:
    return start + lag * np.arange(1, n + 1)


def test_one_file_is_read_as_it_is(save: Save, frames: np.ndarray, alanine_dipeptide: Scene) -> None:
    record = {"temperature_k": 300.0, "cost": {"wall_s": 2.0, "network_evaluations": 7}, "completed": False}
    ensemble = load_ensemble([save("a.h5", frames, steps(60, 2.0), record=record, chunk=16)], label="mine")
    assert ensemble.label == "mine"
    assert ensemble.lag_ps == 2.0 and ensemble.total_ps == 120.0
    assert np.array_equal(ensemble.segments[0], frames)
    assert ensemble.record["temperature_k"] == 300.0
    assert ensemble.chunk_idx is not None and ensemble.chunk_idx[0].max() == 3
    assert any("Stopped before the end" in note and "a.h5 (60 frames)" in note for note in ensemble.notes)
    assert not any("Stopped" in note for note in notable((*ensemble.notes, "kept"))), "a clock's own stages"
    assert "kept" in notable((*ensemble.notes, "kept")), "control"
    assert ensemble.scene.topology_hash == alanine_dipeptide.topology_hash


def test_other_order_and_names_are_matched(save: Save, frames: np.ndarray, alanine_dipeptide: Scene) -> None:
    order = np.random.default_rng(0).permutation(22)
    path = save("b.h5", frames[:, order], steps(60), scene=permuted(alanine_dipeptide, order))
    ensemble = load_ensemble([path], template=alanine_dipeptide)
    quads = np.array([[4, 6, 8, 14], [6, 8, 14, 16]])
    assert torsion(ensemble.segments[0], quads) == pytest.approx(torsion(frames, quads), abs=1e-5)
    assert any("reordered" in note for note in ensemble.notes)
    untouched = load_ensemble([path])
    assert np.array_equal(untouched.segments[0], frames[:, order])


def test_another_molecule_is_refused(save: Save, frames: np.ndarray, alanine_dipeptide: Scene) -> None:
    smaller = Scene.from_dict(
        alanine_dipeptide.to_dict() | {"elements": ["C" if e == "N" else e for e in alanine_dipeptide.elements]}
    )
    path = save("c.h5", frames, steps(60), scene=smaller)
    with pytest.raises(OutOfDomainError, match="does not hold the molecule of the reference"):
        load_ensemble([path], template=alanine_dipeptide)


def test_replicas_become_segments_and_costs_add_up(save: Save, frames: np.ndarray) -> None:
    costs: list[dict[str, Any]] = [{"cost": {"wall_s": 2.0, "energy_evaluations": 5}}, {"cost": {"wall_s": 3.0}}]
    paths = [save(f"{k}.h5", frames, steps(60), record=costs[k] | {"temperature_k": 300.0 + k}) for k in range(2)]
    ensemble = load_ensemble(paths)
    assert ensemble.segment_lengths == [60, 60]
    assert ensemble.record["cost"] == {"wall_s": 5.0}
    assert ensemble.flags is not None and [len(f) for f in ensemble.flags] == [60, 60]
    assert any("differ in temperature_k (300.0, 301.0)" in note for note in ensemble.notes)
    without = save("none.h5", frames, steps(60))
    assert "cost" not in load_ensemble([paths[0], without]).record, "half a cost is no cost"


@pytest.mark.parametrize("suffix", [".h5", ".dcd", ".xtc"])
def test_replicas_in_one_file_are_read_as_those_in_many(save: Save, frames: np.ndarray, suffix: str) -> None:
    costs = [{"cost": {"wall_s": 2.0}, "seed": 1}, {"cost": {"wall_s": 3.0}, "seed": 2}]
    parts = [frames[:20], frames[20:]]  # what follows on in time, so that nothing but the record tells
    paths = [save(f"a_r{k}{suffix}", parts[k], steps(len(parts[k])), record=costs[k]) for k in range(2)]
    joined = join(paths, paths[0].with_name(f"a{suffix}"))
    one, many = load_ensemble([joined]), load_ensemble(paths)
    assert one.segment_lengths == many.segment_lengths == [20, 40]
    for a, b in zip(one.segments, many.segments, strict=True):
        np.testing.assert_allclose(a, b, atol=6e-4 if suffix == ".xtc" else 1e-6)
    assert one.record["cost"] == many.record["cost"] == {"wall_s": 5.0}
    assert load_ensemble([joined], lag_ps=2.0).segment_lengths == [20, 40]
    assert any("2 replicas in one file" in note for note in one.notes)
    assert find_trajectories(joined.parent) == paths, "nothing is counted twice"
    assert find_trajectories(joined) == [joined]
    plain = save(f"b{suffix}", frames, steps(60))
    assert load_ensemble([plain]).segment_lengths == [60]
    with pytest.raises(InputError, match="joins 2 replicas"):
        collect_frames([joined])


def test_a_jump_in_time_begins_a_segment(save: Save, frames: np.ndarray) -> None:
    times = np.concatenate([steps(25), steps(35, start=500.0)])
    ensemble = load_ensemble([save("jump.h5", frames, times)])
    assert ensemble.segment_lengths == [25, 35] and ensemble.lag_ps == 1.0
    assert any("time jumps 1 times" in note for note in ensemble.notes)


def test_uneven_time_is_refused_unless_the_lag_is_stated(save: Save, frames: np.ndarray) -> None:
    times = np.cumsum(np.random.default_rng(1).uniform(0.8, 1.2, 60))
    path = save("uneven.h5", frames, times)
    with pytest.raises(TrajectoryError, match="time is uneven"):
        load_ensemble([path])
    ensemble = load_ensemble([path], lag_ps=1.0)
    assert ensemble.lag_ps == 1.0 and ensemble.segment_lengths == [60]


def test_a_stated_lag_wins_and_the_difference_is_said(save: Save, frames: np.ndarray) -> None:
    ensemble = load_ensemble([save("d.h5", frames, steps(60))], lag_ps=2.0)
    assert ensemble.lag_ps == 2.0
    assert any("2 ps per frame as stated; the file itself says 1 ps" in note for note in ensemble.notes)


def test_what_is_said_of_several_files_alike_is_said_once(save: Save, frames: np.ndarray) -> None:
    paths = [save(f"{name}.h5", frames, steps(60, lag)) for name, lag in (("a", 1.0), ("b", 1.0), ("c", 4.0))]
    said = [note for note in load_ensemble(paths, lag_ps=2.0).notes if "as stated" in note]
    assert said == [
        f"{paths[0]} and 1 more: 2 ps per frame as stated; the file itself says 1 ps.",
        f"{paths[2]}: 2 ps per frame as stated; the file itself says 4 ps.",
    ]


def test_replicas_of_different_intervals_are_refused(save: Save, frames: np.ndarray) -> None:
    paths = [save("e.h5", frames, steps(60)), save("f.h5", frames, steps(60, 2.0))]
    with pytest.raises(InputError, match="must share one save interval"):
        load_ensemble(paths)


def test_one_frame_has_no_lag(save: Save, frames: np.ndarray) -> None:
    path = save("one.h5", frames[:1], steps(1))
    with pytest.raises(InputError, match="one frame only"):
        load_ensemble([path])
    assert load_ensemble([path], lag_ps=1.0).n_frames == 1


def test_no_file_and_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No trajectory file"):
        load_ensemble([])
    with pytest.raises(TrajectoryError):
        load_ensemble([tmp_path / "absent.h5"])


def test_a_dcd_of_ours_reads_like_its_hdf5(save: Save, frames: np.ndarray) -> None:
    by_dcd = load_ensemble([save("x.dcd", frames, steps(60))])
    by_hdf5 = load_ensemble([save("x.h5", frames, steps(60))])
    assert by_dcd.lag_ps == by_hdf5.lag_ps == 1.0
    assert by_dcd.segments[0] == pytest.approx(by_hdf5.segments[0], abs=1e-6)


@pytest.mark.parametrize(
    ("lags", "common"), [((1.0, 1.0), 1.0), ((1.0, 3.0), 3.0), ((1.0, 2.5), 5.0), ((0.2, 0.5), 1.0)]
)
def test_least_common_interval(
    simulate: Callable[..., Ensemble], lags: tuple[float, float], common: float
) -> None:  # fmt: skip
    made = [replace(simulate(22, 400), lag_ps=lag) for lag in lags]
    thinned, _ = alike(made)
    assert [e.lag_ps for e in thinned] == pytest.approx([common, common])
    assert np.array_equal(thinned[0].segments[0], made[0].segments[0][:: round(common / lags[0])])


def test_intervals_without_a_common_multiple_are_refused(simulate: Callable[..., Ensemble]) -> None:
    with pytest.raises(InputError, match="no common multiple"):
        alike([simulate(23, 100), replace(simulate(23, 100), lag_ps=0.997)])
    few = simulate(24, 9)
    with pytest.raises(InputError, match=f"{few.label} holds 9; at least 10"):
        alike([simulate(23, 100), few])


def test_shapes_are_checked(alanine_dipeptide: Scene) -> None:
    with pytest.raises(InputError, match="has shape"):
        Ensemble("bad", [np.zeros((5, 21, 3), dtype=np.float32)], 1.0, alanine_dipeptide)
    with pytest.raises(InputError, match="no frames"):
        Ensemble("empty", [], 1.0, alanine_dipeptide)
    with pytest.raises(InputError, match="state it with `dt_ps"):
        Ensemble("still", [np.zeros((5, 22, 3), dtype=np.float32)], 0.0, alanine_dipeptide)
    with pytest.raises(InputError, match="do not match the segments"):
        Ensemble("flags", [np.zeros((5, 22, 3), dtype=np.float32)], 1.0, alanine_dipeptide,
                 flags=[np.zeros(4, dtype=np.uint16)])  # fmt: skip
