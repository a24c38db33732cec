"""A part of the training runs that fits into 60 MiB: `python docs/studies/training/peptide_subset.py write OUT ...`.

For a machine with a GPU that little can be carried to. All atoms are kept, as int16: hydrogens are part of what the
model learns, and placing them anew would teach it their ideal places. Of each molecule about as many frames: half of
them 1 ps apart, in stretches drawn by how rare the states of torsions in them are, half 10 ps apart, in whole runs
drawn in the same way: `OUT/MOLECULE/fine.windows.h5` and `wide.windows.h5`, windows files as of `surromd windows`.
Other recipes take OUT as `--train`. What is held out of all runs is not trained on here either.

The flow is what a GPU is for. How likely states are, stretches do not tell: weights trained on them are where a short
training on all runs starts (`peptide_transfer --start`).

`measure OUT --train RUNS/train`: trains on a tenth of the molecules, of all their runs and of OUT, equally many steps,
and prints how far the flow's loss on what all runs hold out differs.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from peptide_list import training_peptides
from processes import is_trained

from surrogate.data import Split, TrainingFrames, collect_frames, load_frames
from surrogate.models.peptides.layout import PeptideConfig, chain_features
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.peptides.subjects import PeptideSubject, balanced_starts
from surrogate.models.peptides.trainer import PeptideTraining, peptide_loss, train_peptides, with_scale
from surrogate.models.weights import load_weights
from systems.errors import InputError

MOST_MIB = 60.0
# Of frames 1 ps apart; a chunk and the frame before it take 17.
_STRETCH = 96
_WIDE_PS = 10.0
# What a file holds beside its frames: the scene, where they are from.
_HEADER_BYTES = 20_000
_EVERY, _HELD_WINDOWS = 10, 256
_RUNS, _PARTS = "run_*.h5", "*.windows.h5"
Ranges = list[tuple[int, int]]


def has_frames(folder: Path) -> bool:
    """True where a molecule's folder holds runs or parts of them."""
    return any(folder.glob(_RUNS)) or any(folder.glob(_PARTS))


def training_sets(folder: Path) -> list[TrainingFrames]:
    """Return a molecule's frames to train on: of its runs, or the parts of them that a subset has."""
    if files := sorted(folder.glob(_RUNS)):
        return [collect_frames(files)]
    return [load_frames(path) for path in sorted(folder.glob(_PARTS))]


