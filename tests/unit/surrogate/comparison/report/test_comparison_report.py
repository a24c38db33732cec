"""The report: offline, whole or absent, strict JSON, the verdict first; and the figures for notebooks."""

from __future__ import annotations

import errno
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surrogate.comparison.comparison import Comparison, compare
from surrogate.comparison.measure.statistics import Estimate
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.report import report
from surrogate.comparison.report.figures import Album, Figure, albums, answer_overview, weighted_maps
from surrogate.comparison.report.report import PROSE, Foreword, render, side_by_side, write_report
from surrogate.comparison.rows.charts import BarChart, Landscape, Line, LineChart, bar_chart
from surrogate.comparison.rows.rows import Options
from systems.errors import InputError, StorageError

VOID = {"meta", "link", "br", "img", "hr", "input"}


class Page(HTMLParser):
    """Collects tags and checks that every element is closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href", "srcset", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes <{self.open[-1:]}>"
        self.open.pop()


@pytest.fixture(scope="module")
def comparison(simulate: Callable[..., Ensemble]) -> Comparison:
    """One sound candidate, and one with every kind of trouble the page has to show."""
    reference, good, replicate = (simulate(seed, 3_000) for seed in (31, 32, 33))
    record = {"model": "lam-slide", "temperature_k": 300.0, "cost": {"wall_s": 10.0, "network_evaluations": 100}}
    frames = good.segments[0].copy()
    frames[::50] = np.nan
    frames[7] *= 1.5
    chunks = [np.repeat(np.arange(100, dtype=np.int32), 30)]
    bad = replace(good, label="<script>alert(1)</script>", segments=[frames], chunk_idx=chunks, record=record)
    reference = replace(reference, record={"temperature_k": 300.0, "cost": {"wall_s": 200.0}},
                        sources=("r0.h5", "r1.h5"), top="ala2.pdb", stated_lag_ps=1.0)  # fmt: skip
    return compare(reference, [replace(good, sources=("a b.h5",)), bad], replicate)


@pytest.fixture(scope="module")
def folder(comparison: Comparison, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the report lies, and nothing else."""
    made = tmp_path_factory.mktemp("report")
    write_report(comparison, made / "report.html")
    return made


@pytest.fixture(scope="module")
def written(folder: Path) -> tuple[str, dict[str, object]]:
    return (folder / "report.html").read_text("utf-8"), json.loads((folder / "report.json").read_text("utf-8"))


def one_of_each_type() -> tuple[LineChart, Landscape, BarChart]:
    x = np.linspace(1.0, 10.0, 5)
    counts = np.random.default_rng(0).poisson(20.0, (8, 6)).astype(float)
    return (
        LineChart("equivalent_time", "Forecast <error>", "against time", "time / ps", "ADE / nm",
                  (Line("reference", "reference", x, x**2, x**2 - 1, x**2 + 1), Line("frozen", "other", x, 0 * x + 3)),
                  log_y=True),
        Landscape("kinetics", "TIC 0 and 1", "TIC 0", "TIC 1", np.linspace(-2, 2, 9), np.linspace(-1, 1, 7),
                  counts, counts.T.reshape(8, 6), counts),
        bar_chart("structure", "Hydrogen bonds", "in brackets", "frames / %", ("A", "B"),
                  [[Estimate(x, x - 0.1, x + 0.1) for x in (1.0, 2.0)]] * 3),
    )  # fmt: skip


@pytest.fixture(scope="module")
def few_pictures(comparison: Comparison) -> Comparison:
    """The candidate with troubles, with one chart of each type: drawing all takes seconds."""
    bad = comparison.evaluations[1]
    shorter = replace(bad, charts=one_of_each_type())
    return replace(comparison, evaluations=(shorter,), movies=comparison.movies[1:2])


def test_page_is_well_formed_and_asks_for_nothing(written: tuple[str, dict[str, object]]) -> None:
    page = Page(written[0])
    assert not page.open
    assert all(a.startswith(("#", "data:")) for a in page.addresses), page.addresses
    assert "default-src 'none'" in written[0]
    without_namespaces = re.sub(r'xmlns(:\w+)?="[^"]*"', "", written[0])
    assert not re.search(r"https?://|@import|url\((?!#)", without_namespaces)


