"""OpenMM beside a rollout: frames relaxed, energies, and real MD from a frame, under the conditions of training."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import torch

from surrogate.data import fitted_atoms
from surrogate.models.potential import Potential
from surrogate.models.propagator import Molecule
from systems.chemistry.geometry import superposition
from systems.chemistry.validity import WIDENING
from systems.errors import InputError, SimulationError, SurromdError
from systems.trajectory.codec import DIFFERENCE_COLUMN
from systems.units import whole_steps

if TYPE_CHECKING:
    from md_reference.run.engine import Relaxed
    from surrogate.models.weights import Weights


FloatArray = npt.NDArray[np.floating[Any]]

# The reference that energies are measured against: long enough for fast motion, short enough to be made on the spot.
_DISCARDED_PS = 10.0
_SAMPLE_PS = 0.5
_SAMPLES = 150


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

    def __init__(self, weights: Weights, *, platform: str = "auto") -> None:
        from md_reference.forces.forcefield import build_system, resolve
        from md_reference.forces.spec import ForceFieldSpec
        from md_reference.run.engine import Relaxer

        self._scene, self._conditions = weights.domain.scene, weights.domain.conditions
        self._platform, self._lag_ps = platform, weights.domain.lag_ps
        needed = ("force_field", "solvent", "temperature_k", "timestep_ps")
        missing = [key for key in needed if self._conditions.get(key) is None]
        if missing:
            raise InputError(f"{_cannot(weights)}: they do not say their {' and '.join(missing)}.")
        try:
            self._spec = resolve(self._scene, ForceFieldSpec.of(self._conditions))
            self._system = build_system(self._scene, self._spec)
            self._relaxer = Relaxer(self._scene, self._system, platform=platform, born=self._spec.is_born)
        except SurromdError as error:
            raise InputError(f"{_cannot(weights)}: {error}") from error
        self._steps_per_frame = whole_steps(
            self._lag_ps, self._conditions["timestep_ps"], "the weights' frame spacing in MD time steps"
        )
        self._fit = fitted_atoms(self._scene)

    def relax(self, frame_nm: FloatArray) -> Relaxed:
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

    @cached_property
    def energy_limit_kj_mol(self) -> float:
        """The highest energy of a relaxed frame that passes: 1.5 times as far above the mean as MD goes in 150 frames.

        Measured on MD of 85 ps from the training template, made when it is first asked for.
        """
        with self._engine(seed=0) as engine:
            engine.set_positions(self.relax(self._scene.positions_nm).positions_nm)
            engine.thermalise()
            engine.step(round(_DISCARDED_PS / self._conditions["timestep_ps"]))
            energies = np.empty(_SAMPLES)
            for k in range(_SAMPLES):
                engine.step(round(_SAMPLE_PS / self._conditions["timestep_ps"]))
                energies[k] = self.relax(engine.positions()).potential_kj_mol
        return float(energies.mean() + WIDENING * (energies.max() - energies.mean()))

    def simulate(self, start_nm: FloatArray, n_frames: int, *, seed: int) -> Segment:
        """Run MD from a frame `(n_atoms, 3)` nm: relaxed first, velocities drawn anew, frames at the weights' spacing.

        The same start and seed give the same frames, whatever was simulated before. Raises SimulationError when the
        start is beyond repair or the system blows up.
        """
        start = np.asarray(start_nm, dtype=np.float64)
        frames = np.empty((n_frames, *start.shape))
        with self._engine(seed=seed) as engine:
            engine.set_positions(self.relax(start).positions_nm)
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
            timestep_ps=c["timestep_ps"], seed=seed, platform=self._platform,
        )  # fmt: skip
        return Engine(self._scene, conditions, system=self._system)

    def close(self) -> None:
        """Free OpenMM's Contexts."""
        self._relaxer.close()
        if "_still" in vars(self):
            self._still.close()


def _cannot(weights: Weights) -> str:
    return f"{weights.path.name} cannot be coupled to OpenMM (`guard='flag'` and resample need no coupling)"


# Whether a frame's energy is one that the reference has: against MD's energies for models of frames, against the
# reference's own energy of the same frame for a learned potential.

# A potential's energy is wrong where it is off by so many times its mean absolute error at held-out states, most of
# which are hotter than a rollout; it is unsure where its members differ by so many times what they do there. Of
# paracetamol at 700 K they differ by at most five times that.
WRONG_TIMES, UNSURE_TIMES = 10.0, 10.0


class EnergyCheck(Protocol):
    """A number in kJ/mol for a frame `(n_atoms, 3)` nm, kept in the trajectory's scalar `column`; infinity where there
    is none. The `limit` of what passes, and whether a number does not."""

    column: str

    @property
    def limit(self) -> float: ...
    def value(self, frame_nm: FloatArray) -> float: ...
    def fails(self, value: float) -> bool: ...


class RelaxedEnergy:
    """Energy in kJ/mol of a frame whose stiff bonds are relaxed, against the highest that MD reaches."""

    column = "relaxed_energy_kj_mol"

    def __init__(self, coupling: Coupling) -> None:
        self._coupling = coupling

    @property
    def limit(self) -> float:
        return self._coupling.energy_limit_kj_mol

    def value(self, frame_nm: FloatArray) -> float:
        try:
            return self._coupling.relax(frame_nm).potential_kj_mol
        except SimulationError:
            return np.inf

    def fails(self, value: float) -> bool:
        return value > self.limit


class ReferenceDifference:
    """U_reference - U_model in kJ/mol of a frame as it is, for a learned potential; by this column the comparison
    reweights."""

    column = DIFFERENCE_COLUMN

    def __init__(self, coupling: Coupling, weights: Weights) -> None:
        assert isinstance(weights.model, Potential)
        self._coupling, self._model = coupling, weights.model
        self._molecule = Molecule.of(weights.domain.scene)
        self.limit = WRONG_TIMES * _measured(weights, "energy_mae")

    def value(self, frame_nm: FloatArray) -> float:
        frame = np.asarray(frame_nm, dtype=np.float64)
        learned = self._model.evaluate(torch.from_numpy(frame)[None], self._molecule).energy_kj_mol
        try:
            return self._coupling.energy_kj_mol(frame) - float(learned)
        except SurromdError:
            return np.inf

    def fails(self, value: float) -> bool:
        return not np.isfinite(value) or abs(value) > self.limit


class MemberSpread:
    """Which frames a learned potential knows nothing of: there its members' energies differ."""

    def __init__(self, weights: Weights) -> None:
        assert isinstance(weights.model, Potential)
        self._model = weights.model
        self._molecule = Molecule.of(weights.domain.scene)
        self.limit_kj_mol = UNSURE_TIMES * _measured(weights, "energy_spread")

    def unsure(self, frames_nm: FloatArray) -> npt.NDArray[np.bool_]:
        """Frames `(b, n, n_atoms, 3)` nm -> `(b, n)`; frames that are not finite are the other checks' to find."""
        flat = torch.from_numpy(frames_nm.reshape(-1, *frames_nm.shape[2:]).astype(np.float64))
        with torch.no_grad():
            spread = self._model.energies(flat, self._molecule).std(-1, correction=0)
        found: npt.NDArray[np.bool_] = (spread > self.limit_kj_mol).numpy().reshape(frames_nm.shape[:2])
        return found


def _measured(weights: Weights, name: str) -> float:
    """Return what training measured at the states that it held out, infinity where it did not."""
    return float(weights.provenance.get(name, np.inf))
