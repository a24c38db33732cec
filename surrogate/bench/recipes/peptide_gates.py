"""Gates of the weights `peptides`, each a table: `python -m surrogate.bench.recipes.peptide_gates lag FOLDER ...`.

`lag`: one model of alanine dipeptide (or any one peptide with phi and psi), trained for a number of steps on `--train`,
is started from frames of `--test`, which it never saw. At each lag: the correlation of cos psi one lag later and the
joint phi/psi distance, beside MD from the same starts; and Chapman and Kolmogorov's test: ten steps of 10 ps against
one of 100 ps, beside two halves of MD. `--plain` trains without innovations, the ablation. What is finished in FOLDER
is not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from surrogate.bench.lag_errors import Row, evenly_started, hold_against, joint_distance, table, torsions
from systems.chemistry.validity import Geometry

if TYPE_CHECKING:
    from surrogate.data.frames import TrainingFrames
    from surrogate.data.weights import Weights

FloatArray = npt.NDArray[np.float64]
LAGS_PS = (1, 3, 10, 30, 100, 300, 1000)
STEPS = 7300
STARTS = 5000
_SHORT_PS, _STEPS_OF_SHORT = 10.0, 10


def train(references: Sequence[Path], out: Path, *, steps: int, innovation: bool) -> None:
    """Train on one peptide's references; what is there stays, what was interrupted goes on."""
    from surrogate.data.frames import collect_frames
    from surrogate.models.lam_slide.trainer import is_trained
    from surrogate.models.peptides.model import PeptideConfig
    from surrogate.models.peptides.trainer import PeptideTraining, train_peptides

    if is_trained(out):
        return
    training = PeptideTraining(steps=steps, time_reversal=True)
    train_peptides([collect_frames(list(references))], out, PeptideConfig(innovation=innovation), training, resume=True)


def draw(weights: Weights, first_nm: FloatArray, lag_ps: float, n_chunks: int = 1) -> FloatArray:
    """Return the frames `(n_starts, n, n_atoms, 3)` nm that follow `first_nm` (n_starts, n_atoms, 3)."""
    from surrogate.sampling.chunks import ChunkSampler, noise_seed
    from surrogate.sampling.domain import fit_weights

    fitted, _ = fit_weights(weights.domain.scene, weights, lag_ps=lag_ps)
    sampler = ChunkSampler(fitted)
    sampler.batch = 256
    found = [first_nm[:, None]]
    for k in range(n_chunks):
        seeds = [noise_seed(0, row, k) for row in range(len(first_nm))]
        found.append(np.asarray(sampler.draw(found[-1][:, -1:], seeds).frames_nm, dtype=np.float64))
    return np.concatenate(found[1:], axis=1)


def lag_rows(weights: Weights, test: TrainingFrames, lag_ps: float, n_starts: int) -> list[Row]:
    """Return the rows of MD and of the model at one lag, of the first frame after each start alone."""
    known = evenly_started(test, 2, round(lag_ps / test.lag_ps), n_starts)
    geometry = Geometry.from_dict(weights.domain.geometry)
    sources = {"MD": known[:, 1:], "model": draw(weights, known[:, 0], lag_ps)[:, :1]}
    return [hold_against(test, known[:, 0], x, geometry, lag_ps, name) for name, x in sources.items()]


def chapman_kolmogorov(weights: Weights, test: TrainingFrames, n_starts: int) -> dict[str, float]:
    """Return the joint phi/psi distance of ten short steps to one long one, and that of two halves of MD.

    Half as many frames lie further apart by chance, so MD's halves are of as many frames as the model's two sets.
    """
    stride = round(_SHORT_PS * _STEPS_OF_SHORT / test.lag_ps)
    known = evenly_started(test, 2, stride, 2 * n_starts)
    first = known[:n_starts, 0]
    one_chunk = draw(weights, first[:1], _SHORT_PS).shape[1]
    short = draw(weights, first, _SHORT_PS, -(-_STEPS_OF_SHORT // one_chunk))[:, _STEPS_OF_SHORT - 1]
    long = draw(weights, first, _SHORT_PS * _STEPS_OF_SHORT)[:, 0]
    return {
        "ten steps against one": joint_distance(torsions(test.scene, short), torsions(test.scene, long)),
        "halves of MD": joint_distance(torsions(test.scene, known[::2, 1]), torsions(test.scene, known[1::2, 1])),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse, train, measure, print the table and keep it in FOLDER."""
    from surrogate.data.frames import collect_frames
    from surrogate.data.weights import load_weights

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("gate", choices=("lag",))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--train", type=Path, nargs="+", required=True, help="references of one peptide")
    parser.add_argument("--test", type=Path, nargs="+", required=True, help="references that training does not see")
    parser.add_argument("--steps", type=int, default=STEPS, help="optimisation steps of the training")
    parser.add_argument("--starts", type=int, default=STARTS, help="frames that each lag is started from")
    parser.add_argument("--plain", action="store_true", help="train on the coordinates themselves, not on innovations")
    a = parser.parse_args(arguments)
    a.folder.mkdir(parents=True, exist_ok=True)
    name = "lag-plain" if a.plain else "lag"
    train(a.train, a.folder / f"{name}.safetensors", steps=a.steps, innovation=not a.plain)
    weights, test = load_weights(a.folder / f"{name}.safetensors"), collect_frames(list(a.test))
    rows = []
    for lag_ps in LAGS_PS:
        if lag_ps <= weights.domain.longest_lag_ps * (1 + 1e-6):
            rows += lag_rows(weights, test, lag_ps, a.starts)
            sys.stderr.write(f"{lag_ps} ps measured\n")
    found = chapman_kolmogorov(weights, test, a.starts)
    record: dict[str, Any] = {"provenance": weights.provenance, "rows": [asdict(row) for row in rows], **found}
    (a.folder / f"{name}.json").write_text(json.dumps(record, indent=1))
    sys.stdout.write(table(rows) + "\n" + "\n".join(f"{what}: {value:.3f}" for what, value in found.items()) + "\n")


if __name__ == "__main__":
    main()
