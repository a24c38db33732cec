"""What is said beside the numbers: trimming to equal length, a replicate that differs, what the scene lacks."""

from __future__ import annotations

from collections.abc import Sequence

from surrogate.judge import verdict
from surrogate.judge.measure.slow_motion import rarely_crossed
from surrogate.judge.measure.statistics import effective_samples
from surrogate.judge.measure.structure import Features
from surrogate.judge.rows import metrics
from surrogate.judge.rows.rows import Options, Row, Trio
from surrogate.judge.rows.suspicions import copied_from
from systems.chemistry import validity
from systems.units import format_time_ps

LEAST_SAMPLES = 20
# Fewer, and error bars of what follows the slow motion are themselves not known.
LEAST_FOR_TESTS = 5
# What is known of the truth, however short the candidate is.
LEAST_FOR_WORTH = 10
_MENTIONED = 3


def trimming(trio: Trio, reference: Features, candidate: Features, replicate: Features) -> list[str]:
    """Return which trajectories are longer than the equal length at which distances are taken."""
    longer = [f for f in (reference, candidate, replicate) if f.total_ps > trio.compared_ps]
    return [
        f"{f.label}: the first {f.frames(0, round(trio.compared_ps / f.lag_ps)).length_words} of {f.length_words} are "
        "used for the distances, at equal length; all of it for the tests."
        for f in longer
    ]


def doubts(trio: Trio, correlation: float, start: str = "") -> verdict.Doubts:
    """Return which slow motions are not sampled, in words. `correlation`: the slowest of any trajectory, frames;
    `start`: what of the reference still depends on where it started."""
    short = lost = ""
    lag_ps = trio.reference.features.lag_ps
    samples = effective_samples(round(trio.compared_ps / lag_ps), correlation)
    if samples < LEAST_SAMPLES:
        short = (
            f"the slowest motion is remembered for {format_time_ps(correlation * lag_ps, 2)}, which "
            f"makes {samples:.2g} independent samples, too few to judge by ({LEAST_SAMPLES} are needed)"
        )
    apart = rarely_crossed((trio.reference.features, trio.replicate.features), trio.candidate.features)
    if apart:
        named = ", ".join(apart[:_MENTIONED]) + (f" and {len(apart) - _MENTIONED} more" if apart[_MENTIONED:] else "")
        lost = (
            f"it lies in another state of {named} than the reference, and hardly any run passes from one to the other"
        )
    copied, _ = copied_from(trio)
    return verdict.Doubts(short, lost, copied, start)


def unlike(rows: Sequence[Row], options: Options) -> list[str]:
    """Return a warning where the replicate itself differs from the reference."""
    metrics_off = verdict.replicate_differs(rows, options)
    if not metrics_off:
        return []
    return [
        f"The replicate itself differs from the reference ({'; '.join(metrics_off)}): the two are not samples of one "
        "simulation, or too short; trust no verdict on these metrics."
    ]


def skipped(trio: Trio) -> list[tuple[str, str]]:
    """Return the checks and torsions that the scene has nothing for, with the reason."""
    skipped = []
    probes = trio.reference.features.probes
    whole = probes is None or probes.whole
    none = "the scene has none" if whole else "atoms that it needs are not in all files: not checked"
    done = {check.mask for check in metrics.applicable_checks(trio.geometry)}
    for flag, what, why in (
        (validity.BOND_HALF_ANGSTROM, "Bond lengths", "the scene has no bonds"),
        (validity.CLASH, "Clashes", "no two atoms are more than three bonds apart"),
        (validity.CHIRALITY, "Stereocentres", none),
        (validity.OMEGA, "Peptide and double bonds", none),
        (validity.RING, "Planar rings", none),
    ):
        if flag not in done:
            skipped.append((what, why))
    if not len(trio.torsions.phi) and not len(trio.torsions.psi):
        skipped.append(("Torsion distributions, basins, autocorrelation", "the scene has no φ or ψ torsion"))
    elif not trio.torsions.residues:
        skipped.append(("Joint φ/ψ maps", "no residue has both torsions"))
    return skipped
