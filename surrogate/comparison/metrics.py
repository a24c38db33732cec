"""What is compared: one list of metrics, each with its kind and time scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from surrogate.comparison.input_notes import copy_rows
from surrogate.comparison.rows.bond_rows import angle_rows, bond_rows, temperature_rows
from surrogate.comparison.rows.charts import Chart
from surrogate.comparison.rows.forecast import forecast_charts
from surrogate.comparison.rows.msm_rows import msm_rows
from surrogate.comparison.rows.peptide_protocol import peptide_charts
from surrogate.comparison.rows.relaxation_rows import boundary_row, correlation_rows, tica_rows
from surrogate.comparison.rows.rows import ComparisonInput, Kind, Measured, Row, Skipped, TimeScale, by_group
from surrogate.comparison.rows.shape_rows import (
    along_time,
    contact_rows,
    hydrogen_bond_rows,
    secondary_structure,
    shape_rows,
)
from surrogate.comparison.rows.torsion_rows import intervention_rows, other_torsion_rows, population_rows, torsion_rows
from surrogate.comparison.rows.validity_rows import energy_rows, validity_rows
from surrogate.comparison.rows.within_rows import step_rows, within_rows


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
    FunctionMetric("Validity of frames", "validity", "fast", validity_rows),
    FunctionMetric("Copies of frames", "validity", "fast", copy_rows),
    FunctionMetric("Bond lengths", "distribution", "fast", bond_rows),
    FunctionMetric("Bond angles", "distribution", "fast", angle_rows),
    FunctionMetric("Temperature of vibrations", "distribution", "fast", temperature_rows),
    FunctionMetric("Potential energies", "distribution", "fast", energy_rows),
    FunctionMetric("Populations of basins", "distribution", "slow", population_rows),
    FunctionMetric("φ and ψ", "distribution", "slow", torsion_rows),
    FunctionMetric("φ and ψ without frames that guards changed", "distribution", "slow", intervention_rows),
    FunctionMetric("Other torsions", "distribution", "slow", other_torsion_rows),
    FunctionMetric("Torsions within the states of slower ones", "distribution", "within states", within_rows),
    FunctionMetric("Size and shape", "distribution", "slow", shape_rows),
    FunctionMetric("Secondary structure", "distribution", "slow", secondary_structure),
    FunctionMetric("Contacts", "distribution", "slow", contact_rows),
    FunctionMetric("Hydrogen bonds", "distribution", "slow", hydrogen_bond_rows),
    FunctionMetric("Relaxation of torsions", "kinetics", "slow", correlation_rows),
    FunctionMetric("TIC 0", "kinetics", "slow", tica_rows),
    FunctionMetric("Markov state model", "kinetics", "slow", msm_rows),
    FunctionMetric("Steps from frame to frame", "kinetics", "step", step_rows),
    FunctionMetric("Steps across chunk boundaries", "kinetics", "fast", boundary_row),
    FunctionMetric("The peptide papers' recipe", "information", "slow", peptide_charts),
    FunctionMetric("Forecast error", "information", "fast", forecast_charts),
    FunctionMetric("RMSD and torsions along time", "information", "slow", along_time),
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
