"""Rollouts in chunks to any length: replicas in one batch, frames checked as they are made, streamed, resumable."""

from __future__ import annotations

import hashlib
import io
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from surrogate.models.potential import Potential
from surrogate.models.weights import Weights
from surrogate.sampling.chunks import (
    BLOWN_UP,
    Chunk,
    ChunkSampler,
    Guard,
    Interventions,
    Progress,
    Tally,
    noise_seed,
    none_through,
)
from surrogate.sampling.config import RolloutConfig as RolloutConfig
from surrogate.sampling.coupling import Coupling, PotentialChecks
from surrogate.sampling.domain import DomainMatch, fit_weights, in_bath, in_step
from systems.chemistry.graph import STIFF_BOND, STIFF_STEP_PS
from systems.chemistry.validity import INVALID, Geometry, check_frames
from systems.errors import InputError, SimulationError, first_line
from systems.files.outside import UNREADABLE, arrays_in, check_disk
from systems.files.schema import built
from systems.interrupts import deferred_interrupt
from systems.prepare.ring_conformers import conformer_of, ring_conformers
from systems.scene import Scene, part_of, select_atoms
from systems.trajectory import checkpoint
from systems.trajectory.base import TrajectoryWriter
from systems.trajectory.codec import DIFFERENCE_COLUMN, open_trajectory
from systems.units import format_time_ps, whole_steps

# Plan of a rollout: everything that is settled before the first chunk.

# Farther from the origin float32 coordinates are too coarse for a molecule; frames are then written about it.
_FAR_NM = 1000.0


class Plan(NamedTuple):
    """What a rollout works with, settled before the first chunk."""

    scene: Scene
    weights: Weights
    config: RolloutConfig
    match: DomainMatch
    kept_atoms: npt.NDArray[np.int64]  # of the scene
    shift_nm: npt.NDArray[np.float64]  # added to frames when they are written
    save_every_ps: float
    stride: int
    n_frames: int
    settings: dict[str, Any]

    @property
    def n_steps(self) -> int:
        return self.n_frames * self.stride


def resolve_plan(
    scene: Scene, weights: Weights, match: DomainMatch, config: RolloutConfig, sampler: ChunkSampler, *, n_replicas: int
) -> Plan:
    """Turn durations into numbers of frames; `weights` and `match` are what `domain.fit_weights` made of the scene.

    Raises UnitError for intervals that do not divide, InputError for a selection that means no atom.
    """
    lag_ps = weights.domain.lag_ps
    save_every_ps = lag_ps if config.save_every_ps is None else config.save_every_ps
    stride = whole_steps(save_every_ps, lag_ps, "save interval in the weights' frame spacing")
    n_frames = whole_steps(config.time_ps, save_every_ps, "rollout length in save intervals")
    kept = np.arange(scene.n_atoms) if config.atoms == "all" else scene.heavy_idx
    if config.select is not None:
        kept = np.intersect1d(kept, select_atoms(scene, config.select))
    if not len(kept):
        raise InputError(f"the selection leaves no atom of {scene.name} to write.")
    for name in ("anneal_ps", "energy_every"):
        if getattr(config, name) and not isinstance(weights.model, Potential):
            raise InputError(f"`{name}` is for learned potentials; these weights learned frames. Leave it out.")
    centre = scene.positions_nm.mean(axis=0)
    settings = {
        **asdict(config),
        "solver": sampler.solver,
        "bf16": sampler.precision.bf16,
        "weights_hash": weights.hash,
        "replicas": n_replicas,
        "start": hashlib.sha256(scene.positions_nm.tobytes()).hexdigest()[:16],
    }
    del settings["time_ps"]  # a rollout may be resumed to become longer
    shift_nm = centre if np.abs(centre).max() <= _FAR_NM else np.zeros(3)
    return Plan(scene, weights, config, match, kept, shift_nm, save_every_ps, stride, n_frames, settings)


# Checkpoint of a rollout: written beside its first file after each flush, read by `resume`.


def packed_progress(progress: Progress) -> tuple[dict[str, Any], bytes]:
    """Return what a checkpoint keeps of a rollout: JSON for its header, and arrays."""
    arrays: dict[str, Any] = {k: v for k, v in vars(progress).items() if isinstance(v, np.ndarray)}
    plain = {k: v for k, v in asdict(progress).items() if k not in arrays}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return plain, buffer.getvalue()


