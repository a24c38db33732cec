"""Rates of MD: lanes where they run and are faster, OpenMM and one plain line where not. Rates of rollouts."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from md_reference.forces.spec import ForceFieldSpec
from md_reference.run import lanes, plan
from md_reference.run.config import MDConfig
from md_reference.run.lanes import LanesUnavailableError
from surrogate.data.shipped import weights_path
from surrogate.data.weights import load_weights
from surrogate.verbs.run import rates as measuring
from surrogate.verbs.run.rates import Rates, Rolls, compiling_s, measure, rollout_rate
from systems.errors import InputError, SimulationError
from systems.prepare.peptide import build_peptide

SCENE = build_peptide("ACE-GLY-NME")
CONFIG = MDConfig(time_ps=1.0, force=ForceFieldSpec("ff14SB", "obc2"))
NO_COMPILER = "no C++ compiler (g++) was found, which platform lanes needs"


@pytest.fixture(autouse=True)
def timed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenMM takes 25 µs a step, sixteen replicas in lanes 32: 2 each."""

    def planned(scene: Any, config: MDConfig, *, replicas: int) -> Any:
        return SimpleNamespace(us_per_step=2.0 if config.platform == "lanes" else 25.0, line=config.platform)

    monkeypatch.setattr(plan, "make_plan", planned)
    monkeypatch.setattr(lanes, "n_lanes", lambda: 16)
    monkeypatch.setattr(measuring, "measured_stretch", lambda cores: 2.0)
    monkeypatch.setattr(measuring, "_covering", lambda *_: (None, "nothing covers it"))


def found(config: MDConfig = CONFIG) -> Rates:
    return measure(SCENE, config, None, cores=1)


def test_lanes_are_taken_where_they_are_faster() -> None:
    rates = found()
    assert (rates.platform, rates.at_once, rates.replicas, rates.md) == ("lanes", 16, 16, "lanes")
    assert rates.md_ps_per_s == pytest.approx(0.004 / 2e-6 / 2.0), "half of the core is others'"
    assert rates.openmm_ps_per_s == pytest.approx(0.004 / 25e-6 / 2.0) and rates.without_lanes == ""


def refuses(error: Exception) -> Callable[..., Any]:
    def plan_of(scene: Any, config: MDConfig, *, replicas: int) -> Any:
        if config.platform == "lanes":
            raise error
        return SimpleNamespace(us_per_step=25.0, line=config.platform)

    return plan_of


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (LanesUnavailableError(f"{NO_COMPILER}; take another platform."), NO_COMPILER),
        (LanesUnavailableError("platform lanes knows no CMAPTorsionForce; take another platform."), "CMAPTorsionForce"),
        (SimulationError("a copy of the molecule blew up"), "blew up"),
    ],
)
def test_where_lanes_cannot_openmm_runs_and_one_line_says_why(
    error: Exception, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan, "make_plan", refuses(error))
    rates = found()
    assert (rates.platform, rates.replicas) == ("auto", 1) and rates.md_ps_per_s == rates.openmm_ps_per_s
    assert rates.without_lanes.endswith(said) or said in rates.without_lanes
    assert "another platform" not in rates.without_lanes
    with pytest.raises(type(error)):
        found(replace(CONFIG, platform="lanes"))


def test_what_is_no_rival_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "make_plan", refuses(AssertionError("lanes were tried")))
    assert "bath" in found(replace(CONFIG, ensemble="nve")).without_lanes
    asked = found(replace(CONFIG, platform="CPU"))
    assert (asked.platform, asked.without_lanes) == ("CPU", "")
    assert found(replace(CONFIG, force=ForceFieldSpec("gfn2-xtb", "vacuum"))).dear


@pytest.mark.skipif(not (shutil.which("g++") or shutil.which("c++")), reason="no C++ compiler")
def test_without_a_compiler_the_line_is_plain(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:  # fmt: skip
    monkeypatch.undo()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(lanes, "_program", lanes._program.__wrapped__)
    monkeypatch.setattr(measuring, "_covering", lambda *_: (None, "nothing covers it"))
    assert found().without_lanes == NO_COMPILER


LONG_S = 1000.0


def rolls(name: str, roll_s: float, stretch: float = 1.0) -> Rolls:
    weights = load_weights(weights_path(name))
    return rollout_rate(weights.domain.scene, weights, 300.0, stretch, roll_s)


def test_a_potential_is_compiled_where_it_rolls_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def rate(scene: Any, weights: Any, how: Rolls, temperature_k: float) -> float:
        tried.append((how.compiled, weights.model.n_new))
        return 16.0 if how.compiled else 10.0

    monkeypatch.setattr(measuring, "_measured_rate", rate)
    long = rolls("paracetamol-gfn2-xtb", LONG_S, 2.0)
    assert (long.replicas, long.compiled, long.ps_per_s) == (32, True, 8.0), "half of the core is others'"
    assert long.how == "32 replicas of paracetamol-gfn2-xtb, compiled"
    assert tried == [(False, 1), (True, 1)], "a frame tells"
    short = rolls("paracetamol-gfn2-xtb", LONG_S, 6.0)
    assert (short.replicas, short.compiled, short.how) == (32, False, "32 replicas of paracetamol-gfn2-xtb")
    other = rolls("alanine-dipeptide", LONG_S)
    assert (other.replicas, other.compiled) == (8, False)
    assert [compiled for compiled, _ in tried] == [False, True, False, False]
    assert compiling_s(True, 2.0, LONG_S) > 0.0 == compiling_s(True, 2.0, 60.0) == compiling_s(False, 2.0, LONG_S)


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (InputError("compiling needs a C++ compiler; leave it out."), "compiling needs a C++ compiler"),
        (RuntimeError("CppCompileError: no space left\nmany lines"), "CppCompileError: no space left"),
        (None, "no faster here"),
    ],
)
def test_where_compiling_fails_a_potential_rolls_plain_and_one_line_says_why(
    error: Exception | None, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rate(scene: Any, weights: Any, how: Rolls, temperature_k: float) -> float:
        if how.compiled and error is not None:
            raise error
        return 10.0

    monkeypatch.setattr(measuring, "_measured_rate", rate)
    found = rolls("paracetamol-gfn2-xtb", LONG_S)
    assert (found.compiled, found.ps_per_s) == (False, 10.0)
    assert found.how == f"32 replicas of paracetamol-gfn2-xtb, not compiled ({why})"


def test_the_rate_is_that_of_a_rollout_of_so_many_replicas(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def rollout(scene: Any, weights: Any, outs: Any, config: Any, *, progress: Any, **_: Any) -> None:
        asked.append((len(outs), config.compile, config.time_ps))
        for k in range(3):
            progress(k, 3, "")

    monkeypatch.setattr("surrogate.sampling.runner.rollout", rollout)
    monkeypatch.setattr(measuring, "time", SimpleNamespace(monotonic=iter([0.0, 4.0, 9.0]).__next__))
    found = rolls("paracetamol-gfn2-xtb", 0.0)
    assert asked == [(32, False, pytest.approx(0.4))]
    assert found.ps_per_s == pytest.approx(32 * 0.1 / 4.0)
