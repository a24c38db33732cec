"""Terms that a file says were given to its frames: shown, marked, and out of the verdict; nothing else is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.judge.comparison import Comparison, Judgement, compare
from surrogate.judge.read.ensemble import Ensemble, load_ensemble
from surrogate.judge.report.report import render
from surrogate.judge.rows.rows import Options
from systems.imposed import ANGLES, BONDS, KEY, RIGID_BONDS, imposed_terms
from systems.scene import Scene
from systems.trajectory.codec import open_writer

QUICK = Options(n_bootstrap=60, n_permutations=20, peptide_recipe=False)
_IMPOSED = {"bond_shift", "bond_width:flexible bonds", "bond_jsd", "bond_wasserstein",
            "angle_shift", "angle_jsd", "angle_wasserstein", "temperature"}  # fmt: skip


@pytest.fixture(scope="module")
def widened(simulate: Callable[..., Ensemble]) -> tuple[Ensemble, Ensemble, Ensemble]:
    """A candidate whose atoms wobble by half as much again as they should, so that its bonds are too wide."""
    reference, candidate, replicate = (simulate(seed, 1500) for seed in (1, 2, 3))
    segments = []
    for frames in candidate.segments:
        x = np.array(frames[:])
        segments.append(x + 0.002 * np.random.default_rng(0).standard_normal(x.shape).astype(np.float32))
    return reference, replace(candidate, segments=segments), replicate


def _compared(trio: tuple[Ensemble, Ensemble, Ensemble], terms: list[str]) -> Comparison:
    reference, candidate, replicate = trio
    record = {**candidate.record, KEY: terms} if terms else candidate.record
    return compare(reference, [replace(candidate, record=record)], replicate, options=QUICK)


@pytest.fixture(scope="module")
def plain(widened: tuple[Ensemble, Ensemble, Ensemble]) -> Judgement:
    return _compared(widened, []).judgements[0]


def test_rows_of_imposed_terms_are_shown_and_leave_the_verdict(
    widened: tuple[Ensemble, Ensemble, Ensemble], plain: Judgement
) -> None:
    assert plain.status == "different" and any("flexible bonds vary" in x for x in plain.findings)
    comparison = _compared(widened, [BONDS, ANGLES])
    marked = comparison.judgements[0]
    rows = {row.key: row for row in marked.rows}
    named = {key for key, row in rows.items() if row.verdict == "imposed"}
    assert named == _IMPOSED
    assert not any("bond" in x for x in marked.findings) and set(marked.findings) <= set(plain.findings)
    assert f"{len(named)} more are imposed" in marked.verdict
    assert any("come from the training reference" in note for note in marked.notes)
    # The numbers themselves stay.
    assert rows["bond_jsd"].candidate == plain.row("bond_jsd").candidate
    assert render(comparison, command="surromd compare").count("= imposed") == len(named)


def test_a_term_excuses_its_own_rows_alone(widened: tuple[Ensemble, Ensemble, Ensemble], plain: Judgement) -> None:
    """Only bonds that the reference constrains, of which there are none: the candidate is as wrong as before."""
    judged = _compared(widened, [RIGID_BONDS, "torsions"]).judgements[0]
    assert judged.findings == plain.findings and judged.verdict == plain.verdict
    assert not [row.key for row in judged.rows if row.verdict == "imposed"]


def test_files_name_them_and_replicas_add_up(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    frames = np.repeat(alanine_dipeptide.positions_nm[None], 5, axis=0)
    paths = []
    for k, terms in enumerate(([RIGID_BONDS, BONDS], [ANGLES], None)):
        paths.append(tmp_path / f"r{k}.h5")
        record = {"temperature_k": 300.0} | ({} if terms is None else {KEY: terms})
        with open_writer(paths[-1], alanine_dipeptide, record) as writer:
            writer.append(frames, np.arange(5) + 1.0)
    assert imposed_terms(load_ensemble(paths).record) == (RIGID_BONDS, BONDS, ANGLES)
    assert imposed_terms(load_ensemble(paths[2:]).record) == ()
