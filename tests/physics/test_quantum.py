"""GFN2-xTB through OpenMM: units, signs, charges and spins, refusals."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import surrogate as sm
from md_reference.forces.forcefield import resolve
from md_reference.forces.quantum import KJ_MOL_PER_HARTREE, NM_PER_BOHR, Potential, build_quantum_system
from md_reference.forces.spec import ForceFieldSpec, at_level
from md_reference.run.config import Conditions, resolve_settings
from md_reference.run.engine import Engine, Relaxer
from systems.errors import InputError, PreparationError, UnknownNameError
from systems.library.named_scenes import load
from systems.prepare.molecule import scene_from_smiles
from systems.scene import FloatArray, Scene
from systems.trajectory.codec import open_trajectory

pytest.importorskip("tblite")
SPEC = ForceFieldSpec("gfn2-xtb", "vacuum", None, constrain_hydrogens=False)


def test_energy_is_tblites_own_in_kj_mol_and_its_forces_are_minus_the_gradient() -> None:
    from tblite.interface import Calculator

    scene = scene_from_smiles("CO")
    x = scene.positions_nm + 0.004 * np.random.default_rng(0).normal(size=scene.positions_nm.shape)
    numbers = np.array([{"H": 1, "C": 6, "O": 8}[e] for e in scene.elements])
    own = Calculator("GFN2-xTB", numbers, x / NM_PER_BOHR)
    own.set("verbosity", 0)
    result = own.singlepoint()
    with Engine(scene, Conditions(force=SPEC, platform="Reference", timestep_ps=0.0005)) as engine:
        energy, forces = engine.energy(x), engine.forces(x)
        assert energy == pytest.approx(float(result.get("energy")) * 2625.4996394799, rel=1e-10)
        # Methanol in GFN2-xTB: -8.22 hartree; a wrong unit is off by orders of magnitude.
        assert energy / KJ_MOL_PER_HARTREE == pytest.approx(-8.2, abs=0.1)
        step = 1e-5
        for atom, axis in ((0, 0), (1, 2), (3, 1)):
            ends = []
            for sign in (1, -1):
                moved = x.copy()
                moved[atom, axis] += sign * step
                ends.append(engine.energy(moved))
            numeric = -(ends[0] - ends[1]) / (2 * step)
            assert forces[atom, axis] == pytest.approx(numeric, rel=2e-3, abs=1.0)
        scale = np.abs(forces).max()
        assert scale > 100.0
        # No net force on a free molecule.
        np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=1e-3 * scale)


def test_forces_depend_on_positions_alone() -> None:
    """Not on what was computed before, so that a resumed run repeats an undisturbed one."""
    scene = scene_from_smiles("CO")
    fresh, used = Potential(scene), Potential(scene)
    x = scene.positions_nm
    for shift in (0.01, -0.02):
        used(x * (1.0 + shift))
    (energy, forces), (again, forces_again) = fresh(x), used(x)
    assert energy == again
    np.testing.assert_array_equal(forces, forces_again)


def test_charge_and_unpaired_electrons_are_used() -> None:
    radical, anion = scene_from_smiles("[CH3]"), scene_from_smiles("[CH3-]")
    assert radical.provenance["multiplicity"] == 2
    energies = [Potential(s)(radical.positions_nm)[0] for s in (radical, anion)]
    assert abs(energies[0] - energies[1]) > 10.0


def test_masses_and_constraints_are_what_was_asked_for() -> None:
    scene = load("ethanol")
    free = build_quantum_system(scene)
    assert free.getNumConstraints() == 0
    assert [free.getParticleMass(i)._value for i in range(scene.n_atoms)] == scene.masses_da.tolist()
    spec = resolve(scene, ForceFieldSpec("gfn2-xtb", "auto", 3.0, True))
    assert spec == ForceFieldSpec("gfn2-xtb", "vacuum", 3.0, True)
    rigid = build_quantum_system(scene, hydrogen_mass_da=3.0, constrain_hydrogens=True)
    masses = np.array([rigid.getParticleMass(i)._value for i in range(scene.n_atoms)])
    assert masses.sum() == pytest.approx(scene.masses_da.sum())
    assert all(masses[[e == "H" for e in scene.elements]] == 3.0)
    assert masses.min() >= 3.0
    lengths = {}
    for k in range(rigid.getNumConstraints()):
        hydrogen, other, length = rigid.getConstraintParameters(k)
        assert scene.elements[hydrogen] == "H"
        lengths.setdefault(scene.elements[other], []).append(length._value)
    # GFN2-xTB's own rest lengths: O-H 0.096, C-H 0.109 nm.
    assert [len(lengths["O"]), len(lengths["C"])] == [1, 5]
    np.testing.assert_allclose(lengths["O"], 0.096, atol=0.001)
    np.testing.assert_allclose(lengths["C"], 0.1095, atol=0.0015)
    with pytest.raises(PreparationError, match="mass"):
        build_quantum_system(scene, hydrogen_mass_da=8.0)


def test_rigid_bonds_to_hydrogen_stay_as_they_are_at_four_fs() -> None:
    scene = scene_from_smiles("CO")
    spec = ForceFieldSpec("gfn2-xtb", "vacuum", 3.0, constrain_hydrogens=True)
    with Engine(scene, Conditions(force=spec, platform="Reference", timestep_ps=0.004)) as engine:
        engine.thermalise()
        bonds = [(i, j) for i, j in scene.bonds.tolist() if "H" in (scene.elements[i], scene.elements[j])]
        heavy = [(i, j) for i, j in scene.bonds.tolist() if (i, j) not in bonds]
        lengths = {True: [], False: []}
        for _ in range(6):
            engine.step(5)
            x = engine.positions()
            for rigid, pairs in ((True, bonds), (False, heavy)):
                lengths[rigid].append([np.linalg.norm(x[i] - x[j]) for i, j in pairs])
        assert engine.state().temperature_k < 2000.0
    assert np.ptp(lengths[True], axis=0).max() < 1e-5
    # Negative control: the bond between heavy atoms swings.
    assert np.ptp(lengths[False], axis=0).max() > 1e-4


def test_a_short_run_keeps_its_energy() -> None:
    scene = load("ethanol")
    with Engine(scene, Conditions(force=SPEC, platform="Reference", timestep_ps=0.0005, ensemble="nve")) as engine:
        engine.thermalise()
        totals, potentials = [], []
        for _ in range(5):
            engine.step(2)
            state = engine.state()
            potentials.append(state.potential_kj_mol)
            totals.append(state.potential_kj_mol + state.kinetic_kj_mol)
    assert np.ptp(totals) < 1.0
    # Negative control: what is conserved is the sum.
    assert np.ptp(potentials) > 2.0


def test_level_and_settings_go_together() -> None:
    assert at_level(None, None) is None
    assert at_level("gfn2-xtb", None) == "gfn2-xtb"
    assert at_level("mm", "ff19SB") == "ff19SB"
    with pytest.raises(InputError, match="contradicts"):
        at_level("gfn2-xtb", "ff14SB")
    with pytest.raises(InputError, match="contradicts"):
        at_level("mm", "gfn2-xtb")
    with pytest.raises(UnknownNameError, match="gfn2-xtb"):
        at_level("gfn2", None)
    scene = scene_from_smiles("CO")
    names = ("timestep_ps", "hydrogen_mass_da", "constrain_hydrogens")
    for given, expected in (
        ({}, (0.004, 3.0, True)),
        ({"timestep_ps": 0.002}, (0.002, 3.0, True)),
        ({"timestep_ps": 0.001}, (0.001, None, False)),
        ({"hydrogen_mass_da": None}, (0.0005, None, False)),
        ({"constrain_hydrogens": False}, (0.0005, None, False)),
        ({"timestep_ps": 0.002, "constrain_hydrogens": False}, (0.002, 3.0, False)),
    ):
        settings, _ = resolve_settings(scene, {"force_field": "gfn2-xtb", **given})
        assert tuple(settings[name] for name in names) == expected, given
    by_protocol, _ = resolve_settings(scene, {"force_field": "gfn2-xtb"}, "md17")
    assert tuple(by_protocol[name] for name in names) == (0.0005, None, False), "of the paper"
    with pytest.raises(InputError, match="4fs"):
        resolve_settings(scene, {"force_field": "gfn2-xtb", "timestep_ps": 0.005})


ZWITTERION = "[NH3+]CC(=O)[O-]"


@pytest.mark.parametrize("rigid", [True, False])
def test_a_zwitterion_that_vacuum_makes_neutral_is_refused_by_the_bond_that_moves(rigid: bool) -> None:
    def minimum_nm(smiles: str, solvent: str) -> tuple[Scene, FloatArray]:
        scene = scene_from_smiles(smiles)
        spec = replace(SPEC, solvent=solvent, constrain_hydrogens=rigid)
        with Engine(scene, Conditions(force=spec, platform="Reference", timestep_ps=0.0005)) as engine:
            engine.minimise()
            return scene, engine.positions()

    with pytest.raises(PreparationError, match=r"H\d moves from N1 to O\d .*`solvent='alpb-water'`") as caught:
        minimum_nm(ZWITTERION, "vacuum")
    assert "\n" not in str(caught.value)
    # The neutral form in vacuum and the zwitterion in water stay what they are.
    for smiles, solvent in (("NCC(=O)O", "vacuum"), (ZWITTERION, "alpb-water")):
        scene, at = minimum_nm(smiles, solvent)
        i, j = scene.bonds[np.array([scene.elements[i] == "N" and scene.elements[j] == "H" for i, j in scene.bonds])].T
        assert (np.linalg.norm(at[i] - at[j], axis=1) < 0.112).all()


def test_water_by_alpb_stabilises_ions_and_is_of_this_level_alone() -> None:
    for smiles, least, most in ((ZWITTERION, 60.0, 300.0), ("C", -20.0, 20.0)):
        scene = scene_from_smiles(smiles)
        dry, wet = (Potential(scene, solvent)(scene.positions_nm)[0] for solvent in ("vacuum", "alpb-water"))
        assert least < dry - wet < most, smiles
    copied = pickle.loads(pickle.dumps(Potential(scene, "alpb-water")))
    assert copied(scene.positions_nm)[0] == pytest.approx(wet, abs=1e-6)
    with pytest.raises(PreparationError, match="gfn2-xtb"):
        ForceFieldSpec("ff14SB", "alpb-water")
    with pytest.raises(PreparationError, match="give alpb-water, vacuum"):
        ForceFieldSpec("gfn2-xtb", "obc2")


def test_impossible_electrons_are_refused() -> None:
    scene = scene_from_smiles("CO")
    wrong = replace(scene, provenance=scene.provenance | {"multiplicity": 2})
    with pytest.raises(PreparationError, match="unpaired"):
        build_quantum_system(wrong)


def test_stiff_bonds_of_a_frame_relax_on_a_copy_of_the_system() -> None:
    """As the guards of rollouts do it: the copy takes the quantum program along."""
    scene = scene_from_smiles("O")
    stretched = scene.positions_nm.copy()
    stretched[1] += 0.2 * (stretched[1] - stretched[0])
    potential = Potential(scene)
    with Relaxer(scene, build_quantum_system(scene), platform="Reference", born=False) as relaxer:
        found = relaxer.relax(stretched)
    assert potential(found)[0] < potential(stretched)[0] - 10.0


def test_an_scf_that_fails_without_a_word_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    from tblite.exceptions import TBLiteRuntimeError
    from tblite.interface import Calculator

    def fails(_: Calculator) -> None:
        raise TBLiteRuntimeError("")

    potential = Potential(scene_from_smiles("O"))
    monkeypatch.setattr(Calculator, "singlepoint", fails)
    with pytest.raises(PreparationError, match=r"no electronic ground state .*\(TBLiteRuntimeError\)"):
        potential(scene_from_smiles("O").positions_nm)


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are counted by Linux's /proc")
def test_one_thread_is_enough_wherever_openmp_was_loaded_first() -> None:
    """Threads that OpenMP starts for torch, which is loaded first, wait in a loop while GFN2-xTB has one."""
    code = (
        "import os, torch\n"
        "from md_reference.forces.quantum import Potential\n"
        "from systems.prepare.molecule import scene_from_smiles\n"
        "scene = scene_from_smiles('O')\n"
        "potential = Potential(scene)\n"
        "def threads(): return len(os.listdir('/proc/self/task')), torch.get_num_threads()\n"
        "before = threads()\n"
        "potential(scene.positions_nm)\n"
        "assert threads() == before, (threads(), before)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], env=os.environ | {"OMP_NUM_THREADS": "2"}, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()


def test_frames_in_which_md_made_another_molecule_are_marked_and_said(tmp_path: Path) -> None:
    how: dict[str, Any] = {
        "level": "gfn2-xtb",
        "time_ps": 0.2,
        "equilibrate_ps": 0.01,
        "save_every_ps": 0.005,
        "timestep_ps": 5e-4,
    }
    (kept,) = sm.reference("smiles:F/C=C/F", tmp_path / "kept.h5", **how)
    assert sm.info(kept)["invalid_frames"] == 0 and "not the molecule" not in str(sm.info(kept)["details"])
    (hot,) = sm.reference("smiles:F/C=C/F", tmp_path / "hot.h5", **how, temperature_k=6000.0, friction_per_ps=50.0)
    found = sm.info(hot)
    assert 0 < found["invalid_frames"] < found["n_frames"] == 40
    changed = found["record"]["summary"]["changed"]
    with open_trajectory(hot) as reader:
        assert reader.flags is not None
        first = int(np.flatnonzero(reader.flags)[0])
        assert changed == {"n_frames": found["invalid_frames"], "first_ps": pytest.approx(reader.time_ps[first]),
                           "what": changed["what"]}  # fmt: skip
    assert f"warning: {found['invalid_frames']} of 40 frames" in str(found["details"])