def test_verdict_stands_before_everything_else(written: tuple[str, dict[str, object]], comparison: Comparison) -> None:
    html = written[0]
    first = html.index('class="verdict')
    assert first < html.index("<svg") and first < html.index("<table")
    assert comparison.evaluations[1].status == "broken"
    assert "Broken: 2 % of frames have coordinates that are not finite" in html


def test_a_foreword_stands_before_the_verdict(
    few_pictures: Comparison, written: tuple[str, dict[str, object]], tmp_path: Path
) -> None:
    said = Foreword("worth <b>much</b>", "How", [("way", "MD & more")], [Figure("<svg></svg>", "By MD's <weights>")])
    files = write_report(few_pictures, tmp_path / "r.html", foreword=said)
    page = files.read_text("utf-8")
    assert page.index("worth &lt;b&gt;much&lt;/b&gt;") < page.index("MD &amp; more") < page.index('class="verdict')
    assert page.index("By MD&#39;s &lt;weights&gt;") < page.index('class="verdict')
    assert "worth &lt;b>much" in files.with_suffix(".md").read_text("utf-8")
    assert '<p class="foreword">' in page and '<p class="foreword">' not in written[0]


def test_names_from_outside_are_escaped(written: tuple[str, dict[str, object]]) -> None:
    assert "<script>alert" not in written[0]
    assert "&lt;script&gt;alert(1)" in written[0]


def test_costs_skips_definitions_and_command_are_there(written: tuple[str, dict[str, object]]) -> None:
    html = written[0]
    for text in ("25.9 µs/day", "20 × the reference", "Left out, and why",
                 "Planar rings: none among the atoms compared",
                 "Jensen-Shannon distance", "How to make this report again",
                 "surromd compare r0.h5,r1.h5 &#39;a b.h5&#39;",
                 "--top ala2.pdb --top - --top - --top - --dt 1ps --dt - --dt - --dt - -o report.html",
                 "prefers-color-scheme: dark", "max-width: 44rem"):  # fmt: skip
        assert text in html, text


def test_json_is_strict_and_holds_every_row_and_curve(
    written: tuple[str, dict[str, object]], comparison: Comparison
) -> None:
    data = written[1]
    evaluated = data["evaluations"]
    assert isinstance(evaluated, list)
    for out, evaluation in zip(evaluated, comparison.evaluations, strict=True):
        assert [r["key"] for r in out["rows"]] == [r.key for r in evaluation.rows]
        assert out["verdict"] == evaluation.verdict
        charts = {c.get("title") or c["label"]: c for c in out["charts"]}
        assert np.array(charts["φ and ψ of ALA 2"]["reference"]).shape == (50, 50)
        assert {"φ ALA 2", "TIC 0", "Autocorrelation of cos ψ ALA 2"} <= set(charts)
    assert evaluated[1]["speed_ratio"] == pytest.approx(20.0)
    assert data["replicate"] is not None


def test_candidates_stand_side_by_side(written: tuple[str, dict[str, object]], comparison: Comparison) -> None:
    lines = side_by_side(comparison)
    keys = {row.key for evaluation in comparison.evaluations for row in evaluation.rows}
    assert {line.first.key for line in lines} == keys and len(lines) == len(keys)
    for line in lines:
        for evaluation, row in zip(comparison.evaluations, line.rows, strict=True):
            assert row in (*evaluation.rows, None)
    distance = next(line for line in lines if line.first.key.startswith("psi_jsd"))
    for row in distance.rows:
        assert row is not None and f"{report.number(row.candidate)} ({report.number(row.replicate)})" in written[0]
    seams = next(line for line in lines if line.first.key == "chunk_step")
    assert seams.rows[0] is None and seams.rows[1] is not None
    html = written[0]
    assert html.index('id="side-by-side"') < html.index('id="candidate-1"') < html.index('id="candidate-2"')


