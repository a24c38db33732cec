"""Scenes of the library run, under all names alike, or by a protocol; and its molecules need no AmberTools."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from library_runs import run_scene

from md_reference.forces import gaff
from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions, defaults, resolve_settings, to_config
from md_reference.run.engine import Engine
from systems.chemistry.graph import molecule_key
from systems.chemistry.validity import check_frames, geometry_from_scene
from systems.errors import InputError, PreparationError
from systems.library import named_scenes
from systems.library.named_scenes import MOLECULES, find_protocol, prepare
from systems.scene import Scene

MD17 = named_scenes.groups()[MOLECULES]
GAFF = ForceFieldSpec("gaff2", "vacuum", hydrogen_mass_da=None, constrain_hydrogens=False)


@pytest.fixture
def no_ambertools(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No AmberTools anywhere, no parameters cached, and no program may be started."""

    def refused(*_: Any, **__: Any) -> None:
        raise AssertionError("a program was started")

    monkeypatch.setenv("SURROMD_CACHE", str(tmp_path))
    monkeypatch.setattr("md_reference.forces.programs.find_ambertools", lambda: None)
    monkeypatch.setattr(gaff, "find_ambertools", lambda: None)
    monkeypatch.setattr(subprocess, "run", refused)
    monkeypatch.setattr(subprocess, "Popen", refused)


def potential(scene: Scene) -> tuple[float, float]:
    """Energies in kJ/mol of the scene as it is, and minimised."""
    with Engine(scene, Conditions(force=GAFF, platform="Reference")) as engine:
        before = engine.energy()
        after = engine.minimise()
        relaxed = scene.with_positions(engine.positions())
    assert not check_frames(relaxed.positions_nm, geometry_from_scene(scene)).any()
    return before, after


@pytest.mark.parametrize("name", MD17)
@pytest.mark.usefixtures("no_ambertools")
def test_molecules_have_their_parameters_without_ambertools(name: str) -> None:
    from openmm import NonbondedForce

    scene = named_scenes.load(name)
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
    from systems.prepare.molecule import scene_from_smiles

    with pytest.raises(PreparationError, match="AmberTools"):
        build_system(scene_from_smiles("CO"), GAFF)


@pytest.mark.usefixtures("no_ambertools")
def test_parameters_follow_the_molecule_into_another_atom_order() -> None:
    from systems.prepare.molecule import scene_from_smiles

    ours, reordered = named_scenes.load("ethanol"), scene_from_smiles("OCC")
    assert ours.elements != reordered.elements
    assert potential(ours)[1] == pytest.approx(potential(reordered)[1], abs=2.0)  # one of its conformers


# ---- protocols -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "names",
    [
        ("ethanol", "smiles:CCO", "smiles:OCC"),
        ("alanine-dipeptide", "ACE-ALA-NME", "sequence:ACE-ALA-NME"),
        ("ac-ala3-nhme", "sequence:ACE-ALA-ALA-ALA-NME", "ACE-ALA-ALA-ALA-NME"),
        ("ASFK", "ALA-SER-PHE-LYS", "sequence:ASFK"),
    ],
)
def test_one_molecule_has_one_default_under_all_its_names(names: tuple[str, ...]) -> None:
    scenes = [prepare(name) for name in names]
    assert len({molecule_key(scene) for scene in scenes}) == 1
    found = []
    for scene in scenes:
        settings, said = resolve_settings(scene, {})
        assert said == ""
        config = to_config(settings | {"time_ps": 1.0}, seed=0)
        found.append(replace(config, force=resolve(scene, config.force)))
    assert found[0].temperature_k == 300.0
    assert found == found[:1] * len(names)


def test_a_protocol_is_asked_for_by_name_and_outweighed_by_what_is_given() -> None:
    md17 = find_protocol("md17").settings
    for name in ("aspirin", "smiles:CCO"):
        scene = prepare(name)
        settings, said = resolve_settings(scene, {}, "md17")
        assert {key: settings[key] for key in md17} == md17
        for word in (
            "by protocol md17",
            "temperature 500K",
            "timestep 0.5fs",
            "save every 5fs",
            "gaff2",
            "GAFF2 for their PBE",
        ):
            assert word in said
        warmer, said = resolve_settings(scene, {"temperature_k": 600.0, "save_every_ps": 0.01}, "md17")
        assert (warmer["temperature_k"], warmer["save_every_ps"], warmer["timestep_ps"]) == (600.0, 0.01, 0.0005)
        assert "temperature" not in said
        assert "save every" not in said


def test_without_a_protocol_the_defaults_hold_and_nothing_is_said() -> None:
    scene = named_scenes.load("aspirin")
    assert resolve_settings(scene, {}) == (defaults(), "")
    assert resolve_settings(scene, {"temperature_k": 310.0})[0] == defaults() | {"temperature_k": 310.0}


def test_model_systems_have_settings_of_their_own_and_take_no_protocol() -> None:
    scene = named_scenes.load("double-well")
    settings, said = resolve_settings(scene, {})
    assert (settings["timestep_ps"], settings["save_every_ps"]) == (0.01, 0.1)
    assert "this program's own" in said
    with pytest.raises(InputError, match="leave `protocol` out"):
        resolve_settings(scene, {}, "md17")


def test_flexible_bonds_end_above_one_femtosecond() -> None:
    scene = named_scenes.load("ethanol")
    assert resolve_settings(scene, {"timestep_ps": 0.001}, "md17")[0]["constrain_hydrogens"] is False
    assert resolve_settings(scene, {"timestep_ps": 0.002}, "md17")[0]["constrain_hydrogens"] is True
    given = {"timestep_ps": 0.002, "constrain_hydrogens": False}
    assert resolve_settings(scene, given, "md17")[0]["constrain_hydrogens"] is False


def test_another_force_field_leaves_the_protocol_s_solvent() -> None:
    scene = named_scenes.load("chignolin")
    assert resolve_settings(scene, {"force_field": "gfn2-xtb"}, "fast-folders")[0]["solvent"] == "auto"
    assert resolve_settings(scene, {"solvent": "vacuum"}, "fast-folders")[0]["force_field"] == "ff14SB"


# ---- runs ----------------------------------------------------------------------------------------------------------


def test_model_systems_run_and_are_read_by_others(tmp_path: Path) -> None:
    outcome = run_scene("harmonic-oscillator", tmp_path, time_ps=5.0)
    assert outcome.passed, outcome.reason
    assert outcome.force_field == "model"


@pytest.mark.slow
@pytest.mark.parametrize("name", named_scenes.names())
def test_every_scene_runs_ten_picoseconds(name: str, tmp_path: Path) -> None:
    outcome = run_scene(name, tmp_path)
    assert outcome.passed, outcome.reason or f"{outcome.invalid_frames} invalid frames"
    if outcome.bath_k:
        # At a friction of 0.1/ps the energy hardly changes within 10 ps: one draw, of relative spread 1 / sqrt(3 n).
        spread = 1.0 / np.sqrt(3 * outcome.n_atoms)
        assert outcome.temperature_k == pytest.approx(outcome.bath_k, rel=4.0 * spread)
