"""Weights for peptides on molecules that they never saw, beside MD of these.

    python docs/studies/training/peptide_unseen.py FOLDER --weights W [--test CAMPAIGN/test] [--solvent tip3p]
          [--library CAMPAIGN/train] [--molecules NAME ...] [-o TABLE.json]

Without `--test` MD is the record of its torsions (`peptide_reference`), in OBC2, and what needs its frames is left out:
the equivalent MD time and MDGen's recipe.

Of each molecule the weights roll as many runs as MD has, each from the first frame of one of these, as long as MD's but
10 ns at most, unguarded, at lags of 10 ps, 100 ps and 1 ns as far as training had them (FOLDER/NAME; what is there is
read). Over MD's own:
- torsions: mean Jensen-Shannon distance (root, natural logarithm, 50 bins) over φ, ψ and χ, of one run to all others'
  MD (single), and of half of the runs to half of MD's (pooled); joint maps of ψ and the next φ (36 x 36) pooled;
- kinetics: integrated correlation times of every cos ψ and along the two slowest TICA coordinates of MD;
- lags: root mean square difference of the populations of torsion states at 100 ps and 1 ns from those at 10 ps;
- populations of torsion states: root mean square difference from MD's, of rollouts, of frames that the weights draw
  at endless times, and of one half of MD's runs from the other; in TIP3P levels that set populations
  (`peptide_populations`) move those at endless times half as far as those of steps;
- free chains of four, by MDGen's recipe: every other run to the remaining runs of MD, the model's over MD's.
A φ > 0 that MD enters fewer than ten times plays no part: frames that show it are left out of distances, as are pairs
of runs one of which shows it half of the time, and runs that show it out of kinetics. How likely it is,
`peptide_energies` and `peptide_gates seeds` say.

Beside the model stand the first frames of MD's runs, as many as are simulated in the wall time of the rollout, and
`--library`, torsions of monomers drawn without regard to neighbours (`peptide_scores`).
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from peptide_campaign import IMPLICIT, WATER, dynamics, minimised
from peptide_energies import trained_with
from peptide_reference import RECORD, Reference, references
from peptide_rollouts import FRAMES_PS, frame_weights, rolled, thinned
from peptide_scores import Turn, angles, library, rarely_positive, turns_of

from md_reference.forces.forcefield import build_system
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import WaterBox
from md_reference.run.machine import machine_name
from surrogate.api import compare
from surrogate.comparison.measure.distributions import distance
from surrogate.comparison.measure.kinetics import circular_features, fit_projection, tica_lag, zero_crossing
from surrogate.comparison.measure.structure import Baseline
from surrogate.comparison.measure.torsions import find_wells
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.published_metrics import TABLE, fit_recipe, peptide_table
from surrogate.models.architecture import weights_path
from surrogate.models.peptides.chains import POSITIVE_PHI_DEG
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.domain import fit_weights, under_conditions
from systems.chemistry.validity import INVALID, Geometry, check_frames
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

FloatArray = npt.NDArray[np.float64]
# Runs of torsions in rad, `(n_frames, n_torsions)` each.
Runs = Sequence[FloatArray]
LAGS_PS, BINS, JOINT_BINS, HALVES, SEED = (100.0, 1000.0), 50, 36, 10, 0
# Frames after each start at endless times.
ENDLESS = 200
# By so many steps the pace of MD is measured; it is that of steps of 4 fs, as the runs have.
PACE_STEPS, TIMESTEP_PS = {"obc2": 5000, "tip3p": 500}, 0.004
# The last column of the first table; the others make a second one.
LAST_DISTANCE = "joint maps, pooled"


def densities(runs: Runs, weights: Runs) -> list[FloatArray]:
    """Return of each run, whose frames count `weights`, the histograms of every torsion, `(n_torsions, BINS)`."""
    edges = np.linspace(-math.pi, math.pi, BINS + 1)
    return [np.stack([np.histogram(x, edges, weights=w)[0] for x in run.T]).astype(np.float64)
            for run, w in zip(runs, weights, strict=True)]  # fmt: skip


def joint_densities(runs: Runs, weights: Runs, pairs: Sequence[tuple[int, int]]) -> list[FloatArray]:
    """Return of each run the joint histograms of pairs of torsions, `(n_pairs, JOINT_BINS ** 2)`."""
    edges = np.linspace(-math.pi, math.pi, JOINT_BINS + 1)
    return [np.stack([np.histogram2d(run[:, i], run[:, j], (edges, edges), weights=w)[0].ravel() for i, j in pairs])
            for run, w in zip(runs, weights, strict=True)]  # fmt: skip


def mean_distance(one: FloatArray, other: FloatArray) -> float:
    return float(np.mean([distance(a, b) for a, b in zip(one, other, strict=True)]))


def single(md: Sequence[FloatArray], of: Sequence[FloatArray]) -> FloatArray:
    """Return the distance of each run of `of` to all runs of MD but the one of its number."""
    whole = sum(md)
    return np.array([mean_distance(whole - md[k], of[k]) for k in range(len(md))])


def pooled(md: Sequence[FloatArray], of: Sequence[FloatArray], but: int | None = None) -> FloatArray:
    """Return the distances between random halves of MD's runs and as many of `of`, of the other numbers, but one."""
    rng, found = np.random.default_rng(SEED), []
    for _ in range(HALVES):
        order = [k for k in rng.permutation(len(md)).tolist() if k != but]
        half = len(order) // 2
        found.append(mean_distance(sum(md[k] for k in order[:half]), sum(of[k] for k in order[half : 2 * half])))
    return np.array(found)