def choose_parts(frames: TrainingFrames, n_frames: int, seed: int) -> tuple[TrainingFrames, TrainingFrames]:
    """Return about half of `n_frames` frames as close as they are, and half _WIDE_PS apart."""
    subject = PeptideSubject(frames, chain_features(frames.scene, with_scale(PeptideConfig(), [frames])))
    rng = np.random.default_rng(seed)
    trained, held = (frames.split.ranges(frames.starts, validation=which) for which in (False, True))
    close = [(k, k + _STRETCH) for low, high in trained for k in range(low, high - _STRETCH + 1, _STRETCH)]
    every = max(1, round(_WIDE_PS / frames.lag_ps))
    longest = max(high - low for low, high in trained) // every
    n_close, n_wide = (max(2, n_frames // 2 // each) for each in (_STRETCH, longest))
    fine = [*_drawn(subject, close, n_close - 1, rng), max(held, key=lambda r: r[1] - r[0])]
    return _parts(frames, fine, 1), _parts(frames, _drawn(subject, trained, n_wide, rng), every)


def _drawn(subject: PeptideSubject, ranges: Ranges, n: int, rng: np.random.Generator) -> Ranges:
    """Draw at most `n` of the ranges, those with rare states of torsions more often."""
    stated = subject.chain.stated
    states = subject.states(torch.arange(subject.frames.n_frames))[:, stated.residue.cpu(), stated.slot.cpu()]
    probabilities = balanced_starts(states).amax(dim=1).numpy() if states.shape[1] else np.ones(len(states))
    share: npt.NDArray[np.float64] = np.array([probabilities[low:high].mean() for low, high in ranges])
    drawn = rng.choice(len(ranges), size=min(n, len(ranges)), replace=False, p=share / share.sum())
    return [ranges[k] for k in drawn]


def _parts(frames: TrainingFrames, ranges: Ranges, every: int) -> TrainingFrames:
    """Return every `every`-th frame of the ranges, each a trajectory of its own, the last held out."""
    kept = [np.arange(low, high, every) for low, high in ranges]
    runs = np.searchsorted(frames.starts, [low for low, _ in ranges], side="right") - 1
    sources = tuple(
        {**frames.sources[run], "first_frame": int(idx[0] - frames.starts[run]), "every": every, "n_frames": len(idx)}
        for run, idx in zip(runs.tolist(), kept, strict=True)
    )
    starts = np.cumsum([0, *(len(idx) for idx in kept)])
    return replace(
        frames, coordinates=frames.coordinates[np.concatenate(kept)], starts=starts, lag_ps=frames.lag_ps * every,
        sources=sources, split=Split(held=(len(kept) - 1,)),
    )  # fmt: skip


def write(out: Path, runs: Path, most_mib: float) -> None:
    """Write the subset of all molecules below `runs` that have any; what is there stays."""
    files = {p.name: found for p in training_peptides() if (found := sorted((runs / p.name).glob(_RUNS)))}
    if not files:
        raise InputError(f"{runs} holds no runs of training peptides; give `train` in a folder of `peptide_runs`.")
    atoms = {name: collect_frames(found[:1]).scene.n_atoms for name, found in files.items()}
    room = most_mib * 2**20 - 2 * _HEADER_BYTES * len(files)
    n_frames = int(room / (6 * sum(atoms.values())))
    total = 0
    for k, (name, found) in enumerate(files.items()):
        targets = [out / name / f"{what}.windows.h5" for what in ("fine", "wide")]
        if not all(path.exists() for path in targets):
            (out / name).mkdir(parents=True, exist_ok=True)
            for part, path in zip(choose_parts(collect_frames(found), n_frames, seed=k), targets, strict=True):
                part.save(path)
        total += sum(load_frames(path).n_frames for path in targets)
        sys.stderr.write(f"{name}\n")
    mib = sum(path.stat().st_size for path in out.rglob(_PARTS)) / 2**20
    sys.stdout.write(f"{len(files)} molecules, {total} frames of all atoms, {mib:.1f} MiB\n")


def held_losses(model: PeptideSlide, sets: Sequence[TrainingFrames]) -> npt.NDArray[np.float64]:
    """Return the flow's loss `(n_sets,)` on windows of what each set holds out, the same for any model."""
    found = []
    for frames in sets:
        subject, generator = PeptideSubject(frames, chain_features(frames.scene, model.config)), torch.Generator()
        idx, times = subject.windows(_HELD_WINDOWS, model.config, generator.manual_seed(0), validation=True)
        with torch.no_grad():
            loss, _ = peptide_loss(model, subject.chain, *subject.seen(model, idx), times, generator, noisy=False)
        found.append(float(loss))
    return np.array(found)


def measure(subset: Path, runs: Path, steps: int) -> None:
    """Train on all runs and on the subset of a tenth of the molecules, print the losses; models stay in `subset`."""
    names = [p.name for p in training_peptides()[::_EVERY] if (subset / p.name).is_dir()]
    if not names:
        raise InputError(f"{subset} holds no part of any molecule that is measured; `write` it first.")
    whole = [frames for name in names for frames in training_sets(runs / name)]
    parts = [frames for name in names for frames in training_sets(subset / name)]
    # One start, so that what scales the numbers, and with it the unit of the losses, is one.
    first = train_peptides(whole, subset / "first.safetensors", PeptideConfig(), PeptideTraining(steps=1))
    losses = {}
    for what, sets in (("all runs", whole), ("subset", parts)):
        out = subset / f"{what.replace(' ', '-')}-{steps}.safetensors"
        if not is_trained(out):
            training = PeptideTraining(steps=steps)
            train_peptides(sets, out, PeptideConfig(), training, start=load_weights(first), resume=True)
        model = load_weights(out).model
        assert isinstance(model, PeptideSlide)
        losses[what] = held_losses(model, whole)
    worse = losses["subset"] - losses["all runs"]
    seen = {what: sum(frames.n_frames for frames in sets) for what, sets in (("all runs", whole), ("subset", parts))}
    record = {
        "molecules": names, "steps": steps, "frames": seen,
        "loss": {what: float(found.mean()) for what, found in losses.items()},
        "worse": float(worse.mean()), "error": float(worse.std(ddof=1) / len(worse) ** 0.5),
    }  # fmt: skip
    (subset / f"losses-{steps}.json").write_text(json.dumps(record, indent=1))
    sys.stdout.write(json.dumps(record, indent=1) + "\n")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("write", "measure"))
    parser.add_argument("subset", type=Path)
    parser.add_argument("--train", type=Path, required=True, help="all runs: `train` in a folder of `peptide_runs`")
    parser.add_argument("--mib", type=float, default=MOST_MIB, help="how large the subset may be")
    parser.add_argument("--steps", type=int, default=3000, help="of each training of `measure`")
    a = parser.parse_args(arguments)
    if a.what == "write":
        write(a.subset, a.train, a.mib)
    else:
        measure(a.subset, a.train, a.steps)


if __name__ == "__main__":
    main()
