"""Whether the comparison's equivalent MD time is calibrated: `python
docs/studies/comparison/compare_equivalent_time.py REF...
--lengths 500ps 1ns 5ns`.

Of four or more long runs of one simulation the first is the reference, the second the replicate; pieces of the others,
of known lengths, are the candidates. The equivalent MD time of such a piece by the φ/ψ map is its own length.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from compare_molecules import load_runs

from systems.errors import InputError
from systems.units import format_time_ps, parse_time_ps

if TYPE_CHECKING:
    from surrogate.comparison.read.ensemble import Ensemble

_LEAST_RUNS = 3


@dataclass(frozen=True)
class Read:
    """Pieces of one length: the geometric mean of their worths in ps, how many there are, and how many intervals hold
    the length."""

    length_ps: float
    equivalent_ps: float
    n: int
    n_held: int


def calibrate(
    runs: Sequence[Ensemble], lengths_ps: Sequence[float], most: int = 30, reference_ps: float = math.inf
) -> list[Read]:
    """Return what the equivalent MD time of pieces of each length is read as, at most `most` pieces of a length.

    Of reference and replicate the first `reference_ps` are used.

    Raises InputError for fewer than three runs, or runs without φ and ψ.
    """
    from surrogate.comparison.equivalent_time import equivalent_time_by, joint_measure
    from surrogate.comparison.measure.structure import Baseline

    if len(runs) < _LEAST_RUNS:
        raise InputError(f"{len(runs)} runs: a reference, a replicate and one to cut candidates from are needed.")
    baseline = Baseline.of(runs[0], probing=False)
    torsions = baseline.torsions
    # The map needs phi and psi alone: contacts and the like of a million frames take an hour.
    reference, replicate, *others = (baseline.measure(run) for run in runs)
    n_reference = round(min(reference_ps, reference.total_ps) / runs[0].lag_ps)
    reference, replicate = reference.frames(0, n_reference), replicate.frames(0, n_reference)
    found = []
    for length_ps in lengths_ps:
        n = round(length_ps / runs[0].lag_ps)
        pieces = [run.frames(k, k + n) for run in others for k in range(0, run.n_frames - n + 1, n)]
        equivalent_times = []
        for piece in pieces[:: -(-len(pieces) // most) or 1]:
            made = joint_measure(reference, piece, replicate, torsions)
            if made is None:
                raise InputError("The runs have no residue with φ and ψ, or too few frames.")
            equivalent_time = equivalent_time_by(*made)
            if equivalent_time is not None:
                equivalent_times.append(equivalent_time)
        held = [(w.low_ps or 0.0) <= length_ps <= (w.high_ps or math.inf) for w in equivalent_times]
        mean = float(np.exp(np.mean([math.log(w.equivalent_ps) for w in equivalent_times])))
        found.append(Read(length_ps, mean, len(equivalent_times), sum(held)))
    return found


def report(found: Sequence[Read]) -> str:
    """Return the table and the share of intervals that hold."""
    lines = ["| length | read as | pieces | intervals that hold it |", "|---|---|---|---|"]
    for r in found:
        read = format_time_ps(float(f"{r.equivalent_ps:.3g}"))
        lines.append(f"| {format_time_ps(r.length_ps)} | {read} | {r.n} | {r.n_held} |")
    n, held = sum(r.n for r in found), sum(r.n_held for r in found)
    return "\n".join([*lines, f"{held} of {n} intervals hold the true length ({100 * held / max(n, 1):.0f} %)"])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="REF", help="three or more long runs of one simulation")
    parser.add_argument("--lengths", nargs="+", default=["500ps", "1ns", "2ns", "5ns", "10ns", "20ns"])
    parser.add_argument("--most", type=int, default=30, help="pieces of each length at most")
    parser.add_argument("--reference", default=None, help="use so much of reference and replicate")
    args = parser.parse_args(arguments)
    reference_ps = math.inf if args.ref is None else parse_time_ps(args.ref)
    found = calibrate(load_runs(args.runs), [parse_time_ps(x) for x in args.lengths], args.most, reference_ps)
    sys.stdout.write(report(found) + "\n")


if __name__ == "__main__":
    main()
