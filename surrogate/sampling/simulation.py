"""A surrogate behind the face of `openmm.app.Simulation`: topology, reporters, step, context, checkpoints; and
a learned potential as other programs take it."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
import numpy.typing as npt
import torch

from surrogate.models.architecture import weights_path
from surrogate.models.potential import Potential
from surrogate.models.propagator import Molecule
from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.chunks import BLOWN_UP, ChunkSampler, noise_seed
from surrogate.sampling.config import RolloutConfig
from surrogate.sampling.domain import fit_weights, match_domain
from systems.chemistry.geometry import FloatArray
from systems.errors import InputError, SimulationError, first_line
from systems.files.outside import UNREADABLE, arrays_in
from systems.files.whole_file import create_whole
from systems.library.named_scenes import prepare
from systems.options import from_field, options_as_keywords
from systems.scene import Scene


def _lacks(what: str) -> Any:
    """Return a method that refuses what a surrogate does not have."""

    def refuse(*args: Any, **options: Any) -> NoReturn:
        raise SimulationError(f"a surrogate has no {what}.")

    return refuse


@dataclass(frozen=True, eq=False)
class SurrogateState:
    """A snapshot as `openmm.State`: positions `(n_atoms, 3)` nm, time and step. Getters of what a surrogate does not
    have raise SimulationError."""

    positions_nm: npt.NDArray[np.float32]
    time_ps: float
    step: int

    def getPositions(self, asNumpy: bool = False) -> Any:
        """Return positions with their unit: `Vec3`s, or an array `(n_atoms, 3)` with `asNumpy`."""
        from openmm import Vec3, unit

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

    def getParameters(self) -> dict[str, float]:
        """Return no global parameters: there are none."""
        return {}

    def getPeriodicBoxVectors(self, asNumpy: bool = False) -> NoBox:
        """Return a box that is none; see `NoBox`."""
        return NoBox()

    getPotentialEnergy = _lacks("potential energy; leave it out")
    getKineticEnergy = _lacks("kinetic energy (nor total energy, nor temperature); leave it out")
    getVelocities = _lacks("velocities; leave them out")
    getForces = _lacks("forces; leave them out")
    getPeriodicBoxVolume = _lacks("periodic box; leave the cell, volume and density out")


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
    _refuse = _lacks("periodic box; leave the cell, volume and density out")
    __float__ = __pow__ = __truediv__ = __rtruediv__ = __str__ = _refuse

    def value_in_unit(self, unit: Any) -> npt.NDArray[np.float64]:
        return self._refuse() if self._is_product else np.zeros((3, 3))


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """Those of a rollout's options that a Simulation takes."""

    seed: int = from_field(RolloutConfig, "seed")
    lag_ps: float | None = from_field(RolloutConfig, "lag_ps")
    solvent: str | None = from_field(RolloutConfig, "solvent")
    force: bool = from_field(RolloutConfig, "force")
    solver: str | None = from_field(RolloutConfig, "solver")
    solver_steps: int | None = from_field(RolloutConfig, "solver_steps")
    precision: str = from_field(RolloutConfig, "precision")


