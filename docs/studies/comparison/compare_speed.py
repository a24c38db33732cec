"""Time and memory of the comparison: `python docs/studies/comparison/compare_speed.py --frames 100000 [--profile]`.

Three trajectories of alanine dipeptide (reference, candidate, replicate) are made up: torsions hop between three states
and wiggle inside them, atoms shake by 2 pm, as many frames as asked for, one per ps. Then `surromd compare` runs on the
files in a process of its own, reading and report included, and its wall time, processor time and greatest memory are
printed; `--profile` says where the time goes. Other files than made-up ones: `--files REF TRAJ REPLICATE`; `--paths
TRAJ TOP` makes three of one trajectory of a large molecule, 200 frames along it with noise.
"""

from __future__ import annotations

import argparse
import json
import os
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from md_reference.run.machine import available_cores
from systems.scene import Scene

FloatArray = npt.NDArray[np.float64]

SCENE = "alanine-dipeptide"
# beta, alpha, left-handed; rows sum to one, the slowest exchange takes some hundred frames.
TRANSITIONS = np.array([[0.988, 0.010, 0.002], [0.010, 0.988, 0.002], [0.010, 0.010, 0.980]])
CENTRES_RAD = np.radians([[-75.0, 150.0], [-70.0, -20.0], [60.0, 40.0]])
SHAKE_NM = 0.002
PATH_FRAMES = 200
# Processor time: on a busy machine wall time says little about where it goes.
_PROFILED = """
import atexit, cProfile, sys, time
profile = cProfile.Profile(time.process_time)
atexit.register(profile.dump_stats, sys.argv.pop(1))
profile.enable()
from surrogate.cli.main import main
main()
"""
_BLOCK_FRAMES = 20_000
_LISTED = 25


@dataclass(frozen=True)
class Timing:
    """What one run of `surromd compare` took: seconds of wall and processor time, greatest resident memory in GB."""

    frames: int
    atoms: int
    wall_s: float
    cpu_s: float
    memory_gb: float
    cores: int


def torsion_path(n_frames: int, rng: np.random.Generator) -> FloatArray:
    """Return φ and ψ in rad, `(n_frames, 2)`, of the three-state chain with correlated wiggling inside the states."""
    from scipy.signal import lfilter

    states = np.empty(n_frames, dtype=np.int64)
    at, state = 0, 0
    while at < n_frames:
        stay = int(rng.geometric(1.0 - TRANSITIONS[state, state]))
        states[at : at + stay] = state
        at += stay
        leave = TRANSITIONS[state].copy()
        leave[state] = 0.0
        state = int(rng.choice(3, p=leave / leave.sum()))
    wiggle = lfilter([0.2], [1.0, -0.6], rng.standard_normal((n_frames, 2)), axis=0)
    return np.asarray(CENTRES_RAD[states] + wiggle, dtype=np.float64)