def over(measure: Callable[..., FloatArray], md: Sequence[FloatArray], of: Sequence[FloatArray]) -> list[float]:
    """Return a mean distance of `of` to MD over that of MD to itself, and its standard error over runs."""
    if measure is single:
        found, floor = single(md, of), single(md, md)
        ratio = found.mean() / floor.mean()
        relative = [x.std(ddof=1) / x.mean() / math.sqrt(len(x)) for x in (found, floor)]
        return [float(ratio), float(ratio * math.hypot(*relative))]
    each = [float(pooled(md, of, k).mean() / pooled(md, md, k).mean()) for k in range(len(md))]
    jackknife = math.sqrt((len(md) - 1) * float(np.var(each)))
    return [float(pooled(md, of).mean() / pooled(md, md).mean()), jackknife]


def shown(runs: Runs, rare: Sequence[int]) -> list[npt.NDArray[np.bool_]]:
    """Return in which frames of each run a φ of columns `rare` is positive."""
    low, high = np.radians(POSITIVE_PHI_DEG)
    return [((x[:, rare] > low) & (x[:, rare] < high)).any(axis=1) for x in runs]


def never(runs: Runs, rare: Sequence[int]) -> Runs:
    """Return the runs without a positive φ of columns `rare`; all of them where few are without."""
    found = [x for x, there in zip(runs, shown(runs, rare), strict=True) if not there.any()]
    return found if 2 * len(found) >= len(runs) else runs


def published(scene: Scene, md_nm: Runs, own_nm: Runs) -> dict[str, list[float]] | None:
    """Return the columns of MDGen's table, the model's distance, the replicate's and their ratio; None where it has no
    Markov model."""

    def frames(some: Runs) -> Ensemble:
        segments = [x.astype(np.float32) for x in some]
        return Ensemble(scene.name, segments, FRAMES_PS, scene)

    reference, replicate, own = frames(md_nm[::2]), frames(md_nm[1::2]), frames(own_nm[1::2])
    baseline = Baseline.of(reference)
    of = [baseline.measure(x) for x in (reference, replicate, own)]
    fit = fit_recipe(of[0])
    if fit is None:
        return None
    floor, model = (peptide_table(fit, of[0], x).tolist() for x in of[1:])
    return {name: [b, a, b / a] for name, a, b in zip(TABLE, floor, model, strict=True)}


