"""Minimise, equilibrate, produce: reference MD of one replica, streamed, checkpointed, resumable to the frame."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
import numpy.typing as npt

from md_reference.forces.forcefield import build_system
from md_reference.forces.spec import QUANTUM
from md_reference.run.config import MDConfig, check_run, check_same_run, settings_of
from md_reference.run.engine import Engine, State, refuse_damaged
from md_reference.run.machine import PlatformChoice, platform_for
from md_reference.run.run_summary import summarise
from systems.chemistry.validity import INVALID, check_frames, geometry_from_scene
from systems.errors import InputError, SimulationError
from systems.files.schema import built
from systems.interrupts import deferred_interrupt
from systems.scene import FloatArray, Scene, part_of
from systems.trajectory.base import TrajectoryWriter
from systems.trajectory.checkpoint import (
    FLUSH_SHARE,
    Checkpoint,
    checkpoint_path,
    locked_outputs,
    new_header,
    supported_checkpoint,
    write_checkpoint,
    writer_at,
)
from systems.trajectory.codec import DIFFERENCE_COLUMN, open_trajectory
from systems.units import format_time_ps

__all__ = ["MDConfig", "checkpoint_path", "simulate"]


class ProgressFn(Protocol):
    """Called with frames done and frames in all after each block that is on disk; with a `note`, before there are
    any: then `done` of `total` is the share of the equilibration."""

    def __call__(self, done: int, total: int, note: str | None = None) -> None: ...


def report_preparing(progress: ProgressFn | None, share: float) -> None:
    """Report which share of the equilibration is done; 0 while minimising."""
    if progress is not None:
        progress(round(1000 * share), 1000, "equilibrating" if share else "minimising")


# Python sees Ctrl-C only between calls of OpenMM: about so long may pass until it does.
_SIGNAL_S = 0.25
# Frames that are written at once, at most.
_MOST_FRAMES = 1000


def simulate(
    scene: Scene,
    config: MDConfig,
    out: str | Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: ProgressFn | None = None,
    choice: PlatformChoice | None = None,
    notes: Sequence[dict[str, Any]] = (),
) -> Path:
    """Run reference MD and stream it to `out` (.h5, .dcd, .xtc): frames at save_every_ps, 2 save_every_ps ... time_ps.

    A checkpoint stands behind every block of frames: a `kill -9`, a full disk or a power failure loses at most one save
    interval, half a second of work, or fifty times what it takes to write, whichever is the longest. `resume=True` goes
    on from there with the same random stream, on the same platform, bit for bit but in npt: OpenMM's checkpoint has not
    the barostat's counter, step size and random numbers. Ctrl-C and SIGTERM stop at once, with a checkpoint
    at the last frame: KeyboardInterrupt. No other process can write `out` meanwhile.

    `choice`: the platform where it has been chosen before. `notes`: one entry, added to the record. Raises
    SimulationError when coordinates stop being finite or the system blows up: the frames before stay in the file, which
    then says `completed: false`.
    """
    out = Path(out)
    config = check_run(scene, config, out)
    chk = checkpoint_path(out)
    with deferred_interrupt() as asked_to_stop, locked_outputs([out], may_exist=resume or overwrite):
        if resume and out.exists() and not chk.exists():
            already_complete(out, config)
            return out
        kept = supported_checkpoint(chk, [out]) if resume and chk.exists() else None
        run = _Run(scene, config, [out], kept, overwrite=overwrite, asked_to_stop=asked_to_stop, progress=progress)
        run.start(choice)
        how: dict[str, Any] = {"resumed": run.resumed, "columns": config.columns}
        record = record_of(scene, config, run.choice) | (notes[0] if notes else {})
        with run.engine, writer_at(out, run.written, record, run.header, **how) as writer:
            run.produce([writer])
        chk.unlink(missing_ok=True)
    return out


@dataclass(frozen=True)
class Stand:
    """Where a run stands, as its checkpoint says beside what all of them do."""

    config: dict[str, Any] = field(default_factory=dict)
    wall_s: float = 0.0
    platform: str = ""
    threads: Annotated[int, range(1, 1025)] = 1


class StoredRun:
    """Replicas on their way (one, or a batch with one checkpoint): what is done, since when, what their files say.
    Raises InputError for a checkpoint that is not of this run."""

    # Held in memory, then flushed with a checkpoint: what a `kill -9` costs at most, or one frame if that is more.
    block_s = 0.5
    n_dof = 0
    others = ""

    def __init__(
        self,
        scene: Scene,
        config: MDConfig,
        outs: Sequence[Path],
        kept: Checkpoint | None,
        *,
        overwrite: bool,
        asked_to_stop: Callable[[], bool],
        progress: ProgressFn | None,
    ) -> None:
        self.scene, self.config, self.outs = scene, config, outs
        self.asked_to_stop, self.progress = asked_to_stop, progress
        self.resumed = kept is not None
        self.header, self.blob = kept or (new_header(len(outs), overwrite=overwrite), b"")
        try:
            self.stand = built(Stand, {k: v for k, v in self.header.items() if k in Stand.__annotations__})
        except ValueError as error:
            raise InputError(f"checkpoint {checkpoint_path(outs[0])} cannot be resumed ({error}).") from error
        if self.resumed:
            check_same_run(self.stand.config, config, outs[0])
        self.began = time.monotonic()
        self.done = int(self.header["files"][0]["n_frames"])
        solute = config.kept_atoms(scene)
        self.atoms = np.arange(scene.n_atoms) if solute is None else solute
        self.written = scene if solute is None else part_of(scene, solute)

    @property
    def wall_s(self) -> float:
        return self.stand.wall_s + time.monotonic() - self.began

    def cost(self) -> dict[str, float]:
        """Return each replica's share of the cost of what is in the files; equilibration is in the wall time and not in
        the count of production steps."""
        simulated_ps, wall_s = self.done * self.config.save_every_ps, self.wall_s / len(self.outs)
        return {
            "wall_s": wall_s,
            "energy_evaluations": self.done * self.config.steps_per_frame,
            "ns_per_day": simulated_ps * 1e-3 / wall_s * 86400.0,
        }

    def keep(self, blob: bytes, **said: Any) -> None:
        """Write the checkpoint: the state `blob` of what runs, and what is said of it."""
        said |= {"config": settings_of(self.config), "wall_s": self.wall_s}
        self.header = {key: self.header[key] for key in ("run_id", "overwrite", "files")} | said
        write_checkpoint(checkpoint_path(self.outs[0]), self.header, blob)

    def save(self) -> None:
        """Write the checkpoint of the last frame."""
        raise NotImplementedError

    def frame(self) -> Any:
        """Return what is kept of the next frame, None when somebody asked to stop. Raises SimulationError."""
        raise NotImplementedError

    def append(self, writers: Sequence[TrajectoryWriter], frames: Sequence[Any], times_ps: npt.ArrayLike) -> None:
        """Write frames, which there are."""
        raise NotImplementedError

    def produce(self, writers: Sequence[TrajectoryWriter]) -> None:
        """Append frames until all are there. Raises SimulationError, StorageError, KeyboardInterrupt."""
        n_frames, flushed_s, most = self.config.n_frames, 0.0, 1
        while self.done < n_frames:
            frames, failure = self._block(min(most, n_frames - self.done), max(self.block_s, FLUSH_SHARE * flushed_s))
            computed, most = time.monotonic(), min(2 * most, _MOST_FRAMES)
            if frames:
                self.append(writers, frames, (self.done + 1 + np.arange(len(frames))) * self.config.save_every_ps)
                self.done += len(frames)
                self.header["files"] = [{"n_frames": self.done, "digest": writer.digest()} for writer in writers]
            if failure:
                for writer in writers:
                    writer.update_record({"completed": False, "failure": failure, "cost": self.cost()})
                after = format_time_ps(self.done * self.config.save_every_ps)
                raise SimulationError(
                    f"{self.scene.name}: {failure} after {after}; {self.done} good frames are in "
                    f"{self.outs[0]}{self.others}. {_advice(self.config)}"
                )
            stop = self.asked_to_stop() and self.done < n_frames
            if self.done < n_frames:
                self.save()
            flushed_s = time.monotonic() - computed
            if self.progress is not None:
                self.progress(len(writers) * self.done, len(writers) * n_frames)
            if stop:
                for writer in writers:
                    writer.update_record({"cost": self.cost()})
                raise KeyboardInterrupt
        self.finish(writers)

    def _block(self, most: int, seconds: float) -> tuple[list[Any], str]:
        """Return the frames of the next seconds, up to `most`, and why there are no more, if the run has failed."""
        frames: list[Any] = []
        until = time.monotonic() + seconds
        while len(frames) < most and not (frames and time.monotonic() > until):
            try:
                frame = self.frame()
            except SimulationError as error:
                return frames, str(error)
            if frame is None:
                break
            frames.append(frame)
        return frames, ""

    def finish(self, writers: Sequence[TrajectoryWriter]) -> None:
        """Say in the files that they are complete, what they cost, and how the run went."""
        config, mass_da = self.config, float(self.scene.masses_da.sum())
        bath: dict[str, Any] = {"ensemble": config.ensemble, "temperature_k": config.temperature_k}
        for writer in writers:
            time_ps, scalars, flags = writer.series()
            summary = summarise(time_ps, scalars, flags, mass_da=mass_da, n_dof=self.n_dof, **bath)
            # A resumed run may have become longer than the one that wrote the record.
            length = {"completed": True, "time_ps": config.time_ps}
            writer.update_record({**length, "cost": self.cost(), "summary": summary})


class _Run(StoredRun):
    """One replica by OpenMM."""

    choice: PlatformChoice
    engine: Engine
    # Steps at once, so that a wish to stop is heard soon.
    piece = 10

    def start(self, choice: PlatformChoice | None) -> None:
        """Settle the platform, and go to where the run was left, or to time 0."""
        self.system = system_of(self.scene, self.config)
        if self.resumed:
            choice = PlatformChoice(self.stand.platform, self.stand.threads, "as before it was resumed")
        self.choice = choice or platform_for(self.scene, self.config)
        if self.resumed:
            self.engine = self._engine(self.config.ensemble)
            self.engine.restore(self.blob)
        else:
            self.engine = self._equilibrated()
            # Before there is a file, so that a run killed at any later moment can be resumed like any other.
            self.blob = self.engine.checkpoint()
            self.save()
        self.n_dof = self.engine.n_dof

    def _engine(self, ensemble: str) -> Engine:
        conditions = replace(self.config, ensemble=ensemble, platform=self.choice.name)
        return Engine(self.scene, conditions, threads=self.choice.threads, system=self.system)

    def _equilibrated(self) -> Engine:
        """Return the engine at time 0: minimised, and run for `equilibrate_ps` in the bath."""
        config = self.config
        bath = self._engine("nvt" if config.ensemble == "nve" else config.ensemble)
        try:
            self._equilibrate(bath)
            if config.ensemble != "nve":
                return bath
            state = bath.state(velocities=True)
        except SimulationError as error:
            raise SimulationError(f"{self.scene.name}: {error} before the first frame. {_advice(config)}") from error
        bath.close()
        engine = self._engine("nve")
        engine.take_over(state)
        return engine

    def _equilibrate(self, engine: Engine) -> None:
        n_steps = math.ceil(round(self.config.equilibrate_ps / self.config.timestep_ps, 6))
        report_preparing(self.progress, 0.0)
        engine.minimise()
        refuse_damaged(self.scene, engine.positions())
        engine.thermalise()
        done = 0
        while done < n_steps:
            done += self._advance(engine, n_steps - done)
            report_preparing(self.progress, done / n_steps)
            if self.asked_to_stop():
                raise KeyboardInterrupt
        engine.state()

    def _advance(self, engine: Engine, n_steps: int) -> int:
        """Take steps until somebody may want to look whether to stop, and return how many."""
        taken = min(self.piece, n_steps)
        began = time.monotonic()
        engine.step(taken)
        seconds = max(time.monotonic() - began, 1e-9)
        self.piece = max(1, min(2 * self.piece, math.ceil(taken * _SIGNAL_S / seconds), 100_000))
        return taken

    def save(self) -> None:
        self.keep(self.blob, platform=self.engine.platform_name, threads=self.engine.threads)

    def frame(self) -> State | None:
        steps, per_frame = 0, self.config.steps_per_frame
        while steps < per_frame:
            if self.asked_to_stop():
                return None
            steps += self._advance(self.engine, per_frame - steps)
        state = self.engine.state(velocities=self.config.save_velocities, forces=self.config.save_forces)
        self.blob = self.engine.checkpoint()
        return state

    def append(self, writers: Sequence[TrajectoryWriter], frames: Sequence[State], times_ps: npt.ArrayLike) -> None:
        def written(name: str) -> FloatArray:
            return np.array([getattr(s, name)[self.atoms] for s in frames])

        scalars = {name: np.array([getattr(s, name) for s in frames]) for name in ("potential_kj_mol", "temperature_k")}
        cells = None if self.scene.cell_nm is None else np.array([s.cell_nm for s in frames])
        if cells is not None and self.config.ensemble == "npt":
            scalars["volume_nm3"] = np.linalg.det(cells)
        scalars = own_scalars(self.config, scalars, np.array([s.positions_nm for s in frames]))
        writers[0].append(
            written("positions_nm").astype(np.float32),
            times_ps,
            scalars=scalars,
            velocities_nm_ps=written("velocities_nm_ps") if self.config.save_velocities else None,
            forces_kj_mol_nm=written("forces_kj_mol_nm") if self.config.save_forces else None,
            cell_nm=cells,
            flags=self._changed(written("positions_nm")),
        )

    def _changed(self, positions_nm: FloatArray) -> npt.NDArray[np.uint16] | None:
        """Return validity bits of frames where bonds can break; None where a force field keeps them."""
        if self.config.force.force_field != QUANTUM:
            return None
        return check_frames(positions_nm, geometry_from_scene(self.written)) & np.uint16(INVALID)


def system_of(scene: Scene, config: MDConfig) -> Any:
    """Return the `openmm.System` of a run, the umbrella potential included."""
    system = build_system(scene, config.force)
    if config.umbrella is not None:
        system.addForce(config.umbrella.force())
    return system


def own_scalars(config: MDConfig, scalars: dict[str, FloatArray], positions_nm: FloatArray) -> dict[str, FloatArray]:
    """Return the scalars of frames `(n, n_atoms, 3)`: their potential energy, without that of the umbrella, which is in
    a column of its own."""
    if config.umbrella is None:
        return scalars
    own = config.umbrella.energies_kj_mol(positions_nm)
    return scalars | {"potential_kj_mol": scalars["potential_kj_mol"] - own, DIFFERENCE_COLUMN: -own}


def record_of(scene: Scene, config: MDConfig, choice: PlatformChoice) -> dict[str, Any]:
    """Return what the file of a run says of it before there are frames."""
    import openmm

    return {
        "kind": "reference",
        "integrator": "VelocityVerlet" if config.ensemble == "nve" else "LangevinMiddle",
        "program": {"openmm": openmm.__version__},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "completed": False,
        **settings_of(config),
        "platform": choice.name,
        "threads": choice.threads,
        "platform_reason": choice.reason,
    }


def _advice(config: MDConfig) -> str:
    return f"Try a shorter `timestep_ps` (now {config.timestep_ps * 1000:g} fs)."


def already_complete(out: Path, config: MDConfig) -> None:
    """A file without its checkpoint must hold all frames of this run. Raises InputError."""
    if not out.exists():
        raise InputError(f"{out} is not there, nor is the checkpoint of its run; start again with `overwrite`.")
    with open_trajectory(out) as reader:
        record, n_frames = reader.record, reader.n_frames
    # The record names the platform that ran, which "auto" leaves open.
    check_same_run(record, config, out, ignoring=("platform",))
    if record.get("completed") and n_frames < config.n_frames:
        raise InputError(
            f"{out} is a finished run of {n_frames} frames, and this one has {config.n_frames}: a run that is finished "
            "cannot be made longer, as its last velocities are not kept; start a longer one under another name, or "
            "more replicas with other seeds."
        )
    if not record.get("completed") or n_frames != config.n_frames:
        raise InputError(
            f"{out} holds {n_frames} of {config.n_frames} frames but its checkpoint is gone; start again with "
            "`overwrite`, or keep it under another name."
        )
