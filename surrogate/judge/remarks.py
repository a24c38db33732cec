"""What is said beside the numbers: trimming to equal length, a replicate that differs, what the scene lacks."""

from __future__ import annotations

from collections.abc import Sequence

from surrogate.judge import metrics, verdict
from surrogate.judge.rows import Options, Row, Trio
from surrogate.judge.structure import Features
from systems import validity
from systems.units import format_time_ps

_SHORT_IN_CORRELATION_TIMES = 30


def trimming(
    trio: Trio, reference: Features, candidate: Features, replicate: Features, correlation: float
) -> list[str]:
    """Return what was left out of each trajectory for equal length, and whether the rest is too short to judge by."""
    notes = []
    compared = trio.reference.features
    for features in (reference, candidate, replicate):
        if features.n_frames > compared.n_frames:
            notes.append(
                f"{features.label}: the first {format_time_ps(compared.total_ps)} of "
                f"{format_time_ps(features.total_ps)} are used, for equal length."
            )
    if compared.n_frames < _SHORT_IN_CORRELATION_TIMES * 2 * correlation:
        notes.append(
            f"The compared length is only {compared.n_frames / (2 * correlation):.0f} correlation times of the slowest "
            "torsion: too short to judge by; error bars are themselves uncertain."
        )
    return notes


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
    done = {check.mask for check in metrics.applicable_checks(trio.geometry)}
    for flag, what, why in (
        (validity.BOND_HALF_ANGSTROM, "Bond lengths", "the scene has no bonds"),
        (validity.CLASH, "Clashes", "no two atoms are more than three bonds apart"),
        (validity.CHIRALITY, "Stereocentres", "the scene has none"),
        (validity.OMEGA, "Peptide and double bonds", "the scene has none"),
        (validity.RING, "Planar rings", "the scene has none"),
    ):
        if flag not in done:
            skipped.append((what, why))
    if not len(trio.torsions.phi) and not len(trio.torsions.psi):
        skipped.append(("Torsion distributions, basins, autocorrelation", "the scene has no φ or ψ torsion"))
    elif not trio.torsions.residues:
        skipped.append(("Joint φ/ψ maps", "no residue has both torsions"))
    return skipped
