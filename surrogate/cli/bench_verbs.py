"""The verbs `bench` and `stress`: parsing and printing; what they do are functions of `surrogate.bench`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogate.cli.parameters import JsonOpt, Precision, QuietOpt, SeedOpt
from surrogate.cli.render import print_json
from systems.units import parse_time_ps, parse_wall_s

if TYPE_CHECKING:
    from surrogate.bench.md_speed import Row

bench = typer.Typer(
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Benchmarks: what is fast, and by how much, on this machine.",
)


@bench.callback()
def _benchmarks() -> None:
    """Keep `bench` a group, however many benchmarks it has."""


@bench.command()
def reference(
    quick: Annotated[bool, typer.Option("--quick", help="Three sizes, short timings: a minute or two.")] = False,
    case: Annotated[list[str] | None, typer.Option("--case", help="Only this scene; may be repeated.")] = None,
    rounds: Annotated[
        int | None, typer.Option("--rounds", min=1, help="How often each is timed: 7; 3 if quick.")
    ] = None,
    seconds: Annotated[str | None, typer.Option("--seconds", help="Of each timing: 3s; 0.3s if quick.")] = None,
    cores: Annotated[int | None, typer.Option("--cores", min=1, help="Cores to use; all.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the result here, .json.")] = None,
    quiet: QuietOpt = False,
    as_json: JsonOpt = False,
) -> None:
    """Our OpenMM set-up against OpenMM's plain defaults: same model, time step and cores. Wants an idle machine."""
    from surrogate.bench.md_speed import run_benchmark, select_cases, table_head, table_line, write_json

    cases = select_cases(case, quick=quick)
    shown = not (quiet or as_json)

    def report(row: Row) -> None:
        if shown:
            typer.echo(table_line(row))

    if shown:
        typer.echo("ns/day of all cores together; ratio: ours over the faster of OpenMM's two ways, [least, greatest]")
        typer.echo(table_head())
    result = run_benchmark(
        cases,
        rounds=rounds or (3 if quick else 7),
        seconds=parse_wall_s(seconds, "--seconds") if seconds is not None else (0.3 if quick else 3.0),
        cores=cores,
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
def cost_error(
    reference: Annotated[str, typer.Argument(metavar="REFERENCE", help="Held-out run: a file, folder or glob.")],
    replicate: Annotated[str, typer.Argument(metavar="REPLICATE", help="Another one, as long.")],
    weights: Annotated[list[str], typer.Option("--weights", "-w", help="Name or .safetensors file; repeatable.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the tables and the plot.")] = Path("cost-error"),
    time: Annotated[str, typer.Option("--time", help="Rolled at each setting, all replicas together.")] = "20ns",
    rounds: Annotated[int, typer.Option("--rounds", min=1, help="Parts, by turns with OpenMM.")] = 4,
    solver: Annotated[list[str] | None, typer.Option("--solver", help="Only this; repeatable.")] = None,
    steps: Annotated[list[int] | None, typer.Option("--steps", min=1, help="2, 3, 4, 6, 10, 20; repeatable.")] = None,
    precision: Annotated[list[Precision] | None, typer.Option("--precision", help="Repeatable.")] = None,
    batch: Annotated[list[int] | None, typer.Option("--batch", min=1, help="Replicas: 32; repeatable.")] = None,
    compile: Annotated[bool, typer.Option("--compile", help="The usual setting compiled, too.")] = False,
    seed: SeedOpt = 0,
    quiet: QuietOpt = False,
    as_json: JsonOpt = False,
) -> None:
    """Run time against error of a surrogate at many settings, beside OpenMM, on one core. Goes on where it stopped.

    REFERENCE and REPLICATE: two runs that the weights were not trained on.
    """
    from surrogate.bench.cost_error.cost_page import markdown
    from surrogate.bench.cost_error.sweep import cost_error as run
    from surrogate.bench.cost_error.sweep_settings import CostErrorConfig, Sweep

    result = run(
        reference,
        replicate,
        weights,
        out,
        CostErrorConfig(time_ps=parse_time_ps(time, "--time"), rounds=rounds, seed=seed),
        Sweep(solver, steps, None if precision is None else [one.value for one in precision], batch, compile),
        report=lambda line: None if quiet or as_json else typer.echo(f"running: {line}", err=True),
    )
    if as_json:
        print_json(result)
    elif not quiet:
        typer.echo(markdown(result))
        typer.echo(f"{out}: cost_error.json, cost_error.md, cost_error.svg")


def stress(
    weights: Annotated[str, typer.Argument(metavar="WEIGHTS", help="Name of shipped weights, or a .safetensors file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the tables, the plot and the rollouts.")] = Path(
        "surromd-stress"
    ),
    frames: Annotated[
        list[int] | None, typer.Option("--frames", min=1, help="Length of a rollout, all replicas: 10000 and 100000.")
    ] = None,
    replicas: Annotated[int | None, typer.Option("--replicas", min=1, help="Of the rollouts: 16.")] = None,
    guard: Annotated[list[str] | None, typer.Option("--guard", help="Of the rollouts: flag and repair.")] = None,
    section: Annotated[
        list[str] | None,
        typer.Option(
            "--section", help="Only this: length, invariance, inputs, precision, batches, solvers, openmm. Repeatable."
        ),
    ] = None,
    scene: Annotated[
        str | None, typer.Option("--scene", help="Of weights for many molecules: the one to try, such as smiles:CCO.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Short runs of everything: a minute or two.")] = False,
    seed: SeedOpt = 0,
    quiet: QuietOpt = False,
    as_json: JsonOpt = False,
) -> None:
    """How WEIGHTS stand long rollouts, odd inputs, other arithmetic and settings, beside OpenMM itself."""
    from surrogate.bench.stress.trials import choose_config, stress_weights

    result = stress_weights(
        weights,
        out,
        choose_config(quick=quick, frames=frames, replicas=replicas, guards=guard, sections=section, seed=seed),
        scene=scene,
        report=lambda name: None if quiet or as_json else typer.echo(f"running: {name}", err=True),
    )
    if as_json:
        print_json(result)
    elif not quiet:
        from surrogate.bench.stress.stress_page import markdown

        typer.echo(markdown(result))
        typer.echo(f"{out}: stress.json, stress.md, stress.svg")
