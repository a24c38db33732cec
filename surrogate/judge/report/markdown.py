"""The report as Markdown: the same words and tables, for a README, an issue or a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from surrogate.judge.comparison import Comparison, Judgement
from surrogate.judge.measure.statistics import Estimate
from surrogate.judge.report.definitions import DEFINITIONS
from surrogate.judge.report.wording import (
    GROUP_TITLES,
    MARKS,
    STATE_HEADS,
    STATUS_MARKS,
    cards,
    interval,
    number,
    per_day,
    plain,
    side_by_side,
    state_lines,
)
from surrogate.judge.rows.rows import GROUPS, Row
from systems.files.outside import printable
from systems.units import format_time_ps


def to_markdown(comparison: Comparison, *, command: str, headline: str = "") -> str:
    """Return the report as Markdown text: a headline, verdicts, one table per candidate, what was left out, costs."""
    title = f"{comparison.scene_name} ({comparison.formula}, {comparison.n_atoms} atoms)"
    parts = [f"# {_text(title)} against {_text(comparison.reference.label)}"]
    parts += [_text(headline)] if headline else []
    for judgement in comparison.judgements:
        mark = STATUS_MARKS[judgement.status]
        use, for_what, why = map(_text, judgement.in_short)
        parts.append(f"**{mark} {_text(judgement.account.label)}**: {use}\n- {for_what}\n- {why}")
        parts.append(_text(judgement.verdict))
    if comparison.convergence is not None:
        parts += [
            "## Has the reference forgotten its start?",
            _text(comparison.convergence.verdict),
            _drifts(comparison),
        ]
    if len(comparison.judgements) > 1:
        parts += ["## Side by side", _side_by_side(comparison)]
    for judgement in comparison.judgements:
        parts += _candidate(judgement)
    parts += ["## Trajectories and what they cost", _costs(comparison)]
    parts += _list("Notes", comparison.notes)
    parts.append("## What the numbers mean")
    parts += [f"**{d.term}**: {_text(d.meaning)} {_text(d.source)}".rstrip() for d in DEFINITIONS]
    parts += ["## How to make this report again", "```\n{}\n```".format(command.replace("`", "'"))]
    versions = ", ".join(f"{k} {v}" for k, v in comparison.versions.items())
    parts.append(f"Random draws: seed {comparison.options.seed}. {versions}.")
    return "\n\n".join(parts) + "\n"


def _candidate(judgement: Judgement) -> list[str]:
    headline = [
        f"- {card.title}: {_text(card.value)}" + (f" ({_text(card.note)})" if card.note else "")
        for card in cards(judgement)
    ]
    out = [f"## {_text(judgement.account.label)}", "\n".join(headline)]
    if judgement.findings:
        out.append("What is off, worst first:")
        out.append("\n".join(f"{k}. {_text(x)}" for k, x in enumerate(judgement.findings, 1)))
    rows = [_metric(row, title) for g in GROUPS for title, row in _of_group(judgement.rows, g)]
    out.append(_table(("", "Metric", "Reference", "Candidate", "Replicate", "Ratio", "Tolerance", "Verdict"), rows))
    out.append(
        f"Compared over {format_time_ps(judgement.compared_ps)} ({judgement.n_frames} frames) each; in brackets 95 % "
        f"intervals from {judgement.n_blocks} blocks of {format_time_ps(judgement.block_ps)}."
    )
    out += _list("Left out, and why", [f"{what}: {why}." for what, why in judgement.skipped])
    return out + _list("Equal terms", judgement.notes)


def _of_group(rows: Sequence[Row], group: str) -> list[tuple[str, Row]]:
    mine = [row for row in rows if row.group == group]
    return [(GROUP_TITLES.get(group, group.capitalize()) if k == 0 else "", row) for k, row in enumerate(mine)]


def _metric(row: Row, title: str) -> tuple[str, ...]:
    name = f"{row.metric} / {row.unit}" if row.unit else row.metric
    values = [f"{number(e)} {interval(e)}".rstrip() for e in (row.reference, row.candidate, row.replicate)]
    return (title, name, *values, plain(row.ratio), row.tolerance_text, f"{MARKS[row.verdict]} {row.verdict}")


def _side_by_side(comparison: Comparison) -> str:
    def cell(row: Row | None) -> str:
        return "–" if row is None else f"{MARKS[row.verdict]} {number(row.candidate)}"

    labels = [j.account.label for j in comparison.judgements]
    rows = []
    for line in side_by_side(comparison):
        name = f"{line.metric} / {line.unit}" if line.unit else line.metric
        truth: Estimate | None = line.first.reference or line.first.replicate
        rows.append((name, number(truth), *(cell(row) for row in line.rows)))
    return _table(("Metric", "Reference (of a distance: the replicate's)", *labels), rows)


def _costs(comparison: Comparison) -> str:
    listed = [("Reference", comparison.reference)]
    listed += [("Candidate", j.account) for j in comparison.judgements]
    if comparison.replicate is not None:
        listed.append(("Replicate", comparison.replicate))
    rows = [
        (
            f"{role}: {a.label}",
            a.length,
            f"{a.n_frames}, every {format_time_ps(a.lag_ps)}",
            "not recorded" if a.wall_s is None else f"{a.wall_s:.4g} s",
            per_day(a.ns_per_day),
        )
        for role, a in listed
    ]
    return _table(("Trajectory", "Length", "Frames", "Wall time", "Speed"), rows)


def _drifts(comparison: Comparison) -> str:
    return _table(STATE_HEADS, state_lines(comparison.convergence)) if comparison.convergence else ""


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(_text(cell) for cell in line) + " |" for line in lines)


def _list(title: str, entries: Sequence[str]) -> list[str]:
    return [f"### {title}", "\n".join(f"- {_text(x)}" for x in entries)] if entries else []


def _text(value: str) -> str:
    """What came from outside must not start a tag or a cell, nor end one."""
    escaped = printable(value).replace("\\", "\\\\").replace("<", "&lt;").replace("|", "\\|").replace("`", "\\`")
    return escaped.replace("*", "\\*").replace("_", "\\_").replace("\n", " ")
