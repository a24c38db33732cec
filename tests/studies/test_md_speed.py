"""The benchmark of reference MD: it compares equal models, and sees unequal ones."""

from __future__ import annotations

import json
from pathlib import Path

import md_speed as study
import pytest


@pytest.mark.slow
def test_the_benchmark_compares_equal_models(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "bench.json"
    study.main(["--case", "ethanol", "--rounds", "1", "--seconds", "0.05s", "--cores", "1", "-o", str(out)])
    rows = json.loads(out.read_text())["rows"]
    assert [(row["case"], row["solvent"], row["n_atoms"]) for row in rows] == [
        ("ethanol", "vacuum", 9),
        ("ethanol", "obc2", 9),
    ]
    for row in rows:
        assert row["equal_energies"] and row["energy_gap"] < 0.02 and row["force_gap"] < 1e-4
        assert row["ns_per_day"]["ours"] > row["ns_per_day"]["plain, all cores"]
    shown = capsys.readouterr().out
    assert "ethanol" in shown and "ratio" in shown
    with pytest.raises(SystemExit, match="Did you mean 'ethanol'"):
        study.main(["--case", "methanol"])


def test_unequal_models_are_seen() -> None:
    """Negative control of the comparison: another force field, and another solvent."""
    ala = next(c for c in study.CASES if c.scene == "alanine-dipeptide" and c.solvent == "obc2")
    scene = ala.prepared()
    mine = study.ours(ala, scene)
    mine.context.setPositions(scene.positions_nm)
    for other in (ala, study.Case("x", ala.scene, "vacuum"), study.Case("x", ala.scene, "obc2", "ff99SB-ILDN")):
        found = study._compare({"ours": mine, "plain, one a core": study.plain(scene, other.spec(), threads=1)})
        assert found["equal_energies"] == (other is ala), found
