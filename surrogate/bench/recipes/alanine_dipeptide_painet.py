"""PAINET as an integrator of alanine dipeptide, from nothing to its stress table: `python -m
surrogate.bench.recipes.alanine_dipeptide_painet`.

Makes short runs of constant energy with velocities at 300 and 450 K, and very short ones from their frames shaken: what
follows from a state does not depend on how likely it is, and a rollout comes by its own errors to states that 300 K
hardly know. Then trains, lets the model roll unguarded, and trains further with the truth about the states it came to.
The weights are judged as an integrator on a run that training never saw, and by `surromd stress`. Every step that is
already on disk is skipped, an interrupted one is resumed.

Bonds to hydrogen are flexible: the bath between chunks would set rigid ones in motion.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from surrogate.data.splits import Split
from systems.units import parse_wall_s

if TYPE_CHECKING:
    from surrogate.bench.integrator import IntegratorReport
    from surrogate.data.frames import TrainingFrames
    from surrogate.data.weights import Weights
    from surrogate.models.painet.config import PainetConfig
    from surrogate.models.painet.trainer import PainetTraining

FloatArray = npt.NDArray[np.float64]

SCENE = "alanine-dipeptide"
NAME = "alanine-dipeptide-painet"
RUN_PS, SAVE_EVERY_PS, TIMESTEP_PS, SETTLE_PS = 10.0, 0.001, 0.0005, 40.0
# Of the bath that settles the runs, and of the one that refreshes velocities between a rollout's chunks.
FRICTION_PER_PS, BATH_PER_PS = 5.0, 50.0


@dataclass(frozen=True)
class Runs:
    """`n` runs at one temperature, seeds `seed`, `seed` + 1, ..."""

    temperature_k: float
    n: int
    seed: int


# The last of the cold runs is held out.
COLD, HOT = Runs(300.0, 24, 1000), Runs(450.0, 22, 2000)
# Runs from frames whose atoms are displaced by up to so much (standard deviation), at 300 to 600 K.
N_SHAKEN, SHAKEN_NM, SHAKEN_K, SHAKEN_SEED = 12_000, 0.006, (300.0, 600.0), 3000
# States that rollouts of the first training come to: replicas and chunks of each.
N_VISITED, VISITING, VISITS, VISITED_SEED = 12_000, 48, 125, 4000
# Frames of a run from such a state, two chunks and the first; and the total energy up to which it is one.
SHORT_FRAMES, HIGHEST_KJ_MOL = 9, 500.0
FURTHER_RATE = 7e-4
# Frames of each piece that is taken from the long runs, and from one to the next: so that the shaken ones count.
PIECE, EVERY = 30, 400


def model_config() -> PainetConfig:
    """Two frames 2 fs apart at once: three kicks turn the fastest vibration by as much as a chunk does, exactly."""
    from surrogate.models.painet.config import PainetConfig

    return PainetConfig(n_new=2, frame_stride=2, width=48, n_decoder_layers=3, edges="all", decoder="leapfrog")


def training_config(budget_s: float) -> PainetTraining:
    """Without noise and pushforward: from a wrong state the right answer is what follows from that state."""
    from surrogate.models.painet.trainer import PainetTraining

    return PainetTraining(
        budget_s=budget_s, learning_rate=3e-3, noise=0.0, pushforward=0.0, velocity_weight=1.0, every_frame=True
    )


def make_reference(folder: Path, name: str, runs: Runs) -> list[Path]:
    """Run what is missing: ff14SB, OBC2, flexible bonds, natural masses, velocity Verlet, frames 1 fs apart."""
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.config import MDConfig
    from md_reference.run.replicas import simulate_replicas
    from systems.library.named_scenes import load
    from systems.trajectory.claim import replica_paths

    config = MDConfig(
        time_ps=RUN_PS,
        save_every_ps=SAVE_EVERY_PS,
        temperature_k=runs.temperature_k,
        friction_per_ps=FRICTION_PER_PS,
        timestep_ps=TIMESTEP_PS,
        equilibrate_ps=SETTLE_PS,
        seed=runs.seed,
        platform="Reference",
        force=ForceFieldSpec("ff14SB", "obc2", None, constrain_hydrogens=False),
        ensemble="nve",
        save_velocities=True,
    )
    return simulate_replicas(load(SCENE), config, replica_paths(folder / f"{name}.h5", runs.n), resume=True)


def shaken_states(frames: TrainingFrames) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield positions of frames with every atom displaced, and velocities drawn anew, nm and nm/ps."""
    scene, rng = frames.scene, np.random.default_rng(SHAKEN_SEED)
    thermal = np.sqrt(8.31446e-3 / scene.masses_da)[:, None]
    for start in rng.integers(frames.n_frames, size=(N_SHAKEN, 1)):
        shift = rng.uniform(0.0, SHAKEN_NM) * rng.standard_normal((scene.n_atoms, 3))
        velocities = np.sqrt(rng.uniform(*SHAKEN_K)) * thermal * rng.standard_normal((scene.n_atoms, 3))
        yield frames.positions_nm(start)[0].astype(np.float64) + shift, velocities


