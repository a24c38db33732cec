"""The study of LaM-SLidE's error on charged particles: each kind of line trains, and what is left out makes none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import n_body_causes as study
import numpy as np
import pytest
import torch
from forecast_methods import N_GIVEN, polynomial_weights
from n_body_cause_views import InnovationsView, VelocitiesView
from n_body_data import make_systems
from n_body_views import ParticleView

from surrogate.models.lam_slide.trainer import random_rotations

NAMES = (
    "set: flow times of the paper, charges in the code",
    "16 windows, set: and the next frame's true velocities",
    "16 windows, set: 5 latents, a token each",
    "set: regression instead of a flow",
    "exact code: a token for all particles of a frame",
    "particles: not told of charges",
    "particles: a token each, positions given",
    "particles: given frames noised by 5 %",
    "particles: innovations",
    "particles: and the next frame's true velocities",
    "particles: 16 trajectories by heart",
)


@pytest.mark.slow
def test_every_kind_of_line_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "CODE_STEPS", 2)
    data = make_systems("n-body-charged", range(4))
    changes = {change.name: change for change in study.CHANGES}
    assert len(changes) == len(study.CHANGES)
    for name in NAMES:
        found = study.run(replace(changes[name], batch=4), data, data.first(3), tmp_path, 2)
        assert found.steps == 2
        assert 0.0 < found.mean_ade < 5.0
        # Without noise a sample is the mean forecast; what codes nothing errs by nothing.
        assert (found.sample_ade == found.mean_ade) == ("regression" in name)
        if "exact" in name:
            assert found.code_ade == pytest.approx(0.0, abs=1e-5)
        else:
            assert (found.code_ade is None) == name.startswith("particles")


def test_lines_that_were_not_run_again_stay_in_the_table(tmp_path: Path) -> None:
    old, new = study.CHANGES[3].name, study.CHANGES[1].name
    (tmp_path / f"{study._slug(new)}.csv").write_text("step,sample_ade,mean_ade\n5,0.5,0.25\n")
    before = {"rows": [[old, "1", "2", "", "", "9"], ["gone", "1", "2", "", "", "9"]], "curves": {old: [[9, 2, 1]]}}
    made = study.table_of([study.Found(new, 5, 1.0, 0.25, 0.5, 1.0)], tmp_path, json.loads(json.dumps(before)))
    assert made["rows"] == [[new, "0.250", "0.500", "", "", "5"], before["rows"][0]]
    assert made["curves"] == {new: [[5, 0.5, 0.25]], old: [[9, 2, 1]]}


def test_innovations_are_what_the_frames_before_do_not_tell() -> None:
    data = make_systems("n-body-charged", range(3))
    view = InnovationsView.of(data, polynomial_weights(1, 2))
    x = data.positions_nm
    seen = view.ahead(x)
    np.testing.assert_allclose(view.from_model(x[:, :N_GIVEN], seen), x[:, N_GIVEN:], rtol=0, atol=1e-10)
    # Of a line through two frames they are the changes of steps.
    bends = np.diff(x, 2, axis=1)[:, N_GIVEN - 2 :]
    np.testing.assert_allclose(seen * view.scales_nm[:, None, None], bends, rtol=0, atol=1e-10)


def test_true_velocities_turn_with_their_system() -> None:
    data = make_systems("n-body-charged", range(3))
    plain = ParticleView.of(data, polynomial_weights(1, 3))
    view = VelocitiesView(plain.window, plain.sizes_nm)
    turned = study._turned(data, torch.Generator().manual_seed(1))
    turns = random_rotations(3, torch.Generator().manual_seed(1))[:, None]
    told, known = (view.known(d.positions_nm[:, :N_GIVEN], d).features.unflatten(-1, (-1, 3)) for d in (data, turned))
    torch.testing.assert_close(known, told @ turns.mT, rtol=0, atol=1e-5)
    torch.testing.assert_close(told[:, :, :-1].flatten(2), plain.known(data.positions_nm[:, :N_GIVEN], data).features)
    # They are those of the first frame to come, nearly the step about it, and not of the last given one.
    steps = np.diff(data.positions_nm - data.positions_nm.mean(2, keepdims=True), axis=1) / data.lag_ps
    off = [
        np.median(np.abs(told[:, :, -1].numpy() - steps[:, at : at + 2].mean(1))) for at in (N_GIVEN - 1, N_GIVEN - 2)
    ]
    assert 5 * off[0] < off[1]