def of_monomers(
    turns: Sequence[Turn], residues: Sequence[str], folder: Path, kt: Mapping[str, float], like: Runs
) -> Runs | None:  # fmt: skip
    """Return runs as many and as long as `like`, whose residues are drawn from runs of their monomers in a folder; None
    where these do not have every torsion. `kt`: free energies of φ > 0, which short runs do not tell."""
    each = [sorted((folder / name).glob("run_*.h5")) for name in residues]
    if not all(each):
        return None
    alone = [thinned(files) for files in each]
    own = [turns_of(scene) for scene, *_ in alone]
    values = [[angles(t, x) for x in frames] for t, (_, frames, _) in zip(own, alone, strict=True)]
    phi = [next(k for k, turn in enumerate(t) if turn.kind == "phi") for t in own]
    likely = [frame_weights(x, k, kt.get(name)) for x, k, name in zip(values, phi, residues, strict=True)]
    rng, whole = np.random.default_rng(SEED), [np.concatenate(x) for x in values]
    try:
        return [library(turns, whole, likely, own, len(x), rng) for x in like]
    except KeyError:
        return None


def worst(md_files: Sequence[Path], rollouts: Sequence[Path]) -> tuple[float, str]:
    """Return the equivalent MD time by the worst measure, ns and in words, as `surromd compare` states it of every
    other rollout beside as many runs of MD, with the other runs of MD as the replicate; its report stays there."""
    report = rollouts[0].parent / "report.html"
    compared = compare(md_files[::2], [rollouts[::2]], report, replicate=md_files[1::2], overwrite=True)
    found = compared.evaluations[0].equivalent_time
    least = min(found, key=lambda by: by.equivalent_ps, default=None)
    return (math.nan, "-") if least is None else (least.equivalent_ps * 1e-3, least.in_words())


def spent_s(rollout: Path) -> float:
    """Return the wall time of a rollout, of one in a batch its share of that."""
    with open_trajectory(rollout) as reader:
        return float(reader.record["cost"]["wall_s"])


def pace(scene: Scene, frame_nm: FloatArray, solvent: str) -> float:
    """Return how much MD in a solvent a core simulates now, ps of all replicas a second, by some steps."""
    here, spec = scene.with_positions(frame_nm), IMPLICIT
    if solvent == WATER.solvent:
        here, spec = solvate(replace(here, cell_nm=None), WATER, WaterBox()), WATER
    system = build_system(here, spec)
    run, start_nm = dynamics(system, 300.0, SEED), here.positions_nm
    if spec is WATER:
        start_nm = minimised(here, spec, system)
    run.set_positions(np.repeat(start_nm[None], run.n_replicas, axis=0))
    run.thermalise()
    began, steps = time.perf_counter(), PACE_STEPS[solvent]
    run.step(steps)
    return run.n_replicas * steps * TIMESTEP_PS / (time.perf_counter() - began)


def correlation_times_ps(series: Sequence[FloatArray]) -> FloatArray:
    """Return the integrated correlation time of each column of runs `(n_frames, k)`."""
    return FRAMES_PS * np.array([zero_crossing([x[:, k] for x in series])[1] for k in range(series[0].shape[1])])


def kinetics(md: Runs, of: Runs, psi: Sequence[int]) -> dict[str, float]:
    """Return by torsion number of ψ, and for the slowest coordinates, correlation times of `of` over MD's."""
    columns: dict[str, tuple[Runs, Runs]] = {
        f"ψ {k}": ([np.cos(x[:, [k]]) for x in md], [np.cos(x[:, [k]]) for x in of]) for k in psi
    }
    features = [[circular_features(x) for x in some] for some in (md, of)]
    slow = fit_projection(features[0], tica_lag(FRAMES_PS), 2)
    if slow is not None:
        ours, theirs = ([slow.project(x) for x in some] for some in features)
        for k in range(slow.matrix.shape[1]):
            columns[f"TICA {k}"] = [x[:, [k]] for x in ours], [x[:, [k]] for x in theirs]
    ratios = {name: correlation_times_ps(b) / correlation_times_ps(a) for name, (a, b) in columns.items()}
    return {name: float(ratio[0]) for name, ratio in ratios.items()}


def populations(wells: Sequence[Any], runs: Runs) -> FloatArray:
    """Return the population of every state of every torsion."""
    found = []
    for k, of in enumerate(wells):
        states = np.concatenate(of.assign([x[:, k] for x in runs]))
        found += (np.bincount(states, minlength=len(of.names)) / len(states)).tolist()
    return np.array(found)


