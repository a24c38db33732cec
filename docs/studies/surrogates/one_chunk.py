"""Errors of one chunk of PAINET: `python docs/studies/surrogates/one_chunk.py WEIGHTS REF`.

From states of a reference at constant energy, with velocities, that training has not seen, to where the reference
stands one chunk later: root mean square errors per coordinate of positions and velocities, beside the frozen frame, a
straight flight, and leapfrog steps with the true forces, as many as named. The model runs without its bath.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from surrogate.data import TrainingFrames, collect_frames
from surrogate.models.painet.model import Painet
from surrogate.models.weights import load_weights
from systems.errors import InputError

FloatArray = npt.NDArray[np.floating[Any]]
State = tuple[FloatArray, FloatArray]
# Positions (n_atoms, 3) nm -> forces, kJ/mol/nm.
ForceFn = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class ChunkError:
    """Root mean square errors per coordinate where a chunk ends: nm and nm/ps."""

    name: str
    position_nm: float
    velocity_nm_ps: float


def leapfrog(x: FloatArray, v: FloatArray, forces: ForceFn, masses_da: FloatArray, time_ps: float, n: int) -> State:
    """Return states `(b, n_atoms, 3)` after `n` steps of drift, kick, drift that take `time_ps` together."""
    x, v, step = x.astype(np.float64), v.astype(np.float64), time_ps / n
    for k in range(len(x)):
        x[k] += 0.5 * step * v[k]
        for done in range(1, n + 1):
            v[k] += step * forces(x[k]) / masses_da[:, None]
            x[k] += (step if done < n else 0.5 * step) * v[k]
    return x, v


def chunk_errors(step: Callable[[FloatArray, FloatArray], State], frames: TrainingFrames, span: int, forces: ForceFn, *,
                 starts: int, steps: list[int]) -> Iterator[ChunkError]:  # fmt: skip
    """Yield the errors of simple forecasts and of `step` (states to states) from `starts` evenly spaced frames to those
    `span` frames later. Raises InputError for frames without velocities or too few of them."""
    if frames.velocities is None or frames.n_frames <= span:
        raise InputError(f"a chunk of {span} frames needs a longer trajectory, with velocities.")
    first = np.linspace(0, frames.n_frames - 1 - span, starts).astype(np.int64)
    x, v = frames.positions_nm(first), frames.velocities[first]
    x_true, v_true = frames.positions_nm(first + span), frames.velocities[first + span]
    time_ps = span * frames.lag_ps

    def error(name: str, state: State) -> ChunkError:
        off = [float(np.sqrt(np.mean(np.square(a - b)))) for a, b in zip(state, (x_true, v_true), strict=True)]
        return ChunkError(name, *off)

    yield error("frozen frame", (x, v))
    yield error("straight flight", (x + time_ps * v, v))
    for n in steps:
        state = leapfrog(x, v, forces, frames.scene.masses_da, time_ps, n)
        yield error(f"leapfrog, {n} x {1000 * time_ps / n:.2f} fs", state)
    yield error("model", step(x, v))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("reference", type=Path, help="trajectory with velocities, at constant energy")
    parser.add_argument("--starts", type=int, default=128)
    parser.add_argument("--steps", type=int, nargs="*", default=[1, 2, 3, 4], help="of leapfrog in a chunk")
    args = parser.parse_args()
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.config import Conditions
    from md_reference.run.engine import Engine

    torch.set_num_threads(1)
    weights = load_weights(args.weights)
    model, of = weights.model, weights.domain.conditions
    if not isinstance(model, Painet):
        raise InputError(f"{args.weights} ({model.arch}) carries no velocities.")
    frames = collect_frames([args.reference], canonical=False, velocities=True)
    structure = model.structure(model.featurise(weights.domain.scene))

    @torch.inference_mode()
    def step(x: FloatArray, v: FloatArray) -> State:
        found = model(torch.from_numpy(x), torch.from_numpy(v), structure)
        return found[0][:, -1].numpy(), found[1][:, -1].numpy()

    spec = ForceFieldSpec(of["force_field"], of["solvent"], None, constrain_hydrogens=False)
    span = model.n_new * model.config.frame_stride
    with Engine(frames.scene, Conditions(force=spec, platform="Reference", timestep_ps=0.0005)) as engine:
        for row in chunk_errors(step, frames, span, engine.forces, starts=args.starts, steps=args.steps):
            sys.stdout.write(
                f"{row.name:24} position {10 * row.position_nm:.4f} Å   velocity {row.velocity_nm_ps:.3f} nm/ps\n"
            )


if __name__ == "__main__":
    main()
