"""The shipped weights of alanine dipeptide: plain LaM-SLidE as in its paper, from nothing to a comparison.

    python docs/studies/training/alanine_dipeptide.py FOLDER
    python docs/studies/training/alanine_dipeptide.py FOLDER --only train --budget 90min
    python docs/studies/training/alanine_dipeptide.py FOLDER --only train --form joined --budget 5min --device cuda

Steps, each skipped where its files are there and resumed where it was stopped:

- `reference`: ff14SB, OBC2, 300 K, 1/ps, 4 fs, SIMD replicas of 30 ns, frames 10 ps apart: 32 to train on (two of them
  are held out whole, for the validation curve) and 32 that training never sees, the test and its replicate.
- `train`: both stages, at most `--budget` of wall time; `model.csv` beside the weights has the curves. `--form joined`:
  all latents of a frame in one token; `random`: identifiers drawn anew for each sample of stage one.
- `ship`: weights as float16, `alanine-dipeptide.safetensors`.
- `compare`: 16 rollouts of 30 ns against sixteen test replicas, the other sixteen as the replicate baseline.

As in the paper: atoms are told apart by identifiers from a pool of 32 with random embeddings, a frame is a set of
latent vectors, each a token of its own, through blocks that attend along latents and along time by turns (Algorithm 5),
flow matching with data prediction (eq. 9) and auxiliary losses through the frozen decoder, AdamW, EMA 0.999, 10 solver
steps. Otherwise than there: frames are superposed on one template instead of turned at random, both stages keep one
assignment of identifiers, arbitrary but fixed (Figure 3), where the paper's first stage draws one for each sample
(Algorithm 1: after 900 steps frames came back to 0.072 nm; with the fixed one for half of the samples to 0.043 nm after
300; `random_identifiers` is that share), latents are trained with a little noise, the prediction is
preconditioned (Karras 2022) with logit-normal flow times, and every other window is shown backwards in time.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from processes import is_trained

from surrogate import api
from surrogate.data import TrainingFrames, collect_frames
from surrogate.models.lam_slide.model import ApproximatorConfig, AutoencoderConfig, LamSlideConfig
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
from surrogate.models.weights import load_weights, save_weights
from surrogate.progress import progress_bar
from systems.files.whole_file import replica_paths
from systems.units import parse_wall_s

SCENE = "alanine-dipeptide"
REPLICA_PS, LAG_PS = 30_000.0, 10.0
# First seed and number of replicas.
REFERENCE = {"train": (100, 32), "held": (200, 32)}
ROLLOUTS, ROLLOUT_SEED = 16, 1
STEPS = ("reference", "train", "ship", "compare")

MODEL = LamSlideConfig(
    autoencoder=AutoencoderConfig(n_latents=4, latent_dim=24, identifier_pool=32, random_identifiers=0.0),
    approximator=ApproximatorConfig(chunk_frames=8, latents_per_token=1, width=128, n_layers=4, auxiliary_frames=2),
)
FORMS = {
    "model": MODEL,
    "joined": replace(MODEL, approximator=replace(MODEL.approximator, latents_per_token=4)),
    "random": replace(MODEL, autoencoder=replace(MODEL.autoencoder, random_identifiers=1.0)),
}


def replicas(folder: Path, kind: str) -> list[Path]:
    return replica_paths(folder / f"{kind}.h5", REFERENCE[kind][1])


def make_reference(folder: Path) -> None:
    for kind, (seed, n) in REFERENCE.items():
        if not all(path.exists() for path in replicas(folder, kind)):
            api.reference(SCENE, folder / f"{kind}.h5", time_ps=REPLICA_PS, save_every_ps=LAG_PS, platform="simd",
                          replicas=n, seed=seed, resume=True)  # fmt: skip


def training_frames(folder: Path) -> TrainingFrames:
    """Return the frames of the training replicas, every twelfth of which is for validation."""
    paths = replicas(folder, "train")
    held = [path for k, path in enumerate(paths) if k % 16 == 15]
    return collect_frames([path for path in paths if path not in held and path.exists()],
                          held=[path for path in held if path.exists()])  # fmt: skip


def train(folder: Path, form: str, budget_s: float, device: str) -> Path:
    """Train both stages, a fifth of the budget for the first, and write `FORM.safetensors`."""
    out = folder / f"{form}.safetensors"
    if not is_trained(out):
        config = TrainingConfig(budget_s=budget_s, time_reversal=True, device=device)
        with progress_bar("alanine dipeptide", quiet=False) as advance:
            train_lam_slide(training_frames(folder), out, FORMS[form], config, resume=True,
                            progress=lambda stage, share, _: advance(round(1000 * share), 1000, stage))  # fmt: skip
    return out


def ship(weights: Path, out: Path) -> None:
    """Write weights as float16."""
    whole = load_weights(weights)
    save_weights(out, whole.model, whole.domain, whole.provenance, half=True)


def compare(folder: Path, weights: Path, ending: str) -> None:
    """Roll as many replicas as the test has, as long, and compare; `comparison.html` and what the command prints."""
    # Most frames of identifiers drawn anew are invalid: a guard would stop the rollout.
    how = {"guard": "off"} if ending == "_random" else {}
    outs = api.rollout(SCENE, weights, folder / f"rollout{ending}.h5", time_ps=REPLICA_PS, replicas=ROLLOUTS,
                       seed=ROLLOUT_SEED, resume=True, **how)  # fmt: skip
    held = replicas(folder, "held")
    api.compare(held[:ROLLOUTS], [outs], folder / f"comparison{ending}.html", replicate=held[ROLLOUTS:], overwrite=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--only", choices=STEPS, help="this step alone")
    parser.add_argument("--budget", default="95min", help="wall time of the training (default 95min)")
    parser.add_argument("--form", choices=FORMS, default="model", help="other ones are not shipped")
    parser.add_argument("--device", default="cpu", help="of the training")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    shipped = args.folder / f"{SCENE}.safetensors"
    plain = args.form == "model"
    for step in [s for s in STEPS if plain or s != "ship"] if args.only is None else [args.only]:
        if step == "reference":
            make_reference(args.folder)
        elif step == "train":
            train(args.folder, args.form, parse_wall_s(args.budget), args.device)
        elif step == "ship":
            ship(args.folder / "model.safetensors", shipped)
        else:
            weights, ending = (shipped, "") if plain else (args.folder / f"{args.form}.safetensors", f"_{args.form}")
            compare(args.folder, weights, ending)


if __name__ == "__main__":
    main()