def lag_errors(md: Runs, at_10: Runs, others: dict[float, Runs]) -> dict[str, float]:
    """Return for each lag how far populations are from those at 10 ps, over what halves of MD differ."""
    wells = [find_wells([x[:, k] for x in md]) for k in range(md[0].shape[1])]
    half = len(md) // 2
    floor = np.sqrt(np.mean((populations(wells, md[:half]) - populations(wells, md[half:])) ** 2))
    here = populations(wells, at_10)
    return {f"{lag:g} ps": float(np.sqrt(np.mean((populations(wells, x) - here) ** 2)) / floor)
            for lag, x in others.items()}  # fmt: skip


def endless(weights: Weights, scene: Scene, starts_nm: FloatArray, solvent: str | None) -> list[FloatArray]:
    """Return ENDLESS frames after each start, each when nothing is left of the one before."""
    fitted, _ = fit_weights(scene, weights, lag_ps=FRAMES_PS, force=True, solvent=solvent)
    model = cast(PeptideSlide, copy(fitted.model))
    model.lag_ps = model.config.forgotten_ps
    rows = math.ceil(ENDLESS / model.n_new)
    frames = torch.from_numpy(starts_nm).float().repeat_interleave(rows, dim=0)[:, None]
    noise = torch.randn(len(frames), *model.noise_shape(scene.n_atoms), generator=torch.Generator().manual_seed(SEED))
    with torch.no_grad():
        found = model.next_chunk(frames, model.featurise(scene), noise, solver_steps=model.usual_steps).frames_nm
    return [x.double().flatten(0, 1)[:ENDLESS].numpy() for x in found.split(rows)]


def population_errors(md: Runs, others: Mapping[str, Runs]) -> dict[str, float]:
    """Return how far populations of states are from MD's, of others and of MD's halves from each other, %."""
    wells = [find_wells([x[:, k] for x in md]) for k in range(md[0].shape[1])]
    pairs = {"MD's halves": (md[::2], md[1::2]), **{name: (x, md) for name, x in others.items()}}
    return {name: 100.0 * float(np.sqrt(np.mean((populations(wells, a) - populations(wells, b)) ** 2)))
            for name, (a, b) in pairs.items()}  # fmt: skip


def farthest_state(turns: Sequence[Turn], residues: Sequence[str], md: Runs, of: Runs, rare: Sequence[int]) -> str:
    """Return the state of a torsion, but of `rare` ones, whose population is farthest from MD's, and both populations
    with standard errors over runs."""
    kept = [k for k in range(len(turns)) if k not in rare]
    turns, md, of = [turns[k] for k in kept], [x[:, kept] for x in md], [x[:, kept] for x in of]
    wells = [find_wells([x[:, k] for x in md], fold=t.fold) for k, t in enumerate(turns)]
    each = [np.array([populations(wells, [x]) for x in some]) for some in (md, of)]
    here, there = ((x.mean(axis=0), x.std(axis=0, ddof=1) / math.sqrt(len(x))) for x in each)
    names = [f"{t.kind} of {residues[t.residue]} {t.residue + 1}, {name}"
             for t, w in zip(turns, wells, strict=True) for name in w.names]  # fmt: skip
    k = int(np.abs(here[0] - there[0]).argmax())
    percent = [f"{100 * mean[k]:.0f} ± {100 * error[k]:.0f}" for mean, error in (there, here)]
    return f"{names[k]}: {percent[0]} for {percent[1]} %"


