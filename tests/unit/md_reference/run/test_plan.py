"""The plan says what will run and what will not, and is right about it."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest

from md_reference.forces.forcefield import build_system
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions, MDConfig
from md_reference.run.machine import available_cores, platform_for
from md_reference.run.plan import make_plan
from systems.errors import InputError, PreparationError, UnknownNameError
from systems.library.named_scenes import load
from systems.scene import Scene

WET = ForceFieldSpec("ff14SB", "tip3p")


@pytest.fixture(scope="module")
def wet() -> Scene:
    return solvate(load("alanine-dipeptide"), WET, WaterBox())


def skipped(scene: Scene, spec: ForceFieldSpec) -> set[str]:
    return set(make_plan(scene, MDConfig(time_ps=0.0, force=spec), timed=False).skipped)


def test_terms_and_constraints_are_those_of_the_molecule(alanine_dipeptide: Scene) -> None:
    plan = make_plan(alanine_dipeptide, MDConfig(time_ps=0.0), timed=False)
    n_hydrogen = alanine_dipeptide.elements.count("H")
    assert plan.rows["constraints"] == f"{n_hydrogen} bonds to hydrogen"
    assert plan.rows["platform"] == "Reference"
    assert plan.us_per_step is None
    json.dumps(asdict(plan))


def test_constraints_of_waters_are_not_bonds_to_hydrogen(wet: Scene) -> None:
    n_dry, n_waters = load("alanine-dipeptide").elements.count("H"), (wet.n_atoms - 22) // 3
    plan = make_plan(wet, MDConfig(time_ps=0.0, force=WET), timed=False)
    assert plan.rows["constraints"] == f"{n_dry} bonds to hydrogen, {n_waters} rigid waters"
    config = MDConfig(time_ps=0.0, force=replace(WET, constrain_hydrogens=False), timestep_ps=0.001)
    flexible = make_plan(wet, config, timed=False)
    assert flexible.rows["constraints"] == f"{n_waters} rigid waters" and "only water rigid" in flexible.line


def test_the_reference_platform_is_not_for_slanted_cells(wet: Scene) -> None:
    assert wet.cell_nm is not None
    slanted = replace(wet, cell_nm=wet.cell_nm + np.array([[0, 0, 0], [0.5, 0, 0], [0, 0, 0]]))
    with pytest.raises(InputError, match="omits pairs in non-rectangular cells"):
        make_plan(slanted, MDConfig(time_ps=0.0, force=WET, platform="Reference"), timed=False)
    few = SimpleNamespace(n_atoms=40, cell_nm=slanted.cell_nm)
    assert platform_for(few, Conditions(force=WET)).name == "CPU"  # type: ignore[arg-type]
    assert platform_for(wet, Conditions(force=WET, platform="Reference")).name == "Reference"


def test_hydrogens_may_not_take_all_the_mass_of_an_atom(alanine_dipeptide: Scene) -> None:
    with pytest.raises(PreparationError, match=r"hydrogens of 6\.0 Da leave atom \S+ -2\.9. Da"):
        build_system(alanine_dipeptide, ForceFieldSpec(hydrogen_mass_da=6.0))


def test_vacuum_has_no_born_term_and_obc2_no_custom_one(alanine_dipeptide: Scene) -> None:
    assert "generalised Born term" in skipped(alanine_dipeptide, ForceFieldSpec(solvent="vacuum"))
    assert "generalised Born term" not in skipped(alanine_dipeptide, ForceFieldSpec())
    assert "CustomGBForce of implicit/obc2.xml" in skipped(alanine_dipeptide, ForceFieldSpec())


def test_a_long_step_with_natural_hydrogens_is_warned_of(alanine_dipeptide: Scene) -> None:
    natural = ForceFieldSpec(hydrogen_mass_da=None)
    assert make_plan(alanine_dipeptide, MDConfig(time_ps=0.0, force=natural, timestep_ps=0.004), timed=False).warnings
    assert not make_plan(
        alanine_dipeptide, MDConfig(time_ps=0.0, force=natural, timestep_ps=0.002), timed=False
    ).warnings
    assert not make_plan(alanine_dipeptide, MDConfig(time_ps=0.0, timestep_ps=0.004), timed=False).warnings


def test_the_platform_asked_for_is_kept_or_refused(alanine_dipeptide: Scene) -> None:
    assert make_plan(alanine_dipeptide, MDConfig(time_ps=0.0, platform="CPU"), timed=False).rows["platform"] == "CPU"
    with pytest.raises(UnknownNameError, match="Reference"):
        make_plan(alanine_dipeptide, MDConfig(time_ps=0.0, platform="Referense"), timed=False)


def test_steps_are_timed_and_the_saving_is_stated(alanine_dipeptide: Scene) -> None:
    plan = make_plan(alanine_dipeptide, MDConfig(time_ps=0.0))
    assert plan.us_per_step is not None and plan.ns_per_day is not None
    assert plan.ns_per_day == pytest.approx(0.004e-3 * 86_400.0 / (plan.us_per_step * 1e-6))
    assert "times faster" in plan.skipped["OpenMM's CPU platform"]


def test_the_wall_time_of_a_length_is_estimated(alanine_dipeptide: Scene) -> None:
    plan = make_plan(alanine_dipeptide, MDConfig(time_ps=900.0), replicas=3 * available_cores())
    assert plan.us_per_step is not None
    # A nanosecond with its 100 ps of equilibration, three rounds of replicas.
    assert plan.wall_s == pytest.approx(3 * 250_000 * plan.us_per_step * 1e-6)
    assert make_plan(alanine_dipeptide, MDConfig(time_ps=900.0), timed=False).wall_s is None


@pytest.mark.parametrize(
    ("n_atoms", "born", "platform"),
    [(22, True, "Reference"), (62, True, "CPU"), (62, False, "Reference"), (150, False, "CPU")],
)
def test_the_platform_follows_the_size_and_the_solvent(n_atoms: int, born: bool, platform: str) -> None:
    spec = ForceFieldSpec("auto", "obc2" if born else "vacuum")
    choice = platform_for(SimpleNamespace(n_atoms=n_atoms, cell_nm=None), Conditions(force=spec))  # type: ignore[arg-type]
    assert choice.name == platform
    assert choice.threads == 1
    assert str(n_atoms) in choice.reason


def test_only_large_scenes_take_more_threads_and_quantum_forces_one(alanine_dipeptide: Scene) -> None:
    assert platform_for(alanine_dipeptide, Conditions(), max_threads=4).threads == 1
    large = SimpleNamespace(n_atoms=1500, cell_nm=None)
    assert platform_for(large, Conditions(platform="CPU"), max_threads=4).threads == 4  # type: ignore[arg-type]
    quantum = Conditions(force=ForceFieldSpec("gfn2-xtb", "vacuum"))
    assert platform_for(large, quantum, max_threads=4).name == "Reference"  # type: ignore[arg-type]
    with pytest.raises(InputError, match="platform simd"):
        platform_for(alanine_dipeptide, Conditions(platform="simd"))
