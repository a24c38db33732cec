"""Charts along time, ends of chains, the equivalent MD time's units."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from surrogate.comparison.comparison import Evaluation, compare
from surrogate.comparison.equivalent_time import EquivalentTime, equivalent_time_charts
from surrogate.comparison.measure.structure import _ends
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.charts import LineChart
from surrogate.comparison.rows.rows import Options


@pytest.fixture(scope="module")
def evaluated(simulate: Callable[..., Ensemble]) -> Evaluation:
    three = [simulate(k, 900) for k in (81, 82, 83)]
    return compare(three[0], [three[1]], three[2], options=Options(peptide_recipe=False)).evaluations[0]


def test_torsions_and_rmsd_are_drawn_along_time(evaluated: Evaluation) -> None:
    charts = {c.title: c for c in evaluated.charts if isinstance(c, LineChart)}
    for title in ("RMSD along time", "φ of ALA 2 along time", "ψ of ALA 2 along time"):
        lines = charts[title].lines
        assert [line.name for line in lines] == ["reference", "candidate", "replicate"]
        assert all(len(line.x) == len(line.y) == 300 for line in lines), "900 frames, every third"
        assert charts[title].dots, "no stroke across the picture where an angle runs over the end of its range"
    assert "fewer than 5 residues" in dict(evaluated.skipped)["Secondary structure"]


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
    equivalent_time = EquivalentTime(
        "x", "distribution", "x", 3400.0, 380.0, None, "", 0.1, (80.0, 1e4), errors, errors, errors
    )
    assert equivalent_time.in_words() == "3.4 ns [0.38 ns, > 10 ns]"
    assert replace(equivalent_time, high_ps=23_997.0).in_words() == "3.4 ns [0.38 ns, 24 ns]"
    assert (
        replace(equivalent_time, equivalent_ps=690.0, low_ps=41.0, high_ps=820.0).in_words() == "690 ps [41 ps, 820 ps]"
    )
    assert equivalent_time_charts([equivalent_time])[0].x_label == "length of MD / ns"
    short = replace(equivalent_time, lengths_ps=(0.04, 5.0))
    assert equivalent_time_charts([short])[0].x_label == "length of MD / ps", "no row of noughts below the axis"