def molecule(
    weights: Weights, reference: Reference, folder: Path, solvent: str | None, monomers: Path | None = None
) -> dict[str, Any]:
    """Roll a molecule and return its line of the table."""
    scene, time_ps, starts_nm = reference.scene, reference.time_ps, reference.starts_nm

    def files(lag_ps: float) -> list[Path]:
        return [folder / f"{lag_ps:g}ps-{k:02d}.h5" for k in range(len(starts_nm))]

    def roll(lag_ps: float) -> list[FloatArray]:
        return rolled(weights, scene, files(lag_ps), time_ps, lag_ps, solvent, starts_nm)

    own_nm = roll(FRAMES_PS)
    longest_ps = under_conditions(weights, {"solvent": solvent}).domain.longest_lag_ps
    lags = [lag for lag in LAGS_PS if lag <= min(time_ps / 2, longest_ps)]
    fitted, _ = fit_weights(scene, weights, lag_ps=FRAMES_PS, force=True, solvent=solvent)
    geometry = Geometry.from_dict(fitted.domain.geometry)
    valid = 100.0 * float(np.mean([((check_frames(x, geometry) & INVALID) == 0).mean() for x in own_nm]))
    turns = turns_of(scene)
    md, of = reference.torsions, [angles(turns, x) for x in own_nm]
    rare = rarely_positive(turns, md)
    counted = [[(~x).astype(np.float64) for x in shown(some, rare)] for some in (md, of)]
    kept = [k for k, both in enumerate(zip(*counted, strict=True)) if min(x.mean() for x in both) >= 0.5]
    md, of, *counted = ([some[k] for k in kept] for some in (md, of, *counted))
    at = {(t.kind, t.residue): k for k, t in enumerate(turns)}
    psi = [k for k, t in enumerate(turns) if t.kind == "psi"]
    pairs = [(k, at["phi", t.residue + 1]) for k, t in enumerate(turns)
             if t.kind == "psi" and ("phi", t.residue + 1) in at]  # fmt: skip
    amino_acids = [name for name in scene.residue_names if name not in ("ACE", "NME")]
    one = densities(md, counted[0]), densities(of, counted[1])
    joint = (joint_densities(md, counted[0], pairs), joint_densities(of, counted[1], pairs)) if pairs else None
    md_ps = pace(scene, starts_nm[0], reference.solvent) * spent_s(files(FRAMES_PS)[0])
    first = max(1, round(md_ps / FRAMES_PS))
    others: dict[str, Runs] = {f"MD of {len(md) * md_ps * 1e-3:.2g} ns": [x[:first] for x in md]}
    drawn = monomers and of_monomers(turns, amino_acids, monomers, trained_with(weights.provenance), md)
    if drawn:
        others["library of monomers"] = drawn
    usual = never(md, rare)
    at_endless = [angles(turns, x) for x in endless(weights, scene, starts_nm, solvent)]
    return {
        "frames": sum(map(len, md)),
        "torsions, single": over(single, *one),
        "torsions, pooled": over(pooled, *one),
        "joint maps, pooled": None if joint is None else over(pooled, *joint),
        "torsions, pooled, of others": {
            name: over(pooled, one[0], densities(x, [(~there).astype(np.float64) for there in shown(x, rare)]))
            for name, x in others.items()
        },
        "equivalent MD time": worst(reference.files, files(FRAMES_PS)) if reference.files else (math.nan, "-"),
        "MD's own, single": float(single(one[0], one[0]).mean()),
        "farthest state": farthest_state(turns, amino_acids, md, of, rare),
        "rare φ > 0": [f"{turns[k].kind} {turns[k].residue}" for k in rare],
        "kinetics": kinetics(usual, never(of, rare), psi),
        "kinetics of MD's halves": kinetics(usual[::2], usual[1::2], psi),
        "MDGen's recipe": published(scene, reference.frames_nm, own_nm)
        if len(psi) == 3 and len(amino_acids) == 4 and reference.files else None,
        "lags": lag_errors(md, of, {lag: [angles(turns, x) for x in roll(lag)] for lag in lags}),
        "populations, %": population_errors(md, {"rollouts": of, "endless times": at_endless}),
        "valid, %": valid,
    }  # fmt: skip


def summary(rows: dict[str, dict[str, Any]]) -> list[str]:
    """Return the gates, a line each."""
    lines = []
    for what in ("torsions, single", "torsions, pooled", "joint maps, pooled"):
        found = [row[what][0] for row in rows.values() if row[what]]
        if found:
            lines.append(f"{what}: mean {np.mean(found):.2f}, at most {max(found):.2f} of {len(found)}")
    for what in ("kinetics", "kinetics of MD's halves"):
        ratios = np.array([x for row in rows.values() for x in row[what].values() if math.isfinite(x)])
        off = np.exp(np.abs(np.log(ratios)))
        lines.append(f"{what}: {100 * np.mean(off < 1.4):.0f} % of {len(off)} within 1.4, at most {off.max():.1f} off")
    for lag in LAGS_PS:
        found = [row["lags"][f"{lag:g} ps"] for row in rows.values() if f"{lag:g} ps" in row["lags"]]
        if found:
            lines.append(
                f"populations at {lag:g} ps: {np.mean(found):.2f} of what MD's halves differ, at most {max(found):.2f}"
            )
    errors = {what: np.sqrt(np.mean([row["populations, %"][what] ** 2 for row in rows.values()]))
              for what in next(iter(rows.values()))["populations, %"]}  # fmt: skip
    lines.append("populations off MD's: " + ", ".join(f"{what} {x:.1f} %" for what, x in errors.items()))
    found = [row["equivalent MD time"][0] for row in rows.values()]
    if not np.isnan(found).all():
        lines.append(f"equivalent MD time by the worst measure: median {np.nanmedian(found):.3g} ns")
    tables = [row["MDGen's recipe"] for row in rows.values() if row["MDGen's recipe"]]
    for column in TABLE if tables else ():
        lines.append(f"MDGen's recipe, {column}: {np.nanmean([one[column][2] for one in tables]):.2f} of {len(tables)}")
    lines.append(f"valid: {np.mean([row['valid, %'] for row in rows.values()]):.2f} %")
    return lines


