"""Headline numbers of one candidate, and the table that lays several candidates side by side."""

from __future__ import annotations

from typing import NamedTuple

from surrogate.judge.comparison import Comparison, Judgement
from surrogate.judge.report.wording import number, per_day, plain, worst
from surrogate.judge.rows.rows import GROUPS, Row


class Card(NamedTuple):
    """One headline number; `verdict` is the word of the row behind it, or empty."""

    title: str
    value: str
    note: str
    verdict: str


class Line(NamedTuple):
    """One metric over all candidates: the first reference's row, and each candidate's own (None where it has none)."""

    group: str
    metric: str
    unit: str
    first: Row
    rows: tuple[Row | None, ...]

    @property
    def all_agree(self) -> bool:
        """Whether no candidate is off in this metric."""
        return all(row is None or row.verdict == "agrees" for row in self.rows)


def cards(judgement: Judgement) -> list[Card]:
    """Return the headline numbers: what it is worth, validity, the worst joint map and relaxation time, speed."""
    valid = judgement.row("valid:all")
    others = "" if valid.reference is None else f"reference {number(valid.reference)} %"
    out = []
    if judgement.worth_words and judgement.worth:
        best = judgement.worth[0]
        out.append(
            Card(f"Worth, by its {best.measure}", f"{best.in_words().split(' [')[0]} of MD", best.in_words(), "")
        )
    out.append(Card("Valid frames", f"{number(valid.candidate)} %", others, valid.verdict))
    joint = worst([r for r in judgement.rows if r.key.startswith("joint_jsd")])
    if joint is not None:
        note = f"{plain(joint.ratio)} × a replicate's ({number(joint.replicate)})" if joint.ratio else ""
        out.append(Card(joint.metric, number(joint.candidate), note, joint.verdict))
    slow = worst([r for r in judgement.rows if r.key.startswith("correlation_time")])
    if slow is not None and slow.reference is not None:
        note = f"reference {number(slow.reference)} ps, ratio {plain(slow.ratio)}"
        out.append(Card(slow.metric, f"{number(slow.candidate)} ps", note, slow.verdict))
    ratio = judgement.speed_ratio
    if judgement.account.ns_per_day is None:
        note = "the file's record holds no cost"
    else:
        note = f"{ratio:.3g} × the reference's" if ratio is not None else "the reference's cost is not recorded"
    return [*out, Card("Speed", per_day(judgement.account.ns_per_day), note, "")]


def side_by_side(comparison: Comparison) -> list[Line]:
    """Return every metric that any candidate has, in the table's order, with the row of each candidate.

    Rows are matched by key, so that a metric whose name carries its finding (which bond is farthest off) is one line.
    """
    by_key: dict[str, list[Row | None]] = {}
    n = len(comparison.judgements)
    for k, judgement in enumerate(comparison.judgements):
        for row in judgement.rows:
            by_key.setdefault(row.key, [None] * n)[k] = row
    lines = []
    for found in by_key.values():
        first = next(row for row in found if row is not None)
        names = {row.metric for row in found if row is not None}
        metric = first.metric if len(names) == 1 else first.metric.split(":")[0]
        lines.append(Line(first.group, metric, first.unit, first, tuple(found)))
    return sorted(lines, key=lambda line: GROUPS.index(line.first.group))
