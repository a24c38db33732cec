"""Rates of MD: SIMD where they run and are faster, OpenMM and one plain line where not. Rates of rollouts."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run import plan
from md_reference.run.config import MDConfig
from md_reference.simd import force_field
from md_reference.simd.system_terms import SimdUnavailableError
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.models.architecture import weights_path
from surrogate.models.potential import Potential
from surrogate.models.weights import load_weights
from surrogate.verbs.run import rates as measuring
from surrogate.verbs.run.rates import Rates, Rolls, measure, rollout_rate
from systems.chemistry.graph import backbone_torsions, bonded_graph, turned
from systems.errors import SimulationError
from systems.prepare.peptide import build_peptide

SCENE = build_peptide("ACE-GLY-NME")
CONFIG = MDConfig(time_ps=1.0, force=ForceFieldSpec("ff14SB", "obc2"))
NO_COMPILER = "no C++ compiler (g++) was found, which platform simd needs"


@pytest.fixture(autouse=True)
def timed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenMM takes 25 µs a step, sixteen SIMD replicas 32: 2 each."""

    def planned(scene: Any, config: MDConfig, *, replicas: int) -> Any:
        return SimpleNamespace(us_per_step=2.0 if config.platform == "simd" else 25.0, line=config.platform)

    monkeypatch.setattr(plan, "make_plan", planned)
    monkeypatch.setattr(force_field, "n_replicas", lambda: 16)
    monkeypatch.setattr(measuring, "measured_stretch", lambda cores: 2.0)
    monkeypatch.setattr(measuring, "_covering", lambda *_: (None, "nothing covers it"))


def found(config: MDConfig = CONFIG) -> Rates:
    return measure(SCENE, config, None, cores=1)


def test_simd_are_taken_where_they_are_faster() -> None:
    rates = found()
    assert (rates.platform, rates.at_once, rates.replicas, rates.md) == ("simd", 16, 16, "simd")
    assert rates.md_ps_per_s == pytest.approx(0.004 / 2e-6 / 2.0), "half of the core is others'"
    assert rates.openmm_ps_per_s == pytest.approx(0.004 / 25e-6 / 2.0) and rates.without_simd == ""


COVERING = measuring._covering


