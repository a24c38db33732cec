"""Frames a second of rollouts of peptides, and what makes them.

    python docs/studies/surrogates/state_draws.py [--sequence ACE-LEU-SER-NME] [--rounds 20]

Chunks of one replica on one thread at lags of 10 ps, 100 ps and 1 ns, in turn: as they are drawn, with states drawn by
torch instead of the program, and, as far as frames are drawn each on its own, one frame a chunk. The median of so many
rounds and, in brackets, how many times as many are drawn as usual.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from contextlib import nullcontext
from typing import Any, cast
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
import torch

from surrogate.bench.timing import machine_facts
from surrogate.models.architecture import weights_path
from surrogate.models.peptides import state_jumps
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.weights import load_weights
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.domain import fit_weights
from systems.prepare.peptide import build_peptide

LAGS_PS = 10.0, 100.0, 1000.0
USUAL, ALONE = "as they are drawn", "one frame a chunk"
WAYS: dict[str, Any] = {
    USUAL: nullcontext(),
    "states by torch": patch.object(state_jumps, "_program", lambda: None),
    ALONE: patch.object(PeptideSlide, "far_apart", lambda self, lag_ps: False),
}


def frames_per_s(sampler: ChunkSampler, last_nm: npt.NDArray[np.float64], seed: int) -> float:
    """Return the frames a second of one chunk."""
    began = time.perf_counter()
    sampler.draw(last_nm, [seed])
    return sampler.n_new / (time.perf_counter() - began)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequence", default="ACE-LEU-SER-NME")
    parser.add_argument("--rounds", type=int, default=20)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    weights, scene = load_weights(weights_path("peptides")), build_peptide(args.sequence)
    sys.stdout.write(f"{args.sequence}, {machine_facts()['about']}\n")
    for lag_ps in LAGS_PS:
        fitted, _ = fit_weights(scene, weights, lag_ps=lag_ps, force=True)
        far_apart = cast(PeptideSlide, fitted.model).far_apart(lag_ps)
        rates: dict[str, list[float]] = {way: [] for way in WAYS if far_apart or way != ALONE}
        for seed in range(1 + args.rounds):
            for way, found in rates.items():
                with WAYS[way]:
                    found.append(frames_per_s(ChunkSampler(fitted), scene.positions_nm[None, None], seed))
        median = {way: statistics.median(found[1:]) for way, found in rates.items()}
        told = [f"{way} {rate:.0f} frames/s ({median[USUAL] / rate:.2f})" for way, rate in median.items()]
        sys.stdout.write(f"{lag_ps:6g} ps: {'; '.join(told)}\n")


if __name__ == "__main__":
    main()
