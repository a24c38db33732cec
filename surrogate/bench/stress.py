"""The numerical-stability test of weights: long rollouts; inputs that a rollout was not made for (moved, noisy,
strained, mirrored, permuted, with other atoms); other arithmetic and settings; and OpenMM, all by the same criteria."""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation

from surrogate.bench.stress_page import Frames, measure_bonds, measure_drift, measure_validity, write_stress
from surrogate.bench.timing import Roller, machine_facts, openmm_of
from surrogate.data import fitted_atoms
from surrogate.models.layers import with_compiled_parts
from surrogate.models.propagator import Propagator, draw_noise
from surrogate.sampling.chunks import ChunkSampler, noise_seed, with_bf16_weights
from surrogate.sampling.domain import find_deviations, fit_weights, match_domain
from systems.chemistry.validity import INVALID, Geometry, check_frames
from systems.errors import (
    InputError,
    OutOfDomainError,
    SimulationError,
    StorageError,
    SurromdError,
    first_line,
    nearest,
)
from systems.scene import FloatArray, Scene, part_of, reordered
from systems.trajectory.codec import open_trajectory

if TYPE_CHECKING:
    from surrogate.bench.bench_options import StressOptions
    from surrogate.models.weights import Weights

SECTIONS = ("length", "invariance", "inputs", "precision", "batches", "solvers", "openmm")
_ENERGY_FRAMES = 100
ReportFn = Callable[[str], None]
NOISE_NM = (0.001, 0.003, 0.01, 0.03, 0.1)
_ROWS = 8
SOLVER_STEPS = (2, 5, 10, 20, 40)
BATCHES = (1, 8, 64, 512)
TIMESTEPS_PS = (0.001, 0.002, 0.004, 0.005)
# Before anything is counted OpenMM leaves the minimum that it starts from.
DISCARDED_PS = 10.0


@dataclass(frozen=True)
class StressConfig:
    """What to run. `frames`: lengths of the rollouts, in frames over all replicas; `guards`: under which of the guards
    of `surromd rollout`. `chunks` of the short runs, `openmm_frames` of MD at each time step."""

    frames: tuple[int, ...] = (10_000, 100_000)
    replicas: int = 16
    guards: tuple[str, ...] = ("flag", "repair")
    sections: tuple[str, ...] = SECTIONS
    chunks: int = 8
    openmm_frames: int = 200
    compiled: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        for name in self.sections:
            if name not in SECTIONS:
                raise InputError(
                    f"a stress test has no section {name!r}; known: {', '.join(SECTIONS)}."
                    f"{nearest(name, list(SECTIONS))}"
                )
        if not self.frames or min(self.frames) < 10 * self.replicas:
            raise InputError(f"rollouts need at least ten frames in each of {self.replicas} replicas.")


QUICK = StressConfig(frames=(1_000,), replicas=4, chunks=2, openmm_frames=20, compiled=False)


def choose_config(options: StressOptions) -> StressConfig:
    """Return the usual or the quick settings, with what is given in their place. Raises InputError."""
    usual = QUICK if options.quick else StressConfig()
    return replace(
        usual,
        frames=tuple(options.frames or usual.frames),
        replicas=options.replicas or usual.replicas,
        guards=tuple(options.guards or usual.guards),
        sections=tuple(options.sections or usual.sections),
        seed=options.seed,
    )


def stress_weights(
    weights: str | Path, folder: Path, config: StressConfig, *, scene: str | None = None,
    report: ReportFn = lambda name: None,
) -> dict[str, Any]:  # fmt: skip
    """Run a stress test of weights, by name or file, and write its tables into `folder`; return its rows.

    Weights of several peptides are tried on `scene` (`systems.library.named_scenes`), or the first that they were
    trained on. Raises SurromdError for weights that cannot be loaded or do not cover the scene and a folder that
    cannot be written; KeyboardInterrupt says what is kept.
    """
    from surrogate.models.architecture import weights_path
    from surrogate.models.weights import load_weights

    loaded = load_weights(weights_path(weights))
    if scene is not None:
        from systems.library.named_scenes import prepare

        loaded, _ = fit_weights(prepare(scene), loaded)
    elif loaded.domain.transferable:
        loaded, _ = fit_weights(loaded.domain.scene, loaded)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {folder} ({error.strerror}); name another with `out`.") from error
    try:
        return run_stress(loaded, folder, config, report=report)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{folder} keeps what was done; the same command goes on") from None


