"""The verb `reproduce`: parsing and printing; what it does is `surrogate.bench.reproduce`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogate.cli_options import JsonOpt, QuietOpt, ResumeOpt, SeedOpt
from surrogate.cli_printing import print_json
from systems.units import parse_wall_s

if TYPE_CHECKING:
    from surrogate.bench.reproduce import Row

_SIZE = {"min": 2, "help": "Trajectories, instead of the published number."}


def reproduce(
    name: Annotated[str, typer.Argument(metavar="NAME", help="n-body-charged, n-body-spring or n-body-gravity.")],
    budget: Annotated[str, typer.Option("--budget", help="Wall time of each method's training.")] = "10min",
    method: Annotated[
        list[str] | None,
        typer.Option("--method", help="Only this; may be repeated. Baselines, egnn, lam-slide, pair-forces."),
    ] = None,
    train: Annotated[int, typer.Option("--train", **_SIZE)] = 3000,
    test: Annotated[int, typer.Option("--test", **_SIZE)] = 2000,
    validation: Annotated[
        int | None, typer.Option("--validation", min=2, help="Trajectories. [default: a tenth of --test]")
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="Leave out what goes beyond the papers: extrapolation, other starts.")
    ] = False,
    steps: Annotated[int | None, typer.Option("--steps", min=1, help="Optimiser steps instead of a budget.")] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Processes that simulate; one a core.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder of data and results. [default: surromd-NAME]")
    ] = None,
    seed: SeedOpt = 0,
    resume: ResumeOpt = False,
    quiet: QuietOpt = False,
    as_json: JsonOpt = False,
) -> None:
    """Repeat a published forecasting task: make its data, train, and put our errors under the published ones."""
    from surrogate.bench.reproduce import check_names, row_line, table_lines
    from surrogate.bench.reproduce import reproduce as run
    from surrogate.bench.reproduce_methods import METHODS, Settings
    from surrogate.progress import progress_bar

    chosen = method or list(METHODS)
    check_names(name, chosen)
    folder = out or Path(f"surromd-{name}")
    settings = Settings(
        folder=folder,
        budget_s=None if steps is not None else parse_wall_s(budget, "--budget"),
        steps=steps,
        seed=seed,
        resume=resume,
        extrapolate=not plain,
        any_start=not plain,
        from_velocity=not plain,
    )
    shown = not (quiet or as_json)

    def report(row: Row) -> None:
        if shown:
            typer.echo(row_line(row), err=True)

    with progress_bar(f"data of {name}", quiet=not shown) as advance:
        result = run(
            name,
            folder,
            methods=chosen,
            settings=settings,
            n_train=train,
            n_validation=validation,
            n_test=test,
            workers=workers,
            progress=advance,
            report=report,
        )
    if as_json:
        print_json(result.to_dict())
    else:
        typer.echo("\n".join(table_lines(result)))
