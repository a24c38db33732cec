"""Teach weights of peptides to arrive in few evaluations: `python docs/studies/training/peptide_distil.py OUT ...`.

`--train`: a folder of training runs (`train` in a folder of `peptide_runs`), of which windows are drawn. What is in OUT
half done is gone on with.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from peptide_subset import training_sets

from surrogate.models.peptides.distil import distil
from surrogate.models.peptides.trainer import PeptideTraining
from surrogate.models.weights import load_weights
from systems.units import parse_wall_s

_LEARNING_RATE, _VALIDATE_S = 3e-4, 300.0


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--weights", type=Path, required=True, help="of the teacher")
    parser.add_argument("--train", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=2, help="evaluations of a rollout")
    parser.add_argument("--budget", required=True, help="wall time, as 40min")
    a = parser.parse_args(arguments)
    sets = [frames for folder in sorted(a.train.iterdir()) for frames in training_sets(folder)]
    training = PeptideTraining(
        budget_s=parse_wall_s(a.budget, "--budget"), learning_rate=_LEARNING_RATE, validate_every_s=_VALIDATE_S
    )
    distil(sets, load_weights(a.weights), a.out, training, steps=a.steps, resume=True)


if __name__ == "__main__":
    main()
