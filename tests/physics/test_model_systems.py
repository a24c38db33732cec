"""Model systems against known answers: equipartition, frequencies, populations, conservation, the published scheme."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from md_reference.forces.model_forces import build_model_system, build_nve_integrator, generate_n_body
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from systems.library.particles import (
    N_BODY,
    double_well,
    double_well_left_population,
    harmonic_answers,
    harmonic_oscillator,
    n_body,
    particles,
)
from systems.scene import FloatArray, Scene

MODEL = ForceFieldSpec("model", "vacuum")
STANDARD_ERRORS = 4.0
N_COPIES = 400


def copies(scene: Scene, n: int) -> Scene:
    """`n` independent particles in the well of a scene of one: its law acts on each."""
    law = dict(scene.interactions or {})
    return particles("copies", law, np.repeat(scene.positions_nm, n, axis=0), masses_da=np.full(n, scene.masses_da[0]))


def sampled(scene: Scene, temperature_k: float, *, n_frames: int, every_ps: float, settle_ps: float) -> FloatArray:
    """Positions `(n_frames, n_copies, 3)` nm in the bath; each particle is an independent run."""
    timestep_ps = 0.02
    with Engine(
        copies(scene, N_COPIES),
        Conditions(force=MODEL, temperature_k=temperature_k, timestep_ps=timestep_ps, seed=5, platform="Reference"),
    ) as engine:
        engine.thermalise()
        engine.step(round(settle_ps / timestep_ps))
        frames = np.empty((n_frames, N_COPIES, 3))
        for k in range(n_frames):
            engine.step(round(every_ps / timestep_ps))
            frames[k] = engine.positions()
    return frames


def agrees(per_particle: FloatArray, expected: Any) -> Any:
    """Whether the mean over independent particles `(n_copies, ...)` lies within its error of what is expected."""
    error = per_particle.std(axis=0, ddof=1) / np.sqrt(len(per_particle))
    return np.abs(per_particle.mean(axis=0) - expected) < STANDARD_ERRORS * error


# ---- one particle in a well ----------------------------------------------------------------------------------------


def test_the_harmonic_variance_is_kt_over_k_along_each_axis() -> None:
    scene = harmonic_oscillator()
    x = sampled(scene, 300.0, n_frames=40, every_ps=0.5, settle_ps=10.0)
    squares = (x**2).mean(axis=0)  # (n_copies, 3)
    expected = harmonic_answers(scene, 300.0)["variance_nm2"]
    np.testing.assert_allclose(expected, 8.314462618e-3 * 300.0 / np.array([50.0, 100.0, 200.0]), rtol=1e-9)
    assert agrees(squares, expected).all()
    assert agrees(x.mean(axis=0), 0.0).all()
    # Negative controls: another temperature, and the axes exchanged.
    assert not agrees(squares, harmonic_answers(scene, 330.0)["variance_nm2"]).any()
    assert not agrees(squares, expected[[1, 2, 0]]).any()


def free_run(scene: Scene, time_ps: float, *, timestep_ps: float = 0.001, n_frames: int = 50) -> tuple[Any, Any, Any]:
    """Times `(n,)`, positions and velocities `(n, n_particles, 3)` without a bath, from the scene's own velocities."""
    stride = round(time_ps / timestep_ps / n_frames)
    positions, velocities = np.empty((2, n_frames, scene.n_atoms, 3))
    with Engine(
        scene, Conditions(force=MODEL, ensemble="nve", timestep_ps=timestep_ps, platform="Reference")
    ) as engine:
        if scene.velocities_nm_ps is not None:
            engine.set_velocities(scene.velocities_nm_ps)
        for k in range(n_frames):
            engine.step(stride)
            state = engine.state(velocities=True)
            positions[k], velocities[k] = state.positions_nm, state.velocities_nm_ps
    return timestep_ps * stride * np.arange(1, n_frames + 1), positions, velocities


