"""The n-body tasks: data, methods, and errors by the papers' definition."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from forecast_errors import Estimate, estimate, ratio
from forecast_methods import (
    N_GIVEN,
    N_SAMPLES,
    Array,
    MethodSummary,
    Settings,
    check_known,
    measured,
)
from n_body_methods import METHODS
from published import PUBLISHED

from systems.errors import InputError
from systems.files.whole_file import create_whole

if TYPE_CHECKING:
    from surrogate.progress import ProgressFn

# The published sizes: trajectories of each split (LaM-SLidE, section 4.3; GeoTDM). Theirs of validation stop trainings
# early; ours choose the polynomial and draw the curve of training, and are a tenth of those of test.
PUBLISHED_SIZES = {"train": 3000, "validation": 2000, "test": 2000}
SIZES = PUBLISHED_SIZES | {"validation": 200}
# The method whose published row proves the data alike.
_OUR_ANCHOR = "egnn"


@dataclass(frozen=True)
class Row:
    """One of our methods: errors over the test trajectories in the table's unit, the median of ADE (a few close
    encounters carry the mean), ADE over our EGNN's, and what it cost."""

    ade: Estimate
    fde: Estimate
    median_ade: float
    over_egnn: Estimate | None
    summary: MethodSummary

    @property
    def method(self) -> str:
        return self.summary.method

    def to_dict(self) -> dict[str, Any]:
        errors = {"ade": self.ade.to_dict(), "fde": self.fde.to_dict(), "median_ade": self.median_ade}
        over = None if self.over_egnn is None else self.over_egnn.to_dict()
        return {**errors, "over_egnn": over, **vars(self.summary)}


@dataclass(frozen=True)
class Reproduction:
    """Our rows on one task, with the sizes of the sets they were measured on."""

    name: str
    rows: tuple[Row, ...]
    sizes: dict[str, int]
    budget_s: float | None
    seed: int

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values, the published rows too."""
        published = {method: {"ade": ade, "fde": fde} for method, (ade, fde) in PUBLISHED[self.name].items()}
        return {
            "name": self.name,
            "sizes": self.sizes,
            "published_sizes": PUBLISHED_SIZES,
            "budget_s": self.budget_s,
            "seed": self.seed,
            "samples": N_SAMPLES,
            "published": published,
            "rows": [row.to_dict() for row in self.rows],
        }


def check_names(name: str, methods: Sequence[str]) -> None:
    """Raise UnknownNameError for a task or a method that is not known, naming the nearest."""
    check_known(task=([name], PUBLISHED), method=(methods, METHODS))


def reproduce(
    name: str,
    settings: Settings,
    *,
    methods: Sequence[str] = tuple(METHODS),
    sizes: Mapping[str, int] = SIZES,
    workers: int | None = None,
    progress: ProgressFn | None = None,
    report: Callable[[Row], None] | None = None,
) -> Reproduction:
    """Run one task in `settings.folder`: data in NAME.h5, training states and curves, NAME.json; what is there stays.

    `sizes`: trajectories of each split, by its name. Raises UnknownNameError for
    unknown names and InputError for sizes below 2, for a folder with other data, and for splits that overlap.
    """
    from n_body_data import SEED_STRIDE, make_sets
    from particle_sets import check_disjoint, read_set

    check_names(name, methods)
    for split, n in sizes.items():
        if not 2 <= n <= SEED_STRIDE:
            raise InputError(f"{n} {split} trajectories; between 2 and {SEED_STRIDE} can be made.")
    path = settings.folder / f"{name}.h5"
    make_sets(name, path, dict(sizes), workers=workers, progress=progress)
    train, validation, test = (read_set(path, split, n) for split, n in sizes.items())
    check_disjoint([train, validation, test])
    rows: list[Row] = []
    anchor: Array | None = None
    # EGNN first: the others' rows are given relative to it.
    for method in sorted(dict.fromkeys(methods), key=lambda m: m != _OUR_ANCHOR):
        fit = partial(METHODS[method], train, validation, settings)
        summary, [(ade, fde)] = measured(method, fit, [(test, test.positions_nm)])
        anchor = ade if method == _OUR_ANCHOR else anchor
        over = None if anchor is None else ratio(ade, anchor)
        rows.append(Row(estimate(ade), estimate(fde), float(np.median(ade)), over, summary))
        if report is not None:
            report(rows[-1])
    result = Reproduction(name, tuple(rows), dict(sizes), settings.budget_s, settings.seed)
    create_whole(settings.folder / f"{name}.json", json.dumps(result.to_dict(), indent=1))
    return result


def table_lines(result: Reproduction) -> list[str]:
    """Return the table: published rows, then ours with 95 % intervals over the test trajectories."""
    sizes = " / ".join(f"{n:,}" for n in result.sizes.values())
    lines = [
        f"{result.name}: ADE and FDE, {N_GIVEN} frames given, 20 predicted, mean of {N_SAMPLES} samples; "
        f"{sizes} training / validation / test trajectories",
        f"{'':<20} {'ADE':>24} {'FDE':>24} {'median':>8} {'ADE/our EGNN':>20} {'training':>9}",
        "published (3,000 / 2,000 / 2,000)",
    ]
    lines += [f"  {method:<20}{ade:>22} {fde:>24}" for method, (ade, fde) in PUBLISHED[result.name].items()]
    return [*lines, "ours", *(row_line(row) for row in result.rows)]


def row_line(row: Row) -> str:
    """Return one of our rows, as it stands in the table."""
    over = "" if row.over_egnn is None else str(row.over_egnn)
    cost = f"{row.summary.training_s:.0f} s" if row.summary.n_parameters else "-"
    figures = f"{row.ade!s:>22} {row.fde!s:>24} {row.median_ade:>#8.3g} {over:>20} {cost:>9}"
    return f"  {row.method:<20}{figures}  {row.summary.note}"
