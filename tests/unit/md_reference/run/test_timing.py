"""Which platform is chosen: by timings where there are any, remembered, on busy machines and with a bad cache too."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from md_reference.forces.spec import ForceFieldSpec
from md_reference.run import machine
from md_reference.run.config import Conditions
from md_reference.run.machine import (
    PlatformChoice,
    Timing,
    cache_file,
    choose_fastest,
    measured_platform,
    recall,
    remember,
    timing_key,
)
from systems.library.named_scenes import load
from systems.scene import Scene

BY_SIZE = PlatformChoice("Reference", 1, "by size")
VACUUM = ForceFieldSpec(solvent="vacuum")


@pytest.fixture(autouse=True)
def timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Timings on, and a cache of this test's own."""
    monkeypatch.setenv("SURROMD_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("SURROMD_TIMING")
    yield


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[list[tuple[str, int]]]:
    """What was timed, with invented results: CPU 40 µs on one thread and 15 on two, Reference 50."""
    asked: list[list[tuple[str, int]]] = []

    def invent(_: Any, __: Any, candidates: list[tuple[str, int]], *___: Any, **____: Any) -> list[Timing]:
        asked.append(candidates)
        speeds = {("CPU", 1): 40.0, ("CPU", 2): 15.0, ("Reference", 1): 50.0}
        return [Timing(*c, speeds.get(c)) for c in candidates]

    monkeypatch.setattr(machine, "time_platforms", invent)
    return asked


def chosen(*timings: Timing, **more: int) -> tuple[str, int]:
    choice = choose_fastest(list(timings), BY_SIZE, n_atoms=22, **more)
    return choice.name, choice.threads


def test_the_fastest_wins_and_threads_must_pay_for_themselves() -> None:
    cpu, reference = Timing("CPU", 1, 40.0), Timing("Reference", 1, 50.0)
    assert chosen(cpu, reference) == ("CPU", 1)
    assert chosen(reference, Timing("CPU", 1, 60.0)) == ("Reference", 1)
    assert chosen(cpu, Timing("CPU", 2, 36.0)) == ("CPU", 1)
    assert chosen(cpu, Timing("CPU", 2, 30.0)) == ("CPU", 2)
    assert chosen(cpu, Timing("CPU", 2, 30.0), Timing("CPU", 4, 28.0)) == ("CPU", 2)


def test_replicas_share_a_device() -> None:
    cpu, device = Timing("CPU", 1, 40.0), Timing("CUDA", 1, 25.0)
    assert chosen(cpu, device) == ("CUDA", 1)
    assert chosen(cpu, device, side_by_side=2) == ("CPU", 1)


def test_without_a_timing_the_size_decides() -> None:
    choice = choose_fastest([Timing("CPU", 1, None, "no device")], BY_SIZE, n_atoms=22)
    assert (choice.name, choice.reason) == ("Reference", "by size")
    assert choice.timings[0].note == "no device"


def test_what_was_timed_is_remembered_for_scenes_like_it(
    alanine_dipeptide: Scene, counted: list[list[tuple[str, int]]]
) -> None:
    first = measured_platform(alanine_dipeptide, Conditions(force=VACUUM))
    assert (first.name, len(counted)) == ("CPU", 1)
    again = measured_platform(alanine_dipeptide, Conditions(force=VACUUM))
    assert (again.name, len(counted)) == ("CPU", 1)
    assert {t.note for t in again.timings} == {"remembered"}
    assert [t.us_per_step for t in again.timings] == [40.0, 50.0]
    measured_platform(alanine_dipeptide, Conditions())
    assert len(counted) == 2, "another solvent is another timing"
    measured_platform(load("aspirin"), Conditions(force=ForceFieldSpec("gaff2", "vacuum")))
    assert len(counted) == 3, "another force field is another timing"


def test_size_classes_are_a_tenth_wide() -> None:
    def key(n_atoms: int) -> str:
        return timing_key(SimpleNamespace(n_atoms=n_atoms, interactions=None, cell_nm=None), VACUUM)  # type: ignore[arg-type]

    assert key(21) == key(22) != key(24)
    assert key(1010) == key(1050) != key(1200)


def test_threads_are_timed_beside_one_thread_and_only_where_they_may_win(
    alanine_dipeptide: Scene, counted: list[list[tuple[str, int]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    measured_platform(alanine_dipeptide, Conditions(force=VACUUM), max_threads=2)
    assert counted[-1] == [("CPU", 1), ("Reference", 1)]
    monkeypatch.setattr(machine, "_THREADS_TIMED_ATOMS", 1)
    choice = measured_platform(alanine_dipeptide, Conditions(force=VACUUM), max_threads=2)
    assert counted[-1] == [("CPU", 1), ("CPU", 2)]
    assert (choice.name, choice.threads) == ("CPU", 2)
    # Replicas that share the cores know of it and do not take them.
    assert measured_platform(alanine_dipeptide, Conditions(force=VACUUM), max_threads=1).threads == 1


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00\xff garbage",
        b"[1, 2]",
        b'{"format": 99, "us_per_step": {}}',
        b'{"format": 1, "us_per_step": [1]}',
        b'{"format": 1, "us_per_step": {"MACHINE": [3]}}',
        b'{"format": 1, "us_per_step": {"MACHINE": {"KEY": {"CPU/1": -3, "Reference/1": "fast", "x": null}}}}',
    ],
)
def test_a_damaged_cache_is_ignored_and_replaced(
    alanine_dipeptide: Scene, counted: list[list[tuple[str, int]]], content: bytes
) -> None:
    key = timing_key(alanine_dipeptide, VACUUM)
    text = content.replace(b"MACHINE", machine.machine_name().encode()).replace(b"KEY", key.encode())
    cache_file().parent.mkdir(parents=True)
    cache_file().write_bytes(text)
    assert recall(key) == {}
    assert measured_platform(alanine_dipeptide, Conditions(force=VACUUM)).name == "CPU"
    assert len(counted) == 1
    assert recall(key) == {"CPU/1": 40.0, "Reference/1": 50.0}


def test_the_cache_is_never_written_half(monkeypatch: pytest.MonkeyPatch) -> None:
    remember("a", [Timing("CPU", 1, 1.0)])
    before = cache_file().read_bytes()

    def killed(*_: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(os, "replace", killed)
    remember("b", [Timing("CPU", 1, 2.0)])  # without a word: a run does not fail for want of a cache
    assert cache_file().read_bytes() == before
    assert sorted(p.name for p in cache_file().parent.iterdir()) == [cache_file().name]


def test_timings_of_another_machine_are_kept_and_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    remember("a", [Timing("CPU", 1, 1.0)])
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(machine, "machine_name", lambda: "another")
        assert recall("a") == {}
        remember("a", [Timing("CPU", 1, 2.0)])
    assert recall("a") == {"CPU/1": 1.0}
    assert len(json.loads(cache_file().read_text())["us_per_step"]) == 2


def test_switched_off_the_size_decides_and_nothing_is_touched(
    alanine_dipeptide: Scene, counted: list[list[tuple[str, int]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SURROMD_TIMING", "off")
    assert measured_platform(alanine_dipeptide, Conditions(force=VACUUM)).name == "Reference"
    assert not counted and not cache_file().exists()
    monkeypatch.delenv("SURROMD_TIMING")
    assert measured_platform(alanine_dipeptide, Conditions(force=VACUUM, platform="Reference")).reason == "asked for"
    assert not counted


def test_real_steps_of_alanine_dipeptide(alanine_dipeptide: Scene) -> None:
    """Processor time, so this holds on a loaded machine: 9 against 44 µs a step in vacuum."""
    choice = measured_platform(alanine_dipeptide, Conditions(force=VACUUM))
    assert choice.name == "Reference"
    by_name = {t.platform: t.us_per_step for t in choice.timings}
    assert by_name["Reference"] is not None and by_name["CPU"] is not None
    assert 1.0 < by_name["Reference"] < by_name["CPU"] / 1.5
    assert "measured" in choice.reason


def test_on_busy_cores_threads_are_not_timed(alanine_dipeptide: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def batch(wall_over_cpu: float) -> Any:
        def fake(_: Any, candidate: tuple[str, int], __: int) -> tuple[float, float | None]:
            return (4e-5, wall_over_cpu) if candidate[1] == 1 else (3e-5, None)

        return fake

    monkeypatch.setattr(machine, "_THREADS_TIMED_ATOMS", 1)
    monkeypatch.setattr(machine, "_batch", batch(2.5))
    busy = measured_platform(alanine_dipeptide, Conditions(force=VACUUM), max_threads=2)
    assert busy.threads == 1
    assert "CPU/2" not in recall(timing_key(alanine_dipeptide, VACUUM)), "a number about other work was remembered"
    assert any("other work" in t.note for t in busy.timings)
    monkeypatch.setattr(machine, "_batch", batch(1.02))
    assert measured_platform(alanine_dipeptide, Conditions(force=VACUUM), max_threads=2).threads == 2
