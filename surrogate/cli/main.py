"""The command line: parsing and printing only. Every verb is one call of `surrogate.api`, which is loaded when it runs;
`bench` and `stress` are calls of `surrogate.bench`."""

from __future__ import annotations

import atexit
import functools
import gc
import inspect
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, is_dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, cast, get_type_hints

import typer
from typer.core import TyperGroup

import surrogate as sm
from surrogate.cli.render import (
    as_flags,
    print_comparison,
    print_json,
    print_library,
    print_pairs,
    print_run,
    print_written,
)
from surrogate.verbs.options import (
    CampaignOptions,
    CompareOptions,
    CostErrorOptions,
    DemoOptions,
    PlanOptions,
    Quiet,
    ReferenceOptions,
    RolloutOptions,
    RunOptions,
    StressOptions,
    TrainOptions,
    WindowsOptions,
    said,
)
from systems.errors import SurromdError
from systems.files.outside import printable
from systems.interrupts import interrupted_by_signals
from systems.options import MissingOptionError, Option, gather, option, options_of

# Of objects since the last look for garbage, before there is another.
_YOUNG_OBJECTS = 50_000


# ---- arguments and options that several verbs share ----------------------------------------------------------------


def literal(text: str) -> str:
    """Return a help text in which brackets are what they look like: typer and rich take `[default: 4fs]` for markup and
    show nothing of it."""
    return text.replace("[", "\\[")


def _scenes(incomplete: str) -> list[str]:
    """Return the library's names that begin so, for a shell that completes the word."""
    from systems.library.named_scenes import names

    return [name for name in names() if name.startswith(incomplete)]


def _weights(incomplete: str) -> list[str]:
    from surrogate.models.architecture import shipped_weights

    return [name for name in shipped_weights() if name.startswith(incomplete)]


SceneArg = Annotated[
    str,
    typer.Argument(
        metavar="SCENE", help="Library name, path, smiles:CCO or sequence:ACE-ALA-NME.", autocompletion=_scenes
    ),
]
WeightsOpt = Annotated[
    str | None,
    typer.Option(
        "--weights",
        help="Shipped weights by name, or a .safetensors file (default: those that cover SCENE).",
        autocompletion=_weights,
    ),
]
OutOpt = Annotated[Path, typer.Option("--out", "-o", help="Output trajectory (.h5, .dcd or .xtc).")]
FolderOpt = Annotated[Path, typer.Option("--out", "-o", help="Output folder.")]


# Click's own exceptions, which end in its own messages and exit codes; typer 0.26 and newer bring a click of their own.
_CLICK: dict[str, Any] = {kind.__name__: kind for kind in typer.BadParameter.__mro__}
_USAGE_ERRORS = (_CLICK["ClickException"], typer.Exit, typer.Abort)


def usage_error(message: str, context: Any = None) -> Exception:
    """Return click's error that ends a command with its usage, a message and exit code 2."""
    made: Exception = _CLICK["UsageError"](message, context)
    return made


JsonOpt = Annotated[bool, typer.Option("--json", help="Print the result as JSON to stdout.")]


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with an option of the command line for each that its dataclasses of options declare.

    A parameter of such a type (`options: RolloutOptions`) becomes all of them, in its place, and `--config FILE`, which
    what stands on the command line comes before. Names and units are those of `systems.options`.
    """
    hints = get_type_hints(command, include_extras=True)
    shown: list[inspect.Parameter] = []
    kinds: dict[str, type] = {}
    for parameter in inspect.signature(command).parameters.values():
        hint = hints[parameter.name]
        if is_dataclass(hint):
            kinds[parameter.name] = cast(Any, hint)
            known = options_of(cast(type, hint)).values()
            shown += [_parameter(each) for each in known if each.flags]
            shown.append(_keyword("config", Path, _config_option(known)))
        else:
            shown.append(parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY))

    @functools.wraps(command)
    def run(**given: Any) -> None:
        for name, kind in kinds.items():
            try:
                resolved = _resolved(kind, given)
            except MissingOptionError as error:
                raise usage_error(f"{command.__name__} {error.needs}") from None
            # Such as the lines about charges.
            logging.getLogger("surromd").setLevel(
                logging.ERROR if getattr(resolved, "quiet", False) else logging.NOTSET
            )
            given[name] = resolved
        command(**given)

    run.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in shown}
    return run


def _config_option(known: Iterable[Option]) -> Any:
    """Return `--config`, whose help names the tables of the file."""
    tables = dict.fromkeys(found.section or found.name for found in known if found.section or found.kind is dict)
    listed = "".join(f", [{table}]" for table in tables)
    return typer.Option(
        "--config", help=literal(f"TOML file of these options{listed}; the command line takes precedence.")
    )


def _resolved(kind: type, given: dict[str, Any]) -> Any:
    """Take a dataclass's options out of what the command line gives, and return it. Raises what `gather` does."""

    def plain(value: Any) -> Any:
        return [plain(one) for one in value] if isinstance(value, list) else getattr(value, "value", value)

    typed = {name: given.pop(name) for name, found in options_of(kind).items() if found.flags}
    values = {name: plain(value) for name, value in typed.items() if value is not None and value != []}
    return gather(kind, values, file=given.pop("config"), naming=lambda found: found.flags[0])