def run_stress(weights: Weights, folder: Path, config: StressConfig, *, report: ReportFn) -> dict[str, Any]:
    """Run the sections and return their rows, JSON-able; rollouts stay in `folder` and are resumed when run again.
    Weights are for one molecule (`sampling.domain.fit_weights`).

    Tables and JSON are written anew after each section, so that what is done survives an interruption; sections
    that an earlier run of the same weights left in `folder` stay where this one does not run them. `report` is
    called with each section as it begins. Raises SurromdError where a rollout cannot be written.
    """
    result: dict[str, Any] = {
        "weights": weights.path.name,
        "weights_hash": weights.hash,
        "model": weights.model.arch,
        "domain": weights.domain.describe(),
        "scene": weights.domain.scene.name,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine_facts(),
        "seed": config.seed,
    }
    sections = _earlier_sections(folder, weights)
    for name in (s for s in SECTIONS if s in config.sections):
        report(name)
        rows = _RUN[name](weights, folder, config)
        if name == "length":  # beside earlier ones of another guard or length
            done = {(row["guard"], row.get("asked")) for row in rows}
            rows += [row for row in sections.get(name, []) if (row["guard"], row.get("asked")) not in done]
            rows.sort(key=lambda row: (row["guard"], row.get("asked", 0)))
        sections[name] = rows
        result["sections"] = {s: sections[s] for s in SECTIONS if s in sections}
        write_stress(result, folder)
    return result


def _earlier_sections(folder: Path, weights: Weights) -> dict[str, list[dict[str, Any]]]:
    try:
        found = json.loads((folder / "stress.json").read_text(encoding="utf-8"))
        same = found["weights_hash"] == weights.hash and found["scene"] == weights.domain.scene.name
        return dict(found["sections"]) if same else {}
    except (OSError, ValueError, LookupError, TypeError):
        return {}


def _length(weights: Weights, folder: Path, config: StressConfig) -> list[dict[str, Any]]:
    return [
        _one_length(weights, folder, config, n_frames, guard) for guard in config.guards for n_frames in config.frames
    ]


