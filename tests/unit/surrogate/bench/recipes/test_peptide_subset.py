"""A part of the runs of each molecule: of its own length and states, and of nothing that is held out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from small_scenes import with_phi_turned
from surrogate.bench.recipes import peptide_subset
from surrogate.bench.recipes.peptide_subset import choose_parts, held_losses, training_sets
from surrogate.data.frames import collect_frames
from surrogate.data.weights import load_weights
from systems.errors import InputError
from systems.prepare.peptide import build_peptide
from systems.trajectory.codec import open_writer

_N, _RUNS = 1200, 4


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two molecules that tremble; for 96 of 1,200 frames of each run phi is turned by half a circle."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("ALA", "GLY"):
        scene = build_peptide(f"ACE-{name}-NME")
        rng = np.random.default_rng(len(list(folder.iterdir())))
        (folder / name).mkdir()
        for k in range(_RUNS):
            x = np.repeat(scene.positions_nm[None], _N, axis=0)
            x[96 * (1 + k) : 96 * (2 + k)] = with_phi_turned(scene)
            x += 0.004 * rng.normal(size=x.shape)
            record = {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0}
            with open_writer(folder / name / f"run_{k:03d}.h5", scene, record) as writer:
                writer.append(x.astype(np.float32), 1.0 + np.arange(_N))
    return folder


def test_parts_are_frames_of_the_runs_and_none_that_is_held_out_is_trained_on(runs: Path) -> None:
    frames = collect_frames(sorted((runs / "ALA").glob("*.h5")))
    fine, wide = choose_parts(frames, 800, seed=1)
    assert (fine.lag_ps, wide.lag_ps) == (1.0, 10.0)
    assert 300 < fine.n_frames <= 400 and wide.n_frames == 3 * 114
    cut = round(0.95 * _N)
    for part in (fine, wide):
        trained = {begin for begin, _ in part.split.ranges(part.starts, validation=False)}
        for source, begin, end in zip(part.sources, part.starts[:-1].tolist(), part.starts[1:].tolist(), strict=True):
            run = int(source["file"][4:7])
            idx = source["first_frame"] + source["every"] * np.arange(end - begin)
            np.testing.assert_array_equal(part.coordinates[begin:end], frames.coordinates[run * _N + idx])
            assert idx[-1] < cut if begin in trained else part is wide or idx[0] >= cut


def test_stretches_with_rare_states_are_drawn_more_often(runs: Path) -> None:
    """Every twelfth stretch holds the other sign of phi, and it is drawn for a third and more of the frames."""
    frames = collect_frames(sorted((runs / "ALA").glob("*.h5")))
    share = []
    for seed in range(20):
        fine, _ = choose_parts(frames, 800, seed=seed)
        rare = [(96 <= s["first_frame"] - 96 * int(s["file"][4:7]) < 192) for s in fine.sources[:-1]]
        share.append(np.mean(rare))
    assert np.mean(share) > 0.33


def test_the_subset_fits_and_its_loss_is_measured_beside_that_of_all_runs(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peptide_subset, "_EVERY", 1)
    monkeypatch.setattr(peptide_subset, "_HELD_WINDOWS", 16)
    monkeypatch.setattr(peptide_subset, "_HEADER_BYTES", 15_000)
    out = tmp_path / "subset"
    with pytest.raises(InputError, match="holds no runs"):
        peptide_subset.main(["write", str(out), "--train", str(tmp_path / "nowhere")])
    with pytest.raises(InputError, match="`write` it first"):
        peptide_subset.main(["measure", str(out), "--train", str(runs)])
    peptide_subset.main(["write", str(out), "--train", str(runs), "--mib", "0.3"])
    files = sorted(out.rglob("*.h5"))
    assert [path.name for path in files] == ["fine.windows.h5", "wide.windows.h5"] * 2
    assert 0.15 < sum(path.stat().st_size for path in files) / 2**20 <= 0.3
    assert "2 molecules" in capsys.readouterr().out
    assert [f.lag_ps for f in training_sets(out / "ALA")] == [1.0, 10.0]
    assert [f.n_frames for f in training_sets(runs / "ALA")] == [_N * _RUNS]
    peptide_subset.main(["measure", str(out), "--train", str(runs), "--steps", "2"])
    record = json.loads((out / "losses-2.json").read_text())
    assert record["molecules"] == ["ALA", "GLY"] and record["frames"]["all runs"] == 2 * _N * _RUNS
    assert record["worse"] == pytest.approx(record["loss"]["subset"] - record["loss"]["all runs"])
    # A model's loss is what its flow predicts: with a network that says nothing it is the variance of what is asked.
    model = load_weights(out / "subset-2.safetensors").model
    sets = training_sets(runs / "ALA")
    before = held_losses(model, sets)
    for parameter in model.flow.parameters():
        parameter.data += 0.05
    assert (held_losses(model, sets) > before).all()
    shifted = [replace(f, coordinates=f.coordinates[::-1].copy()) for f in sets]
    assert (held_losses(model, shifted) != held_losses(model, sets)).all()
