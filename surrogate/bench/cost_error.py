"""Run time against error: a surrogate at many settings beside OpenMM at many lengths, on one core.

`surromd bench cost-error` runs it. Each setting rolls the same time; its error is that of the φ/ψ map against two held-
out runs, its cost the processor time of this process, one thread. Before each of its parts OpenMM runs for a moment, so
that the ratio of the two does not hang on what else the machine does. MD's own error is that of pieces of one held-out
run against the whole of the other (`comparison.equivalent_time`).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.bench.accuracy import (
    HeldOut,
    compare_frames,
    compare_reference,
    effective_row,
    equivalent_time_row,
    read_reference,
    refuse_trained_on,
)
from surrogate.bench.timing import OPENMM, Roller, machine_facts, markdown_table, md_costs, roll_in_turns
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.domain import fit_weights
from surrogate.training.devices import torch_threads
from surrogate.verbs.options import CostErrorConfig, CostErrorOptions, Sweep, Trajectories
from surrogate.verbs.outputs import find_trajectories
from systems.errors import InputError, StorageError, SurromdError
from systems.files.whole_file import create_whole
from systems.options import part_of
from systems.trajectory.codec import open_trajectory

if TYPE_CHECKING:
    from surrogate.models.weights import Weights

ReportFn = Callable[[str], None]
# A rollout with fewer whole molecules is drawn hollow: its error does not count.
SOUND_PERCENT = 99.0
_COLOURS = {"multistep": "#1f77b4", "fitted": "#d62728", "euler": "#7f7f7f", "dopri5": "#9467bd"}


@dataclass(frozen=True)
class Setting:
    """One way to roll. `solver` None: of a model without one, for which `steps` mean nothing."""

    solver: str | None
    steps: int
    precision: str = "auto"
    batch: int = 32
    compile: bool = False

    @property
    def label(self) -> str:
        words = [f"{self.solver} {self.steps}" if self.solver else "as it is"]
        words += [self.precision] if self.precision != "auto" else []
        words += [f"batch {self.batch}"] if self.batch != Setting.batch else []
        return ", ".join(words + (["compiled"] if self.compile else []))


def cost_error(
    reference: Trajectories,
    replicate: Trajectories,
    weights: Sequence[str | Path],
    folder: Path,
    options: CostErrorOptions,
    *,
    report: ReportFn = lambda line: None,
) -> dict[str, Any]:
    """Measure weights, by name or file, at the settings of `choose_settings`; see `run_cost_error`."""
    from surrogate.models.architecture import weights_path
    from surrogate.models.weights import load_weights

    loaded = [load_weights(weights_path(name)) for name in weights]
    sweep = part_of(options, Sweep)
    chosen = [(one, choose_settings(one, sweep)) for one in loaded]  # what cannot be is said before anything is read
    first, second = find_trajectories(reference), find_trajectories(replicate)
    return run_cost_error(chosen, first, second, folder, part_of(options, CostErrorConfig), report=report)


def choose_settings(weights: Weights, sweep: Sweep) -> list[Setting]:
    """Return all combinations of what is asked for; without solvers those that take a batch at once. Raises InputError
    for a solver that the weights do not know."""
    from surrogate.models.lam_slide.flow import ADAPTIVE

    known = weights.model.solvers
    unknown = [name for name in sweep.solvers or () if name not in known]
    if unknown:
        raise InputError(f"{weights.path.name} knows no solver {unknown[0]!r}; choose {', '.join(known) or 'none'}.")
    solvers: list[str | None] = [*(sweep.solvers or [name for name in known if name not in ADAPTIVE])] or [None]
    steps = sweep.steps if known else (weights.model.usual_steps,)
    compiled = (False, True) if sweep.compiled else (False,)
    return [Setting(*each) for each in product(solvers, steps, sweep.precisions, sweep.batches, compiled)]


def run_cost_error(
    chosen: Sequence[tuple[Weights, Sequence[Setting]]],
    reference: Sequence[Path],
    replicate: Sequence[Path],
    folder: Path,
    config: CostErrorConfig,
    *,
    report: ReportFn = lambda line: None,
) -> dict[str, Any]:
    """Measure weights at their settings and write cost_error.json, .md and .svg into `folder` after each.

    What an earlier run left there is kept, if it was of the same references and the same `config`. Raises InputError
    for references that weights were trained on, for a folder of another benchmark, and for weights of other molecules;
    StorageError; KeyboardInterrupt says what is kept.
    """
    weights = [one for one, _ in chosen]
    prints = [refuse_trained_on(w, reference, replicate, lag_ps=config.lag_ps) for w in weights]
    fitted = [_fitted(w, reference, config.lag_ps) for w in weights]
    result = _earlier(folder, {"references": prints[0], "config": asdict(config)})
    scene = fitted[0].domain.scene
    scenes = {w.domain.scene.topology_hash: w.domain.scene for w in fitted}  # atoms may stand in another order
    report("reading the references")
    references = {hashed: read_reference(of, reference, replicate, config.lag_ps) for hashed, of in scenes.items()}
    ref = references[scene.topology_hash]
    result |= {"machine": machine_facts(), "scene": scene.name, "files": [p.name for p in (*reference, *replicate)]}
    try:
        with torch_threads(config.threads):
            if "md" not in result:
                report("OpenMM")
                result["md"] = compare_reference(ref, seed=config.seed) | {"cost": md_costs(fitted[0], config)}
            for (one, settings), as_rolled in zip(chosen, fitted, strict=True):
                of_these = references[as_rolled.domain.scene.topology_hash]
                for setting in settings:
                    named = {"weights_hash": one.hash, **asdict(setting)}
                    if not any(row.items() >= named.items() for row in result["rows"]):
                        report(f"{one.path.stem}: {setting.label}")
                        row = measure_setting(as_rolled, setting, of_these, config, result["md"]["slowest"])
                        result["rows"].append(row | effective_row(row, result["md"]))
                        write_cost_error(result, folder)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{folder} keeps the settings that were finished; the same command goes on") from None
    write_cost_error(result, folder)
    return result


def _fitted(weights: Weights, reference: Sequence[Path], lag_ps: float | None) -> Weights:
    """Return weights as they roll the molecule of the references at one lag, where they know several of either."""
    knows_lags = weights.domain.longest_lag_ps > weights.domain.lag_ps
    if not (weights.domain.transferable or (knows_lags and lag_ps)):
        return weights
    with open_trajectory(reference[0]) as reader:
        scene = reader.scene
    return fit_weights(
        scene or weights.domain.scene, weights, lag_ps=(lag_ps or weights.domain.lag_ps) if knows_lags else None
    )[0]


def measure_setting(
    weights: Weights, setting: Setting, ref: HeldOut, config: CostErrorConfig, slowest: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Roll one setting in parts, by turns with OpenMM; return its cost, its errors and its equivalent MD time,
    JSON-able. `slowest`: the torsion that effective samples are counted by (`accuracy.slowest_torsion`)."""
    named = {"weights": weights.path.stem, "weights_hash": weights.hash, "label": setting.label}
    row: dict[str, Any] = named | asdict(setting)
    try:
        sampler = ChunkSampler(weights, solver=setting.solver, solver_steps=setting.steps, precision=setting.precision,
                               compile=setting.compile)  # fmt: skip
        roller = Roller(weights, sampler, rows=setting.batch, seed=config.seed)
        discarded = -(-config.discarded_ps // (sampler.n_new * weights.domain.lag_ps))
        started = time.process_time()
        roller.advance(max(1, int(discarded)) * sampler.n_new)
        row["first_chunks_s"] = time.process_time() - started
        parts, costs = roll_in_turns(weights, roller, sampler, config)
    except (SurromdError, np.linalg.LinAlgError) as error:  # the latter where frames are no longer finite
        return row | {"outcome": f"not run: {error}"}
    frames = np.concatenate(parts, axis=1)
    ns = 1e-3 * frames.shape[0] * frames.shape[1] * weights.domain.lag_ps
    row |= {"bf16": sampler.precision.bf16, "evaluations": sampler.evaluations_per_chunk, "ns": ns, **costs}
    every = max(1, round(ref.reference.lag_ps / weights.domain.lag_ps))
    errors, equivalent_time = compare_frames(
        frames[:, every - 1 :: every], ref, seed=config.seed, slowest=None if slowest is None else slowest["torsion"]
    )
    spent = ns * row["cpu_s_per_ns"]["mean"]
    return row | errors | {"spent_s": spent} | equivalent_time_row(equivalent_time, spent, row["md_s_per_ns"]["mean"])


def _earlier(folder: Path, header: dict[str, Any]) -> dict[str, Any]:
    """Return what a folder holds, or an empty result. Raises InputError where it is of other references or times."""
    path = folder / "cost_error.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    except (OSError, ValueError) as error:
        raise StorageError(f"{path} cannot be used ({error}); name another folder with `out`.") from error
    if found and any(found.get(key) != value for key, value in header.items()):
        raise InputError(f"{path} is of other references, times or rounds; name another folder with `out`.")
    return {**header, "rows": [], **found}


# ---- the page -------------------------------------------------------------------------------------------------------


def write_cost_error(result: dict[str, Any], folder: Path) -> None:
    """Write cost_error.json, .md and, where a setting was measured, .svg. Raises StorageError."""
    create_whole(folder / "cost_error.json", json.dumps(result, indent=1))
    create_whole(folder / "cost_error.md", markdown(result))
    if any("jsd" in row for row in result["rows"]):
        create_whole(folder / "cost_error.svg", lambda path: plot(result, path))


def markdown(result: dict[str, Any]) -> str:
    """Return the tables: MD and the settings."""
    md, config = result["md"], result["config"]
    correlation, relaxation_ps = (
        np.mean([run["value"] for run in md[key]]) for key in ("correlation", "relaxation_ps")
    )
    columns = (md[key] for key in ("lengths_ps", "errors", "errors_low", "errors_high"))
    by_length = "; ".join(
        f"{1e-3 * ps:.3g} ns {error:.3f} [{low:.3f}, {high:.3f}]" for ps, error, low, high in zip(*columns, strict=True)
    )
    slow, counted = (
        md["slowest"],
        "No torsion relaxes 50 times over in the MD at hand: effective samples are not counted.",
    )
    if slow is not None:
        counted = (
            f"Effective samples: simulated time over 2 max(τ, τ of MD) of {slow['name']} (MD: {slow['tau_ps']:.1f} ps, "
            f"{slow['samples']:.0f} of them at hand), a processor second; over OpenMM's."
        )
    md_rows = [
        {"MD": cost["label"], "s/ns": _range(cost["cpu_s_per_ns"]), "wall s/ns": cost["wall_s_per_ns"]["mean"]}
        for cost in md["cost"]
    ]
    return "\n".join(
        [
            f"# Run time against error: {result['scene']}",
            "",
            f"Rollouts of {1e-3 * config['time_ps']:g} ns in all replicas, against two held-out runs of "
            f"{1e-3 * md['length_ps']:g} ns; processor seconds on {config['threads']} thread(s), mean of "
            f"{config['rounds']} parts [least, greatest]; 95 % intervals in brackets elsewhere.",
            "",
            result["machine"]["about"],
            "",
            "## MD",
            "",
            *markdown_table(md_rows),
            "",
            f"JSD of MD by length, typical piece [10 %, 90 % of pieces]: {by_length}.",
            "",
            "## Settings",
            "",
            *markdown_table([_row(row, md["errors"][0]) for row in result["rows"]]),
            "",
            "JSD: Jensen-Shannon distance of the joint φ/ψ map (50 x 50) to the held-out runs, root mean square; "
            f"{md['replicate_baseline']:.3f} is what these have between them, and nothing below is claimed. MD, "
            "same seconds: the JSD of as many processor seconds of OpenMM at 4 fs. Equivalent MD time: how much MD "
            "is as far from the reference; faster: what that MD takes, over what the rollout took. C1: autocorrelation "
            f"of cos ψ after one frame (reference {correlation:.3f}), τ: its relaxation time (reference "
            f"{relaxation_ps:.1f} ps).",
            "",
            counted,
            "",
        ]
    )


def _row(row: dict[str, Any], shortest: float) -> dict[str, Any]:
    """Return the cells of a setting; `shortest` is the error of the shortest MD at hand."""
    out: dict[str, Any] = {"weights": row["weights"], "setting": row["label"]}
    if "outcome" in row:
        return out | {"evaluations": row["outcome"]}
    bound = {"at least": "≥ ", "less than": "< "}.get(row["equivalent_time"]["bound"], "")
    faster = [row[f"times_faster{end}"] for end in ("", "_low", "_high")]
    same, over_md = row["md_of_same_seconds"], row.get("effective_over_md")
    return out | {
        "evaluations": f"{row['evaluations']:.3g}",
        "s/ns": _range(row["cpu_s_per_ns"]),
        "wall s/ns": f"{row['wall_s_per_ns']['mean']:.3g}",
        "x MD 4 fs": _range(row["speed_over_md"]),
        "0.5 Å %": f"{row['valid_half_angstrom_%']['value']:.2f}",
        "20 % %": f"{row['bonds_20_percent_%']['value']:.2f}",
        "JSD": _interval([row["jsd"][key] for key in ("value", "low", "high")], ".3f"),
        "MD, same seconds": f"> {shortest:.3f}" if same is None else f"{same:.3f}",
        "equivalent MD time": row["equivalent_time"]["words"],
        "faster": f"{bound}{faster[0]:.2g}" if bound else _interval(faster, ".2g"),
        "C1": "none" if row["correlation"]["value"] is None else f"{row['correlation']['value']:.3f}",
        "τ / ps": _interval([row["relaxation_ps"][key] for key in ("value", "low", "high")], ".1f"),
        "effective samples": "" if over_md is None else f"{row['effective_per_s']:.3g}/s, {over_md:.3g} x MD",
    }


def _range(spread: dict[str, float]) -> str:
    return _interval([spread["mean"], spread["least"], spread["greatest"]], ".3g")


def _interval(found: Sequence[float | None], digits: str) -> str:
    """Return a value with the ends of its interval, such as '0.31 [0.28, 0.35]'; without them where none is known."""
    value, *ends = ("..." if each is None else f"{each:{digits}}" for each in found)
    return f"{value} [{', '.join(ends)}]" if found[1:] != [None, None] else value


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw error against processor seconds, logarithmic: MD of every length, and each setting."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator, ScalarFormatter

    figure = Figure(figsize=(8.2, 5.4), layout="constrained")
    axes = figure.add_subplot()
    md = result["md"]
    cost = next(cost for cost in md["cost"] if cost["way"] == OPENMM)
    x = 1e-3 * np.asarray(md["lengths_ps"]) * cost["cpu_s_per_ns"]["mean"]
    axes.plot(x, md["errors"], color="black", lw=1.4, label=cost["label"])
    axes.fill_between(x, md["errors_low"], md["errors_high"], color="black", alpha=0.1, lw=0)
    axes.axhline(md["replicate_baseline"], color="black", lw=0.8, alpha=0.5)
    text = f"two runs of {1e-3 * md['length_ps']:g} ns"
    axes.annotate(text, (0.01, md["replicate_baseline"]), xycoords=("axes fraction", "data"), va="bottom", fontsize=8)
    labelled = set()
    for row in (row for row in result["rows"] if "jsd" in row):
        colour = _COLOURS.get(row["solver"], "#2ca02c")
        is_sound = row["valid_half_angstrom_%"]["value"] >= SOUND_PERCENT
        at = row["spent_s"], row["jsd"]["value"]
        low, high = (at[1] if row["jsd"][end] is None else row["jsd"][end] for end in ("low", "high"))
        bar = [[max(at[1] - max(low, 0.5 * at[1]), 0.0)], [max(high - at[1], 0.0)]]
        axes.errorbar(*at, bar, fmt="o", color=colour, lw=0.7, mfc=colour if is_sound else "white", zorder=3,
                      label=None if row["solver"] in labelled else row["solver"] or "surrogate")  # fmt: skip
        labelled.add(row["solver"])
        axes.annotate(row["label"].removeprefix(f"{row['solver']} "), at, xytext=(5, 3), textcoords="offset points",
                      fontsize=7.5, color=colour)  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="processor time / s (one core)",
             ylabel="Jensen-Shannon distance of the φ/ψ map to held-out MD",
             title=f"{result['scene']}: run time against error")  # fmt: skip
    axes.yaxis.set_major_locator(FixedLocator([0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8]))
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.yaxis.set_minor_locator(FixedLocator([]))
    axes.grid(alpha=0.25, which="major")
    axes.plot([], [], "o", color="grey", mfc="white", label=f"under {SOUND_PERCENT:g} % of frames whole")
    axes.legend(frameon=False, fontsize=8.5, title="numbers: solver steps", title_fontsize=8)
    figure.savefig(path, format="svg", dpi=140)
