"""Scenes of the library run by their protocol, and its molecules need no AmberTools."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from md_reference import gaff
from md_reference.engine import Engine
from md_reference.forcefield import ForceFieldSpec, build_system
from md_reference.protocol import defaults, settle
from surrogate.bench.library import run_scene
from systems import library
from systems.catalogue import MD17_PROTOCOL, MOLECULES
from systems.errors import PreparationError
from systems.scene import Scene
from systems.validity import check_frames, geometry_from_scene

MD17 = library.groups()[MOLECULES]
GAFF = ForceFieldSpec("gaff2", "vacuum", hydrogen_mass_da=None, constrain_hydrogens=False)


@pytest.fixture
def no_ambertools(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No AmberTools anywhere, no parameters cached, and no program may be started."""

    def refused(*_: Any, **__: Any) -> None:
        raise AssertionError("a program was started")

    monkeypatch.setenv("SURROMD_CACHE", str(tmp_path))
    monkeypatch.setattr("md_reference.ambertools.find_ambertools", lambda: None)
    monkeypatch.setattr(gaff, "find_ambertools", lambda: None)
    monkeypatch.setattr(subprocess, "run", refused)
    monkeypatch.setattr(subprocess, "Popen", refused)


def potential(scene: Scene) -> tuple[float, float]:
    """Energies in kJ/mol of the scene as it is, and minimised."""
    with Engine(scene, GAFF, platform="Reference") as engine:
        before = engine.energy()
        after = engine.minimise()
        relaxed = scene.with_positions(engine.positions())
    assert not check_frames(relaxed.positions_nm, geometry_from_scene(scene)).any()
    return before, after


@pytest.mark.parametrize("name", MD17)
@pytest.mark.usefixtures("no_ambertools")
def test_molecules_have_their_parameters_without_ambertools(name: str) -> None:
    from openmm import NonbondedForce

    scene = library.load(name)
    system = build_system(scene, GAFF)
    nonbonded = next(f for f in system.getForces() if isinstance(f, NonbondedForce))
    charges = np.array([nonbonded.getParticleParameters(i)[0]._value for i in range(scene.n_atoms)])
    assert charges.sum() == pytest.approx(0.0, abs=1e-5)
    oxygens = [i for i, e in enumerate(scene.elements) if e == "O"]
    assert (charges[oxygens] < -0.3).all()
    before, after = potential(scene)
    assert after < before
    if name == "benzene":  # Jakalian et al. (2002): -0.13 and 0.13
        np.testing.assert_allclose(np.abs(charges), 0.130, atol=0.005)


@pytest.mark.usefixtures("no_ambertools")
def test_another_molecule_would_need_ambertools() -> None:
    from systems.molecule import scene_from_smiles

    with pytest.raises(PreparationError, match="AmberTools"):
        build_system(scene_from_smiles("CO"), GAFF)


@pytest.mark.usefixtures("no_ambertools")
def test_parameters_follow_the_molecule_into_another_atom_order() -> None:
    from systems.molecule import scene_from_smiles

    ours, reordered = library.load("ethanol"), scene_from_smiles("OCC")
    assert ours.elements != reordered.elements
    assert potential(ours)[1] == pytest.approx(potential(reordered)[1], abs=2.0)  # one of its conformers


# ---- protocols -----------------------------------------------------------------------------------------------------


def test_a_library_scene_runs_by_its_protocol_unless_told_otherwise() -> None:
    scene = library.load("aspirin")
    settings, said = settle(scene, {})
    assert {key: settings[key] for key in MD17_PROTOCOL} == MD17_PROTOCOL
    for word in ("500 K", "0.5 fs", "5 fs", "gaff2", "MD17"):
        assert word in said
    warmer, said = settle(scene, {"temperature_k": 600.0, "save_every_ps": 0.01})
    assert (warmer["temperature_k"], warmer["save_every_ps"], warmer["timestep_ps"]) == (600.0, 0.01, 0.0005)
    assert "temperature" not in said
    assert "saved" not in said


def test_other_scenes_run_by_the_defaults() -> None:
    from dataclasses import replace

    scene = replace(library.load("aspirin"), provenance={"source": "file"})
    assert settle(scene, {}) == (defaults(), "")
    assert settle(scene, {"temperature_k": 310.0})[0] == defaults() | {"temperature_k": 310.0}


def test_the_first_peptide_runs_by_the_defaults_and_says_nothing() -> None:
    settings, said = settle(library.load("alanine-dipeptide"), {})
    assert said == ""
    assert settings == defaults() | {"force_field": "ff14SB", "solvent": "obc2"}


def test_flexible_bonds_end_above_one_femtosecond() -> None:
    scene = library.load("ethanol")
    assert settle(scene, {"timestep_ps": 0.001})[0]["constrain_hydrogens"] is False
    assert settle(scene, {"timestep_ps": 0.002})[0]["constrain_hydrogens"] is True
    assert settle(scene, {"timestep_ps": 0.002, "constrain_hydrogens": False})[0]["constrain_hydrogens"] is False


def test_another_force_field_leaves_the_protocol_s_solvent() -> None:
    scene = library.load("chignolin")
    assert settle(scene, {"force_field": "gfn2-xtb"})[0]["solvent"] == "auto"
    assert settle(scene, {"solvent": "vacuum"})[0]["force_field"] == "ff14SB"


# ---- runs ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "time_ps"), [("n-body-gravity:2", 1.0), ("harmonic-oscillator", 5.0)])
def test_model_systems_run_and_are_read_by_others(name: str, time_ps: float, tmp_path: Path) -> None:
    outcome = run_scene(name, tmp_path, time_ps=time_ps)
    assert outcome.passed, outcome.reason
    assert outcome.force_field == "model"
    if name.startswith("n-body"):
        assert outcome.ensemble == "nve"
        assert outcome.energy_spread < 1e-3


def test_an_n_body_file_holds_the_trajectory_of_its_generator(tmp_path: Path) -> None:
    from md_reference.model_systems import generate_n_body
    from systems.trajectory import open_trajectory

    run_scene("n-body-spring:4", tmp_path, time_ps=1.0)
    with open_trajectory(tmp_path / "n-body-spring-4.h5") as reader:
        frames, times = reader.read(), reader.time_ps
    made, other = (generate_n_body("n-body-spring", [seed], n_frames=10) for seed in (4, 5))
    np.testing.assert_allclose(times, made.time_ps, atol=1e-9)
    np.testing.assert_allclose(frames, made.positions_nm[0], atol=1e-6)
    assert np.abs(frames - other.positions_nm[0]).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", library.names())
def test_every_scene_runs_ten_picoseconds(name: str, tmp_path: Path) -> None:
    outcome = run_scene(name, tmp_path)
    assert outcome.passed, outcome.reason or f"{outcome.invalid_frames} invalid frames"
    if outcome.bath_k:
        # At a friction of 0.1/ps the energy hardly changes within 10 ps: one draw, of relative spread 1 / sqrt(3 n).
        spread = 1.0 / np.sqrt(3 * outcome.n_atoms)
        assert outcome.temperature_k == pytest.approx(outcome.bath_k, rel=4.0 * spread)
