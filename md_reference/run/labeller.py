"""An expensive reference as a labeller: states of a molecule to ask about, and its energies and forces there, a
process a core."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from md_reference.forces.forcefield import build_system
from md_reference.forces.mixture import is_water, molecules_of
from md_reference.forces.quantum import Potential, check_minimum
from md_reference.forces.spec import QUANTUM, ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.machine import available_cores
from md_reference.run.replicas import refuse_within_import, signals_held
from systems.chemistry.distance_bonds import changed_bond
from systems.chemistry.graph import turn_torsions
from systems.chemistry.validity import changed_stereo
from systems.errors import PreparationError, SimulationError
from systems.files.whole_file import Closing
from systems.interrupts import end_with_parent
from systems.scene import FloatArray, Scene


@dataclass(frozen=True)
class _Pace:
    """How hot MD goes: its step and its hydrogens, how long it settles, how far apart its states are, and how many of
    the frames asked of plain MD it makes."""

    timestep_ps: float
    hydrogen_mass_da: float | None
    discarded_ps: float
    apart_ps: float
    share: float


_CHEAP = _Pace(0.0005, None, 2.0, 0.25, 1.0)
# Where every step is an expensive force: as few as will do. H2 has no heavy atom to make its hydrogens heavier.
_EXPENSIVE = _Pace(0.002, 3.0, 0.3, 0.01, 0.125)
_EXPENSIVE_LIGHT = replace(_EXPENSIVE, timestep_ps=0.0005, hydrogen_mass_da=None)
# Every so many-th hot state has one of its torsions turned to any angle.
_TURN_EVERY = 3
# Bonds of hot states are stretched, which a potential must learn; those longer than this, in radii, are broken.
_BROKEN = 1.6
_worker: Potential | None = None


@dataclass(frozen=True, eq=False)
class Labels:
    """States `positions_nm` (n, n_atoms, 3) with their energies (n,) in kJ/mol and forces (n, n_atoms, 3) in kJ/mol/nm;
    `failed`: how many more the reference has no answer for; `rearranged`: those that are another molecule."""

    positions_nm: FloatArray
    energies_kj_mol: FloatArray
    forces_kj_mol_nm: FloatArray
    failed: int = 0
    rearranged: int = 0


class Labeller(Closing):
    """GFN2-xTB of one molecule. Use as a context manager or call `close`. `n_rearranged` counts the states that were
    left out since they are another molecule. Raises PreparationError for what GFN2-xTB refuses, and for a molecule
    whose minimum is another one."""

    def __init__(self, scene: Scene, *, workers: int | None = None) -> None:
        self.n_workers = workers or available_cores()
        if self.n_workers > 1:
            refuse_within_import()
        self.scene = scene
        self._potential = Potential(scene)
        check_minimum(scene)  # what the method refuses is known before anything runs
        self.n_rearranged = 0
        self._pool: ProcessPoolExecutor | None = None
        if self.n_workers > 1:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.n_workers, context, _start, (scene.to_dict(),))
            with signals_held():
                self._pool.submit(int)  # starts the processes

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def label(self, positions_nm: FloatArray) -> Labels:
        """Return energies and forces at states `(n, n_atoms, 3)` nm; those without an answer are left out, as are those
        of another molecule."""
        asked = np.asarray(positions_nm, dtype=np.float64)
        states = asked[self._is_same(asked)]
        self.n_rearranged += len(asked) - len(states)
        answers = self._answers(states)
        good = [(x, *answer) for x, answer in zip(states, answers, strict=True) if answer is not None]
        shape = (len(good), self.scene.n_atoms, 3)
        kept, energies, forces = ([row[part] for row in good] for part in range(3))
        n_failed, n_rearranged = len(states) - len(good), len(asked) - len(states)
        return Labels(
            np.array(kept).reshape(shape), np.array(energies), np.array(forces).reshape(shape), n_failed, n_rearranged
        )

    def energies(self, positions_nm: FloatArray) -> FloatArray:
        """Return the energy `(n,)` in kJ/mol of every state, infinity where there is none or it is another molecule."""
        asked = np.asarray(positions_nm, dtype=np.float64)
        found, same = np.full(len(asked), np.inf), self._is_same(asked)
        found[same] = [np.inf if answer is None else answer[0] for answer in self._answers(asked[same])]
        return found

    def _is_same(self, states: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which states are no other molecule."""
        turned = changed_stereo(self.scene, states)
        return np.array([not t and not changed_bond(self.scene, x, stretch=_BROKEN)
                         for x, t in zip(states, turned, strict=True)], dtype=bool)  # fmt: skip

    def _answers(self, states: FloatArray) -> list[tuple[float, FloatArray] | None]:
        if self._pool is None:
            return [_answer(state, self._potential) for state in states]
        try:
            return list(self._pool.map(_answer, states, chunksize=4))
        except BrokenProcessPool as error:
            raise SimulationError(
                "a labelling process ended unexpectedly (killed, out of memory, or started by a script without "
                "`if __name__ == '__main__':`)."
            ) from error

    def explore(self, n_states: int, temperatures_k: Sequence[float], *, seed: int) -> FloatArray:
        """Return states `(n, n_atoms, 3)` nm of hot MD by GAFF2 (`rough`, see `gaff.entry`), or by GFN2-xTB where GAFF2
        has no parameters and of water, which is rigid beside it; as many at each temperature, of every third one
        torsion turned."""
        rng = np.random.default_rng(seed)
        each, apart_ps = -(-n_states // len(temperatures_k)), self._cheap[2].apart_ps
        states = np.concatenate([self._md(each, apart_ps, t, seed=int(rng.integers(2**31))) for t in temperatures_k])
        turn_torsions(self.scene, states, _TURN_EVERY, rng)
        order: FloatArray = states[rng.permutation(len(states))[:n_states]]
        return order

    def motion(
        self, n_frames: int, lag_ps: float, temperature_k: float, *, seed: int, constrain_hydrogens: bool = False
    ) -> FloatArray:
        """Return frames `(n_frames, n_atoms, 3)` nm of MD as hot as asked, `lag_ps` apart, an eighth as many where
        GFN2-xTB makes it; the centre of mass stays where it is."""
        n_frames = max(2, round(n_frames * self._cheap[2].share))
        return self._md(n_frames, lag_ps, temperature_k, seed=seed, constrain_hydrogens=constrain_hydrogens)

    def _md(
        self, n_frames: int, lag_ps: float, temperature_k: float, *, seed: int, constrain_hydrogens: bool = False
    ) -> FloatArray:
        spec, system, pace = self._cheap
        if constrain_hydrogens:
            spec = replace(spec, constrain_hydrogens=True)
            system = build_system(self.scene, spec, rough=True)
        conditions = Conditions(force=spec, temperature_k=temperature_k, timestep_ps=pace.timestep_ps, seed=seed,
                                platform="Reference")  # fmt: skip
        frames = np.empty((n_frames, self.scene.n_atoms, 3))
        with Engine(self.scene, conditions, system=system) as engine:
            engine.minimise()
            engine.thermalise()
            engine.step(round(pace.discarded_ps / pace.timestep_ps))
            for k in range(n_frames):
                engine.step(round(lag_ps / pace.timestep_ps))
                frames[k] = engine.positions()
        share = self.scene.masses_da / self.scene.masses_da.sum()
        return frames - np.einsum("n,tnk->tk", share, frames)[:, None]

    @cached_property
    def _cheap(self) -> tuple[ForceFieldSpec, Any, _Pace]:
        """The forces of hot MD, their `openmm.System`, and how it goes."""
        paces = {"gaff2": _CHEAP, QUANTUM: _EXPENSIVE if set(self.scene.elements) != {"H"} else _EXPENSIVE_LIGHT}
        if any(is_water(self.scene.elements, molecule) for molecule in molecules_of(self.scene)):
            del paces["gaff2"]
        for name, pace in paces.items():
            spec = ForceFieldSpec(name, "vacuum", pace.hydrogen_mass_da, constrain_hydrogens=False)
            try:
                return spec, build_system(self.scene, spec, rough=True), pace
            except PreparationError:
                if name == QUANTUM:
                    raise
        raise AssertionError("GFN2-xTB is among the ways")


def _start(scene: dict[str, Any]) -> None:
    global _worker
    # Ctrl-C is the parent's to answer: a worker that it ends while it takes a task leaves the pool's queue locked.
    for name in {"SIGINT", "SIGHUP"} & set(signal.Signals.__members__):
        signal.signal(signal.Signals[name], signal.SIG_IGN)
    end_with_parent()
    _worker = Potential(Scene.from_dict(scene))


def _answer(state: FloatArray, own: Potential | None = None) -> tuple[float, FloatArray] | None:
    potential = own or _worker
    assert potential is not None
    try:
        return potential(state)
    except (PreparationError, SimulationError):
        return None
