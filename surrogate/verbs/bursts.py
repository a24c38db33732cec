"""Short MD from a rollout's frames, where long MD is too dear to judge it by."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surrogate.progress import progress_bar
from surrogate.verbs.options import BurstOptions, Trajectories
from surrogate.verbs.outputs import find_trajectories
from systems.errors import InputError
from systems.interrupts import stop_if_asked
from systems.takes import takes

if TYPE_CHECKING:
    from surrogate.judge.burst_check import BurstCheck

_NEEDED = ("force_field", "solvent", "temperature_k", "timestep_ps")


@takes(BurstOptions)
def bursts(rollout: Trajectories, *, options: BurstOptions) -> BurstCheck:
    """Run short MD from frames of a rollout and return whether it moves between states as MD does.

    `rollout`: a trajectory whose file says under which conditions its weights were trained, or several replicas.
    `n_bursts` starts are spread evenly over the rollout's metastable states; each is run for `burst_ps` with velocities
    drawn anew (`surrogate.judge.burst_check`). The result says whether transitions agree and how far reweighted
    populations are from the rollout's; it is no worth in ns, and says nothing of states that the rollout never visits.
    Raises InputError for a trajectory that does not say its conditions or has no two states, SimulationError when MD
    cannot be run from a frame.
    """
    from md_reference.forces.forcefield import build_system, resolve
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.config import Conditions
    from md_reference.run.engine import Engine
    from md_reference.run.frame_relaxation import Relaxer
    from surrogate.judge.burst_check import States, judge_bursts
    from surrogate.judge.read.ensemble import load_ensemble

    paths = find_trajectories(rollout)
    candidate = load_ensemble(paths)
    record = candidate.record
    missing = [key for key in _NEEDED if record.get(key) is None]
    if missing:
        raise InputError(f"{Path(paths[0]).name} does not say which {' and '.join(missing)} MD of it needs.")
    states = States(candidate, options.burst_ps)
    starts = states.starts(options.n_bursts, np.random.default_rng(options.seed))
    conditions = Conditions(
        resolve(candidate.scene, ForceFieldSpec.of(record)),
        temperature_k=record["temperature_k"],
        friction_per_ps=record.get("friction_per_ps") or 1.0,
        timestep_ps=record["timestep_ps"],
        seed=options.seed,
    )
    ends = np.empty((len(starts), candidate.scene.n_atoms, 3))
    n_steps = round(states.lag_ps / conditions.timestep_ps)
    system = build_system(candidate.scene, conditions.force)
    with (
        closing(Relaxer(candidate.scene, system, born=conditions.force.is_born)) as relaxer,
        Engine(candidate.scene, conditions, system=system) as engine,
        progress_bar(f"bursts of {candidate.scene.name}", quiet=options.quiet) as progress,
    ):
        for k, start in enumerate(starts):
            stop_if_asked()
            frame = np.asarray(candidate.segments[start.segment][start.frame : start.frame + 1], dtype=np.float64)[0]
            engine.set_positions(relaxer.relax(frame).positions_nm)
            engine.thermalise()
            engine.step(n_steps)
            ends[k] = engine.positions()
            if progress is not None:
                progress(k + 1, len(starts))
    return judge_bursts(states, starts, states.of(ends), options.seed)
