"""Where replicas begin: each in a state of its own, so that together they do not remember one structure.

The first is the scene itself; the others were hot for a while and have cooled down, handedness, peptide and double
bonds kept. All is a function of scene, forces, number and seed: what resumes begins where it began.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import count, islice
from typing import Any

import numpy as np
import numpy.typing as npt

from md_reference.forces.forcefield import build_system
from md_reference.forces.mixture import dry_part, solute_of
from md_reference.forces.spec import QUANTUM, ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine, Relaxer
from md_reference.simd.force_field import SimdReplicas, n_replicas
from md_reference.simd.system_terms import SimdUnavailableError
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import rotatable_torsions
from systems.chemistry.validity import CHIRALITY, NOT_FINITE, OMEGA, RING, check_frames, geometry_from_scene
from systems.errors import PreparationError, SimulationError
from systems.interrupts import stop_if_asked
from systems.prepare.ring_conformers import conformer_of, ring_conformers
from systems.scene import FloatArray, IntArray, Scene

HOT_K, HOT_PS, FRICTION_PER_PS = 500.0, 100.0, 5.0
# Of the time it was hot.
_COOLING = 0.2
# By OpenMM, one after the other: so far apart, of that time.
_APART = 0.2
_TURNED_PS, _LEAST_TURNED, _STIFFNESS_KJ_MOL = 20.0, 0.2, 300.0
# Steps of minimisation before MD: to the very minimum a box of water takes several times as long, and MD then begins
# too cold.
_MINIMISED = 200
_PIECE = 500
# A scene for each replica, and how they were found, in a few words.
Starts = tuple[tuple[Scene, ...], str]
_KEPT = NOT_FINITE | CHIRALITY | OMEGA | RING


def many_starts(scene: Scene, conditions: Conditions, n: int, *, hot_ps: float = HOT_PS) -> Starts:
    """Return `n` starts of a scene in different states, drawn with the seed of `conditions`, and how they were found.

    They come from `hot_ps` at 500 K, of the structure given and of conformers whose rings pucker differently, and a
    fifth of that at the bath's temperature, by SIMD replicas where these run the scene, else by OpenMM; at quantum
    level by GAFF2. In explicit water the solute is turned to the torsions that its dry self then has, in 20 ps, or in
    as much less as `hot_ps` is less than 100, but in 4. Where nothing turns, or hot MD fails, all begin in the scene's
    own structure, and `how` says so.
    """

    def one(why: str) -> Starts:
        return (scene,) * n, f"all replicas start from the input structure: {why}"

    if n == 1 or scene.interactions is not None:
        return one("one replica" if n == 1 else "a model system")
    if scene.cell_nm is not None and not len(solute_of(scene)):
        return one("nothing but water and ions")
    dry = dry_part(scene)
    conformers = ring_conformers(dry)
    if len(conformers) == 1 and not len(rotatable_torsions(dry)):
        return one("it has no rotatable torsions")
    try:
        spec = _hot_forces(conditions.force)
        frames, by = _hot(dry, conformers, replace(conditions, force=spec, ensemble="nvt"), n, hot_ps)
        if scene.cell_nm is not None:
            frames = _in_water(scene, conditions, dry, frames, _turned_ps(hot_ps))
    except (PreparationError, SimulationError) as error:
        return one(str(error).rstrip("."))
    how = f"{n} starting structures: the input, and others from {hot_ps:.3g} ps at {HOT_K:g} K ({by})"
    if len(conformers) > 1:
        how += f" of {len(conformers)} ring conformers"
    return _scenes(scene, frames), how + (", cooled" if scene.cell_nm is None else ", their torsions set in water")


def frames_as_starts(
    scene: Scene, conditions: Conditions, frames_nm: Iterable[npt.NDArray[np.floating]], n: int, *,
    hot_ps: float = HOT_PS,
) -> Starts:  # fmt: skip
    """Return starts from frames, each `(n_atoms, 3)` nm: the first `n` that are the scene's molecule when they are
    relaxed near where they are; fewer where fewer are, each then taken several times. Raises SimulationError where none
    is. In explicit water frames are of the solute, which is turned to their torsions as by `many_starts`."""
    if scene.cell_nm is not None:
        dry, first = dry_part(scene), np.stack(list(islice(frames_nm, n))).astype(np.float64)
        if first.shape[1] != dry.n_atoms:
            raise SimulationError(f"frames of {first.shape[1]} atoms are not of its solute, which has {dry.n_atoms}")
        found_nm = _in_water(scene, conditions, dry, first, _turned_ps(hot_ps))
        scenes = _scenes(scene, found_nm[np.arange(n) % len(found_nm)])
        return scenes, f"{len(first)} starting structures: frames of the rollout, their torsions set in water"
    found: list[FloatArray] = []
    tried = 0
    geometry = geometry_from_scene(scene)
    system = build_system(scene, conditions.force)
    with Relaxer(scene, system, born=conditions.force.is_born) as relaxer:
        for tried, frame in enumerate(frames_nm, 1):  # noqa: B007
            stop_if_asked()
            try:
                relaxed = relaxer.relax(np.asarray(frame, dtype=np.float64))
            except SimulationError:
                continue
            if not check_frames(relaxed, geometry)[0] & _KEPT:
                found.append(relaxed)
            if len(found) == n:
                break
    if not found:
        raise SimulationError(f"none of {tried} frames of the rollout can be a start of MD")
    scenes = _scenes(scene, np.stack(found))
    how = f"starting structure{'s' * (len(found) > 1)}: frames of the rollout, relaxed"
    return tuple(scenes[k % len(scenes)] for k in range(n)), f"{len(found)} {how}"


def _scenes(scene: Scene, frames_nm: FloatArray) -> tuple[Scene, ...]:
    return tuple(replace(scene, positions_nm=frame) for frame in frames_nm)


def _hot_forces(force: ForceFieldSpec) -> ForceFieldSpec:
    """Return the forces of hot MD: the run's own without its water, GAFF2 at quantum level."""
    if force.force_field == QUANTUM:
        return ForceFieldSpec("gaff2", "vacuum", force.hydrogen_mass_da)
    if force.is_explicit:
        return replace(force, solvent="obc2" if force.force_field != "gaff2" else "vacuum")
    return force


