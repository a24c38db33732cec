"""Umbrella potentials of torsions: their force, what files say of them, and that weighted frames are equilibrium's."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import openmm
import pytest

from md_reference.forces.forcefield import build_system
from md_reference.forces.spec import ForceFieldSpec
from md_reference.forces.umbrella import Umbrella
from md_reference.run.config import MDConfig
from md_reference.run.replicas import simulate_batch
from md_reference.run.simulate import simulate
from md_reference.simd.force_field import n_replicas
from surrogate.comparison.md_answer import md_answer
from surrogate.comparison.read.ensemble import load_ensemble
from surrogate.data import collect_frames
from surrogate.verbs.compare import compare
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions
from systems.errors import InputError
from systems.prepare.peptide import build_peptide
from systems.trajectory.codec import DIFFERENCE_COLUMN, frame_factors, open_trajectory

SCENE = build_peptide("ACE-ALA-NME")
PSI = backbone_torsions(SCENE)["psi"]
# Cosine and sine of the angle, then of twice the angle.
UMBRELLA = Umbrella((tuple(PSI[0].tolist()),), ((3.0, -1.0, 0.5, 2.0),))
CONFIG = MDConfig(
    time_ps=4.0, equilibrate_ps=1.0, seed=4, platform="simd", force=ForceFieldSpec("ff14SB", "obc2"), umbrella=UMBRELLA
)
HOT_K = 500.0
needs_compiler = pytest.mark.skipif(not (shutil.which("g++") or shutil.which("c++")), reason="no C++ compiler")


def energy_kj_mol(positions_nm: np.ndarray, umbrella: Umbrella | None) -> float:
    system = build_system(SCENE, CONFIG.force)
    if umbrella is not None:
        system.addForce(umbrella.force())
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    context.setPositions(positions_nm)
    return float(context.getState(energy=True).getPotentialEnergy()._value)


def test_its_energies_are_those_of_its_force() -> None:
    frames = SCENE.positions_nm + np.random.default_rng(0).normal(0.0, 0.02, (5, SCENE.n_atoms, 3))
    added = [energy_kj_mol(x, UMBRELLA) - energy_kj_mol(x, None) for x in frames]
    assert np.allclose(UMBRELLA.energies_kj_mol(frames), added, atol=1e-6)
    psi = np.asarray(torsion(frames, PSI))[:, 0]
    waves = 3.0 * np.cos(psi) - np.sin(psi) + 0.5 * np.cos(2 * psi) + 2.0 * np.sin(2 * psi)
    assert np.ptp(UMBRELLA.energies_kj_mol(frames) - waves) < 1e-6, "up to a constant"


def test_it_lowers_what_lies_high_and_leaves_the_rest() -> None:
    """Of a torsion with a barrier of 4 kT, lowered to 1 kT above its lowest."""
    kt = 8.314462618e-3 * 300.0
    grid = np.linspace(-np.pi, np.pi, 2_000_001)
    energy = 2.0 * (1.0 - np.cos(2 * grid))
    chosen = np.random.default_rng(1).choice(grid, 400_000, p=np.exp(-energy) / np.exp(-energy).sum())
    found = Umbrella.of(PSI, chosen[:, None], [1.0], 300.0)
    x = np.array([0.0, np.pi / 2])

    def added(at: np.ndarray) -> np.ndarray:
        waves = zip(found.series_kj_mol[0][::2], found.series_kj_mol[0][1::2], strict=True)
        return sum(a * np.cos(n * at) + b * np.sin(n * at) for n, (a, b) in enumerate(waves, 1))

    low, high = added(x)
    assert high - low == pytest.approx(-3.0 * kt, abs=0.25 * kt)
    left = np.array([2.0 * (1.0 - np.cos(2 * y)) + added(np.array([y]))[0] / kt for y in grid[::20_000]])
    assert np.ptp(left) == pytest.approx(1.0, abs=0.35), "what is left is 1 kT high"
    assert Umbrella.of(PSI, chosen[:, None], [9.0], 300.0).series_kj_mol[0] == pytest.approx([0.0] * 12, abs=0.1)


@needs_compiler
@pytest.mark.parametrize("platform", ["simd", "Reference"])
def test_files_hold_the_energies_without_it_and_its_own(tmp_path: Path, platform: str) -> None:
    out, config = tmp_path / "a.h5", replace(CONFIG, platform=platform)
    if platform == "simd":
        simulate_batch(SCENE, config, [out])
    else:
        simulate(SCENE, config, out)
    with open_trajectory(out) as reader:
        frames, scalars = np.asarray(reader.read(), dtype=np.float64), reader.scalars
        assert reader.record["umbrella"]["series_kj_mol"] == [[3.0, -1.0, 0.5, 2.0]]
    assert np.allclose(scalars[DIFFERENCE_COLUMN], -UMBRELLA.energies_kj_mol(frames), atol=2e-3)
    exact = [energy_kj_mol(x, None) for x in frames]
    assert np.allclose(scalars["potential_kj_mol"], exact, atol=0.1), "frames are rounded"
    with pytest.raises(InputError, match="umbrella"):
        other = replace(config, umbrella=None)
        simulate_batch(SCENE, other, [out], resume=True) if platform == "simd" else simulate(
            SCENE, other, out, resume=True
        )


@needs_compiler
def test_weighted_frames_are_those_of_equilibrium(tmp_path: Path) -> None:
    """ψ crosses more often, and its populations, weighted, are those of MD without an umbrella: at 500 K, where
    chance moves them apart by 0.02."""
    long = replace(CONFIG, time_ps=1000.0, equilibrate_ps=20.0, temperature_k=HOT_K)
    plain = [tmp_path / f"plain{k}.h5" for k in range(n_replicas())]
    simulate_batch(SCENE, replace(long, umbrella=None), plain)
    psi = np.concatenate([np.asarray(torsion(x, PSI))[:, 0] for x in load_ensemble(plain).segments])
    bent = [tmp_path / f"bent{k}.h5" for k in range(n_replicas())]
    found = Umbrella.of(PSI, psi[:, None], [1.0], HOT_K)
    simulate_batch(SCENE, replace(long, umbrella=found), bent)
    md = load_ensemble(bent)
    assert md.differences_kj_mol is not None

    def strands(angles: np.ndarray) -> np.ndarray:
        degrees = np.rad2deg(angles) % 360.0
        return (degrees > 60.0) & (degrees < 240.0)

    own = [np.asarray(torsion(x, PSI))[:, 0] for x in md.segments]
    changes = [int(np.diff(strands(x).astype(int)).astype(bool).sum()) for x in (psi, np.concatenate(own))]
    assert changes[1] > 1.3 * changes[0]
    factors = np.concatenate(frame_factors(md.differences_kj_mol, HOT_K))
    shares = [
        strands(psi).mean(), np.average(strands(np.concatenate(own)), weights=factors),
        next(s.share for s in md_answer(md, HOT_K).states if s.state == "β"),
    ]  # fmt: skip
    assert np.abs(np.diff(shares)).max() < 0.05
    barrier = np.abs(np.rad2deg(np.concatenate(own)) - 75.0) < 25.0
    assert barrier.mean() > 1.5 * np.average(barrier, weights=factors), "unweighted they are not"


@needs_compiler
def test_nothing_that_counts_frames_alike_takes_them(tmp_path: Path) -> None:
    out, plain = tmp_path / "a.h5", tmp_path / "b.h5"
    simulate_batch(SCENE, replace(CONFIG, time_ps=30.0), [out])
    simulate_batch(SCENE, replace(CONFIG, time_ps=30.0, umbrella=None), [plain])
    with pytest.raises(InputError, match=r"a\.h5 is MD under an umbrella potential"):
        compare(plain, [out])
    with pytest.raises(InputError, match=r"a\.h5 was made under an umbrella potential"):
        collect_frames([plain, out])
    assert collect_frames([plain]).n_frames == 30
