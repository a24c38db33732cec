"""The verbs `bench` and `stress`: parsing and printing; what they do are functions of `surrogate.bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogate.bench.cost_error.sweep_settings import CostErrorOptions
from surrogate.bench.stress.stress_options import StressOptions
from surrogate.cli.parameters import JsonOpt, with_options
from surrogate.cli.render import print_json

bench = typer.Typer(
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Benchmarks on this machine.",
)


@bench.callback()
def _benchmarks() -> None:
    """Keep `bench` a group, however many benchmarks it has."""


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
    """Stress-test WEIGHTS: long rollouts, unusual inputs, precision, solvers, beside OpenMM."""
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
