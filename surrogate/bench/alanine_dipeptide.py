"""The shipped weights, from nothing to a judged rollout: `python -m surrogate.bench.alanine_dipeptide`.

Makes 400 ns of reference to train on and 200 ns that training never sees (the truth and its replicate), trains, rounds
the weights to float16 for shipping, rolls 100 ns forward and compares. Every step that is already on disk is skipped,
an interrupted one is resumed.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

from surrogate import api
from systems.units import parse_wall_s

SCENE = "alanine-dipeptide"
TRAIN_SEED, N_TRAIN = 100, 4
HELD_SEED, N_HELD = 104, 2
REPLICA_PS = 100_000.0
ROLLOUT_SEED = 1
SNAPSHOT_S = 480.0


@dataclass(frozen=True)
class Paths:
    """Where the recipe's files lie."""

    folder: Path

    def reference(self, kind: str, n: int) -> list[Path]:
        return [self.folder / f"{kind}_r{k}.h5" for k in range(n)]

    @property
    def weights(self) -> Path:
        return self.folder / "model.safetensors"

    @property
    def shipped(self) -> Path:
        return self.folder / f"{SCENE}.safetensors"


def make_reference(paths: Paths, kind: str, n: int, seed: int) -> list[Path]:
    """Run the replicas that are missing: ff14SB, OBC2, 300 K, 1/ps, 4 fs, 3 Da, frames 1 ps apart."""
    api.reference(
        SCENE, paths.folder / f"{kind}.h5", time_ps=REPLICA_PS, save_every_ps=1.0, replicas=n, seed=seed, resume=True
    )
    return paths.reference(kind, n)


def train(paths: Paths, references: list[Path], budget_s: float) -> Path:
    """Train and write float32 weights, with a snapshot every eight minutes for the curve of error against time."""
    from surrogate.data.frames import collect_frames
    from surrogate.models.lam_slide.config import LamSlideConfig
    from surrogate.progress import progress_bar
    from surrogate.training.lam_slide import TrainingConfig, train_lam_slide

    if paths.weights.exists() and not list(paths.folder.glob("model.*.train.safetensors")):
        return paths.weights
    config = TrainingConfig(budget_s=budget_s, snapshot_every_s=SNAPSHOT_S)
    with progress_bar("training", quiet=False) as advance:

        def report(stage: str, share: float, metrics: dict[str, float]) -> None:
            if advance is not None:
                advance(round(1000 * share), 1000, stage)

        frames = collect_frames(references)
        return train_lam_slide(frames, paths.weights, LamSlideConfig(), config, resume=True, progress=report)


def ship(source: Path, target: Path) -> Path:
    """Round weights to float16 (half the size; a test holds the two together) and write them to `target`."""
    from surrogate.data.weights import load_weights, save_weights

    weights = load_weights(source)
    save_weights(target, weights.model, weights.domain, weights.provenance, half=True)
    return target


def judge(weights: Path, held: list[Path], folder: Path, name: str, solver_steps: int | None) -> dict[str, object]:
    """Roll 100 ns from the library's structure and compare with held-out reference, its second half the replicate."""
    out = folder / f"{name}.h5"
    api.rollout(SCENE, weights, out, time_ps=REPLICA_PS, seed=ROLLOUT_SEED, solver_steps=solver_steps, resume=True)
    comparison = api.compare(held[0], [out], folder / f"{name}.html", replicate=held[1], labels=[name])
    return comparison.to_dict()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/alanine-dipeptide"))
    parser.add_argument("--budget", default="55min", help="training time, both stages (default 55min)")
    parser.add_argument("--solver-steps", type=int, default=None)
    parser.add_argument("--curve", action="store_true", help="also judge every snapshot of the training")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    paths = Paths(args.out)
    references = make_reference(paths, "train", N_TRAIN, TRAIN_SEED)
    held = make_reference(paths, "held", N_HELD, HELD_SEED)
    train(paths, references, parse_wall_s(args.budget))
    ship(paths.weights, paths.shipped)
    rows = judge(paths.shipped, held, paths.folder, "rollout", args.solver_steps)
    (paths.folder / "figures.json").write_text(json.dumps(rows, indent=1))
    if args.curve:
        for snapshot in sorted(paths.folder.glob("model.at*min.safetensors")):
            judge(snapshot, held, paths.folder, snapshot.stem.replace("model.", "curve_"), args.solver_steps)


if __name__ == "__main__":
    main()
