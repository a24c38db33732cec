"""Known wrongs: what the comparison must say of trajectories that are wrong in a known way, and what it says:

    python docs/studies/comparison/compare_cases.py FOLDER [-o docs/compare_cases.md]

`--temperatures` reads instead the temperature of MD made here at 300 and at 350 K, against those runs and against our
own at 300 K.

FOLDER holds ala2.pdb and trajectory-1.dcd to trajectory-4.dcd, runs of 10 ns of alanine dipeptide at 1 ps. The first is
the reference, the third the replicate; every case is made of the second, but where it says otherwise. One is simulated
anew with OpenMM as those runs were, but too hot.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from surrogate.comparison.comparison import Comparison, Evaluation
    from surrogate.comparison.read.ensemble import Ensemble

Frames = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Case:
    """`make(reference, candidate, another)` are frames `(n, n_atoms, 3)` nm; due are one of `statuses` and `said`, a
    pattern in verdict, findings or notes (empty: nothing is found). `temperature_k`: at which MD is run for it."""

    name: str
    make: Callable[[Frames, Frames, Frames], Frames]
    statuses: tuple[str, ...]
    said: str = ""
    temperature_k: float | None = None


@dataclass(frozen=True)
class Outcome:
    """What was said of a case; `as_due`: whether that is what must be."""

    case: Case
    status: str
    words: str
    as_due: bool


def _noisy(x: Frames, sigma_nm: float) -> Frames:
    return (x + np.random.default_rng(2).normal(0, sigma_nm, x.shape)).astype(np.float32)


def _exploded(x: Frames) -> Frames:
    out = x.copy()
    out[5000] *= 1e6
    return out


_MIRROR = np.array([-1, 1, 1], dtype=np.float32)
FAIR = ("indistinguishable", "undecided")
WRONG = ("different", "broken")
CASES = (
    Case("another run of the same MD", lambda r, x, y: x, FAIR),
    Case("every 2nd frame, called 1 ps", lambda r, x, y: x[::2], ("different",), "step of all torsions"),
    Case("every 5th frame, called 1 ps", lambda r, x, y: x[::5], ("different",), "step of all torsions"),
    Case("every 5th frame dropped", lambda r, x, y: x[np.arange(len(x)) % 5 != 4], ("different",),
         "step of all torsions"),
    Case("every frame twice", lambda r, x, y: np.repeat(x, 2, axis=0)[: len(x)], ("different",), "copies of other"),
    Case("1 ns, ten times", lambda r, x, y: np.tile(x[:1000], (10, 1, 1)), ("different",), "90 % of frames are copies"),
    Case("one frame all along", lambda r, x, y: np.repeat(x[:1], len(x), axis=0), ("broken",), "does not move"),
    Case("frames in random order", lambda r, x, y: np.random.default_rng(0).permutation(x), ("different",),
         "relaxation time of cos ψ"),
    Case("the mirror image", lambda r, x, y: x * _MIRROR, ("broken",), "inverted stereocentre"),
    Case("3 % larger", lambda r, x, y: x * np.float32(1.03), WRONG, "shift of a mean bond length, .* Å instead of"),
    Case("noise of 3 pm on every atom", lambda r, x, y: _noisy(x, 0.003), WRONG, "temperature of vibrations"),
    Case("one exploded frame", lambda r, x, y: _exploded(x), ("broken",), "came apart"),
    Case("atoms in another order", lambda r, x, y: x[:, ::-1], ("broken",), "topology fit its coordinates"),
    Case("the reference itself", lambda r, x, y: r, ("undecided",), "100 % of its frames are frames of the reference"),
    Case("30 % of it from the reference",
         lambda r, x, y: np.concatenate([x[:7000], r[7000:]]), (*FAIR, "different"), "30 % of its frames"),
    Case("two runs joined in one file",
         lambda r, x, y: np.concatenate([x[:4000], y[4000:]]), (*FAIR, "different"), "jumps once .*first at 4 ns"),
    Case("0.3 ns of the same MD", lambda r, x, y: x[:300], ("undecided",), r"\(20 are needed\)"),
    Case("1 ns of MD made here, at 350 K", lambda r, x, y: x, WRONG, "temperature of vibrations .*: 3[3-6]. K", 350.0),
)  # fmt: skip


def load_runs(folder: Path) -> list[Ensemble]:
    """Return the four runs."""
    from surrogate.comparison.read.ensemble import load_ensemble

    top = folder / "ala2.pdb"
    return [load_ensemble([folder / f"trajectory-{k}.dcd"], top=top, lag_ps=1.0) for k in (1, 2, 3, 4)]


def simulate(folder: Path, temperature_k: float) -> Frames:
    """Return 1 ns of MD as the runs in `folder` were made (its README), but for the temperature."""
    from surrogate import api
    from surrogate.comparison.read.ensemble import load_ensemble

    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "md.h5"
        api.reference(
            folder / "ala2.pdb",
            path,
            time_ps=1000.0,
            save_every_ps=1.0,
            equilibrate_ps=20.0,
            temperature_k=temperature_k,
            force_field="ff99SB-ILDN",
            solvent="amber99-obc",
            friction_per_ps=91.0,
            timestep_ps=0.002,
            hydrogen_mass_da=None,
            seed=1,
            quiet=True,
        )
        return np.array(load_ensemble([path], template=load_runs(folder)[0].scene).segments[0])


def run_cases(folder: Path, cases: Sequence[Case] = CASES) -> list[Outcome]:
    """Evaluate every case."""
    from surrogate.comparison.comparison import compare
    from surrogate.comparison.rows.rows import Options

    runs = load_runs(folder)
    reference, candidate, _, another = (np.array(r.segments[0]) for r in runs)
    made = []
    for case in cases:
        own = candidate if case.temperature_k is None else simulate(folder, case.temperature_k)
        frames = np.ascontiguousarray(case.make(reference, own, another))
        made.append(replace(runs[1], label=case.name, segments=[frames]))
    found = compare(runs[0], made, runs[2], options=Options(peptide_recipe=False))
    return [_outcome(case, evaluation, found) for case, evaluation in zip(cases, found.evaluations, strict=True)]


def temperatures(folder: Path) -> str:
    """Return the table of what the temperature row reads of MD made here, by two references."""
    from surrogate.comparison.comparison import compare
    from surrogate.comparison.rows.rows import Options

    runs = load_runs(folder)
    cold, hot = (replace(runs[0], label=f"ours, {t:.0f} K", segments=[simulate(folder, t)]) for t in (300.0, 350.0))
    lines = ["| reference | candidate | reads |", "|---|---|---|"]
    for reference, candidates in ((runs[0], [cold, hot]), (cold, [hot])):
        found = compare(reference, candidates, runs[2], options=Options(peptide_recipe=False))
        for evaluation in found.evaluations:
            read = evaluation.row("temperature").candidate
            words = f"{read.value:.0f} K [{read.low:.0f}, {read.high:.0f}]"
            lines.append(f"| {reference.label} | {evaluation.summary.label} | {words} |")
    return "\n".join(lines)


def _outcome(case: Case, evaluation: Evaluation, found: Comparison) -> Outcome:
    notes = [n for n in (*evaluation.notes, *found.notes) if n.startswith(case.name)]
    parts = re.split(r"; |(?<=[a-z)])\. ", evaluation.verdict)
    hit = next((t for t in (*evaluation.findings, *parts, *notes) if re.search(case.said, t)), None)
    quiet = not case.said and not evaluation.findings
    words = evaluation.verdict.split(". ")[0] if quiet or hit is None else hit
    right = evaluation.status in case.statuses and (quiet if not case.said else hit is not None)
    return Outcome(case, evaluation.status, words.removeprefix(f"{case.name}: "), right)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the Markdown table."""
    lines = ["| case | must be evaluated | is evaluated | said |", "|---|---|---|---|"]
    for o in outcomes:
        mark = "" if o.as_due else "**wrong:** "
        lines.append(f"| {o.case.name} | {' or '.join(o.case.statuses)} | {mark}{o.status} | {o.words} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=None, help="write the table between its markers in this page")
    parser.add_argument("--temperatures", action="store_true", help="what MD at 300 and 350 K is read as")
    args = parser.parse_args(arguments)
    if args.temperatures:
        sys.stdout.write(temperatures(args.folder) + "\n")
        return
    text = table(run_cases(args.folder))
    if args.out is None:
        sys.stdout.write(text + "\n")
        return
    begin, end = "<!-- cases -->", "<!-- end of cases -->"
    page = args.out.read_text(encoding="utf-8")
    head, tail = page.split(begin)[0], page.split(end)[1]
    args.out.write_text(f"{head}{begin}\n{text}\n{end}{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
