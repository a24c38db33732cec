"""Throughput of LaM-SLidE, trained and sampled in fp32 and bf16, and its share of the processor:
`python docs/studies/surrogates/throughput.py [--threads 2] [--weights NAME]`.

`peak` is the fastest product of two square matrices measured in the same run; the share is counted floating-point
operations of matrix products (torch's flop counter), over time, over that peak. Last it samples 30 frames (10 of them
given) x 32 latents x width 128 x 6 layers in 10 Euler steps (Table 11), by turns with the plain float32 program of
`bench.plain_network`, which computes the same function; ratios are the median, least and greatest over rounds.
Processor time of all threads over their number, so that a shared machine does not count twice.
"""

from __future__ import annotations

import argparse
import copy
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from plain_network import plain_network
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from surrogate.bench.timing import machine_facts
from surrogate.models.architecture import weights_path
from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.model import Approximator, ApproximatorConfig, LamSlide
from surrogate.models.lam_slide.trainer import draw_flow_times, flow_loss
from surrogate.models.propagator import Molecule, draw_noise
from surrogate.models.weights import load_weights
from surrogate.sampling.chunks import with_bf16_weights

PAPER = ApproximatorConfig(chunk_frames=30, n_conditioning=10, latents_per_token=1, width=128, n_layers=6, n_heads=4)
PAPER_LATENTS, PAPER_DIM, PAPER_STEPS = 32, 32, 10
Network = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Rate:
    """`seconds` a call, `per_second` units of `what`, `gflops` of matrix products, `share` of the measured peak."""

    what: str
    precision: str
    seconds: float
    per_second: float
    gflops: float
    share: float


def least_seconds(call: Callable[[], object], repeats: int) -> float:
    """Return the least processor time of a call per thread, after one to warm up."""
    call()
    found = []
    for _ in range(repeats):
        started = time.process_time()
        call()
        found.append((time.process_time() - started) / torch.get_num_threads())
    return min(found)


def matrix_peak(precision: str, repeats: int = 5) -> float:
    """Return the greatest GFLOP/s of products of square matrices of 512 to 2048 rows."""
    dtype = torch.bfloat16 if precision == "bf16" else torch.float32
    rates = []
    for n in (512, 1024, 2048):
        a, b = (torch.randn(n, n, dtype=dtype) for _ in range(2))
        rates.append(2e-9 * n**3 / least_seconds(lambda a=a, b=b: a @ b, repeats))  # type: ignore[misc]
    return max(rates)


def measure(what: str, precision: str, units: int, peak: float, call: Callable[[], object], repeats: int) -> Rate:
    with FlopCounterMode(display=False) as counter:
        call()
    seconds = least_seconds(call, repeats)
    gflops = 1e-9 * counter.get_total_flops() / seconds
    return Rate(what, precision, seconds, units / seconds, gflops, gflops / peak)


def filled(module: torch.nn.Module) -> torch.nn.Module:
    """Fill the layers that begin at zero, so that every path carries numbers."""
    with torch.no_grad():
        for p in module.parameters():
            if not p.abs().max() > 0:
                p.normal_(std=0.05)
    return module


def training_rate(model: LamSlide, n_atoms: int, precision: str, peak: float, batch: int, repeats: int) -> Rate:
    """Windows a second: loss, gradient and update of stage two, latents ready."""
    model = LamSlide(model.config)
    filled(model)
    model.autoencoder.requires_grad_(False)
    optimiser = torch.optim.AdamW(model.approximator.parameters(), lr=1e-4)
    latents = torch.randn(batch, *model.noise_shape(n_atoms))
    generator = torch.Generator().manual_seed(0)

    def step() -> None:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=precision == "bf16"):
            loss, _ = flow_loss(model, latents, n_atoms, draw_flow_times(model, batch, generator), generator)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()

    return measure("training, windows", precision, batch, peak, step, repeats)


def sampling_rate(model: LamSlide, molecule: Molecule, precision: str, peak: float, batch: int, repeats: int) -> Rate:
    """Frames a second of `next_chunk` at 20 solver steps, as a rollout calls it."""
    bf16 = precision == "bf16"
    model = with_bf16_weights(model) if bf16 else model
    noise = draw_noise(model, molecule.n_atoms, [torch.Generator().manual_seed(k) for k in range(batch)])
    frames = 0.1 * torch.randn(batch, model.n_conditioning, molecule.n_atoms, 3)

    def draw() -> None:
        with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16, enabled=bf16):
            model.next_chunk(frames, molecule, noise, solver_steps=20)

    return measure("sampling, frames", precision, batch * model.n_new, peak, draw, repeats)


