"""Whether two versions of the program give the same numbers, bit for bit: frames of the shipped weights for a seed,
tensors of short trainings.

Run once with each version, of which the other's folder stands on PYTHONPATH, on one machine:

    PYTHONPATH=OTHER python docs/studies/surrogates/same_numbers.py frames -o before.json
    python docs/studies/surrogates/same_numbers.py frames -o after.json --against before.json

(`tensors` for trainings). Exit status 1 and the names of what differs, else nothing but the file.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from surrogate import api
from surrogate.models.architecture import shipped_weights
from surrogate.models.weights import load_weights
from systems.library import named_scenes
from systems.trajectory.codec import open_trajectory, open_writer

_FITTED = ("resampling", "normal-modes", "frozen")


def hashes_of_frames(folder: Path) -> dict[str, str]:
    """Return a hash of what each of the shipped weights rolls: two replicas of two chunks, seed 3, fp32 and, where that
    suits the model, bf16."""
    found = {}
    for name, path in shipped_weights().items():
        weights = load_weights(path)
        time_ps = 2 * weights.model.n_new * weights.domain.lag_ps
        scene = weights.domain.scene
        for precision in ("fp32",) if weights.model.float32_layers is None else ("fp32", "bf16"):
            outs = api.rollout(scene, name, folder / "r.h5", time_ps=time_ps, replicas=2, seed=3, guard="flag",
                               precision=precision, overwrite=True, quiet=True)  # fmt: skip
            digest = hashlib.sha256()
            for out in outs:
                with open_trajectory(out) as reader:
                    digest.update(np.ascontiguousarray(reader.read()).tobytes())
            found[f"{name} {weights.hash[:12]} {scene.name} {precision}"] = digest.hexdigest()[:16]
    return found


def hashes_of_tensors(folder: Path) -> dict[str, str]:
    """Return a hash of the tensors that trainings of a few steps write, on frames scattered about a scene."""
    from safetensors.numpy import load_file

    scene, rng = named_scenes.load("alanine-dipeptide"), np.random.default_rng(0)
    reference = folder / "reference.h5"
    with open_writer(reference, scene, {"temperature_k": 300.0}) as writer:
        frames = scene.positions_nm + 0.003 * rng.normal(size=(800, scene.n_atoms, 3))
        writer.append(frames, np.arange(1.0, 801.0))

    def trained(name: str, **options: object) -> str:
        out = api.train([reference], folder / f"{name}.safetensors", device="cpu", quiet=True, **options)
        digest = hashlib.sha256()
        for key, value in sorted(load_file(out).items()):
            digest.update(key.encode())
            digest.update(value.tobytes())
        return digest.hexdigest()[:16]

    found = {arch: trained(arch, arch=arch, seed=3) for arch in _FITTED}
    found["lam-slide"] = trained("lam-slide", arch="lam-slide", seed=3, steps=4)
    found["chosen"] = trained("chosen", steps=6)
    found["from"] = trained("from", steps=3, start_from=folder / "chosen.safetensors")
    return found


def main(argv: list[str] | None = None) -> int:
    """Write the hashes, and compare them with those of another version; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds: dict[str, Callable[[Path], dict[str, str]]] = {"frames": hashes_of_frames, "tensors": hashes_of_tensors}
    parser.add_argument("kind", choices=kinds)
    parser.add_argument("-o", "--out", type=Path, required=True, help="file to write, .json")
    parser.add_argument("--against", type=Path, help="what another version wrote")
    asked = parser.parse_args(argv)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        found = kinds[asked.kind](Path(folder))
    asked.out.write_text(json.dumps(found, indent=1))
    if asked.against is None:
        return 0
    before = json.loads(asked.against.read_text())
    differ = sorted(name for name in {*found, *before} if found.get(name) != before.get(name))
    sys.stdout.write("".join(f"{name}: {before.get(name)} -> {found.get(name)}\n" for name in differ))
    sys.stdout.write(f"{len(found) - sum(name in found for name in differ)} of {len(found)} the same\n")
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