class Simulation:
    """A learned simulator that OpenMM's and MDTraj's reporters take for `openmm.app.Simulation`.

    One step is one frame of the weights, `integrator.getStepSize()` long. `currentStep` may be set. Frames are those
    that `rollout` writes for the same seed, replica 0, in the scene's atom order and pose. What a surrogate does not
    have (energies, temperature, forces, a box) raises SimulationError where it is asked for and is never zero.
    Reporters that ask for such things by default must be told not to: `HDF5Reporter(file, 10, cell=False,
    potentialEnergy=False, kineticEnergy=False, temperature=False)`.

    `scene` and `weights` are what the command line takes, or a Scene and loaded weights.
    `force` runs a scene that leaves the training domain where that is possible; `deviations` then says how. `lag_ps`:
    the time of a step, of weights that were trained for several; `solvent`: one of theirs. Raises OutOfDomainError,
    InputError, WeightsError.
    """

    @options_as_keywords(SimulationOptions)
    def __init__(
        self,
        scene: str | Path | Scene,
        weights: str | Path | Weights,
        *,
        options: SimulationOptions,
    ) -> None:
        import openmm
        from openmm import unit

        if isinstance(scene, str | Path):
            scene = prepare(str(scene))
        if isinstance(weights, str | Path):
            weights = load_weights(weights_path(weights))
        weights, match = fit_weights(
            scene, weights, force=options.force, lag_ps=options.lag_ps, solvent=options.solvent
        )
        self.scene, self.weights, self.deviations = scene, weights, match.deviations
        self.topology = scene.to_openmm_topology()
        self.system = openmm.System()
        for mass in scene.masses_da.tolist():
            self.system.addParticle(mass * unit.dalton)
        self.reporters: list[Any] = []
        self.currentStep = 0
        self._sampler = ChunkSampler(
            weights, solver_steps=options.solver_steps, solver=options.solver, precision=options.precision
        )
        self._seed, self._force = options.seed, options.force
        self._order, self._back = match.order, np.argsort(match.order)
        self._last: npt.NDArray[np.float32]
        self._velocities: npt.NDArray[np.float32] | None
        self._pending: npt.NDArray[np.float32]
        self._chunks = 0  # drawn since the start, which the seed of the next one counts from
        self._frames = 0  # behind us, counted apart from `currentStep`, which the user may set
        self._begin(scene.positions_nm)
        self.integrator = SurrogateIntegrator(self)
        self.context = SurrogateContext(self)

    @property
    def lag_ps(self) -> float:
        """Simulated time of one step in ps."""
        return self.weights.domain.lag_ps

    @property
    def positions_nm(self) -> npt.NDArray[np.float32]:
        """The frame we stand at, `(n_atoms, 3)` nm, in the scene's atom order and place."""
        frame: npt.NDArray[np.float32] = self._current[self._back] + self._centre.astype(np.float32)
        return frame

    def step(self, steps: int) -> None:
        """Advance `steps` frames; reporters are called when they are due, as OpenMM does.

        Raises SimulationError when the coordinates become NaN or infinite.
        """
        end = self.currentStep + int(steps)
        while self.currentStep < end:
            asked = [reporter.describeNextReport(self) for reporter in self.reporters]
            # A dictionary, or, of MDTraj's and older reporters, a tuple.
            due = [wanted["steps"] if isinstance(wanted, dict) else wanted[0] for wanted in asked]
            ahead = min([end - self.currentStep, *(steps for steps in due if steps > 0)])
            self._advance(ahead)
            for reporter, steps in zip(self.reporters, due, strict=True):
                if steps == ahead:
                    reporter.report(self, self.state())

    def saveCheckpoint(self, file: str | Path | BinaryIO) -> None:
        """Write where the simulation stands to a path or a binary file, all random numbers to come included."""
        arrays = {"last": self._last, "current": self._current, "pending": self._pending, "centre": self._centre}
        if self._velocities is not None:
            arrays["velocities"] = self._velocities
        arrays["counts"] = np.array([self.currentStep, self._chunks, self._frames])
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, settings=np.array(self._settings()), **arrays)
        if isinstance(file, str | Path):
            create_whole(Path(file), buffer.getvalue())
        else:
            file.write(buffer.getvalue())

    def loadCheckpoint(self, file: str | Path | BinaryIO) -> None:
        """Go back to where a checkpoint was saved; what follows is the same bit for bit.

        Raises InputError when it is damaged, or of another scene, other weights or settings; nothing changes then.
        """
        name = str(file) if isinstance(file, str | Path) else "the checkpoint"
        try:
            arrays = arrays_in(file)
            settings, counts = arrays["settings"].tolist(), arrays["counts"].tolist()
            last, current, pending, centre = (arrays[key] for key in ("last", "current", "pending", "centre"))
        except UNREADABLE as error:
            raise InputError(f"{name} cannot be read as a checkpoint ({first_line(error)}); take another.") from error
        if differs := [f"{a}, not {b}" for a, b in zip(settings, self._settings(), strict=True) if a != b]:
            raise InputError(f"{name} was saved with {differs[0]}.")
        self._last, self._current, self._pending, self._centre = last, current, pending, centre
        self._velocities = arrays.get("velocities")
        self.currentStep, self._chunks, self._frames = counts

    def _settings(self) -> list[str]:
        """Return what a checkpoint must have been saved with, a text each."""
        sampler = self._sampler
        return [
            f"seed = {self._seed}", f"lag_ps = {self.lag_ps}", f"weights {self.weights.hash}",
            f"topology {self.scene.topology_hash}", f"solver = {sampler.solver!r}, {sampler.solver_steps} steps",
            f"precision = {sampler.precision.name}",
        ]  # fmt: skip

    minimizeEnergy = _lacks("energy to minimise; prepare the scene, or minimise it with OpenMM")

    def _begin(self, positions_nm: npt.ArrayLike) -> None:
        """Start from positions `(n_atoms, 3)` nm in the scene's order; what was drawn ahead is dropped."""
        start = np.asarray(positions_nm, dtype=np.float64)
        if start.shape != (self.scene.n_atoms, 3) or not np.isfinite(start).all():
            raise InputError(f"positions must be {self.scene.n_atoms} x 3 finite numbers, not {start.shape}.")
        # About the centre, as `rollout` has them: a molecule far from the origin keeps its digits.
        self._centre = start.mean(axis=0)
        self._current = (start - self._centre).astype(np.float32)[self._order]
        self._last = np.repeat(self._current[None], self._sampler.n_conditioning, axis=0)
        self._velocities = None
        self._pending = np.empty((0, self.scene.n_atoms, 3), dtype=np.float32)

    def _restart(self, positions_nm: npt.NDArray[np.float64]) -> None:
        """Start anew where a rollout may begin. Raises OutOfDomainError."""
        if positions_nm.shape == (self.scene.n_atoms, 3) and np.isfinite(positions_nm).all():
            self.deviations = match_domain(
                self.scene.with_positions(positions_nm), self.weights, force=self._force
            ).deviations
        self._begin(positions_nm)

    def _advance(self, n_frames: int) -> None:
        left = n_frames
        while left > 0:
            if not len(self._pending):
                self._draw()
            taken = min(left, len(self._pending))
            self._current, self._pending = self._pending[taken - 1], self._pending[taken:]
            self.currentStep += taken
            self._frames += taken
            left -= taken

    def _draw(self) -> None:
        given = None if self._velocities is None else self._velocities[None]
        drawn = self._sampler.draw(self._last[None], [noise_seed(self._seed, 0, self._chunks)], given)
        frames = drawn.frames_nm[0].astype(np.float32)
        if not np.isfinite(frames).all():
            raise SimulationError(
                f"{BLOWN_UP} after {self._frames * self.lag_ps:g} ps; try precision 'fp32' or other weights."
            )
        self._pending = frames
        self._last = frames[-self._sampler.n_conditioning :]
        ends = drawn.velocities_nm_ps
        self._velocities = None if ends is None else ends[0].astype(np.float32)
        self._chunks += 1

    def state(self) -> SurrogateState:
        """Return a snapshot of where the simulation stands."""
        return SurrogateState(self.positions_nm, self._frames * self.lag_ps, self.currentStep)


