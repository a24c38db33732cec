"""PAINET's cost against atoms, and its error against EGNN's.

`python docs/studies/published/forecasters.py cost` or `... error TRAJECTORY...`.

`cost` times one chunk of branched chains of 10 to 10,000 atoms, factored and dense attention side by side, in
processor time of one thread, and prints the exponent of a power law fitted to all sizes and to the last decade.

`error` trains PAINET and EGNN (PAINET's decoder alone, wider, with at least as many parameters) on the same
trajectories with velocities, for the same number of steps or the same time, and prints the mean square error over all
predicted frames (A-MSE) on the last fifth of each trajectory, which neither has seen, beside the frozen frame's and
constant velocity's. `--modes` and `--free-rotation` (which EGNN gets as well) are what this project adds to the paper's
PAINET (`painet_modes`); `--attention none` leaves its attention out. `--frames 1 --stride 300` is state-to-state at
1.5 ps of 5 fs frames, `--frames 8 --stride 37` state-to-trajectory. With `-o FOLDER` finished trainings stay and
interrupted ones go on.

`python docs/studies/published/reproduce.py md17` leaves trajectories of the eight molecules that serve here.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from forecast_errors import Estimate, block_means, ratio
from integrator import cut
from painet_modes import ModalConfig, ModalEgnn, ModalPainet
from safetensors.torch import load_file

from surrogate.data import TrainingFrames, collect_frames
from surrogate.models.conformance import branched_chain, random_state
from surrogate.models.painet.model import Painet, PainetConfig, PainetTraining, StateWindows, for_frames, train_painet
from surrogate.models.weights import read_header
from systems.errors import InputError

SIZES = (10, 30, 100, 300, 1000, 3000, 10_000)
# Pairs of 3,000 atoms in four heads are a quarter of a gigabyte for each of the products.
LARGEST_DENSE = 1000
TEST_SHARE = 0.2


@dataclass(frozen=True)
class Cost:
    atoms: int
    linear_ms: float
    dense_ms: float | None


def measure_cost(n_atoms: int, config: PainetConfig, repeats: int) -> Cost:
    """Return the least processor time of a chunk, ms, over `repeats` calls."""
    molecule, (x, v) = branched_chain(n_atoms), random_state(n_atoms, 1, 1)

    def least_ms(attention: str) -> float:
        torch.manual_seed(0)
        model = Painet(replace(config, attention=attention)).eval()
        structure = model.structure(molecule)
        found = []
        with torch.inference_mode():
            for _ in range(repeats + 1):
                started = time.process_time()
                model(x[:, 0], v, structure)
                found.append(1e3 * (time.process_time() - started))
        return min(found[1:])

    return Cost(n_atoms, least_ms("linear"), least_ms("dense") if n_atoms <= LARGEST_DENSE else None)


def exponent(costs: list[Cost]) -> float:
    """Return the slope of log cost over log atoms."""
    slope, _ = np.polyfit(np.log([c.atoms for c in costs]), np.log([c.linear_ms for c in costs]), 1)
    return float(slope)


@dataclass(frozen=True)
class Errors:
    """A-MSE in Å^2 per coordinate on `windows` test windows; `spans` of them fit side by side, so many are
    independent at best. `ratio` is PAINET's over EGNN's with a 95 % interval over those."""

    scene: str
    windows: int
    spans: int
    frozen: float
    constant_velocity: float
    egnn: float
    painet: float
    ratio: Estimate
    egnn_parameters: int
    painet_parameters: int
    egnn_s: float
    painet_s: float


def matched_width(config: ModalConfig) -> int:
    """Return the width at which EGNN has at least PAINET's parameters, those of elements that do not occur aside."""
    target = _working_parameters(ModalPainet(config))
    width = config.width
    while _working_parameters(ModalEgnn(replace(config, width=width))) < target:
        width += 2
    return width


def _working_parameters(model: Painet) -> int:
    by_type = ("embed_type.weight", "e_phi", "e_psi")
    return sum(p.numel() for name, p in model.named_parameters() if not name.endswith(by_type))


