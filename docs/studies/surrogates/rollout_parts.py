"""What a frame of a rollout costs, part by part: `python docs/studies/surrogates/rollout_parts.py [--batch 1 32]`.

Processor milliseconds a frame on one thread, the least of some rounds: one evaluation of the network, then all that a
frame costs however many there are (`fixed`): encoder, decoder, canonical pose, noise, stiff terms, guards, the kinds of
windows and the writer. Chunks that are drawn again, which cost more of both, are left out; `whole chunk` holds them.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from surrogate.bench.timing import machine_facts
from surrogate.models.architecture import weights_path
from surrogate.models.lam_slide.model import LamSlide
from surrogate.models.propagator import draw_noise
from surrogate.models.weights import load_weights
from surrogate.sampling.chunks import ChunkSampler, Guard
from systems.chemistry.geometry import superposition
from systems.trajectory.codec import open_writer


def least_ms(call: Callable[[], object], rounds: int) -> float:
    """Return the least processor time of a call, in ms, after one to warm up."""
    found = []
    for _ in range(rounds + 1):
        started = time.process_time()
        call()
        found.append(1e3 * (time.process_time() - started))
    return min(found[1:])


def parts(name: str, batch: int, rounds: int, precision: str, folder: Path) -> dict[str, float]:
    """Return ms a frame of each part. Raises TypeError for weights of another model than LaM-SLidE."""
    weights = load_weights(weights_path(name))
    sampler, guard, scene = ChunkSampler(weights, precision=precision), Guard(weights.domain), weights.domain.scene
    model = sampler._model
    if not isinstance(model, LamSlide):
        raise TypeError(f"{name} are weights of {weights.model.arch}; parts are known of lam-slide.")
    seeds = list(range(batch))
    last = scene.positions_nm[None, None].repeat(batch, axis=0)
    drawn = sampler.draw(last, seeds).frames_nm
    posed = torch.from_numpy(last.astype(np.float32))
    noise = draw_noise(model, scene.n_atoms, [torch.Generator().manual_seed(seed) for seed in seeds])
    elements = sampler._molecule.elements
    found: dict[str, float] = {}
    with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16, enabled=sampler.precision.bf16):
        known, tau = model.encode(posed, elements), torch.full((1,), 0.5)
        latents = model.approximator(noise, tau, known)[:, model.n_conditioning :]
        calls: dict[str, Callable[[], object]] = {
            "network, one evaluation": lambda: model.approximator(noise, tau, known),
            "encoder": lambda: model.encode(posed, elements),
            "decoder": lambda: model.decode(latents, scene.n_atoms),
            "canonical pose": lambda: superposition(last[:, -1], sampler._target, idx=sampler._fit),
            "noise": lambda: draw_noise(model, scene.n_atoms, [torch.Generator().manual_seed(s) for s in seeds]),
            "guards": lambda: guard.check(drawn, last[:, -1]),
        }
        for what, call in calls.items():
            found[what] = least_ms(call, rounds)
    with open_writer(folder / "parts.h5", scene, {}) as writer:
        frames = drawn.reshape(-1, *drawn.shape[2:]).astype(np.float32)
        flags = np.zeros(len(frames), dtype=np.uint16)
        ahead = 1.0 + np.arange(len(frames))
        found["writer"] = least_ms(lambda: writer.append(frames, writer.n_frames + ahead, flags=flags), rounds)
    found["fixed"] = sum(found.values()) - found["network, one evaluation"]
    found["whole chunk, as a rollout draws it"] = least_ms(lambda: sampler.draw(last, seeds), rounds)
    return {what: ms / (batch * sampler.n_new) for what, ms in found.items()}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="alanine-dipeptide")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 32])
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--precision", default="auto")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    table = {}
    for n in args.batch:
        with tempfile.TemporaryDirectory() as folder:
            table[n] = parts(args.weights, n, args.rounds, args.precision, Path(folder))
    for n, found in table.items():
        sys.stdout.write(f"batch of {n}, ms a frame\n")
        sys.stdout.writelines(f"  {what:36} {ms:8.4f}\n" for what, ms in found.items())
    if args.json is not None:
        args.json.write_text(json.dumps({"machine": machine_facts(), "ms_per_frame": table}, indent=1))


if __name__ == "__main__":
    main()