def visited_states(weights: Path, frames: TrainingFrames) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield states that unguarded rollouts of a first training come to, its own errors among them, until they are lost.

    What the model learns there is the truth of OpenMM (Ross, Gordon and Bagnell 2011, DAgger).
    """
    import torch

    from surrogate.data.weights import load_weights
    from surrogate.models.interface import Molecule
    from surrogate.models.painet.model import Painet

    model = load_weights(weights).model
    assert isinstance(model, Painet) and frames.velocities is not None
    scene, generator = frames.scene, torch.Generator().manual_seed(VISITED_SEED)
    molecule, structure = Molecule.of(scene), None
    starts = np.linspace(0, frames.n_frames - 1, VISITING).astype(np.int64)
    for _ in range(-(-N_VISITED // (VISITING * VISITS))):
        x, v = torch.from_numpy(frames.positions_nm(starts)), torch.from_numpy(frames.velocities[starts])
        structure = structure or model.structure(molecule)
        for _ in range(VISITS):
            with torch.inference_mode():
                v = model.refreshed(v, molecule, torch.randn(x.shape, generator=generator))
                yield from zip(x.double().numpy(), v.double().numpy(), strict=True)
                x, v = (s[:, -1] for s in model(x, v, structure))
        starts = (starts + 1_237) % frames.n_frames


def short_runs(path: Path, frames: TrainingFrames, states: Iterable[tuple[FloatArray, FloatArray]],
               source: dict[str, Any]) -> TrainingFrames:  # fmt: skip
    """Run OpenMM at constant energy from each state for SHORT_FRAMES frames; kept in a windows file. States that are
    beyond physics are left out."""
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.config import Conditions
    from md_reference.run.engine import Engine
    from surrogate.data.frames import at_rest, load_frames, quantise

    if path.exists():
        return load_frames(path)
    scene, spec = frames.scene, ForceFieldSpec("ff14SB", "obc2", None, constrain_hydrogens=False)
    x: list[FloatArray] = []
    v: list[FloatArray] = []
    # Without a bath the temperature only says what the engine takes for a blow-up.
    with Engine(
        scene,
        Conditions(
            force=spec, platform="Reference", timestep_ps=TIMESTEP_PS, ensemble="nve", temperature_k=10 * SHAKEN_K[1]
        ),
    ) as engine:
        for positions, velocities in states:
            kinetic = 0.5 * float((scene.masses_da[:, None] * np.square(velocities)).sum())
            if not kinetic + engine.energy(positions) < HIGHEST_KJ_MOL:
                continue
            engine.set_velocities(velocities)
            for _ in range(SHORT_FRAMES):
                state = engine.state(velocities=True)
                assert state.velocities_nm_ps is not None
                x.append(state.positions_nm)
                v.append(state.velocities_nm_ps)
                engine.step(round(SAVE_EVERY_PS / TIMESTEP_PS))
    found = replace(
        frames,
        coordinates=quantise(at_rest(np.stack(x), scene.masses_da)),
        velocities=at_rest(np.stack(v), scene.masses_da).astype(np.float32),
        starts=np.arange(0, len(x) + 1, SHORT_FRAMES),
        sources=({**source, "n_runs": len(x) // SHORT_FRAMES},),
    )
    found.save(path)
    return found


def thin(frames: TrainingFrames) -> TrainingFrames:
    """Return pieces of PIECE frames, from the first of each run and every EVERY frames on; held-out runs stay whole."""
    assert frames.velocities is not None
    keep, starts, held = [], [0], []
    for k, (begin, end) in enumerate(itertools.pairwise(frames.starts.tolist())):
        whole = k in frames.split.held
        for low in range(begin, end, end - begin if whole else EVERY):
            piece = np.arange(low, end if whole else min(low + PIECE, end))
            held += [len(starts) - 1] if whole else []
            keep.append(piece)
            starts.append(starts[-1] + len(piece))
    idx = np.concatenate(keep)
    return replace(frames, coordinates=frames.coordinates[idx], velocities=frames.velocities[idx],
                   starts=np.array(starts), split=Split(held=tuple(held)))  # fmt: skip


def join(first: TrainingFrames, *others: TrainingFrames) -> TrainingFrames:
    """Return the frames of all, under the conditions and with the held-out runs of the first."""
    parts = (first, *others)
    offsets = np.cumsum([0, *(p.n_frames for p in parts)])
    return replace(
        first,
        coordinates=np.concatenate([p.coordinates for p in parts]),
        velocities=np.concatenate([p.velocities for p in parts if p.velocities is not None]),
        starts=np.concatenate([[0], *(at + p.starts[1:] for at, p in zip(offsets, parts, strict=False))]),
        sources=tuple(source for p in parts for source in p.sources),
    )


def train(folder: Path, cold: list[Path], hot: list[Path], budgets_s: tuple[float, float]) -> Path:
    """Train on all but the last cold run, then further with what the first training comes to; return the weights."""
    from surrogate.data.frames import collect_frames
    from surrogate.data.weights import load_weights

    typical = collect_frames(cold[:-1], canonical=False, velocities=True, held=cold[-1:])
    hotter = collect_frames(hot, canonical=False, velocities=True)
    shaken = short_runs(folder / "shaken.h5", typical, shaken_states(join(typical, hotter)),
                        {"shaken_nm": SHAKEN_NM, "temperatures_k": SHAKEN_K, "seed": SHAKEN_SEED})  # fmt: skip
    frames = join(thin(typical), thin(hotter), shaken)
    first = _train(folder / "first.safetensors", frames, typical, training_config(budgets_s[0]), None)
    visited = short_runs(folder / "visited.h5", typical, visited_states(first, hotter),
                         {"visited_by": first.name, "seed": VISITED_SEED})  # fmt: skip
    further = replace(training_config(budgets_s[1]), learning_rate=FURTHER_RATE, seed=1)
    return _train(folder / "further.safetensors", join(frames, visited), typical, further, load_weights(first))


def _train(out: Path, frames: TrainingFrames, typical: TrainingFrames, config: PainetTraining,
           start: Weights | None) -> Path:  # fmt: skip
    from surrogate.models.painet.trainer import train_painet
    from surrogate.progress import training_bar

    if out.exists() and not list(out.parent.glob(f"{out.stem}.*.train.safetensors")):
        return out
    with training_bar(f"training {out.stem}") as report:
        return train_painet(frames, out, model_config(), config, typical=typical, start=start, resume=True,
                            progress=report)  # fmt: skip


def ship(source: Path, target: Path) -> Path:
    """Write the weights with the bath of rollouts: strong enough to take away the heat of the model's errors."""
    from surrogate.data.weights import load_weights, save_weights

    weights = load_weights(source)
    weights.model.config = replace(weights.model.config, friction_per_ps=BATH_PER_PS)
    save_weights(target, weights.model, weights.domain, weights.provenance)
    return target


