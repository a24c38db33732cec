"""Minimise, equilibrate, produce: reference MD of one replica, streamed, checkpointed, resumable to the frame."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from md_reference.engine import Engine
from md_reference.forcefield import ForceFieldSpec
from systems.errors import InputError, SimulationError, StorageError
from systems.interrupts import deferred_interrupt
from systems.scene import Scene
from systems.trajectory import open_writer
from systems.units import format_time_ps, whole_steps

# (frames done, frames in all) -> None, called after each block that is on disk.
ProgressFn = Callable[[int, int], None]

# Python sees Ctrl-C only between calls of OpenMM.
_STEPS_BETWEEN_SIGNALS = 500


@dataclass(frozen=True)
class MDConfig:
    """One run. Times in ps, temperature in K, friction in 1/ps; Langevin middle integrator (Zhang 2019)."""

    time_ps: float
    save_every_ps: float = 1.0
    temperature_k: float = 300.0
    friction_per_ps: float = 1.0
    timestep_ps: float = 0.004
    equilibrate_ps: float = 100.0
    seed: int = 0
    platform: str = "auto"
    force: ForceFieldSpec = field(default_factory=ForceFieldSpec)

    @property
    def steps_per_frame(self) -> int:
        return whole_steps(self.save_every_ps, self.timestep_ps, "save interval in time steps")

    @property
    def n_frames(self) -> int:
        return whole_steps(self.time_ps, self.save_every_ps, "run length in save intervals")


def checkpoint_path(out: Path) -> Path:
    """Where the checkpoint of a trajectory lies: beside it, until the run is complete."""
    return out.with_name(out.name + ".checkpoint")


def simulate(
    scene: Scene,
    config: MDConfig,
    out: str | Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: ProgressFn | None = None,
    checkpoint_every_s: float = 20.0,
) -> Path:
    """Run reference MD and stream it to `out` (.h5 or .dcd): frames at save_every_ps, 2 save_every_ps, ..., time_ps.

    A `kill -9` loses at most the frames since the last checkpoint (`checkpoint_every_s` of wall time); `resume=True`
    cuts the file back to that checkpoint and goes on with the same random stream. Ctrl-C and SIGTERM stop between two
    frames, with a checkpoint: KeyboardInterrupt. Raises SimulationError when coordinates stop being finite or the
    system blows up (`Engine.state`): the frames before stay in the file, which then says `completed: false`.
    """
    out = Path(out)
    n_frames, steps_per_frame = config.n_frames, config.steps_per_frame
    chk = checkpoint_path(out)
    if resume and not chk.exists() and out.exists():
        return _already_complete(out, config)
    resuming = resume and chk.exists() and out.exists()
    started = time.monotonic()
    with Engine(
        scene,
        config.force,
        temperature_k=config.temperature_k,
        friction_per_ps=config.friction_per_ps,
        timestep_ps=config.timestep_ps,
        seed=config.seed,
        platform=config.platform,
    ) as engine:
        record = _record(config, engine)
        if resuming:
            header, blob = _read_checkpoint(chk)
            _check_same_run(header["config"], _settings(config), out)
            engine.restore(blob)
            done, spent_s = int(header["n_frames"]), float(header["wall_s"])
        else:
            done, spent_s = 0, 0.0
            _equilibrate(engine, config, scene.name)

        def save_checkpoint(wall_s: float) -> None:
            header = {"config": _settings(config), "n_frames": done, "wall_s": wall_s}
            _write_checkpoint(chk, header, engine.checkpoint())

        with (
            open_writer(out, scene, record, append=resuming, overwrite=overwrite) as writer,
            deferred_interrupt() as asked_to_stop,
        ):
            if resuming:
                writer.truncate(done)
            else:
                # At once, so that a run killed in its first seconds can be resumed like any other.
                save_checkpoint(spent_s + time.monotonic() - started)
            last_saved = time.monotonic()
            # A block is what is held in memory and flushed together: about half a second of work, found as we go.
            block = 1
            while done < n_frames:
                size = min(block, n_frames - done)
                block_began = time.monotonic()
                frames = np.empty((size, scene.n_atoms, 3), dtype=np.float32)
                scalars = {name: np.empty(size) for name in ("potential_kj_mol", "temperature_k")}
                filled, failure = 0, ""
                for k in range(size):
                    if asked_to_stop():
                        break
                    try:
                        engine.step(steps_per_frame)
                        state = engine.state()
                    except SimulationError as error:
                        failure = str(error)
                        break
                    frames[k] = state.positions_nm
                    scalars["potential_kj_mol"][k] = state.potential_kj_mol
                    scalars["temperature_k"][k] = state.temperature_k
                    filled += 1
                times = (done + 1 + np.arange(filled)) * config.save_every_ps
                writer.append(frames[:filled], times, scalars={k: v[:filled] for k, v in scalars.items()})
                done += filled
                wall_s = spent_s + time.monotonic() - started
                if failure:
                    writer.update_record({"completed": False, "failure": failure, "cost": _cost(wall_s, done, config)})
                    raise SimulationError(
                        f"{scene.name}: {failure} after {format_time_ps(done * config.save_every_ps)}; {done} good "
                        f"frames are in {out}. {_advice(config)}"
                    )
                if progress is not None:
                    progress(done, n_frames)
                if asked_to_stop() and done < n_frames:
                    save_checkpoint(wall_s)
                    writer.update_record({"cost": _cost(wall_s, done, config)})
                    raise KeyboardInterrupt
                if time.monotonic() - last_saved > checkpoint_every_s and done < n_frames:
                    save_checkpoint(wall_s)
                    last_saved = time.monotonic()
                per_frame_s = max((time.monotonic() - block_began) / size, 1e-6)
                block = min(max(1, round(0.5 / per_frame_s)), 1000, 2 * block)
            wall_s = spent_s + time.monotonic() - started
            # A resumed run may have become longer than the one that wrote the record.
            writer.update_record({"completed": True, "time_ps": config.time_ps, "cost": _cost(wall_s, done, config)})
    chk.unlink(missing_ok=True)
    return out


def _equilibrate(engine: Engine, config: MDConfig, name: str) -> None:
    """Minimise, draw velocities, run for `equilibrate_ps`, set the clock to 0. Raises SimulationError."""
    try:
        engine.minimise()
        engine.thermalise()
        n_steps = max(1, round(config.equilibrate_ps / config.timestep_ps))
        for start in range(0, n_steps, _STEPS_BETWEEN_SIGNALS):
            engine.step(min(_STEPS_BETWEEN_SIGNALS, n_steps - start))
        engine.state()
    except SimulationError as error:
        raise SimulationError(f"{name}: {error} before the first frame. {_advice(config)}") from error
    engine.reset_clock()


def _advice(config: MDConfig) -> str:
    return f"Try a shorter --timestep (now {config.timestep_ps * 1000:g} fs)."


def _cost(wall_s: float, n_frames: int, config: MDConfig) -> dict[str, float]:
    """Cost of what is in the file; equilibration is in the wall time and not in the count of production steps."""
    return {
        "wall_s": wall_s,
        "energy_evaluations": n_frames * config.steps_per_frame,
        "ns_per_day": n_frames * config.save_every_ps * 1e-3 / wall_s * 86400.0,
    }


def _record(config: MDConfig, engine: Engine) -> dict[str, Any]:
    import openmm

    return {
        "kind": "reference",
        "integrator": "LangevinMiddle",
        "program": {"openmm": openmm.__version__},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "completed": False,
        **_settings(config),
        "platform": engine.platform_name,
    }


def _settings(config: MDConfig) -> dict[str, Any]:
    """The settings of a run as one level of names and plain values."""
    flat = asdict(config)
    force = flat.pop("force")
    return {**flat, **force}


def _already_complete(out: Path, config: MDConfig) -> Path:
    from systems.trajectory import open_trajectory

    with open_trajectory(out) as reader:
        record, n_frames = reader.record, reader.n_frames
    asked = _settings(config)
    # The record names the platform that ran, which "auto" leaves open.
    asked.pop("platform")
    _check_same_run({key: record.get(key) for key in asked}, asked, out)
    if record.get("completed") and n_frames == config.n_frames:
        return out
    raise InputError(
        f"{out} holds {n_frames} of {config.n_frames} frames but its checkpoint is gone; start again with "
        "--overwrite, or keep it under another name."
    )


def _check_same_run(old: dict[str, Any], new: dict[str, Any], out: Path) -> None:
    for key, value in json.loads(json.dumps(new)).items():
        # A run may be resumed to become longer.
        if key != "time_ps" and old.get(key) != value:
            raise InputError(
                f"{out} was started with {key} = {old.get(key)!r}, not {value!r}; resume with the same settings "
                "or write to another file."
            )


def _write_checkpoint(path: Path, header: dict[str, Any], blob: bytes) -> None:
    temporary = path.with_name(path.name + ".new")
    header = {**header, "sha256": hashlib.sha256(blob).hexdigest()}
    try:
        with open(temporary, "wb") as handle:
            handle.write(json.dumps(header).encode() + b"\n" + blob)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise StorageError(f"cannot write checkpoint {path}: {error.strerror}; free space and --resume.") from error


def _read_checkpoint(path: Path) -> tuple[dict[str, Any], bytes]:
    try:
        line, _, blob = path.read_bytes().partition(b"\n")
        header = json.loads(line)
        # OpenMM loads a truncated checkpoint without a word.
        if hashlib.sha256(blob).hexdigest() != header["sha256"]:
            raise ValueError("its checksum is wrong")
        return header, blob
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"checkpoint {path} is damaged ({error}); start again with --overwrite.") from error
