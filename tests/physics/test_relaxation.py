"""Frames relaxed under springs: stiff bonds come back, all else stays."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from md_reference.forces.forcefield import build_system
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine, Relaxer
from systems.errors import SimulationError
from systems.scene import Scene

SPEC = ForceFieldSpec("ff14SB", "obc2", 3.0)


@pytest.fixture(scope="module")
def engine(alanine_dipeptide: Scene) -> Iterator[Engine]:
    with Engine(alanine_dipeptide, Conditions(force=SPEC, seed=1)) as made:
        made.minimise(max_iterations=50)
        made.thermalise()
        made.step(2000)
        yield made


@pytest.fixture(scope="module")
def relaxer(alanine_dipeptide: Scene) -> Iterator[Relaxer]:
    with Relaxer(alanine_dipeptide, build_system(alanine_dipeptide, SPEC)) as made:
        yield made


def lengths(x: np.ndarray, scene: Scene) -> np.ndarray:
    return np.linalg.norm(x[scene.bonds[:, 0]] - x[scene.bonds[:, 1]], axis=1)


def test_a_stretched_bond_comes_back_and_the_rest_stays(
    engine: Engine, relaxer: Relaxer, alanine_dipeptide: Scene
) -> None:
    frame = engine.positions()
    rest = relaxer.relax(frame)
    for i, j in ((4, 1), (2, 1), (6, 4)):  # C-CH3, a constrained H-CH3, N-C
        broken = frame.copy()
        broken[i] += 0.06 * (frame[i] - frame[j]) / np.linalg.norm(frame[i] - frame[j])
        found = relaxer.relax(broken)
        off = np.abs(lengths(found, alanine_dipeptide) - lengths(rest, alanine_dipeptide))
        assert np.abs(lengths(broken, alanine_dipeptide) - lengths(frame, alanine_dipeptide)).max() > 0.055
        assert off.max() < 0.002
        assert np.linalg.norm(found - broken, axis=1).max() < 0.1
        assert abs(engine.energy(found) - engine.energy(rest)) < 8.0
    engine.set_positions(frame)


def test_thermal_energy_of_bonds_and_angles_is_gone(engine: Engine, relaxer: Relaxer) -> None:
    frame = engine.positions()
    before = engine.energy()
    assert engine.energy(relaxer.relax(frame)) < before - 10.0
    engine.set_positions(frame)


def test_relaxing_keeps_the_conformation(engine: Engine, relaxer: Relaxer) -> None:
    """Torsions stay within 15 degrees; a minimisation without springs turns at least one of some frames farther."""
    from systems.chemistry.geometry import torsion

    quads = np.array([[4, 6, 8, 14], [6, 8, 14, 16]])
    moved, free = [], []
    frame = engine.positions()
    for _ in range(4):
        engine.set_positions(frame)
        engine.thermalise()
        engine.step(500)
        frame = engine.positions()
        engine.minimise()
        for into, x in ((moved, relaxer.relax(frame)), (free, engine.positions())):
            change = torsion(x, quads) - torsion(frame, quads)
            into.append(np.abs((change + np.pi) % (2 * np.pi) - np.pi).max())
    assert np.rad2deg(max(moved)) < 15.0
    assert np.rad2deg(max(free)) > 2 * np.rad2deg(max(moved))


def test_what_is_beyond_repair_is_said_in_one_line(relaxer: Relaxer, alanine_dipeptide: Scene) -> None:
    lost = alanine_dipeptide.positions_nm.copy()
    lost[3] = np.nan
    with pytest.raises(SimulationError, match="not finite"):
        relaxer.relax(lost)
    on_top = np.zeros_like(lost)
    with pytest.raises(SimulationError, match="finite"):
        relaxer.relax(on_top)
    # And the relaxer still works.
    assert np.isfinite(relaxer.relax(alanine_dipeptide.positions_nm)).all()