def test_what_is_written_counts_not_the_water_around_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report on 19 atoms takes seconds; on 983 it was to take a minute of two."""
    monkeypatch.setattr(measuring, "_covering", COVERING)
    rolled: list[Rolls] = []

    def rolled_once(*how: Any) -> Rolls:  # it takes seconds, whatever is written
        rolled.extend([] if rolled else [rollout_rate(*how)])
        return rolled[0]

    monkeypatch.setattr(measuring, "rollout_rate", rolled_once)
    wet = solvate(SCENE, spec := ForceFieldSpec("ff14SB", "tip3p"), WaterBox())
    config = replace(CONFIG, force=spec)
    rates = measure(wet, config, None, cores=1)
    assert rates.platform == "simd" and rates.n_atoms == SCENE.n_atoms < wet.n_atoms
    assert measure(wet, replace(config, keep="all"), None, cores=1).n_atoms == wet.n_atoms
    assert "shipped peptides" in rates.coverage, "the molecule is known in water, too"
    other = measure(wet, replace(config, force=replace(spec, force_field="ff19SB")), None, cores=1)
    assert "force_field ff14SB, not ff19SB" in other.coverage
    slower = replace(config, platform="CPU")
    assert measure(wet, slower, None, cores=1).n_atoms == wet.n_atoms, "OpenMM writes all"


def refuses(error: Exception) -> Callable[..., Any]:
    def plan_of(scene: Any, config: MDConfig, *, replicas: int) -> Any:
        if config.platform == "simd":
            raise error
        return SimpleNamespace(us_per_step=25.0, line=config.platform)

    return plan_of


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (SimdUnavailableError(f"{NO_COMPILER}; use another platform."), NO_COMPILER),
        (SimdUnavailableError("platform simd does not support CMAP; use another platform."), "CMAP"),
        (SimulationError("a copy of the molecule blew up"), "blew up"),
    ],
)
def test_where_simd_cannot_openmm_runs_and_one_line_says_why(
    error: Exception, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan, "make_plan", refuses(error))
    rates = found()
    assert (rates.platform, rates.replicas) == ("auto", 1) and rates.md_ps_per_s == rates.openmm_ps_per_s
    assert rates.without_simd.endswith(said) or said in rates.without_simd
    assert "another platform" not in rates.without_simd
    with pytest.raises(type(error)):
        found(replace(CONFIG, platform="simd"))


def test_what_is_no_rival_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "make_plan", refuses(AssertionError("SIMD was tried")))
    assert "bath" in found(replace(CONFIG, ensemble="nve")).without_simd
    asked = found(replace(CONFIG, platform="CPU"))
    assert (asked.platform, asked.without_simd) == ("CPU", "")
    assert found(replace(CONFIG, force=ForceFieldSpec("gfn2-xtb", "vacuum"))).expensive


@pytest.mark.skipif(not (shutil.which("g++") or shutil.which("c++")), reason="no C++ compiler")
def test_without_a_compiler_the_line_is_plain(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:  # fmt: skip
    monkeypatch.undo()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(force_field, "_program", force_field._program.__wrapped__)
    monkeypatch.setattr(measuring, "_covering", lambda *_: (None, "nothing covers it"))
    assert found().without_simd == NO_COMPILER


@pytest.mark.parametrize(
    ("wall_s", "processor_s"),
    [([0.0, 4.0, 9.0], [0.0, 8.0, 16.0]), ([0.0, 40.0, 90.0], [0.0, 4.0, 9.0])],
    ids=["two cores", "interrupted"],
)
@pytest.mark.parametrize(
    ("name", "replicas", "chunk_ps"), [("paracetamol-gfn2-xtb", 64, 0.1), ("alanine-dipeptide", 8, 70.0)]
)
def test_the_rate_is_that_of_a_rollout_of_so_many_replicas(
    name: str, replicas: int, chunk_ps: float, wall_s: list[float], processor_s: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    asked = []

    def rollout(scene: Any, weights: Any, outs: Any, config: Any, *, progress: Any, **_: Any) -> None:
        asked.append((len(outs), config.time_ps))
        for k in range(3):
            progress(k, 3, "")

    weights = load_weights(weights_path(name))
    monkeypatch.setattr("surrogate.sampling.runner.rollout", rollout)
    monkeypatch.setattr(measuring, "_relaxations_ps", lambda files: (40.0, 8.0))
    clocks = {"monotonic": iter(wall_s).__next__, "process_time": iter(processor_s).__next__}
    monkeypatch.setattr(measuring, "time", SimpleNamespace(**clocks))
    found = rollout_rate(weights.domain.scene, weights, 300.0, 2.0, 4)
    assert asked == [(replicas, pytest.approx(6 * chunk_ps))], "of a potential a frame a chunk tells"
    assert found.replicas == replicas
    assert found.relaxation_ps == (0.0 if isinstance(weights.model, Potential) else 40.0), (
        "so few frames show no relaxation"
    )
    assert found.ps_per_s == pytest.approx(replicas * chunk_ps / 4.0 / 2.0), "half of the core is others'"


def test_weights_for_several_lags_are_measured_by_long_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def rollout(scene: Any, weights: Any, outs: Any, config: Any, *, progress: Any, **_: Any) -> None:
        asked.append(config)
        for k in range(4):
            progress(k, 3, "")

    monkeypatch.setattr("surrogate.sampling.runner.rollout", rollout)
    monkeypatch.setattr(measuring, "_relaxations_ps", lambda files: (1_500.0, 200.0))
    weights = load_weights(weights_path("peptides"))
    rolls = rollout_rate(build_peptide("ACE-ALA-NME"), weights, 300.0, 1.0, 1)
    assert rolls.lag_ps == 10.0 and asked[0].save_every_ps == 100.0
    assert asked[0].time_ps == 6 * weights.model.n_new * 100.0
    rates = replace(found(), rolls=rolls)
    assert rates.relaxation_words == "a slowest relaxation of 1.5 ns, that of states 200 ps, as the first rollouts show"
    assert rates.usual_ps == 200.0 and found().usual_ps == found().relaxation_ps
    assert found().relaxation_words == "a slowest relaxation of 1 ns, assumed"


def test_the_slowest_relaxation_is_that_of_a_torsion_that_jumps(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, rng = build_peptide("ACE-ALA-NME"), np.random.default_rng(2)
    quad = backbone_torsions(scene)["psi"][0].tolist()
    other = turned(scene.positions_nm, quad, np.pi, bonded_graph(scene))
    for tau in (4.0, 16.0):
        state = np.cumsum(rng.random((8, 500)) < 0.5 * -np.expm1(-1.0 / tau), axis=1) % 2
        frames = np.where(state[..., None, None] > 0, other, scene.positions_nm)
        frames = (frames + 1e-3 * rng.standard_normal(frames.shape)).astype(np.float32)
        rolled = Ensemble("rolled", list(frames), 100.0, scene)
        monkeypatch.setattr("surrogate.comparison.read.ensemble.load_ensemble", lambda files, rolled=rolled: rolled)
        slowest_ps, usual_ps = measuring._relaxations_ps([])
        assert 0.6 < slowest_ps / (100.0 * tau) < 1.7
        assert usual_ps <= slowest_ps


def test_the_usual_relaxation_of_states_is_that_of_their_populations() -> None:
    rng = np.random.default_rng(3)

    def jumping(tau: float, share: float) -> list[np.ndarray]:
        """Eight runs of an angle between two states, the first of that share, forgotten after `tau` frames."""
        runs = []
        for _ in range(8):
            state = [rng.random() < share]
            for _ in range(4999):
                state.append(rng.random() < share if rng.random() < -np.expm1(-1.0 / tau) else state[-1])
            runs.append(np.where(state, -1.5, 1.5) + 0.2 * rng.standard_normal(5000))
        return runs

    slow, fast, rare = jumping(40.0, 0.5), jumping(4.0, 0.5), jumping(40.0, 0.1)
    assert measuring.usual_relaxation([slow]) == pytest.approx(40.0, rel=0.25)
    assert measuring.usual_relaxation([slow, fast]) == pytest.approx(22.0, rel=0.25), "the mean of both"
    assert measuring.usual_relaxation([rare]) == pytest.approx(40.0 * 4 * 0.09, rel=0.35), (
        "what is rare is known sooner"
    )
    assert measuring.usual_relaxation([[0.1 * rng.standard_normal(500)]]) == 0.0
