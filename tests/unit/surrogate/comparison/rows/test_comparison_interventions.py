"""Frames that guards changed: read from the file, told in a note, and left out of a second distance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.comparison.comparison import compare
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.rows.rows import Options
from systems.scene import Scene
from systems.trajectory.codec import open_writer

RECORD = {"temperature_k": 300.0, "interventions": {"guard": "fallback", "chunks": 100, "chunks_caught": 7,
          "frames": {"MD after a failure": 30}, "bias": ["a mixture"]}}  # fmt: skip
QUICK = Options(n_bootstrap=60, n_permutations=100, peptide_recipe=False)


def test_the_column_and_the_summary_are_read(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    paths = [tmp_path / f"r{k}.h5" for k in range(2)]
    frames = np.repeat(alanine_dipeptide.positions_nm[None], 40, axis=0)
    marks = np.zeros(40)
    marks[30:33] = 3
    for path in paths:
        with open_writer(path, alanine_dipeptide, RECORD) as writer:
            writer.append(frames, np.arange(40) + 1.0, scalars={"intervention": marks})
    found = load_ensemble(paths)
    assert found.changed is not None and [c.sum() for c in found.changed] == [3, 3]
    assert np.flatnonzero(found.changed[0]).tolist() == [30, 31, 32]
    assert [c.sum() for c in found.strided(2).changed or []] == [2, 2]
    (note,) = (n for n in found.notes if "guard" in n)
    assert "stepped in in 14 of 200 chunks" in note and "60 MD after a failure" in note and "a mixture" in note
    plain = tmp_path / "plain.h5"
    with open_writer(plain, alanine_dipeptide, {"temperature_k": 300.0}) as writer:
        writer.append(frames, np.arange(40) + 1.0)
    assert load_ensemble([plain]).changed is None
    assert not [n for n in load_ensemble([plain]).notes if "guard" in n]


def test_distances_without_changed_frames_stand_beside_those_with(inputs: tuple[Ensemble, Ensemble, Ensemble]) -> None:
    """A tenth of the candidate is frozen in one conformation, as by repeated repair; left out, it is as the rest is."""
    reference, candidate, replicate = inputs
    changed = [np.arange(len(s)) % 10 == 0 for s in candidate.segments]
    frozen = []
    for frames, gone in zip(candidate.segments, changed, strict=True):
        copy = np.array(frames[:])
        copy[gone] = copy[0]
        frozen.append(copy)
    touched = replace(candidate, segments=frozen, changed=changed)
    rows = {row.key: row for row in compare(reference, [touched], replicate, options=QUICK).evaluations[0].rows}
    (key,) = (k for k in rows if k.startswith("joint_jsd_unchanged"))
    with_all, without = rows[key.replace("_unchanged", "")].candidate.value, rows[key].candidate.value
    clean = {r.key: r for r in compare(reference, [candidate], replicate, options=QUICK).evaluations[0].rows}
    assert key not in clean
    assert without == pytest.approx(clean[key.replace("_unchanged", "")].candidate.value, rel=0.15)
    assert with_all > 1.5 * without, "the bias shows"
    assert "10 % that guards changed" in rows[key].metric


def test_nothing_or_nearly_everything_changed_is_said_and_skipped(
    inputs: tuple[Ensemble, Ensemble, Ensemble],
) -> None:
    reference, candidate, replicate = inputs
    for value, said in ((False, "changed no frame"), (True, "100 %")):
        marked = replace(candidate, changed=[np.full(len(s), value) for s in candidate.segments])
        evaluation = compare(reference, [marked], replicate, options=QUICK).evaluations[0]
        assert not [row for row in evaluation.rows if "unchanged" in row.key]
        assert [why for what, why in evaluation.skipped if "guards changed" in what and said in why]
