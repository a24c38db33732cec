"""The study of LaM-SLidE's error on charged particles: each kind of line trains, and what is left out makes none."""

from __future__ import annotations

from pathlib import Path

import n_body_causes as study
import pytest

from surrogate.bench.reproduce.n_body_data import make_systems

NAMES = (
    "set: and charges in the code",
    "set: regression instead of a flow",
    "set: identifiers in one order",
    "exact code: a token for all particles of a frame",
    "particles: not told of charges",
    "particles: a token each, positions given",
    "particles: 16 trajectories by heart",
)


def test_every_kind_of_line_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "CODE_STEPS", 2)
    monkeypatch.setattr(study, "CODE_BATCH", 8)
    monkeypatch.setattr(study, "BATCH", 4)
    data = make_systems("n-body-charged", range(4))
    changes = {change.name: change for change in study.CHANGES}
    assert len(changes) == len(study.CHANGES)
    for name in NAMES:
        found = study.run(changes[name], data, data.first(3), tmp_path, 2)
        assert found.steps == 2
        assert 0.0 < found.mean_ade < 5.0
        # Without noise a sample is the mean forecast; what codes nothing errs by nothing.
        assert (found.sample_ade == found.mean_ade) == ("regression" in name)
        if "exact" in name:
            assert found.code_ade == pytest.approx(0.0, abs=1e-5)
        else:
            assert (found.code_ade is None) == name.startswith("particles")
