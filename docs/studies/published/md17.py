"""The eight molecules of MD17 at 500 K, ten frames of 5 fs given, twenty to forecast.

The protocol is GeoTDM's (Han 2024) and LaM-SLidE's (section 4.4), the trajectories are ours (GAFF2 by OpenMM, for
MD17's PBE), so the published rows are for orientation. With a file of MD17's own ethanol, what was learned on ours
forecasts that too: out of distribution.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from forecast_errors import Estimate, block_means, estimate
from forecast_methods import (
    N_GIVEN,
    N_NEW,
    N_SAMPLES,
    Array,
    MethodSummary,
    Settings,
    check_known,
    measured,
)
from md17_data import MD17_MOLECULES, make_trajectories, read_md17_ethanol, read_windows
from md17_methods import METHODS
from published import PUBLISHED_MD17

from systems.files.whole_file import create_whole

if TYPE_CHECKING:
    from molecule_windows import MoleculeWindows

    from surrogate.progress import ProgressFn

NAME = "md17"
# The protocol's windows of each molecule; they overlap heavily.
WINDOWS = {"train": 5000, "validation": 1000, "test": 1000}
_A_PER_NM = 10.0


@dataclass(frozen=True)
class MoleculeRow:
    """One method on one molecule: errors in Å with intervals over independent stretches of the test part."""

    method: str
    molecule: str
    ade: Estimate
    fde: Estimate
    n_windows: int
    n_independent: int

    def to_dict(self) -> dict[str, Any]:
        return vars(self) | {"ade": self.ade.to_dict(), "fde": self.fde.to_dict()}


@dataclass(frozen=True)
class MoleculeReproduction:
    """All rows, by method and molecule, and what each method cost; `time_ps` of trajectory of each molecule."""

    rows: tuple[MoleculeRow, ...]
    summaries: tuple[MethodSummary, ...]
    time_ps: float
    budget_s: float | None
    seed: int

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values, the published rows too."""
        return {
            "name": NAME,
            "unit": "angstrom",
            "time_ps": self.time_ps,
            "budget_s": self.budget_s,
            "seed": self.seed,
            "samples": N_SAMPLES,
            "published": PUBLISHED_MD17,
            "rows": [row.to_dict() for row in self.rows],
            "methods": [vars(summary) for summary in self.summaries],
        }


def check_names(molecules: Sequence[str], methods: Sequence[str]) -> None:
    """Raise UnknownNameError for a molecule or a method that is not known, naming the nearest."""
    check_known(molecule=(molecules, MD17_MOLECULES), method=(methods, METHODS))


def reproduce_molecules(
    settings: Settings,
    *,
    molecules: Sequence[str] = MD17_MOLECULES,
    methods: Sequence[str] = tuple(METHODS),
    time_ps: float = 200.0,
    windows: dict[str, int] | None = None,
    md17_ethanol: Path | None = None,
    progress: ProgressFn | None = None,
    report: Callable[[MethodSummary], None] | None = None,
) -> MoleculeReproduction:
    """Make the trajectories in `settings.folder`, fit each method to all molecules, forecast each; what is there stays.

    `windows` of each molecule by split, the protocol's when not given. Writes md17.json. Raises UnknownNameError, and
    InputError for files of other settings or trajectories that are too short.
    """
    check_names(molecules, methods)
    paths = make_trajectories(molecules, settings.folder, time_ps=time_ps, seed=settings.seed, progress=progress)
    span, counts = N_GIVEN + N_NEW, windows or WINDOWS
    learned = [read_windows(path, counts, span) for path in paths.values()]
    tested = [*learned, *([read_md17_ethanol(md17_ethanol, span)] if md17_ethanol and "ethanol" in molecules else [])]
    tests = [(m, m.windows(m.starts["test"])) for m in tested]
    rows: list[MoleculeRow] = []
    summaries: list[MethodSummary] = []
    for method in dict.fromkeys(methods):
        summary, errors = measured(method, partial(METHODS[method], learned, settings), tests)
        rows += [_row(method, m, *found) for m, found in zip(tested, errors, strict=True)]
        summaries.append(summary)
        if report is not None:
            report(summaries[-1])
    result = MoleculeReproduction(tuple(rows), tuple(summaries), time_ps, settings.budget_s, settings.seed)
    create_whole(settings.folder / f"{NAME}.json", json.dumps(result.to_dict(), indent=1))
    return result


def _row(method: str, m: MoleculeWindows, *errors_nm: Array) -> MoleculeRow:
    ade, fde = (_estimate(_A_PER_NM * errors, m.blocks["test"]) for errors in errors_nm)
    return MoleculeRow(method, m.label, ade, fde, len(errors_nm[0]), m.n_independent("test"))


def _estimate(errors: Array, blocks: np.ndarray[Any, np.dtype[np.int64]]) -> Estimate:
    """The mean over windows, its interval from independent stretches drawn again."""
    spread = estimate(block_means(errors, blocks))
    shift = float(errors.mean()) - spread.value
    return Estimate(float(errors.mean()), spread.low + shift, spread.high + shift)


def table_lines(result: MoleculeReproduction) -> list[str]:
    """Return one table a molecule: published rows, then ours with 95 % intervals."""
    lines = [
        f"MD17 protocol: ADE and FDE in Å, {N_GIVEN} frames given, {N_NEW} predicted, mean of {N_SAMPLES} samples",
        f"ours: {result.time_ps:g} ps of each molecule (GAFF2, 500 K); published: MD17 itself, for orientation",
    ]
    for molecule in dict.fromkeys(row.molecule for row in result.rows):
        ours = [row for row in result.rows if row.molecule == molecule]
        lines.append(f"{molecule}: {ours[0].n_windows:,} test windows, {ours[0].n_independent} independent at best")
        published = PUBLISHED_MD17.get(molecule.removesuffix(" (MD17)"), {})
        lines += [f"  {method + ', published':<30}{ade:>9.3f} {fde:>28.3f}" for method, (ade, fde) in published.items()]
        lines += [f"  {row.method:<30}{row.ade!s:>27} {row.fde!s:>27}" for row in ours]
    return [*lines, "methods", *(summary_line(summary) for summary in result.summaries)]


def summary_line(summary: MethodSummary) -> str:
    """Return one line about a method."""
    cost = (
        f"{summary.n_parameters:,} parameters, {summary.training_s:.0f} s of training; " if summary.n_parameters else ""
    )
    return f"  {summary.method:<18}{cost}forecasts {summary.forecast_s:.1f} s; {summary.note}"
