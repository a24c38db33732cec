"""GFN2-xTB as an OpenMM force: energies and gradients of tblite, in MD's units.

GFN2-xTB: Bannwarth, Ehlert and Grimme, J. Chem. Theory Comput. 15, 1652 (2019).
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from systems.chemistry.distance_bonds import changed_bond
from systems.chemistry.validity import changed_stereo
from systems.errors import PreparationError, first_line
from systems.scene import FloatArray, Scene

# CODATA 2018.
KJ_MOL_PER_HARTREE = 2625.4996394799
NM_PER_BOHR = 0.0529177210903
_HEAVIEST = 86
_UPHILL_KJ_MOL = 1e9
# A force costs some hundred ms at 50 atoms and grows with the third power.
LARGEST = 200
# Bonds to hydrogen are at rest long before torsions are; protons of zwitterions move last.
_MINIMISER_STEPS = 60
# Implicit solvents by their name in tblite. ALPB: Ehlert, Stahn, Spicher and Grimme, J. Chem. Theory Comput. 17, 4250
# (2021).
_SOLVENTS = {"alpb-water": "water"}


def build_quantum_system(
    scene: Scene, *, solvent: str = "vacuum", hydrogen_mass_da: float | None = None, constrain_hydrogens: bool = False
) -> Any:
    """Return an `openmm.System` whose one force is GFN2-xTB, without a cell, in vacuum or `alpb-water`.

    `hydrogen_mass_da`: taken from the atom a hydrogen is bonded to; None leaves natural masses. With
    `constrain_hydrogens` bonds to hydrogen are as long as in the nearest minimum of the energy, and rigid. Every force
    is an SCF from scratch, so that a resumed run repeats an undisturbed one. Raises PreparationError where tblite or
    PythonForce is missing, for elements beyond radon, for scenes too large, and where that minimum is another molecule.
    """
    import openmm

    if not hasattr(openmm, "PythonForce"):
        raise PreparationError(f"gfn2-xtb needs OpenMM's PythonForce, which {openmm.__version__} lacks; update OpenMM.")
    if scene.n_atoms > LARGEST:
        raise PreparationError(
            f"scene {scene.name!r} has {scene.n_atoms} atoms; gfn2-xtb is limited to {LARGEST} atoms here. "
            "Use a force field."
        )
    potential = Potential(scene, solvent)
    potential(scene.positions_nm)  # what the method refuses is known before anything runs
    system = openmm.System()
    for mass_da in _masses_da(scene, hydrogen_mass_da).tolist():
        system.addParticle(mass_da)

    force = openmm.PythonForce(potential.of_state)
    force.setName("GFN2-xTB")
    system.addForce(force)
    if constrain_hydrogens and (bonds := _hydrogen_bonds(scene)):
        rest_nm = _minimum_nm(scene, system)
        refuse_rearranged(scene, rest_nm)
        for hydrogen, other in bonds:
            system.addConstraint(hydrogen, other, float(np.linalg.norm(rest_nm[hydrogen] - rest_nm[other])))
    return system


def refuse_rearranged(scene: Scene, positions_nm: FloatArray) -> None:
    """Raise PreparationError where a minimum `(n_atoms, 3)` nm has other bonds or another handedness than the scene."""
    if what := changed_bond(scene, positions_nm) or changed_stereo(scene, positions_nm[None])[0]:
        raise PreparationError(
            f"scene {scene.name!r} becomes another molecule when GFN2-xTB minimises it: {what}. Give the form that it "
            "becomes (a neutral one for a zwitterion), or simulate it with `solvent='alpb-water'`."
        )


def check_minimum(scene: Scene) -> None:
    """Raise PreparationError where GFN2-xTB, in vacuum, minimises a scene to another molecule."""
    refuse_rearranged(scene, _minimum_nm(scene, build_quantum_system(scene)))


def _hydrogen_bonds(scene: Scene) -> list[tuple[int, int]]:
    """Return the bonds to hydrogen, the hydrogen first."""
    bonds = [pair if scene.elements[pair[0]] == "H" else pair[::-1] for pair in map(tuple, scene.bonds.tolist())]
    return [(hydrogen, other) for hydrogen, other in bonds if scene.elements[hydrogen] == "H"]


def _masses_da(scene: Scene, hydrogen_mass_da: float | None) -> FloatArray:
    """Return masses `(n_atoms,)`, hydrogens as heavy as asked for at the cost of what they are bonded to."""
    masses = np.array(scene.masses_da, dtype=np.float64)
    for hydrogen, other in _hydrogen_bonds(scene) if hydrogen_mass_da is not None else ():
        if scene.elements[other] != "H":
            masses[other] -= hydrogen_mass_da - scene.masses_da[hydrogen]
            masses[hydrogen] = hydrogen_mass_da
    if masses.min() <= 0.0:
        raise PreparationError(
            f"`hydrogen_mass_da={hydrogen_mass_da:g}` leaves a heavy atom of scene {scene.name!r} no mass; use less."
        )
    return masses


def _minimum_nm(scene: Scene, system: Any) -> FloatArray:
    """Return positions `(n_atoms, 3)` nm of the minimum that a free `system` goes to from those of its scene."""
    import openmm

    platform = openmm.Platform.getPlatform("Reference")
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), platform)
    context.setPositions(scene.positions_nm)
    signs = set(np.sign(scene.formal_charges).tolist())
    openmm.LocalEnergyMinimizer.minimize(context, maxIterations=0 if {-1, 1} <= signs else _MINIMISER_STEPS)
    return np.asarray(context.getState(positions=True).getPositions(asNumpy=True)._value, dtype=np.float64)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Molecules of this size only lose by more threads, which wait in a loop: twice the time, more on busy cores."""
    try:  # the library whose threads tblite takes, torch's where that was loaded before
        openmp = ctypes.CDLL("libgomp.so.1")
    except OSError:
        yield
        return
    before = openmp.omp_get_max_threads()
    openmp.omp_set_num_threads(1)
    try:
        yield
    finally:
        openmp.omp_set_num_threads(before)


