"""Mutated trajectories, weights and checkpoints: what was written, or one line of refusal; no traceback, no hang."""

from __future__ import annotations

import json
import random
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.chunks import Tally
from surrogate.sampling.runner import Progress, packed_progress, progress_of
from systems.errors import SurromdError
from systems.scene import Scene
from systems.trajectory.checkpoint import new_header, read_checkpoint, write_checkpoint
from systems.trajectory.codec import open_trajectory, open_writer
from time_limits import time_limit

SECONDS_A_FILE = 20
N_FRAMES = 40
SETTINGS = {"seed": 3, "guard": "repair", "weights_hash": "0123456789abcdef"}
Mutation = Callable[[bytearray, random.Random], None]


def _place(data: bytearray, rng: random.Random) -> int:
    """Anywhere, or, as likely, at a byte that is not zero: files hold much space that nothing reads."""
    for _ in range(50 if rng.random() < 0.5 else 0):
        place = rng.randrange(len(data))
        if data[place]:
            return place
    return rng.randrange(len(data))


def flip_bits(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        data[_place(data, rng)] ^= 1 << rng.randrange(8)


def random_bytes(data: bytearray, rng: random.Random) -> None:
    at, n = _place(data, rng), rng.choice((1, 4, 64, 512))
    data[at : at + n] = bytes(rng.randrange(256) for _ in range(len(data[at : at + n])))


def zero_block(data: bytearray, rng: random.Random) -> None:
    at, n = _place(data, rng), rng.choice((8, 64, 512, 4096))
    data[at : at + n] = bytes(len(data[at : at + n]))


def exchange_blocks(data: bytearray, rng: random.Random) -> None:
    n = min(rng.choice((4, 8, 264, 512)), len(data) // 2)
    a, b = sorted((_place(data, rng), _place(data, rng)))
    if b - a >= n and b + n <= len(data):
        data[a : a + n], data[b : b + n] = data[b : b + n], data[a : a + n]


def cut_end(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data)) :]


def cut_piece(data: bytearray, rng: random.Random) -> None:
    at = _place(data, rng)
    del data[at : at + rng.choice((1, 4, 100))]


def insert(data: bytearray, rng: random.Random) -> None:
    at = _place(data, rng)
    data[at:at] = bytes(rng.randrange(256) for _ in range(rng.choice((1, 8, 300))))


def grow(data: bytearray, rng: random.Random) -> None:
    data += bytes(rng.randrange(256) for _ in range(rng.choice((1, 288, 5000))))


MUTATIONS: tuple[Mutation, ...] = (flip_bits, flip_bits, flip_bits, random_bytes, zero_block, exchange_blocks, cut_end,
                                   cut_piece, insert, grow)  # fmt: skip


def mutated(data: bytes, seed: int) -> tuple[str, bytes]:
    """Return what was done and the mutated bytes."""
    rng = random.Random(seed)
    out, done = bytearray(data), []
    for mutation in rng.choices(MUTATIONS, k=rng.choice((1, 1, 1, 3))):
        if out:
            mutation(out, rng)
            done.append(mutation.__name__)
    return "+".join(done), bytes(out)


# ---- the files: how each is made, and read whole ---------------------------------------------------------------------


def make_trajectory(path: Path, scene: Scene) -> None:
    rng = np.random.default_rng(0)
    with open_writer(path, scene, {"kind": "rollout", "seed": 7, "completed": False}) as writer:
        for k in range(0, N_FRAMES, 8):
            frames = scene.positions_nm + rng.normal(scale=0.01, size=(8, scene.n_atoms, 3))
            writer.append(frames, np.arange(k + 1, k + 9), flags=rng.integers(0, 3, 8), chunk_idx=k // 8,
                          scalars={"intervention": rng.integers(0, 3, 8)})  # fmt: skip
        writer.update_record({"completed": True})


def read_trajectory(path: Path) -> dict[str, Any]:
    with open_trajectory(path) as reader:
        return {
            "frames": reader.read().tobytes(),
            "time_ps": reader.time_ps.tobytes(),
            "flags": b"" if reader.flags is None else reader.flags.tobytes(),
            "chunk_idx": b"" if reader.chunk_idx is None else reader.chunk_idx.tobytes(),
            "scalars": {name: values.tobytes() for name, values in reader.scalars.items()},
            "scene": reader.scene and json.dumps(reader.scene.to_dict()),
            "record": reader.record,
        }


def make_checkpoint(path: Path) -> None:
    rng = np.random.default_rng(1)
    tally = Tally(chunks=9, chunks_caught=1, frames_caught=2, reasons={"clash": 2}, frames={"repaired": 2})
    last, velocities = (rng.normal(size=shape).astype(np.float32) for shape in ((2, 1, 22, 3), (2, 22, 3)))
    progress = Progress(last, velocities,
                        chunks=9, steps=63, wall_s=1.5, seconds={"draw": 1.0}, tallies=[tally, Tally()])  # fmt: skip
    plain, arrays = packed_progress(progress)
    write_checkpoint(path, new_header(0, overwrite=False) | {"settings": SETTINGS, "progress": plain}, arrays)


