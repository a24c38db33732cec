"""Rollouts in chunks: each conditioned on the end of the last; replicas batched, frames checked, streamed."""

from __future__ import annotations

import copy
import hashlib
import io
import json
import time
import zipfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from surrogate.models.interface import Molecule, Surrogate, draw_noise
from surrogate.models.lam_slide.flow import SOLVERS
from surrogate.sampling.domain import match_scene
from systems.errors import InputError, SimulationError
from systems.geometry import superposition
from systems.interrupts import deferred_interrupt
from systems.scene import Scene
from systems.trajectory import open_trajectory, open_writer
from systems.trajectory_types import TrajectoryWriter
from systems.units import format_time_ps, whole_steps
from systems.validity import Geometry, check_frames
from systems.whole_file import create_whole

if TYPE_CHECKING:
    from surrogate.data.weights import Weights

# (frames done, frames in all) of one replica -> None
ProgressFn = Callable[[int, int], None]
Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class RolloutConfig:
    """One rollout. `save_every_ps` None keeps every model frame. `solver` None is the one that suits the weights, else
    'multistep' or 'euler' (models.lam_slide.flow). `precision`: 'fp32', 'bf16' (autocast of the network;
    coordinates and integration stay fp32) or 'auto' (bf16 where the processor multiplies it in hardware)."""

    time_ps: float
    save_every_ps: float | None = None
    seed: int = 0
    solver_steps: int = 20
    solver: str | None = None
    precision: str = "auto"

    def __post_init__(self) -> None:
        if self.solver_steps < 1:
            raise InputError(f"solver steps must be at least 1, not {self.solver_steps}.")
        if self.solver not in (None, *SOLVERS):
            raise InputError(f"solver {self.solver!r} is unknown; choose {' or '.join(SOLVERS)}.")
        if self.precision not in ("auto", "fp32", "bf16"):
            raise InputError(f"precision {self.precision!r} is unknown; choose auto, fp32 or bf16.")


@dataclass
class _Progress:
    """Where a rollout stands: what a checkpoint holds."""

    last_frames: Float32Array  # (replicas, n_conditioning, n_atoms, 3) nm, model order, the user's pose
    chunks: int = 0  # chunks done
    steps: int = 0  # model frames done, kept or not
    wall_s: float = 0.0
    last_velocities: Float32Array | None = None  # (replicas, n_atoms, 3) nm/ps, of a model that carries them


