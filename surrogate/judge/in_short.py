"""The three lines on top of a report: use it or not, for what, why."""

from __future__ import annotations

from collections.abc import Sequence

from surrogate.judge.rows.rows import Group, Row
from surrogate.judge.verdict import ALL_KEY, SURE, Doubts, Status

_WHAT: dict[Group, str] = {
    "validity": "single structures",
    "structure": "bonds, angles, shape and contacts",
    "populations": "populations of states",
    "distributions": "distributions and free energies of torsions",
    "kinetics": "relaxation times and rates",
}
_MENTIONED = 2
_GOOD, _BAD = ("agrees", "close"), ("differs", "fails")


def in_short(
    rows: Sequence[Row], status: Status, findings: Sequence[str], doubts: Doubts = SURE, worth: str = ""
) -> tuple[str, str, str]:
    """Return the three lines: whether to use the trajectory in place of reference MD, for what, and why."""
    good, bad, unknown = _sorted(rows)
    why = "; ".join(findings[:_MENTIONED])
    for_what = f"Right: {_listed(good) or 'nothing that could be tested'}."
    for_what += f" Wrong: {_listed(bad)}." if bad else ""
    for_what += f" Not known: {_listed(unknown)}." if unknown else ""
    ends = f" {worth}" if worth else ""
    if status == "broken":
        return "Do not use it.", "For nothing: frames are no molecules, or do not move as one.", f"Why: {why}."
    if status == "undecided":
        reason = next(filter(None, reversed(doubts)), "the error bars are wider than what would matter")
        return "Not known yet whether it can be used.", for_what, f"Why: {reason}.{ends}"
    if status == "different":
        waits = f" What is not known waits: {doubts.start}." if doubts.start else ""
        return "Do not use it for what is wrong in it.", for_what, f"Why: {why}.{waits}{ends}"
    if status == "close":
        return "Use it within its tolerances.", for_what, f"Why: {why}, each within its tolerance.{ends}"
    return "Use it.", for_what, f"Why: nothing measured differs from reference MD by more than chance.{ends}"


def _sorted(rows: Sequence[Row]) -> tuple[list[str], list[str], list[str]]:
    """Return what is right, what is wrong and what is not known, by the words of each group's rows."""
    good, bad, unknown = [], [], []
    for group, name in _WHAT.items():
        words = [r.verdict for r in rows if r.group == group and r.key != ALL_KEY]
        if not words:
            continue
        if any(w in _BAD for w in words):
            bad.append(name)
        elif 2 * sum(w in _GOOD for w in words) >= len(words):
            good.append(name)
        else:
            unknown.append(name)
    return good, bad, unknown


def _listed(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
