"""The verbs `bench` and `stress`: parsing and printing; what they do are functions of `surrogate.bench`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogate.bench.cost_error.sweep_settings import CostErrorOptions
from surrogate.bench.speed_options import SpeedOptions
from surrogate.bench.stress.stress_options import StressOptions
from surrogate.cli.parameters import JsonOpt, with_options
from surrogate.cli.render import print_json

if TYPE_CHECKING:
    from surrogate.bench.md_speed import Row

bench = typer.Typer(
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Benchmarks on this machine.",
)


@bench.callback()
def _benchmarks() -> None:
    """Keep `bench` a group, however many benchmarks it has."""


@bench.command()
@with_options
def reference(
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output file (.json).")] = None,
    *,
    options: SpeedOptions,
    as_json: JsonOpt = False,
) -> None:
    """Our OpenMM set-up against OpenMM's plain defaults: same model, time step and cores. Wants an idle machine."""
    from surrogate.bench.md_speed import run_benchmark, select_cases, table_head, table_line, write_json

    cases = select_cases(options.cases, quick=options.quick)
    shown = not (options.quiet or as_json)

    def report(row: Row) -> None:
        if shown:
            typer.echo(table_line(row))

    if shown:
        typer.echo("ns/day of all cores together; ratio: ours over the faster of OpenMM's two ways, [least, greatest]")
        typer.echo(table_head())
    result = run_benchmark(
        cases,
        rounds=options.rounds or (3 if options.quick else 7),
        seconds=options.timing_s or (0.3 if options.quick else 3.0),
        cores=options.cores,
        report=report,
        skipped=lambda line: typer.echo(f"left out: {line}", err=True),
    )
    if out is not None:
        write_json(result, out)
    if as_json:
        print_json(result)
    if not result["rows"] or not all(row["equal_energies"] for row in result["rows"]):
        typer.echo("error: no case ran, or energies differ: see above.", err=True)
        raise typer.Exit(1)


@bench.command(name="cost-error")
@with_options
def cost_error(
    reference: Annotated[str, typer.Argument(metavar="REFERENCE", help="Held-out reference: a file, folder or glob.")],
    replicate: Annotated[str, typer.Argument(metavar="REPLICATE", help="Independent reference of the same length.")],
    weights: Annotated[
        list[str], typer.Option("--weights", "-w", help="Weights by name or .safetensors file; repeatable.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Output folder.")] = Path("cost-error"),
    *,
    options: CostErrorOptions,
    as_json: JsonOpt = False,
) -> None:
    """Run time against error of a surrogate at many settings, beside OpenMM, on one core. Goes on where it stopped.

    REFERENCE and REPLICATE: two runs that the weights were not trained on.
    """
    from surrogate.bench.cost_error.cost_page import markdown
    from surrogate.bench.cost_error.sweep import cost_error as run

    quiet = options.quiet or as_json
    result = run(
        reference,
        replicate,
        weights,
        out,
        options,
        report=lambda line: None if quiet else typer.echo(f"running: {line}", err=True),
    )
    if as_json:
        print_json(result)
    elif not quiet:
        typer.echo(markdown(result))
        typer.echo(f"{out}: cost_error.json, cost_error.md, cost_error.svg")


@with_options
def stress(
    weights: Annotated[str, typer.Argument(metavar="WEIGHTS", help="Name of shipped weights, or a .safetensors file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Output folder.")] = Path("surromd-stress"),
    *,
    options: StressOptions,
    as_json: JsonOpt = False,
) -> None:
    """How WEIGHTS stand long rollouts, odd inputs, other arithmetic and settings, beside OpenMM itself."""
    from surrogate.bench.stress.trials import choose_config, stress_weights

    quiet = options.quiet or as_json
    result = stress_weights(
        weights,
        out,
        choose_config(options),
        scene=options.scene,
        report=lambda name: None if quiet else typer.echo(f"running: {name}", err=True),
    )
    if as_json:
        print_json(result)
    elif not quiet:
        from surrogate.bench.stress.stress_page import markdown

        typer.echo(markdown(result))
        typer.echo(f"{out}: stress.json, stress.md, stress.svg")
