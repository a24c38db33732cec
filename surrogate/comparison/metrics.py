"""What is compared: one list of metrics, each with its kind and time scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from surrogate.comparison.rows import kinetics_rows, published_metrics, structure_rows, torsion_rows, validity_rows
from surrogate.comparison.rows.charts import Chart
from surrogate.comparison.rows.rows import ComparisonInput, Kind, Measured, Row, Skipped, TimeScale, by_group


@dataclass(frozen=True)
class Metric:
    """A metric of a comparison: its name for people, its `kind` (charts of "information" are shown, and no verdict
    rests on it), the `time_scale` of the slowest motion that its rows depend on, which says whether a short comparison,
    or one by a reference that depends on its start, can test it (`verdict.untested`), and `measure`: rows of the
    candidate between reference and replicate, charts, and what was left out and why."""

    name: str
    kind: Kind
    time_scale: TimeScale
    measure: Callable[[ComparisonInput], Measured]


METRICS: tuple[Metric, ...] = (
    Metric("Validity of frames", "validity", "fast", validity_rows.validity_rows),
    Metric("Copies of frames", "validity", "fast", validity_rows.copy_rows),
    Metric("Bond lengths", "distribution", "fast", structure_rows.bond_rows),
    Metric("Bond angles", "distribution", "fast", structure_rows.angle_rows),
    Metric("Temperature of vibrations", "distribution", "fast", structure_rows.temperature_rows),
    Metric("Populations of basins", "distribution", "slow", torsion_rows.population_rows),
    Metric("φ and ψ", "distribution", "slow", torsion_rows.torsion_rows),
    Metric("Other torsions", "distribution", "slow", torsion_rows.other_torsion_rows),
    Metric("Torsions within the states of slower ones", "distribution", "within states", torsion_rows.within_rows),
    Metric("Size and shape", "distribution", "slow", structure_rows.shape_rows),
    Metric("Secondary structure", "distribution", "slow", structure_rows.secondary_structure),
    Metric("Contacts", "distribution", "slow", structure_rows.contact_rows),
    Metric("Hydrogen bonds", "distribution", "slow", structure_rows.hydrogen_bond_rows),
    Metric("Relaxation of torsions", "kinetics", "slow", kinetics_rows.correlation_rows),
    Metric("TIC 0 and Markov state model", "kinetics", "slow", kinetics_rows.slow_rows),
    Metric("Steps from frame to frame", "kinetics", "step", torsion_rows.step_rows),
    Metric("Steps across chunk boundaries", "kinetics", "fast", kinetics_rows.boundary_row),
    Metric("The peptide papers' recipe", "information", "slow", published_metrics.peptide_charts),
)


def measure_all(metrics: Sequence[Metric], inputs: ComparisonInput) -> Measured:
    """Return what the metrics find: rows in the order of their groups, each with its metric's kind and time scale."""
    rows: list[Row] = []
    charts: list[Chart] = []
    skipped: list[Skipped] = []
    for metric in metrics:
        found = metric.measure(inputs)
        if metric.kind != "information":
            rows += [replace(row, kind=metric.kind, time_scale=metric.time_scale) for row in found.rows]
        charts += found.charts
        skipped += found.skipped
    return Measured(by_group(rows), charts, skipped)
