"""What is compared: one list of metrics, each with its kind and time scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from surrogate.comparison.rows import kinetics_rows, published_metrics, structure_rows, torsion_rows, validity_rows
from surrogate.comparison.rows.charts import Chart
from surrogate.comparison.rows.rows import ComparisonInput, Kind, Measured, Row, Skipped, TimeScale, by_group


class Metric(Protocol):
    """A metric of a comparison.

    `kind`: "validity" (of single frames), "distribution", "kinetics", or "information", whose charts are shown and on
    which no verdict rests. `time_scale`: how soon its quantity has forgotten itself, which says whether a short
    comparison, or one by a reference that depends on its start, can test it (`verdict.untested`).
    """

    @property
    def name(self) -> str:
        """Name for people."""

    @property
    def kind(self) -> Kind:
        """What sort of difference it finds."""

    @property
    def time_scale(self) -> TimeScale:
        """Of the slowest motion that its rows depend on."""

    def measure(self, inputs: ComparisonInput) -> Measured:
        """Return rows of the candidate between reference and replicate, charts, and what was left out and why."""


@dataclass(frozen=True)
class FunctionMetric:
    """A metric that is a function of the input; see `Metric`."""

    name: str
    kind: Kind
    time_scale: TimeScale
    measure: Callable[[ComparisonInput], Measured]


METRICS: tuple[Metric, ...] = (
    FunctionMetric("Validity of frames", "validity", "fast", validity_rows.validity_rows),
    FunctionMetric("Copies of frames", "validity", "fast", validity_rows.copy_rows),
    FunctionMetric("Bond lengths", "distribution", "fast", structure_rows.bond_rows),
    FunctionMetric("Bond angles", "distribution", "fast", structure_rows.angle_rows),
    FunctionMetric("Temperature of vibrations", "distribution", "fast", structure_rows.temperature_rows),
    FunctionMetric("Potential energies", "distribution", "fast", validity_rows.energy_rows),
    FunctionMetric("Populations of basins", "distribution", "slow", torsion_rows.population_rows),
    FunctionMetric("φ and ψ", "distribution", "slow", torsion_rows.torsion_rows),
    FunctionMetric(
        "φ and ψ without frames that guards changed", "distribution", "slow", torsion_rows.intervention_rows
    ),
    FunctionMetric("Other torsions", "distribution", "slow", torsion_rows.other_torsion_rows),
    FunctionMetric(
        "Torsions within the states of slower ones", "distribution", "within states", torsion_rows.within_rows
    ),
    FunctionMetric("Size and shape", "distribution", "slow", structure_rows.shape_rows),
    FunctionMetric("Secondary structure", "distribution", "slow", structure_rows.secondary_structure),
    FunctionMetric("Contacts", "distribution", "slow", structure_rows.contact_rows),
    FunctionMetric("Hydrogen bonds", "distribution", "slow", structure_rows.hydrogen_bond_rows),
    FunctionMetric("Relaxation of torsions", "kinetics", "slow", kinetics_rows.correlation_rows),
    FunctionMetric("TIC 0", "kinetics", "slow", kinetics_rows.tica_rows),
    FunctionMetric("Markov state model", "kinetics", "slow", kinetics_rows.msm_rows),
    FunctionMetric("Steps from frame to frame", "kinetics", "step", torsion_rows.step_rows),
    FunctionMetric("Steps across chunk boundaries", "kinetics", "fast", kinetics_rows.boundary_row),
    FunctionMetric("The peptide papers' recipe", "information", "slow", published_metrics.peptide_charts),
    FunctionMetric("Forecast error", "information", "fast", published_metrics.forecast_charts),
    FunctionMetric("RMSD and torsions along time", "information", "slow", structure_rows.along_time),
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
