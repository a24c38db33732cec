"""The distributions without the frames that a rollout's guards changed, beside those of all frames."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.distributions import RAMACHANDRAN_BINS, block_counts_joint
from surrogate.judge.rows.charts import Chart
from surrogate.judge.rows.rows import Row, Sample, Trio, distance_row

FloatArray = npt.NDArray[np.float64]

_TITLE = "Distributions without frames that guards changed"
_LEAST_SHARE = 0.1


def intervention_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[tuple[str, str]]]:
    """Return each joint φ/ψ distance with the changed frames of the candidate left out, beside that of all frames.

    Where the two differ, the interventions show in the statistics. Skipped where no frame was changed, or nearly all
    were; a candidate whose file has no such column gets neither rows nor a reason.
    """
    changed = trio.candidate.features.changed
    if changed is None:
        return [], [], []
    share = float(np.concatenate(list(changed)).mean())
    if share == 0.0:
        return [], [], [(_TITLE, "the guards changed no frame")]
    if share > 1.0 - _LEAST_SHARE:
        return [], [], [(_TITLE, f"{100 * share:.3g} % of the frames were changed")]
    rows = []
    for residue in trio.torsions.residues:
        where = f"{residue.label}, without the {100 * share:.2g} % that guards changed"

        def statement(ratio: float, where: str = where) -> str:
            return f"the φ/ψ distribution of {where}, is {ratio:.2g} times as far from the reference as a replicate's"

        rows.append(
            distance_row(
                trio,
                [_counts(s, residue.phi, residue.psi) for s in trio.samples],
                key=f"joint_jsd_unchanged:{residue.label}",
                group="distributions",
                metric=f"Joint φ/ψ distance, {where}",
                statement=statement,
            )
        )
    return rows, [], []


def _counts(sample: Sample, phi: int, psi: int) -> FloatArray:
    """Joint histograms per block `(n_blocks, n_bins)` of the frames that nothing was done about."""
    features = sample.features
    x, y = [s[:, phi] for s in features.phi], [s[:, psi] for s in features.psi]
    counts = block_counts_joint(x, y, RAMACHANDRAN_BINS, sample.blocks)
    if features.changed is None:
        return counts
    n = RAMACHANDRAN_BINS.n_total
    for piece in sample.blocks.pieces:
        part = slice(piece.start, piece.stop)
        gone = features.changed[piece.segment][part]
        index = RAMACHANDRAN_BINS.index(x[piece.segment][part][gone]) * n
        index += RAMACHANDRAN_BINS.index(y[piece.segment][part][gone])
        counts[piece.block] -= np.bincount(index, minlength=n * n)
    return counts