def test_markdown_has_the_verdicts_every_row_and_no_markup_from_outside(comparison: Comparison) -> None:
    text = render(comparison, PROSE, command="surromd compare a_b c")
    assert "<script>" not in text and "&lt;script>alert(1)&lt;/script>" in text
    assert text.index("Broken: 2 % of frames") < text.index("## Side by side") < text.index("| Metric |")
    cells = [[c.strip() for c in line.split(" | ")] for line in text.splitlines() if line.startswith("| ")]
    for evaluation in comparison.evaluations:
        for row in evaluation.rows:
            shown = f"{report.number(row.candidate)} {report.interval(row.candidate)}".strip()
            assert any(shown in line and any(f"{report.MARKS[row.verdict]} {row.verdict}" in c for c in line)
                       for line in cells), row.key  # fmt: skip
    assert all(len(line) == len(cells[k - 1]) or cells[k - 1][0] != line[0] for k, line in enumerate(cells) if k > 1)
    assert "\nsurromd compare a_b c\n" in text


def test_markdown_goes_beside_the_page(folder: Path) -> None:
    assert sorted(p.name for p in folder.iterdir()) == ["report.html", "report.json", "report.md"]
    assert (folder / "report.md").read_text("utf-8").startswith("# alanine-dipeptide (C6H12N2O2, 22 atoms) against")


def test_every_type_of_chart_is_drawn_and_written(comparison: Comparison) -> None:
    charts = one_of_each_type()
    first = comparison.evaluations[0]
    # The comparison's charts in the same sections alone: drawing all takes seconds.
    beside = [c for c in first.charts if c.section in {c.section for c in charts}]
    plain = {a.title: a for a in albums(beside, 300.0)}
    drawn = {a.title: a for a in albums((*charts, *beside), 300.0)}
    section = "Equivalent MD time"
    assert len(drawn[section].figures) == len(plain.get(section, Album("", [], "")).figures) + 1
    assert len(drawn["Kinetics"].figures) == len(plain["Kinetics"].figures)
    assert [f.caption.split()[0] for f in drawn["TIC 0 and 1"].figures] == ["Reference", "Candidate", "Replicate",
                                                                            "Candidate"]  # fmt: skip
    figure = drawn[section].figures[0]
    assert figure.caption == "Forecast <error>: against time" and 'aria-label="Forecast &lt;error&gt;"' in figure.svg
    assert "#0101" not in figure.svg
    records = [c.to_dict() for c in charts]
    assert [r["type"] for r in records] == ["LineChart", "Landscape", "BarChart"]
    assert records[0]["lines"][0]["y"] == pytest.approx((charts[0].lines[0].x ** 2).tolist(), rel=1e-5)


def test_same_input_same_page(few_pictures: Comparison) -> None:
    assert report.render(few_pictures, command="x") == report.render(few_pictures, command="x")


def test_only_html_is_written(comparison: Comparison, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"written as \.html"):
        write_report(comparison, tmp_path / "report.json")
    assert not list(tmp_path.iterdir())


def test_nothing_is_left_where_it_cannot_be_written(
    comparison: Comparison, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report, "render", lambda *_, **__: "new")  # of other tests; drawing takes seconds
    with pytest.raises(StorageError, match=r"absent|taken"):
        write_report(comparison, tmp_path / "absent" / "report.html")
    (tmp_path / "taken.html").mkdir()
    with pytest.raises(StorageError, match=r"absent|taken"):
        write_report(comparison, tmp_path / "taken.html")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["taken.html"]


def test_a_full_disk_leaves_the_old_report_alone(
    comparison: Comparison, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "report.html").write_text("old")
    monkeypatch.setattr("systems.files.whole_file.write_whole", full)
    monkeypatch.setattr(report, "render", lambda *_, **__: "new")
    with pytest.raises(StorageError):
        write_report(comparison, tmp_path / "report.html")
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("report.html", "old")]


def test_numbers_show_as_many_digits_as_they_have() -> None:
    assert report.number(Estimate(0.12345, error=0.02)) == "0.123"
    assert report.number(Estimate(123.456, error=20.0)) == "123"
    assert report.number(Estimate(99.9871, error=0.002)) == "99.987"
    assert report.number(Estimate(float("nan"))) == "not defined"
    assert report.number(None) == "–"
    assert report.interval(Estimate(1.0, 0.9, 1.1, 0.05)) == "[0.900, 1.100]"
    assert report.interval(Estimate(1.0, 1.0, 1.0, 0.0)) == ""
    assert report.setting("temperature_k", 300.0) == "temperature 300 K"
    assert report.setting("friction_per_ps", 1.0) == "friction 1 /ps"
    assert report.setting("force_field", "ff14SB") == "force field ff14SB"


