"""The shipped weights, from nothing to a judged rollout: `python docs/studies/training/alanine_dipeptide.py`.

Makes the reference to train on and 200 ns that training never sees (the truth and its replicate), trains, rounds the
weights to float16 for shipping, rolls 100 ns forward and compares. Every step that is already on disk is skipped, an
interrupted one is resumed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from surrogate import api
from systems.trajectory.claim import replica_paths
from systems.units import parse_wall_s

if TYPE_CHECKING:
    from surrogate.data.weights import Weights
    from surrogate.models.lam_slide.trainer import TrainingConfig

Angles = npt.NDArray[np.floating[Any]]
SCENE = "alanine-dipeptide"
# Kind of run: first seed and number of replicas. `more` was added when the first 400 ns turned out to hold a single
# crossing to phi > 0, `later` and `last` for the further training; the held-out runs are those of the first version.
TRAIN = {"train": (100, 4), "more": (106, 3)}
FURTHER = {"later": (109, 1), "last": (116, 1)}
HELD = {"held": (104, 2)}
REPLICA_PS = 100_000.0
ROLLOUT_SEED = 1
ROLLOUT_REPLICAS = 16
LONG_PS, LONG_SEED = 1_000_000.0, 5
CURVE_PS = 20_000.0
FIGURES = ("joint_jsd", "correlation:1", "correlation_time", "valid:2", "valid:4")
SNAPSHOT_S = 600.0
STAGES = ("first", "further", "kinds")
# Each further training starts from the weights of the one before, at a lower rate, and draws rare windows more often.
# The last one also names the kind of a window to the network: without, crossings to phi > 0 are never made.
RARE_DRAWS = 0.3
FURTHER_RATE, FURTHER_SEED = 7e-4, 10
KINDS_RATE, KINDS_SEED = 6e-4, 11
# The last training knows rare windows too well and ordinary ones a little worse: weights most of the way between the
# two (WiSE-FT, Wortsman 2022) keep the time scales of the one and the crossings of the other.
KINDS_SHARE = 0.85


@dataclass(frozen=True)
class Paths:
    """Where the recipe's files lie."""

    folder: Path

    def reference(self, kind: str, n: int) -> list[Path]:
        return replica_paths(self.folder / f"{kind}.h5", n)

    def stage(self, name: str) -> Path:
        return self.folder / f"{name}.safetensors"

    @property
    def weights(self) -> Path:
        return self.folder / "model.safetensors"

    @property
    def shipped(self) -> Path:
        return self.folder / f"{SCENE}.safetensors"


def make_reference(paths: Paths, kinds: dict[str, tuple[int, int]]) -> list[Path]:
    """Run the replicas that are missing: ff14SB, OBC2, 300 K, 1/ps, 4 fs, 3 Da, frames 1 ps apart."""
    for kind, (seed, n) in kinds.items():
        out = paths.folder / f"{kind}.h5"
        api.reference(SCENE, out, time_ps=REPLICA_PS, save_every_ps=1.0, replicas=n, seed=seed, resume=True)
    return [path for kind, (_, n) in kinds.items() for path in paths.reference(kind, n)]


def train(paths: Paths, references: list[Path], further: list[Path], budgets_s: tuple[float, float, float], *,
          compile_: bool) -> Path:  # fmt: skip
    """Train on `references`, then twice further on these and `further`, and write float32 weights.

    Snapshots every ten minutes stay beside each, for the curve of error against time.
    """
    from surrogate.data.weights import load_weights
    from surrogate.models.lam_slide.trainer import TrainingConfig

    common: dict[str, Any] = {"snapshot_every_s": SNAPSHOT_S, "time_reversal": True, "compile": compile_}
    configs = [
        TrainingConfig(budget_s=budgets_s[0], **common),
        TrainingConfig(
            budget_s=budgets_s[1], stage_two_rate=FURTHER_RATE, seed=FURTHER_SEED, rare_draws=RARE_DRAWS, **common
        ),
        TrainingConfig(
            budget_s=budgets_s[2],
            stage_two_rate=KINDS_RATE,
            seed=KINDS_SEED,
            rare_draws=RARE_DRAWS,
            rare_kinds=True,
            **common,
        ),
    ]
    start = None
    for number, (name, config) in enumerate(zip(STAGES, configs, strict=True)):
        _train(paths.stage(name), references if number == 0 else [*references, *further], config, start)
        start = load_weights(paths.stage(name))
    if not paths.weights.exists():
        average(paths.stage("further"), paths.stage("kinds"), KINDS_SHARE, paths.weights)
    return paths.weights


