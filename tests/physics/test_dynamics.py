"""The reference's dynamics: the temperature it keeps, and that random streams are what the seeds say."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.replicas import simulate_replicas
from md_reference.run.simulate import MDConfig, simulate
from surrogate.comparison.measure.kinetics import zero_crossing
from surrogate.comparison.measure.statistics import effective_samples
from systems.library.named_scenes import load
from systems.scene import FloatArray, Scene
from systems.trajectory.codec import open_trajectory

BATH_K = 300.0
N_SAMPLES = 1500
# The 12 bonds to hydrogen are rigid; nothing removes the centre-of-mass motion, which the bath heats like the rest.
N_DOF = 3 * 22 - 12
STANDARD_ERRORS = 4.0
# Where the tolerance comes from: the statistical error of the mean, and an error of the integrator that grows with the
# square of the time step, +0.65 K in 400 ns at 4 fs (3 Da, mean 300.78 less 0.13 of the velocities along constraints).
BIAS_K = {0.002: 0.3, 0.004: 1.2}


@dataclass(frozen=True)
class Sampled:
    """Kinetic temperatures `(n,)` K of one run and the standard error of their mean."""

    temperature_k: FloatArray
    error_k: float


@cache
def run_of(timestep_ps: float, bath_k: float = BATH_K) -> Sampled:
    """Sample every 0.1 ps at a friction of 10/ps, where velocities are nearly independent from sample to sample.

    The kinetic energy is that of the velocities of half steps, which the Langevin middle integrator holds: for a
    harmonic oscillator these have exactly kT/2 each at any step (Zhang et al., J. Phys. Chem. A 123, 6056, 2019).
    """
    spec = ForceFieldSpec(hydrogen_mass_da=3.0 if timestep_ps > 0.002 else None)
    with Engine(
        load("alanine-dipeptide"),
        Conditions(force=spec, temperature_k=bath_k, friction_per_ps=10.0, timestep_ps=timestep_ps, seed=11),
    ) as engine:
        engine.minimise()
        engine.thermalise()
        engine.step(round(5.0 / timestep_ps))
        samples = np.empty(N_SAMPLES)
        for k in range(N_SAMPLES):
            engine.step(round(0.1 / timestep_ps))
            samples[k] = engine.state().temperature_k
    n_effective = effective_samples(N_SAMPLES, zero_crossing([samples])[1])
    return Sampled(samples, float(samples.std() / math.sqrt(n_effective)))


def within(mean_k: float, sampled: Sampled, timestep_ps: float) -> bool:
    return abs(mean_k - BATH_K) < STANDARD_ERRORS * sampled.error_k + BIAS_K[timestep_ps]


@pytest.mark.parametrize("timestep_ps", [0.002, 0.004])
def test_mean_kinetic_temperature_is_the_bath(timestep_ps: float) -> None:
    sampled = run_of(timestep_ps)
    assert sampled.error_k < 3.0, "the error bar is too wide to say anything"
    mean = float(sampled.temperature_k.mean())
    assert within(mean, sampled, timestep_ps), f"{mean:.1f} +- {sampled.error_k:.1f} K"
    # Negative controls: degrees of freedom counted without the constraints, or less those of the centre of mass.
    assert not within(mean * N_DOF / 66, sampled, timestep_ps)
    assert not within(mean * N_DOF / (N_DOF - 3), sampled, timestep_ps)


def test_another_bath_is_another_temperature() -> None:
    sampled = run_of(0.004, bath_k=320.0)
    assert not within(float(sampled.temperature_k.mean()), sampled, 0.004)


@pytest.mark.parametrize("timestep_ps", [0.002, 0.004])
def test_kinetic_temperature_fluctuates_as_in_the_canonical_ensemble(timestep_ps: float) -> None:
    # Chi-squared with N_DOF degrees of freedom: variance 2 T^2 / n; its own relative error is about sqrt(2 / n_eff).
    spread = run_of(timestep_ps).temperature_k.std()
    expected = BATH_K * math.sqrt(2.0 / N_DOF)
    assert expected == pytest.approx(57.7, abs=0.1)
    assert spread == pytest.approx(expected, rel=4.0 * math.sqrt(0.5 / (N_SAMPLES / 2)))
    # A weak-coupling thermostat, or no bath at all, would show a third of it or less.
    assert spread > 2.0 * expected / 3.0


def test_temperature_holds_no_velocity_along_the_constraints() -> None:
    """OpenMM's own kinetic energy does: half of each step's noise along them stays until the next step.

    That is n_constraints / 4 (1 - exp(-2 friction timestep)) degrees of freedom: 5.1 K at 91/ps and 2 fs.
    """
    excess = []
    with Engine(
        load("alanine-dipeptide"),
        Conditions(force=ForceFieldSpec(hydrogen_mass_da=None), friction_per_ps=91.0, timestep_ps=0.002, seed=2),
    ) as engine:
        engine.minimise()
        engine.thermalise()
        engine.step(500)
        for _ in range(400):
            engine.step(20)
            raw = engine._context.getState(energy=True).getKineticEnergy()._value
            state = engine.state()
            excess.append(state.temperature_k * (raw / state.kinetic_kj_mol - 1.0))
    error = float(np.std(excess) / math.sqrt(len(excess)))
    expected = BATH_K * 12 / (4 * N_DOF) * (1.0 - math.exp(-2 * 91.0 * 0.002))
    assert expected == pytest.approx(5.1, abs=0.1)
    assert abs(np.mean(excess) - expected) < STANDARD_ERRORS * error
    assert error < 0.25, "a zero excess would pass unnoticed"


@pytest.mark.parametrize(("friction_per_ps", "timestep_ps"), [(1.0, 0.004), (91.0, 0.002)])
def test_asking_for_the_state_changes_no_trajectory(friction_per_ps: float, timestep_ps: float) -> None:
    last = []
    for ask, seed in ((False, 4), (True, 4), (False, 5)):
        with Engine(
            load("alanine-dipeptide"), Conditions(friction_per_ps=friction_per_ps, timestep_ps=timestep_ps, seed=seed)
        ) as engine:
            engine.minimise()
            engine.thermalise()
            for _ in range(20):
                engine.step(10)
                if ask:
                    engine.state()
            last.append(engine.positions())
    assert np.abs(last[1] - last[0]).max() < 1e-7
    assert np.abs(last[2] - last[0]).max() > 1e-2


# ---- seeds ---------------------------------------------------------------------------------------------------------

SHORT = MDConfig(time_ps=8.0, save_every_ps=0.08, equilibrate_ps=2.0, seed=3, platform="Reference")


def frames(path: Path) -> FloatArray:
    with open_trajectory(path) as reader:
        assert reader.record["completed"]
        return reader.read()


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(load("alanine-dipeptide"), SHORT, tmp_path_factory.mktemp("seeds") / "a.h5")


def test_equal_seeds_give_identical_trajectories(alanine_dipeptide: Scene, first: Path, tmp_path: Path) -> None:
    # In between another run draws from the same process's random numbers.
    simulate(alanine_dipeptide, replace(SHORT, time_ps=0.4, seed=99), tmp_path / "between.h5")
    again = simulate(alanine_dipeptide, SHORT, tmp_path / "b.h5")
    np.testing.assert_array_equal(frames(again), frames(first))


@pytest.mark.parametrize("seed", [0, 4, 2**31])
def test_different_seeds_differ_from_the_first_frame(
    alanine_dipeptide: Scene, first: Path, tmp_path: Path, seed: int
) -> None:
    other = simulate(alanine_dipeptide, replace(SHORT, seed=seed, time_ps=0.4), tmp_path / "b.h5")
    shared = frames(first)[:5]
    assert (np.abs(frames(other) - shared).max(axis=(1, 2)) > 0.01).all()


def test_seed_zero_is_a_seed(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    """OpenMM itself reads 0 as "choose one"."""
    config = replace(SHORT, seed=0, time_ps=0.4)
    a, b = (frames(simulate(alanine_dipeptide, config, tmp_path / f"{k}.h5")) for k in range(2))
    np.testing.assert_array_equal(a, b)


def test_replicas_are_the_runs_of_their_seeds_and_independent(
    alanine_dipeptide: Scene, first: Path, tmp_path: Path
) -> None:
    outs = [tmp_path / f"r{k}.h5" for k in range(2)]
    simulate_replicas(alanine_dipeptide, replace(SHORT, starts="one"), outs)
    np.testing.assert_array_equal(frames(outs[0]), frames(first))
    alone = simulate(alanine_dipeptide, replace(SHORT, seed=SHORT.seed + 1), tmp_path / "alone.h5")
    np.testing.assert_array_equal(frames(outs[1]), frames(alone))
    series = []
    for out in outs:
        with open_trajectory(out) as reader:
            series.append(reader.scalars["temperature_k"])
    n_effective = effective_samples(len(series[0]), max(zero_crossing([s])[1] for s in series))
    assert abs(np.corrcoef(*series)[0, 1]) < STANDARD_ERRORS / math.sqrt(n_effective)
    # Negative control: the same run twice is not independent by this measure.
    assert np.corrcoef(series[0], series[0])[0, 1] > STANDARD_ERRORS / math.sqrt(n_effective)
