"""The report: one self-contained HTML file that opens offline, and the same numbers as JSON beside it."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from surrogate.judge import figures
from surrogate.judge.account import Account
from surrogate.judge.comparison import Comparison, Judgement
from surrogate.judge.definitions import DEFINITIONS
from surrogate.judge.rows import GROUPS, Row
from surrogate.judge.statistics import Estimate
from systems.errors import InputError, StorageError
from systems.units import format_time_ps

MARKS = {"agrees": "✓", "close": "≈", "differs": "✗", "fails": "‼", "undecided": "?"}
STATUS_MARKS = {"indistinguishable": "✓", "close": "≈", "different": "✗", "broken": "‼", "undecided": "?"}
GROUP_TITLES = {
    "validity": "Validity of frames",
    "structure": "Bond lengths",
    "populations": "Populations",
    "distributions": "Distributions",
    "kinetics": "Kinetics",
}
MAX_DRAWN = 6
_UNITS = {"_per_ps": "/ps", "_k": "K", "_ps": "ps", "_da": "Da", "_nm": "nm", "_s": "s"}


class Card(NamedTuple):
    """One headline number."""

    title: str
    value: str
    note: str
    verdict: str


class Figure(NamedTuple):
    """One SVG with its caption."""

    svg: str
    caption: str


def write_report(comparison: Comparison, path: str | Path, *, command: str | None = None) -> tuple[Path, Path]:
    """Write `path` (HTML) and the JSON beside it; return both paths.

    `command` is printed as the way to reproduce the report (by default one is put together from the file names).
    Both files appear whole or not at all. Raises InputError for a name that does not end in .html, StorageError when
    they cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{target}: a report is written as .html (its JSON goes beside it).")
    beside = target.with_suffix(".json")
    _check_place(target, beside)
    text = json.dumps(comparison.to_dict(), indent=1, allow_nan=False, ensure_ascii=False)
    page = render(comparison, command=command or _command(comparison, target))
    _write_together({beside: text + "\n", target: page})
    return target, beside


