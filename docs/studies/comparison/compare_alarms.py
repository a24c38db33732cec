"""False alarms of the comparison on one molecule: `python docs/studies/comparison/compare_alarms.py REF... --piece
20ns`.

Runs of one simulation are cut into pieces. Each piece is evaluated once as the candidate, against a piece of another
run as the reference and one of a third as the replicate: nothing is wrong with any of them, so that every word worse
than "undecided" is a false alarm. At a significance of 5 % over all rows, Holm-corrected, at most one in twenty is due.

`--intervals` counts instead how many of the pieces' 95 % intervals of relaxation times hold the time that all runs
together give: that of the integrated autocorrelation of every cos psi or, without one, of every rotatable torsion.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.read.ensemble import Ensemble
from systems.units import format_time_ps, parse_time_ps

if TYPE_CHECKING:
    from surrogate.comparison.measure.structure import Features

_LEVEL = 0.05
# Fewer independent samples, and a relaxation time has no interval to be held to.
_LEAST_SAMPLES = 5
_SEEN_SHARE = 0.003


@dataclass(frozen=True)
class Alarms:
    """What came of fair comparisons: how many ended in which word, and which rows were to blame how often.

    `replicate_off`: in how many the replicate was said to differ from the reference, an alarm of the same kind.
    """

    n: int
    piece_ps: float
    status: dict[str, int]
    rows: dict[str, int]
    replicate_off: int

    @property
    def n_alarms(self) -> int:
        return self.n - self.status.get("indistinguishable", 0) - self.status.get("undecided", 0)

    def p_value(self) -> float:
        """Return the probability of so many alarms or more when one in twenty is due (exact binomial test)."""
        from scipy.stats import binomtest

        return float(binomtest(self.n_alarms, self.n, _LEVEL, alternative="greater").pvalue)

    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the share of alarms (Clopper and Pearson, Biometrika 26, 404, 1934)."""
        from scipy.stats import binomtest

        found = binomtest(self.n_alarms, self.n).proportion_ci(0.95, method="exact")
        return float(found.low), float(found.high)


def cut(runs: Sequence[Ensemble], piece_ps: float) -> list[tuple[int, Ensemble]]:
    """Return the whole pieces of each run with the number of the run; pieces do not cross segments."""
    out = []
    for k, run in enumerate(runs):
        n = round(piece_ps / run.lag_ps)
        for s, segment in enumerate(run.segments):
            for start in range(0, len(segment) - n + 1, n):
                name = f"{run.label} {s} at {format_time_ps(start * run.lag_ps)}"
                frames = segment[start : start + n]
                piece = replace(run, label=name, segments=[frames], flags=None, chunk_idx=None, sources=())
                out.append((k, piece))
    return out


