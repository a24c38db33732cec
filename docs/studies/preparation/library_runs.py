"""Every scene of the library, run for 10 ps by its paper's protocol, else by the defaults, and looked at:
`python docs/studies/preparation/library_runs.py`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from systems.errors import SurromdError
from systems.units import parse_time_ps

# One of each kind that is made on demand, beside all that ship.
ON_DEMAND = ("ACE-SER-GLY-NME", "SDFS")


@dataclass(frozen=True)
class Outcome:
    """One scene: what it ran with, how long it took, what its frames are worth; `reason` says why it did not run."""

    name: str
    n_atoms: int = 0
    force_field: str = ""
    solvent: str = ""
    ensemble: str = ""
    timestep_fs: float = 0.0
    platform: str = ""
    n_frames: int = 0
    seconds: float = 0.0
    bath_k: float = 0.0
    temperature_k: float = 0.0
    invalid_frames: int = 0
    energy_spread: float = 0.0
    reason: str = ""

    @property
    def passed(self) -> bool:
        """Whether all frames came, are valid, and readable by others."""
        return not self.reason and self.n_frames > 0 and self.invalid_frames == 0


def run_scene(name: str, folder: Path, *, time_ps: float = 10.0) -> Outcome:
    """Run one scene by its first protocol, if it has one, equilibrated for ten relaxation times of the bath, and check
    the file it wrote.

    Frames must number what was asked for, pass the checks of `systems.chemistry.validity`, and open in MDTraj and
    MDAnalysis with the same coordinates. `energy_spread`: in NVE, the standard deviation of the total energy over the
    mean kinetic one.
    """
    from md_reference.run.config import resolve_settings, to_config
    from md_reference.run.simulate import simulate
    from systems.chemistry.validity import INVALID, check_frames, geometry_from_scene
    from systems.library import named_scenes
    from systems.trajectory.codec import open_trajectory

    began = time.perf_counter()
    try:
        scene = named_scenes.load(name)
        settings, _ = resolve_settings(scene, {}, next(iter(named_scenes.entry(name).protocols), None))
        settings |= {
            "time_ps": time_ps,
            "equilibrate_ps": min(settings["equilibrate_ps"], 10.0 / settings["friction_per_ps"]),
        }
        config = to_config(settings, seed=1)
        path = simulate(scene, config, folder / f"{name.replace(':', '-')}.h5", overwrite=True)
        with open_trajectory(path) as reader:
            frames, record, scalars = reader.read(), dict(reader.record), dict(reader.scalars)
        reason = _elsewhere(path, frames)
    except SurromdError as error:
        return Outcome(name, reason=" ".join(str(error).split()), seconds=time.perf_counter() - began)
    if len(frames) != config.n_frames:
        reason = f"{len(frames)} of {config.n_frames} frames"
    elif not np.isfinite(scalars["potential_kj_mol"]).all():
        reason = "an energy is not finite"
    flags = check_frames(frames, geometry_from_scene(scene))
    summary: dict[str, Any] = record.get("summary") or {}
    return Outcome(
        name,
        n_atoms=scene.n_atoms,
        force_field=record["force_field"],
        solvent=record["solvent"],
        ensemble=record["ensemble"],
        timestep_fs=1000.0 * config.timestep_ps,
        platform=record["platform"],
        n_frames=len(frames),
        seconds=time.perf_counter() - began,
        bath_k=0.0 if config.ensemble == "nve" else config.temperature_k,
        temperature_k=float(np.mean(scalars["temperature_k"])),
        invalid_frames=int(np.count_nonzero(flags & INVALID)),
        energy_spread=_energy_spread(summary, scene.n_atoms) if config.ensemble == "nve" else 0.0,
        reason=reason,
    )


def _energy_spread(summary: dict[str, Any], n_atoms: int) -> float:
    from systems.units import GAS_CONSTANT_KJ_MOL_K

    kinetic = 1.5 * n_atoms * GAS_CONSTANT_KJ_MOL_K * float(summary["temperature_k"]["mean"])
    return float(summary["total_kj_mol"]["standard_deviation"]) / kinetic


def _elsewhere(path: Path, frames: Any) -> str:
    """What is wrong with the file for MDTraj or MDAnalysis; empty when both read these frames."""
    import MDAnalysis
    import mdtraj

    from systems.trajectory.companion_writer import topology_path

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not np.allclose(mdtraj.load(str(path)).xyz, frames, atol=1e-5):
            return "MDTraj reads other coordinates"
        universe = MDAnalysis.Universe(str(topology_path(path)), str(path), format="H5MD")
        last = universe.trajectory[-1].positions / 10.0
        if universe.trajectory.n_frames != len(frames) or not np.allclose(last, frames[-1], atol=1e-5):
            return "MDAnalysis reads other coordinates"
    return ""


def run_library(names: Sequence[str], folder: Path, *, time_ps: float = 10.0, say: Any = None) -> list[Outcome]:
    """Run scenes one after the other; `say` is called with each outcome."""
    outcomes = []
    for name in names:
        outcomes.append(run_scene(name, folder, time_ps=time_ps))
        if say is not None:
            say(outcomes[-1])
    return outcomes


def table_row(outcome: Outcome) -> str:
    """Return one line of the printed table."""
    if outcome.n_frames == 0:
        return f"{outcome.name:<20} refused: {outcome.reason}"
    bath = f"{outcome.bath_k:.0f}" if outcome.bath_k else "-"
    verdict = "ok" if outcome.passed else outcome.reason or f"{outcome.invalid_frames} invalid frames"
    nve = outcome.ensemble == "nve"
    spread = f", total energy ±{100.0 * outcome.energy_spread:.2g} % of the kinetic" if nve else ""
    return (
        f"{outcome.name:<20} {outcome.n_atoms:>5} {outcome.force_field + '/' + outcome.solvent:<14} "
        f"{outcome.ensemble:<4} {outcome.timestep_fs:>4g} fs {outcome.platform:<10} {outcome.n_frames:>6} frames "
        f"{outcome.seconds:>7.1f} s {outcome.temperature_k:>6.0f} K ({bath})  {verdict}{spread}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is named, or all; return 1 when a scene does not run."""
    from systems.library import named_scenes

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="scenes; all of the library and some on demand without any")
    parser.add_argument("--time", default="10ps", help="length of each run")
    parser.add_argument("--json", type=Path, help="write the outcomes to this file")
    asked = parser.parse_args(arguments)
    listed = [name for members in named_scenes.groups().values() for name in members]
    with tempfile.TemporaryDirectory(prefix="surromd-library-") as folder:
        outcomes = run_library(
            asked.names or [*listed, *ON_DEMAND],
            Path(folder),
            time_ps=parse_time_ps(asked.time, "--time"),
            say=lambda outcome: print(table_row(outcome), flush=True),  # noqa: T201
        )
    if asked.json:
        asked.json.write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=2))
    good = sum(outcome.passed for outcome in outcomes)
    print(f"{good} of {len(outcomes)} scenes ran for {asked.time}")  # noqa: T201
    return 0 if good == len(outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
