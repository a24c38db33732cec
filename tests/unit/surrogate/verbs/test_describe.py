"""What `surromd info` says of a rollout's guards, and of folders of runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from surrogate.cli.render import print_pairs
from surrogate.verbs.info import info, intervention_lines
from surrogate.verbs.run.run_record import Outcome, RunRecord, write_run
from systems.errors import InputError


def test_what_guards_caught_and_did_is_said() -> None:
    plain = {"guard": "flag", "chunks": 162, "chunks_caught": 1, "reasons": {"clash": 3}, "frames": {}}
    assert intervention_lines({"interventions": plain}) == ["guard flag: 1 of 162 chunks caught: clash (3 frames)"]
    helped = plain | {"frames": {"repaired": 4}, "bias": ["colder"]}
    assert intervention_lines({"interventions": helped})[1:] == [
        "frames that are not the surrogate's first draw: 4 repaired", "bias: colder",
    ]  # fmt: skip


def test_a_folder_of_a_run_is_told_from_a_campaigns(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="manifest"):
        info(tmp_path)
    record = RunRecord("x", "X", "CH4", "abc", {})
    write_run(tmp_path, record)
    assert info(tmp_path)["summary"] == "not done; 0 stages have ended"
    write_run(tmp_path, replace(record, outcome=Outcome("Close.", "close", "so", 1.0, 2.0)))
    found = info(tmp_path)
    assert (found["type"], found["summary"], found["scene"]) == ("run", "Close.", "x")
    for damaged in ("[1]", "{", '{"outcome": 3, "stages": []}', "{}"):
        (tmp_path / "run.json").write_text(damaged)
        with pytest.raises(InputError, match=r"run\.json (cannot be read|was written by another version)") as caught:
            info(tmp_path)
        assert "\n" not in str(caught.value)


def test_a_folder_of_many_runs_lists_them(tmp_path: Path) -> None:
    lines = [{"name": "a", "failed": "", "headline": "Close."}, {"name": "b", "failed": "no SMILES"}]
    (tmp_path / "results.json").write_text(json.dumps(lines))
    found = info(tmp_path)
    assert found["summary"] == "1 of 2 molecules evaluated"
    assert found["molecules"] == {"a": "Close.", "b": "failed: no SMILES"}


def test_the_record_of_a_forced_rollout_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    print_pairs({"out_of_domain": [{"what": "temperature", "reason": "350 K, trained at 300 K"}]})
    assert "temperature: 350 K, trained at 300 K" in capsys.readouterr().out


def test_of_many_files_and_numbers_a_few_are_printed_and_json_has_all(capsys: pytest.CaptureFixture[str]) -> None:
    few = {"kt": {f"r{k}": 0.5 * k for k in range(5)}, "sources": [{"file": f"f{k}"} for k in range(5)]}
    print_pairs(few)
    assert len(capsys.readouterr().out.splitlines()) == 2 + 5 + 5
    many = {"kt": {f"r{k}": 0.5 * k for k in range(50)}, "sources": [{"file": f"f{k}"} for k in range(50)],
            "molecules": {f"m{k}": "Close." for k in range(50)}}  # fmt: skip
    print_pairs(many)
    lines = capsys.readouterr().out.splitlines()
    assert lines.count("  and 47 more (--json has all)") == 2 and len(lines) == 3 + 2 * (3 + 1) + 50
    print_pairs(many, as_json=True)
    assert json.loads(capsys.readouterr().out) == many