def fair_input_sets(pieces: Sequence[tuple[int, Ensemble]]) -> Iterator[tuple[Ensemble, Ensemble, Ensemble]]:
    """Yield (reference, candidate, replicate): each piece once as candidate, the others as far round the list as a
    third and two thirds of it, moved on until all three come from different runs."""
    n = len(pieces)
    for k, (run, piece) in enumerate(pieces):
        others: list[tuple[int, Ensemble]] = []
        for share in (n // 3, 2 * n // 3):
            taken = {run, *(r for r, _ in others)}
            ahead = (pieces[(k + share + i) % n] for i in range(n))
            found = next((p for p in ahead if p[0] not in taken), None)
            if found is not None:
                others.append(found)
        if len(others) == 2:
            yield others[0][1], piece, others[1][1]


def count_alarms(runs: Sequence[Ensemble], piece_ps: float, most: int | None = None) -> Alarms:
    """Evaluate every piece as the module says and count. Raises InputError when fewer than three runs hold a piece."""
    from surrogate.comparison.comparison import compare
    from surrogate.comparison.rows.rows import Options
    from systems.errors import InputError

    status: Counter[str] = Counter()
    rows: Counter[str] = Counter()
    off = 0
    for done, (reference, candidate, replicate) in enumerate(fair_input_sets(cut(runs, piece_ps))):
        if most is not None and done >= most:
            break
        found = compare(reference, [candidate], replicate, options=Options(peptide_recipe=False)).evaluations[0]
        status[found.status] += 1
        rows.update(r.key for r in found.rows if r.verdict in ("close", "differs", "fails"))
        off += any(note.startswith("The replicate itself differs") for note in found.notes)
    if not status:
        raise InputError(f"Fewer than three runs hold a piece of {format_time_ps(piece_ps)}: nothing to compare.")
    return Alarms(sum(status.values()), piece_ps, dict(status), dict(rows), off)


@dataclass(frozen=True)
class Intervals:
    """Of `n` 95 % intervals of relaxation times of pieces, how many hold the true time.

    `times_ps`: what all runs together give, by torsion; `n_missed`: how many of the pieces have not met a state that
    all runs together hold, and were held against the time that pieces like them give together.
    """

    n: int
    n_held: int
    n_missed: int
    times_ps: dict[str, float]

    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the share that holds (Clopper and Pearson); pieces count as independent."""
        from scipy.stats import binomtest

        found = binomtest(self.n_held, self.n).proportion_ci(0.95, method="exact")
        return float(found.low), float(found.high)


def count_intervals(runs: Sequence[Ensemble], piece_ps: float) -> Intervals:
    """Take the interval of every piece's relaxation times as a comparison makes it, and count.

    The reference is what all pieces together give; but no interval can hold what a run has not met, so that pieces that
    miss a state (a quarter turn of a torsion, `_SEEN_SHARE` of all frames or more) are held against each other. Asked
    are torsions of which a piece holds `_LEAST_SAMPLES` independent samples.
    """
    from surrogate.comparison.measure.kinetics import zero_crossing
    from surrogate.comparison.measure.slow_motion import longest_correlation
    from surrogate.comparison.measure.statistics import block_length, effective_samples, make_blocks
    from surrogate.comparison.measure.structure import Baseline
    from surrogate.comparison.rows.kinetics_rows import relaxation_of, turning
    from surrogate.comparison.rows.rows import Options, make_sample

    baseline = Baseline.of(runs[0])
    n, lag_ps = round(piece_ps / runs[0].lag_ps), runs[0].lag_ps
    pieces = []
    for run in runs:
        whole = baseline.measure(run)
        pieces += [whole.frames(start, start + n) for start in range(0, whole.n_frames - n + 1, n)]
    shares = np.array([_quarters(piece) for piece in pieces])
    held_by_all = shares.mean(axis=0) >= _SEEN_SHARE
    met = (shares[:, held_by_all] >= 0.1 * shares.mean(axis=0)[held_by_all]).all(axis=1)
    moving = [turning(piece) for piece in pieces]
    asked = held = 0
    for k in range(len(moving[0])):
        for like in (True, False):
            every = [x for m, same in zip(moving, met, strict=True) if same == like or like for x in m[k][2]]
            ref = zero_crossing(every)[1] if every else math.nan
            if not effective_samples(n, ref) >= _LEAST_SAMPLES:
                continue
            for piece, same in zip(pieces, met, strict=True):
                if same == like:
                    blocks = make_blocks(piece.segment_lengths, block_length(n, longest_correlation(piece)))
                    found = relaxation_of(make_sample(piece, blocks, Options(), 0), k)[1]
                    asked += 1
                    held += found.low <= ref * lag_ps <= found.high
    times = [lag_ps * zero_crossing([x for m in moving for x in m[k][2]])[1] for k in range(len(moving[0]))]
    names = [label or baseline.torsions.psi_labels[k] for k, (_, label, _) in enumerate(moving[0])]
    return Intervals(asked, held, int((~met).sum()), dict(zip(names, times, strict=True)))


def _quarters(piece: Features) -> npt.NDArray[np.float64]:
    """Return the share of frames in each quarter turn of phi, psi and every rotatable torsion, `(n,)`."""
    from surrogate.comparison.measure.slow_motion import SLOW_KINDS

    angles = [np.concatenate(piece.phi), np.concatenate(piece.psi)]
    if piece.probes is not None and "torsions" in piece.series:
        slow = [k for k, t in enumerate(piece.probes.torsions) if t.kind in SLOW_KINDS]
        angles.append(np.concatenate(piece.series["torsions"])[:, slow])
    quarter = np.floor(np.concatenate(angles, axis=1) / (math.pi / 2)) % 4
    return np.concatenate([(quarter == q).mean(axis=0) for q in range(4)])


def report_intervals(found: Intervals) -> str:
    """Return the count in words."""
    times = ", ".join(f"{name} {time:.3g} ps" for name, time in found.times_ps.items())
    if not found.n:
        return f"no piece holds {_LEAST_SAMPLES} independent samples of any torsion ({times})"
    low, high = (100 * x for x in found.interval())
    return (
        f"{found.n_held} of {found.n} intervals hold the relaxation time ({100 * found.n_held / found.n:.0f} % "
        f"[{low:.0f}, {high:.0f}]; 95 are due); {found.n_missed} pieces have not met every state ({times})"
    )


def report(found: Alarms) -> str:
    """Return the count in words."""
    low, high = (100 * x for x in found.interval())
    length = f" of {format_time_ps(found.piece_ps)}" if found.piece_ps else ""
    lines = [
        f"{found.n} fair comparisons{length}: {found.n_alarms} false alarms "
        f"({100 * found.n_alarms / found.n:.1f} % [{low:.1f}, {high:.1f}]; 5 % are due, p {found.p_value():.2g})",
        ", ".join(f"{n} {word}" for word, n in sorted(found.status.items())),
        f"replicate said to differ: {found.replicate_off}",
    ]
    return "\n".join([*lines, *(f"  {n} x {key}" for key, n in sorted(found.rows.items(), key=lambda x: -x[1]))])


def main(arguments: Sequence[str] | None = None) -> None:
    from surrogate.comparison.read.ensemble import load_ensemble

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="REF", help="three or more runs of one simulation")
    parser.add_argument("--piece", default="20ns", help="length of each piece (default 20ns)")
    parser.add_argument("--most", type=int, default=None, help="stop after so many comparisons")
    parser.add_argument("--intervals", action="store_true", help="count intervals of relaxation times instead")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args(arguments)
    first = load_ensemble([args.runs[0]])
    runs = [first, *(load_ensemble([path], template=first.scene) for path in args.runs[1:])]
    if args.intervals:
        sys.stdout.write(report_intervals(count_intervals(runs, parse_time_ps(args.piece))) + "\n")
        return
    found = count_alarms(runs, parse_time_ps(args.piece), args.most)
    sys.stdout.write(report(found) + "\n")
    if args.json is not None:
        record: dict[str, Any] = vars(found) | {"n_alarms": found.n_alarms, "p_value": found.p_value()}
        args.json.write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
