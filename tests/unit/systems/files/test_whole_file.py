"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from systems.errors import StorageError
from systems.files.whole_file import create_whole


def test_a_file_that_its_writer_made_private_has_the_rights_of_a_new_one(tmp_path: Path) -> None:
    def private(path: Path) -> None:
        path.write_text("x")
        path.chmod(0o600)

    before = os.umask(0o027)
    try:
        create_whole(tmp_path / "a", private)
    finally:
        assert os.umask(before) == 0o027, "the mask is left as it was"
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


def test_what_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")

    def fails(path: Path) -> None:
        path.write_text("half")
        raise OSError(28, "No space left on device")

    with pytest.raises(StorageError, match="disk"):
        create_whole(tmp_path / "a", fails)
    assert [p.name for p in tmp_path.iterdir()] == ["a"] and (tmp_path / "a").read_text() == "old"