def test_the_harmonic_oscillator_has_the_frequency_root_k_over_m() -> None:
    scene = harmonic_oscillator()
    t, x, v = free_run(scene, 10.0)
    omega = harmonic_answers(scene, 300.0)["angular_frequency_per_ps"]
    np.testing.assert_allclose(omega, np.sqrt(np.array([50.0, 100.0, 200.0]) / 12.0), rtol=1e-12)

    def exact(frequency: FloatArray) -> tuple[FloatArray, FloatArray]:
        phase = t[:, None] * frequency
        return scene.positions_nm * np.cos(phase), -scene.positions_nm * frequency * np.sin(phase)

    np.testing.assert_allclose(x[:, 0], exact(omega)[0], atol=1e-5)
    np.testing.assert_allclose(v[:, 0], exact(omega)[1], atol=5e-5)
    # Negative control: one part in a thousand in the frequency, as from a mass of 12.02 Da, is seen.
    assert np.abs(x[:, 0] - exact(1.001 * omega)[0]).max() > 1e-3


@cache
def left_share(temperature_k: float) -> FloatArray:
    x = sampled(double_well(), temperature_k, n_frames=40, every_ps=1.0, settle_ps=40.0)
    return (x[..., 0] < 0).mean(axis=0)


def test_double_well_populations_are_those_of_the_boltzmann_density() -> None:
    from scipy.integrate import quad

    scene = double_well()
    expected = double_well_left_population(scene, 300.0)

    def weight(x: float) -> float:
        return float(np.exp(-(6.0 * ((x / 0.3) ** 2 - 1.0) ** 2 + 2.5 * x) / (8.314462618e-3 * 300.0)))

    left, right = quad(weight, -2.0, 0.0)[0], quad(weight, 0.0, 2.0)[0]
    assert expected == pytest.approx(left / (left + right), abs=1e-6)
    assert 0.6 < expected < 0.7
    share = left_share(300.0)
    assert share.std() > 0.0, "no particle crossed"
    assert agrees(share, expected), f"{share.mean():.3f} against {expected:.3f}"
    # Negative controls: the tilt the other way round, no tilt, and a bath of 600 K.
    assert not agrees(share, 1.0 - expected)
    assert not agrees(share, 0.5)
    assert not agrees(share, double_well_left_population(scene, 600.0))


# ---- laws of pairs -------------------------------------------------------------------------------------------------


def plain_energy(scene: Scene, x: FloatArray) -> float:
    """The energy by the law's formula in plain NumPy."""
    law = scene.interactions or {}
    i, j = np.triu_indices(scene.n_atoms, k=1)
    r2 = ((x[i] - x[j]) ** 2).sum(axis=1)
    if law["kind"] == "coulomb":
        q = np.array(law["charges_e"])
        return float((law["coulomb_constant"] * q[i] * q[j] / np.sqrt(r2)).sum())
    if law["kind"] == "gravity":
        m = scene.masses_da
        return float((-law["gravitational_constant"] * m[i] * m[j] / np.sqrt(r2 + law["softening_nm"] ** 2)).sum())
    rows = np.array([[a, b] in law["pairs"] for a, b in zip(i.tolist(), j.tolist(), strict=True)])
    return float(0.5 * law["force_constant_kj_mol_nm2"] * r2[rows].sum())


@pytest.mark.parametrize("name", N_BODY)
def test_energies_and_forces_are_those_of_the_law(name: str) -> None:
    scene = n_body(name, 3)
    x = scene.positions_nm
    with Engine(scene, Conditions(force=MODEL, platform="Reference")) as engine:
        assert engine.energy() == pytest.approx(plain_energy(scene, x), rel=1e-10)
        forces = engine.forces()
    numeric = np.empty_like(x)
    for k, axis in np.ndindex(*x.shape):
        ends = []
        for sign in (1, -1):
            moved = x.copy()
            moved[k, axis] += sign * 1e-5
            ends.append(plain_energy(scene, moved))
        numeric[k, axis] = (ends[1] - ends[0]) / 2e-5
    scale = np.abs(numeric).max()
    np.testing.assert_allclose(forces, numeric, atol=1e-7 * scale)
    # Negative control: another seed's law or positions give other forces.
    with Engine(n_body(name, 4), Conditions(force=MODEL, platform="Reference")) as other:
        assert np.abs(other.forces() - numeric).max() > 1e-2 * scale


def pair(law: dict[str, Any], distance_nm: float, *, masses: tuple[float, float], speeds: tuple[float, float]) -> Scene:
    """Two particles on the x axis, their centre of mass in the origin, moving along y."""
    heavy = np.array(masses)
    x = np.array([-heavy[1], heavy[0]]) / heavy.sum() * distance_nm
    positions, velocities = np.zeros((2, 2, 3))
    positions[:, 0], velocities[:, 1] = x, speeds
    return particles("pair", law, positions, masses_da=heavy, velocities_nm_ps=velocities)