def judge(weights: Path, held: Path) -> IntegratorReport:
    """Judge the weights as an integrator from states of the held-out run."""
    from surrogate.bench.integrator import judge_weights
    from surrogate.data.frames import collect_frames

    return judge_weights(weights, collect_frames([held], canonical=False, velocities=True), starts=16, chunks=250)


def stress(weights: Path, folder: Path, lengths: list[int], guards: list[str]) -> dict[str, Any]:
    """Run `surromd stress` in lengths of `lengths` frames under each guard; sections that were run stay."""
    from surrogate.bench.stress.stress_options import StressOptions
    from surrogate.bench.stress.trials import choose_config, stress_weights

    config = choose_config(StressOptions(frames=lengths, guards=guards))
    return stress_weights(weights, folder, config, report=lambda name: _say(f"stress: {name}\n"))


def _say(line: str) -> None:
    sys.stdout.write(line)
    sys.stdout.flush()


def main() -> None:
    import torch

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs") / NAME)
    parser.add_argument("--budget", default="15min", help="of the first training (default 15min)")
    parser.add_argument("--further", default="20min", help="of the further training (default 20min)")
    parser.add_argument("--frames", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--guard", nargs="+", default=["flag", "repair", "fallback"])
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    cold, hot = (make_reference(args.out, name, runs) for name, runs in (("cold", COLD), ("hot", HOT)))
    trained = train(args.out, cold, hot, (parse_wall_s(args.budget), parse_wall_s(args.further)))
    weights = ship(trained, args.out / f"{NAME}.safetensors")
    report = asdict(judge(weights, cold[-1]))
    (args.out / "integrator.json").write_text(json.dumps(report, indent=1))
    for key, value in report.items():
        _say(f"{key:20} {value:.5g}\n")
    stress(weights, args.out / "stress", args.frames, args.guard)


if __name__ == "__main__":
    main()