def sampling_ratio(batch: int, rounds: int) -> dict[str, Any]:
    """Time 10 Euler steps of the paper's network by turns: the plain float32 program, ours in float32, in bf16, and in
    bf16 with conditioning frames computed once; `relative_error` is that of a single evaluation."""
    torch.manual_seed(0)
    exact = Approximator(PAPER, PAPER_LATENTS, PAPER_DIM).eval().requires_grad_(False)
    filled(exact)
    exact.float32_layers = ()  # type: ignore[assignment]
    rough = with_bf16_weights(exact)  # type: ignore[type-var]
    once = copy.deepcopy(rough)
    once.config = replace(PAPER, clean_conditioning=True)
    noise = torch.randn(batch, PAPER.chunk_frames, PAPER_LATENTS, PAPER_DIM)
    known = torch.randn_like(noise[:, : PAPER.n_conditioning])

    def with_memory(network: Any) -> Network:
        memory = once.remember(known)
        return lambda o, tau: network(o, tau, known, memory)

    ways: dict[str, tuple[bool, Callable[[], Network]]] = {
        "plain fp32": (False, lambda: lambda o, tau: plain_network(exact, o, tau, known)),
        "ours fp32": (False, lambda: lambda o, tau: exact(o, tau, known)),
        "ours bf16": (True, lambda: lambda o, tau: rough(o, tau, known)),
        "ours bf16, clean": (True, lambda: with_memory(once)),
    }

    def sample(name: str, n_steps: int = PAPER_STEPS) -> Tensor:
        bf16, network = ways[name]
        with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16, enabled=bf16):
            return flow.euler(network(), noise, n_steps)

    seconds = [{name: least_seconds(lambda n=name: sample(n), 1) for name in ways} for _ in range(rounds)]  # type: ignore[misc]
    reference = sample("plain fp32", 1)[:, PAPER.n_conditioning :]
    result: dict[str, Any] = {"batch": batch}
    for name in ways:
        ratios = sorted(s["plain fp32"] / s[name] for s in seconds)
        error = (sample(name, 1)[:, PAPER.n_conditioning :] - reference).square().mean().sqrt()
        result[name] = {
            "ms": 1e3 * statistics.median(s[name] for s in seconds),
            "ratio": [ratios[0], statistics.median(ratios), ratios[-1]],
            # Clean conditioning is another function of the same tensors: nothing to compare.
            "relative_error": None if "clean" in name else float(error / reference.square().mean().sqrt()),
        }
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="alanine-dipeptide", help="whose configuration is timed")
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--batch", type=int, default=64, help="of training; of sampling half of it")
    parser.add_argument("--repeats", type=int, default=5, help="of each training and sampling call; 0 leaves them out")
    parser.add_argument("--rounds", type=int, default=5, help="of the paper's network beside the plain program")
    parser.add_argument("--paper-batches", type=int, nargs="*", default=[1, 4])
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    if args.threads is not None:
        torch.set_num_threads(args.threads)
    weights = load_weights(weights_path(args.weights))
    assert isinstance(weights.model, LamSlide)
    molecule = weights.model.featurise(weights.domain.scene)
    facts = machine_facts()
    sys.stdout.write(f"{facts['about']}\n")
    peaks, rates = {}, []
    for precision in ("fp32", "bf16") if args.repeats else ():
        peaks[precision] = peak = matrix_peak(precision)
        sys.stdout.write(f"peak of matrix products, {precision}: {peak:.0f} GFLOP/s\n")
        rates.append(training_rate(weights.model, molecule.n_atoms, precision, peak, args.batch, args.repeats))
        rates.append(sampling_rate(weights.model, molecule, precision, peak, args.batch // 2, args.repeats))
        for r in rates[-2:]:
            sys.stdout.write(
                f"{r.what:18} {r.precision}: {r.per_second:9.1f} a second, {r.gflops:6.1f} GFLOP/s, "
                f"{100 * r.share:.1f} % of the peak\n"
            )
    sampled = [sampling_ratio(batch, args.rounds) for batch in args.paper_batches]
    for found in sampled:
        for name in [key for key in found if key != "batch"]:
            row = found[name]
            low, middle, high = row["ratio"]
            differs = "" if row["relative_error"] is None else f", differs by {row['relative_error']:.1e}"
            sys.stdout.write(
                f"30 frames, 10 steps, batch {found['batch']}: {name:26} {row['ms']:8.0f} ms, {middle:.2f} x as fast "
                f"[{low:.2f}, {high:.2f}]{differs}\n"
            )
    if args.json is not None:
        record = {"machine": facts, "threads": torch.get_num_threads(), "peak_gflops": peaks, "paper": sampled}
        args.json.write_text(json.dumps(record | {"rates": [asdict(r) for r in rates]}, indent=1))


if __name__ == "__main__":
    main()
