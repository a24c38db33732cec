"""Rows of hydrogen-bond lifetimes: how long a bond once formed stays formed, from one frame to the next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.equal_atoms import equal_rows, group_labels
from surrogate.judge.measure.statistics import Blocks
from surrogate.judge.rows.block_means import column, family_of
from surrogate.judge.rows.charts import Chart
from surrogate.judge.rows.motion.relaxation_rows import speed_words
from surrogate.judge.rows.own_blocks import with_own_blocks
from surrogate.judge.rows.rows import Metric, Row, Trio, observable_row

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_NAME = "Hydrogen-bond lifetimes"
_MOST = 4
_LEAST_BREAKS = 20


def lifetime_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[tuple[str, str]]]:
    """Return the mean lifetime of the hydrogen bonds that the reference breaks most often, equal ones together.

    Skipped where the reference breaks none of them at least twenty times.
    """
    probes = trio.reference.features.probes
    if probes is None or not len(probes.hydrogen_bonds):
        return [], [], [(_NAME, "no hydrogen bond is followed")]
    lag_ps = trio.reference.features.lag_ps
    formed = [family_of(s, "hydrogen_bonds") for s in trio.samples]
    groups = equal_rows(probes.hydrogen_bonds, probes.classes)
    labels = group_labels(probes.labels("hydrogen_bonds"), groups)
    first = [_group_sums(formed[0], group, trio.reference.blocks) for group in groups]
    order = sorted(range(len(labels)), key=lambda k: -first[k][1].sum())
    chosen = [k for k in order[:_MOST] if first[k][1].sum() >= _LEAST_BREAKS]
    if not chosen:
        return [], [], [(_NAME, f"the reference breaks none of them {_LEAST_BREAKS} times")]
    rows: list[Row] = []
    skipped: list[tuple[str, str]] = []
    for k in chosen:
        fine = with_own_blocks(trio, [_breaks_beyond_rate(f, groups[k]) for f in formed])
        sums = [_group_sums(f, groups[k], s.blocks) for f, s in zip(formed, fine.samples, strict=True)]
        if sums[1][1].sum() < _LEAST_BREAKS:
            often = "never forms it" if not sums[1][0].sum() else f"breaks it {sums[1][1].sum():.0f} times"
            skipped.append((f"Lifetime of the hydrogen bond {labels[k]}", f"the candidate {often}"))
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            values = [float(lag_ps * f.sum() / b.sum()) if b.sum() else np.nan for f, b in sums]
            draws = [lag_ps * (s.weights @ f) / (s.weights @ b) for (f, b), s in zip(sums, fine.samples, strict=True)]
        rows.append(
            observable_row(
                fine,
                Metric(
                    f"hydrogen_bond_lifetime:{labels[k]}",
                    "kinetics",
                    f"Lifetime of the hydrogen bond {labels[k]}",
                    "ps",
                    0.2,
                    relative=True,
                ),
                values,
                draws,
                lambda c, r, k=k: speed_words(f"the hydrogen bond {labels[k]} breaks", c, r),  # type: ignore[misc]
            )
        )
    return rows, [], skipped


def _breaks_beyond_rate(formed: Sequence[BoolArray], columns: npt.NDArray[np.intp]) -> list[FloatArray]:
    """Return per segment how many bonds break at each frame beyond what the mean rate has for those formed, `(n,)`."""
    held = [x[:, columns].sum(axis=1).astype(np.float64) for x in formed]
    broken = [np.append((x[:-1, columns] & ~x[1:, columns]).sum(axis=1), 0).astype(np.float64) for x in formed]
    rate = sum(b.sum() for b in broken) / max(sum(h.sum() for h in held), 1.0)
    return [b - rate * h for b, h in zip(broken, held, strict=True)]


def _group_sums(
    formed: Sequence[BoolArray], columns: npt.NDArray[np.intp], blocks: Blocks
) -> tuple[FloatArray, FloatArray]:
    """Return the `lifetime_sums` of several columns of `formed` `(n, k)` together."""
    each = [lifetime_sums(column(formed, int(k)), blocks) for k in columns]
    return np.sum([held for held, _ in each], axis=0), np.sum([broken for _, broken in each], axis=0)


def lifetime_sums(formed: Sequence[BoolArray], blocks: Blocks) -> tuple[FloatArray, FloatArray]:
    """Return per block the frames from which the bond could break, and in how many it broke: two `(n_blocks,)`.

    Their ratio is the mean lifetime in frames. A pair of frames belongs to the block in which it starts; the last frame
    of a segment starts none, so that a bond that outlives its segment counts as not yet broken (the maximum-likelihood
    estimate under censoring). Source: continuous definition, Rapaport, Mol. Phys. 50, 1151 (1983).
    """
    held, broken = np.zeros(blocks.n_blocks), np.zeros(blocks.n_blocks)
    for piece in blocks.pieces:
        part = formed[piece.segment][piece.start : piece.stop + 1]
        held[piece.block] += np.count_nonzero(part[:-1])
        broken[piece.block] += np.count_nonzero(part[:-1] & ~part[1:])
    return held, broken
