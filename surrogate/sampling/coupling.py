"""OpenMM beside a rollout: frames relaxed, energies, and real MD from a frame, under the conditions of training; and
how far a learned potential can be trusted at a frame."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from surrogate.data import fitted_atoms
from surrogate.models.potential import Potential
from surrogate.models.propagator import Molecule
from surrogate.models.weights import Weights
from systems.chemistry.geometry import FloatArray, superposition
from systems.errors import InputError, SurromdError
from systems.units import whole_steps


class Segment(NamedTuple):
    """Real MD: frames `(n_frames, n_atoms, 3)` nm and velocities `(n_atoms, 3)` nm/ps at the last, laid on the frame
    that they start from, as the frames of a rollout are."""

    frames_nm: FloatArray
    velocities_nm_ps: FloatArray


class Coupling:
    """OpenMM with the force field that a surrogate was trained on: relaxes its frames and runs MD from them.

    Atoms are in the model's order. Call `close` when done.

    Raises InputError when the weights do not say which force field they were trained with, or OpenMM cannot build it.
    """

    def __init__(self, weights: Weights) -> None:
        from md_reference.forces.forcefield import build_system, resolve
        from md_reference.forces.spec import ForceFieldSpec
        from md_reference.run.engine import Relaxer

        self._scene, self._conditions = weights.domain.scene, weights.domain.conditions
        cannot = f"{weights.path.name} cannot be coupled to OpenMM (`guard='flag'` and resample need no coupling)"
        needed = ("force_field", "solvent", "temperature_k", "timestep_ps")
        missing = [key for key in needed if self._conditions.get(key) is None]
        if missing:
            raise InputError(f"{cannot}: they do not say their {' and '.join(missing)}.")
        try:
            spec = ForceFieldSpec.of(self._conditions)
            if spec.is_explicit and self._scene.cell_nm is None:
                raise InputError(f"they learned from MD in {spec.solvent}, and a rollout has no water.")
            self._spec = resolve(self._scene, spec)
            self._system = build_system(self._scene, self._spec)
            self._relaxer = Relaxer(self._scene, self._system, born=self._spec.is_born)
        except SurromdError as error:
            raise InputError(f"{cannot}: {error}") from error
        self._steps_per_frame = whole_steps(
            weights.domain.lag_ps, self._conditions["timestep_ps"], "the weights' frame spacing in MD time steps"
        )
        self._fit = fitted_atoms(self._scene)

    def relax(self, frame_nm: FloatArray) -> FloatArray:
        """Return a frame `(n_atoms, 3)` nm with its stiff bonds at rest and all else held near where it was.

        Raises SimulationError for frames that are beyond repair.
        """
        return self._relaxer.relax(frame_nm)

    def energy_kj_mol(self, frame_nm: FloatArray) -> float:
        """Return the energy of a frame `(n_atoms, 3)` nm as it is. Raises SurromdError where there is none."""
        return float(self._still.energy(frame_nm))

    @cached_property
    def _still(self) -> Any:
        """An engine that is asked for energies alone."""
        return self._engine(seed=0)

    def simulate(self, start_nm: FloatArray, n_frames: int, *, seed: int) -> Segment:
        """Run MD from a frame `(n_atoms, 3)` nm: relaxed first, velocities drawn anew, frames at the weights' spacing.

        The same start and seed give the same frames, whatever was simulated before. Raises SimulationError when the
        start is beyond repair or the system blows up.
        """
        start = np.asarray(start_nm, dtype=np.float64)
        frames = np.empty((n_frames, *start.shape))
        with self._engine(seed=seed) as engine:
            engine.set_positions(self.relax(start))
            engine.thermalise()
            for k in range(n_frames):
                engine.step(self._steps_per_frame)
                state = engine.state(velocities=True)
                frames[k] = state.positions_nm
        rotation, translation = superposition(frames, start, idx=self._fit)
        laid = np.einsum("tij,tnj->tni", rotation, frames) + translation[:, None, :]
        velocities = np.asarray(state.velocities_nm_ps)
        # What the molecule does as a whole is no part of a rollout.
        velocities = velocities - self._scene.masses_da @ velocities / self._scene.masses_da.sum()
        return Segment(laid, velocities @ rotation[-1].T)

    def _engine(self, *, seed: int) -> Any:
        from md_reference.run.config import Conditions
        from md_reference.run.engine import Engine

        c = self._conditions
        conditions = Conditions(
            force=self._spec, temperature_k=c["temperature_k"], friction_per_ps=c.get("friction_per_ps") or 1.0,
            timestep_ps=c["timestep_ps"], seed=seed,
        )  # fmt: skip
        return Engine(self._scene, conditions, system=self._system)

    def close(self) -> None:
        """Free OpenMM's Contexts."""
        self._relaxer.close()
        if "_still" in vars(self):
            self._still.close()