def test_two_particles_under_gravity_go_round_in_their_period() -> None:
    law = {"kind": "gravity", "gravitational_constant": 1.0, "softening_nm": 0.1}
    distance, masses = 0.4, (1.0, 3.0)
    # Each on a circle about the centre of mass: mu omega^2 d = G m1 m2 d / (d^2 + s^2)^(3/2).
    omega = np.sqrt(sum(masses) / (distance**2 + 0.1**2) ** 1.5)
    radii = np.array([-masses[1], masses[0]]) / sum(masses) * distance
    scene = pair(law, distance, masses=masses, speeds=tuple(omega * radii))
    period = 2.0 * np.pi / omega
    timestep = period / 5000
    _, x, v = free_run(scene, period, timestep_ps=timestep)
    np.testing.assert_allclose(x[-1], scene.positions_nm, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(x[:, 0] - x[:, 1], axis=1), distance, atol=1e-6)
    energies = [plain_energy(scene, f) + 0.5 * (scene.masses_da * (w**2).sum(axis=1)).sum() for f, w in zip(x, v)]
    momenta = (scene.masses_da[:, None] * v).sum(axis=1)
    turning = (scene.masses_da[:, None] * np.cross(x, v)).sum(axis=1)
    np.testing.assert_allclose(energies, energies[0], rtol=1e-6)
    np.testing.assert_allclose(momenta, 0.0, atol=1e-12)
    np.testing.assert_allclose(turning, np.broadcast_to(turning[0], turning.shape), rtol=1e-10, atol=1e-12)
    # Negative controls: without the softening, or with the heavy particle's mass forgotten, the circle does not close.
    for wrong in (law | {"softening_nm": 1e-6}, law | {"gravitational_constant": 0.99}):
        _, y, _ = free_run(replace(scene, interactions=wrong), period, timestep_ps=timestep)
        assert np.abs(y[-1] - scene.positions_nm).max() > 1e-2
    light = replace(scene, masses_da=np.array([1.0, 1.0]))
    assert np.abs(free_run(light, period, timestep_ps=timestep)[1][-1] - scene.positions_nm).max() > 1e-2


def test_two_particles_on_a_spring_swing_in_its_period() -> None:
    law = {"kind": "springs", "force_constant_kj_mol_nm2": 0.1, "pairs": [[0, 1]]}
    masses = (1.0, 3.0)
    scene = pair(law, 0.8, masses=masses, speeds=(0.3, -0.1))
    omega = np.sqrt(0.1 * (1.0 / masses[0] + 1.0 / masses[1]))
    t, x, v = free_run(scene, 20.0, timestep_ps=0.005)
    apart = x[:, 1] - x[:, 0]

    def exact(frequency: float) -> FloatArray:
        start = scene.positions_nm[1] - scene.positions_nm[0]
        speed = scene.velocities_nm_ps[1] - scene.velocities_nm_ps[0]
        phase = frequency * t[:, None]
        return start * np.cos(phase) + speed / frequency * np.sin(phase)

    np.testing.assert_allclose(apart, exact(omega), atol=1e-5)
    energies = [plain_energy(scene, f) + 0.5 * (scene.masses_da * (w**2).sum(axis=1)).sum() for f, w in zip(x, v)]
    np.testing.assert_allclose(energies, energies[0], rtol=1e-6)
    np.testing.assert_allclose((scene.masses_da[:, None] * v).sum(axis=1), 0.0, atol=1e-12)
    # Negative controls: each spring counted twice, or one part in a hundred in the force constant.
    for factor in (2.0, 1.01):
        assert np.abs(apart - exact(np.sqrt(factor) * omega)).max() > 1e-2


@pytest.mark.parametrize("product", [1.0, -1.0])
def test_like_charges_part_and_unlike_ones_meet(product: float) -> None:
    law = {"kind": "coulomb", "coulomb_constant": 1.0, "charges_e": [1.0, product]}
    scene = pair(law, 2.0, masses=(1.0, 1.0), speeds=(0.0, 0.0))
    _, x, v = free_run(scene, 1.0)
    apart = np.linalg.norm(x[-1, 0] - x[-1, 1])
    assert (apart - 2.0) * product > 0.1
    kinetic = 0.5 * (v[-1] ** 2).sum()
    assert kinetic == pytest.approx(product * (1.0 / 2.0 - 1.0 / apart), rel=1e-5)