def read_progress(path: Path) -> dict[str, Any]:
    found = vars(progress_of(path, read_checkpoint(path), SETTINGS))
    return {key: value.tobytes() if isinstance(value, np.ndarray) else repr(value) for key, value in found.items()}


def read_weights(path: Path) -> dict[str, Any]:
    weights = load_weights(path)
    tensors = {name: tensor.numpy().tobytes() for name, tensor in weights.model.state_dict().items()}
    domain = {**vars(weights.domain), "scene": weights.domain.scene.to_dict()}
    return {"tensors": tensors, "config": weights.model.config.to_dict(), "domain": json.dumps(domain),
            "provenance": weights.provenance}  # fmt: skip


def prepare(kind: str, folder: Path, scene: Scene, small_weights: Weights) -> tuple[Path, Callable[[Path], Any]]:
    """Make the files of a kind in a folder; return the one to mutate and what reads them."""
    if kind in ("a.h5", "a.dcd"):
        make_trajectory(folder / kind, scene)
        return folder / kind, read_trajectory
    if kind in ("a.meta.h5", "a.pdb"):
        make_trajectory(folder / "a.dcd", scene)
        return folder / kind, lambda path: read_trajectory(path.parent / "a.dcd")
    if kind == "rollout checkpoint":
        make_checkpoint(folder / "a.h5.checkpoint")
        return folder / "a.h5.checkpoint", read_progress
    if kind == "reference checkpoint":
        write_checkpoint(folder / "b.h5.checkpoint", new_header(0, overwrite=False), b"state" * 300)
        return folder / "b.h5.checkpoint", read_checkpoint
    (folder / "w.safetensors").write_bytes(small_weights.path.read_bytes())
    return folder / "w.safetensors", read_weights


KINDS = ("a.h5", "a.dcd", "a.meta.h5", "a.pdb", "weights", "rollout checkpoint", "reference checkpoint")  # fmt: skip


def outcome(path: Path, read: Callable[[Path], Any], reference: Any) -> str:
    """Return 'same' or 'refused'; raise AssertionError for anything else."""
    try:
        with time_limit(SECONDS_A_FILE):
            found = read(path)
    except SurromdError as error:
        assert str(error).strip() and "\n" not in str(error), f"not one line: {error!r}"
        return "refused"
    if found == reference:
        return "same"
    changed = [key for key in reference if found[key] != reference[key]] if isinstance(reference, dict) else found
    raise AssertionError(f"read, but altered: {changed}")


def fuzz(kind: str, seeds: range, folder: Path, scene: Scene, weights: Weights) -> tuple[Counter[str], list[str]]:
    """Return how often each outcome came, and every fault with the seed that makes it again."""
    path, read = prepare(kind, folder, scene, weights)
    whole, reference = path.read_bytes(), read(path)
    counts: Counter[str] = Counter()
    faults = []
    for seed in seeds:
        what, data = mutated(whole, seed)
        path.write_bytes(data)
        try:
            counts[outcome(path, read, reference)] += 1
        except Exception as error:  # whatever else is raised is the finding
            counts["fault"] += 1
            faults.append(f"{kind}, seed {seed} ({what}): {type(error).__name__}: {error}")
    return counts, faults


def test_an_alteration_is_noticed(tmp_path: Path, alanine_dipeptide: Scene, small_weights: Weights) -> None:
    path, read = prepare("rollout checkpoint", tmp_path, alanine_dipeptide, small_weights)
    reference = read(path)
    assert outcome(path, read, reference) == "same"
    with pytest.raises(AssertionError, match="altered: \\['steps'\\]"):
        outcome(path, read, reference | {"steps": "64"})
    path.write_bytes(b"")
    assert outcome(path, read, reference) == "refused"


@pytest.mark.parametrize("kind", KINDS)
def test_mutated_files(kind: str, tmp_path: Path, alanine_dipeptide: Scene, small_weights: Weights) -> None:
    counts, faults = fuzz(kind, range(25), tmp_path, alanine_dipeptide, small_weights)
    assert not faults, "\n".join(faults)
    assert counts["refused"] > 3 or kind == "a.pdb", "mutations must not always be harmless"


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_thousand_mutated_files_of_each_kind(kind: str, tmp_path: Path, alanine_dipeptide: Scene,
                                               small_weights: Weights) -> None:  # fmt: skip
    counts, faults = fuzz(kind, range(1_000, 2_000), tmp_path, alanine_dipeptide, small_weights)
    assert not faults, f"{len(faults)} of {counts.total()}\n" + "\n".join(faults[:20])
