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


def test_a_stage_before_the_count_does_not_slow_the_speed(capsys: pytest.CaptureFixture[str],
                                                          monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    clock = [0.0]
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    with progress_bar("MD", quiet=False, ps_per_frame=1.0) as advance:
        assert advance is not None
        advance(400, 1000, "equilibrating")
        clock[0] = 1000.0
        advance(0, 100)
        clock[0] = 1010.0
        advance(100, 100)
    shown = capsys.readouterr().err
    # 100 ps in the ten seconds after the equilibration: 0.864 µs/day; with its thousand seconds it would be 0.00855.
    assert "0.864 µs/day" in shown
