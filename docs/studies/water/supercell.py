"""Alanine dipeptide in TIP3P by OpenMM on a GPU: many cells side by side in one periodic cell, whose images move apart.

    python docs/studies/water/supercell.py make FOLDER [--times 3]        # system.xml, state.npz: 27 cells of 985 atoms
    python docs/studies/water/supercell.py run FOLDER --seconds 150       # needs OpenMM and NumPy alone
    python docs/studies/water/supercell.py files FOLDER                   # each solute's trajectory: solute_r*.h5

The System of one cell is that of `alanine_dipeptide.py`, repeated: same cutoff, same tolerance of PME. A GPU that
takes 2,000 steps a second of 985 atoms takes nearly as many of 27 times as many, and none of the solutes meets its
own image.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from itertools import product
from pathlib import Path

import numpy as np
import openmm
from openmm import unit

TEMPERATURE_K, FRICTION_PER_PS, STEP_PS, SAVE_PS = 300.0, 1.0, 0.004, 1.0


def repeated(system: openmm.System, times: int) -> openmm.System:
    """Return the System of `times` cells along each edge."""
    many, n, cells = openmm.System(), system.getNumParticles(), times**3
    many.setDefaultPeriodicBoxVectors(*(times * v for v in system.getDefaultPeriodicBoxVectors()))
    for _ in range(cells):
        for k in range(n):
            many.addParticle(system.getParticleMass(k))
    for cell in range(cells):
        for k in range(system.getNumConstraints()):
            i, j, length = system.getConstraintParameters(k)
            many.addConstraint(i + cell * n, j + cell * n, length)
    # Of each kind of force: how a term is read and added, and how many of what is read are atoms.
    terms = {
        "HarmonicBondForce": [("Bond", 2)],
        "HarmonicAngleForce": [("Angle", 3)],
        "PeriodicTorsionForce": [("Torsion", 4)],
        "NonbondedForce": [("Particle", 0), ("Exception", 2)],
    }
    for force in system.getForces():
        if force.getName() == "CMMotionRemover":
            many.addForce(openmm.CMMotionRemover(force.getFrequency()))
            continue
        copy = openmm.XmlSerializer.clone(force)
        for cell, (kind, n_atoms) in product(range(1, cells), terms[force.getName()]):
            for k in range(getattr(force, f"getNum{kind}s")()):
                found = getattr(force, f"get{kind}Parameters")(k)
                atoms = [atom + cell * n for atom in found[:n_atoms]]
                getattr(copy, f"add{kind}")(*atoms, *found[n_atoms:])
        many.addForce(copy)
    return many


def make(given: argparse.Namespace) -> None:
    """Prepare one cell, which `alanine_dipeptide.py simd` takes, too, let it settle for 10 ps, and repeat it."""
    from md_reference.forces.forcefield import build_system
    from md_reference.forces.solvation import solvate
    from md_reference.forces.spec import ForceFieldSpec, WaterBox
    from md_reference.run.config import Conditions
    from md_reference.run.engine import Engine
    from systems.library.named_scenes import prepare

    dry, spec = prepare("alanine-dipeptide"), ForceFieldSpec("ff14SB", "tip3p")
    scene = solvate(dry, spec, WaterBox())
    system = build_system(scene, spec)
    with Engine(scene, Conditions(force=spec, platform="CPU", seed=1), system=system) as engine:
        engine.minimise(max_iterations=500)
        engine.thermalise()
        engine.step(2_500)
        x, energy = engine.positions(), engine.energy()
    edges = np.array([v.value_in_unit(unit.nanometer) for v in system.getDefaultPeriodicBoxVectors()])
    cells = np.array(list(product(range(given.times), repeat=3))) @ edges
    many, x = repeated(system, given.times), cells[:, None] + x
    context = openmm.Context(many, openmm.VerletIntegrator(STEP_PS), openmm.Platform.getPlatform("CPU"))
    context.setPositions(x.reshape(-1, 3))
    of_many = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    given.folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(given.folder / "state.npz", x=x, n_solute=dry.n_atoms)
    (given.folder / "system.xml").write_text(openmm.XmlSerializer.serialize(many))
    (given.folder / "solute.json").write_text(json.dumps(dry.to_dict()))
    (given.folder / "scene.json").write_text(json.dumps(scene.to_dict()))
    sys.stdout.write(f"{len(x)} cells of {scene.n_atoms} atoms, {of_many / len(x):.2f} kJ/mol each; one {energy:.2f}\n")


def run(given: argparse.Namespace) -> None:
    """Write solutes.npz: `x` (frames, cells, solute atoms, 3) nm, unwrapped, `SAVE_PS` apart."""
    began = time.monotonic()
    system = openmm.XmlSerializer.deserialize((given.folder / "system.xml").read_text())
    with np.load(given.folder / "state.npz") as state:
        x, n_solute = state["x"], int(state["n_solute"])
    integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE_K, FRICTION_PER_PS, STEP_PS)
    integrator.setRandomNumberSeed(given.seed)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform(given.platform))
    context.setPositions(x.reshape(-1, 3))
    context.setVelocitiesToTemperature(TEMPERATURE_K, given.seed)
    frames, started = [], time.monotonic()
    while time.monotonic() - began < given.seconds:
        integrator.step(round(SAVE_PS / STEP_PS))
        now = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
        frames.append(now.reshape(x.shape)[:, :n_solute].astype(np.float32))
    spent = time.monotonic() - started
    kinetic = context.getState(energy=True).getKineticEnergy().value_in_unit(unit.kilojoule_per_mole)
    n_dof = 3 * (system.getNumParticles() - 1) - system.getNumConstraints()
    kelvin = 2.0 * kinetic / n_dof / unit.MOLAR_GAS_CONSTANT_R.value_in_unit(unit.kilojoule_per_mole / unit.kelvin)
    np.savez_compressed(given.folder / "solutes.npz", x=np.array(frames))
    ns_a_day = len(frames) * SAVE_PS * 86.4 / spent
    sys.stdout.write(f"{given.platform}: {len(x)} x {len(frames) * SAVE_PS:g} ps in {spent:.0f} s, {ns_a_day:.0f} ns a "
                     f"day and cell; {kelvin:.1f} K\n")  # fmt: skip


def files(given: argparse.Namespace) -> None:
    """Write each solute's trajectory."""
    from systems.scene import Scene
    from systems.trajectory.codec import open_writer

    scene = Scene.from_dict(json.loads((given.folder / "solute.json").read_text()))
    with np.load(given.folder / "solutes.npz") as data:
        x = data["x"]
    for k in range(x.shape[1]):
        with open_writer(given.folder / f"solute_r{k}.h5", scene, {"temperature_k": TEMPERATURE_K}) as writer:
            writer.append(x[:, k], SAVE_PS * (1.0 + np.arange(len(x))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make", "run", "files"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--times", type=int, default=3, help="cells along each edge")
    parser.add_argument("--seconds", type=float, default=150.0)
    parser.add_argument("--platform", default="OpenCL")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    {"make": make, "run": run, "files": files}[given.what](given)


if __name__ == "__main__":
    main()