# ---- the published generator ---------------------------------------------------------------------------------------


def plain_forces(scene: Scene, x: FloatArray) -> FloatArray:
    law = scene.interactions or {}
    away = x[:, None] - x[None]
    r2 = (away**2).sum(axis=-1)
    np.fill_diagonal(r2, 1.0)
    if law["kind"] == "coulomb":
        q = np.array(law["charges_e"])
        size = law["coulomb_constant"] * q[:, None] * q[None] / r2**1.5
    elif law["kind"] == "springs":
        size = np.zeros_like(r2)
        for i, j in law["pairs"]:
            size[i, j] = size[j, i] = -law["force_constant_kj_mol_nm2"]
    else:
        size = -scene.masses_da[:, None] * scene.masses_da[None] / (r2 + law["softening_nm"] ** 2) ** 1.5
    forces = (size[..., None] * away).sum(axis=1)
    return np.clip(forces, -100.0, 100.0) if "max_force_kj_mol_nm" in law else forces


def published(scene: Scene, integrator: str, n_steps: int) -> tuple[FloatArray, FloatArray]:
    """The published scheme in plain NumPy, masses 1, step 0.001."""
    x, v = scene.positions_nm.copy(), np.array(scene.velocities_nm_ps)
    for _ in range(n_steps):
        if integrator == "kick-drift":
            v += 1e-3 * plain_forces(scene, x)
            x += 1e-3 * v
        else:
            v += 5e-4 * plain_forces(scene, x)
            x += 1e-3 * v
            v += 5e-4 * plain_forces(scene, x)
    return x, v


@pytest.mark.parametrize("name", N_BODY)
def test_trajectories_are_those_of_the_published_scheme(name: str) -> None:
    made = generate_n_body(name, [11, 12], n_frames=4)
    protocol = N_BODY[name]
    assert made.positions_nm.shape == (2, 4, protocol.n_particles, 3)
    np.testing.assert_allclose(made.time_ps, protocol.first_frame_ps + 0.1 * np.arange(4))
    for row, seed in enumerate(made.seeds):
        for frame in (0, 3):
            x, v = published(n_body(name, seed), protocol.integrator, round(made.time_ps[frame] / 1e-3))
            np.testing.assert_allclose(made.positions_nm[row, frame], x, atol=1e-9)
            np.testing.assert_allclose(made.velocities_nm_ps[row, frame], v, atol=1e-9)
    # Negative control: the other scheme is not within a thousand times that.
    other = "kick-drift-kick" if protocol.integrator == "kick-drift" else "kick-drift"
    x, _ = published(n_body(name, 12), other, round(made.time_ps[3] / 1e-3))
    assert np.abs(x - made.positions_nm[1, 3]).max() > 1e-6


def test_a_set_made_in_parts_is_the_same_set() -> None:
    whole = generate_n_body("n-body-spring", range(4), n_frames=2)
    part = generate_n_body("n-body-spring", [2, 3], n_frames=2)
    np.testing.assert_array_equal(whole.positions_nm[2:], part.positions_nm)
    np.testing.assert_array_equal(whole.edges[2:], part.edges)
    assert np.abs(whole.positions_nm[0] - part.positions_nm[0]).max() > 0.1


def test_published_forces_are_cut_at_a_hundred() -> None:
    import openmm

    law = {"kind": "coulomb", "coulomb_constant": 1.0, "charges_e": [1.0, 1.0], "max_force_kj_mol_nm": 100.0}
    close = particles("close", law, [[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]], masses_da=[1.0, 1.0],
                      provenance={"library_name": "n-body-charged"})  # fmt: skip
    speeds = []
    for largest in (100.0, None):
        scene = replace(close, interactions={k: v for k, v in law.items() if largest or not k.startswith("max")})
        integrator = build_nve_integrator(scene, 0.001)
        context = openmm.Context(build_model_system(scene), integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions(scene.positions_nm)
        integrator.step(1)
        speeds.append(context.getState(velocities=True).getVelocities(asNumpy=True)._value[:, 0])
    np.testing.assert_allclose(speeds[0], [-0.1, 0.1], rtol=1e-9)
    np.testing.assert_allclose(speeds[1], [-10.0, 10.0], rtol=1e-9)