def table_row(name: str, row: dict[str, Any]) -> dict[str, Any]:
    """Return a molecule's line of the tables, by column; distances, correlation times and populations over MD's own."""

    def ratio(found: Sequence[float] | None) -> str:
        return "-" if not found else f"{found[0]:.2f} ± {found[1]:.2f}"

    def between(found: dict[str, float]) -> str:
        return f"{min(found.values()):.2f} to {max(found.values()):.2f}"

    (md, bought_then), *others = row["torsions, pooled, of others"].items()
    return {
        "molecule": name,
        "frames": row["frames"],
        "torsions, one run": ratio(row["torsions, single"]),
        "torsions, pooled": ratio(row["torsions, pooled"]),
        "MD of the same wall time": f"{ratio(bought_then)} ({md.removeprefix('MD of ')})",
        "library of monomers": ratio(others[0][1] if others else None),
        "joint maps, pooled": ratio(row["joint maps, pooled"]),
        "equivalent MD time": row["equivalent MD time"][1],
        "correlation times": between(row["kinetics"]),
        "MD's halves": between(row["kinetics of MD's halves"]),
        "populations at 100 ps, 1 ns": ", ".join(f"{x:.2f}" for x in row["lags"].values()),
        "farthest state of a torsion, for MD's": row["farthest state"],
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--weights", required=True)
    parser.add_argument("--test", type=Path, default=RECORD)
    parser.add_argument("--solvent")
    parser.add_argument("--library", type=Path)
    parser.add_argument("--molecules", nargs="+")
    parser.add_argument("-o", "--out", type=Path)
    a = parser.parse_args(arguments)
    weights, rows = load_weights(weights_path(a.weights)), {}
    for reference in references(a.test):
        name = reference.name
        if a.molecules and name not in a.molecules:
            continue
        rows[name] = molecule(weights, reference, a.folder / name, a.solvent, a.library)
        sys.stdout.write(f"{name}: {json.dumps(rows[name], ensure_ascii=False)}\n")
        sys.stdout.flush()
    if not rows:
        raise SystemExit(f"{a.test} holds none of {', '.join(a.molecules)}.")
    sys.stdout.write("\n".join(summary(rows)) + "\n")
    if a.out is not None:
        given = [f"--weights {a.weights}", *([] if a.test == RECORD else ["--test CAMPAIGN/test"]),
                 *(["--solvent", a.solvent] if a.solvent else []),
                 *(["--library CAMPAIGN/train"] if a.library else [])]  # fmt: skip
        lines = [table_row(*each) for each in rows.items()]
        columns = [key for key in lines[0] if any(line[key] != "-" for line in lines)]
        first = columns.index(LAST_DISTANCE) + 1
        about = {"command": " ".join(["python docs/studies/training/peptide_unseen.py FOLDER", *given]),
                 "machine": machine_name()}  # fmt: skip
        for out, shown_here, note in (
            (a.out, columns[:first], "; ".join(summary(rows)) + "."),
            (a.out.with_stem(f"{a.out.stem}_states"), [columns[0], *columns[first:]], ""),
        ):
            table = {"columns": shown_here, "rows": [[line[key] for key in shown_here] for line in lines], **about}
            out.write_text(json.dumps(table | {"note": note}, indent=1, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