def _hot(
    dry: Scene, conformers: FloatArray, conditions: Conditions, n: int, hot_ps: float
) -> tuple[FloatArray, str]:  # fmt: skip
    """Return frames `(n, n_atoms, 3)`, the first as given and minimised, the others from hot MD; and by what."""
    system = build_system(dry, conditions.force)
    on_cpu = replace(conditions, platform="Reference" if dry.n_atoms < 300 else "CPU")
    with Engine(dry, on_cpu, threads=1, system=system) as engine:
        bases = []
        for conformer in conformers:
            engine.set_positions(conformer)
            engine.minimise()
            bases.append(engine.positions())
    geometry = geometry_from_scene(dry)
    try:
        batches, by = _by_simd(system, conditions, bases, hot_ps), "SIMD replicas"
        batch = next(batches)
    except SimdUnavailableError:
        batches, by = _by_openmm(dry, system, on_cpu, bases, hot_ps), "OpenMM"
        batch = next(batches)
    found = [bases[0]]
    for _ in range(2 + 4 * n // len(batch)):
        found += [x for x in batch if not check_frames(x, geometry)[0] & _KEPT]
        if len(found) >= n:
            break
        batch = next(batches)
    # Where heat turns peptide bonds over, what is left is taken again, with other velocities.
    return np.stack([found[k % len(found)] for k in range(n)]), by


def _by_simd(system: Any, conditions: Conditions, bases: list[FloatArray], hot_ps: float) -> Iterator[FloatArray]:
    """Yield batches of sixteen states that were hot and have cooled down."""
    how: dict[str, Any] = {"friction_per_ps": FRICTION_PER_PS, "timestep_ps": conditions.timestep_ps}
    # The first replica of all is the structure given.
    at = np.stack([bases[conformer_of(k + 1, len(bases))] for k in range(n_replicas())])
    seed = conditions.seed
    while True:
        for temperature_k, time_ps in ((HOT_K, hot_ps), (conditions.temperature_k, _COOLING * hot_ps)):
            run = SimdReplicas(system, temperature_k=temperature_k, seed=seed % 2**31, **how)
            run.set_positions(at)
            run.thermalise()
            _steps(run, time_ps)
            at, seed = run.positions_nm.astype(np.float64), seed + 7919
        yield at
        # The next batch goes on from here: it has been hot for longer.


def _by_openmm(
    scene: Scene, system: Any, conditions: Conditions, bases: list[FloatArray], hot_ps: float
) -> Iterator[FloatArray]:
    """Yield states of hot runs, one of each conformer, each minimised, which cooling would do."""
    hot = replace(conditions, temperature_k=HOT_K, friction_per_ps=FRICTION_PER_PS)
    with Engine(scene, hot, threads=1, system=system) as engine:
        kept = list(bases)
        for k in count(1):
            stop_if_asked()
            own = conformer_of(k, len(bases))
            engine.set_positions(kept[own])
            engine.thermalise()
            engine.step(max(1, round(_APART * hot_ps / hot.timestep_ps)))
            kept[own] = engine.positions()
            engine.minimise(max_iterations=_MINIMISED)
            yield engine.positions()[None]


def _turned_ps(hot_ps: float) -> float:
    return _TURNED_PS * min(1.0, max(_LEAST_TURNED, hot_ps / HOT_PS))


def _in_water(wet: Scene, conditions: Conditions, dry: Scene, frames: FloatArray, turned_ps: float) -> FloatArray:
    """Return positions `(n, n_atoms, 3)` in water whose solute was turned to the torsions of dry `frames`."""
    angles = np.asarray(torsion(frames, rotatable_torsions(dry)), dtype=np.float64)
    solute = solute_of(wet)
    quads: IntArray = np.asarray(solute)[rotatable_torsions(dry)]
    system = build_system(wet, conditions.force)
    with Engine(wet, replace(conditions, platform="CPU", ensemble="nvt"), threads=1, system=system) as engine:
        engine.minimise(max_iterations=_MINIMISED)
        start = engine.positions()
    out = np.empty((len(angles), wet.n_atoms, 3))
    for first in range(0, len(angles), n_replicas()):
        run = SimdReplicas(
            system, temperature_k=conditions.temperature_k, friction_per_ps=FRICTION_PER_PS,
            timestep_ps=conditions.timestep_ps, seed=conditions.seed + first, biased=quads.tolist(),
        )  # fmt: skip
        run.set_positions(np.repeat(start[None], run.n_replicas, axis=0))
        run.thermalise()
        own = angles[np.minimum(first + np.arange(run.n_replicas), len(angles) - 1)]
        for share in (0.1, 0.3, 1.0):
            for place in range(len(quads)):
                run.set_bias(place, own[:, place], share * _STIFFNESS_KJ_MOL)
            _steps(run, turned_ps / 3)
        last = min(n_replicas(), len(angles) - first)
        out[first : first + last] = run.positions_nm[:last]
    flags = check_frames(out[:, np.asarray(solute)], geometry_from_scene(dry)) & _KEPT
    out[flags != 0] = start
    return out


def _steps(run: SimdReplicas, time_ps: float) -> None:
    n_steps = round(time_ps / run.timestep_ps)
    for done in range(0, n_steps, _PIECE):
        stop_if_asked()
        run.step(min(_PIECE, n_steps - done))
