"""The summary of what a frame costs names every part, and adds them up."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import rollout_parts


def test_parts_add_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rollout_parts.main(["--batch", "2", "--rounds", "1", "--precision", "fp32", "--json", str(tmp_path / "parts.json")])
    found = json.loads((tmp_path / "parts.json").read_text())["ms_per_frame"]["2"]
    whole, network = found.pop("whole chunk, as a rollout draws it"), found.pop("network, one evaluation")
    fixed = found.pop("fixed")
    assert fixed == pytest.approx(sum(found.values()))
    assert {"decoder", "writer", "guards", "canonical pose"} <= set(found)
    assert all(ms > 0 for ms in (whole, network, *found.values()))
    assert "batch of 2" in capsys.readouterr().out
    with pytest.raises(TypeError, match="parts are known of lam-slide"):
        rollout_parts.main(["--weights", "paracetamol-gfn2-xtb", "--batch", "1", "--rounds", "1"])
