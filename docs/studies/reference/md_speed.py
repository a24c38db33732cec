"""Our OpenMM set-up against OpenMM's plain defaults: same model, time step and cores, timed in turn.

    python docs/studies/reference/md_speed.py [--quick] [--case NAME] [-o FILE]      # on an idle machine

Ours runs one replica on each core. OpenMM's defaults run in two ways, and the faster counts: one simulation on all
cores, which is what it does unasked, and one simulation per core with one thread each, which it must be told. Each
round times all of them, every other round in reverse; ratios are taken within a round. What is timed is integration
alone, without files. 4 fs with hydrogens of 3 Da stands apart: it is another integration of the same model.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import signal
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.spec import PROTEIN_FILES, ForceFieldSpec, WaterBox, cutoff_nm, water_file
from md_reference.run.config import Conditions
from md_reference.run.machine import available_cores, platform_for, platform_properties
from surrogate.bench.timing import machine_facts
from systems.errors import InputError, SimulationError, SurromdError, first_line, nearest
from systems.files.whole_file import create_whole
from systems.interrupts import end_with_parent
from systems.scene import Scene
from systems.units import parse_wall_s

LONG_TIMESTEP_PS, HYDROGEN_MASS_DA = 0.004, 3.0
TEMPERATURE_K, FRICTION_PER_PS, TIMESTEP_PS = 300.0, 1.0, 0.002  # of `plain_context`, too

MODES = ("ours", "plain, all cores", "plain, one a core", "ours, 4 fs and 3 Da")
_OURS, _ALL_CORES, _PER_CORE, _LONG = MODES
_N_ENERGIES = 5
# Single precision sums, and PME's error between two runs of its own.
_ENERGY_RELATIVE, _ENERGY_ABSOLUTE_KJ_MOL = 2e-5, 0.02


@dataclass(frozen=True)
class Case:
    """A scene in a solvent. `padding_nm` makes the box of explicit water."""

    name: str
    scene: str
    solvent: str
    force_field: str = "ff14SB"
    padding_nm: float = 1.0

    def prepared(self) -> Scene:
        """Return the scene, solvated where the solvent is explicit. Raises PreparationError."""
        from systems.library.named_scenes import prepare

        scene = prepare(self.scene)
        if not self.spec().is_explicit:
            return scene
        from md_reference.forces.solvation import solvate

        return solvate(scene, self.spec(), WaterBox(padding_nm=self.padding_nm))

    def spec(self, *, repartitioned: bool = False) -> ForceFieldSpec:
        """Return the force field; hydrogens keep their natural mass unless `repartitioned`."""
        mass = HYDROGEN_MASS_DA if repartitioned else None
        return ForceFieldSpec(force_field=self.force_field, solvent=self.solvent, hydrogen_mass_da=mass)


_PEPTIDES = (
    ("ACE-ALA-NME", "alanine-dipeptide"),
    ("ACE-ALA-GLY5-NME", "sequence:ACE-ALA-GLY-GLY-GLY-GLY-GLY-NME"),
    ("CLN025", "sequence:YYDPETGTWY"),
    ("ACE-ALA99-NME", "sequence:ACE-" + "ALA-" * 99 + "NME"),
)
CASES = (
    *(Case("ethanol", "ethanol", solvent, "gaff2") for solvent in ("vacuum", "obc2")),
    *(Case(name, scene, solvent) for name, scene in _PEPTIDES for solvent in ("vacuum", "obc2")),
    Case("ACE-ALA-NME", "alanine-dipeptide", "tip3p"),
)


@dataclass(frozen=True)
class Row:
    """One scene in one solvent. Speeds in ns/day of all cores together, ratios within rounds: median, least, greatest.

    `ratio` is ours over the faster of OpenMM's two ways, `speed_up_long_step` ours at 4 fs over ours at 2 fs.
    `processor_ratio`: ours over OpenMM's with one thread, by processor time, which other work on the machine hardly
    changes (None on a device). `energy_gap`: the largest difference in kJ/mol over five frames, and `force_gap` the
    largest relative difference of all forces.
    """

    case: str
    solvent: str
    n_atoms: int
    ours: str
    plain: str
    ns_per_day: dict[str, float]
    ratio: tuple[float, float, float]
    speed_up_long_step: tuple[float, float, float]
    processor_ratio: float | None
    energy_kj_mol: float
    energy_gap: float
    force_gap: float
    equal_energies: bool


@dataclass(frozen=True)
class Setup:
    """A Context ready to run, and in words what it is."""

    context: Any
    platform: str
    threads: str
    timestep_ps: float


def plain_context(scene: Scene, spec: ForceFieldSpec, *, threads: int | None) -> Any:
    """Return an `openmm.Context` of what OpenMM's manual makes of the model: its files, its defaults, 300 K, 1/ps, 2
    fs, the platform it picks by itself.

    `threads`: of the CPU platform where that is picked; None leaves its default, all cores.
    """
    from openmm import LangevinMiddleIntegrator, Platform, app

    topology, system = scene.to_openmm_topology(), plain_system(scene, spec)
    simulation = app.Simulation(topology, system, LangevinMiddleIntegrator(300.0, 1.0, 0.002))
    if threads is not None and simulation.context.getPlatform().getName() == "CPU":
        chosen = Platform.getPlatform("CPU"), {"Threads": str(threads)}
        simulation = app.Simulation(topology, system, LangevinMiddleIntegrator(300.0, 1.0, 0.002), *chosen)
    return simulation.context


def plain_system(scene: Scene, spec: ForceFieldSpec) -> Any:
    """Return the `openmm.System` by OpenMM's own way: its XML files, or for GAFF2 its reader of the same prmtop.

    Bonds to hydrogen are rigid, as a step of 2 fs needs; all else is default, the removal of the centre of mass's
    motion included.
    """
    from openmm import app, unit

    rigid = {"constraints": app.HBonds}
    if spec.force_field == "gaff2":
        from md_reference.forces import gaff

        implicit = {"implicitSolvent": app.OBC2} if spec.solvent == "obc2" else {}
        return gaff.entry(scene).system(scene, nonbondedMethod=app.NoCutoff, **rigid, **implicit)
    files = [PROTEIN_FILES[spec.force_field]]
    box: dict[str, Any] = {"nonbondedMethod": app.NoCutoff}
    if spec.solvent == "obc2":
        files.append("implicit/obc2.xml")
    elif spec.is_explicit:
        files.append(str(water_file(spec.force_field, spec.solvent)))
        box = {"nonbondedMethod": app.PME, "nonbondedCutoff": cutoff_nm(spec.force_field)[0] * unit.nanometer}
    topology = scene.to_openmm_topology()
    if scene.cell_nm is not None:
        topology.setPeriodicBoxVectors(scene.cell_nm * unit.nanometer)
    return app.ForceField(*files).createSystem(topology, **rigid, **box)


def plain(scene: Scene, spec: ForceFieldSpec, *, threads: int | None) -> Setup:
    """Return what OpenMM's manual makes of the model, and what it runs on."""
    context = plain_context(scene, spec, threads=threads)
    platform = context.getPlatform()
    is_cpu = platform.getName() == "CPU"
    used = platform.getPropertyValue(context, "Threads") if is_cpu else "1"
    return Setup(context, platform.getName(), used, TIMESTEP_PS)