# A potential's energy is wrong where it is off by so many times its mean absolute error at held-out states, most of
# which are hotter than a rollout; it is unsure where its members differ by so many times what they do there. Of
# paracetamol at 700 K they differ by at most five times that.
WRONG_TIMES, UNSURE_TIMES = 10.0, 10.0


class PotentialChecks:
    """Where a learned potential cannot be trusted: at frames at which its members' energies differ, and, by `coupling`,
    at those whose energy is far from the reference's."""

    def __init__(self, weights: Weights, coupling: Coupling | None = None) -> None:
        assert isinstance(weights.model, Potential)
        self._model, self._coupling = weights.model, coupling
        self._molecule = Molecule.of(weights.domain.scene)
        # Infinity where training did not measure them.
        error, spread = (float(weights.provenance.get(name, np.inf)) for name in ("energy_mae", "energy_spread"))
        self._wrong_kj_mol, self._unsure_kj_mol = WRONG_TIMES * error, UNSURE_TIMES * spread
        self._zero_kj_mol = torch.zeros(())
        # Of a molecule that they never saw members have each a zero of their own: energies count from the start.
        self._start_nm = weights.domain.scene.positions_nm.copy() if weights.domain.limits is None else None
        if self._start_nm is not None:
            start = torch.tensor(self._start_nm[None], dtype=torch.float64)
            with torch.no_grad():
                self._zero_kj_mol = self._model.energies(start, self._molecule)

    def unsure(self, frames_nm: FloatArray) -> npt.NDArray[np.bool_]:
        """Frames `(b, n, n_atoms, 3)` nm -> `(b, n)`; frames that are not finite are the other checks' to find."""
        flat = torch.from_numpy(frames_nm.reshape(-1, *frames_nm.shape[2:]).astype(np.float64))
        with torch.no_grad():
            spread = (self._model.energies(flat, self._molecule) - self._zero_kj_mol).std(-1, correction=0)
        found: npt.NDArray[np.bool_] = (spread > self._unsure_kj_mol).numpy().reshape(frames_nm.shape[:2])
        return found

    def difference(self, frame_nm: FloatArray) -> float:
        """Return U_reference - U_model in kJ/mol of a frame `(n_atoms, 3)` nm, infinity where there is none. By this
        the comparison reweights."""
        assert self._coupling is not None
        frame = np.asarray(frame_nm, dtype=np.float64)
        learned = self._model.evaluate(torch.from_numpy(frame)[None], self._molecule).energy_kj_mol
        try:
            return self._coupling.energy_kj_mol(frame) - float(learned)
        except SurromdError:
            return np.inf

    @cached_property
    def _offset_kj_mol(self) -> float:
        found = 0.0 if self._start_nm is None else self.difference(self._start_nm)
        return found if np.isfinite(found) else 0.0

    def is_wrong(self, difference_kj_mol: float) -> bool:
        """Return whether a `difference` is large, or further from that of the start, where this was not trained on."""
        return not np.isfinite(difference_kj_mol) or abs(difference_kj_mol - self._offset_kj_mol) > self._wrong_kj_mol
