"""The verb `reproduce`: parsing and printing; what it does is `surrogate.bench.reproduce.n_body`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogate.bench.reproduce.reproduce_options import ReproduceOptions
from surrogate.cli.parameters import JsonOpt, literal, with_options
from surrogate.cli.render import print_json
from systems.errors import InputError


@with_options
def reproduce(
    name: Annotated[str, typer.Argument(metavar="NAME", help="n-body-charged, n-body-spring, n-body-gravity or md17.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help=literal("Folder of data and results. [default: surromd-NAME]"))
    ] = None,
    *,
    options: ReproduceOptions,
    as_json: JsonOpt = False,
) -> None:
    """Repeat a published forecasting task: make its data, train, and put our errors under the published ones."""
    from surrogate.bench.reproduce import md17 as molecules
    from surrogate.bench.reproduce import n_body as bodies
    from surrogate.bench.reproduce.forecast_methods import SWITCHES, Settings, without_switches
    from surrogate.bench.reproduce.md17_data import MD17_MOLECULES
    from surrogate.bench.reproduce.md17_methods import METHODS as MOLECULE_METHODS
    from surrogate.bench.reproduce.n_body_methods import METHODS
    from surrogate.models.particles.trainer import PAPER_STEPS
    from surrogate.progress import progress_bar
    from surrogate.training.devices import choose_device

    of_molecules = name == molecules.NAME
    chosen = list(options.methods or (MOLECULE_METHODS if of_molecules else METHODS))
    chosen_molecules = list(options.molecules or MD17_MOLECULES)
    if of_molecules:
        molecules.check_names(chosen_molecules, chosen)
    else:
        bodies.check_names(name, chosen)
    folder = out or Path(f"surromd-{name}")
    steps = options.steps
    if options.paper_size and not of_molecules and steps is None:
        steps = PAPER_STEPS
    settings = Settings(
        folder=folder,
        budget_s=None if steps is not None else options.budget_s,
        steps=steps,
        call_s=options.call_s,
        paper_size=options.paper_size,
        seed=options.seed,
        resume=options.resume,
        device=choose_device(options.device),
        solver_steps=options.solver_steps,
        clean_conditioning=options.clean_conditioning,
    )
    if options.clean_conditioning and not of_molecules:
        raise InputError(f"`clean_conditioning`: {name} does not know it; leave it out.")
    settings = without_switches(settings, SWITCHES if options.plain else options.without or [])
    shown = not (options.quiet or as_json)

    def say(line: str) -> None:
        if shown:
            typer.echo(line, err=True)

    test = options.n_test
    with progress_bar(f"data of {name}", quiet=not shown) as advance:
        if of_molecules:
            asked = {"train": options.n_train, "validation": options.n_validation or test, "test": test}
            found = molecules.reproduce_molecules(
                settings,
                molecules=chosen_molecules,
                methods=chosen,
                time_ps=options.time_ps,
                windows={split: asked[split] or n for split, n in molecules.WINDOWS.items()},
                md17_ethanol=options.md17_ethanol,
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
                    "train": options.n_train or bodies.SIZES["train"],
                    "validation": options.n_validation or max(2, (test or bodies.SIZES["test"]) // 10),
                    "test": test or bodies.SIZES["test"],
                },
                workers=options.workers,
                progress=advance,
                report=lambda row: say(bodies.row_line(row)),
            )
            lines, record = bodies.table_lines(result), result.to_dict()
    if as_json:
        print_json(record)
    else:
        typer.echo("\n".join(lines))
