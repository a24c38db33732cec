"""The labeller: states of a molecule and GFN2-xTB's answers at them, alone and in processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from md_reference.forces.quantum import Potential, refuse_rearranged
from md_reference.run.labeller import Labeller
from systems.chemistry.graph import bonded_graph, turned
from systems.chemistry.validity import changed_stereo
from systems.errors import PreparationError, SimulationError
from systems.prepare.molecule import scene_from_smiles
from systems.scene import FloatArray, Scene

pytest.importorskip("tblite")


def test_a_script_that_labels_while_it_is_imported_ends(tmp_path: Path, repository: Path) -> None:
    script = "from systems.prepare.molecule import scene_from_smiles\nfrom md_reference.run.labeller import Labeller\n"
    script += "scene = scene_from_smiles('O')\nLabeller(scene, workers=2).label(scene.positions_nm[None])\n"
    (tmp_path / "script.py").write_text(script)
    run = subprocess.run([sys.executable, str(tmp_path / "script.py")], capture_output=True, text=True, check=False,
                         env=os.environ | {"PYTHONPATH": str(repository)}, timeout=120)  # fmt: skip
    assert run.returncode == 1 and "`if __name__ == '__main__':`" in run.stderr


def test_answers_are_the_potentials_own_whoever_computes_them() -> None:
    scene = scene_from_smiles("CO")
    rng = np.random.default_rng(0)
    states = scene.positions_nm + 0.003 * rng.normal(size=(3, scene.n_atoms, 3))
    with Labeller(scene, workers=1) as alone, Labeller(scene, workers=2) as many:
        here, there = alone.label(states), many.label(states)
        # Ctrl-C reaches every process of the terminal; the parent answers it, and its workers wait to be ended.
        for worker in multiprocessing.active_children():
            os.kill(worker.pid, signal.SIGINT)
        np.testing.assert_array_equal(many.label(states).energies_kj_mol, there.energies_kj_mol)
        os.kill(multiprocessing.active_children()[0].pid or 0, signal.SIGKILL)
        with pytest.raises(SimulationError, match="a labelling process ended unexpectedly"):
            many.label(np.repeat(states, 20, axis=0))
    for k, state in enumerate(states):
        energy, forces = Potential(scene)(state)
        for found in (here, there):
            assert found.energies_kj_mol[k] == pytest.approx(energy, abs=1e-6)
            np.testing.assert_allclose(found.forces_kj_mol_nm[k], forces, atol=1e-4)


def test_states_without_an_answer_are_left_out_and_counted() -> None:
    scene = scene_from_smiles("CO")
    states = scene.positions_nm + np.array([0.0, 1.0])[:, None, None]

    def silent(positions_nm: FloatArray) -> tuple[float, FloatArray]:
        if positions_nm[0, 0] > 0.5:
            raise PreparationError("no electronic ground state")
        return 0.0, np.zeros_like(positions_nm)

    with Labeller(scene, workers=1) as labeller:
        labeller._potential = silent  # type: ignore[assignment]
        found = labeller.label(states)
    assert (found.failed, found.rearranged) == (1, 0)
    np.testing.assert_array_equal(found.positions_nm, states[:1])


def test_every_state_has_an_energy_and_another_molecule_an_infinite_one() -> None:
    scene = scene_from_smiles("CO")
    states = np.repeat(scene.positions_nm[None], 3, axis=0)
    states[1, -1] += 0.2  # the hydroxyl's hydrogen
    with Labeller(scene, workers=1) as labeller:
        found = labeller.energies(states)
    assert found[0] == found[2] == pytest.approx(Potential(scene)(scene.positions_nm)[0]) and np.isposinf(found[1])


def test_states_of_another_molecule_are_left_out_and_counted() -> None:
    scene = scene_from_smiles("NCC(=O)O")
    moved, stretched = scene.positions_nm.copy(), scene.positions_nm.copy()
    acid = next(j for i, j in scene.bonds.tolist() if (scene.elements[i], scene.elements[j]) == ("O", "H"))
    moved[acid] = moved[0] + 0.102 * _away(moved, 0, scene)
    first, second = scene.bonds[0]
    stretched[first] += 0.4 * (stretched[first] - stretched[second])
    with Labeller(scene, workers=1) as labeller:
        found = labeller.label(np.stack([scene.positions_nm, moved, stretched]))
        assert labeller.label(scene.positions_nm[None]).rearranged == 0
        assert labeller.n_rearranged == 1
    assert (found.rearranged, found.failed) == (1, 0)
    np.testing.assert_array_equal(found.positions_nm, np.stack([scene.positions_nm, stretched]))


def _away(x: FloatArray, atom: int, scene: Scene) -> FloatArray:
    """The direction `(3,)` in which an atom has no neighbours."""
    near = [j if i == atom else i for i, j in scene.bonds.tolist() if atom in (i, j)]
    arm = x[atom] - x[near].mean(axis=0)
    return arm / np.linalg.norm(arm)


def test_a_molecule_that_the_reference_makes_another_is_not_learned() -> None:
    with pytest.raises(PreparationError, match="moves from N1 to O"), Labeller(scene_from_smiles("[NH3+]CC(=O)[O-]")):
        pass


def test_hot_states_keep_their_bonds_and_turn_their_torsions() -> None:
    scene = scene_from_smiles("OCCO")
    with Labeller(scene, workers=1) as labeller:
        found, again = (labeller.explore(48, (300.0, 600.0), seed=1) for _ in range(2))
    np.testing.assert_array_equal(found, again)
    assert found.shape == (48, scene.n_atoms, 3)
    for i, j in scene.bonds:
        rest = np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j])
        assert (np.abs(np.linalg.norm(found[:, i] - found[:, j], axis=-1) / rest - 1.0) < 0.3).all()
    # Hydrogens of the hydroxyls stand near and far from the other oxygen.
    apart = np.linalg.norm(found[:, 4] - found[:, 3], axis=-1)
    assert np.ptp(apart) > 0.1


def test_what_the_level_refuses_is_known_at_once() -> None:
    scene = scene_from_smiles("CO")
    with pytest.raises(PreparationError, match="unpaired"):
        Labeller(replace(scene, provenance=scene.provenance | {"multiplicity": 2}), workers=1)


def test_a_molecule_that_gaff2_does_not_know_moves_by_the_level_itself() -> None:
    # Borane; methyl, with one electron too many for a pair; water, which is rigid beside GAFF2.
    for smiles in ("B", "[CH3]", "O"):
        scene = scene_from_smiles(smiles)
        with Labeller(scene, workers=1) as labeller:
            states = labeller.explore(4, (300.0,), seed=0)
            assert labeller.label(states).failed == 0
            assert len(labeller.motion(16, 0.01, 300.0, seed=0)) == 2, "an eighth: each step is an expensive force"
        assert states.shape == (4, scene.n_atoms, 3)
        assert np.linalg.norm(states[:, 0] - states[:, 1], axis=-1).std() > 1e-4


def test_hydrogen_without_a_heavy_atom_stays_whole() -> None:
    scene = scene_from_smiles("[H][H]")
    with Labeller(scene, workers=1) as labeller:
        frames = labeller.motion(200, 0.1, 700.0, seed=0)
        rigid = labeller.motion(80, 0.1, 300.0, seed=0, constrain_hydrogens=True)
    flexible, fixed = (np.linalg.norm(x[:, 0] - x[:, 1], axis=-1) for x in (frames, rigid))
    assert flexible.max() < 0.1 and flexible.std() > 1e-3 > 1e4 * fixed.std()


def test_bad_molecules_are_refused_in_one_line() -> None:
    for smiles, word in (("[U]", "it holds U: metals"), ("[Na+].[Cl-]", "one molecule")):
        with pytest.raises(PreparationError, match=word) as caught, Labeller(scene_from_smiles(smiles), workers=1):
            pass
        assert "\n" not in str(caught.value)
    scene = scene_from_smiles("CO")
    beyond = replace(scene, elements=("Fr", *scene.elements[1:]))
    with pytest.raises(PreparationError, match="no parameters for Fr"):
        Labeller(beyond, workers=1)


def test_states_of_another_handedness_are_not_learned() -> None:
    """The mirror image of a stereocentre and the other isomer of a double bond; a turned amide is the same molecule."""
    for smiles, words in (("C[C@H](F)Cl", "stereocentre"), ("C/C=C/F", "double bond")):
        scene = scene_from_smiles(smiles)
        other = scene.positions_nm * [1.0, 1.0, -1.0] if "@" in smiles else _half_turn(scene)
        found = changed_stereo(scene, np.array([scene.positions_nm, other, scene.positions_nm * 1.02]))
        assert found[0] == found[2] == "" and words in found[1], found
        with pytest.raises(PreparationError, match=f"becomes another molecule .*{words}"):
            refuse_rearranged(scene, other)
        refuse_rearranged(scene, scene.positions_nm)
    assert changed_stereo(scene_from_smiles("CC(=O)NC"), _half_turn(scene_from_smiles("CC(=O)NC"), 1, 3)[None]) == [""]
    with Labeller(scene, workers=1) as labeller:
        found_labels = labeller.label(np.array([scene.positions_nm, other]))
    assert len(found_labels.positions_nm) == 1 and found_labels.rearranged == 1


def _half_turn(scene: Scene, i: int = 1, j: int = 2) -> FloatArray:
    """The scene with what hangs on j turned about i - j by 180°."""
    graph = bonded_graph(scene)
    quad = (next(k for k in graph[i] if k != j), i, j, next(k for k in graph[j] if k != i))
    return np.asarray(turned(scene.positions_nm, quad, np.pi, graph))
