"""Charts along time, ends of chains, the worth's units."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from surrogate.judge.comparison import Judgement, compare
from surrogate.judge.measure.probes import _ends
from surrogate.judge.read.ensemble import Ensemble
from surrogate.judge.rows.charts import LineChart
from surrogate.judge.rows.rows import Options
from surrogate.judge.worth import Worth, worth_charts


@pytest.fixture(scope="module")
def judged(simulate: Callable[..., Ensemble]) -> Judgement:
    three = [simulate(k, 900) for k in (81, 82, 83)]
    return compare(three[0], [three[1]], three[2], options=Options(peptide_recipe=False)).judgements[0]


def test_torsions_and_rmsd_are_drawn_along_time(judged: Judgement) -> None:
    charts = {c.title: c for c in judged.charts if isinstance(c, LineChart)}
    for title in ("RMSD along time", "φ of ALA 2 along time", "ψ of ALA 2 along time"):
        lines = charts[title].lines
        assert [line.name for line in lines] == ["reference", "candidate", "replicate"]
        assert all(len(line.x) == len(line.y) == 300 for line in lines), "900 frames, every third"
        assert charts[title].dots, "no stroke across the picture where an angle runs over the end of its range"
    assert "fewer than 5 residues" in dict(judged.skipped)["Secondary structure"]


def test_ends_are_those_of_the_chain() -> None:
    from systems.library.named_scenes import prepare

    scene = prepare("sequence:ACE-LYS-ALA-ARG-NME")
    ends = _ends(scene)
    assert ends is not None and [scene.atom_names[i] for i in ends] == ["CA", "CA"]


def test_a_long_side_chain_is_no_end_of_a_short_chain() -> None:
    """Lysine between caps: longest along its side chain; its ends are the caps'. A drug has no side chains."""
    from systems.library.named_scenes import prepare
    from systems.prepare.peptide import build_peptide

    scene = build_peptide("ACE-LYS-NME")
    ends = _ends(scene)
    assert ends is not None
    assert {scene.residue_names[scene.residue_of_atom[i]] for i in ends} == {"ACE", "NME"}
    assert _ends(prepare("smiles:CCCCCC")) is not None


def test_both_ends_of_an_interval_share_a_unit() -> None:
    errors = (1.0, 0.1)
    worth = Worth("x", "distribution", "x", 3400.0, 380.0, None, "", 0.1, (80.0, 1e4), errors, errors, errors)
    assert worth.in_words() == "3.4 ns [0.38 ns, > 10 ns]"
    assert replace(worth, high_ps=23_997.0).in_words() == "3.4 ns [0.38 ns, 24 ns]"
    assert replace(worth, worth_ps=690.0, low_ps=41.0, high_ps=820.0).in_words() == "690 ps [41 ps, 820 ps]"
    assert worth_charts([worth])[0].x_label == "length of MD / ns"
    short = replace(worth, lengths_ps=(0.04, 5.0))
    assert worth_charts([short])[0].x_label == "length of MD / ps", "no row of noughts below the axis"
