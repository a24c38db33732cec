"""Runs of many peptides from diverse starts: `python docs/studies/training/peptide_runs.py FOLDER --budget 3h`.

What the weights `peptides` learn from (`FOLDER/train`) and are tested on (`FOLDER/test`). Each molecule gets a folder
with `run_000.h5`, ...: ff14SB, OBC2, 300 K, 4 fs, frames 1 ps apart, sixteen runs at once (`md_reference.simd`,
checked against OpenMM for each molecule). Runs for training start from structures chosen from metadynamics
(`seeds.npz`), 20 ps after each start discarded; those for testing from the built structure, 1 ns discarded. What is
there is left alone, so that the same command goes on after an interruption. One process a core, at low priority.
"""

from __future__ import annotations

import json
import os
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from peptide_list import Peptide, held_out_peptides, training_peptides
from peptide_seeds import Seeds, choose_seeds
from processes import arguments_of, in_order, only_here, run_path, simulate_runs

from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import SIMD, MDConfig
from md_reference.run.engine import Engine
from md_reference.simd.force_field import n_replicas
from systems.prepare.peptide import build_peptide
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

DISCARD_PS, TEST_DISCARD_PS = 20.0, 1000.0
_SPEC = ForceFieldSpec("ff14SB", "obc2")
# Metadynamics needs OpenMM; of tiny molecules its Reference platform is the fastest.
_PLATFORM = "Reference"


def simulate_peptide(folder: Path, peptide: Peptide, deadline: float, *, seeded: bool = True) -> None:
    """Make a peptide's missing runs, until the deadline; `seeded` as for training, otherwise as for testing.

    Raises SimulationError.
    """
    with only_here(folder) as free:
        if not free:
            return
        missing = [k for k in range(peptide.n_starts) if not run_path(folder, k).exists()]
        if not missing or time.time() > deadline:
            return
        scene = build_peptide(peptide.sequence)
        seeds = _seeds(folder / "seeds.npz", scene, peptide) if seeded else _built(scene, peptide)
        while missing and time.time() < deadline:
            missing = missing[
                simulate(scene, seeds, missing, folder, peptide, TEST_DISCARD_PS if not seeded else DISCARD_PS) :
            ]


def _seed_of(peptide: Peptide, k: int) -> int:
    return zlib.crc32(f"{peptide.name}:{k}".encode()) % (2**31 - 2)


def _built(scene: Scene, peptide: Peptide) -> Seeds:
    """Return the built structure, its energy minimised, as often as there are runs."""
    with Engine(scene, MDConfig(time_ps=1.0, force=_SPEC, platform=_PLATFORM)) as engine:
        engine.minimise()
        positions = engine.positions()
    return Seeds(np.repeat(positions[None], peptide.n_starts, axis=0), ("built",) * peptide.n_starts)


def _seeds(path: Path, scene: Scene, peptide: Peptide) -> Seeds:
    if path.exists():
        with np.load(path) as stored:
            return Seeds(stored["positions_nm"], tuple(str(g) for g in stored["groups"]))
    seeds = choose_seeds(scene, peptide.n_starts, seed=_seed_of(peptide, -1), platform=_PLATFORM)
    part = path.with_suffix(".part.npz")
    np.savez_compressed(part, positions_nm=seeds.positions_nm, groups=np.array(seeds.groups))
    os.replace(part, path)
    return seeds


def simulate(
    scene: Scene, seeds: Seeds, wanted: Sequence[int], folder: Path, peptide: Peptide, discard_ps: float
) -> int:
    """Simulate from the first of the `wanted` starts, as many as go at once; return how many.

    Their files get their names when all frames are there. Raises SimulationError.
    """
    wanted = list(wanted[: n_replicas()])
    config = MDConfig(
        time_ps=peptide.time_ps, equilibrate_ps=discard_ps, seed=_seed_of(peptide, wanted[0]), force=_SPEC,
        platform=SIMD,
    )  # fmt: skip
    notes = [{"start": {"group": seeds.groups[k], "index": k, "discarded_ps": discard_ps}} for k in wanted]
    simulate_runs(scene, config, folder, wanted, starts_nm=seeds.positions_nm[wanted], notes=notes)
    return len(wanted)


def _order() -> list[tuple[Peptide, bool]]:
    """Return all molecules and whether each is for training: monomers, pairs, what is tested, chains."""
    training, tested = training_peptides(), held_out_peptides()
    short = [p for p in training if p.capped and len(p.residues) <= 2]
    return [
        *((p, True) for p in short),
        *((p, False) for p in tested if len(p.residues) <= 2),
        *((p, True) for p in training if p not in short),
        *((p, False) for p in tested if len(p.residues) > 2),
    ]


def _make(task: tuple[Peptide, bool], deadline: float, folder: str) -> None:
    peptide, training = task
    place = Path(folder) / ("train" if training else "test") / peptide.name
    simulate_peptide(place, peptide, deadline, seeded=training)


def summary(folder: Path) -> dict[str, Any]:
    """Return what is there: runs and simulated ns of each molecule, and in all."""
    rows = {}
    for peptide, training in _order():
        name = f"{'train' if training else 'test'}/{peptide.name}"
        done = sorted((folder / name).glob("run_*.h5"))
        if done:
            rows[name] = {"runs": len(done), "of": peptide.n_starts, "ns": len(done) * peptide.time_ps * 1e-3}
    return {"molecules": rows, "ns": sum(row["ns"] for row in rows.values())}


def check(folder: Path) -> list[str]:
    """Read every run and return what is wrong: files that cannot be opened, frames that are missing."""
    wrong = []
    for peptide, training in _order():
        for path in sorted((folder / ("train" if training else "test") / peptide.name).glob("run_*.h5")):
            with open_trajectory(path) as reader:
                if reader.n_frames != round(peptide.time_ps):
                    wrong.append(f"{path}: {reader.n_frames} frames")
    return wrong


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = arguments_of(__doc__, {"--summary": "say what is there and check it; simulate nothing"}, arguments)
    if chosen.summary:
        print(json.dumps({**summary(chosen.folder), "wrong": check(chosen.folder)}, indent=1))  # noqa: T201
        return
    in_order(_order, _make, chosen.budget_s, chosen.workers, str(chosen.folder))
    print(json.dumps(summary(chosen.folder)["ns"]))  # noqa: T201


if __name__ == "__main__":
    main()