class SurrogateIntegrator:
    """What reporters ask an OpenMM integrator for."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation

    def getStepSize(self) -> Any:
        """Return the time between two frames, with its unit."""
        from openmm import unit

        return self._simulation.lag_ps * unit.picoseconds

    def step(self, steps: int) -> None:
        """Advance without reporters, as OpenMM's integrators do."""
        self._simulation._advance(int(steps))


class SurrogateContext:
    """What reporters and scripts ask an OpenMM context for."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation

    def getState(self, **wanted: Any) -> SurrogateState:
        """Return a snapshot, whatever is asked for; what a surrogate lacks raises when the state is asked for it."""
        return self._simulation.state()

    def getIntegrator(self) -> SurrogateIntegrator:
        return self._simulation.integrator

    def getSystem(self) -> Any:
        return self._simulation.system

    def getTime(self) -> Any:
        return self.getState().getTime()

    def getStepCount(self) -> int:
        return self._simulation.currentStep

    def setPositions(self, positions: Any) -> None:
        """Start anew from positions `(n_atoms, 3)`, in nm where they have no unit; what was drawn ahead is dropped.
        Raises OutOfDomainError as the constructor does: for another stereoisomer, without `force` a strained start.
        """
        from openmm import unit

        if unit.is_quantity(positions):
            positions = positions.value_in_unit(unit.nanometer)
        self._simulation._restart(np.array([tuple(row) for row in positions], dtype=np.float64))


# A learned potential as other programs take it: a function of positions, an OpenMM force, an ASE calculator.

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
        if not isinstance(loaded.model, Potential):
            raise InputError(
                f"{loaded.path.name} makes frames, not forces ({loaded.model.arch}); train a potential with "
                "`level='gfn2-xtb'`."
            )
        self.scene, self.weights, self._model = scene, loaded, loaded.model.eval()
        match = match_domain(scene, loaded)
        self._order = match.order
        self._back = np.argsort(self._order)
        self._molecule = Molecule.of(match.domain.scene)

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
            raise InputError(f"a learned force needs OpenMM's PythonForce; {openmm.__version__} has none, update it.")

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
                per_angstrom = NM_PER_ANGSTROM / KJ_MOL_PER_EV
                self.results = {"energy": energy / KJ_MOL_PER_EV, "forces": forces * per_angstrom}

        return Learned()
