"""Error against lag of a LaM-SLidE that takes it.

`python docs/studies/training/lag_errors.py FOLDER --train REF... --test REF...`

One model is trained on alanine dipeptide (or another peptide with phi and psi) for all spacings of frames up to
`--longest-lag-ps`. At each of some lags it is started from frames of a trajectory that it never saw, which are in
equilibrium, so that all it makes should be, too, and should forget where it started as fast as MD does. Beside it: MD
itself, continued from the same frames, which is the replicate baseline of every figure, and the model told the shortest
lag whatever is asked, which shows what the lag is worth to it. What is finished in FOLDER is not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.validity import INVALID, Geometry, check_frames
from systems.units import parse_wall_s

if TYPE_CHECKING:
    from surrogate.data import TrainingFrames
    from surrogate.models.weights import Weights
    from systems.scene import Scene

FloatArray = npt.NDArray[np.float64]
LAGS_PS = (1, 3, 10, 30, 100, 300, 1000)
CHUNK_FRAMES = 16
_BINS = 24


@dataclass(frozen=True)
class Row:
    """One source at one lag: the share of `valid` frames, the Jensen-Shannon distance of their joint phi/psi to the
    test trajectories', and the correlation of cos psi and cos phi with the `starts` one lag later."""

    lag_ps: float
    source: str
    valid: float
    jsd: float
    psi: float
    phi: float
    starts: int

    def error(self, correlation: float) -> float:
        """Return the standard error of one of its correlations (Fisher)."""
        return float((1.0 - correlation**2) / self.starts**0.5)


def train(references: Sequence[Path], out: Path, *, longest_lag_ps: float, budget_s: float) -> None:
    """Train one model for all lags; what is there stays, what was interrupted goes on."""
    from processes import is_trained

    from surrogate.data import collect_frames
    from surrogate.models.lam_slide.model import ApproximatorConfig, LamSlideConfig
    from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide

    if is_trained(out):
        return
    settings = TrainingConfig(budget_s=budget_s, time_reversal=True, longest_lag_ps=longest_lag_ps)
    config = LamSlideConfig(approximator=ApproximatorConfig(chunk_frames=CHUNK_FRAMES))
    train_lam_slide(collect_frames(list(references)), out, config, settings, resume=True)


def torsions(scene: Scene, frames_nm: FloatArray) -> FloatArray:
    """Return the first phi and psi `(..., 2)` of frames `(..., n_atoms, 3)`."""
    from systems.chemistry.geometry import torsion
    from systems.chemistry.graph import backbone_torsions

    of = backbone_torsions(scene)
    flat = frames_nm.reshape(-1, *frames_nm.shape[-2:])
    found: FloatArray = np.asarray(torsion(flat, [of["phi"][0], of["psi"][0]]), dtype=np.float64)
    return found.reshape(*frames_nm.shape[:-2], 2)


def measure(weights: Weights, test: TrainingFrames, lag_ps: float, n_starts: int) -> list[Row]:
    """Return the rows of one lag: MD, the model, and the model told the shortest lag."""
    from surrogate.sampling.chunks import ChunkSampler
    from surrogate.sampling.domain import fit_weights

    known = evenly_started(test, weights.model.n_new + 1, round(lag_ps / test.lag_ps), n_starts)
    sources = {"MD": known[:, 1:]}
    for name, told_ps in (("model", lag_ps), ("model, told the shortest", weights.domain.lag_ps)):
        fitted, _ = fit_weights(weights.domain.scene, weights, lag_ps=told_ps)
        drawn = ChunkSampler(fitted).draw(known[:, :1], list(range(n_starts)))
        sources[name] = np.asarray(drawn.frames_nm, dtype=np.float64)
    geometry = Geometry.from_dict(weights.domain.geometry)
    return [hold_against(test, known[:, 0], frames, geometry, lag_ps, name) for name, frames in sources.items()]