def compare_errors(
    path: Path, config: ModalConfig, training: PainetTraining, folder: Path, windows_at_most: int = 500
) -> Errors:
    """Train both on the first four fifths of a trajectory and compare them on the last; what `folder` holds of them
    under the trajectory's name is gone on with."""
    whole = collect_frames([path], canonical=False, velocities=True)
    known, unseen = cut(whole, TEST_SHARE)
    wide = replace(config, width=matched_width(config))
    found, sizes, spent = {}, {}, {}
    for kind, settings in ((ModalPainet, config), (ModalEgnn, wide)):
        out = folder / f"{path.stem}.{kind.arch}.safetensors"
        if not out.exists() or any(folder.glob(f"{out.stem}.*.train.safetensors")):
            train_painet(known, out, settings, training, model_class=kind, resume=True)
        model, header = kind(for_frames(settings, known)), read_header(out)
        if model.config.to_dict() != header.config:
            raise InputError(f"{out} is of other settings; name another folder.")
        model.load_state_dict(load_file(out))
        spent[kind.arch] = float(header.provenance["training_s"])
        found[kind.arch] = window_errors(model.eval(), unseen, windows_at_most)
        sizes[kind.arch] = _working_parameters(model)
    windows = StateWindows(unseen, config, torch.device("cpu"))
    starts = thinned(windows.starts, windows_at_most)
    blocks = np.minimum(starts // windows.span, max(0, unseen.n_frames // windows.span - 1))
    (x, v), (reference, _) = windows.state(starts), windows.future(starts)
    times = whole.lag_ps * config.frame_stride * torch.arange(1, config.n_new + 1)[None, :, None, None]
    guesses = (x[:, None], x[:, None] + times * v[:, None])
    frozen, moving = (100.0 * float((guess - reference).square().mean()) for guess in guesses)
    return Errors(
        scene=whole.scene.name,
        windows=len(starts),
        spans=unseen.n_frames // windows.span,
        frozen=frozen,
        constant_velocity=moving,
        egnn=float(found["egnn"].mean()),
        painet=float(found["painet"].mean()),
        ratio=ratio(block_means(found["painet"], blocks), block_means(found["egnn"], blocks)),
        egnn_parameters=sizes["egnn"],
        painet_parameters=sizes["painet"],
        egnn_s=spent["egnn"],
        painet_s=spent["painet"],
    )


def thinned(starts: npt.NDArray[np.int64], at_most: int) -> npt.NDArray[np.int64]:
    """Return `at_most` evenly spaced ones of `starts`."""
    return starts[np.linspace(0, len(starts) - 1, min(at_most, len(starts))).astype(np.int64)]


@torch.inference_mode()
def window_errors(
    model: Painet, frames: TrainingFrames, at_most: int = 500, block: int = 256
) -> npt.NDArray[np.float64]:
    """Return the mean square error over all predicted frames of evenly spaced windows, Å^2 per coordinate, `(n,)`."""
    windows = StateWindows(frames, model.config, torch.device("cpu"))
    structure = model.structure(model.featurise(frames.scene))
    starts = thinned(windows.starts, at_most)
    found = []
    for begin in range(0, len(starts), block):
        first = starts[begin : begin + block]
        predicted, _ = model(*windows.state(first), structure)
        found.append(100.0 * (predicted - windows.future(first)[0]).square().mean((1, 2, 3)).double().numpy())
    return np.concatenate(found)


def run_cost(args: argparse.Namespace) -> list[Cost]:
    config = PainetConfig(n_new=args.frames)
    costs = []
    sys.stdout.write(f"{'atoms':>7}  {'factored':>12}  {'dense':>12}   ms of processor time a chunk of {args.frames}\n")
    for size in SIZES:
        cost = measure_cost(size, config, args.repeats)
        costs.append(cost)
        dense = "" if cost.dense_ms is None else f"{cost.dense_ms:12.2f}"
        sys.stdout.write(f"{size:7d}  {cost.linear_ms:12.2f}  {dense}\n")
    last = [c for c in costs if c.atoms >= SIZES[-1] / 10]
    sys.stdout.write(f"exponent: {exponent(costs):.3f} over all sizes, {exponent(last):.3f} over the last decade\n")
    return costs


def run_error(args: argparse.Namespace) -> list[Errors]:
    config = ModalConfig(n_new=args.frames, frame_stride=args.stride, width=args.width, attention=args.attention,
                         n_modes=args.modes, free_rotation=args.free_rotation)  # fmt: skip
    training = PainetTraining(steps=args.steps, budget_s=args.seconds, batch=args.batch, noise=0.0, pushforward=0.0,
                              velocity_weight=0.0, seed=args.seed, device=args.device)  # fmt: skip
    rows = []
    heads = f"{'frozen':>10}{'const. v':>10}{'EGNN':>10}{'PAINET':>10}   PAINET/EGNN"
    sys.stdout.write(f"{'molecule':16}{'windows':>8}{'spans':>6}{heads}\n")
    for path in args.trajectories:
        with tempfile.TemporaryDirectory() as temporary:
            folder = args.out or Path(temporary)
            folder.mkdir(parents=True, exist_ok=True)
            row = compare_errors(path, config, training, folder, args.windows)
        rows.append(row)
        sys.stdout.write(
            f"{row.scene:16}{row.windows:8d}{row.spans:6d}{row.frozen:10.3g}{row.constant_velocity:10.3g}"
            f"{row.egnn:10.3g}{row.painet:10.3g}   {row.ratio}\n"
        )
        sys.stdout.flush()
    if rows:
        mean = statistics.geometric_mean(r.painet / r.egnn for r in rows)
        better = sum(r.painet <= 0.95 * r.egnn for r in rows)
        sys.stdout.write(f"PAINET at least 5 % lower on {better} of {len(rows)}; mean ratio {mean:.3f}\n")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, default=None)
    verbs = parser.add_subparsers(required=True)
    cost = verbs.add_parser("cost")
    cost.add_argument("--frames", type=int, default=8)
    cost.add_argument("--repeats", type=int, default=5)
    cost.set_defaults(run=run_cost)
    error = verbs.add_parser("error")
    error.add_argument("trajectories", type=Path, nargs="+")
    error.add_argument("--frames", type=int, default=8)
    error.add_argument("--stride", type=int, default=4)
    error.add_argument("--width", type=int, default=32)
    error.add_argument("--attention", choices=("linear", "dense", "none"), default="linear")
    error.add_argument("--modes", type=int, default=0, help="of motion over the whole molecule; 0: the paper's PAINET")
    error.add_argument("--free-rotation", action="store_true", help="leave the rotation of the whole to a rigid body")
    error.add_argument("--steps", type=int, default=None)
    error.add_argument("--seconds", type=float, default=None)
    error.add_argument("--batch", type=int, default=16)
    error.add_argument("--windows", type=int, default=500, help="test windows of each trajectory")
    error.add_argument("--device", default="cpu", help="cpu or cuda")
    error.add_argument("-o", "--out", type=Path, default=None, help="folder of weights and training states")
    error.add_argument("--seed", type=int, default=0)
    error.set_defaults(run=run_error)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = args.run(args)
    if args.json is not None:
        args.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))


if __name__ == "__main__":
    main()
