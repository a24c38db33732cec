"""The numerical-stability test of weights: long rollouts; inputs that a rollout was not made for (noisy, strained,
mirrored, with other atoms); and OpenMM, all by the same criteria."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.bench.timing import Roller, machine_facts, markdown_table, openmm_of
from surrogate.comparison.measure.distributions import distance
from surrogate.models.architecture import weights_path
from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.config import RolloutConfig
from surrogate.sampling.domain import find_deviations, fit_weights, match_domain
from surrogate.sampling.runner import rollout
from surrogate.verbs.options import StressOptions
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import rotatable_torsions
from systems.chemistry.validity import BOND_HALF_ANGSTROM, INVALID, NOT_FINITE, Geometry, check_frames
from systems.errors import InputError, OutOfDomainError, SimulationError, StorageError, SurromdError
from systems.files.whole_file import create_whole
from systems.library.named_scenes import prepare
from systems.scene import FloatArray, IntArray, Scene, part_of
from systems.trajectory.checkpoint import checkpoint_path
from systems.trajectory.codec import open_trajectory

Frames = npt.NDArray[np.floating[Any]]
ReportFn = Callable[[str], None]
# Sections of the test, and their titles.
TITLES = {
    "length": "Long rollouts",
    "inputs": "Inputs pushed out of the training domain",
    "openmm": "OpenMM itself, by the same criteria",
}
NOISE_NM = (0.001, 0.01, 0.1)
_ROWS = 8
TIMESTEPS_PS = (0.001, 0.002, 0.004, 0.005)
# Before anything is counted OpenMM leaves the minimum that it starts from.
DISCARDED_PS = 10.0
_TORSION_BINS = 36
# Bonds that the reference constrains do not vibrate and have no temperature.
_STIFF_NM = 5e-4


def stress(
    weights: str | Path | Weights, folder: Path, options: StressOptions, *, report: ReportFn = lambda name: None
) -> dict[str, Any]:
    """Run a stress test of weights and return the rows of its sections, JSON-able; rollouts stay in `folder` and are
    resumed when run again, stress.json and stress.md are written anew after each section.

    `weights`: a name, a file, or loaded ones; those of several peptides are tried on `options.scene`, or the first that
    they were trained on. `report` is called with each section as it begins. Raises SurromdError for weights that cannot
    be loaded or do not cover the scene, and what cannot be written; KeyboardInterrupt says what is kept.
    """
    loaded = load_weights(weights_path(weights)) if isinstance(weights, str | Path) else weights
    if options.scene is not None:
        loaded, _ = fit_weights(prepare(options.scene), loaded)
    elif loaded.domain.transferable:
        loaded, _ = fit_weights(loaded.domain.scene, loaded)
    is_quick, seed = options.quick, options.seed
    frames = options.frames or ((1_000,) if is_quick else (10_000, 100_000))
    replicas = options.replicas or (4 if is_quick else 16)
    if min(frames) < 10 * replicas:
        raise InputError(f"rollouts need at least ten frames in each of {replicas} replicas.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {folder} ({error.strerror}); name another with `out`.") from error
    run: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "length": lambda: [
            measure_length(loaded, folder, n, replicas=replicas, guard=guard, seed=seed)
            for guard in options.guards
            for n in frames
        ],
        "inputs": lambda: measure_odd_inputs(loaded, chunks=2 if is_quick else 4, seed=seed),
        "openmm": lambda: measure_openmm(loaded, n_frames=20 if is_quick else 200, seed=seed),
    }
    result: dict[str, Any] = {
        "weights": loaded.path.name,
        "weights_hash": loaded.hash,
        "model": loaded.model.arch,
        "domain": loaded.domain.describe(),
        "scene": loaded.domain.scene.name,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine_facts(),
        "seed": seed,
        "sections": {},
    }
    try:
        for name in (name for name in TITLES if name in options.sections):
            report(name)
            result["sections"][name] = run[name]()
            create_whole(folder / "stress.json", json.dumps(result, indent=1))
            create_whole(folder / "stress.md", markdown(result))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{folder} keeps what was done; the same command goes on") from None
    return result


def markdown(result: dict[str, Any]) -> str:
    """Return the tables."""
    head = [f"# Stress test of {result['weights']}", f"{result['domain']}; {result['model']}, {result['made']}"]
    lines = [head[0], "", head[1], "", result["machine"]["about"], ""]
    for name, rows in result["sections"].items():
        lines += [f"## {TITLES[name]}", "", *markdown_table(rows), ""]
    lines += [
        "valid_half_angstrom: finite, and each bond within 0.5 Å of the reference's mean (Fu et al., TMLR 2023); "
        "valid_all: every rule of systems.chemistry.validity. chunks helped: those in which the guard caught a frame "
        "(under flag, only marked). first, last: in these tenths of the rollouts; torsion distance between the two, "
        "and by chance. A surrogate has no velocities of its own: in place of a temperature stands the variance of "
        "bonds in per cent of the reference's.",
        "",
    ]
    return "\n".join(lines)


# ---- measures -------------------------------------------------------------------------------------------------------


def measure_validity(replicas: Sequence[Frames], geometry: Geometry) -> dict[str, float]:
    """Return the shares of replicas' frames, each `(n_frames, n_atoms, 3)` nm in the geometry's atom order, that obey
    the 0.5 Å rule and all rules, in per cent."""
    flags = np.concatenate([check_frames(frames, geometry) for frames in replicas])
    rules = {"valid_half_angstrom_%": NOT_FINITE | BOND_HALF_ANGSTROM, "valid_all_%": INVALID}
    return {name: 100.0 * float(((flags & mask) == 0).mean()) for name, mask in rules.items()}


def measure_bonds(frames: Frames, geometry: Geometry) -> dict[str, float]:
    """Return of frames `(n, n_atoms, 3)` nm: the root mean square of mean bond lengths from the reference's, in pm, and
    the share of the reference's variance that bonds which vibrate have, times 100 (100 % is the reference's
    temperature, by equipartition)."""
    pairs = geometry.bond_idx
    x = frames[np.isfinite(frames).all(axis=(1, 2))].astype(np.float64)
    if not len(x) or not len(pairs):
        return {}
    lengths = np.linalg.norm(x[:, pairs[:, 0]] - x[:, pairs[:, 1]], axis=2)
    out = {"bond_shift_pm": 1e3 * float(np.sqrt(np.square(lengths.mean(axis=0) - geometry.bond_mean_nm).mean()))}
    soft = geometry.bond_std_nm > _STIFF_NM
    if soft.any():
        out["bond_variance_%"] = 100.0 * float((lengths.var(axis=0)[soft] / geometry.bond_std_nm[soft] ** 2).mean())
    return out


def measure_drift(replicas: Sequence[Frames], scene: Scene, geometry: Geometry) -> dict[str, Any]:
    """Return what differs between the first and the last tenth of replicas `(n_frames, n_atoms, 3)` nm, template order:
    bonds, and the mean Jensen-Shannon distance (square root, natural logarithm) of the rotatable torsions' histograms
    of 10° bins, beside the same between two halves of the replicas over both tenths, which differ by chance alone."""
    tenth = max(1, min(map(len, replicas)) // 10)
    first, last = (np.concatenate([r[part] for r in replicas]) for part in (slice(tenth), slice(-tenth, None)))
    out: dict[str, Any] = {}
    for name, frames in (("first", first), ("last", last)):
        out |= {f"{name}_{key}": value for key, value in measure_bonds(frames, geometry).items()}
    quads = rotatable_torsions(scene, rotors=False)
    if len(quads):
        out["torsion_distance"] = _torsion_distance(first, last, quads)
    if len(quads) and len(replicas) > 1:
        ends = [np.concatenate([r[:tenth], r[-tenth:]]) for r in replicas]
        by_chance = _torsion_distance(np.concatenate(ends[::2]), np.concatenate(ends[1::2]), quads)
        out["torsion_distance_by_chance"] = by_chance
    return out


def _torsion_distance(one: Frames, other: Frames, quads: IntArray) -> float:
    edges = np.linspace(-np.pi, np.pi, _TORSION_BINS + 1)

    def histograms(frames: Frames) -> FloatArray:
        angles = torsion(frames[np.isfinite(frames).all(axis=(1, 2))], quads)
        return np.stack([np.histogram(each, bins=edges)[0].astype(np.float64) for each in angles.T])

    return float(np.mean(distance(histograms(one), histograms(other))))


# ---- sections -------------------------------------------------------------------------------------------------------


def measure_length(
    weights: Weights, folder: Path, n_frames: int, *, replicas: int, guard: str, seed: int = 0
) -> dict[str, Any]:
    """Return validity, drift and speed of a rollout of `n_frames` in all replicas together, under a guard; its files
    stay in `folder`."""
    scene, lag_ps = weights.domain.scene, weights.domain.lag_ps
    outs = [folder / f"{guard}_{n_frames}_r{k}.h5" for k in range(replicas)]
    row: dict[str, Any] = {"guard": guard, "replicas": replicas, "frames": n_frames}
    config = RolloutConfig(time_ps=-(-n_frames // replicas) * lag_ps, seed=seed, guard=guard)
    try:
        if _was_stopped(outs, weights, seed):
            row["outcome"] = "stopped by the guards when it was rolled before"
        else:
            rollout(scene, weights, outs, config, resume=True)
    except SimulationError as error:  # stopped by the guards: what came before is evaluated
        row["outcome"] = str(error)
        if not all(path.exists() for path in outs):
            return row
    except SurromdError as error:
        return row | {"outcome": str(error)}
    geometry = Geometry.from_dict(weights.domain.geometry)
    found: list[Frames] = []
    chunks = caught = 0
    for path in outs:
        with open_trajectory(path) as reader:
            found.append(reader.read())
            summary, row["wall_s"] = reader.record["interventions"], reader.record.get("cost", {}).get("batch_wall_s")
        chunks, caught = chunks + summary["chunks"], caught + summary["chunks_caught"]
    row |= {"frames": sum(map(len, found)), "chunks_helped_%": 100.0 * caught / max(chunks, 1)}
    if min(map(len, found)) == 0:
        return row
    return row | measure_validity(found, geometry) | measure_drift(found, scene, geometry)


def _was_stopped(outs: Sequence[Path], weights: Weights, seed: int) -> bool:
    """Whether these files are all there is of a rollout that ended before its time."""
    if checkpoint_path(outs[0]).exists() or not all(path.exists() for path in outs):
        return False
    with open_trajectory(outs[0]) as reader:
        record = reader.record
    return record.get("completed") is False and (record["weights_hash"], record["seed"]) == (weights.hash, seed)


def odd_scenes(weights: Weights, seed: int) -> Iterator[tuple[str, Scene]]:
    """Yield scenes outside the training domain, by name."""
    scene = weights.domain.scene
    x = scene.positions_nm
    rng = np.random.default_rng(seed)
    for sigma in NOISE_NM:
        yield f"noise of {sigma:g} nm", scene.with_positions(x + rng.normal(scale=sigma, size=x.shape))
    yield "mirrored", scene.with_positions(x * np.array([1.0, 1.0, -1.0]))
    yield "strained: all bonds 40 % longer", scene.with_positions(x * 1.4)
    far = np.linalg.norm(x[:, None] - x[None], axis=2)
    i, j = (int(k) for k in np.unravel_index(far.argmax(), far.shape))
    clashing = x.copy()
    clashing[i] = x[j] + [0.02, 0.0, 0.0]
    yield "clashing: two far atoms 0.02 nm apart", scene.with_positions(clashing)
    broken = x.copy()
    broken[0, 0] = np.nan
    yield "a coordinate that is no number", scene.with_positions(broken)
    if 0 < len(scene.heavy_idx) < scene.n_atoms:
        yield "heavy atoms only", part_of(scene, scene.heavy_idx)
        lost = next(k for k in range(scene.n_atoms) if scene.elements[k] == "H")
        rest = part_of(scene, np.array([k for k in range(scene.n_atoms) if k != lost]))
        charges = rest.formal_charges.copy()
        charges[0] -= 1
        yield "a proton less", replace(rest, formal_charges=charges)


def measure_odd_inputs(weights: Weights, *, chunks: int = 4, seed: int = 0) -> list[dict[str, Any]]:
    """Return of each odd input: refused or not and why, and what becomes of it when it is forced. `first_%` and
    `last_%`: frames that obey the 0.5 Å rule in the first and the last of `chunks`, over eight replicas."""
    sampler = ChunkSampler(weights)
    geometry = Geometry.from_dict(weights.domain.geometry)
    rows = []
    for name, scene in odd_scenes(weights, seed):
        deviations = find_deviations(scene, weights.domain, model=weights.model)
        row: dict[str, Any] = {"input": name, "outcome": "refused" if deviations else "run"}
        row["reasons"] = ", ".join(d.what for d in deviations)
        try:
            order = match_domain(scene, weights, force=True).order
            roller = Roller(weights, sampler, rows=_ROWS, seed=0, start_nm=scene.positions_nm[order])
            frames = roller.advance(chunks * sampler.n_new)
        except OutOfDomainError:
            row["forced"] = "refused too"
        except SurromdError as error:
            row["forced"] = str(error)
        else:
            row["forced"] = "run, marked" if deviations else ""
            for key, part in (("first_%", slice(sampler.n_new)), ("last_%", slice(-sampler.n_new, None))):
                row[key] = measure_validity(list(frames[:, part]), geometry)["valid_half_angstrom_%"]
        rows.append(row)
    return rows


def measure_openmm(weights: Weights, *, n_frames: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return the same criteria of OpenMM itself at 1, 2, 4 and 5 fs, under the conditions of training."""
    domain = weights.domain
    geometry = Geometry.from_dict(domain.geometry)
    rows: list[dict[str, Any]] = []
    for timestep_ps in TIMESTEPS_PS:
        row: dict[str, Any] = {"timestep_fs": 1e3 * timestep_ps}
        frames = np.empty((n_frames, domain.scene.n_atoms, 3))
        energies, temperatures = np.empty(n_frames), np.empty(n_frames)
        try:
            with openmm_of(domain, timestep_ps, seed) as engine:
                engine.step(round(DISCARDED_PS / timestep_ps))
                started = time.process_time()
                # Of a model with shorter frames than this step, every step is one.
                steps = max(1, round(domain.lag_ps / timestep_ps))
                for k in range(n_frames):
                    engine.step(steps)
                    state = engine.state()
                    frames[k] = state.positions_nm
                    energies[k], temperatures[k] = state.potential_kj_mol, state.temperature_k
            speed = {"frames_per_cpu_s": len(frames) / max(time.process_time() - started, 1e-9)}
        except SurromdError as error:
            rows.append({**row, "outcome": str(error)})
            continue
        half = n_frames // 2
        row |= measure_validity([frames], geometry) | measure_bonds(frames, geometry)
        row |= {"temperature_k": float(temperatures[half:].mean()), "potential_kj_mol": float(energies[half:].mean())}
        rows.append(row | speed)
    return rows
