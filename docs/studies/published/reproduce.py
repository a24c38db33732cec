"""Repeat a published forecasting task: make its data, train, and put our errors under the published ones.

    python docs/studies/published/reproduce.py n-body-charged [--method lam-slide] [-o FOLDER]
    python docs/studies/published/reproduce.py md17 [--molecule ethanol] [--budget 8min]

Tasks: n-body-charged, n-body-spring, n-body-gravity (`n_body`) and md17. Data and finished trainings in FOLDER stay;
with --resume an interrupted training goes on. The manual's page: docs/results/published_tasks.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import forecaster_training
import md17
import n_body
from forecast_methods import SWITCHES, Settings, without_switches
from md17_data import MD17_MOLECULES
from md17_methods import METHODS as MOLECULE_METHODS
from n_body_methods import METHODS

from surrogate.progress import progress_bar
from surrogate.training.devices import choose_device
from systems.errors import InputError, SurromdError
from systems.units import parse_time_ps, parse_wall_s


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = _parser().parse_args(arguments)
    try:
        lines = run(chosen)
    except SurromdError as error:
        sys.exit(f"error: {error}")
    print("\n".join(lines))  # noqa: T201


def run(chosen: argparse.Namespace) -> list[str]:
    """Run the task that was asked for; return its table. Raises SurromdError."""
    of_molecules = chosen.task == md17.NAME
    methods = chosen.method or list(MOLECULE_METHODS if of_molecules else METHODS)
    molecules = chosen.molecule or list(MD17_MOLECULES)
    if of_molecules:
        md17.check_names(molecules, methods)
    else:
        n_body.check_names(chosen.task, methods)
        if chosen.clean_conditioning:
            raise InputError(f"--clean-conditioning: {chosen.task} does not know it; leave it out.")
    settings = _settings(chosen, of_molecules)
    with progress_bar(f"data of {chosen.task}", quiet=chosen.quiet) as advance:
        how: dict[str, Any] = {"methods": methods, "progress": advance}
        if of_molecules:
            asked = {"train": chosen.train, "validation": chosen.validation or chosen.test, "test": chosen.test}
            found = md17.reproduce_molecules(
                settings,
                molecules=molecules,
                time_ps=parse_time_ps(chosen.time, "--time"),
                windows={split: asked[split] or n for split, n in md17.WINDOWS.items()},
                md17_ethanol=chosen.md17_ethanol,
                report=lambda summary: _say(chosen, md17.summary_line(summary)),
                **how,
            )
            return md17.table_lines(found)
        n_test = chosen.test or n_body.SIZES["test"]
        sizes = {
            "train": chosen.train or n_body.SIZES["train"],
            "validation": chosen.validation or max(2, n_test // 10),
            "test": n_test,
        }
        report = lambda row: _say(chosen, n_body.row_line(row))  # noqa: E731
        return n_body.table_lines(
            n_body.reproduce(chosen.task, settings, sizes=sizes, workers=chosen.workers, report=report, **how)
        )


def _settings(chosen: argparse.Namespace, of_molecules: bool) -> Settings:
    steps = chosen.steps
    if (chosen.paper_size or chosen.paper_form) and not of_molecules and steps is None:
        steps = forecaster_training.PAPER_STEPS
    budget = chosen.budget or ("10min" if steps is None else None)
    settings = Settings(
        folder=chosen.out or Path(f"surromd-{chosen.task}"),
        budget_s=None if budget is None else parse_wall_s(budget, "--budget"),
        steps=steps,
        call_s=None if chosen.call is None else parse_wall_s(chosen.call, "--call"),
        paper_size=chosen.paper_size,
        paper_form=chosen.paper_form,
        seed=chosen.seed,
        resume=chosen.resume,
        device=choose_device(chosen.device),
        solver_steps=chosen.solver_steps,
        clean_conditioning=chosen.clean_conditioning,
    )
    return without_switches(settings, SWITCHES if chosen.plain else chosen.without or [])


def _say(chosen: argparse.Namespace, line: str) -> None:
    if not chosen.quiet:
        print(line, file=sys.stderr)  # noqa: T201


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("task", help="n-body-charged, n-body-spring, n-body-gravity or md17")
    add("-o", "--out", type=Path, help="folder of data and results [surromd-TASK]")
    add("--budget", help="wall time of each method's training [10min; none where steps are given]")
    add("--steps", type=int, help="optimiser steps, at most as many as the budget allows")
    add("--method", action="append", help="only this; may be repeated")
    add("--train", type=int, help="trajectories (md17: windows of each molecule) instead of the published number")
    add("--validation", type=int, help="the same [a tenth of the test's; md17: as the test's]")
    add("--test", type=int, help="the same")
    add("--plain", action="store_true", help="leave out what goes beyond the papers: all that can be left out")
    add("--without", action="append", help=f"leave this out: {', '.join(SWITCHES)}; may be repeated")
    add("--clean-conditioning", action="store_true", help="md17: LaM-SLidE computes given frames once a chunk")
    add("--molecule", action="append", help="md17: only this; may be repeated")
    add("--time", default="200ps", help="md17: trajectory of each molecule")
    add("--md17-ethanol", type=Path, help="md17: an .npz of MD17's own ethanol to forecast as well")
    add("--call", help="end at the first saved state after so long; the same with --resume goes on")
    add("--paper-size", action="store_true", help="LaM-SLidE of the published sizes (n-body: and epochs), for a GPU")
    add("--paper-form", action="store_true", help="n-body: LaM-SLidE as published but for 8 latents and width 128")
    add("--solver-steps", type=int, default=10, help="LaM-SLidE's; 1 gives its mean forecast instead of samples")
    add("--workers", type=int, help="n-body: processes that simulate [one a core]")
    add("--device", default="auto", help="where to train: auto, cpu or cuda")
    add("--seed", type=int, default=0)
    add("--resume", action="store_true", help="go on with trainings that were interrupted")
    add("--quiet", action="store_true", help="print the table alone")
    return parser


if __name__ == "__main__":
    main()