def average(before: Path, after: Path, share: float, out: Path) -> Path:
    """Write the weights `share` of the way from `before` to `after`, which a further training made of them.

    What only the second has (kinds and their odds) is taken whole.
    """
    from surrogate.data.weights import load_weights, save_weights

    old, new = load_weights(before), load_weights(after)
    begun, found = old.model.state_dict(), new.model.state_dict()
    found |= {name: torch.lerp(begun[name].float(), value.float(), share).to(value.dtype)
              for name, value in found.items() if name in begun}  # fmt: skip
    new.model.load_state_dict(found)
    provenance = {**new.provenance, "average": {"of": [old.hash, new.hash], "share": share}}
    save_weights(out, new.model, new.domain, provenance, stiff=new.stiff)
    return out


def _train(out: Path, references: list[Path], config: TrainingConfig, start: Weights | None) -> Path:
    from surrogate.data.frames import collect_frames
    from surrogate.models.lam_slide.config import LamSlideConfig
    from surrogate.models.lam_slide.trainer import is_trained, train_lam_slide
    from surrogate.progress import training_bar

    if is_trained(out):
        return out
    with training_bar(f"training {out.stem}") as report:
        frames = collect_frames(references)
        return train_lam_slide(frames, out, LamSlideConfig(), config, start=start, resume=True, progress=report)


def ship(source: Path, target: Path, references: Sequence[Path] = ()) -> Path:
    """Round weights to float16 (half the size; a test holds the two together) and write them to `target`, with the
    stiff terms of `references` (models.stiff) where these are given, else those that they have."""
    from surrogate.data.features.stiff_terms import drawn_terms
    from surrogate.data.frames import collect_frames
    from surrogate.data.weights import load_weights, save_weights

    weights = load_weights(source)
    provenance, stiff = weights.provenance, weights.stiff
    if references:
        frames = collect_frames(list(references))
        provenance, stiff = {**provenance, "stiff_terms": frames.origin}, drawn_terms(frames)
    save_weights(target, weights.model, weights.domain, provenance, stiff=stiff, half=True)
    return target


def judge(
    weights: Path, held: list[Path], folder: Path, name: str, *, total_ps: float, solver_steps: int | None
) -> dict[str, Any]:
    """Roll `total_ps` in a batch, compare with as much held-out reference (the other held-out run is the replicate).

    Returns the figures that the project is judged by, each with its interval, and writes the report beside the rollout.
    """
    outs = api.rollout(
        SCENE,
        weights,
        folder / f"{name}.h5",
        time_ps=total_ps / ROLLOUT_REPLICAS,
        replicas=ROLLOUT_REPLICAS,
        seed=ROLLOUT_SEED,
        solver_steps=solver_steps,
        resume=True,
    )
    comparison = api.compare(held[0], [outs], folder / f"{name}.html", replicate=held[1], labels=[name], overwrite=True)
    judgement = comparison.judgements[0]
    rows: dict[str, Any] = {key: judgement.row(key).to_dict() for key in FIGURES}
    for key, row in rows.items():
        sys.stdout.write(f"{name:16s} {key:18s} {row['candidate']}  floor or reference: {row['replicate']}\n")
    return rows


class Maps:
    """Joint phi/psi histograms of trajectories and the share of frames, in per cent, at phi > 0."""

    def __init__(self) -> None:
        from surrogate.judge.measure.structure import backbone
        from systems.library.named_scenes import load

        self.scene = load(SCENE)
        residue = backbone(self.scene)
        self.quads = np.stack([residue.phi[0], residue.psi[0]])

    def angles(self, paths: list[Path]) -> list[Angles]:
        """Return phi and psi `(n_frames, 2)` of each continuous stretch, rad."""
        from surrogate.judge.read.ensemble import load_ensemble
        from systems.chemistry.geometry import torsion

        return [torsion(x, self.quads) for x in load_ensemble(paths, template=self.scene).segments]

    def of(self, segments: list[Angles]) -> tuple[npt.NDArray[np.float64], float]:
        """Return the histogram of stretches, flat, and the share."""
        from surrogate.judge.measure.distributions import RAMACHANDRAN_BINS, is_positive

        angles, n = np.concatenate(segments), RAMACHANDRAN_BINS.n_total
        phi, psi = (RAMACHANDRAN_BINS.index(angles[:, k]) for k in range(2))
        counts = np.bincount(phi * n + psi, minlength=n * n).astype(np.float64)
        return counts, 100.0 * float(is_positive(angles[:, 0]).mean())


