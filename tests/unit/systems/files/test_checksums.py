"""Checksums: any flipped bit of a frame shows, and text is what was written or refused."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from systems.errors import SurromdError, TrajectoryError
from systems.files.whole_file import frame_checksums, sealed, unsealed
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer

CELL = np.diag([2.0, 2.1, 2.2])


def pair(*, periodic: bool = False) -> Scene:
    return Scene(
        name="pair",
        atom_names=("A", "B"),
        elements=("C", "O"),
        residue_of_atom=np.zeros(2, dtype=np.int64),
        residue_names=("UNK",),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=np.array([[0, 1]]),
        bond_orders=np.ones(1),
        formal_charges=np.zeros(2, dtype=np.int64),
        masses_da=np.array([12.0, 16.0]),
        positions_nm=np.array([[0.0, 0.0, 0.0], [0.12, 0.0, 0.0]]),
        cell_nm=CELL if periodic else None,
    )


def write(path: Path, n: int = 3, *, periodic: bool = False, columns: tuple[str, ...] = ()) -> None:
    rng = np.random.default_rng(4)
    extra = {f"{name}_{unit}": rng.normal(size=(n, 2, 3)) for name, unit in
             (("velocities", "nm_ps"), ("forces", "kj_mol_nm")) if name in columns}  # fmt: skip
    with open_writer(path, pair(periodic=periodic), {"seed": 7}, columns=columns) as writer:
        writer.append(rng.normal(size=(n, 2, 3)), np.arange(1, n + 1), flags=np.arange(n), chunk_idx=np.arange(n),
                      scalars={"energy": rng.normal(size=n)}, **extra)  # fmt: skip


def everything(path: Path) -> list[object]:
    with open_trajectory(path) as reader:
        assert reader.scene is not None and reader.flags is not None and reader.chunk_idx is not None
        columns = [reader.read(), reader.time_ps, reader.flags, reader.chunk_idx, *reader.scalars.values(),
                   reader.read_velocities(), reader.read_forces(), reader.read_cells()]  # fmt: skip
        arrays = [None if c is None else c.tolist() for c in columns]
        return [*arrays, reader.record, json.dumps(reader.scene.to_dict()), sorted(reader.scalars)]


def test_each_flipped_bit_changes_the_checksum() -> None:
    rng = np.random.default_rng(0)
    columns = {"frames": rng.normal(size=(1, 4, 3)).astype(np.float32), "time": np.array([17.0]),
               "chunk_idx": np.array([3], dtype=np.int32), "flags": np.array([5], dtype=np.uint16),
               "scalars/e": np.array([-2.5])}  # fmt: skip
    usual = frame_checksums(columns)
    seen = {int(usual[0])}
    n_bits = 0
    for name, values in columns.items():
        for bit in range(8 * values.nbytes):
            raw = bytearray(values.tobytes())
            raw[bit // 8] ^= 1 << bit % 8
            changed = np.frombuffer(bytes(raw), dtype=values.dtype).reshape(values.shape)
            seen.add(int(frame_checksums(columns | {name: changed})[0]))
            n_bits += 1
    assert len(seen) == n_bits + 1


@pytest.mark.parametrize("change", ["signs", "exchanged", "shifted", "atoms exchanged"])
def test_changes_that_simple_sums_do_not_see(change: str) -> None:
    x = np.random.default_rng(1).normal(size=(50, 22, 3)).astype(np.float32)
    usual = frame_checksums({"frames": x})
    if change == "signs":
        y = x * np.float32(-1.0)
    elif change == "exchanged":
        y = x[:, :, [1, 0, 2]]
    elif change == "atoms exchanged":
        y = x[:, ::-1]
    else:
        y = np.roll(x, 1, axis=0)
    assert (frame_checksums({"frames": y}) != usual).all()
    assert (frame_checksums({"frames": x.copy()}) == usual).all()


def test_columns_may_begin_later_but_not_change_names() -> None:
    x = {"frames": np.ones((2, 1, 3), dtype=np.float32)}
    late = frame_checksums({**x, "scalars/e": np.array([np.nan, 0.0])})
    assert late[0] == frame_checksums(x)[0] and late[1] != frame_checksums(x)[1]
    assert late[1] != frame_checksums({**x, "scalars/f": np.array([np.nan, 0.0])})[1]
    assert len(frame_checksums({"frames": np.ones((0, 4, 3), dtype=np.float32)})) == 0


def test_sealed_text() -> None:
    for value in ({}, {"a": 1, "b": "x"}):
        text = json.dumps(value)
        assert json.loads(unsealed(sealed(text))) == value
        for wrong in (
            text,
            sealed(text).replace("{", "{ ", 1),
            sealed(text)[:-2],
            sealed(text).replace("_seal", "_sea1"),
        ):
            with pytest.raises(ValueError, match="checksum"):
                unsealed(wrong)


@pytest.mark.parametrize("suffix", [".h5", ".dcd"])
def test_each_flipped_bit_of_the_frames_is_noticed(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write(path)
    whole, reference = path.read_bytes(), everything(path)
    if suffix == ".dcd":
        places = range(len(whole) - 3 * (3 * (2 * 4 + 8)), len(whole))
    else:
        with h5py.File(path) as file:
            start = file["coordinates"].id.get_chunk_info(0).byte_offset
            places = range(start, start + 3 * 2 * 3 * 4)
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(TrajectoryError, match=r"damaged at frame [012]"):
            everything(path)
    path.write_bytes(whole)
    assert everything(path) == reference


@pytest.mark.parametrize("name", ["velocities", "forces", "particles/trajectory/box/edges/value", "time",
                                  "surromd/flags", "surromd/chunk_idx", "surromd/scalars/energy", "surromd/record",
                                  "surromd/scene"])  # fmt: skip
def test_a_changed_column_is_noticed(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.h5"
    write(path, periodic=True, columns=("velocities", "forces"))
    everything(path)
    with h5py.File(path, "r+") as file:
        values = file[name][()]
        if isinstance(values, bytes):
            file[name][()] = values.replace(b"7", b"8").replace(b"pair", b"pear")
        else:
            values[(2,) + (0,) * (values.ndim - 1)] += 1
            file[name][...] = values
    with pytest.raises(SurromdError, match="checksum"):
        everything(path)


def test_a_changed_cell_of_a_dcd_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.dcd"
    write(path, periodic=True)
    everything(path)
    data = bytearray(path.read_bytes())
    frame = (len(data) - 14 * 4 * 3 - 3 * (3 * (2 * 4 + 8))) + 4
    data[frame + 5] ^= 1
    path.write_bytes(data)
    with pytest.raises(TrajectoryError, match="damaged at frame 0"):
        everything(path)


def test_files_of_earlier_versions_are_read_and_not_continued(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write(path)
    reference = everything(path)
    with h5py.File(path, "r+") as file:
        for name in ("record", "scene"):
            text = json.loads(file[f"surromd/{name}"][()])
            del text["_seal"], file[f"surromd/{name}"]
            file[f"surromd/{name}"] = np.bytes_(json.dumps(text).encode())
        del file["surromd/checksums"], file["surromd/run_id"]
    assert everything(path) == reference
    with pytest.raises(TrajectoryError, match="not written by surromd"):
        open_writer(path, pair(), {}, append=True)
    assert everything(path) == reference
