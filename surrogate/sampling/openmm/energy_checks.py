"""Whether a frame's energy is one that the truth has: against MD's energies for models of frames, against the truth's
own energy of the same frame for a learned potential."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt
import torch

from surrogate.models.interface import Molecule
from surrogate.models.painet.potential.model import PainetPotential
from systems.errors import SimulationError, SurromdError
from systems.trajectory.codec import DIFFERENCE_COLUMN

if TYPE_CHECKING:
    from surrogate.data.weights import Weights
    from surrogate.sampling.openmm.coupling import Coupling

FloatArray = npt.NDArray[np.floating[Any]]

# A potential's energy is wrong where it is off by so many times its mean absolute error at held-out states, most of
# which are hotter than a rollout; it is unsure where its members differ by so many times what they do there. Of
# paracetamol at 700 K they differ by at most five times that.
WRONG_TIMES, UNSURE_TIMES = 10.0, 10.0


class EnergyCheck(Protocol):
    """A number in kJ/mol for a frame, kept in the trajectory's scalar `column`, the limit of what passes, and whether a
    number does not."""

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
        """Return the energy of a frame `(n_atoms, 3)` nm, infinity where there is none."""
        try:
            return self._coupling.relax(frame_nm).potential_kj_mol
        except SimulationError:
            return np.inf

    def fails(self, value: float) -> bool:
        return value > self.limit


class TruthDifference:
    """U_truth - U_model in kJ/mol of a frame as it is, for a learned potential; by this column the judge reweights."""

    column = DIFFERENCE_COLUMN

    def __init__(self, coupling: Coupling, weights: Weights) -> None:
        assert isinstance(weights.model, PainetPotential)
        self._coupling, self._model = coupling, weights.model
        self._fabric = self._model.fabric(Molecule.of(weights.domain.scene))
        self.limit = WRONG_TIMES * _measured(weights, "energy_mae")

    def value(self, frame_nm: FloatArray) -> float:
        """Return the difference at a frame `(n_atoms, 3)` nm, infinity where the truth has no answer."""
        frame = np.asarray(frame_nm, dtype=np.float64)
        learned = self._model.evaluate(torch.from_numpy(frame)[None], self._fabric).energy_kj_mol
        try:
            return self._coupling.energy_kj_mol(frame) - float(learned)
        except SurromdError:
            return np.inf

    def fails(self, value: float) -> bool:
        return not np.isfinite(value) or abs(value) > self.limit


class MemberSpread:
    """Which frames a learned potential knows nothing of: there its members' energies differ."""

    def __init__(self, weights: Weights) -> None:
        assert isinstance(weights.model, PainetPotential)
        self._model = weights.model
        self._fabric = self._model.fabric(Molecule.of(weights.domain.scene))
        self.limit_kj_mol = UNSURE_TIMES * _measured(weights, "energy_spread")

    def unsure(self, frames_nm: FloatArray) -> npt.NDArray[np.bool_]:
        """Frames `(b, n, n_atoms, 3)` nm -> `(b, n)`; frames that are not finite are the other checks' to find."""
        flat = torch.from_numpy(frames_nm.reshape(-1, *frames_nm.shape[2:]).astype(np.float64))
        with torch.no_grad():
            spread = self._model.members(flat, self._fabric).std(-1, correction=0)
        found: npt.NDArray[np.bool_] = (spread > self.limit_kj_mol).numpy().reshape(frames_nm.shape[:2])
        return found


def _measured(weights: Weights, name: str) -> float:
    """Return what training measured at the states that it held out, infinity where it did not."""
    return float(weights.provenance.get(name, np.inf))