def evenly_started(test: TrainingFrames, length: int, stride: int, n_starts: int) -> FloatArray:
    """Return windows `(n_starts, length, n_atoms, 3)` nm of frames `stride` apart, spread evenly over a test set."""
    starts = test.window_starts((length - 1) * stride + 1, validation=False)
    starts = starts[np.linspace(0, len(starts) - 1, n_starts).astype(int)]
    return test.positions_nm(starts[:, None] + np.arange(length) * stride).astype(np.float64)


def hold_against(test: TrainingFrames, first_nm: FloatArray, frames_nm: FloatArray, geometry: Geometry, lag_ps: float,
                 source: str) -> Row:  # fmt: skip
    """Return the row of frames `(n_starts, n, n_atoms, 3)` nm that came after `first_nm` (n_starts, n_atoms, 3)."""
    everything = torsions(test.scene, test.positions_nm(np.arange(0, test.n_frames, 5)).astype(np.float64))
    first, found = torsions(test.scene, first_nm), torsions(test.scene, frames_nm)
    flags = check_frames(frames_nm.reshape(-1, *frames_nm.shape[2:]), geometry)
    phi, psi = (_correlation(np.cos(first[:, k]), np.cos(found[:, 0, k])) for k in (0, 1))
    valid = float(((flags & INVALID) == 0).mean())
    jsd = joint_distance(found.reshape(-1, 2), everything)
    return Row(lag_ps, source, valid, jsd, psi, phi, len(first))


def _correlation(x: FloatArray, y: FloatArray) -> float:
    """Of two draws from one equilibrium, whose mean and variance they share."""
    both = np.concatenate([x, y])
    return float(((x - both.mean()) * (y - both.mean())).mean() / both.var())


def joint_distance(x: FloatArray, y: FloatArray) -> float:
    """Return the Jensen-Shannon distance of two sets of (phi, psi), each `(n, 2)` rad."""
    from surrogate.comparison.measure.distributions import distance

    edges = np.linspace(-np.pi, np.pi, _BINS + 1)
    counts = [np.histogram2d(a[:, 0], a[:, 1], bins=(edges, edges))[0].ravel() for a in (x, y)]
    return float(distance(*counts))


def table(rows: Sequence[Row]) -> str:
    """Return the rows as Markdown."""
    lines = [
        "| lag, ps | frames of | valid | joint φ/ψ JSD | cos ψ one lag later | cos φ one lag later |",
        "|---|---|---|---|---|---|",
        *(
            f"| {r.lag_ps:g} | {r.source} | {100 * r.valid:.2f} % | {r.jsd:.3f} "
            f"| {r.psi:.2f} ± {r.error(r.psi):.2f} | {r.phi:.2f} ± {r.error(r.phi):.2f} |"
            for r in rows
        ),
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse, train, measure, print the table and keep it in FOLDER."""
    from surrogate.data import collect_frames
    from surrogate.models.weights import load_weights

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--train", type=Path, nargs="+", required=True, help="references of one molecule")
    parser.add_argument("--test", type=Path, nargs="+", required=True, help="references that training does not see")
    parser.add_argument("--longest-lag-ps", type=float, default=1000.0)
    parser.add_argument("--budget", default="50min", help="wall time of the training")
    parser.add_argument("--starts", type=int, default=128, help="frames that each lag is started from")
    a = parser.parse_args(arguments)
    a.folder.mkdir(parents=True, exist_ok=True)
    out = a.folder / "lags.safetensors"
    train(a.train, out, longest_lag_ps=a.longest_lag_ps, budget_s=parse_wall_s(a.budget))
    weights, test = load_weights(out), collect_frames(list(a.test))
    rows = []
    for lag_ps in LAGS_PS:
        if weights.domain.lag_ps <= lag_ps <= weights.domain.longest_lag_ps:
            rows += measure(weights, test, lag_ps, a.starts)
            sys.stderr.write(f"{lag_ps} ps measured\n")
    record: dict[str, Any] = {"domain": weights.domain.describe(), "provenance": weights.provenance,
                              "rows": [asdict(row) for row in rows]}  # fmt: skip
    (a.folder / "lags.json").write_text(json.dumps(record, indent=1))
    (a.folder / "lags.md").write_text(table(rows) + "\n")
    sys.stdout.write(table(rows) + "\n")


if __name__ == "__main__":
    main()
