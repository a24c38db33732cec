"""The numerical-stability test of weights: long rollouts, odd inputs, other arithmetic, other settings, and OpenMM."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.bench import stress_trials
from surrogate.bench.stress_page import Frames, measure_drift, measure_validity, write_stress
from surrogate.bench.timing import machine_facts
from systems.chemistry.validity import INVALID, Geometry, check_frames
from systems.errors import InputError, SimulationError, StorageError, SurromdError, nearest
from systems.trajectory.codec import open_trajectory

if TYPE_CHECKING:
    from surrogate.bench.bench_options import StressOptions
    from surrogate.models.weights import Weights

SECTIONS = ("length", "invariance", "inputs", "precision", "batches", "solvers", "openmm")
_ENERGY_FRAMES = 100
ReportFn = Callable[[str], None]


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
    from surrogate.data.shipped import weights_path
    from surrogate.models.weights import load_weights
    from surrogate.sampling.domain import fit_weights

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
    from surrogate.sampling.openmm.coupling import Coupling

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


_RUN: dict[str, Callable[[Any, Path, StressConfig], list[dict[str, Any]]]] = {
    "length": _length,
    "invariance": lambda w, _, c: [
        row for kind in ("fp32", "bf16") for row in stress_trials.measure_invariance(w, precision=kind, seed=1)
    ],
    "inputs": lambda w, _, c: stress_trials.measure_odd_inputs(w, chunks=max(2, c.chunks // 2), seed=c.seed),
    "precision": lambda w, _, c: stress_trials.measure_precision(w, compiled=c.compiled, seed=c.seed),
    "batches": lambda w, _, c: stress_trials.measure_batches(
        w, seed=c.seed, batches=stress_trials.BATCHES if c.compiled else stress_trials.BATCHES[:2]
    ),
    "solvers": lambda w, _, c: stress_trials.measure_solvers(w, chunks=c.chunks, seed=c.seed),
    "openmm": lambda w, _, c: stress_trials.measure_openmm(w, n_frames=c.openmm_frames, seed=c.seed),
}
