"""The `openmm.State` of a surrogate: positions, time and energy; velocities and forces are refused by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from systems.errors import SimulationError


@dataclass(frozen=True, eq=False)
class SurrogateState:
    """A snapshot: positions `(n_atoms, 3)` nm, time, step; `include` names what was asked for, as `openmm.State`.

    Every getter raises SimulationError for what was not asked for or what a surrogate does not have.
    """

    positions_nm: npt.NDArray[np.float32]
    time_ps: float
    step: int
    include: frozenset[str]
    energy_fn: Callable[[npt.NDArray[np.float64]], float] | None = None

    def getPositions(self, asNumpy: bool = False) -> Any:
        """Return positions with their unit: `Vec3`s, or an array `(n_atoms, 3)` with `asNumpy`."""
        from openmm import Vec3, unit

        if "positions" not in self.include:
            raise SimulationError("this state was taken without positions; call getState(positions=True).")
        positions = self.positions_nm.astype(np.float64)
        if asNumpy:
            return positions * unit.nanometer
        return [Vec3(*row) for row in positions.tolist()] * unit.nanometer

    def getTime(self) -> Any:
        """Return the simulated time with its unit."""
        from openmm import unit

        return self.time_ps * unit.picoseconds

    def getStepCount(self) -> int:
        return self.step

    def getPotentialEnergy(self) -> Any:
        """Return what the simulation's `energy_fn` says of the positions, with its unit."""
        from openmm import unit

        if "energy" not in self.include:
            raise SimulationError("this state was taken without energy; call getState(energy=True).")
        if self.energy_fn is None:
            raise SimulationError("a surrogate has no potential energy; give the simulation an energy_fn.")
        return float(self.energy_fn(self.positions_nm.astype(np.float64))) * unit.kilojoules_per_mole

    def getKineticEnergy(self) -> NoReturn:
        raise SimulationError("a surrogate has no kinetic energy (nor total energy, nor temperature); leave it out.")

    def getVelocities(self, asNumpy: bool = False) -> NoReturn:
        raise SimulationError("a surrogate has no velocities; leave them out.")

    def getForces(self, asNumpy: bool = False) -> NoReturn:
        raise SimulationError("a surrogate has no forces; leave them out.")

    def getParameters(self) -> dict[str, float]:
        """Return no global parameters: there are none."""
        return {}

    def getPeriodicBoxVectors(self, asNumpy: bool = False) -> NoBox:
        """Return a box that is none; see `NoBox`."""
        return NoBox()

    def getPeriodicBoxVolume(self) -> NoReturn:
        _no_box()


def _no_box() -> NoReturn:
    raise SimulationError("a surrogate has no periodic box; leave the cell, volume and density out.")


class NoBox:
    """The box of a molecule without one. StateDataReporter multiplies its lengths whether it reports a volume or not,
    so products are allowed; an attempt to get a number out of it raises SimulationError.

    As a whole it has the value that DCD and XTC files write where there is no cell, zeros: MDTraj's reporters of these
    formats ask for it, and its readers make None of it again.
    """

    # Before NumPy's own operators.
    __array_ufunc__ = None

    def __init__(self, *, is_product: bool = False) -> None:
        self._is_product = is_product

    def __getitem__(self, index: int) -> NoBox:
        if index not in (0, 1, 2):
            raise IndexError(index)
        return self

    def __mul__(self, other: Any) -> NoBox:
        return NoBox(is_product=True)

    __rmul__ = __mul__

    def value_in_unit(self, unit: Any) -> npt.NDArray[np.float64]:
        if self._is_product:
            _no_box()
        return np.zeros((3, 3))

    def __float__(self) -> float:
        _no_box()

    def __pow__(self, power: float) -> NoReturn:
        _no_box()

    def __truediv__(self, other: Any) -> NoReturn:
        _no_box()

    def __rtruediv__(self, other: Any) -> NoReturn:
        _no_box()

    def __str__(self) -> str:
        _no_box()