def _one_length(weights: Weights, folder: Path, config: StressConfig, n_frames: int, guard: str) -> dict[str, Any]:
    from surrogate.sampling.config import RolloutConfig
    from surrogate.sampling.runner import rollout

    scene, lag_ps = weights.domain.scene, weights.domain.lag_ps
    each = -(-n_frames // config.replicas)
    outs = [folder / f"{guard}_{n_frames}_r{k}.h5" for k in range(config.replicas)]
    row: dict[str, Any] = {"guard": guard, "asked": n_frames, "replicas": config.replicas}
    try:
        rollout(scene, weights, outs, RolloutConfig(time_ps=each * lag_ps, seed=config.seed, guard=guard), resume=True)
    except SimulationError as error:  # stopped by the guards: what came before is evaluated
        row["outcome"] = str(error)
        if not all(path.exists() for path in outs):
            return row
    except SurromdError as error:
        return row | {"outcome": str(error)}
    geometry = Geometry.from_dict(weights.domain.geometry)
    replicas: list[Frames] = []
    unmarked = chunks = caught = 0
    seconds: dict[str, float] = {}
    for path in outs:
        with open_trajectory(path) as reader:
            replicas.append(reader.read())
            flags = np.zeros(reader.n_frames, np.uint16) if reader.flags is None else reader.flags.astype(np.uint16)
            summary, row["wall_s"] = reader.record["interventions"], reader.record.get("cost", {}).get("batch_wall_s")
        bad = (check_frames(replicas[-1], geometry) & np.uint16(INVALID)) != 0
        unmarked += int(np.count_nonzero(bad & ((flags & np.uint16(INVALID)) == 0)))
        chunks, caught = chunks + summary["chunks"], caught + summary["chunks_caught"]
        seconds = dict(summary["seconds"])
    if min(map(len, replicas)) == 0:
        return row
    draw_s, check_s = max(seconds.pop("draw", 0.0), 1e-9), seconds.pop("check", 0.0)
    row |= measure_validity(replicas, geometry, lag_ps).to_dict()
    row |= {
        "invalid_unmarked": unmarked,
        "chunks_helped_%": 100.0 * caught / max(chunks, 1),
        "checks_%": 100.0 * check_s / draw_s,
        "help_%": 100.0 * sum(seconds.values()) / draw_s,
    }
    return row | {"drift": measure_drift(replicas, scene, geometry) | _energy_drift(weights, replicas)}


def _energy_drift(weights: Weights, replicas: list[Frames]) -> dict[str, Any]:
    """Mean energies of relaxed frames in kJ/mol, first and last tenth, with standard errors; empty without OpenMM."""
    from surrogate.sampling.coupling import Coupling

    try:
        coupling = Coupling(weights)
    except InputError as error:
        return {"energy": f"not computed: {error}"}
    tenth = max(1, min(map(len, replicas)) // 10)
    out: dict[str, Any] = {}
    try:
        for key, part in (("first", slice(tenth)), ("last", slice(-tenth, None))):
            pool = np.concatenate([r[part] for r in replicas])
            energies = []
            for frame in pool[:: max(1, len(pool) // _ENERGY_FRAMES)]:
                try:
                    energies.append(coupling.relax(frame).potential_kj_mol)
                except SurromdError:  # beyond repair; the validity rows count it
                    continue
            if energies:
                out[f"energy_{key}_kj_mol"] = float(np.mean(energies))
                out[f"energy_{key}_error_kj_mol"] = float(np.std(energies) / np.sqrt(len(energies)))
    finally:
        coupling.close()
    return out


# ---- odd inputs -----------------------------------------------------------------------------------------------------


def first_chunk(
    scene: Scene, weights: Weights, sampler: ChunkSampler, *, force: bool = False, rows: int = 1, chunks: int = 1
) -> FloatArray:
    """Return the first chunks `(rows, frames, n_atoms, 3)` nm after a scene, in its atom order."""
    order = match_domain(scene, weights, force=force).order
    roller = Roller(weights, sampler, rows=rows, seed=0, start_nm=scene.positions_nm[order])
    return roller.advance(chunks * sampler.n_new)[:, :, np.argsort(order)]


def measure_invariance(weights: Weights, *, precision: str, seed: int = 0) -> list[dict[str, Any]]:
    """Return how far the first chunk is from that of the unmoved scene, moved alike, in nm (greatest coordinate)."""
    scene = weights.domain.scene
    sampler = ChunkSampler(weights, precision=precision)
    plain = first_chunk(scene, weights, sampler)
    size = float(np.abs(plain - plain.mean(axis=2, keepdims=True)).max())
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_quat(np.roll(rng.normal(size=4), -1)).as_matrix()
    direction = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    moves = {f"translated by {far:g} nm": (np.eye(3), far * direction) for far in (1.0, 10.0, 1e6)}
    found: dict[str, float] = {}
    for name, (turn, shift) in {"rotated": (rotation, np.zeros(3)), **moves}.items():
        chunk = first_chunk(scene.with_positions(scene.positions_nm @ turn.T + shift), weights, sampler)
        found[name] = float(np.abs(chunk - (plain @ turn.T + shift)).max())
    order = np.random.default_rng(seed).permutation(scene.n_atoms)
    permuted = first_chunk(reordered(scene, order), weights, sampler)
    found["atoms permuted"] = float(np.abs(permuted - plain[:, :, order]).max())
    return [
        {"input": name, "precision": precision, "deviation_nm": error, "of_size": error / size}
        for name, error in found.items()
    ]


def odd_scenes(weights: Weights, seed: int) -> Iterator[tuple[str, Scene]]:
    """Yield scenes outside the training domain, by name."""
    scene = weights.domain.scene
    x = scene.positions_nm
    rng = np.random.default_rng(seed)
    for sigma in NOISE_NM:
        yield f"noise of {sigma:g} nm", scene.with_positions(x + rng.normal(scale=sigma, size=x.shape))
    yield "mirrored", scene.with_positions(x * np.array([1.0, 1.0, -1.0]))
    yield "strained: all bonds 10 % longer", scene.with_positions(x * 1.1)
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
            frames = first_chunk(scene, weights, sampler, force=True, rows=_ROWS, chunks=chunks)[:, :, order]
        except OutOfDomainError:
            row["forced"] = "refused too"
        except SurromdError as error:
            row["forced"] = str(error)
        else:
            row["forced"] = "run, marked" if deviations else ""
            for key, part in (("first_%", slice(sampler.n_new)), ("last_%", slice(-sampler.n_new, None))):
                found = measure_validity(list(frames[:, part]), geometry, 1.0)
                row[key] = 100.0 * (1.0 - found.broken / found.frames)
        rows.append(row)
    return rows


# ---- other arithmetic and settings ----------------------------------------------------------------------------------


def measure_precision(weights: Weights, *, compiled: bool, seed: int = 0) -> list[dict[str, Any]]:
    """Return of each arithmetic how far its first chunk is from float64's, from the training template, eight replicas.
    `deviation_nm` is the greatest coordinate, `rms_nm` the root mean square; validity is that of this one chunk."""
    inputs = _Inputs(weights, _ROWS, seed)
    geometry = Geometry.from_dict(weights.domain.geometry)
    rows: list[dict[str, Any]] = []
    with _in_double():
        reference = inputs.chunk(copy.deepcopy(weights.model).double(), torch.float64)
        rows.append({"arithmetic": "fp64", **_valid(reference, geometry)})

    def add(name: str, draw: Callable[[], Frames]) -> None:
        try:
            draw()  # what is compiled or cached at first
            started = time.process_time()
            frames = draw()
        except (RuntimeError, OSError, ImportError) as error:
            rows.append({"arithmetic": name, "outcome": f"not run: {first_line(error)[:120]}"})
            return
        speed = _frames_per_cpu_s(frames, started)
        gap = np.abs(frames - reference)
        row = {"deviation_nm": float(gap.max()), "rms_nm": float(np.sqrt(np.square(gap).mean()))}
        rows.append({"arithmetic": name, **row, **_valid(frames, geometry), **speed})

    model = weights.model
    add("fp32", lambda: inputs.chunk(model, torch.float32))
    half = with_bf16_weights(model)
    add("bf16", lambda: inputs.chunk(half, torch.float32, autocast=torch.bfloat16))
    if compiled:
        fast = with_compiled_parts(model)
        add("fp32, compiled", lambda: inputs.chunk(fast, torch.float32))
    return rows


def measure_batches(weights: Weights, *, seed: int = 0, batches: tuple[int, ...] = BATCHES) -> list[dict[str, Any]]:
    """Return of each batch size how far the first replica's chunk is from the same drawn alone, and the speed."""
    sampler = ChunkSampler(weights, precision="fp32")
    alone: Frames | None = None
    rows = []
    for size in batches:
        roller = Roller(weights, sampler, rows=size, seed=seed)
        started = time.process_time()
        frames = roller.advance(sampler.n_new)
        speed = _frames_per_cpu_s(frames, started)
        alone = frames[0] if alone is None else alone
        rows.append({"batch": size, "deviation_nm": float(np.abs(frames[0] - alone).max()), **speed})
    return rows


def measure_solvers(weights: Weights, *, chunks: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return validity and bonds from coarse to fine: at solver steps of each solver."""
    geometry = Geometry.from_dict(weights.domain.geometry)
    solvers: Sequence[str] = weights.model.solvers
    cases: list[tuple[str | None, int]]
    cases = [(solver, steps) for solver in solvers for steps in SOLVER_STEPS]
    rows = []
    for solver, steps in cases or [(None, 1)]:
        sampler = ChunkSampler(weights, solver=solver, solver_steps=steps)
        started = time.process_time()
        frames = Roller(weights, sampler, rows=_ROWS, seed=seed).advance(chunks * sampler.n_new)
        speed = _frames_per_cpu_s(frames, started)
        bonds = measure_bonds(frames.reshape(-1, *frames.shape[2:]), geometry)
        rows.append({"solver": solver or "none", "steps": steps, **_valid(frames, geometry), **bonds, **speed})
    return rows


def measure_openmm(weights: Weights, *, n_frames: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return the same criteria of OpenMM itself at 1, 2, 4 and 5 fs, under the conditions of training."""
    domain = weights.domain
    geometry, lag_ps = Geometry.from_dict(domain.geometry), domain.lag_ps
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
                steps = max(1, round(lag_ps / timestep_ps))
                for k in range(n_frames):
                    engine.step(steps)
                    state = engine.state()
                    frames[k] = state.positions_nm
                    energies[k], temperatures[k] = state.potential_kj_mol, state.temperature_k
            speed = _frames_per_cpu_s(frames[None], started)
        except KeyError as error:
            rows.append({**row, "outcome": f"not run: the weights do not say their {error}"})
            continue
        except SurromdError as error:
            rows.append({**row, "outcome": str(error)})
            continue
        half = n_frames // 2
        row |= _valid(frames[None], geometry) | measure_bonds(frames, geometry)
        row |= {"temperature_k": float(temperatures[half:].mean()), "potential_kj_mol": float(energies[half:].mean())}
        rows.append(row | speed)
    return rows


class _Inputs:
    """The template in its canonical pose and the noise of a few replicas: what `next_chunk` takes."""

    def __init__(self, weights: Weights, rows: int, seed: int) -> None:
        template = weights.domain.scene
        self._molecule = weights.model.featurise(template)
        fit = fitted_atoms(template)
        start = template.positions_nm - template.positions_nm[fit].mean(axis=0)
        model = weights.model
        self._last = torch.from_numpy(start).expand(rows, model.n_conditioning, -1, -1)
        generators = [torch.Generator().manual_seed(noise_seed(seed, row, 0)) for row in range(rows)]
        self._noise = draw_noise(model, template.n_atoms, generators)

    @torch.inference_mode()
    def chunk(self, model: Propagator, dtype: torch.dtype, *, autocast: torch.dtype | None = None) -> Frames:
        """Return frames `(rows, n_new, n_atoms, 3)` nm of a model that computes in `dtype`."""
        with torch.autocast("cpu", dtype=autocast or torch.bfloat16, enabled=autocast is not None):
            found = model.next_chunk(
                self._last.to(dtype).contiguous(), self._molecule, self._noise.to(dtype), solver_steps=20
            )
        frames: Frames = found.frames_nm.double().numpy()
        return frames


@contextmanager
def _in_double() -> Iterator[None]:
    """Let the places where networks ask for float32 (Fourier features, the last layer) compute in float64: the models
    have no such switch, because nobody rolls in float64."""
    single = torch.Tensor.float
    torch.Tensor.float = torch.Tensor.double  # type: ignore[method-assign]
    try:
        yield
    finally:
        torch.Tensor.float = single  # type: ignore[method-assign]


def _frames_per_cpu_s(frames: npt.NDArray[Any], started: float) -> dict[str, float]:
    spent = max(time.process_time() - started, 1e-9)
    return {"frames_per_cpu_s": frames.shape[0] * frames.shape[1] / spent}


def _valid(frames: Frames, geometry: Geometry) -> dict[str, float]:
    found = measure_validity(list(frames), geometry, 1.0).to_dict()
    return {key: found[key] for key in ("valid_half_angstrom_%", "valid_all_%")}


_RUN: dict[str, Callable[[Any, Path, StressConfig], list[dict[str, Any]]]] = {
    "length": _length,
    "invariance": lambda w, _, c: [
        row for kind in ("fp32", "bf16") for row in measure_invariance(w, precision=kind, seed=1)
    ],
    "inputs": lambda w, _, c: measure_odd_inputs(w, chunks=max(2, c.chunks // 2), seed=c.seed),
    "precision": lambda w, _, c: measure_precision(w, compiled=c.compiled, seed=c.seed),
    "batches": lambda w, _, c: measure_batches(w, seed=c.seed, batches=BATCHES if c.compiled else BATCHES[:2]),
    "solvers": lambda w, _, c: measure_solvers(w, chunks=c.chunks, seed=c.seed),
    "openmm": lambda w, _, c: measure_openmm(w, n_frames=c.openmm_frames, seed=c.seed),
}
