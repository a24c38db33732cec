"""The label of the progress bar is printed as it is."""

from __future__ import annotations

import pytest

from surrogate.progress import progress_bar


def test_brackets_are_no_markup_and_long_labels_are_cut(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for label, shown in (("OpenMM c1cc[nH]c1", "c1cc[nH]c1"), ("C" * 99, "C" * 41 + "...")):
        with progress_bar(label, quiet=False) as advance:
            assert advance is not None
            advance(1, 1)
        assert shown in capsys.readouterr().err
