"""The verb `reproduce`: parsing and printing; what it does is `surrogate.bench.reproduce.n_body`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogate.cli.parameters import JsonOpt, QuietOpt, ResumeOpt, SeedOpt, literal
from surrogate.cli.render import print_json
from systems.errors import InputError
from systems.units import parse_time_ps, parse_wall_s

_SIZE = {"min": 2, "help": "Trajectories (md17: windows of each molecule), instead of the published number."}


def reproduce(
    name: Annotated[str, typer.Argument(metavar="NAME", help="n-body-charged, n-body-spring, n-body-gravity or md17.")],
    budget: Annotated[str, typer.Option("--budget", help="Wall time of each method's training.")] = "10min",
    method: Annotated[
        list[str] | None,
        typer.Option("--method", help="Only this; may be repeated. Baselines, egnn, lam-slide, pair-forces (n-body)."),
    ] = None,
    train: Annotated[int | None, typer.Option("--train", **_SIZE)] = None,
    test: Annotated[int | None, typer.Option("--test", **_SIZE)] = None,
    validation: Annotated[
        int | None,
        typer.Option("--validation", min=2, help=literal("The same. [default: a tenth of --test; md17: as --test]")),
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="Leave out what goes beyond the papers; the same as every --without.")
    ] = False,
    without: Annotated[
        list[str] | None,
        typer.Option(
            "--without",
            help="Leave out: extrapolate, any-start, from-velocity, canonical, predicted-only. Repeatable.",
        ),
    ] = None,
    clean_conditioning: Annotated[
        bool, typer.Option("--clean-conditioning", help="md17: LaM-SLidE computes given frames once a chunk.")
    ] = False,
    molecule: Annotated[
        list[str] | None,
        typer.Option("--molecule", help=literal("md17: only this; may be repeated. [default: all eight]")),
    ] = None,
    simulated: Annotated[str, typer.Option("--time", help="md17: trajectory of each molecule.")] = "200ps",
    md17_ethanol: Annotated[
        Path | None, typer.Option("--md17-ethanol", help="md17: an .npz of MD17's own ethanol to forecast as well.")
    ] = None,
    steps: Annotated[int | None, typer.Option("--steps", min=1, help="Optimiser steps instead of a budget.")] = None,
    solver_steps: Annotated[
        int,
        typer.Option("--solver-steps", min=1, help="LaM-SLidE's; 1 gives its mean forecast instead of samples."),
    ] = 10,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="n-body: processes that simulate; one a core.")
    ] = None,
    device: Annotated[str, typer.Option("--device", help="Where to train: auto, cpu or cuda.")] = "auto",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help=literal("Folder of data and results. [default: surromd-NAME]"))
    ] = None,
    seed: SeedOpt = 0,
    resume: ResumeOpt = False,
    quiet: QuietOpt = False,
    as_json: JsonOpt = False,
) -> None:
    """Repeat a published forecasting task: make its data, train, and put our errors under the published ones."""
    from surrogate.bench.reproduce import md17 as molecules
    from surrogate.bench.reproduce import n_body as bodies
    from surrogate.bench.reproduce.forecast_methods import SWITCHES, Settings, without_switches
    from surrogate.bench.reproduce.md17_data import MD17_MOLECULES
    from surrogate.bench.reproduce.md17_methods import METHODS as MOLECULE_METHODS
    from surrogate.bench.reproduce.n_body_methods import METHODS
    from surrogate.progress import progress_bar
    from surrogate.training.devices import choose_device

    of_molecules = name == molecules.NAME
    chosen = method or list(MOLECULE_METHODS if of_molecules else METHODS)
    chosen_molecules = molecule or list(MD17_MOLECULES)
    if of_molecules:
        molecules.check_names(chosen_molecules, chosen)
    else:
        bodies.check_names(name, chosen)
    folder = out or Path(f"surromd-{name}")
    settings = Settings(
        folder=folder,
        budget_s=None if steps is not None else parse_wall_s(budget, "--budget"),
        steps=steps,
        seed=seed,
        resume=resume,
        device=choose_device(device),
        solver_steps=solver_steps,
        clean_conditioning=clean_conditioning,
    )
    if clean_conditioning and not of_molecules:
        raise InputError(f"--clean-conditioning: {name} does not know it; leave it out.")
    settings = without_switches(settings, SWITCHES if plain else without or [])
    shown = not (quiet or as_json)

    def say(line: str) -> None:
        if shown:
            typer.echo(line, err=True)

    with progress_bar(f"data of {name}", quiet=not shown) as advance:
        if of_molecules:
            asked = {"train": train, "validation": validation or test, "test": test}
            found = molecules.reproduce_molecules(
                settings,
                molecules=chosen_molecules,
                methods=chosen,
                time_ps=parse_time_ps(simulated, "--time"),
                windows={split: asked[split] or n for split, n in molecules.WINDOWS.items()},
                md17_ethanol=md17_ethanol,
                progress=advance,
                report=lambda account: say(molecules.account_line(account)),
            )
            lines, record = molecules.table_lines(found), found.to_dict()
        else:
            result = bodies.reproduce(
                name,
                settings,
                methods=chosen,
                sizes={
                    "train": train or bodies.SIZES["train"],
                    "validation": validation or max(2, (test or bodies.SIZES["test"]) // 10),
                    "test": test or bodies.SIZES["test"],
                },
                workers=workers,
                progress=advance,
                report=lambda row: say(bodies.row_line(row)),
            )
            lines, record = bodies.table_lines(result), result.to_dict()
    if as_json:
        print_json(record)
    else:
        typer.echo("\n".join(lines))