def render(comparison: Comparison, *, command: str) -> str:
    """Return the report as HTML text."""
    from jinja2 import DictLoader, Environment, StrictUndefined

    package = files("surrogate.judge")
    sources = {name: package.joinpath(name).read_text("utf-8") for name in ("report.html.j2", "report.css")}
    environment = Environment(
        loader=DictLoader(sources), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(number=number, interval=interval, time=format_time_ps, plain=plain, setting=setting)
    candidates = [
        {
            "judgement": j,
            "anchor": f"candidate-{i + 1}",
            "cards": cards(j),
            "groups": [(GROUP_TITLES[g], [r for r in j.rows if r.group == g]) for g in GROUPS],
            "maps": _maps(j, comparison.temperature_k),
            "curves": _curves(j),
            "timelines": _timelines(j),
            "bonds": sorted(j.curves.bonds, key=lambda b: -abs(b.candidate_mean - b.reference_mean)),
        }
        for i, j in enumerate(comparison.judgements)
    ]
    return environment.get_template("report.html.j2").render(
        comparison=comparison,
        candidates=candidates,
        accounts=_accounts(comparison),
        definitions=DEFINITIONS,
        marks=MARKS,
        status_marks=STATUS_MARKS,
        command=command,
        map_max=figures.MAP_MAX_KJ,
    )


def cards(judgement: Judgement) -> list[Card]:
    """Return the headline numbers: validity, the worst joint map, the worst relaxation time, speed."""
    out = [_share_card(judgement.row("valid:all"))]
    joint = _worst([r for r in judgement.rows if r.key.startswith("joint_jsd")])
    if joint is not None:
        note = f"{plain(joint.ratio)} × a replicate's ({number(joint.replicate)})" if joint.ratio else ""
        out.append(Card(joint.metric, number(joint.candidate), note, joint.verdict))
    slow = _worst([r for r in judgement.rows if r.key.startswith("correlation_time")])
    if slow is not None and slow.reference is not None:
        note = f"reference {number(slow.reference)} ps, ratio {plain(slow.ratio)}"
        out.append(Card(slow.metric, f"{number(slow.candidate)} ps", note, slow.verdict))
    account = judgement.account
    if account.ns_per_day is None:
        out.append(Card("Speed", "not recorded", "the file's record holds no cost", ""))
    else:
        ratio = judgement.speed_ratio
        note = f"{ratio:.3g} × the reference's" if ratio is not None else "the reference's cost is not recorded"
        out.append(Card("Speed", _per_day(account.ns_per_day), note, ""))
    return out


def _share_card(row: Row) -> Card:
    others = "" if row.reference is None else f"reference {number(row.reference)} %"
    return Card("Valid frames", f"{number(row.candidate)} %", others, row.verdict)


def _worst(rows: Sequence[Row]) -> Row | None:
    order = ("agrees", "undecided", "close", "differs", "fails")
    return max(rows, key=lambda r: (order.index(r.verdict), r.candidate.value), default=None)


def number(estimate: Estimate | None) -> str:
    """Return the value, with as many digits as its error leaves meaningful (one more than the first uncertain one)."""
    if estimate is None:
        return "–"
    value, error = estimate.value, estimate.error
    if not math.isfinite(value):
        return "not defined"
    if math.isfinite(error) and error > 0:
        decimals = min(max(1 - math.floor(math.log10(error)), 0), 4 if abs(value) < 10 else 3)
        return f"{value:.{decimals}f}"
    return f"{value:.4g}"


def interval(estimate: Estimate | None) -> str:
    """Return the 95 % interval in brackets, or an empty string."""
    if estimate is None or not (math.isfinite(estimate.low) and math.isfinite(estimate.high)):
        return ""
    if estimate.low == estimate.high:
        return ""
    low = number(Estimate(estimate.low, error=estimate.error))
    high = number(Estimate(estimate.high, error=estimate.error))
    return f"[{low}, {high}]"


def plain(estimate: Estimate | None) -> str:
    """Return a ratio with two or three digits."""
    if estimate is None or not math.isfinite(estimate.value):
        return "–"
    return f"{estimate.value:.2f}" if estimate.value < 10 else f"{estimate.value:.3g}"


def setting(key: str, value: object) -> str:
    """Return an entry of a record for people: ('temperature_k', 300.0) -> 'temperature 300 K'."""
    shown = f"{value:g}" if isinstance(value, float) else str(value)
    for ending, unit in _UNITS.items():
        if key.endswith(ending):
            return f"{key.removesuffix(ending).replace('_', ' ')} {shown} {unit}"
    return f"{key.replace('_', ' ')} {shown}"


def _per_day(ns_per_day: float) -> str:
    return f"{ns_per_day / 1000:.3g} µs/day" if ns_per_day >= 1000 else f"{ns_per_day:.3g} ns/day"


def _maps(judgement: Judgement, temperature_k: float) -> list[tuple[str, list[Figure]]]:
    out = []
    for data in judgement.curves.ramachandran[:MAX_DRAWN]:
        row = judgement.row(f"joint_jsd:{data.label}")
        captions = (
            (data.reference, "Reference"),
            (data.candidate, f"Candidate: distance {number(row.candidate)} to the reference"),
            (data.replicate, f"Replicate: distance {number(row.replicate)}, the floor"),
        )
        shown = [Figure(figures.ramachandran(f"{c}, {data.label}", m, temperature_k), c) for m, c in captions]
        caption = "Candidate minus reference: {} where the candidate comes too rarely, {} where too often"
        change = figures.difference(f"Candidate minus reference, {data.label}", data, temperature_k)
        out.append((data.label, [*shown, Figure(change, caption.format(*figures.DIFFERENCE_COLOURS))]))
    return out


def _curves(judgement: Judgement) -> list[Figure]:
    out = [
        Figure(figures.correlation(c), f"Autocorrelation of {c.label}; bands are 95 % intervals")
        for c in judgement.curves.correlations[:MAX_DRAWN]
    ]
    for data in judgement.curves.histograms[: 3 * MAX_DRAWN]:
        outside = data.outside[1]
        beyond = f"; {100 * outside:.2g} % of the candidate's frames lie outside" if outside > 0 else ""
        out.append(Figure(figures.histogram(data), f"Distribution of {data.label}{beyond}"))
    return out


def _timelines(judgement: Judgement) -> tuple[list[Figure], list[str]]:
    """Pictures for trajectories that have a fault, a sentence for those that have none."""
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
        caption = f"{name}: share of faulty frames along time{chunks}"
        drawn.append(Figure(figures.timeline(data), caption))
        if len(data.by_position) > 1 and data.by_position.any():
            drawn.append(Figure(figures.by_position(data), f"{name}: invalid frames by their place in the chunk"))
    return drawn, said


def _accounts(comparison: Comparison) -> list[tuple[str, Account, str]]:
    """Every trajectory with its role and its speed in words."""
    listed = [("Reference", comparison.reference)]
    listed += [("Candidate", j.account) for j in comparison.judgements]
    if comparison.replicate is not None:
        listed.append(("Replicate", comparison.replicate))
    return [(role, a, "not recorded" if a.ns_per_day is None else _per_day(a.ns_per_day)) for role, a in listed]


def _command(comparison: Comparison, target: Path) -> str:
    """The command line that makes this report again, as far as the file names tell."""
    accounts = [comparison.reference, *(j.account for j in comparison.judgements)]
    words = ["surromd", "compare", *(",".join(a.sources) or a.label for a in accounts)]
    if comparison.replicate is not None:
        words += ["--replicate", ",".join(comparison.replicate.sources) or comparison.replicate.label]
    if comparison.reference.top is not None:
        words += ["--top", comparison.reference.top]
    if comparison.reference.stated_lag_ps is not None:
        words += ["--lag", format_time_ps(comparison.reference.stated_lag_ps).replace(" ", "")]
    return shlex.join([*words, "-o", target.name])


def _check_place(*paths: Path) -> None:
    """Fail before anything is drawn where it is plain that nothing can be written."""
    for path in paths:
        if not path.parent.is_dir():
            raise StorageError(f"Cannot write {path}: its folder does not exist; choose another place with -o.")
        if path.is_dir():
            raise StorageError(f"Cannot write {path}: it is a folder; choose another name with -o.")


def _write_together(texts: dict[Path, str]) -> None:
    """Write all files under other names first, so that a full disk leaves neither one nor half a file."""
    partial = {path: path.with_name(f".{path.name}.partial") for path in texts}
    try:
        for path, text in texts.items():
            partial[path].write_text(text, "utf-8")
        for path in texts:
            partial[path].replace(path)
    except OSError as error:
        raise StorageError(
            f"Cannot write {error.filename or 'the report'}: {error.strerror or error}; choose another place with -o."
        ) from error
    finally:
        for leftover in partial.values():
            leftover.unlink(missing_ok=True)
