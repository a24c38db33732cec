"""Whole runs with rates that are made up, so that MD is short: folder, resume, longer budgets, a failed surrogate."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quick_report import evaluated_at_once
from surrogate import api
from surrogate.verbs.run import one_scene, run_scenes, stages
from surrogate.verbs.run.rates import Rates, Rolls
from surrogate.verbs.run.run_scenes import molecules_in, write_results
from systems.errors import InputError, SimulationError
from systems.trajectory.codec import frame_weights, open_trajectory

# As if a second of MD made a tenth of a ps: 150 ps a replica in ten minutes, which are over in a second.
SLOW = Rates(22, 2, 1.0, False, "OBC2", 25e-6, 0.004, 0.2, "trained on it", Rolls("alanine-dipeptide", 1.0, 1.0))


@pytest.fixture
def slow_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(one_scene, "measure", lambda *_: SLOW)


def n_frames(folder: Path, names: list[str]) -> int:
    total = 0
    for name in names:
        with open_trajectory(folder / name) as reader:
            total += reader.n_frames
    return total


@pytest.mark.slow
def test_a_run_leaves_its_folder_and_goes_on_with_a_longer_budget(tmp_path: Path, slow_machine: None) -> None:
    folder = tmp_path / "run"
    found = api.run("alanine-dipeptide", folder, budget_s=400.0, way="md", quiet=True)
    assert found["decision"]["way"] == "md" and [stage["name"] for stage in found["stages"]] == ["md", "report"]
    assert found["trajectory"] == ["trajectory/md_r0.h5"] and found["held_out"] == ["trajectory/md_r1.h5"]
    page = (folder / "report.html").read_text("utf-8")
    assert all(line in page for line in found["outcome"]["in_short"]) and "MD for the whole budget" in page
    assert found.headline in (folder / "report.md").read_text("utf-8").replace("\\", "")
    assert (folder / "log.txt").read_text("utf-8").count("\n") == 2
    assert (
        api.run("alanine-dipeptide", folder, budget_s=400.0, way="md", resume=True, quiet=True)["outcome"]
        == found["outcome"]
    )
    frames = n_frames(folder, found["trajectory"])
    longer = api.run("alanine-dipeptide", folder, budget_s=800.0, way="md", resume=True, quiet=True)
    assert longer["settings"]["budget_s"] == 800.0 and len(longer["stages"]) == 2
    assert n_frames(folder, longer["trajectory"]) >= frames
    with pytest.raises(InputError, match="way"):
        api.run("alanine-dipeptide", folder, budget_s=800.0, resume=True, quiet=True)


def test_where_a_surrogate_fails_md_takes_the_rest(
    tmp_path: Path, slow_machine: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise SimulationError("the guards let no frame through")

    monkeypatch.setitem(stages.STAGES, "rollout", replace(stages.STAGES["rollout"], work=fail))
    found = api.run("alanine-dipeptide", tmp_path / "run", budget_s=400.0, way="surrogate", quiet=True)
    assert found["decision"]["way"] == "md" and "no frame through" in found["decision"]["why"][0]
    assert found["stages"][0]["status"] == "failed"
    assert found["outcome"]["notes"] and "no frame through" in (tmp_path / "run" / "report.html").read_text("utf-8")


def test_weights_that_roll_nothing_end_the_training_and_not_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise SimulationError("31 frames and no valid one; try other weights")

    def train(*_: object, **__: object) -> None:
        (tmp_path / "run" / stages.WEIGHTS_NAME).touch()

    monkeypatch.setattr(
        one_scene, "measure", lambda *_: replace(SLOW, rolls=None, coverage="nothing", md_ps_per_s=0.01, expensive=True)
    )
    monkeypatch.setattr(stages, "train", train)
    monkeypatch.setattr("surrogate.models.weights.load_weights", lambda path: path)
    monkeypatch.setattr(stages, "rollout_rate", fail)
    monkeypatch.setitem(stages.STAGES, "report", replace(stages.STAGES["report"], work=evaluated_at_once))
    found = api.run("alanine-dipeptide", tmp_path / "run", budget_s=400.0, way="surrogate", quiet=True)
    failed = next(stage for stage in found["stages"] if stage["name"] == "train")
    assert failed["status"] == "failed" and failed["note"] == "its weights roll nothing: 31 frames and no valid one."
    assert found["decision"]["way"] == "md" and found["outcome"] is not None and not found["weights"]


def test_molecules_are_a_list_a_folder_or_a_campaign(tmp_path: Path) -> None:
    (tmp_path / "m.smi").write_text("# drugs\nCCO ethanol\nCC(=O)O\n\n")
    found = molecules_in(tmp_path / "m.smi")
    assert found is not None and [s.source for s in found.scenes] == ["smiles:CCO", "smiles:CC(=O)O"]
    assert found.scenes[0].name == "ethanol" and found.scenes[1].name.startswith("CC_O_O-")
    (tmp_path / "two.smi").write_text("CCO a\nCCC A\n")
    with pytest.raises(InputError, match="called 'a'"):
        molecules_in(tmp_path / "two.smi")
    pdbs = tmp_path / "pdbs"
    pdbs.mkdir()
    with pytest.raises(InputError, match="no molecule"):
        molecules_in(pdbs)
    (pdbs / "mine.pdb").touch()
    (pdbs / "notes.txt").touch()
    found = molecules_in(pdbs)
    assert found is not None and [s.name for s in found.scenes] == ["mine"]
    (tmp_path / "c.toml").write_text('scenes = ["ethanol"]\ntime = "1ns"\n')
    found = molecules_in(tmp_path / "c.toml")
    assert found is not None and found.scenes[0].source == "ethanol"
    assert molecules_in("smiles:CCO") is None and molecules_in(pdbs / "mine.pdb") is None


def test_a_title_line_is_no_molecule(tmp_path: Path) -> None:
    for title in ("smiles\tid", "SMILES name", "canonical_smiles", '# a comment\n"Smiles"\tid', "\ufeffsmiles id"):
        (tmp_path / "t.smi").write_text(f"{title}\nCCO\te1\nCCN\te2\n", encoding="utf-8")
        found = molecules_in(tmp_path / "t.smi")
        assert found is not None and [s.name for s in found.scenes] == ["e1", "e2"] and not found.unreadable
    (tmp_path / "t.smi").write_text("CCO smiles\nCCN e2\n")
    found = molecules_in(tmp_path / "t.smi")
    assert found is not None and [s.name for s in found.scenes] == ["smiles", "e2"], "control"


def test_a_list_with_a_title_that_others_reported(shared_data: Path) -> None:
    found = molecules_in(shared_data / "reports" / "o_title.smi")
    assert found is not None and [s.source for s in found.scenes] == ["smiles:CCO", "smiles:CCN"]


def test_names_with_slashes_and_dots_keep_all_that_they_say(tmp_path: Path) -> None:
    (tmp_path / "m.smi").write_text("CCO a/x\nCCN b/x\nCCC drug 1.5\nCCF ok-1.2\nCCS e1\t3.4\n")
    found = molecules_in(tmp_path / "m.smi")
    assert found is not None
    names = [s.name for s in found.scenes]
    assert names[0].startswith("a_x-") and names[1].startswith("b_x-") and names[2].startswith("drug_1.5-")
    assert names[3:] == ["ok-1.2", "e1"], "control: a name that a file can have stays"
    assert not any("/" in name for name in names)


def test_lines_that_are_no_molecule_are_known_before_the_budget_is_shared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared: list[int] = []

    def share_s(n: int, *_: object) -> float:
        shared.append(n)
        raise InputError("enough")

    monkeypatch.setattr(run_scenes, "_share_s", share_s)
    monkeypatch.setattr(run_scenes, "open_client", lambda **_: nullcontext())
    (tmp_path / "m.smi").write_text("C1CC broken\nCCO fine\nC[Na] metal\n")
    with pytest.raises(InputError, match="enough"):
        api.run(tmp_path / "m.smi", tmp_path / "runs", budget_s=100.0, quiet=True)
    assert shared == [1]
    found = molecules_in(tmp_path / "m.smi")
    assert found is not None and found.unreadable.keys() == {"broken", "metal"}
    assert "cannot be read" in found.unreadable["broken"] and "Na" in found.unreadable["metal"]
    (tmp_path / "none.smi").write_text("not a molecule\nat all\n")
    with pytest.raises(InputError, match=r"none\.smi: no line begins with a SMILES"):
        molecules_in(tmp_path / "none.smi")


@pytest.mark.slow
def test_what_fails_among_many_is_listed_with_its_reason(tmp_path: Path) -> None:
    (tmp_path / "m.smi").write_text("C1CC broken\n[H] atom\n")
    found = api.run(tmp_path / "m.smi", tmp_path / "runs", budget_s=100.0, workers=1, quiet=True)
    assert found["failed"].keys() == {"broken", "atom"} and found["summary"] == "0 of 2 molecules evaluated"
    told = api.info(tmp_path / "runs")
    assert told["type"] == "runs" and told["molecules"]["broken"].startswith("failed: ")
    assert "failed: " in (tmp_path / "runs" / "index.html").read_text("utf-8")
    with pytest.raises(InputError, match=r"resume=True"):
        api.run(tmp_path / "m.smi", tmp_path / "runs", budget_s=100.0, workers=1, quiet=True)
    with pytest.raises(InputError, match="15 s each"):
        api.run(tmp_path / "m.smi", tmp_path / "more", budget_s=15.0, workers=1, quiet=True)


def test_the_table_links_each_report_and_takes_names_as_text(tmp_path: Path) -> None:
    line = {
        "name": "<b>", "scene": "smiles:C", "failed": "", "way": "md", "wall_s": 61.0, "rolled_ps": 1500.0,
        "held_out_ps": 1234.0, "equivalent_time": "at least 1 ns", "speed_up": None, "verdict": "Close.",
        "notes": ["stereocentre C2: <S>"],
    }  # fmt: skip
    write_results(tmp_path, [line, {"name": "x", "scene": "smiles:X", "failed": "no & such"}])
    page = (tmp_path / "index.html").read_text("utf-8")
    assert 'href="%3Cb%3E/report.html">&lt;b&gt;' in page and "1.2 ns" in page and "no &amp; such" in page
    assert "Close.; stereocentre C2: &lt;S&gt;" in page
    assert json.loads((tmp_path / "results.json").read_text())[0] == line


@pytest.mark.slow
def test_at_quantum_level_the_answer_is_a_rollout_reweighted_by_the_reference(tmp_path: Path) -> None:
    pytest.importorskip("tblite")
    folder = tmp_path / "run"
    found = api.run("smiles:OCCO", folder, level="gfn2-xtb", budget_s=45.0, quiet=True)
    assert [stage["name"] for stage in found["stages"]] == ["rollout", "energies", "report"]
    assert found.answer["populations_by"] == "reweighting" and found.answer["energies"][0] > 50
    page = (folder / "report.html").read_text("utf-8")
    assert found.answer["in_short"][0] in page and not found["held_out"]
    assert "compared with each other, not with reference MD" in page and "× the reference" not in page
    weights = np.concatenate([frame_weights(path) for path in found.trajectory])
    asked = len((folder / "energies.csv").read_text().splitlines()) - 1
    assert 0 < np.count_nonzero(weights) <= asked and weights.mean() == pytest.approx(1.0)
    api.run("smiles:OCCO", folder, level="gfn2-xtb", budget_s=60.0, resume=True, quiet=True)
    assert len((folder / "energies.csv").read_text().splitlines()) - 1 > asked