def ours(case: Case, scene: Scene, *, repartitioned: bool = False) -> Setup:
    """Return our set-up of one replica out of one per core."""
    import openmm

    spec = resolve(scene, case.spec(repartitioned=repartitioned))
    step_ps = LONG_TIMESTEP_PS if repartitioned else TIMESTEP_PS
    system = build_system(scene, spec)
    choice = platform_for(scene, Conditions(force=spec, timestep_ps=step_ps))
    properties = platform_properties(choice.name, choice.threads)
    integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE_K, FRICTION_PER_PS, step_ps)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform(choice.name), properties)
    return Setup(context, choice.name, str(choice.threads), step_ps)


def run_benchmark(
    cases: Sequence[Case] = CASES,
    *,
    rounds: int = 7,
    seconds: float = 3.0,
    cores: int | None = None,
    report: Callable[[Row], None] | None = None,
    skipped: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Return the benchmark's rows with the machine they hold for (JSON-able); `report` sees each row as it is done.

    Each of `rounds` times every set-up for `seconds`. A case that cannot be set up is told to `skipped`, in one line.
    """
    n = cores or available_cores()
    rows: list[Row] = []
    left_out: list[str] = []
    machine = machine_facts() | {"cores_used": n}
    with _Workers(n) as workers:
        for case in cases:
            try:
                rows.append(_run_case(workers, case, rounds, seconds))
            except SurromdError as error:
                left_out.append(f"{case.name} in {case.solvent}: {error}")
                if skipped is not None:
                    skipped(left_out[-1])
                continue
            if report is not None:
                report(rows[-1])
    return {"machine": machine, "rounds": rounds, "seconds": seconds, "rows": [asdict(r) for r in rows],
            "left_out": left_out}  # fmt: skip


def select_cases(names: Sequence[str] | None, *, quick: bool = False) -> tuple[Case, ...]:
    """Return the cases of these names (all where None); `quick` keeps the three smallest sizes.

    Raises InputError for a name that no case has.
    """
    known = list(dict.fromkeys(case.name for case in CASES))
    for name in names or []:
        if name not in known:
            raise InputError(f"no case is called {name!r}; known: {', '.join(known)}.{nearest(name, known)}")
    chosen = known[:3] if quick and not names else list(names or known)
    return tuple(c for c in CASES if c.name in chosen and not (quick and c.spec().is_explicit))


def _run_case(workers: _Workers, case: Case, rounds: int, seconds: float) -> Row:
    facts = workers.build(case)
    gaps = workers.ask(0, "compare")
    speeds: dict[str, list[float]] = {mode: [] for mode in MODES}
    by_processor: dict[str, list[float]] = {mode: [] for mode in MODES}
    for number in range(rounds):
        for mode in MODES if number % 2 == 0 else MODES[::-1]:
            by_wall, by_cpu = workers.speed(mode, seconds)
            speeds[mode].append(by_wall)
            by_processor[mode].append(by_cpu)
    on_device = not all(facts[mode].startswith(("CPU", "Reference")) for mode in (_OURS, _PER_CORE))
    best = [max(a, b) for a, b in zip(speeds[_ALL_CORES], speeds[_PER_CORE], strict=True)]
    return Row(
        case=case.name,
        solvent=case.solvent,
        n_atoms=facts["n_atoms"],
        ours=facts[_OURS],
        plain=f"{facts[_ALL_CORES]}; {facts[_PER_CORE]}",
        ns_per_day={mode: statistics.median(values) for mode, values in speeds.items()},
        ratio=_spread(speeds[_OURS], best),
        speed_up_long_step=_spread(speeds[_LONG], speeds[_OURS]),
        # The best of each: a processor shared with others has colder caches, never faster ones.
        processor_ratio=None if on_device else max(by_processor[_OURS]) / max(by_processor[_PER_CORE]),
        **gaps,
    )


def _spread(above: list[float], below: list[float]) -> tuple[float, float, float]:
    ratios = [a / b for a, b in zip(above, below, strict=True)]
    return statistics.median(ratios), min(ratios), max(ratios)


# ---- one process per core ------------------------------------------------------------------------------------------


class _Workers:
    """One process per core, each with its own Context of every set-up; they run at the same time or wait."""

    def __init__(self, n: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipes: list[Any] = []
        self._processes: list[Any] = []
        for k in range(n):
            here, there = context.Pipe()
            process = context.Process(target=_serve, args=(there, k, n), name=f"bench-{k}", daemon=True)
            process.start()
            there.close()
            self._pipes.append(here)
            self._processes.append(process)

    def __enter__(self) -> _Workers:
        return self

    def __exit__(self, *_: object) -> None:
        for pipe in self._pipes:
            pipe.close()
        for process in self._processes:
            process.join(timeout=5)
            process.terminate()

    def build(self, case: Case) -> dict[str, Any]:
        """Set the case up everywhere. Raises SimulationError with the reason of the worker that could not."""
        facts = self._all("build", case)
        return dict(facts[0])

    def speed(self, mode: str, seconds: float) -> tuple[float, float]:
        """Return ns/day of all simulations of a mode together, and the best one's by a day of processor time."""
        answers = [self.ask(0, "run", mode, seconds)] if mode == _ALL_CORES else self._all("run", mode, seconds)
        return float(sum(wall for wall, _ in answers)), float(max(cpu for _, cpu in answers))

    def ask(self, worker: int, *message: Any) -> Any:
        self._pipes[worker].send(message)
        return self._answer(worker)

    def _all(self, *message: Any) -> list[Any]:
        for pipe in self._pipes:
            pipe.send(message)
        answers = []
        failure: SurromdError | None = None
        for k in range(len(self._pipes)):
            try:
                answers.append(self._answer(k))
            except SurromdError as error:
                failure = error
        if failure is not None:
            raise failure
        return answers

    def _answer(self, worker: int) -> Any:
        try:
            kind, value = self._pipes[worker].recv()
        except EOFError:
            raise SimulationError(f"worker {worker} of the benchmark died; look for a lack of memory.") from None
        if kind == "error":
            raise SimulationError(value)
        return value


def _serve(pipe: Any, number: int, n_workers: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the parent, which ends its workers
    end_with_parent()
    setups: dict[str, Setup] = {}
    while True:
        try:
            verb, *arguments = pipe.recv()
        except EOFError:
            return
        try:
            if verb == "build":
                setups.clear()
                answer: Any = _build(setups, arguments[0], number, n_workers)
            elif verb == "compare":
                answer = _compare(setups)
            else:
                answer = _run(setups[arguments[0]], arguments[1])
            pipe.send(("done", answer))
        except Exception as error:
            pipe.send(("error", first_line(error)))


def _build(setups: dict[str, Setup], case: Case, number: int, n_workers: int) -> dict[str, Any]:
    import openmm

    scene = case.prepared()
    setups[_OURS] = ours(case, scene)
    setups[_LONG] = ours(case, scene, repartitioned=True)
    setups[_PER_CORE] = plain(scene, case.spec(), threads=1)
    if number == 0:
        setups[_ALL_CORES] = plain(scene, case.spec(), threads=None)
    first = setups[_OURS].context
    first.setPositions(scene.positions_nm)
    openmm.LocalEnergyMinimizer.minimize(first, maxIterations=200)
    positions = first.getState(positions=True).getPositions()
    for setup in setups.values():
        setup.context.setPositions(positions)
        setup.context.setVelocitiesToTemperature(300.0, 1 + number)
        setup.context.getIntegrator().step(2)
    said = {name: f"{s.platform}, {s.threads} thread{'' if s.threads == '1' else 's'}" for name, s in setups.items()}
    return {"n_atoms": scene.n_atoms, **said}


def _run(setup: Setup, seconds: float) -> tuple[float, float]:
    """Return ns/day of one simulation, by the wall clock and by processor time."""
    integrator = setup.context.getIntegrator()
    began = time.perf_counter()
    integrator.step(1)
    batch = max(1, round(0.05 / max(time.perf_counter() - began, 1e-6)))
    taken, began, began_cpu = 0, time.perf_counter(), time.process_time()
    while (wall := time.perf_counter() - began) < seconds or not taken:
        integrator.step(batch)
        setup.context.getState(energy=batch == 1)  # a device works on after `step` has returned
        taken += batch
    ns_a_day = taken * setup.timestep_ps * 1e-3 * 86_400.0
    return ns_a_day / wall, ns_a_day / max(time.process_time() - began_cpu, 1e-9)


def _compare(setups: dict[str, Setup]) -> dict[str, Any]:
    """Compare energies and forces of both set-ups at frames of ours, each on the platform that it runs on."""
    mine, theirs = setups[_OURS].context, setups[_PER_CORE].context
    gaps, forces_apart, energy = [], [], 0.0
    for _ in range(_N_ENERGIES):
        mine.getIntegrator().step(50)
        state = mine.getState(positions=True, energy=True, forces=True)
        theirs.setPositions(state.getPositions())
        other = theirs.getState(energy=True, forces=True)
        energy = float(state.getPotentialEnergy()._value)
        gaps.append(abs(energy - float(other.getPotentialEnergy()._value)))
        a, b = (np.asarray(s.getForces(asNumpy=True)._value) for s in (state, other))
        forces_apart.append(float(np.linalg.norm(a - b) / np.linalg.norm(a)))
    return {
        "energy_kj_mol": energy,
        "energy_gap": max(gaps),
        "force_gap": max(forces_apart),
        "equal_energies": max(gaps) <= _ENERGY_RELATIVE * abs(energy) + _ENERGY_ABSOLUTE_KJ_MOL,
    }


# ---- what is printed -----------------------------------------------------------------------------------------------


def table_head() -> str:
    """Return the heading of `table_line`."""
    columns = f"{'scene':<18}{'atoms':>6} {'solvent':<8}{'ours':>9}{'plain':>9}{'a core':>9}  {'ratio':<20}"
    return f"{columns}{'by cpu':<9}{'with 4 fs':<11}{'energy gap':>11}  platforms"


def table_line(row: Row) -> str:
    """Return one line: ns/day of ours, plain on all cores and plain one a core; the ratio with its extremes."""
    speeds = "".join(f"{row.ns_per_day[mode]:>9.4g}" for mode in (_OURS, _ALL_CORES, _PER_CORE))
    ratio = f"{row.ratio[0]:.2f} [{row.ratio[1]:.2f}, {row.ratio[2]:.2f}]"
    by_cpu = "-" if row.processor_ratio is None else f"{row.processor_ratio:.2f}"
    gap = f"{row.energy_gap:.1e}" + ("" if row.equal_energies else " UNEQUAL")
    return (
        f"{row.case:<18}{row.n_atoms:>6} {row.solvent:<8}{speeds}  {ratio:<20}"
        f"{by_cpu:<9}{f'x {row.speed_up_long_step[0]:.2f}':<11}{gap:>11}  {row.ours} / {row.plain}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, help="write the result here, .json")
    parser.add_argument("--quick", action="store_true", help="three sizes, short timings: a minute or two")
    parser.add_argument("--case", action="append", help="only this scene; may be repeated")
    parser.add_argument("--rounds", type=int, help="how often each is timed [7; 3 with --quick]")
    parser.add_argument("--seconds", help="length of each timing [3s; 0.3s with --quick]")
    parser.add_argument("--cores", type=int, help="cores to use [all]")
    chosen = parser.parse_args(arguments)
    print("ns/day of all cores together; ratio: ours over the faster of OpenMM's two ways, [least, greatest]")  # noqa: T201
    print(table_head())  # noqa: T201
    try:
        result = run_benchmark(
            select_cases(chosen.case, quick=chosen.quick),
            rounds=chosen.rounds or (3 if chosen.quick else 7),
            seconds=parse_wall_s(chosen.seconds or ("0.3s" if chosen.quick else "3s"), "--seconds"),
            cores=chosen.cores,
            report=lambda row: print(table_line(row)),  # noqa: T201
            skipped=lambda line: print(f"left out: {line}", file=sys.stderr),  # noqa: T201
        )
    except SurromdError as error:
        sys.exit(f"error: {error}")
    if chosen.out is not None:
        create_whole(chosen.out, json.dumps(result, indent=1) + "\n")
    if not result["rows"] or not all(row["equal_energies"] for row in result["rows"]):
        sys.exit("error: no case ran, or energies differ: see above.")


if __name__ == "__main__":
    main()
