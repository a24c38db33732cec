"""Energy without a bath, temperature and energy with one, and two seeds that must agree; each with what must fail."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine, State
from md_reference.run.run_summary import correlation_frames, drift, mean_and_error
from md_reference.run.simulate import MDConfig, simulate
from systems.library.named_scenes import load
from systems.scene import FloatArray, Scene
from systems.trajectory.codec import open_trajectory

FLEXIBLE = ForceFieldSpec(solvent="vacuum", hydrogen_mass_da=None, constrain_hydrogens=False)
N_SAMPLES, SAMPLE_PS = 500, 0.04


@cache
def warm_state() -> State:
    with Engine(
        load("alanine-dipeptide"),
        Conditions(force=FLEXIBLE, timestep_ps=0.0005, friction_per_ps=10.0, platform="Reference", seed=3),
    ) as engine:
        engine.minimise()
        engine.thermalise()
        engine.step(4000)
        return engine.state(velocities=True)


@cache
def energies(timestep_ps: float, *, kick_drift: bool = False, friction_per_ps: float | None = None) -> Any:
    """Times `(n,)` ps, total energies `(n,)` kJ/mol and degrees of freedom of 20 ps from the same state."""
    settings: dict[str, Any] = {"timestep_ps": timestep_ps, "platform": "Reference", "seed": 1}
    if friction_per_ps is None:
        settings["ensemble"] = "nve"
    else:
        settings["friction_per_ps"] = friction_per_ps
    with Engine(load("alanine-dipeptide"), Conditions(force=FLEXIBLE, **settings)) as engine:
        if kick_drift:
            engine = _with_kick_drift(engine, timestep_ps)
        engine.take_over(warm_state())
        times, totals = np.empty(N_SAMPLES), np.empty(N_SAMPLES)
        for k in range(N_SAMPLES):
            engine.step(round(SAMPLE_PS / timestep_ps))
            state = engine.state()
            times[k], totals[k] = (k + 1) * SAMPLE_PS, state.potential_kj_mol + state.kinetic_kj_mol
        return times, totals, engine.n_dof


def _with_kick_drift(engine: Engine, timestep_ps: float) -> Engine:
    """The same engine with the integrator of first order whose velocities lag by half a step."""
    import openmm

    integrator = openmm.CustomIntegrator(timestep_ps)
    integrator.addComputePerDof("v", "v+dt*f/m")
    integrator.addComputePerDof("x", "x+dt*v")
    engine._integrator = integrator
    engine._context = openmm.Context(engine._system, integrator, openmm.Platform.getPlatformByName("Reference"))
    return engine


@pytest.mark.parametrize("timestep_ps", [0.0005, 0.001])
def test_total_energy_does_not_drift_without_a_bath(timestep_ps: float) -> None:
    times, totals, n_dof = energies(timestep_ps)
    found = drift(times, totals, n_dof)
    slope, error = found["kj_mol_ns_dof"], found["standard_error"]
    assert slope is not None and error is not None
    # A degree of freedom holds 1.2 kJ/mol of kinetic energy: 0.1 in a nanosecond would be 5 K a nanosecond.
    assert error < 0.1, "the error bar is too wide to say anything"
    assert abs(slope) < 4 * error
    # Negative control: the drift of a leak that would cool by 25 K in a nanosecond is seen.
    leak = drift(times, totals - 0.3 * n_dof * times * 1e-3, n_dof)["kj_mol_ns_dof"]
    assert leak is not None and leak < -4 * error + 0.1
    assert leak == pytest.approx(slope - 0.3)


def test_the_energy_error_is_of_second_order() -> None:
    fine, coarse = (float(energies(dt)[1].std()) for dt in (0.0005, 0.001))
    assert fine < 0.15, "kJ/mol, of 105 kJ/mol of kinetic energy"
    assert 3.2 < coarse / fine < 5.5
    # Negative controls: an integrator of first order, and a bath, however weak.
    first_fine, first_coarse = (float(energies(dt, kick_drift=True)[1].std()) for dt in (0.0005, 0.001))
    assert 1.6 < first_coarse / first_fine < 2.8
    assert first_fine > 10 * fine
    assert energies(0.0005, friction_per_ps=0.01)[1].std() > 5 * fine


# ---- with a bath ---------------------------------------------------------------------------------------------------

BATH = MDConfig(time_ps=200.0, save_every_ps=0.1, friction_per_ps=10.0, equilibrate_ps=10.0, platform="Reference",
                force=ForceFieldSpec(solvent="vacuum"))  # fmt: skip


@pytest.fixture(scope="module")
def baths(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Any, Any]]:
    """Record and scalars of two seeds and of a hotter bath."""
    scene, folder = load("alanine-dipeptide"), tmp_path_factory.mktemp("baths")
    found = {}
    for name, config in {"a": BATH, "b": replace(BATH, seed=1), "hot": replace(BATH, temperature_k=330.0)}.items():
        with open_trajectory(simulate(scene, config, folder / f"{name}.h5")) as reader:
            found[name] = reader.record, reader.scalars
    return found


def test_the_summary_finds_the_temperature_of_the_bath(baths: dict[str, tuple[Any, Any]]) -> None:
    for name, (record, _) in baths.items():
        found = record["summary"]["temperature_k"]
        assert found["standard_error"] < 2.5
        # 1.2 K: what 4 fs adds (tests/physics/test_dynamics.py).
        near = [abs(found["mean"] - bath) < 4 * found["standard_error"] + 1.2 for bath in (300.0, 330.0)]
        assert near == [name != "hot", name == "hot"]
        # Negative control: degrees of freedom counted without the constraints.
        assert abs(found["mean"] * 54 / 66 - found["target"]) > 4 * found["standard_error"] + 1.2


def test_two_seeds_agree_on_the_mean_energy(baths: dict[str, tuple[Any, Any]]) -> None:
    a, b, hot = (baths[name][0]["summary"]["potential_kj_mol"] for name in ("a", "b", "hot"))

    def apart(x: dict[str, float], y: dict[str, float]) -> float:
        return abs(x["mean"] - y["mean"]) / math.hypot(x["standard_error"], y["standard_error"])

    assert apart(a, b) < 3.0
    assert apart(a, hot) > 4.0
    assert baths["a"][1]["potential_kj_mol"][0] != baths["b"][1]["potential_kj_mol"][0]


def alpha_population(path: Path, scene: Scene) -> dict[str, float | None]:
    """Share of frames with psi between -120 and 30 degrees, with its standard error."""
    from systems.chemistry.geometry import torsion
    from systems.chemistry.graph import backbone_torsions

    with open_trajectory(path) as reader:
        psi = np.degrees(torsion(reader.read(), backbone_torsions(scene)["psi"]))[:, 0]
    return mean_and_error(((psi > -120.0) & (psi < 30.0)).astype(float))


@pytest.mark.slow
def test_two_seeds_agree_on_populations(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    config = MDConfig(time_ps=5000.0, save_every_ps=1.0, platform="Reference", seed=20)
    populations = [
        alpha_population(simulate(alanine_dipeptide, replace(config, seed=config.seed + k), tmp_path / f"{k}.h5"),
                         alanine_dipeptide)
        for k in range(2)
    ]  # fmt: skip
    other = replace(config, force=ForceFieldSpec(solvent="vacuum"), time_ps=2000.0)
    in_vacuum = alpha_population(simulate(alanine_dipeptide, other, tmp_path / "vacuum.h5"), alanine_dipeptide)
    (a, b), width = populations, math.hypot(*(p["standard_error"] or 1.0 for p in populations))
    assert a["mean"] is not None and b["mean"] is not None and in_vacuum["mean"] is not None
    assert width < 0.15, "the error bar is too wide to say anything"
    assert abs(a["mean"] - b["mean"]) < 2.0 * width
    assert abs(a["mean"] - in_vacuum["mean"]) > 2.0 * width


# ---- the error bars themselves -------------------------------------------------------------------------------------


def autoregressive(n: int, memory: float, rng: np.random.Generator) -> FloatArray:
    x = rng.normal(size=n)
    for t in range(1, n):
        x[t] = memory * x[t - 1] + math.sqrt(1.0 - memory**2) * x[t]
    return x


def test_error_bars_are_those_of_correlated_frames() -> None:
    """Over many series the mean scatters as stated: (1 + r) / (1 - r) times the variance of independent frames."""
    rng = np.random.default_rng(0)
    series = [autoregressive(2000, 0.8, rng) for _ in range(60)]
    scatter = float(np.std([x.mean() for x in series]))
    stated = float(np.mean([mean_and_error(x)["standard_error"] for x in series]))
    assert stated == pytest.approx(scatter, rel=0.3)
    assert float(np.mean([correlation_frames(x) for x in series])) == pytest.approx(9.0, rel=0.25)
    # Negative control: counted as independent they would state a third of it.
    assert 1.0 / math.sqrt(2000) < 0.5 * scatter
    time_ps = np.arange(2000.0)
    slopes = [drift(time_ps, x, 1) for x in series]
    found = float(np.std([s["kj_mol_ns_dof"] for s in slopes]))
    assert float(np.mean([s["standard_error"] for s in slopes])) == pytest.approx(found, rel=0.35)
