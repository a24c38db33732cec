"""Runs that are killed or stopped at the seams of their stages go on with `resume` and end as if nothing had been."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from md_reference.run import replicas
from md_reference.simd.force_field import SimdReplicas, n_replicas
from quick_report import evaluated_at_once
from surrogate import api
from surrogate.verbs.options import RunOptions
from surrogate.verbs.run import one_scene, stages
from surrogate.verbs.run.decision import Decision, decide, least_budget_s
from surrogate.verbs.run.rates import REPLICAS, Rates, Rolls
from surrogate.verbs.run.run_record import RunRecord, read_run, write_run
from surrogate.verbs.run.stages import Site, StageOf
from systems.errors import InputError, SimulationError
from systems.library.named_scenes import prepare
from systems.trajectory.codec import frame_weights, open_trajectory

# As if a second of MD made a hundredth of a ps: runs end by their length, not by the clock.
RATES = Rates(22, 1, 1.0, False, "OBC2", 5e-3, 0.004, 0.1, "trained on it", Rolls("peptides", 1.0, 0.25))
BUDGET_S = 400.0
HAS_COMPILER = bool(shutil.which("g++") or shutil.which("c++"))
needs_compiler = pytest.mark.skipif(not HAS_COMPILER, reason="no C++ compiler")
AT_ONCE = n_replicas() if HAS_COMPILER else 4
OPENMM, SIMD = RATES, replace(RATES, platform="simd", at_once=AT_ONCE, md_ps_per_s=0.8)
# As if the molecule were in water, and the water not there.
WET = replace(SIMD, explicit=True, step_s=1e-4, md_ps_per_s=8.0)
# The budget that is just enough for MD under an umbrella, more for more replicas; lengths of such runs are that of it.
UMBRELLA_S = next(s for s in range(110, 600, 5) if decide(WET, s, "surrogate").seconds("umbrella md") > 0.0)
WAYS = [
    pytest.param(("md", OPENMM, ["md", "held-out md", "report"]), id="one replica"),
    pytest.param(("md", SIMD, ["md", "report"]), id="simd", marks=needs_compiler),
    pytest.param(("surrogate", OPENMM, ["rollout", "held-out md", "report"]), id="rollout"),
    pytest.param(("surrogate", WET, ["rollout", "umbrella md", "held-out md", "report"]), id="umbrella",
                 marks=needs_compiler),
]  # fmt: skip
Way = tuple[str, Rates, list[str]]
Undisturbed = Callable[[Way], tuple[Path, dict[str, Any]]]


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """No run asks for a name or a host."""

    def refused(*_: Any, **__: Any) -> None:
        raise AssertionError("a run asks the network")

    monkeypatch.setattr("socket.socket.connect", refused)
    monkeypatch.setattr("socket.getaddrinfo", refused)


class Killed(BaseException):
    """Nobody catches it: what is on disk is what a kill leaves."""


def run(folder: Path, asked: str, *, resume: bool = False, starts: str = "many") -> dict[str, Any]:
    options: dict[str, Any] = {"budget_s": BUDGET_S, "way": asked, "resume": resume, "starts": starts}
    return api.run("alanine-dipeptide", folder, quiet=True, **options)


def as_if_measured_at_once(rates: Rates, _: float, *how: Any, **more: Any) -> Decision:
    return decide(rates, UMBRELLA_S if rates == WET else BUDGET_S, *how, **more)


def frames(folder: Path) -> dict[str, Any]:
    found = {}
    for path in sorted(folder.glob("*/*.h5")):
        with open_trajectory(path) as reader:
            found[path.name] = np.asarray(reader.read())
    return found


def run_ids(folder: Path) -> dict[str, str]:
    """Return by which run each file was begun: one that starts over has another."""
    found = {}
    for path in sorted(folder.glob("*/*.h5")):
        with open_trajectory(path) as reader:
            found[path.name] = reader.run_id
    return found


def disturbed(stage: StageOf, *, before: Callable[[], None] = lambda: None, after: Callable[[], None] = lambda: None,
              ) -> StageOf:  # fmt: skip
    def work(site: Site, record: Any) -> Any:
        before()
        found = stage.work(site, record)
        after()
        return found

    return replace(stage, work=work)


def kill() -> None:
    raise Killed


def interrupt() -> None:
    """Ctrl-C, heard by the stage at its next look."""
    os.kill(os.getpid(), signal.SIGINT)


def ended(found: dict[str, Any]) -> list[tuple[str, str]]:
    return [(stage["name"], stage["status"]) for stage in found["stages"]]


@pytest.fixture(params=WAYS)
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Way:
    """A way to run, its rates, and its stages."""
    asked, rates, names = request.param
    monkeypatch.setattr(one_scene, "measure", lambda *_: rates)
    # However long it took to get there: lengths of runs are those of the whole budget.
    monkeypatch.setattr(one_scene, "decide", as_if_measured_at_once)
    monkeypatch.setitem(stages.STAGES, "report", replace(stages.STAGES["report"], work=evaluated_at_once))
    return asked, rates, names


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    """Return the folder of a run that nothing disturbs, made once a way and read only, and what it returned."""
    made: dict[str, tuple[Path, dict[str, Any]]] = {}

    def of(way: Way) -> tuple[Path, dict[str, Any]]:
        if (key := str(way)) not in made:
            folder = tmp_path_factory.mktemp("whole")
            made[key] = folder, run(folder, way[0])
        return made[key]

    return of


def test_kills_before_and_after_each_stage_change_nothing(
    way: Way, undisturbed: Undisturbed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, rates, names = way
    killed = tmp_path / "killed"
    whole, expected = undisturbed(way)
    assert ended(expected) == [(name, "done") for name in names]
    begun: dict[str, str] = {}
    for k, name in enumerate(names):
        for moment in ({"before": kill}, {"after": kill}):
            with monkeypatch.context() as patch:
                patch.setitem(stages.STAGES, name, disturbed(stages.STAGES[name], **moment))
                with pytest.raises(Killed):
                    run(killed, asked, resume=True)
            assert [entry.name for entry in read_run(killed).stages] == names[:k], "what had ended, and no more"
            begun = run_ids(killed) | begun
    found = run(killed, asked, resume=True)
    assert ended(found) == ended(expected) and found["outcome"] == expected["outcome"]
    assert run_ids(killed) == begun, "nothing was made twice"
    kept, right = frames(killed), frames(whole)
    beside = {OPENMM: 1, SIMD: 0, WET: 2 * rates.replicas}[rates]
    assert len(kept) == {"md": rates.replicas, "surrogate": REPLICAS}[asked] + beside
    assert kept.keys() == right.keys()
    for name, positions in right.items():
        assert np.array_equal(kept[name], positions), name


@needs_compiler
def test_md_under_an_umbrella_gives_the_answer_and_the_starts_of_held_out_md(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(one_scene, "measure", lambda *_: WET)
    monkeypatch.setattr(one_scene, "decide", lambda rates, left_s, *how, **more: decide(rates, BUDGET_S, *how, **more))
    monkeypatch.setitem(stages.STAGES, "report", replace(stages.STAGES["report"], work=evaluated_at_once))
    folder, begun = tmp_path / "a", []
    simulated = replicas.simulate_batch

    def stopped(scene: Any, config: Any, outs: list[Path], **how: Any) -> None:
        """The stage under an umbrella is stopped by the clock, as it always is."""
        begun.append((config, how.get("starts_nm")))
        if config.umbrella is not None:
            simulated(scene, replace(config, time_ps=2.0 * config.time_ps), outs, **how | {"progress": at_end(config)})
        else:
            simulated(scene, config, outs, **how)

    def at_end(config: Any) -> Callable[..., None]:
        def progress(done: int, total: int, note: str | None = None) -> None:
            if note is None and done >= config.n_frames:
                raise KeyboardInterrupt

        return progress

    monkeypatch.setattr(replicas, "simulate_batch", stopped)
    monkeypatch.setattr(one_scene.Clock, "work", lambda self, said, s, stage: ended_by_the_clock(stage))
    found = run(folder, "surrogate")
    assert ended(found) == [("rollout", "done"), ("umbrella md", "out of time"), ("held-out md", "done"),
                            ("report", "done")]  # fmt: skip
    (_, drawn), (config, left) = begun
    assert config.umbrella is None and config.starts == "rollout"
    with open_trajectory(folder / found["umbrella"][3]) as reader:
        assert reader.record["umbrella"] and np.allclose(reader.read()[-1] - reader.read()[-1].mean(0),
                                                        left[3] - left[3].mean(0), atol=1e-3)  # fmt: skip
    assert drawn is not None and not np.allclose(drawn[3], left[3])
    record = read_run(folder)
    site = Site(folder, prepare("alanine-dipeptide"), config, RunOptions())
    answer = stages.answer_of(site, record)
    assert answer is not None and answer.under_umbrella and not answer.relaxation_ps
    assert f"MD under an umbrella potential of torsions is {AT_ONCE} replicas" in answer.in_short[2]
    assert found.md == [folder / file for file in record.umbrella] and len(found.md) == AT_ONCE
    weights = np.concatenate([frame_weights(path) for path in found.md])
    assert weights.std() > 0.1 and weights.mean() == pytest.approx(1.0)


@needs_compiler
def test_a_run_in_water_goes_on_with_the_stages_that_it_began_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its held-out MD could not become shorter, as it would be beside MD under an umbrella."""
    monkeypatch.setattr(one_scene, "measure", lambda *_: WET)
    monkeypatch.setattr(one_scene, "decide", lambda rates, left_s, *how, whole_s=0.0, **more:
                        decide(rates, whole_s or left_s, *how, **more))  # fmt: skip
    monkeypatch.setitem(stages.STAGES, "report", replace(stages.STAGES["report"], work=evaluated_at_once))
    short_s, long_s = UMBRELLA_S - 5.0, UMBRELLA_S + 25.0
    options: dict[str, Any] = {"way": "surrogate", "quiet": True}
    first = api.run("alanine-dipeptide", tmp_path / "a", budget_s=short_s, **options)
    names = ["rollout", "held-out md", "report"]
    assert [stage["name"] for stage in first["stages"]] == names
    went_on = api.run("alanine-dipeptide", tmp_path / "a", budget_s=long_s, resume=True, **options)
    assert ended(went_on) == [(name, "done") for name in names] and not went_on["umbrella"]


