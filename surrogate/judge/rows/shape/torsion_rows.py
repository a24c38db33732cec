"""Rows and charts of the torsions beside phi and psi: omega, chi, rotatable bonds of small molecules, rotors."""

from __future__ import annotations

from collections.abc import Sequence

from surrogate.judge.measure.distributions import TORSION_BINS
from surrogate.judge.measure.torsions import Kind
from surrogate.judge.rows.block_means import column, family_of
from surrogate.judge.rows.charts import Chart
from surrogate.judge.rows.curves import histogram
from surrogate.judge.rows.rows import Row, Trio
from surrogate.judge.rows.shape.shape_rows import mean_distance, series_distance

Skipped = tuple[str, str]

# More of one kind than this, and they share one row.
_MANY = 6
_MAX_SERIES = 64
_NAMES: dict[Kind, str] = {
    "ω": "Peptide torsions ω",
    "χ": "Side-chain torsions χ",
    "rotatable": "Rotatable torsions",
    "rotor": "Rotors (methyl, hydroxyl, ammonium)",
}


def other_torsion_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[Skipped]]:
    """Return Jensen-Shannon distances of every torsion beside phi and psi, 100 bins, symmetric rotors folded.

    Chi and rotatable bonds have a row each (one for all above six), omega and rotors one for all of them.
    """
    probes = trio.reference.features.probes
    if probes is None:
        return [], [], []
    rows: list[Row] = []
    charts: list[Chart] = []
    skipped: list[Skipped] = []
    measured = [family_of(s, "torsions") for s in trio.samples]
    for kind, name in _NAMES.items():
        chosen = [k for k, torsion in enumerate(probes.torsions) if torsion.kind == kind]
        if not chosen:
            skipped.append((name, "the scene has none"))
        elif kind in ("χ", "rotatable") and len(chosen) <= _MANY:
            for k in chosen:
                series = [column(v, k) for v in measured]
                label = _folded(probes.torsions[k].label, probes.torsions[k].fold)
                rows.append(series_distance(trio, series, TORSION_BINS, f"torsion_jsd:{label}", label, "distributions"))
                charts.append(histogram(trio, series, TORSION_BINS, label, "rad"))
        else:
            few = _spread(chosen)
            if len(few) < len(chosen):
                skipped.append((f"Some of the {len(chosen)} {name}", f"{len(few)}, evenly chosen, enter the mean"))
            picked = [[x[:, few] for x in v] for v in measured]
            bins = [TORSION_BINS] * len(few)
            rows.append(mean_distance(trio, picked, bins, f"torsions_jsd:{kind}", name, "distributions"))
    return rows, charts, skipped


def _spread(chosen: Sequence[int]) -> list[int]:
    step = -(-len(chosen) // _MAX_SERIES)
    return list(chosen[::step])


def _folded(label: str, fold: int) -> str:
    return label if fold == 1 else f"{label} ({fold} equal positions folded: {fold} times the angle)"