def progress_of(path: Path, state: checkpoint.Checkpoint, settings: dict[str, Any] | None) -> Progress:
    """Return where a rollout of these settings stood, or of any (None), by one state in its checkpoint `path`.

    Raises InputError when it cannot be read, or the rollout was started with other settings.
    """
    header, blob = state
    try:
        arrays = arrays_in(io.BytesIO(blob))
        known, progress = dict(header["settings"]), built(Progress, {**header["progress"], **arrays}, "progress.")
    except UNREADABLE as error:
        raise InputError(
            f"checkpoint {path} cannot be read ({first_line(error)}); start again with `overwrite=True`."
        ) from error
    wanted = known if settings is None else settings
    for key in {**known, **wanted}:
        was, now = known.get(key), wanted.get(key)
        if was != now:
            raise InputError(f"{path}: this rollout was started with {key} = {was!r}, not {now!r}.")
    return progress


# Record of a rollout: settings, provenance and summary in its files, and the lines shown while it runs.

# Options that belong to a part of the record.
_OF_INTERVENTIONS, _OF_SELECTION = ("guard", "energy_every"), ("atoms", "select")


# Frames of one replica, ready to be written, and what goes with them, by name.
Block = dict[str, npt.NDArray[Any]]


class _Rollout:
    """A rollout under way: what it works with, where it stands, its files and the frames that wait to be written."""

    def __init__(self, plan: Plan, sampler: ChunkSampler, state: Progress, state_path: Path, header: dict[str, Any],
                 outs: Sequence[Path]) -> None:  # fmt: skip
        self.plan, self.sampler, self.state, self.outs = plan, sampler, state, outs
        self.checks = Guard(plan.weights.domain)
        self._state_path, self._header = state_path, header
        self._writers: list[TrajectoryWriter] = []
        self._waiting: list[list[Block]] = [[] for _ in outs]
        # What an interrupted run did before counts as no speed.
        self._first_step, self._began = state.steps, time.monotonic()

    def open(self, stack: ExitStack, *, resumed: bool) -> None:
        """Open the files of all replicas, to be closed with the stack."""
        for k, path in enumerate(self.outs):
            writer = checkpoint.writer_at(path, self.written, self.record(k), self._header, k, resumed=resumed)
            self._writers.append(stack.enter_context(writer))

    @property
    def written(self) -> Scene:
        """The atoms that are written."""
        plan = self.plan
        return plan.scene if len(plan.kept_atoms) == plan.scene.n_atoms else part_of(plan.scene, plan.kept_atoms)

    def save(self) -> None:
        """Write the checkpoint."""
        self._header["progress"], arrays = packed_progress(self.state)
        checkpoint.write_checkpoint(self._state_path, self._header, arrays)

    def put_by(self, chunk: Chunk) -> None:
        """Put by the frames of a chunk that are kept, in the scene's atom order and place."""
        plan, state = self.plan, self.state
        steps = state.steps + 1 + np.arange(chunk.frames_nm.shape[1])
        keep = np.flatnonzero((steps % plan.stride == 0) & (steps <= plan.n_steps))
        atoms = np.argsort(plan.match.order)[plan.kept_atoms]
        shift = plan.shift_nm.astype(np.float32)
        for row, waiting in enumerate(self._waiting):
            waiting.append(
                {
                    "frames": chunk.frames_nm[row, keep][:, atoms].astype(np.float32) + shift,
                    "times": (steps[keep] * plan.weights.domain.lag_ps).astype(np.float64),
                    "flags": chunk.flags[row, keep],
                    "chunk_idx": np.full(len(keep), state.chunks, dtype=np.int32),
                    "intervention": chunk.marks[row, keep],
                    DIFFERENCE_COLUMN: chunk.energies_kj_mol[row, keep],
                }
            )

    def move_on(self, chunk: Chunk) -> None:
        """Go on from the end of a chunk."""
        state, sampler = self.state, self.sampler
        history = np.concatenate([state.last_frames, chunk.frames_nm], axis=1)
        state.last_frames = history[:, -state.last_frames.shape[1] :].copy()
        if chunk.velocities_nm_ps is not None:
            state.velocities = chunk.velocities_nm_ps.astype(np.float32)
        state.steps += chunk.frames_nm.shape[1]
        state.chunks += 1
        state.batch, state.drawn, state.evaluations = sampler.batch, sampler.drawn, sampler.evaluations

    def flush(self) -> None:
        """Write the frames that wait, and the checkpoint that goes with them."""
        scalars = ["intervention", *([DIFFERENCE_COLUMN] if self.plan.config.energy_every else [])]
        for writer, waiting in zip(self._writers, self._waiting, strict=True):
            if waiting:
                joined = {name: np.concatenate([block[name] for block in waiting]) for name in waiting[0]}
                columns = {name: joined[name] for name in scalars}
                writer.append(joined["frames"], joined["times"], flags=joined["flags"], chunk_idx=joined["chunk_idx"],
                              scalars=columns)  # fmt: skip
                waiting.clear()
        self._header["files"] = [{"n_frames": w.n_frames, "digest": w.digest()} for w in self._writers]
        # Frames of the last chunk may be left out: a longer rollout could not go on from its end.
        if self.state.steps < self.plan.n_steps:
            self.save()

    def summarise(self, *, completed: bool) -> None:
        """Enter what was done and what it cost, by now or in all; a replica's cost is its share of the batch."""
        state, n_replicas = self.state, len(self.outs)
        wall_s = max(state.wall_s, 1e-9) / n_replicas
        n_frames = min(state.steps // self.plan.stride, self.plan.n_frames)
        for writer, tally in zip(self._writers, state.tallies, strict=True):
            cost = {
                "wall_s": wall_s,
                "batch_wall_s": state.wall_s,
                "network_evaluations": round((state.chunks + tally.draws) * self.sampler.evaluations_per_chunk),
                "ns_per_day": n_frames * self.plan.save_every_ps * 1e-3 / wall_s * 86400.0,
                "guard_share": sum(v for k, v in state.seconds.items() if k != "draw") / max(state.wall_s, 1e-9),
                "batch": self.sampler.batch or n_replicas,
            }
            summary = self._interventions(tally, state.seconds)
            writer.update_record({"interventions": summary, "cost": cost, **({"completed": True} if completed else {})})

    def close(self) -> None:
        """Close the files of a rollout that is complete."""
        self.summarise(completed=True)
        for writer in self._writers:
            writer.close()

    def speed(self) -> str:
        """Return '24200 ns/day, 290 frames/s, 3 helped', of all replicas together, as this process made them; chunks
        that were helped."""
        state, plan = self.state, self.plan
        steps = (state.steps - self._first_step) * len(state.tallies)
        per_s = steps / max(time.monotonic() - self._began, 1e-9)
        helped = sum(tally.chunks_caught for tally in state.tallies)
        word = "caught" if plan.config.guard in ("off", "flag") else "helped"
        ns_per_day = per_s * plan.weights.domain.lag_ps * 86.4
        return f"{ns_per_day:.3g} ns/day, {per_s / plan.stride:.3g} frames/s, {helped} {word}"

    def why_stopped(self, row: int, reason: str) -> str:
        """Return why a rollout cannot go on, where, and what to do."""
        plan, out = self.plan, self.outs[row]
        done_ps = self.state.steps * plan.weights.domain.lag_ps
        at = f"after {format_time_ps(done_ps)}" if done_ps else "in its first chunk"
        if plan.config.guard in ("off", "flag"):
            is_potential = isinstance(plan.weights.model, Potential)
            finer = "`precision='fp32'`, " if self.sampler.precision.bf16 else ""
            finer += "a shorter `timestep_ps`, " if is_potential and reason == BLOWN_UP else ""
            advice = f"the frames are marked in {out}. Try {finer}`guard='repair'` or other weights."
            if plan.config.guard == "flag" and reason != BLOWN_UP:
                advice += " With `guard='off'` nothing stops it."
            if is_potential:
                advice += " MD at the level of the weights may do the same: `surromd reference` tells."
        else:
            advice = f"the frames before are in {out}. Use other weights, or `surromd reference` for this molecule."
        return f"replica {row}, {at}: {reason}; {advice}"

    def record(self, replica: int) -> dict[str, Any]:
        """Return the record that a replica's file begins with; how long the run is, its frames say."""
        plan, sampler = self.plan, self.sampler
        options, weights = asdict(plan.config), plan.weights
        apart = ("time_ps", *_OF_INTERVENTIONS, *_OF_SELECTION)
        record = {
            "kind": "rollout",
            "model": weights.model.arch,
            "weights": weights.path.name,
            "weights_hash": weights.hash,
            "program": {"torch": torch.__version__},
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "completed": False,
            "replica": replica,
            **{name: value for name, value in options.items() if name not in apart},
            "save_every_ps": plan.save_every_ps,
            "lag_ps": weights.domain.lag_ps,
            "precision": sampler.precision.name,
            "precision_reason": sampler.precision.reason,
            "solver": sampler.solver,
            "chunk_frames": sampler.n_new,
            **weights.domain.conditions,
            "interventions": self._interventions(Tally(), {}),
        }
        if not plan.match.seen:
            record["unseen_molecule"] = True
        if plan.match.deviations:
            record["out_of_domain"] = [deviation.to_dict() for deviation in plan.match.deviations]
        if len(plan.kept_atoms) < plan.scene.n_atoms:
            record["selection"] = {**{name: options[name] for name in _OF_SELECTION}, "of_atoms": plan.scene.n_atoms}
        if plan.shift_nm.any() != plan.scene.positions_nm.mean(axis=0).any():
            record["moved_nm"] = (-plan.scene.positions_nm.mean(axis=0)).tolist()
        return record

    def _interventions(self, tally: Tally, seconds: dict[str, float]) -> dict[str, Any]:
        return {
            **{name: getattr(self.plan.config, name) for name in _OF_INTERVENTIONS},
            **tally.to_record(),
            "seconds": {key: round(value, 3) for key, value in seconds.items()},
            "unchecked": list(self.checks.unchecked),
        }


# Stages of annealing, of which the first are hot: as hot as the states that potentials learn from.
HOT_K, HOT_STAGES, ANNEAL_STAGES = 600.0, 3, 10
# Friction times the length of a stage, at least.
_COOLINGS = 2.0

# (frames done, frames in all, summary of speed and interventions) of one replica -> None
ProgressFn = Callable[[int, int, str], None]
# A line about the run as a whole -> None
AnnounceFn = Callable[[str], None]


def rollout(
    scene: Scene,
    weights: Weights,
    outs: Sequence[Path],
    config: RolloutConfig,
    *,
    starts_nm: npt.NDArray[np.float64] | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: ProgressFn | None = None,
    announce: AnnounceFn | None = None,
    flush_every_s: float = 3.0,
) -> list[Path]:
    """Roll a scene forward, one replica per path in `outs`, all in one batch; return the paths.

    Replicas begin at `starts_nm` (n_replicas, n_atoms, 3), without it at the positions of the scene.
    Frames stand at save_every_ps, 2 save_every_ps, ... up to time_ps, in the scene's own atom order and pose, each
    marked with its chunk, its validity flags (systems.chemistry.validity) against the training reference, and what was
    done about it (column `intervention`, `chunks.MARKS`), of which the record holds a summary. Replica k draws
    chunk c's noise from a generator seeded by (seed, k, c), so a replica does not depend on how many run beside it, and
    a resumed rollout continues as if it had not stopped. Ctrl-C and SIGTERM stop between two chunks, with everything on
    disk: KeyboardInterrupt. Memory that does not suffice for all replicas at once halves the batch. `announce` gets
    lines about how the scene leaves what was trained on. Raises OutOfDomainError, InputError, StorageError;
    SimulationError when the guard cannot bring a chunk through (under 'flag' and 'off' the chunk is in the file,
    marked; else what came before).
    """
    weights = in_bath(weights, config.bath)
    if config.timestep_ps is not None and in_step(weights, scene) is not weights:
        raise InputError(
            f"{format_time_ps(config.timestep_ps)} is too long for {STIFF_BOND}; use "
            f"`timestep_ps='{1e3 * STIFF_STEP_PS:g}fs'` or less."
        )
    weights, match = fit_weights(
        scene, weights, temperature_k=config.temperature_k, force=config.force, lag_ps=config.lag_ps,
        save_every_ps=config.save_every_ps, solvent=config.solvent,
    )  # fmt: skip
    if announce is not None:
        for line in match.input_notes(weights.path.name):
            announce(line)
    state_path = checkpoint.checkpoint_path(outs[0])
    precision = config.precision
    if resume and precision == "auto" and state_path.exists():
        # A rollout that goes on keeps it, whatever another processor would choose.
        precision = "bf16" if checkpoint.read_checkpoint(state_path)[0]["settings"]["bf16"] else "fp32"
    sampler = ChunkSampler(weights, solver_steps=config.solver_steps, solver=config.solver, precision=precision)
    plan = resolve_plan(scene, weights, match, config, sampler, n_replicas=len(outs))
    if starts_nm is not None:
        if starts_nm.shape != (len(outs), scene.n_atoms, 3) or not np.isfinite(starts_nm).all():
            raise InputError(
                f"`starts_nm` has the shape {starts_nm.shape}, or numbers that are not finite; {len(outs)} replicas of "
                f"{scene.n_atoms} atoms begin at {(len(outs), scene.n_atoms, 3)}."
            )
        plan.settings["starts"] = hashlib.sha256(starts_nm.tobytes()).hexdigest()[:16]
    check_disk(outs[0], plan.n_frames * len(outs), len(plan.kept_atoms))

    with ExitStack() as stack:
        asked_to_stop = stack.enter_context(deferred_interrupt())
        stack.enter_context(checkpoint.locked_outputs(outs, may_exist=resume or overwrite))
        if resume and not state_path.exists() and any(path.exists() for path in outs):
            return _already_complete(outs, plan, sampler)
        kept = checkpoint.supported_checkpoint(state_path, outs) if resume and state_path.exists() else None
        if kept is None:
            state = _start(plan, sampler, len(outs), asked_to_stop, starts_nm)
        else:
            state = progress_of(state_path, kept, plan.settings)
        header = kept[0] if kept else checkpoint.new_header(len(outs), overwrite=overwrite)
        if plan.n_frames < header.get("n_frames_wanted", 0):
            raise InputError(
                f"{outs[0]} was started for {header['n_frames_wanted']} frames and cannot become shorter; resume with "
                "as much time or more, or write to another file."
            )
        header |= {"settings": plan.settings, "n_frames_wanted": plan.n_frames}
        sampler.batch, sampler.drawn, sampler.evaluations = state.batch, state.drawn, state.evaluations
        coupling = None
        if config.guard in ("repair", "fallback") or config.energy_every:
            coupling = Coupling(weights)
            stack.callback(coupling.close)
        potential = PotentialChecks(weights, coupling) if isinstance(weights.model, Potential) else None
        run = _Rollout(plan, sampler, state, state_path, header, outs)
        engine = Interventions(sampler, run.checks, config, state, coupling, potential)
        if not state.steps:
            # Before there are files, so that a rollout killed at any later moment can be gone on with.
            run.save()
        run.open(stack, resumed=kept is not None)
        started = time.monotonic() - state.wall_s
        flushed_at, flushed_s = time.monotonic(), 0.0
        while state.steps < plan.n_steps:
            chunk = engine.advance()
            state.wall_s = time.monotonic() - started
            if chunk.failure is None and config.guard == "flag":
                at_end = state.steps + chunk.frames_nm.shape[1] >= plan.n_steps
                chunk.failure = none_through(state.tallies, sampler.n_new, at_end=at_end)
            if chunk.failure is not None:
                if config.guard in ("off", "flag"):
                    run.put_by(chunk)
                run.flush()
                run.summarise(completed=False)
                state_path.unlink(missing_ok=True)
                raise SimulationError(run.why_stopped(*chunk.failure))
            run.put_by(chunk)
            run.move_on(chunk)
            complete, stopping = state.steps >= plan.n_steps, asked_to_stop()
            pause_s = max(flush_every_s, checkpoint.FLUSH_SHARE * flushed_s if flush_every_s else 0.0)
            if complete or stopping or time.monotonic() - flushed_at > pause_s:
                since = time.monotonic()
                run.flush()
                flushed_at = time.monotonic()
                flushed_s = flushed_at - since
            if progress is not None:
                progress(min(state.steps // plan.stride, plan.n_frames), plan.n_frames, run.speed())
            if stopping and not complete:
                run.summarise(completed=False)
                raise KeyboardInterrupt
        state.wall_s = time.monotonic() - started
        run.close()
        state_path.unlink(missing_ok=True)
    return list(outs)


def _start(
    plan: Plan, sampler: ChunkSampler, n_replicas: int, asked_to_stop: Callable[[], bool],
    starts_nm: npt.NDArray[np.float64] | None,
) -> Progress:  # fmt: skip
    began = time.monotonic()
    positions = plan.scene.positions_nm[None] if starts_nm is None else starts_nm
    if plan.config.anneal_ps and not plan.match.seen and starts_nm is None:  # heat turns torsions, and no chair
        positions = ring_conformers(plan.scene)
    starts = (positions - positions.mean(axis=1, keepdims=True)).astype(np.float32)[:, plan.match.order]
    own = starts if starts_nm is not None else starts[[conformer_of(k, len(starts)) for k in range(n_replicas)]]
    frames = np.repeat(own[:, None], sampler.n_conditioning, axis=1)
    if plan.config.anneal_ps:
        frames = _annealed(plan, sampler, frames, asked_to_stop)
    return Progress(frames, wall_s=time.monotonic() - began, tallies=[Tally() for _ in range(n_replicas)])


def _annealed(plan: Plan, usual: ChunkSampler, start: npt.NDArray[np.float32],
              asked_to_stop: Callable[[], bool]) -> npt.NDArray[np.float32]:  # fmt: skip
    """Return where replicas `(replicas, n_conditioning, n_atoms, 3)` nm of a potential come to rest after MD at a high
    temperature that falls to theirs; one that flies apart on the way starts as it was."""
    config, frames = plan.weights.model.config, start
    falling = np.geomspace(max(HOT_K, config.temperature_k), config.temperature_k, ANNEAL_STAGES - HOT_STAGES + 1)
    stages = [falling[0]] * (HOT_STAGES - 1) + list(falling)
    n_frames = max(1, round(plan.config.anneal_ps / len(stages) / config.lag_ps))
    chunks = -(-n_frames // config.n_new)
    for stage, temperature_k in enumerate(stages):
        # However short a stage is, it comes to its temperature.
        sampler = usual.at(float(temperature_k), -(-n_frames // chunks), _COOLINGS / (n_frames * config.lag_ps))
        velocities = None
        for k in range(chunks):
            if asked_to_stop():
                raise KeyboardInterrupt
            # Chunks of the rollout count from 0.
            seeds = [noise_seed(plan.config.seed, row, -1 - stage * chunks - k) for row in range(len(frames))]
            drawn = sampler.draw(frames, seeds, velocities)
            frames, velocities = drawn.frames_nm[:, -sampler.n_conditioning :].copy(), drawn.velocities_nm_ps
            lost = ~np.isfinite(frames).all(axis=(1, 2, 3))
            frames[lost] = start[lost]
            if velocities is not None:
                velocities[lost] = np.nan
    lost = check_frames(frames[:, -1], Geometry.from_dict(plan.weights.domain.geometry)) & INVALID != 0
    frames[lost] = start[lost]
    return frames


# What of a record may differ between a rollout and the same one asked for again.
_OF_ONE_RUN = ("weights", "program", "started", "completed", "precision", "precision_reason", "interventions",
               "out_of_domain")  # fmt: skip


def _already_complete(outs: Sequence[Path], plan: Plan, sampler: ChunkSampler) -> list[Path]:
    run = _Rollout(plan, sampler, Progress(np.zeros(0, np.float32)), outs[0], {}, outs)
    for replica, path in enumerate(outs):
        with open_trajectory(path) as reader:
            if not reader.record.get("completed") or reader.n_frames != plan.n_frames:
                raise InputError(
                    f"{path} holds {reader.n_frames} of {plan.n_frames} frames but its checkpoint is gone; start again "
                    "with `overwrite=True`, or keep it under another name."
                )
            known = {**reader.record, **reader.record["interventions"], **_beginning(reader.scene)}
        wanted = {name: value for name, value in run.record(replica).items() if name not in _OF_ONE_RUN}
        wanted |= {name: getattr(plan.config, name) for name in _OF_INTERVENTIONS} | _beginning(run.written)
        for key in (key for key in wanted if key in known):
            if known[key] != wanted[key]:
                raise InputError(f"{path}: this rollout was started with {key} = {known[key]!r}, not {wanted[key]!r}.")
    return list(outs)


def _beginning(scene: Scene | None) -> dict[str, Any]:
    return {} if scene is None else {
        "molecule": scene.topology_hash, "start": hashlib.sha256(scene.positions_nm.tobytes()).hexdigest()[:16]
    }  # fmt: skip
