"""A model that trembles about its last frame, with faults on purpose, and what a rollout of it leaves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from surrogate.models.propagator import Chunk, Molecule, Propagator
from surrogate.models.weights import TrainingDomain, Weights
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

LAG_PS, N_NEW = 0.1, 8
CONDITIONS = {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0, "friction_per_ps": 1.0,
              "timestep_ps": 0.004, "hydrogen_mass_da": 3.0}  # fmt: skip
# Fault: frames (n_new, n_atoms, 3) nm of one replica and its noise in, frames out.
Fault = Callable[[Tensor, Tensor], Tensor]


class Scripted(Propagator):
    """Trembles about the last frame by 0.0005 nm; what goes wrong is written in `fault`."""

    arch: ClassVar[str] = "scripted"
    n_conditioning = 1
    n_new = N_NEW
    largest_batch = 1000

    def __init__(self, fault: Fault | None = None) -> None:
        super().__init__()
        self.fault = fault
        self.rows: list[int] = []

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (N_NEW, n_atoms, 3)

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        if len(last_frames_nm) > self.largest_batch:
            raise RuntimeError("[enforce fail] DefaultCPUAllocator: not enough memory: you tried to allocate a lot")
        self.rows.append(len(last_frames_nm))
        frames = last_frames_nm[:, -1:] + 0.0005 * noise
        if self.fault is not None:
            frames = torch.stack([self.fault(x.clone(), z) for x, z in zip(frames, noise, strict=True)])
        return Chunk(frames)


def unlucky(noise: Tensor) -> bool:
    """True for half of all draws."""
    return bool(noise[0, 0, 0] > 0)


def stretch(frames: Tensor, noise: Tensor) -> Tensor:
    """In half of all draws a carbonyl bond is 0.08 nm too long, in frame 5 alone."""
    if unlucky(noise):
        step = frames[5, 5] - frames[5, 4]
        frames[5, 5] += 0.08 * step / step.norm()
    return frames


def invert(frames: Tensor, noise: Tensor) -> Tensor:
    """In half of all draws CA and its hydrogen are reflected through the plane of the other three, in frame 5 alone."""
    if unlucky(noise):
        a, b, c = frames[5, 6], frames[5, 10], frames[5, 14]
        normal = torch.linalg.cross(b - a, c - a)
        normal = normal / normal.norm()
        for atom in (8, 9):
            frames[5, atom] -= 2 * ((frames[5, atom] - a) @ normal) * normal
    return frames


def twist(frames: Tensor, noise: Tensor) -> Tensor:
    """Frame 2 is turned by 60 degrees about the first peptide bond: still trans, so that no geometry check minds."""
    axis = frames[2, 6] - frames[2, 4]
    x, y, z = (axis / axis.norm()).tolist()
    k = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = torch.eye(3) + np.sin(np.pi / 3) * k + (1 - np.cos(np.pi / 3)) * k @ k
    frames[2, 6:] = frames[2, 6] + (frames[2, 6:] - frames[2, 6]) @ rotation.T
    return frames


def scatter(frames: Tensor, noise: Tensor) -> Tensor:
    """Every frame is a cloud."""
    return 0.3 * noise


def weights_of(domain: TrainingDomain, fault: Fault | None = None) -> Weights:
    return Weights(Scripted(fault), domain, {}, "scripted", Path("scripted.safetensors"))


class Rolled:
    """What a rollout left in its file."""

    def __init__(self, path: Path) -> None:
        with open_trajectory(path) as reader:
            self.frames, self.flags, self.record = reader.read(), reader.flags, dict(reader.record)
            self.marks, self.times = reader.scalars["intervention"], reader.time_ps
            self.scalars, self.scene = dict(reader.scalars), reader.scene
        self.summary: dict[str, Any] = self.record["interventions"]


def roll(out: Path, scene: Scene, weights: Weights, guard: str, n_chunks: int = 4, **settings: Any) -> Rolled:
    config = RolloutConfig(time_ps=n_chunks * N_NEW * LAG_PS, guard=guard, precision="fp32", seed=4, **settings)
    rollout(scene, weights, [out], config)
    return Rolled(out)
