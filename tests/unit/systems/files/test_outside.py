"""Files of strangers: small ones that stand for much, that lead elsewhere, that steer a terminal."""

from __future__ import annotations

import gzip
from pathlib import Path

import h5py
import numpy as np
import pytest

from md_reference.forces.gaff import Entry, read_entry, store
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import MDConfig, check_run
from systems.chemistry.distance_bonds import bonds_by_distance
from systems.errors import InputError, PreparationError, TrajectoryError
from systems.files.outside import content, printable
from systems.files.whole_file import replica_paths
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer


def trajectory(path: Path, scene: Scene) -> Path:
    with open_writer(path, scene, {}) as writer:
        writer.append(scene.positions_nm[None].repeat(3, axis=0), [1.0, 2.0, 3.0])
    return path


@pytest.mark.parametrize("ours", [True, False])
def test_declared_frames_that_are_not_there_are_refused(tmp_path: Path, alanine_dipeptide: Scene, ours: bool) -> None:
    path = tmp_path / "a.h5"
    if ours:
        trajectory(path, alanine_dipeptide)
        with h5py.File(path, "r+") as file:
            for name in ("coordinates", "time", "surromd/chunk_idx", "surromd/checksums/frames"):
                file[name].resize(300_000_000, axis=0)
    else:
        with h5py.File(path, "w") as file:
            file.create_dataset("coordinates", (300_000_000, 2, 3), "<f4", maxshape=(None, 2, 3), chunks=(64, 2, 3))
            file.create_dataset("time", (300_000_000,), "<f4", maxshape=(None,), chunks=(64,))
    assert path.stat().st_size < 300_000
    with pytest.raises(TrajectoryError, match=r"declares|missing|differ"):
        open_trajectory(path)


def test_links_into_other_files_are_not_followed(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    secret = trajectory(tmp_path / "secret.h5", alanine_dipeptide)
    path = trajectory(tmp_path / "a.h5", alanine_dipeptide)
    with open_trajectory(path) as reader:
        assert reader.n_frames == 3
    with h5py.File(path, "r+") as file:
        del file["coordinates"]
        file["coordinates"] = h5py.ExternalLink(str(secret), "/coordinates")
    with pytest.raises(TrajectoryError, match="is a link into another file"):
        open_trajectory(path)
    with h5py.File(path, "r+") as file:
        del file["coordinates"]
        file.create_dataset("coordinates", (3, 22, 3), "<f4", external=[(str(secret), 0, 792)])
    with pytest.raises(TrajectoryError, match="lie in another file"):
        open_trajectory(path)


def test_files_that_hold_or_unpack_to_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("systems.files.outside._TEXT_BYTES", 1_000_000)
    path = tmp_path / "a.pdb"

    def read(data: bytes) -> bytes:
        path.write_bytes(data)
        return content(path)

    assert read(gzip.compress(b"a" * 900_000) + gzip.compress(b"b")) == b"a" * 900_000 + b"b"
    assert read(b"plain") == b"plain"
    with pytest.raises(ValueError, match="unpacks to more than 1 MB"):
        read(gzip.compress(b" " * 50_000_000))
    for bad in (gzip.compress(b"abc")[:-9], b"\x1f\x8b nothing"):
        with pytest.raises(ValueError, match=r"cut short|damaged"):
            read(bad)
    with path.open("wb") as file:
        file.truncate(10**12)  # takes no space
    with pytest.raises(ValueError, match="holds more than 1 MB"):
        content(path)


def test_atoms_in_each_other_are_refused_before_all_pairs_are_listed() -> None:
    with pytest.raises(PreparationError, match="stand in each other"):
        bonds_by_distance(["C"] * 5000, np.zeros((5000, 3)))
    line = np.arange(2000.0)[:, None] * [0.15, 0.0, 0.0]
    assert len(bonds_by_distance(["C"] * 2000, line)) == 1999


def test_runs_larger_than_any_disk_are_refused(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    with pytest.raises(InputError, match="the disk has"):
        check_run(alanine_dipeptide, MDConfig(time_ps=1e33), tmp_path / "a.h5")
    assert check_run(alanine_dipeptide, MDConfig(time_ps=1e6), tmp_path / "a.h5").force == ForceFieldSpec()
    with pytest.raises(InputError, match="too many"):
        replica_paths(tmp_path / "a.h5", 1_000_000_000)


def test_what_would_steer_a_terminal_is_shown() -> None:
    assert printable("a\x1b]0;x\x07\x9b2J\r\nφ Å") == "a\\x1b]0;x\\x07\\x9b2J\\r\nφ Å"


def test_a_cache_entry_that_has_changed_is_made_again(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    path = tmp_path / "x.json.gz"
    prmtop = "%VERSION\n%FLAG POINTERS\n%FORMAT(10I8)\n" + "".join(f"{n:8d}" for n in [22] + [0] * 30) + "\n"
    entry = Entry(alanine_dipeptide, prmtop, {"method": "test"})
    store(path, entry)
    text = gzip.decompress(path.read_bytes())
    assert b'"_seal"' in text
    whole = read_entry(path)
    path.write_bytes(gzip.compress(text.replace(b'"method": "test"', b'"method": "tesT"')))
    assert read_entry(path) is None
    assert whole is None or whole.source == {"method": "test"}


def test_columns_are_kept_in_little_memory(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    path = tmp_path / "a.h5"
    with open_writer(path, alanine_dipeptide, {}) as writer:
        assert writer.file.id.get_access_plist().get_cache()[2] <= 2**20  # HDF5 2: 8 MiB a column