def _keyword(name: str, kind: Any, declared: Any) -> inspect.Parameter:
    annotation = Annotated[kind | None, declared]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _parameter(found: Option) -> inspect.Parameter:
    """Return an option as typer takes it: None where it is left out, so that a file may give it."""
    kind: Any = str if found.reader is not None else found.kind
    if found.choices:
        enumeration: Any = StrEnum  # called by its functional form, which mypy takes with literal names alone
        kind = enumeration(found.name, {choice: choice for choice in found.choices})
    default = "required" if found.required else f"default: {text}" if (text := found.shown_default) else ""
    least, most = found.within if kind in (int, float) else (None, None)
    shown = literal(f"{found.help} [{default}]" if default else found.help)
    declared = typer.Option(*found.flags, help=shown, min=least, max=most, show_default=False)
    return _keyword(found.name, list[kind] if found.many else kind, declared)


# ---- the program ---------------------------------------------------------------------------------------------------


class _Group(TyperGroup):
    """Turns whatever a verb raises into one line on stderr and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        said.set(as_flags)
        if os.environ.get("SURROMD_DEBUG") == "1":
            return super().invoke(ctx)
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as stop:
            _fail(f"interrupted; {stop.args[0] if stop.args else 'nothing was written'}", 130)
        except SurromdError as error:
            _fail(f"error: {error}", 1)
        except BrokenPipeError:
            raise
        except OSError as error:
            _fail(f"error: {_os_error(error)}", 1)
        except MemoryError:
            _fail("error: out of memory; ask for fewer frames or replicas at once", 1)
        except _USAGE_ERRORS as error:
            raise (_needed(error) or error) from None
        except Exception as error:  # a fault of ours: one line for the user, the rest on demand
            if "null byte" in str(error):
                _fail("error: a path holds a NUL character, which no file's name can have", 1)
            _fail(f"error: unexpected {type(error).__name__}: {error} (a bug; SURROMD_DEBUG=1 shows where)", 1)


def _needed(error: Any) -> Exception | None:
    """Return the error that says what is missing, as of options that stand in a dataclass; None of any other error."""
    if type(error).__name__ != "MissingParameter" or error.param is None:
        return None
    name = error.param.opts[0] if error.param.param_type_name == "option" else error.param.metavar
    return usage_error(f"{error.ctx.info_name} needs {name}: {error.param.help}", error.ctx)


def _fail(message: str, code: int) -> None:
    typer.echo(printable(as_flags(" ".join(message.split()))), err=True)
    raise typer.Exit(code) from None


def _os_error(error: OSError) -> str:
    # h5py puts the errno into the text and leaves the attribute empty.
    if error.errno == 28 or "No space left" in str(error) or "errno = 28" in str(error):
        where = f" ({error.filename})" if error.filename else ""
        return f"the disk is full{where}; free some space and run again (--resume where the verb has it)"
    if error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"surromd {sm.__version__}")
        raise typer.Exit()


_HELP = {"help_option_names": ["-h", "--help"]}
app = typer.Typer(
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings=_HELP,
    help="Reference MD with OpenMM, learned surrogate rollouts, and comparison of the two.",
    epilog="SCENE: library name, path (.pdb, .cif, .sdf, .mol, .mol2), smiles:CCO or sequence:ACE-ALA-NME. "
    "Durations carry units: 50ns, 10ps, 2fs.",
)
bench = typer.Typer(no_args_is_help=True, context_settings=_HELP, help="Benchmarks on this machine.")
app.add_typer(bench, name="bench")


@app.callback()
def _surromd(
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.", callback=_version)] = False,
) -> None:
    """Take the options that belong to no verb."""


@app.command()
@with_options
def demo(
    out: FolderOpt = Path("surromd-demo"),
    *,
    options: DemoOptions,
) -> None:
    """Demonstration on alanine dipeptide: OpenMM, a rollout with shipped weights, the comparison."""
    result = sm.demo(out, options=options)
    print_comparison(result, out / "report.html", as_json=False, quiet=options.quiet)


@app.command()
@with_options
def run(
    scene: SceneArg,
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output folder.")] = None,
    options: RunOptions,
    as_json: JsonOpt = False,
) -> None:
    """Simulate SCENE within a wall-time budget, by MD and a surrogate, and evaluate the result."""
    if out is None and not options.dry_run:
        raise usage_error("run needs --out: Folder for trajectory, report and record.")
    result = sm.run(scene, out, options=options)
    print_run(result, as_json=as_json)
    if result.get("failed"):
        raise typer.Exit(1)


@app.command()
def systems(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="System to describe.")] = None,
    as_json: JsonOpt = False,
) -> None:
    """List the systems of the library, or describe one."""
    found = sm.systems(name)
    if name is None and not as_json:
        print_library(found)
    else:
        print_pairs(found if as_json else found[0], as_json=as_json)


@app.command()
@with_options
def plan(scene: SceneArg, *, options: PlanOptions, as_json: JsonOpt = False) -> None:
    """Show platform, settings and speed of a reference run of SCENE, and with --time its wall time."""
    print_pairs(sm.plan(scene, options=options), as_json=as_json)


@app.command()
@with_options
def reference(scene: SceneArg, *, out: OutOpt, options: ReferenceOptions, as_json: JsonOpt = False) -> None:
    """Simulate SCENE with OpenMM and write the trajectory."""
    print_written(sm.reference(scene, out, options=options), as_json, options.quiet)


_CAMPAIGN = (
    "An example of FILE, of two scenes at two temperatures (every setting of `reference` is allowed):",
    'scenes = ["alanine-dipeptide", "pdb/*.pdb"]',
    'temperatures = ["300K", "350K"]',
    "replicas = 4",
    'time = "100ns"',
    'save_every = "10ps"',
)


@app.command(epilog=literal("\n\n".join(_CAMPAIGN)))
@with_options
def campaign(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="TOML file with scenes, temperatures, replicas and settings.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output folder (default: the one named in FILE).")
    ] = None,
    *,
    options: CampaignOptions,
    as_json: JsonOpt = False,
) -> None:
    """Simulate many scenes, temperatures and replicas with OpenMM, on Dask; run again to continue."""
    result = sm.campaign(file, out, options=options)
    if as_json or options.dry_run:
        print_pairs(result, as_json=as_json)
    elif not options.quiet:
        typer.echo(f"{result['file']}: {result['summary']}")
    if result.get("failed"):
        for name, reason in result["failed"].items():
            typer.echo(as_flags(f"failed: {name}: {reason}"), err=True)
        raise typer.Exit(1)


@app.command()
@with_options
def windows(
    references: Annotated[
        list[str], typer.Argument(metavar="REF...", help="Reference trajectories, folders or globs.")
    ],
    *,
    out: Annotated[Path, typer.Option("--out", "-o", help="Output file (.h5).")],
    options: WindowsOptions,
    as_json: JsonOpt = False,
) -> None:
    """Pack reference trajectories into one training file (superposed, 16-bit)."""
    print_written([sm.windows(references, out, options=options)], as_json, options.quiet)


@app.command()
@with_options
def train(
    references: Annotated[
        list[str],
        typer.Argument(metavar="REF_OR_WINDOWS...", help="Trajectories or a windows file; a SCENE with --level."),
    ],
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output weights (.safetensors).")] = None,
    options: TrainOptions,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print the complete --config for these references without training.")
    ] = False,
    as_json: JsonOpt = False,
) -> None:
    """Train a surrogate on reference trajectories, or a potential of one molecule on quantum forces."""
    if explain:
        typer.echo(sm.explain_training(references, options=options), nl=False)
        return
    if out is None:
        raise usage_error("train needs --out: Weights to write, .safetensors.")
    written = sm.train(references, out, options=options)
    print_written([written], as_json, options.quiet)


@app.command()
@with_options
def rollout(
    scene: SceneArg, *, weights: WeightsOpt = None, out: OutOpt, options: RolloutOptions, as_json: JsonOpt = False
) -> None:
    """Generate a trajectory of SCENE with a trained surrogate."""
    print_written(sm.rollout(scene, weights, out, options=options), as_json, options.quiet)


@dataclass(frozen=True, kw_only=True)
class CompareShown(CompareOptions, Quiet):
    """Options of `compare`, and what the command does about its result."""

    show_all: bool = option("Print all metrics, not only the verdict.", False, words=("all",))
    fail_on: str | None = option(
        "Exit with 1 if the verdict on any candidate is this or worse.", None, choices=("different", "broken")
    )


@app.command()
@with_options
def compare(
    reference: Annotated[str, typer.Argument(metavar="REF", help="Reference: a file, folder, 'glob' or a,b,c.")],
    candidates: Annotated[
        list[str], typer.Argument(metavar="TRAJ...", help="Candidate trajectories, one argument each, given like REF.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="HTML report; .json and .md are written beside it.")] = Path(
        "report.html"
    ),
    *,
    options: CompareShown,
    as_json: JsonOpt = False,
) -> None:
    """Compare trajectories with a reference: accuracy, error bars, verdict, cost."""
    result = sm.compare(reference, candidates, out, options=options)
    print_comparison(result, out, as_json=as_json, quiet=options.quiet, show_all=options.show_all)
    bad = {"different": ("different", "broken"), "broken": ("broken",)}
    if options.fail_on is not None and any(j.status in bad[options.fail_on] for j in result.evaluations):
        raise typer.Exit(1)


@app.command()
def info(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="A trajectory, windows, weights (or their name), a campaign's or a run's folder."
        ),
    ],
    scene: Annotated[
        str | None,
        typer.Argument(metavar="SCENE", help="With weights: check whether SCENE lies in their training domain."),
    ] = None,
    as_json: JsonOpt = False,
) -> None:
    """Describe a file and its origin; with weights and a SCENE, whether they cover it."""
    print_pairs(sm.info(path, scene), as_json=as_json)


# ---- benchmarks -----------------------------------------------------------------------------------------------------


@bench.command(name="cost-error")
@with_options
def cost_error(
    reference: Annotated[str, typer.Argument(metavar="REFERENCE", help="Held-out reference: a file, folder or glob.")],
    replicate: Annotated[str, typer.Argument(metavar="REPLICATE", help="Independent reference of the same length.")],
    weights: Annotated[
        list[str], typer.Option("--weights", "-w", help="Weights by name or .safetensors file; repeatable.")
    ],
    out: FolderOpt = Path("cost-error"),
    *,
    options: CostErrorOptions,
    as_json: JsonOpt = False,
) -> None:
    """Run time against error of a surrogate at many settings, beside OpenMM, on one core. Goes on where it stopped.

    REFERENCE and REPLICATE: two runs that the weights were not trained on.
    """
    from surrogate.bench import cost_error as bench

    _measure(
        lambda report: bench.cost_error(reference, replicate, weights, out, options, report=report),
        bench.markdown, f"{out}: cost_error.json and .md", as_json, options.quiet,
    )  # fmt: skip


@app.command()
@with_options
def stress(
    weights: Annotated[str, typer.Argument(metavar="WEIGHTS", help="Name of shipped weights, or a .safetensors file.")],
    out: FolderOpt = Path("surromd-stress"),
    *,
    options: StressOptions,
    as_json: JsonOpt = False,
) -> None:
    """Stress-test WEIGHTS: long rollouts and unusual inputs, beside OpenMM."""
    from surrogate.bench import stress as bench

    _measure(
        lambda report: bench.stress(weights, out, options, report=report),
        bench.markdown, f"{out}: stress.json, stress.md", as_json, options.quiet,
    )  # fmt: skip


def _measure(
    work: Callable[[Callable[[str], None]], dict[str, Any]], markdown: Callable[[Any], str], files: str, as_json: bool,
    quiet: bool,
) -> None:  # fmt: skip
    """Run a benchmark, saying what it does; print what it has found, and which files it has written."""
    result = work(lambda line: None if quiet or as_json else typer.echo(f"running: {line}", err=True))
    if as_json:
        print_json(result)
    elif not quiet:
        typer.echo(markdown(result))
        typer.echo(files)


# ---- the process ----------------------------------------------------------------------------------------------------


def main() -> None:
    """Entry point of the command `surromd`."""
    # Threads that spin while they wait make a step a hundred times slower where other work shares the cores. Read when
    # the numerical libraries load, which is later; a user's own setting stands.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Modules make half a million objects that stay. Looking for garbage among them while they are loaded, and once more
    # when the process ends, took a third of a short command's time.
    gc.set_threshold(_YOUNG_OBJECTS)
    atexit.register(gc.freeze)
    if os.environ.get("SURROMD_DEBUG") != "1":
        # What matters in a file our readers say, in a line.
        warnings.filterwarnings("ignore", module="mdtraj|MDAnalysis")
    try:
        with interrupted_by_signals():
            app(prog_name="surromd")
    except KeyboardInterrupt:  # outside any verb: while starting
        sys.exit(130)


if __name__ == "__main__":
    main()
