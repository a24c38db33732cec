"""`surromd reproduce NAME`: makes the data, trains, evaluates by the papers' definition, puts our rows under theirs."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.bench.reproduce.forecast_errors import Estimate, estimate, forecast_errors, ratio
from surrogate.bench.reproduce.forecast_methods import METHODS, N_GIVEN, N_SAMPLES, Array, Settings
from surrogate.bench.reproduce.published import PUBLISHED
from systems.errors import InputError, UnknownNameError, nearest
from systems.files.whole_file import create_whole

if TYPE_CHECKING:
    from surrogate.data.particle_sets import ParticleSet
    from surrogate.progress import ProgressFn

# The published sizes: training, validation and test trajectories (LaM-SLidE, section 4.3; GeoTDM).
N_TRAIN, N_VALIDATION, N_TEST = 3000, 2000, 2000
# The method whose published row proves the data alike.
_OUR_ANCHOR = "egnn"


@dataclass(frozen=True)
class Row:
    """One of our methods: errors over the test trajectories in the table's unit, the median of ADE (a few close
    encounters carry the mean), ADE over our EGNN's, and what it cost."""

    method: str
    ade: Estimate
    fde: Estimate
    median_ade: float
    over_egnn: Estimate | None
    n_parameters: int
    training_s: float
    cpu_s: float
    forecast_s: float
    note: str

    def to_dict(self) -> dict[str, Any]:
        record = dict(vars(self))
        for key in ("ade", "fde", "over_egnn"):
            record[key] = None if record[key] is None else record[key].to_dict()
        return record


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
            "published_sizes": {"train": N_TRAIN, "validation": N_VALIDATION, "test": N_TEST},
            "budget_s": self.budget_s,
            "seed": self.seed,
            "samples": N_SAMPLES,
            "published": published,
            "rows": [row.to_dict() for row in self.rows],
        }


def check_names(name: str, methods: Sequence[str]) -> None:
    """Raise UnknownNameError for a task or a method that is not known, naming the nearest."""
    for kind, asked, known in (("task", [name], list(PUBLISHED)), ("method", list(methods), list(METHODS))):
        for one in asked:
            if one not in known:
                raise UnknownNameError(f"unknown {kind} {one!r}; known: {', '.join(known)}.{nearest(one, known)}")


def reproduce(
    name: str,
    folder: Path,
    *,
    methods: Sequence[str] = tuple(METHODS),
    settings: Settings,
    n_train: int = N_TRAIN,
    n_validation: int | None = None,
    n_test: int = N_TEST,
    workers: int | None = None,
    progress: ProgressFn | None = None,
    report: Callable[[Row], None] | None = None,
) -> Reproduction:
    """Run one task in `folder`: data in NAME.h5 (what is there is kept), training states and curves, NAME.json.

    `n_validation` is a tenth of `n_test` when not given: the published protocol names 2,000 and uses them for early
    stopping, here they choose the polynomial and draw the curve of training. Raises UnknownNameError for
    unknown names and InputError for sizes below 2, for a folder with other data, and for splits that overlap.
    """
    from surrogate.bench.reproduce.n_body_data import SEED_STRIDE, make_sets
    from surrogate.data.particle_sets import check_disjoint, read_set

    check_names(name, methods)
    sizes = {"train": n_train, "validation": n_validation or max(2, n_test // 10), "test": n_test}
    for split, n in sizes.items():
        if not 2 <= n <= SEED_STRIDE:
            raise InputError(f"{n} {split} trajectories; between 2 and {SEED_STRIDE} can be made.")
    path = folder / f"{name}.h5"
    make_sets(name, path, sizes, workers=workers, progress=progress)
    train, validation, test = (read_set(path, split, n) for split, n in sizes.items())
    check_disjoint([train, validation, test])
    rows: list[Row] = []
    anchor: Array | None = None
    # EGNN first: the others' rows are given relative to it.
    for method in sorted(dict.fromkeys(methods), key=lambda m: m != _OUR_ANCHOR):
        row, ades = _measure(method, train, validation, test, settings, anchor)
        anchor = ades if method == _OUR_ANCHOR else anchor
        rows.append(row)
        if report is not None:
            report(row)
    result = Reproduction(name, tuple(rows), sizes, settings.budget_s, settings.seed)
    create_whole(folder / f"{name}.json", json.dumps(result.to_dict(), indent=1))
    return result


def _measure(
    method: str,
    train: ParticleSet,
    validation: ParticleSet,
    test: ParticleSet,
    settings: Settings,
    anchor: Array | None,
) -> tuple[Row, Array]:
    cpu = time.process_time()
    fitted = METHODS[method](train, validation, settings)
    cpu, began = time.process_time() - cpu, time.perf_counter()
    predicted = fitted.forecast(test, N_SAMPLES)
    took = time.perf_counter() - began
    ade, fde = forecast_errors(predicted, test.positions_nm[:, N_GIVEN:])
    anchor = ade if method == _OUR_ANCHOR else anchor
    over = None if anchor is None else ratio(ade, anchor)
    row = Row(method, estimate(ade), estimate(fde), float(np.median(ade)), over, fitted.n_parameters,
              round(fitted.seconds, 1), round(cpu, 1), round(took, 2), fitted.note)  # fmt: skip
    return row, ade


def table_lines(result: Reproduction) -> list[str]:
    """Return the table: published rows, then ours with 95 % intervals over the test trajectories."""
    sizes = " / ".join(f"{n:,}" for n in result.sizes.values())
    lines = [
        f"{result.name}: ADE and FDE, {N_GIVEN} frames given, 20 predicted, mean of {N_SAMPLES} samples; "
        f"{sizes} training / validation / test trajectories",
        f"{'':<18} {'ADE':>24} {'FDE':>24} {'median':>8} {'ADE/our EGNN':>20} {'training':>9}",
        "published (3,000 / 2,000 / 2,000)",
    ]
    lines += [f"  {method:<18}{ade:>22} {fde:>24}" for method, (ade, fde) in PUBLISHED[result.name].items()]
    return [*lines, "ours", *(row_line(row) for row in result.rows)]


def row_line(row: Row) -> str:
    """Return one of our rows, as it stands in the table."""
    over = "" if row.over_egnn is None else str(row.over_egnn)
    cost = f"{row.training_s:.0f} s" if row.n_parameters else "-"
    figures = f"{row.ade!s:>22} {row.fde!s:>24} {row.median_ade:>#8.3g} {over:>20} {cost:>9}"
    return f"  {row.method:<18}{figures}  {row.note}"
