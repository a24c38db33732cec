"""Rollouts of peptides with states drawn by the program and by torch.

    python docs/studies/surrogates/state_draws.py [--sequence ACE-LEU-SER-NME] [--rounds 20]

Chunks of one replica on one thread at lags of 10 ps, 100 ps and 1 ns, by either in turn: frames a second, the median of
`--rounds` chunks, and the ratio.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from unittest.mock import patch

import torch

from surrogate.bench.timing import machine_facts
from surrogate.models.architecture import weights_path
from surrogate.models.peptides import state_jumps
from surrogate.models.weights import load_weights
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.domain import fit_weights
from systems.prepare.peptide import build_peptide
from systems.scene import Scene

LAGS_PS = 10.0, 100.0, 1000.0


def frames_per_s(sampler: ChunkSampler, scene: Scene, by_torch: bool, seed: int) -> float:
    """Return the frames a second of one chunk."""
    last = scene.positions_nm[None, None]
    with patch.object(state_jumps, "_program", (lambda: None) if by_torch else state_jumps._program):
        began = time.perf_counter()
        sampler.draw(last, [seed])
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
        sampler = ChunkSampler(fit_weights(scene, weights, lag_ps=lag_ps, force=True)[0])
        rates: tuple[list[float], list[float]] = [], []
        for seed in range(1 + args.rounds):
            for found, by_torch in zip(rates, (False, True), strict=True):
                found.append(frames_per_s(sampler, scene, by_torch, seed))
        program, by_torch_alone = (statistics.median(found[1:]) for found in rates)
        ratio = program / by_torch_alone
        sys.stdout.write(f"{lag_ps:6g} ps  program {program:7.1f}  torch {by_torch_alone:7.1f}  ratio {ratio:5.2f}\n")


if __name__ == "__main__":
    main()
