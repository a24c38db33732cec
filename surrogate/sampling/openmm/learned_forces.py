"""A learned potential as other programs take it: a function of positions, an OpenMM force, an ASE calculator."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from surrogate.data.shipped import weights_path
from surrogate.data.weights import load_weights
from surrogate.models.interface import Molecule
from surrogate.models.painet.potential.model import PainetPotential
from surrogate.sampling.domain import match_scene
from systems.errors import InputError, SimulationError

if TYPE_CHECKING:
    from surrogate.data.weights import Weights
    from systems.scene import Scene

FloatArray = npt.NDArray[np.floating[Any]]
# An Å in nm, an eV in kJ/mol (CODATA 2018).
NM_PER_ANGSTROM = 0.1
KJ_MOL_PER_EV = 96.48533212331


class LearnedForces:
    """Energies and forces of a scene by a learned potential, atoms in the scene's order.

    `weights`: a file, or loaded ones. Raises InputError for weights that are no potential, OutOfDomainError for a
    molecule that they do not cover.
    """

    def __init__(self, scene: Scene, weights: str | Path | Weights) -> None:
        loaded = load_weights(weights_path(weights)) if isinstance(weights, str | Path) else weights
        if not isinstance(loaded.model, PainetPotential):
            raise InputError(
                f"{loaded.path.name} makes frames, not forces ({loaded.model.arch}); train a potential with "
                "`level='gfn2-xtb'`."
            )
        self.scene, self.weights, self._model = scene, loaded, loaded.model.eval()
        self._order = match_scene(scene, loaded)
        self._back = np.argsort(self._order)
        self._molecule = Molecule.of(loaded.domain.scene)

    def __call__(self, positions_nm: FloatArray) -> tuple[float, FloatArray]:
        """Positions `(n_atoms, 3)` nm -> energy in kJ/mol, forces `(n_atoms, 3)` in kJ/mol/nm."""
        energies, forces, _ = self.evaluate(np.asarray(positions_nm)[None])
        return float(energies[0]), forces[0]

    def evaluate(self, frames_nm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Frames `(n, n_atoms, 3)` nm -> energies `(n,)`, forces, and the members' spread of energies `(n,)`, root mean
        square, all in kJ/mol and kJ/mol/nm. Raises SimulationError where they are not finite."""
        x = torch.from_numpy(np.ascontiguousarray(np.asarray(frames_nm, dtype=np.float64)[:, self._order]))
        members, gradient = self._model.gradient(x, self._molecule)(x)
        energies, forces = members.mean(-1).numpy(), -gradient.numpy()[:, self._back]
        if not (np.isfinite(energies).all() and np.isfinite(forces).all()):
            raise SimulationError(f"{self.weights.path.name}: the learned energy of {self.scene.name!r} is not finite.")
        return energies, forces, members.std(-1, correction=0).numpy()

    def openmm_force(self) -> Any:
        """Return an `openmm.PythonForce`, to be added to a System of the scene's particles."""
        import openmm

        if not hasattr(openmm, "PythonForce"):
            raise InputError(
                f"a learned force needs OpenMM's PythonForce, which {openmm.__version__} lacks; update it."
            )

        def compute(state: Any) -> tuple[float, FloatArray]:
            return self(np.asarray(state.getPositions(asNumpy=True)._value, dtype=np.float64))

        force = openmm.PythonForce(compute)
        force.setName("PAINET")
        return force

    def ase_calculator(self) -> Any:
        """Return an ASE calculator of energies in eV and forces in eV/Å. Raises InputError without ASE."""
        try:
            from ase.calculators.calculator import Calculator, all_changes
        except ImportError as error:
            raise InputError("an ASE calculator needs ASE; install it: `pip install ase`.") from error
        learned = self

        class Learned(Calculator):
            implemented_properties = ["energy", "forces"]  # noqa: RUF012

            def calculate(self, atoms: Any = None, properties: Any = None, system_changes: Any = all_changes) -> None:
                super().calculate(atoms, properties, system_changes)
                if tuple(atoms.get_chemical_symbols()) != tuple(learned.scene.elements):
                    raise InputError(f"these atoms are not those of {learned.scene.name!r}, in its order.")
                energy, forces = learned(atoms.get_positions() * NM_PER_ANGSTROM)
                self.results = {
                    "energy": energy / KJ_MOL_PER_EV,
                    "forces": forces * (NM_PER_ANGSTROM / KJ_MOL_PER_EV),
                }

        return Learned()