def pose(scene: Scene, torsions_rad: FloatArray, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Return frames `(n, n_atoms, 3)` nm of `scene` with its first φ and ψ as given `(n, 2)`, shaken by 2 pm."""
    from networkx import node_connected_component
    from scipy.spatial.transform import Rotation

    from systems.chemistry.geometry import torsion
    from systems.chemistry.graph import backbone_torsions, bonded_graph

    quads, graph = backbone_torsions(scene), bonded_graph(scene).copy()
    frames = np.repeat(np.asarray(scene.positions_nm, dtype=np.float64)[None], len(torsions_rad), axis=0)
    for column, name in enumerate(("phi", "psi")):
        quad = np.asarray(quads[name][0])
        start, end = int(quad[1]), int(quad[2])
        graph.remove_edge(start, end)
        beyond = sorted(node_connected_component(graph, end))
        graph.add_edge(start, end)
        turn = torsions_rad[:, column] - float(torsion(np.asarray(scene.positions_nm)[None], quad[None])[0, 0])
        axis = frames[:, end] - frames[:, start]
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        matrices = Rotation.from_rotvec(axis * turn[:, None]).as_matrix()
        arms = frames[:, beyond] - frames[:, end : end + 1]
        frames[:, beyond] = np.einsum("fij,faj->fai", matrices, arms) + frames[:, end : end + 1]
    return (frames + SHAKE_NM * rng.standard_normal(frames.shape)).astype(np.float32)


def write_trajectory(path: Path, n_frames: int, seed: int) -> Path:
    """Write a made-up trajectory of `n_frames` at 1 ps, and return its path."""
    from systems.library.named_scenes import load
    from systems.trajectory.codec import open_writer

    scene, rng = load(SCENE), np.random.default_rng(seed)
    path_rad = torsion_path(n_frames, rng)
    with open_writer(path, scene, {"temperature_k": 300.0, "cost": {"wall_s": 100.0}}, overwrite=True) as writer:
        for start in range(0, n_frames, _BLOCK_FRAMES):
            part = path_rad[start : start + _BLOCK_FRAMES]
            writer.append(pose(scene, part, rng), np.arange(start, start + len(part)) + 1.0)
    return path


def noisy_path(frames: npt.NDArray[np.float32], seed: int, n_frames: int = PATH_FRAMES) -> npt.NDArray[np.float32]:
    """Return `n_frames` along `frames` `(n, n_atoms, 3)` nm, a frame more or less, every atom shaken by 4 pm."""
    rng, last = np.random.default_rng(seed), len(frames) - 1
    at = np.clip(np.linspace(0, last, n_frames) + rng.normal(0, 1, n_frames), 0, last).round().astype(int)
    return (frames[at] + rng.normal(0, 2 * SHAKE_NM, (n_frames, *frames.shape[1:]))).astype(np.float32)


def write_paths(trajectory: Path, top: Path, folder: Path) -> list[Path]:
    """Write three noisy paths along a trajectory, frames called 1 ps, and return their files."""
    from systems.trajectory.codec import open_trajectory, open_writer

    with open_trajectory(trajectory, top=top) as reader:
        scene, frames = reader.scene, reader.read()
    assert scene is not None
    paths = []
    for seed in range(3):
        paths.append(folder / f"path_{seed}.h5")
        with open_writer(paths[-1], scene, {"temperature_k": 300.0}, overwrite=True) as writer:
            writer.append(noisy_path(frames, seed), np.arange(PATH_FRAMES) + 1.0)
    return paths


def time_compare(files: Sequence[Path], report: Path, profile: Path | None = None) -> Timing:
    """Run `surromd compare` on (reference, candidate, replicate) in a process of its own and measure it.

    With `profile` it runs under cProfile, which slows it down, and leaves the statistics there.
    Raises RuntimeError when the command fails.
    """
    from systems.trajectory.codec import open_trajectory

    with open_trajectory(files[0]) as reader:
        n_frames, n_atoms = reader.n_frames, reader.n_atoms
    reference, candidate, replicate = (str(f) for f in files)
    start = ["-m", "surrogate.cli.main"] if profile is None else ["-c", _PROFILED, str(profile)]
    command = [sys.executable, *start, "compare", reference, candidate]
    command += ["--replicate", replicate, "-o", str(report), "--overwrite", "--quiet"]
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    wall_s = time.perf_counter() - started
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}.")
    kilobytes = usage.ru_maxrss / (1024 if sys.platform == "darwin" else 1)
    return Timing(n_frames, n_atoms, wall_s, usage.ru_utime + usage.ru_stime, kilobytes * 1024 / 1e9, available_cores())


def profile_lines(profile: Path, n: int = _LISTED) -> list[str]:
    """Return the functions of this project in which most time is spent, callees included, as lines of text."""
    stats = pstats.Stats(str(profile)).stats  # type: ignore[attr-defined]
    ours = []
    for (file, _, function), (_, calls, own, cumulative, _) in stats.items():
        parts = Path(file).parts
        room = next((i for i, part in enumerate(parts) if part in ("surrogate", "systems")), None)
        if room is not None and not function.startswith("<"):
            ours.append((cumulative, own, calls, f"{'/'.join(parts[room:])}:{function}"))
    ours.sort(reverse=True)
    return [
        f"{cumulative:9.2f} s {own:8.2f} s own {calls:8d} calls  {name}" for cumulative, own, calls, name in ours[:n]
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--files", type=Path, nargs=3, metavar=("REF", "TRAJ", "REPLICATE"), default=None)
    parser.add_argument("--paths", type=Path, nargs=2, metavar=("TRAJ", "TOP"), default=None)
    parser.add_argument("--profile", action="store_true", help="run once more under cProfile and say where time goes")
    parser.add_argument("--report", type=Path, default=None, help="keep the report here (.html)")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        names = ("reference.h5", "candidate.h5", "replicate.h5")
        if args.paths is not None:
            args.files = write_paths(*args.paths, Path(folder))
        files = args.files or [write_trajectory(Path(folder) / x, args.frames, k) for k, x in enumerate(names)]
        report = args.report or Path(folder) / "report.html"
        timing = time_compare(files, report)
        sys.stdout.write(
            f"{timing.frames} frames x {timing.atoms} atoms: {timing.wall_s:.1f} s wall, {timing.cpu_s:.1f} s "
            f"processor, {timing.memory_gb:.2f} GB at most, {timing.cores} cores\n"
        )
        if args.profile:
            profile = Path(folder) / "profile"
            time_compare(files, report, profile)
            sys.stdout.write("\n".join(profile_lines(profile)) + "\n")
    if args.json is not None:
        args.json.write_text(json.dumps(asdict(timing), indent=1))


if __name__ == "__main__":
    main()