def ended_by_the_clock(stage: Callable[[], Any]) -> Any:
    try:
        return stage()
    except KeyboardInterrupt:
        return None


@needs_compiler
def test_md_begins_at_frames_of_the_rollout_and_does_so_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(one_scene, "measure", lambda *_: SIMD)
    monkeypatch.setattr(one_scene, "decide", as_if_measured_at_once)
    monkeypatch.setitem(stages.STAGES, "report", replace(stages.STAGES["report"], work=evaluated_at_once))
    one, two = tmp_path / "one", tmp_path / "two"
    run(one, "surrogate")
    with monkeypatch.context() as patch:
        patch.setitem(stages.STAGES, "held-out md", disturbed(stages.STAGES["held-out md"], after=kill))
        with pytest.raises(Killed):
            run(two, "surrogate")
    run(two, "surrogate", resume=True)
    with open_trajectory(one / "reference" / "held_out_r3.h5") as reader:
        assert reader.record["starts"] == "rollout"
    first, second = frames(one), frames(two)
    assert len(first) == REPLICAS + AT_ONCE and first.keys() == second.keys()
    assert all(np.array_equal(first[name], second[name]) for name in first)


@needs_compiler
@pytest.mark.parametrize("good_frames", [0, 5])
def test_where_simd_blow_up_openmm_goes_on_and_nothing_is_lost(
    good_frames: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count, step = [0], SimdReplicas.step

    def fails(self: SimdReplicas, n: int) -> None:
        count[0] += 1
        if count[0] > good_frames + 1:  # the first equilibrates
            raise SimulationError("a copy of the molecule blew up")
        step(self, n)

    monkeypatch.setattr(SimdReplicas, "step", fails)
    monkeypatch.setattr(one_scene, "measure", lambda *_: SIMD)
    monkeypatch.setitem(stages.STAGES, "report", replace(stages.STAGES["report"], work=evaluated_at_once))
    found = run(tmp_path / "run", "md", starts="one")
    assert ended(found) == [("md", "done"), ("held-out md", "done"), ("report", "done")]
    assert found["rates"]["platform"] == "auto" and "blew up" in found["decision"]["why"][0]
    assert "MD by SIMD replicas failed (" in (tmp_path / "run" / "log.txt").read_text("utf-8")
    kept = frames(tmp_path / "run")
    by_simd = [len(positions) for name, positions in kept.items() if "openmm" not in name]
    assert by_simd == [good_frames] * (AT_ONCE if good_frames else 0)
    assert len(kept["md-openmm.h5"]) > 20 and len(kept["held_out-openmm.h5"]) > 20
    evaluated = [Path(name).name for name in (*found["trajectory"], *found["held_out"])]
    assert sorted(evaluated) == sorted(kept) and "md-openmm.h5" in evaluated[: len(found["trajectory"])]
    assert run(tmp_path / "run", "md", resume=True, starts="one")["outcome"] == found["outcome"]


@pytest.mark.parametrize(
    ("asked", "name", "ends"),
    [
        ("md", "md", [("md", "out of time"), ("report", "done")]),
        ("surrogate", "rollout", [("rollout", "out of time"), ("held-out md", "done"), ("report", "done")]),
    ],
)
def test_a_stage_that_has_no_time_to_go_on_keeps_its_frames(
    asked: str, name: str, ends: list[tuple[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates = replace(OPENMM, cores=2 if asked == "md" else 1)
    monkeypatch.setattr(one_scene, "measure", lambda *_: rates)
    monkeypatch.setitem(stages.STAGES, "report", replace(stages.STAGES["report"], work=evaluated_at_once))
    with monkeypatch.context() as patch:
        patch.setitem(stages.STAGES, name, disturbed(stages.STAGES[name], after=kill))
        with pytest.raises(Killed):
            run(tmp_path, asked)
    before = frames(tmp_path)
    spend_until_no_time_for(name, tmp_path)
    monkeypatch.setitem(stages.STAGES, name, disturbed(stages.STAGES[name], before=kill))
    assert ended(run(tmp_path, asked, resume=True)) == ends
    assert before and before.keys() <= frames(tmp_path).keys()
    assert {"md": 2, "surrogate": REPLICAS}[asked] == len(before)


def spend_until_no_time_for(name: str, folder: Path) -> None:
    """Write into the record that no more is left than what comes after a stage takes, and a second."""
    record = read_run(folder)
    assert record.decision is not None
    order = [stage.name for stage in record.decision.stages]
    left_s = sum(stage.seconds for stage in record.decision.stages[order.index(name) + 1 :]) + one_scene.RESTART_S - 0.5
    write_run(folder, replace(record, spent_s=BUDGET_S - left_s))


def test_files_of_one_frame_are_not_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One frame tells no interval: MD that made no more when its time was up has come to nothing."""
    simulate, n_frames = replicas.simulate_replicas, [1]

    def shorter(scene: Any, config: Any, files: list[Path], **more: Any) -> None:
        simulate(scene, replace(config, time_ps=n_frames[0] * config.save_every_ps), files, **more)
        raise KeyboardInterrupt("its time is up")

    monkeypatch.setattr("md_reference.run.replicas.simulate_replicas", shorter)
    monkeypatch.setattr(one_scene, "measure", lambda *_: OPENMM)
    one, two = tmp_path / "one", tmp_path / "two"
    with pytest.raises(InputError, match="MD to compare it with came to nothing in its time"):
        run(one, "md")
    assert {name: len(positions) for name, positions in frames(one).items()} == {"md.h5": 1, "held_out.h5": 1}
    record = read_run(one)
    assert [(entry.name, entry.status) for entry in record.stages] == [("md", "failed"), ("held-out md", "failed")]
    assert record.trajectory == record.held_out == ()
    n_frames[0] = 2  # control
    monkeypatch.setitem(stages.STAGES, "report", replace(stages.STAGES["report"], work=evaluated_at_once))
    found = run(two, "md")
    assert ended(found) == [("md", "out of time"), ("held-out md", "out of time"), ("report", "done")]
    assert found["trajectory"] == ["trajectory/md.h5"] and found["held_out"] == ["reference/held_out.h5"]


def test_md_to_compare_with_is_made_however_late_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(one_scene, "measure", lambda *_: replace(OPENMM, md_ps_per_s=0.01))
    monkeypatch.setitem(stages.STAGES, "report", replace(stages.STAGES["report"], work=evaluated_at_once))
    with monkeypatch.context() as patch:
        patch.setitem(stages.STAGES, "held-out md", disturbed(stages.STAGES["held-out md"], before=kill))
        with pytest.raises(Killed):
            run(tmp_path, "md")
    write_run(tmp_path, replace(read_run(tmp_path), spent_s=BUDGET_S))
    found = run(tmp_path, "md", resume=True)
    assert found["outcome"]["held_out_ps"] >= 2.0 and "held-out md: for 8 s" in (tmp_path / "log.txt").read_text(
        "utf-8"
    )


def test_measuring_that_takes_the_budget_leaves_the_stages_the_least(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(one_scene, "measure", lambda *_: OPENMM)
    record: Any = replace(RunRecord("CCO", "CCO", "", "", {}), rates=OPENMM)
    with pytest.raises(
        InputError, match=r"a budget of 19 s is too short: .* takes 20 s .* Use `budget_s='20s'` or more"
    ):
        one_scene._decide(record, None, None, RunOptions(budget_s=19.0), lambda: 0.0)  # type: ignore[arg-type]
    late = one_scene._decide(record, None, None, RunOptions(budget_s=60.0), lambda: 59.0)  # type: ignore[arg-type]
    assert late.decision is not None
    assert 19.0 < sum(stage.seconds for stage in late.decision.stages) <= least_budget_s(OPENMM)


def test_ctrl_c_in_each_stage_keeps_everything(
    way: Way, undisturbed: Undisturbed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, _, names = way
    _, expected = undisturbed(way)
    for k, name in enumerate(names):
        with monkeypatch.context() as patch:
            patch.setitem(stages.STAGES, name, disturbed(stages.STAGES[name], before=interrupt))
            with pytest.raises(KeyboardInterrupt, match=r"keeps what was done; the same again with `resume=True`"):
                run(tmp_path / "run", asked, resume=True)
        assert [entry.name for entry in read_run(tmp_path / "run").stages] == names[:k]
    found = run(tmp_path / "run", asked, resume=True)
    assert ended(found) == ended(expected) and found["outcome"] == expected["outcome"]
