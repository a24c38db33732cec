"""Record of a rollout: settings, provenance and account in its files, and the lines shown while it runs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any

import torch

from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.config import RolloutConfig
from surrogate.sampling.guards import Guard
from surrogate.sampling.interventions import Chunk
from surrogate.sampling.rollout_account import Tally
from surrogate.sampling.rollout_checkpoint import Progress
from surrogate.sampling.rollout_plan import Plan
from systems.trajectory.base import TrajectoryWriter
from systems.units import format_time_ps

# Options that stand in a part of the record, by its name.
_ACCOUNTS = {"interventions": ("guard", "energy_every", "md_between_ps"), "selection": ("atoms", "select")}


def new_record(plan: Plan, sampler: ChunkSampler, checks: Guard, *, replica: int) -> dict[str, Any]:
    """Return the record that a replica's file begins with."""
    config, weights = plan.config, plan.weights
    record = {
        "kind": "rollout",
        "model": weights.model.arch,
        "weights": weights.path.name,
        "weights_hash": weights.hash,
        "program": {"torch": torch.__version__},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "completed": False,
        "replica": replica,
        **_asked(config),
        "save_every_ps": plan.save_every_ps,
        "lag_ps": weights.domain.lag_ps,
        "precision": sampler.precision.name,
        "precision_reason": sampler.precision.reason,
        "solver": sampler.solver,
        "chunk_frames": sampler.n_new,
        **weights.domain.conditions,
        "interventions": _interventions(plan, Tally(), {}, checks),
    }
    if not plan.match.seen:
        record["unseen_molecule"] = True
    if plan.match.deviations:
        record["out_of_domain"] = [deviation.to_dict() for deviation in plan.match.deviations]
    if len(plan.kept_atoms) < plan.scene.n_atoms:
        record["selection"] = {**_asked(config, "selection"), "of_atoms": plan.scene.n_atoms}
    if plan.shift_nm.any() != plan.scene.positions_nm.mean(axis=0).any():
        record["moved_nm"] = (-plan.scene.positions_nm.mean(axis=0)).tolist()
    return record


def _asked(config: RolloutConfig, account: str = "") -> dict[str, Any]:
    """Return the options of one account of the record, else all that stand in none. How long it is, its frames say."""
    options = asdict(config)
    apart = {"time_ps", *chain(*_ACCOUNTS.values())}
    return {name: options[name] for name in _ACCOUNTS.get(account) or (name for name in options if name not in apart)}


def _interventions(plan: Plan, tally: Tally, seconds: dict[str, float], checks: Guard) -> dict[str, Any]:
    return {
        **_asked(plan.config, "interventions"),
        **tally.to_record(),
        "seconds": {key: round(value, 3) for key, value in seconds.items()},
        "unchecked": list(checks.unchecked),
    }


def close_account(plan: Plan, state: Progress, checks: Guard, sampler: ChunkSampler,
                   writers: Sequence[TrajectoryWriter], *, completed: bool) -> None:  # fmt: skip
    """Enter what was done and what it cost, by now or in all."""
    for writer, tally in zip(writers, state.tallies, strict=True):
        done = {"completed": True} if completed else {}
        account = _interventions(plan, tally, state.seconds, checks)
        writer.update_record(
            {"interventions": account, "cost": _cost(plan, state, tally, sampler, len(writers)), **done}
        )


def _cost(plan: Plan, state: Progress, tally: Tally, sampler: ChunkSampler, n_replicas: int) -> dict[str, Any]:
    """A replica's share of the batch: wall seconds and network evaluations divided by the replicas."""
    wall_s = max(state.wall_s, 1e-9) / n_replicas
    n_frames = min(state.steps // plan.stride, plan.n_frames)
    return {
        "wall_s": wall_s,
        "batch_wall_s": state.wall_s,
        "network_evaluations": round((state.chunks + tally.draws) * sampler.evaluations_per_chunk),
        "ns_per_day": n_frames * plan.save_every_ps * 1e-3 / wall_s * 86400.0,
        "guard_share": sum(v for k, v in state.seconds.items() if k != "draw") / max(state.wall_s, 1e-9),
        "batch": sampler.batch or n_replicas,
    }


@dataclass(frozen=True)
class Speed:
    """Speed since this process began: what an interrupted run did before does not count."""

    steps: int
    since: float

    def describe(self, plan: Plan, state: Progress, n_replicas: int) -> str:
        """Return '24200 ns/day, 290 frames/s, 3 helped': of all replicas together; chunks that were helped."""
        elapsed = max(time.monotonic() - self.since, 1e-9)
        per_s = (state.steps - self.steps) * n_replicas / elapsed
        helped = sum(tally.chunks_caught for tally in state.tallies)
        word = "caught" if plan.config.guard in ("off", "flag") else "helped"
        ns_per_day = per_s * plan.weights.domain.lag_ps * 86.4
        return f"{ns_per_day:.3g} ns/day, {per_s / plan.stride:.3g} frames/s, {helped} {word}"


def why_stopped(plan: Plan, state: Progress, chunk: Chunk, outs: Sequence[Path]) -> str:
    """Return why a rollout cannot go on, where, and what to do."""
    assert chunk.failure is not None
    row, reason = chunk.failure
    at = f"after {format_time_ps(state.steps * plan.weights.domain.lag_ps)}" if state.steps else "in its first chunk"
    if plan.config.guard in ("off", "flag"):
        advice = f"the frames are marked in {outs[row]}. Try `precision='fp32'`, `guard='repair'` or other weights."
        if plan.config.guard == "flag":
            advice += " With `guard='off'` nothing stops it."
    else:
        advice = f"the frames before are in {outs[row]}. Use other weights, or `surromd reference` for this molecule."
    return f"replica {row}, {at}: {reason}; {advice}"