class Potential:
    """GFN2-xTB of one molecule: positions `(n_atoms, 3)` nm -> energy in kJ/mol, forces `(n_atoms, 3)` in kJ/mol/nm.
    Charge from the scene's formal charges, unpaired electrons from `provenance["multiplicity"]` (where it says nothing,
    the fewest possible). `solvent`: vacuum or alpb-water. Raises PreparationError as `build_quantum_system`."""

    def __init__(self, scene: Scene, solvent: str = "vacuum") -> None:
        from openmm.app import Element

        try:
            from tblite.interface import Calculator
        except ImportError as error:
            raise PreparationError("gfn2-xtb needs tblite; install it: `pip install tblite`.") from error
        numbers = np.array([Element.getBySymbol(e).atomic_number for e in scene.elements])
        if numbers.max() > _HEAVIEST:
            heavy = sorted({e for e, z in zip(scene.elements, numbers, strict=True) if z > _HEAVIEST})
            raise PreparationError(f"GFN2-xTB has no parameters for {', '.join(heavy)} in scene {scene.name!r}.")
        charge = int(scene.formal_charges.sum())
        electrons = int(numbers.sum()) - charge
        unpaired = int(scene.provenance.get("multiplicity", 1 + electrons % 2)) - 1
        if unpaired % 2 != electrons % 2:
            raise PreparationError(
                f"scene {scene.name!r} has {electrons} electrons (charge {charge:+d}), which cannot leave {unpaired} "
                "unpaired; check hydrogens, charges and multiplicity."
            )
        self._calculator: Any = Calculator(
            "GFN2-xTB", numbers, scene.positions_nm / NM_PER_BOHR, charge=charge, uhf=unpaired
        )
        self._calculator.set("verbosity", 0)
        if solvent in _SOLVENTS:
            self._calculator.add("alpb-solvation", _SOLVENTS[solvent])
        self._scene, self._solvent = scene, solvent

    def __reduce__(self) -> tuple[type[Potential], tuple[Scene, str]]:
        return Potential, (self._scene, self._solvent)

    def of_state(self, state: Any) -> tuple[float, FloatArray]:
        """Return energy and forces as OpenMM asks for them."""
        positions_nm = np.asarray(state.getPositions(asNumpy=True)._value, dtype=np.float64)
        try:
            return self(positions_nm)
        except PreparationError:
            if state.getStepCount() > 0:
                raise
            # A minimiser's first trial moves all atoms by 1 nm in sum; it must learn that this is uphill.
            return _UPHILL_KJ_MOL, np.zeros_like(positions_nm)

    def __call__(self, positions_nm: FloatArray) -> tuple[float, FloatArray]:
        try:
            self._calculator.update(positions=positions_nm / NM_PER_BOHR)
            with _one_thread():
                result = self._calculator.singlepoint()
        except (RuntimeError, ValueError) as error:
            raise PreparationError(
                f"GFN2-xTB finds no electronic ground state for scene {self._scene.name!r} ({first_line(error)})."
            ) from error
        energy = float(result.get("energy")) * KJ_MOL_PER_HARTREE
        gradient = np.asarray(result.get("gradient"), dtype=np.float64)
        return energy, gradient * (-KJ_MOL_PER_HARTREE / NM_PER_BOHR)
