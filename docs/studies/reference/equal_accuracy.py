"""Speed-up at equal accuracy: what the same minutes of one core tell of a molecule, as lengths of MD.

    python docs/studies/reference/equal_accuracy.py FOLDER --molecule NAME [--minutes 10] [-o TABLE.json]

FOLDER is that of `error_against_minutes`, with the molecule's reference, runs and rivals. Of each way the root mean
square error of the populations of all torsion states is that beside the reference, less the reference's own. MD of all
states that is T long errs by sqrt(c / T), where c follows from how far the reference's replicas scatter; so an error
is equivalent to a length of such MD. Over the length that OpenMM, and SIMD replicas, make in these minutes it is the
speed-up. A torsion of which the reference enters some state fewer than ten times plays no part: it does not know how
likely that is. OpenMM's answer is that of one SIMD replica from one start, as far as these reach, root mean square over
sixteen. Intervals (95 %) are of the reference's replicas, drawn again.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from error_against_minutes import (
    MOLECULES,
    WAYS,
    Angles,
    FloatArray,
    LongMD,
    answer_again,
    finished,
    md_length_ps,
    measured,
    rates_of,
    rolled_length_ps,
    said,
)

from md_reference.run.machine import machine_name
from surrogate.comparison.measure.torsions import Wells, find_wells
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.verbs.run.run_record import RunResult

DRAWS, SEED, LEAST_ENTRIES = 2_000, 0, 10


def known(wells: Wells, segments: Sequence[FloatArray]) -> bool:
    """Return whether replicas enter every state of a torsion, of several, often enough."""
    states = wells.assign(segments)
    entries = [sum(int(((x[1:] == k) & (x[:-1] != k)).sum()) for x in states) for k in range(len(wells.names))]
    return len(entries) > 1 and min(entries) >= LEAST_ENTRIES


class Populations:
    """The states of all torsions of a reference, and their populations by each of its replicas."""

    def __init__(self, ref: LongMD) -> None:
        self.ref = ref
        self.wells = {name: wells for name, x in ref.angles.items() if known(wells := find_wells(x), x)}
        self.of_replicas = np.stack([self.of(angles) for angles in one_by_one(ref.angles)])
        self.total_ps = ref.ensemble.lag_ps * sum(map(len, ref.ensemble.segments))

    def of(self, angles: Angles, weights: Sequence[FloatArray] | None = None) -> FloatArray:
        """Return the populations `(n_states,)` that angles tell."""
        found = []
        for name, wells in self.wells.items():
            states = np.concatenate(wells.assign(angles[name]))
            counts = np.bincount(states, None if weights is None else np.concatenate(list(weights)), len(wells.names))
            found.append(counts / counts.sum())
        return np.concatenate(found)

    def of_ensemble(self, of: Ensemble, weights: Sequence[FloatArray] | None = None) -> FloatArray:
        return self.of(measured(self.ref.baseline, of), weights)

    def equivalent(self, shares: Sequence[FloatArray]) -> tuple[float, tuple[float, ...]]:
        """Return the error in per cent of answers `(n_states,)`, root mean square over them, and the length of MD in ps
        that errs as much, with its interval; endless where the reference tells no error."""

        def of(replicas: FloatArray, own: float) -> tuple[float, float]:
            noise = float(np.mean(self.of_replicas.var(axis=0, ddof=1))) / len(self.of_replicas)
            square = float(np.mean([(x - replicas.mean(axis=0)) ** 2 for x in shares])) - own * noise
            return square, noise * self.total_ps / square if square > 0 else math.inf

        rng, n = np.random.default_rng(SEED), len(self.of_replicas)
        square, length = of(self.of_replicas, 1.0)
        # Drawn again, the reference errs twice.
        drawn = [of(self.of_replicas[rng.integers(n, size=n)], 2.0)[1] for _ in range(DRAWS)]
        return 100.0 * math.sqrt(max(0.0, square)), (length, *np.quantile(drawn, [0.025, 0.975], method="nearest"))


def lines(place: Path, minutes: float, ref: LongMD) -> list[list[str]]:
    """Return a line of each way."""
    rates, _ = rates_of(place, minutes)
    result = RunResult.of(place / f"{minutes:g}min")
    populations, seconds = Populations(ref), 60.0 * minutes
    openmm_ps = seconds * rates["cores"] * rates["timestep_ps"] / rates["step_s"] / rates["stretch"]
    simd_ps = seconds * rates["md_ps_per_s"]
    one = ref.load(finished(place / "one"), max(openmm_ps, md_length_ps(rates, minutes)))
    each = one_by_one(measured(ref.baseline, one))
    answer = answer_again(result, ref)
    run, simd = ref.load(result.md), ref.load(finished(place / "one"), md_length_ps(rates, minutes))
    rolled = ref.load(finished(place / "rollout"), rolled_length_ps(rates, minutes))
    answers = {
        "OpenMM from one start": (openmm_ps, [populations.of(angles) for angles in each]),
        f"SIMD, {WAYS['one']}": (simd_ps, [populations.of_ensemble(simd)]),
        WAYS["rollout"]: (length_ps(rolled), [populations.of_ensemble(rolled)]),
        WAYS["run"]: (length_ps(run), [populations.of_ensemble(run, None if answer is None else answer.weights)]),
    }
    rows = []
    for way, (made_ps, shares) in answers.items():
        error, lengths = populations.equivalent(shares)
        rows.append([way, ns(made_ps), f"{error:.1f}", interval([ns(x) for x in lengths]),
                     *(interval([f"{x / made:.2g}" for x in lengths]) for made in (openmm_ps, simd_ps))])  # fmt: skip
    return rows


def one_by_one(angles: Angles) -> list[Angles]:
    """Return the angles of each replica."""
    n = len(next(iter(angles.values())))
    return [{name: [x[r]] for name, x in angles.items()} for r in range(n)]


def length_ps(ensemble: Ensemble) -> float:
    return ensemble.lag_ps * sum(map(len, ensemble.segments))


def ns(time_ps: float) -> str:
    return f"{1e-3 * time_ps:.2g}" if time_ps < 1e5 else f"{1e-3 * time_ps:.0f}"


def interval(words: Sequence[str]) -> str:
    value, low, high = (word.replace("inf", "∞") for word in words)
    return f"{value} [{low}, {high}]"


COLUMNS = ["way", "ns made", "error of populations, %", "equivalent MD, ns", "over OpenMM", "over SIMD replicas"]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--molecule", choices=sorted(MOLECULES), required=True)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args(arguments)
    place = given.folder / given.molecule
    ref = LongMD.of(finished(place))
    rows = lines(place, given.minutes, ref)
    note = (
        f"{given.molecule}, {given.minutes:g} minutes of one core. Reference: {len(ref.files)} SIMD replicas from many "
        f"starts, {length_ps(ref.ensemble) * 1e-3:.0f} ns in all, split R-hat {ref.r_hat:.2f}; its halves "
        f"differ by {ref.replicate_baseline:.3f} in torsions (Jensen-Shannon distance, root, natural logarithm)."
    )
    table: dict[str, Any] = {
        "command": "python docs/studies/reference/equal_accuracy.py FOLDER "
        f"--molecule '{given.molecule}' --minutes {given.minutes:g}",
        "machine": f"{machine_name()}, one core used", "note": note, "columns": COLUMNS, "rows": rows,
    }  # fmt: skip
    for row in rows:
        said(" | ".join(row))
    said(note)
    if given.out is not None:
        given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
