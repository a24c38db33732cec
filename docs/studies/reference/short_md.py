"""Populations by short MD from frames of a rollout: by MD's transitions alone, by the rollout, and by both together.

    python docs/studies/reference/short_md.py data FOLDER [--molecules GLN-ILE ...]
    python docs/studies/reference/short_md.py table FOLDER [-o TABLE.json]

`data` makes for each molecule sets of one rollout (8 x 60 ns, `peptides`) and 32 SIMD replicas of MD from its frames,
long MD from frames of all rollouts, and 32 replicas from one structure, twice as long; what is there is left alone, and
what was stopped goes on. `table` takes the first part of the short replicas and lays what they tell beside long MD (its
first 5 ns left out): root mean square error of the populations of all states of all torsions in per cent, root mean
square over sets, and how many 95 % intervals of populations hold. MD from one structure is averaged plainly and has
twice the length, as a rollout may take half of the time.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from error_against_minutes import KELVIN, LongMD, intervals_held, said, stretch

import surrogate as sm
from md_reference.run.config import MDConfig
from md_reference.run.machine import machine_name
from md_reference.run.replicas import simulate_batch
from md_reference.run.starts import frames_as_starts
from md_reference.simd.force_field import n_replicas
from surrogate.comparison.md_answer import frames_over_states, md_answer
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.verbs.options import ReferenceOptions
from surrogate.verbs.simulate import resolve_run
from systems.library.named_scenes import prepare
from systems.scene import Scene
from systems.trajectory.checkpoint import checkpoint_path

# What `prepare` takes; ns of long MD, of short MD, and sets.
MOLECULES = {
    "GLN-ILE": ("sequence:ACE-GLN-ILE-NME", 40.0, 6.5, 4),
    "VAL-SER-GLU-PHE": ("sequence:ACE-VAL-SER-GLU-PHE-NME", 50.0, 3.5, 4),
    "TYR-ASP": ("sequence:ACE-TYR-ASP-NME", 40.0, 6.0, 3),
}
WEIGHTS, ROLLED_PS, ROLLED, BATCHES = "peptides", 60e3, 8, 2
EVERY_PS, LEFT_OUT_PS = 10.0, 20.0
LENGTHS_NS = (0.75, 1.5, 3.0, 6.0)


def rolled_files(place: Path, number: int) -> list[Path]:
    return [place / f"rolled{number}_r{k}.h5" for k in range(ROLLED)]


def batch(place: Path, name: str) -> list[Path]:
    return [place / f"{name}_r{k}.h5" for k in range(n_replicas())]


def short_files(place: Path, number: int) -> list[list[Path]]:
    return [batch(place, f"md{number}_{b}") for b in range(BATCHES)]


def one_files(place: Path) -> list[list[Path]]:
    return [batch(place, f"one{b}") for b in range(BATCHES)]


def settings(source: str, ns: float, seed: int, starts: str = "many") -> tuple[Scene, MDConfig]:
    options = ReferenceOptions(
        time_ps=1e3 * ns, save_every_ps=EVERY_PS, seed=seed, platform="simd", equilibrate_ps=LEFT_OUT_PS,
        starts=starts, quiet=True,
    )  # fmt: skip
    return resolve_run(prepare(source), options, {"time_ps": options.time_ps}, quiet=True)[:2]


def from_frames(
    source: str, ns: float, seed: int, rolled: Sequence[Path], batches: Sequence[list[Path]], pick: int
) -> None:
    """Make batches of MD from frames of a rollout, drawn by the seed `pick`."""
    for number, files in enumerate(batches):
        scene, config = settings(source, ns, seed + number)
        starts = None
        if not files[0].exists():
            n = len(batches) * len(files)
            frames = frames_over_states(load_ensemble(rolled), 2 * n, seed=pick)
            begun, _ = frames_as_starts(scene, config, frames, n)
            starts = np.stack([s.positions_nm for s in begun[number * len(files) :][: len(files)]])
        simulate_batch(scene, config, files, resume=True, starts_nm=starts)


def make_data(place: Path, name: str) -> None:
    source, long_ns, short_ns, sets = MOLECULES[name]
    place.mkdir(parents=True, exist_ok=True)
    for number in range(sets):
        rolled = rolled_files(place, number)
        sm.rollout(
            source, WEIGHTS, place / f"rolled{number}.h5", time_ps=ROLLED_PS, save_every_ps=EVERY_PS, replicas=ROLLED,
            seed=100 + number, resume=True, quiet=True,
        )  # fmt: skip
        from_frames(source, short_ns, 1000 * number + 1, rolled, short_files(place, number), number)
        said(f"{name}: set {number}")
    every = [rolled_files(place, number)[k] for k in range(ROLLED) for number in range(sets)]
    from_frames(source, long_ns, 77_777, every, [batch(place, "ref")], 9)
    for b, files in enumerate(one_files(place)):
        scene, config = settings(source, 2.0 * short_ns, 5_000 + b, "one")
        simulate_batch(scene, config, files, resume=True)
    said(f"{name}: long MD, and MD from one structure")


def rows_of(place: Path, name: str) -> list[dict[str, Any]]:
    """Return for each length of short MD the errors of each way, and the intervals that hold."""
    ref = LongMD.of(batch(place, "ref"))
    said(f"{name}: {len(ref.files)} x {ref.answer.replica_ps / 1e3:.0f} ns, split R-hat {ref.r_hat:.3f}")

    def first(of: Ensemble, ns: float) -> Ensemble:
        return stretch(of, 0, round(1e3 * ns / EVERY_PS))

    def load(batches: Sequence[list[Path]]) -> Ensemble:
        return ref.load([f for files in batches for f in files])

    ones = one_files(place)
    one = load(ones) if ones[-1][0].exists() and not checkpoint_path(ones[-1][0]).exists() else None
    rows = []
    sets = [k for k in range(MOLECULES[name][3]) if short_files(place, k)[-1][0].exists()]
    loaded = [(load(short_files(place, k)), ref.load(rolled_files(place, k))) for k in sets]
    for ns in LENGTHS_NS:
        if ns > MOLECULES[name][2]:
            continue
        errors: dict[str, list[float]] = {}
        held = {"MD": [0, 0], "both": [0, 0]}
        for md, rolled in ((first(m, ns), r) for m, r in loaded):
            alone, both = md_answer(md, KELVIN), md_answer(md, KELVIN, surrogate=rolled)
            found = {
                "MD": ref.errors(md, alone.weights)[1], "both": ref.errors(md, both.weights)[1],
                "plain": ref.errors(md)[1], "rolled": ref.errors(rolled)[1], "joint": float(both.is_joint),
                "stated": 100.0 * math.sqrt(float(np.mean([s.error**2 for s in both.states if not s.missing]))),
            }  # fmt: skip
            for way, error in found.items():
                errors.setdefault(way, []).append(error)
            for way, answer in (("MD", alone), ("both", both)):
                held[way] = [
                    a + b for a, b in zip(held[way], intervals_held(answer.to_dict(), ref.answer), strict=True)
                ]
        mean = {way: math.sqrt(float(np.mean(np.square(each)))) for way, each in errors.items()}
        mean["joint"] = sum(errors["joint"])
        if one is not None:
            mean["one"] = ref.errors(first(one, 2.0 * ns))[1]
        rows.append({"molecule": name, "ns": ns, "sets": len(sets), "held": held, **mean})
        said(f"  {rows[-1]}")
    return rows


def make_table(folder: Path, out: Path) -> None:
    rows = [r for name in MOLECULES if (folder / name).is_dir() for r in rows_of(folder / name, name)]
    ways = {"one": "MD from one structure, twice as long", "MD": "MD from rollout frames, its transitions",
            "plain": "the same, plain averages", "rolled": "rollout", "both": "`surromd run`: MD and rollout",
            "stated": "its stated error"}  # fmt: skip

    def ratio(way: str) -> float:
        return float(np.median([r["both"] / r[way] for r in rows if way in r]))

    table = {
        "command": "python docs/studies/reference/short_md.py table FOLDER",
        "machine": machine_name(),
        "note": "Root mean square error of populations, %, over all states and sets. Both over MD's transitions alone: "
        f"median {ratio('MD'):.2f}; over MD from one structure {ratio('one'):.2f}; over the rollout "
        f"{ratio('rolled'):.2f}.",
        "columns": ["molecule, 32 replicas of, sets", *ways.values(), "together in", "intervals hold: MD", "both"],
        "rows": [
            [f"{r['molecule']}, {r['ns']:g} ns, {r['sets']}", *(f"{r[w]:.2g}" if w in r else "" for w in ways),
             f"{r['joint']:.0f} of {r['sets']}", *("{} of {}".format(*r["held"][w]) for w in ("MD", "both"))]
            for r in rows
        ],
    }  # fmt: skip
    out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n", "utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("data", "table"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--molecules", nargs="+", choices=list(MOLECULES), default=list(MOLECULES))
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/results/tables/short_md.json"))
    given = parser.parse_args()
    if given.what == "table":
        make_table(given.folder, given.out)
        return
    for name in given.molecules:
        make_data(given.folder / name, name)


if __name__ == "__main__":
    main()
