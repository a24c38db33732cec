"""Which pictures a candidate gets, and in what order: maps, charts by section, validity along time."""

from __future__ import annotations

from typing import NamedTuple

from surrogate.judge.comparison import Judgement
from surrogate.judge.report import figures
from surrogate.judge.report.chart_figures import draw_chart
from surrogate.judge.report.figures import Figure
from surrogate.judge.report.wording import number
from surrogate.judge.rows.charts import Chart, Landscape, Section

MAX_DRAWN = 6
MAX_DRAWN_HISTOGRAMS = 12
_TITLES: dict[Section, str] = {
    "worth": "What it is worth",
    "distributions": "Distributions",
    "kinetics": "How fast things move",
    "structure": "Structure",
    "experiment": "To lay beside experiment",
    "forecast": "Forecast error",
    "validity": "Validity and energies",
}


class Album(NamedTuple):
    """Pictures under one heading; `left_out` says in words what is only in the JSON."""

    title: str
    figures: list[Figure]
    left_out: str


def maps(judgement: Judgement, temperature_k: float) -> list[Album]:
    """Return four maps for each of the first residues: reference, candidate, replicate, difference."""
    out = []
    for data in judgement.curves.ramachandran[:MAX_DRAWN]:
        row = next((r for r in judgement.rows if r.key == f"joint_jsd:{data.label}"), None)
        captions = [(data.reference, "Reference"), (data.candidate, "Candidate"), (data.replicate, "Replicate")]
        if row is not None:  # of many residues the mean has one
            captions[1] = (data.candidate, f"Candidate: distance {number(row.candidate)} to the reference")
            captions[2] = (data.replicate, f"Replicate: distance {number(row.replicate)}, the floor")
        shown = [Figure(figures.ramachandran(f"{c}, {data.label}", m, temperature_k), c) for m, c in captions]
        change = figures.difference(f"Candidate minus reference, {data.label}", data, temperature_k)
        title = f"φ and ψ of {data.label}"
        out.append(Album(title, [*shown, Figure(change, figures.map_caption())], ""))
    return out


def albums(judgement: Judgement, temperature_k: float) -> list[Album]:
    """Return all charts but the maps of φ and ψ, gathered by section; the rest of a long series is left out."""
    curves = judgement.curves
    charts: list[Chart] = [*curves.histograms, *curves.charts]
    out = []
    for section, title in _TITLES.items():
        everything = [c for c in charts if c.section == section]
        mine = [c for c in everything if not isinstance(c, Landscape)]
        most = MAX_DRAWN_HISTOGRAMS if section == "distributions" else 2 * MAX_DRAWN
        drawn = [figure for chart in mine[:most] for figure in draw_chart(chart, temperature_k)]
        n_left = max(len(mine) - most, 0)
        if section == "kinetics":
            shown = curves.correlations[:MAX_DRAWN]
            n_left += len(curves.correlations) - len(shown)
            caption = "Autocorrelation of {}; bands are 95 % intervals"
            drawn = [Figure(figures.correlation(c), caption.format(c.label)) for c in shown] + drawn
        if drawn:
            out.append(Album(title, drawn, f"{n_left} more stand in the JSON file." if n_left else ""))
        # A landscape is a row of maps: it stands by itself, like those of φ and ψ.
        landscapes = [c for c in everything if isinstance(c, Landscape)]
        out += [Album(c.title, draw_chart(c, temperature_k), "") for c in landscapes[:MAX_DRAWN]]
    return out


def timelines(judgement: Judgement) -> tuple[list[Figure], list[str]]:
    """Return pictures for trajectories that have a fault, and a sentence for each that has none."""
    drawn, said = [], []
    for data, name, faults in zip(
        judgement.curves.timelines, ("Reference", "Candidate", "Replicate"), judgement.faults, strict=True
    ):
        chunks = f"; {data.n_chunks} chunks" if data.n_chunks else ""
        if not data.invalid.any() and not data.strained.any():
            said.append(f"{name}: no fault in any of {faults.n_frames} frames{chunks}.")
            continue
        if data.n_chunks and not len(data.chunks_ps):
            chunks += ", too many to draw"
        drawn.append(Figure(figures.timeline(data), f"{name}: share of faulty frames along time{chunks}"))
        if len(data.by_position) > 1 and data.by_position.any():
            drawn.append(Figure(figures.by_position(data), f"{name}: invalid frames by their place in the chunk"))
    return drawn, said
