"""Replicas begin in states of their own, of the molecule that was given, and do so again for the same seed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import md_reference.run.starts as starts
from md_reference.forces.forcefield import resolve
from md_reference.forces.mixture import solute_of
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions, MDConfig
from md_reference.run.replicas import simulate_replicas
from md_reference.run.starts import frames_as_starts, many_starts
from md_reference.simd.system_terms import SimdUnavailableError
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions, rotatable_torsions
from systems.chemistry.validity import CHIRALITY, OMEGA, check_frames, geometry_from_scene
from systems.errors import SimulationError
from systems.library.named_scenes import load
from systems.scene import Scene, part_of
from systems.trajectory.codec import open_trajectory

SCENE = load("alanine-dipeptide")


def conditions(scene: Scene = SCENE, **more: object) -> Conditions:
    return Conditions(resolve(scene, ForceFieldSpec("auto", "auto")), seed=3, **more)  # type: ignore[arg-type]


def angles(scenes: tuple[Scene, ...]) -> np.ndarray:
    return torsion(np.stack([s.positions_nm for s in scenes]), rotatable_torsions(scenes[0]))


def test_starts_are_many_states_of_the_same_molecule() -> None:
    scenes, how = many_starts(SCENE, conditions(), 20)
    positions = np.stack([s.positions_nm for s in scenes])
    assert len(scenes) == 20 and "20 starting structures" in how
    assert not (check_frames(positions, geometry_from_scene(SCENE)) & (CHIRALITY | OMEGA)).any()
    psi = np.degrees(torsion(positions, np.asarray(backbone_torsions(SCENE)["psi"])))[:, 0]
    helical = (psi > -120) & (psi < 80)
    assert 0 < helical.sum() < 20
    assert {s.topology_hash for s in scenes} == {SCENE.topology_hash}


def test_a_start_is_a_function_of_its_place_and_the_seed() -> None:
    (few, _), (many, _) = many_starts(SCENE, conditions(), 4), many_starts(SCENE, conditions(), 18)
    for one, other in zip(few, many, strict=False):
        np.testing.assert_array_equal(one.positions_nm, other.positions_nm)
    again, _ = many_starts(SCENE, replace(conditions(), seed=4), 4)
    assert np.abs(angles(again)[1:] - angles(few)[1:]).max() > 0.1


def test_without_simd_openmm_heats(monkeypatch: pytest.MonkeyPatch) -> None:
    def unavailable(*_: object, **__: object) -> object:
        raise SimdUnavailableError("no compiler")

    monkeypatch.setattr(starts, "SimdReplicas", unavailable)
    scenes, how = many_starts(SCENE, conditions(), 3)
    assert "OpenMM" in how
    assert np.abs(angles(scenes)[1:] - angles(scenes)[0]).max() > 0.1


@pytest.mark.parametrize("by_simd", [True, False])
def test_replicas_begin_in_either_chair(monkeypatch: pytest.MonkeyPatch, by_simd: bool) -> None:
    from systems.library.named_scenes import prepare

    def unavailable(*_: object, **__: object) -> object:
        raise SimdUnavailableError("no compiler")

    if not by_simd:
        monkeypatch.setattr(starts, "SimdReplicas", unavailable)
    scene = prepare("smiles:CC1CCCCC1")

    def n_turned() -> int:
        scenes, _ = many_starts(scene, conditions(scene), 6, hot_ps=2.0)
        side = np.sign(torsion(np.stack([s.positions_nm for s in scenes]), np.array([[1, 2, 3, 4]]))[:, 0])
        return int((side != side[0]).sum())

    assert n_turned() == 2 and "2 ring conformers" in many_starts(scene, conditions(scene), 6, hot_ps=2.0)[1]
    monkeypatch.setattr(starts, "ring_conformers", lambda scene: scene.positions_nm[None])
    with pytest.raises(AssertionError):
        assert n_turned() == 2, "negative control: heat does not turn it"


def test_what_cannot_turn_begins_in_one_structure() -> None:
    from systems.library.named_scenes import prepare

    methane = prepare("smiles:C")
    scenes, how = many_starts(methane, conditions(methane), 3)
    assert "from the input structure" in how and "no rotatable torsions" in how
    assert all(s is methane for s in scenes)


def test_in_water_little_time_is_for_turning_where_little_is_for_being_hot(monkeypatch: pytest.MonkeyPatch) -> None:
    wet = solvate(SCENE, spec := ForceFieldSpec("ff14SB", "tip3p"), WaterBox())
    asked: list[float] = []

    def turned(scene: Scene, how: Conditions, dry: Scene, to: np.ndarray, turned_ps: float) -> np.ndarray:
        asked.append(turned_ps)
        return np.repeat(scene.positions_nm[None], len(to), axis=0)

    monkeypatch.setattr(starts, "_in_water", turned)
    for hot_ps in (2.0, 50.0):
        many_starts(wet, Conditions(spec, seed=3), 2, hot_ps=hot_ps)
    assert asked == [4.0, 10.0]


def test_at_constant_pressure_and_without_a_solute(monkeypatch: pytest.MonkeyPatch) -> None:
    wet = solvate(SCENE, spec := ForceFieldSpec("ff14SB", "tip3p"), WaterBox())
    npt = Conditions(spec, seed=3, ensemble="npt")
    monkeypatch.setattr(starts, "_steps", lambda *_: None)
    assert "(SIMD replicas)" in many_starts(wet, npt, 2)[1]
    water = part_of(wet, np.setdiff1d(np.arange(wet.n_atoms), solute_of(wet)))
    assert "nothing but water" in many_starts(water, npt, 2)[1]


def test_frames_of_a_solute_are_set_in_its_water() -> None:
    wet = solvate(SCENE, spec := ForceFieldSpec("ff14SB", "tip3p"), WaterBox())
    frames = np.stack([scene.positions_nm for scene in many_starts(SCENE, conditions(), 3)[0]])
    scenes, how = frames_as_starts(wet, Conditions(spec, seed=3), iter(frames), 4, hot_ps=20.0)
    assert how.startswith("3 starting structures: frames of the rollout, their torsions set in water")
    quads, solute = rotatable_torsions(SCENE), solute_of(wet)
    for k, scene in enumerate(scenes):
        assert scene.n_atoms == wet.n_atoms and scene.cell_nm is not None
        off = torsion(scene.positions_nm[solute], quads) - torsion(frames[k % 3], quads)
        assert np.abs(np.angle(np.exp(1j * off))).max() < 0.5
    with pytest.raises(SimulationError, match="frames of 21 atoms are not of its solute, which has 22"):
        frames_as_starts(wet, Conditions(spec, seed=3), frames[:, 1:], 4)


def test_frames_that_are_another_molecule_are_no_starts() -> None:
    mirrored = SCENE.positions_nm * np.array([-1.0, 1.0, 1.0])
    frames = np.stack([mirrored, SCENE.positions_nm, np.full_like(mirrored, np.nan)])
    scenes, how = frames_as_starts(SCENE, conditions(), frames, 4)
    assert how.startswith("1 starting structure:") and len(scenes) == 4
    with pytest.raises(SimulationError, match="none of 1"):
        frames_as_starts(SCENE, conditions(), mirrored[None], 1)


@pytest.mark.parametrize("platform", ["simd", "Reference"])
def test_replicas_begin_apart_unless_one_is_asked_for(tmp_path: Path, platform: str) -> None:
    config = MDConfig(force=conditions().force, time_ps=0.4, save_every_ps=0.2, equilibrate_ps=0.1, platform=platform)
    told: list[str] = []

    def spread(starts: str) -> float:
        outs = [tmp_path / f"{starts}{k}.h5" for k in range(3)]
        simulate_replicas(SCENE, replace(config, starts=starts), outs, announce=lambda said: told.append(str(said)))
        firsts = []
        for out in outs:
            with open_trajectory(out) as reader:
                firsts.append(reader.read(0, 1)[0])
                assert reader.record["starts"] == starts
                assert (reader.record.get("starting_structures") in told) == (starts == "many")
        return float(np.cos(torsion(np.array(firsts), rotatable_torsions(SCENE))).std(axis=0).max())

    assert spread("many") > 2 * spread("one")
    assert sum("starting structures" in line for line in told) == 1
