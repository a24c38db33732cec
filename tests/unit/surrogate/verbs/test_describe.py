"""What `surromd info` says of a rollout's guards, and of folders of runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from surrogate.verbs.info import info, intervention_lines
from systems.errors import InputError


def summary(chunks: int, caught: int, **more: Any) -> dict[str, Any]:
    plain = {"guard": "flag", "chunks": chunks, "chunks_caught": caught, "reasons": {"clash": 3}, "frames": {}}
    return {"interventions": plain | more}


@pytest.mark.parametrize(
    ("chunks", "caught", "said"),
    [(162, 162, "100 %"), (10_000, 9_999, "99.9 %"), (162, 100, "62 %"), (162, 1, "0.62 %"), (1000, 995, "99.5 %")],
)
def test_a_share_of_chunks_is_said_as_people_write_it(chunks: int, caught: int, said: str) -> None:
    assert intervention_lines(summary(chunks, caught)) == [
        f"guard flag: {caught} of {chunks} chunks caught ({said}): clash (3 frames)"
    ]


def test_what_help_costs_is_said_as_people_write_it() -> None:
    seconds = {"draw": 2.0, "md": 9.0, "check": 0.001}
    lines = intervention_lines(summary(9, 3, frames={"repaired": 4}, seconds=seconds, bias=[]))
    assert lines[-1] == "cost beside drawing chunks: md 450 %, check 0.05 %"


def test_a_folder_of_a_run_is_told_from_a_campaigns(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="manifest"):
        info(tmp_path)
    (tmp_path / "run.json").write_text(json.dumps({"scene": "x", "stages": [{}], "outcome": None}))
    assert info(tmp_path)["summary"] == "not done; 1 stages have ended"
    (tmp_path / "run.json").write_text(json.dumps({"scene": "x", "stages": [], "outcome": {"headline": "Close."}}))
    found = info(tmp_path)
    assert (found["type"], found["summary"], found["scene"]) == ("run", "Close.", "x")
    for damaged in ("[1]", "{", '{"outcome": 3, "stages": []}', "{}"):
        (tmp_path / "run.json").write_text(damaged)
        with pytest.raises(InputError, match=r"run\.json cannot be read") as caught:
            info(tmp_path)
        assert "\n" not in str(caught.value)


def test_a_folder_of_many_runs_lists_them(tmp_path: Path) -> None:
    lines = [{"name": "a", "failed": "", "headline": "Close."}, {"name": "b", "failed": "no SMILES"}]
    (tmp_path / "results.json").write_text(json.dumps(lines))
    found = info(tmp_path)
    assert found["summary"] == "1 of 2 molecules evaluated"
    assert found["molecules"] == {"a": "Close.", "b": "failed: no SMILES"}