def test_a_scene_without_torsions_still_has_a_page(tmp_path: Path) -> None:
    from systems.scene import Scene

    positions = np.array([[0.0, 0.0, 0.0], [0.096, 0.0, 0.0], [-0.024, 0.093, 0.0]])
    water = Scene("water", ("O", "H1", "H2"), ("O", "H", "H"), np.zeros(3, dtype=np.int64), ("HOH",), ("1",), ("A",),
                  np.array([[0, 1], [0, 2]]), np.ones(2), np.zeros(3, dtype=np.int64), np.array([16.0, 1, 1]),
                  positions)  # fmt: skip
    rng = np.random.default_rng(0)
    made = [Ensemble(f"w{k}", [(positions + rng.normal(0, 0.002, (500, 3, 3))).astype(np.float32)], 0.5, water)
            for k in range(2)]  # fmt: skip
    written = write_report(compare(made[0], [made[1]]), tmp_path / "water.html")
    text = written.read_text("utf-8")
    assert "the scene has no φ or ψ torsion" in text and not Page(text).open


def test_long_names_beside_bars_leave_room_for_the_bars() -> None:
    """Names of hydrogen bonds once took the whole width: axes without room, names cut off at the left."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    from surrogate.comparison.report import figures
    from surrogate.comparison.report.figures import short_name

    name = "NZ-HZ1 (LYS 19) ... OE1 (GLU 17) and 5 equal"
    assert short_name("CA (LYS 10)") == "CA (LYS 10)"
    assert all(len(line) <= 22 for line in short_name(name).splitlines()) and len(short_name(name).splitlines()) == 2
    seen: list[float] = []

    def draw(title: str, size: tuple[float, float], paint: Callable[[Any, Any], None]) -> str:
        from matplotlib.figure import Figure

        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.add_subplot()
        paint(figure, axes)
        figure.draw_without_rendering()
        seen.append(min(t.get_window_extent().x0 for t in axes.get_yticklabels()))
        seen.append(axes.get_position().width)
        return ""

    chart = bar_chart("structure", "x", "", "frames / %", (name, name), [[Estimate(1.0), Estimate(2.0)]] * 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "draw", draw)
        figures.draw_chart(chart, 300.0)
        patch.setattr(figures, "short_name", lambda name: name)
        figures.draw_chart(chart, 300.0)
    assert seen[0] >= 0 and seen[1] > 0.4
    assert seen[2] < 0 or seen[3] < 0.4, "negative control: whole names do not fit"


def test_a_comparison_draws_reference_replicate_and_candidates(simulate: Callable[..., Ensemble]) -> None:
    reference, other, rolled = (simulate(seed, 3_000) for seed in (1, 2, 3))
    found = compare(reference, [rolled, other], other, options=Options(peptide_recipe=False))
    axes = found.plot().axes
    titles = [a.get_title() for a in axes if a.get_title()]
    label = titles[0].partition(", ")[2]
    assert titles == [f"{name}, {label}" for name in ("reference", "replicate", rolled.label, other.label)]
    images = [np.ma.filled(np.ma.asarray(a.images[0].get_array()), -1.0) for a in axes if a.get_title()]
    assert not np.array_equal(images[0], images[2]) and np.array_equal(images[1], images[3]), (
        "the replicate is evaluated too"
    )


def test_weights_shape_the_maps_of_the_answer() -> None:
    deep, flat = np.full((36, 36), 30.0), np.zeros((36, 36))
    deep[5, 7] = 0.0
    one, other = weighted_maps({"ALA 2": deep, "GLY 3": flat})
    assert "ALA 2" in one.caption and one.svg.startswith("<svg") and one.svg != other.svg


def test_an_answer_without_states_is_an_empty_figure(simulate: Callable[..., Ensemble]) -> None:
    assert len(answer_overview("methane", {}).axes) == 1