def rollout(
    scene: Scene,
    weights: Weights,
    outs: Sequence[Path],
    config: RolloutConfig,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: ProgressFn | None = None,
    flush_every_s: float = 3.0,
) -> list[Path]:
    """Roll a scene forward, one replica per path in `outs`, all in one batch; return the paths.

    Frames stand at save_every_ps, 2 save_every_ps, ... up to time_ps, in the scene's own atom order and pose, each
    marked with its chunk and its validity flags (systems.validity) against the geometry of the training reference.
    Replica k draws chunk c's noise from a generator seeded by (seed, k, c), so a replica does not depend on how many
    run beside it, and a resumed rollout continues as if it had not stopped. Ctrl-C and SIGTERM stop between two chunks,
    with everything on disk: KeyboardInterrupt.
    Raises OutOfDomainError, InputError, StorageError; SimulationError when a chunk ends in a frame that is not finite
    (it is in the file, marked).
    """
    order = match_scene(scene, weights)
    back = np.argsort(order)
    model, lag_ps = weights.model, weights.domain.lag_ps
    save_every_ps = lag_ps if config.save_every_ps is None else config.save_every_ps
    stride = whole_steps(save_every_ps, lag_ps, "save interval in the weights' frame spacing")
    n_frames = whole_steps(config.time_ps, save_every_ps, "rollout length in save intervals")
    geometry = Geometry.from_dict(weights.domain.geometry)
    template = weights.domain.scene
    fit = template.heavy_idx if len(template.heavy_idx) >= 3 else np.arange(template.n_atoms)
    target = template.positions_nm - template.positions_nm[fit].mean(axis=0)
    molecule = Molecule.of(template)
    use_bf16 = config.precision == "bf16" or (config.precision == "auto" and bf16_in_hardware())
    if use_bf16:
        model = with_bf16_weights(model)
    config = replace(config, solver=choose_solver(model, config.solver))
    settings = {**asdict(config), "bf16": use_bf16, "weights_hash": weights.hash, "replicas": len(outs)}
    del settings["time_ps"]  # a rollout may be resumed to become longer
    state_path = outs[0].with_name(outs[0].name + ".checkpoint")
    start = np.asarray(scene.positions_nm, dtype=np.float32)[order]
    state = _Progress(np.broadcast_to(start, (len(outs), model.n_conditioning, *start.shape)).copy())
    resuming = resume and all(p.exists() for p in outs)
    if resuming:
        if not state_path.exists():
            return _already_complete(outs, n_frames)
        state = _read_state(state_path, settings)

    started = time.monotonic() - state.wall_s
    buffers: list[list[tuple[Float32Array, Any, Any, Any]]] = [[] for _ in outs]
    with ExitStack() as stack:
        asked_to_stop = stack.enter_context(deferred_interrupt())
        writers = []
        for k, path in enumerate(outs):
            record = _record(weights, config, settings, save_every_ps, replica=k)
            writer = open_writer(path, scene, record, append=resuming, overwrite=overwrite)
            writers.append(stack.enter_context(writer))
            if resuming:
                writer.truncate(min(state.steps, n_frames * stride) // stride)
        last_flush = time.monotonic()
        while state.steps < n_frames * stride:
            chunk = _next_chunk(model, state, target, fit, molecule, config, use_bf16)
            times = (state.steps + 1 + np.arange(model.n_new)) * lag_ps
            keep = np.flatnonzero((state.steps + 1 + np.arange(model.n_new)) % stride == 0)
            keep = keep[state.steps + 1 + keep <= n_frames * stride]
            for k in range(len(outs)):
                kept = chunk[k, keep]
                flags = check_frames(kept, geometry)
                buffers[k].append((kept[:, back], times[keep], flags, np.full(len(keep), state.chunks, dtype=np.int32)))
            state.last_frames = chunk[:, -model.n_conditioning :].copy()
            state.steps += model.n_new
            state.chunks += 1
            state.wall_s = time.monotonic() - started
            broken = [k for k in range(len(outs)) if not np.isfinite(state.last_frames[k]).all()]
            complete, stopping = state.steps >= n_frames * stride, asked_to_stop()
            if complete or broken or stopping or time.monotonic() - last_flush > flush_every_s:
                for writer, buffer in zip(writers, buffers, strict=True):
                    _flush(writer, buffer)
                _write_state(state_path, state, settings)
                last_flush = time.monotonic()
            if progress is not None:
                progress(min(state.steps // stride, n_frames), n_frames)
            if broken:
                state_path.unlink(missing_ok=True)
                raise SimulationError(
                    f"replica {broken[0]}: the model's frames are no longer finite after "
                    f"{format_time_ps(state.steps * lag_ps)}; they are marked in {outs[broken[0]]}. Try --precision "
                    "fp32 or other weights."
                )
            if stopping and not complete:
                raise KeyboardInterrupt
        state.wall_s = time.monotonic() - started
        for writer in writers:
            writer.update_record({"completed": True, "cost": _cost(state, config, len(outs), n_frames, save_every_ps)})
    state_path.unlink(missing_ok=True)
    return list(outs)


@torch.inference_mode()
def _next_chunk(model: Surrogate, state: _Progress, target: npt.NDArray[np.float64], fit: npt.NDArray[np.int64],
                molecule: Molecule, config: RolloutConfig, use_bf16: bool) -> Float32Array:  # fmt: skip
    """Return the next chunk `(replicas, n_new, n_atoms, 3)` nm in model order and the pose of the frames before;
    velocities, where the model carries them, move on in `state`."""
    last = state.last_frames.astype(np.float64)
    n_replicas, _, n_atoms, _ = last.shape
    if model.canonical:
        # One rigid motion per replica, that of its last frame, carried back onto the new frames.
        rotation, translation = superposition(last[:, -1], target, idx=fit)
    else:
        rotation = np.broadcast_to(np.eye(3), (n_replicas, 3, 3))
        translation = -last[:, -1].mean(axis=1)
    canonical = np.einsum("rij,rtnj->rtni", rotation, last) + translation[:, None, None, :]
    generators = [
        torch.Generator().manual_seed(_seed(config.seed, replica, state.chunks)) for replica in range(n_replicas)
    ]
    noise = draw_noise(model, n_atoms, generators)
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=use_bf16):
        found = model.next_chunk(
            torch.from_numpy(canonical.astype(np.float32)),
            molecule,
            noise,
            solver_steps=config.solver_steps,
            solver=config.solver,
            last_velocities_nm_ps=_turned(state.last_velocities, rotation),
        )
    if found.velocities_nm_ps is not None:
        back = np.einsum("rji,rnj->rni", rotation, found.velocities_nm_ps.double().numpy())
        state.last_velocities = back.astype(np.float32)
    moved = found.frames_nm.double().numpy() - translation[:, None, None, :]
    return np.einsum("rji,rtnj->rtni", rotation, moved).astype(np.float32)


def _turned(velocities: Float32Array | None, rotation: npt.NDArray[np.float64]) -> torch.Tensor | None:
    if velocities is None:
        return None
    return torch.from_numpy(np.einsum("rij,rnj->rni", rotation, velocities).astype(np.float32))


def choose_solver(model: Surrogate, asked: str | None) -> str | None:
    """Return the solver asked for, or the model's default; None for a model that answers in one evaluation."""
    if asked is None:
        return model.solvers[0] if model.solvers else None
    if asked not in model.solvers:
        known = f"use --solver {' or '.join(model.solvers)}" if model.solvers else "it needs no solver, leave it out"
        raise InputError(f"these weights ({model.arch}) are not integrated by the {asked} solver; {known}.")
    return asked


def _seed(seed: int, replica: int, chunk: int) -> int:
    digest = hashlib.sha256(f"{seed}/{replica}/{chunk}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def with_bf16_weights(model: Surrogate) -> Surrogate:
    """Return a copy whose matrix weights are bf16 already: autocast would round them anew in every evaluation."""
    copied = copy.deepcopy(model)
    for name, module in copied.named_modules():
        if isinstance(module, torch.nn.Linear) and not name.startswith(model.float32_layers):
            module.to(torch.bfloat16)
    return copied


def bf16_in_hardware() -> bool:
    """True where the processor has matrix units for bf16 (AMX); a fixed property, so a seed keeps its meaning."""
    supported = getattr(torch.cpu, "_is_amx_tile_supported", None)
    return bool(supported and supported())


def _flush(writer: TrajectoryWriter, buffer: list[tuple[Float32Array, Any, Any, Any]]) -> None:
    if buffer:
        frames, times, flags, chunks = (np.concatenate(parts) for parts in zip(*buffer, strict=True))
        writer.append(frames, times, flags=flags, chunk_idx=chunks)
        buffer.clear()


def _record(weights: Weights, config: RolloutConfig, settings: dict[str, Any], save_every_ps: float, *,
            replica: int) -> dict[str, Any]:  # fmt: skip
    return {
        "kind": "rollout",
        "model": weights.model.arch,
        "weights": weights.path.name,
        "weights_hash": weights.hash,
        "program": {"torch": torch.__version__},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "completed": False,
        "seed": config.seed,
        "replica": replica,
        "save_every_ps": save_every_ps,
        "lag_ps": weights.domain.lag_ps,
        "precision": "bf16" if settings["bf16"] else "fp32",
        "solver": settings["solver"],
        "solver_steps": config.solver_steps,
        "chunk_frames": weights.model.n_new,
        **weights.domain.conditions,
    }


def _cost(state: _Progress, config: RolloutConfig, n_replicas: int, n_frames: int,
          save_every_ps: float) -> dict[str, float]:  # fmt: skip
    """A replica's share of the batch: wall seconds and network evaluations divided by the replicas."""
    wall_s = state.wall_s / n_replicas
    return {
        "wall_s": wall_s,
        "batch_wall_s": state.wall_s,
        "network_evaluations": state.chunks * (1 if config.solver is None else config.solver_steps),
        "ns_per_day": n_frames * save_every_ps * 1e-3 / wall_s * 86400.0,
    }


def _write_state(path: Path, state: _Progress, settings: dict[str, Any]) -> None:
    arrays: dict[str, Any] = {k: v for k, v in vars(state).items() if isinstance(v, np.ndarray)}
    header = {"settings": settings, **{k: v for k, v in vars(state).items() if k not in arrays}}
    buffer = io.BytesIO()
    np.savez(buffer, header=np.array(json.dumps(header)), **arrays)
    create_whole(path, lambda temporary: _write_bytes(temporary, buffer.getvalue()))


def _write_bytes(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def _read_state(path: Path, settings: dict[str, Any]) -> _Progress:
    try:
        with np.load(path, allow_pickle=False) as stored:
            header = json.loads(str(stored["header"]))
            arrays = {key: stored[key] for key in stored.files if key != "header"}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"checkpoint {path} cannot be read ({error}); start again with --overwrite.") from error
    for key, value in header.pop("settings").items():
        if settings[key] != value:
            raise InputError(f"{path}: this rollout was started with {key} = {value!r}, not {settings[key]!r}.")
    return _Progress(**{**header, **arrays})


def _already_complete(outs: Sequence[Path], n_frames: int) -> list[Path]:
    for path in outs:
        with open_trajectory(path) as reader:
            if not reader.record.get("completed") or reader.n_frames != n_frames:
                raise InputError(
                    f"{path} holds {reader.n_frames} of {n_frames} frames but its checkpoint is gone; start again with "
                    "--overwrite, or keep it under another name."
                )
    return list(outs)