def noise_floor(references: list[Path], rollout: list[Path]) -> dict[str, Any]:
    """Return the joint phi/psi distance of every pair of reference runs and of the rollout to each, and phi > 0.

    One replicate is one draw of the floor: a state that is visited once in 200 ns makes pairs of 100 ns differ widely.
    """
    from surrogate.judge.measure.distributions import distance

    maps = Maps()
    counts, share = zip(*(maps.of(maps.angles(paths)) for paths in [*([p] for p in references), rollout]), strict=True)
    to_each = [float(distance(counts[-1], c)) for c in counts[:-1]]
    pairs = [float(distance(a, b)) for k, a in enumerate(counts[:-1]) for b in counts[k + 1 : -1]]
    sys.stdout.write(
        f"{len(pairs)} pairs of reference runs: joint distance {min(pairs):.3f} to {max(pairs):.3f}, median "
        f"{np.median(pairs):.3f}; rollout to each: {min(to_each):.3f} to {max(to_each):.3f}, median "
        f"{np.median(to_each):.3f}\nphi > 0, %: references {' '.join(f'{x:.2f}' for x in share[:-1])}; "
        f"rollout {share[-1]:.2f}\n"
    )
    return {"pairs": pairs, "rollout": to_each, "positive_phi_percent": list(share)}


def judge_long(weights: Path, others: list[Path], held: list[Path], folder: Path) -> dict[str, Any]:
    """Roll a microsecond with `--guard repair`, cut it into pieces of 100 ns and compare each with the first held-out
    run, beside what the `others` (runs of 100 ns) and the replicate score.

    A state that is entered five times in a microsecond makes a single rollout of 100 ns a matter of luck.
    """
    from surrogate.judge.measure.distributions import distance

    n = 2 * ROLLOUT_REPLICAS
    outs = api.rollout(
        SCENE, weights, folder / "long.h5", time_ps=LONG_PS / n, replicas=n, seed=LONG_SEED, guard="repair", resume=True
    )
    maps = Maps()
    truth, _ = maps.of(maps.angles(held[:1]))
    rolled, length = maps.angles(outs), round(REPLICA_PS / ROLLOUT_REPLICAS)
    groups = [
        [angles[start : start + length] for angles in rolled[half::2]]
        for half in range(2)
        for start in range(0, len(rolled[0]) - length + 1, length)
    ]
    found: dict[str, Any] = {}
    for name, each in (
        ("pieces", groups),
        ("replicate", [maps.angles(held[1:])]),
        ("other runs", [maps.angles([path]) for path in others]),
        ("whole", [rolled]),
    ):
        rows = [maps.of(segments) for segments in each]
        found[name] = {"distance": [float(distance(truth, c)) for c, _ in rows], "positive_phi": [p for _, p in rows]}
    limit = 2.0 * found["replicate"]["distance"][0]
    for name, row in found.items():
        within = f"{sum(d <= limit for d in row['distance'])} of {len(row['distance'])} within {limit:.3f}"
        distances = " ".join(f"{d:.3f}" for d in row["distance"])
        positive = " ".join(f"{p:.2f}" for p in row["positive_phi"])
        sys.stdout.write(f"{name:12s} joint distance {distances}: {within}; phi > 0, % {positive}\n")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/alanine-dipeptide"))
    parser.add_argument("--budget", default="65min", help="of the first training, both stages (default 65min)")
    parser.add_argument("--further", default="94min", help="of the further training, second stage (default 94min)")
    parser.add_argument("--kinds", default="45min", help="of the last one, with rare kinds named (default 45min)")
    parser.add_argument("--compile", action="store_true", help="compile the network (needs a C++ compiler)")
    parser.add_argument("--solver-steps", type=int, default=None)
    parser.add_argument("--long", action="store_true", help="also a microsecond, judged in pieces of 100 ns")
    parser.add_argument("--curve", action="store_true", help="also judge every snapshot of the training")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    paths = Paths(args.out)
    references = make_reference(paths, TRAIN)
    further = make_reference(paths, FURTHER)
    held = make_reference(paths, HELD)
    budgets_s = (parse_wall_s(args.budget), parse_wall_s(args.further), parse_wall_s(args.kinds))
    train(paths, references, further, budgets_s, compile_=args.compile)
    if not paths.shipped.exists():
        ship(paths.weights, paths.shipped, [*references, *further])
    steps = args.solver_steps
    figures: dict[str, Any] = {}
    figures["rollout"] = judge(paths.shipped, held, paths.folder, "rollout", total_ps=REPLICA_PS, solver_steps=steps)
    rolled = replica_paths(paths.folder / "rollout.h5", ROLLOUT_REPLICAS)
    figures["floor"] = noise_floor([*references, *further, *held], rolled)
    if args.long:
        figures["long"] = judge_long(paths.shipped, [*references, *further], held, paths.folder)
    if args.curve:
        snapshots = [p for stem in STAGES for p in sorted(paths.folder.glob(f"{stem}.at*min.safetensors"))]
        for weights in [*snapshots, *(paths.stage(name) for name in STAGES), paths.weights]:
            name = "curve_" + weights.stem.replace(".at", "_")
            figures[name] = judge(weights, held, paths.folder, name, total_ps=CURVE_PS, solver_steps=steps)
    (paths.folder / "figures.json").write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
