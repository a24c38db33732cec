"""Replicas in one file: what is kept, where each begins, and what is refused."""

from __future__ import annotations

from pathlib import Path

import mdtraj
import numpy as np
import pytest

from chain_files import RECORD, SUFFIXES, TOLERANCES, chain, frames, left_behind
from surrogate.api import info
from systems.errors import InputError, TrajectoryError
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.joined import KEY, join, replicas_of

N_ATOMS = 12


def replica(path: Path, seed: int, n: int = 6, *, interval_ps: float = 0.5, n_atoms: int = N_ATOMS) -> np.ndarray:
    positions = frames(n, n_atoms, seed)
    with open_writer(path, chain(n_atoms), RECORD | {"seed": seed}) as writer:
        writer.append(positions, interval_ps * (1 + np.arange(n)), flags=np.full(n, seed), chunk_idx=seed,
                      scalars={"e": np.full(n, float(seed))})  # fmt: skip
        writer.update_record({"completed": True})
    return positions


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_all_frames_are_kept_and_the_record_says_where_replicas_begin(tmp_path: Path, suffix: str) -> None:
    paths = [tmp_path / f"a_r{k}{suffix}" for k in range(3)]
    parts = [replica(path, k, 6 + k) for k, path in enumerate(paths)]
    out = join(paths, tmp_path / f"a{suffix}")
    whole = np.concatenate(parts)
    with open_trajectory(out) as reader:
        rtol, atol = TOLERANCES[suffix]
        np.testing.assert_allclose(reader.read(), whole, rtol=rtol, atol=1.1 * atol)
        np.testing.assert_allclose(np.diff(reader.time_ps), 0.5)
        np.testing.assert_array_equal(reader.flags, np.repeat([0, 1, 2], [6, 7, 8]))
        np.testing.assert_array_equal(reader.scalars["e"], np.repeat([0.0, 1.0, 2.0], [6, 7, 8]))
        assert reader.record["completed"] is True and "seed" not in reader.record
        found = replicas_of(reader.record, reader.n_frames)
        assert [(part.start, part.stop) for part, _ in found] == [(0, 6), (6, 13), (13, 21)]
        assert [record["seed"] for _, record in found] == [0, 1, 2]
        with pytest.raises(TrajectoryError, match="joined"):
            replicas_of(reader.record, 20)
    with open_trajectory(paths[0]) as reader:  # one that is not joined is one replica
        assert [part for part, _ in replicas_of(reader.record, 6)] == [slice(0, 6)] and KEY not in reader.record
    if suffix != ".h5":
        seen = mdtraj.load(str(out), top=str(out.with_suffix(".pdb")))
        np.testing.assert_allclose(seen.xyz, whole, atol=1e-5 + 1.1 * atol)
    assert not [name for name in left_behind(tmp_path) if name.startswith(".")]


def test_a_joined_file_costs_what_its_replicas_cost_together(tmp_path: Path) -> None:
    paths = [tmp_path / f"a_r{k}.h5" for k in range(3)]
    for k, path in enumerate(paths):
        replica(path, k)
        with open_writer(path, chain(N_ATOMS), RECORD | {"seed": k}, append=True) as writer:
            writer.update_record({"cost": {"wall_s": 2.0, "steps": 10}, "completed": k < 2, "time_ps": 2000.0})
    told = info(join(paths, tmp_path / "a.h5"))
    assert "6 s" in told["summary"] and told["record"]["cost"] == {"steps": 30, "wall_s": 6.0}
    assert told["summary"].endswith("(ended before the end of 2 ns)"), "one of them did"
    assert told["details"][:3] == [f"replica: a_r{k}.h5, 6 frames" for k in range(3)] and KEY not in told["record"]


def test_replicas_that_do_not_go_together_are_refused(tmp_path: Path) -> None:
    replica(tmp_path / "a_r0.h5", 0)
    replica(tmp_path / "a_r1.h5", 1, interval_ps=1.0)
    replica(tmp_path / "a_r2.h5", 2, n_atoms=5)
    for other, error in (("a_r1.h5", InputError), ("a_r2.h5", TrajectoryError)):
        with pytest.raises(error):
            join([tmp_path / "a_r0.h5", tmp_path / other], tmp_path / "a.h5")
        assert not (tmp_path / "a.h5").exists()
