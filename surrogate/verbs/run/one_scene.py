"""A run of one scene: its folder, its stages one after the other within the budget, the report at the end."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from surrogate.progress import progress_bar
from surrogate.verbs.options import RunOptions, tell
from surrogate.verbs.reference import resolve_run
from surrogate.verbs.run.decision import (
    LEAST_MD_S,
    MD_STAGES,
    RESTART_S,
    Decision,
    PlannedStage,
    Stage,
    decide,
    least_budget_s,
    seconds_of_first,
)
from surrogate.verbs.run.rates import by_openmm, measure
from surrogate.verbs.run.run_record import (
    RUN_NAME,
    RunRecord,
    StageEntry,
    read_run,
    settings_of_run,
    write_run,
)
from surrogate.verbs.run.stage_clock import Clock
from surrogate.verbs.run.stages import STAGES, Site, md_options
from surrogate.verbs.scenes import prepare_scene
from systems.errors import InputError, SimulationError, SurromdError
from systems.files.whole_file import OutputLock

if TYPE_CHECKING:
    from md_reference.run.config import MDConfig
    from systems.scene import Scene

T = TypeVar("T")
LOG_NAME = "log.txt"
# Without these there is nothing to evaluate; a run that lost them to a fault of the surrogate goes on by MD.
_OF_SURROGATE = ("train", "rollout")
_GOES_ON = "the same again with `resume=True` goes on"


def plan_scene(scene: str | Path | Scene, options: RunOptions) -> RunRecord:
    """Return what a run of a scene would be: rates, measured now, and the decision. Nothing is written."""
    molecule, config = _prepared(scene, options)
    record = _new_record(scene, molecule, options)
    return _decide(record, molecule, config, options, lambda: 0.0)


def run_scene(
    scene: str | Path | Scene, folder: Path, options: RunOptions, tell_decision: Callable[[RunRecord], None]
) -> RunRecord:
    """Run a scene into `folder`, or go on with the run there, and return its record, which is done.

    `tell_decision` is called when it is known how the budget is spent. Raises InputError for a folder that is not
    ours, KeyboardInterrupt with what is kept, and what preparing a scene or MD of it raises.
    """
    before = _open_folder(folder, options)
    try:
        with OutputLock(folder / RUN_NAME), progress_bar(f"run {_named(scene)}", quiet=options.quiet) as advance:
            kept = _Kept(folder, before)
            named, log = _named(scene), folder / LOG_NAME
            clock = Clock(
                options.budget_s,
                before.spent_s if before else 0.0,
                kept.beat,
                advance,
                lambda line: _say(log, named, line, quiet=options.quiet),
            )
            molecule, config = _before_stages(clock, "preparing", lambda: _prepared(scene, options))
            if before is None:
                record = _new_record(scene, molecule, options)
            else:
                before.check_same(settings_of_run(options), molecule.topology_hash, folder)
                record = _taken_up(before, options)
            kept.keep(record, clock.spent_s)
            if record.decision is None:
                new = record
                record = _before_stages(
                    clock, "measuring", lambda: _decide(new, molecule, config, options, lambda: clock.spent_s)
                )
            tell_decision(record)
            kept.keep(record, clock.spent_s)
            return _Run(Site(folder, molecule, config, options), kept, clock).to_the_end()
    except KeyboardInterrupt as stop:
        if not (folder / RUN_NAME).exists():
            raise
        said = f"{stop.args[0].split(';')[0]}; " if stop.args else ""
        raise KeyboardInterrupt(f"{said}{folder} keeps what was done; {_GOES_ON}") from None


class _Kept:
    """The record of a run as it is on disk: every change is there before the next stage, and every few seconds what is
    spent, in all and in the stage under way, so that a kill costs no more."""

    def __init__(self, folder: Path, record: RunRecord | None) -> None:
        self._folder, self.record = folder, record
        self.stage = ""

    def keep(self, record: RunRecord, spent_s: float) -> None:
        """Make `record` the run's, here and on disk."""
        self.record = replace(record, spent_s=round(spent_s, 1))
        write_run(self._folder, self.record)

    def beat(self, spent_s: float) -> None:
        """Note what is spent by now."""
        if self.record is None:
            return
        spent_in = dict(self.record.spent_in)
        if self.stage:
            more_s = spent_s - self.record.spent_s
            spent_in[self.stage] = round(spent_in.get(self.stage, 0.0) + more_s, 1)
        self.keep(replace(self.record, spent_in=spent_in), spent_s)


class _Run:
    """A run under way."""

    def __init__(self, site: Site, kept: _Kept, clock: Clock) -> None:
        self.site, self.kept, self.clock = site, kept, clock

    @property
    def record(self) -> RunRecord:
        assert self.kept.record is not None
        return self.kept.record

    def keep(self, record: RunRecord) -> None:
        """Make `record` the run's; what was spent is known already."""
        self.kept.keep(record, self.record.spent_s)

    def say(self, line: str) -> None:
        """Write a line into the log, and show it."""
        _say(self.site.folder / LOG_NAME, self.site.scene.name, line, quiet=self.site.options.quiet)

    def to_the_end(self) -> RunRecord:
        """Do the stages that have not ended and return the record."""
        while pending := self._pending:
            self._do(pending[0].name)
        return self.record

    @property
    def decision(self) -> Decision:
        assert self.record.decision is not None
        return self.record.decision

    @property
    def _pending(self) -> list[PlannedStage]:
        return [stage for stage in self.decision.stages if self.record.ended(stage.name) is None]

    def _do(self, name: Stage) -> None:
        stage, record = STAGES[name], self.record
        assert record.rates is not None
        left_s = self.clock.budget_s - self.clock.spent_s
        there = stage.found(self.site, record) if name in (*MD_STAGES, "rollout") else None
        may_take_s = seconds_of_first(self._pending, left_s)
        if name in MD_STAGES and there is None:  # without MD to compare with all else was in vain
            may_take_s = max(may_take_s, LEAST_MD_S * max(1.0, 0.5 * record.rates.stretch))
        if name == "report":  # it is made however long it takes, for the same reason
            may_take_s = math.inf
        if may_take_s <= RESTART_S * record.rates.stretch and there is not None and (name != "md" or there.held_out):
            self._ended(there, StageEntry(name, "out of time", 0.0))
            return
        self.say(f"{name}: for {may_take_s:.0f} s" if name != "report" else name)
        self.kept.stage = name
        try:
            done = self.clock.work(name, may_take_s, lambda: stage.work(self.site, record))
        except SurromdError as error:
            if name in MD_STAGES and isinstance(error, SimulationError) and record.rates.at_once > 1:
                self._by_openmm(name, str(error))
            elif stage.may_fail:
                self._failed(name, str(error))
            else:
                raise
            return
        finally:
            self.kept.stage = ""
        found = stage.found(self.site, record) if done is None else done
        if found is None:
            self._failed(name, "nothing came of it in its time")
            return
        self._ended(found, StageEntry(name, "out of time" if done is None else "done", 0.0))

    def _failed(self, name: str, reason: str) -> None:
        self.say(f"{name} failed: {reason}")
        self._ended(STAGES[name].found(self.site, self.record) or self.record, StageEntry(name, "failed", 0.0, reason))
        if name in _OF_SURROGATE and not self.record.trajectory and self.decision.way != "md":
            self._by_md(f"{name} failed ({reason})")
            self.say("MD for the rest of the budget")

    def _ended(self, found: RunRecord, entry: StageEntry) -> None:
        """Enter what a stage came to, and how it ended."""
        now = self.record  # with what is spent
        entry = replace(entry, wall_s=now.spent_in.get(entry.name, 0.0))
        self.keep(replace(found.with_stage(entry), spent_s=now.spent_s, spent_in=now.spent_in))

    def _by_openmm(self, name: str, reason: str) -> None:
        """Go on with a stage of MD by OpenMM where SIMD replicas have failed; their good frames stay."""
        record, why = self.record, f"MD by SIMD replicas failed ({reason.rstrip('.')})"
        assert record.rates is not None
        rates = by_openmm(record.rates, self.site.scene, self.site.config, why)
        self.keep(replace(record, rates=rates, simd_failed=record.rates.replicas))
        self.say(f"{why}: {name} by OpenMM")
        if self.decision.way == "md":  # a single replica has no other to be compared with
            self._by_md(why)

    def _by_md(self, why: str) -> None:
        """Spend what is left on MD."""
        assert self.record.rates is not None
        left_s = max(self.clock.budget_s - self.clock.spent_s, least_budget_s(self.record.rates))
        decision = decide(self.record.rates, left_s, "md", save_every_ps=self.decision.save_every_ps)
        ended = {entry.name for entry in self.record.stages}
        stages = tuple(stage for stage in decision.stages if stage.name not in ended)
        decision = replace(decision, why=(why,), stages=stages)
        self.keep(replace(self.record, decision=decision, trajectory=()))


def _say(log: Path, name: str, line: str, *, quiet: bool) -> None:
    with open(log, "a", encoding="utf-8") as file:
        file.write(f"{datetime.now(UTC).isoformat(timespec='seconds')} {line}\n")
    if not quiet:
        tell(name, line)


def _taken_up(record: RunRecord, options: RunOptions) -> RunRecord:
    """Return the record of a run that goes on. With a longer budget the stages that ran out of time, or failed, go on
    for as much longer as the same decision would have given them."""
    before_s = record.settings["budget_s"]
    if record.rates is None or record.decision is None or options.budget_s <= before_s:
        return record
    way = "md" if record.decision.way == "md" else "surrogate"
    longer = decide(record.rates, options.budget_s, way, save_every_ps=record.decision.save_every_ps)
    if longer.way != record.decision.way:  # a surrogate that failed
        return record
    decision = replace(longer, why=record.decision.why, equilibrate_ps=record.decision.equilibrate_ps)
    ended = tuple(entry for entry in record.stages if entry.status == "done" and entry.name != "report")
    return replace(record, decision=decision, stages=ended, outcome=None, settings=settings_of_run(options))


def _before_stages(clock: Clock, doing: str, work: Callable[[], T]) -> T:
    """Return what comes of work that is done before there are stages. Raises InputError where the budget ends first."""
    found = clock.work(doing, clock.budget_s, work)
    if found is None:
        raise InputError(f"the budget is spent while {doing}; give more `budget_s`.")
    return found


def _decide(
    record: RunRecord, scene: Scene, config: MDConfig, options: RunOptions, spent_s: Callable[[], float]
) -> RunRecord:
    """Return the record with rates and decision; `spent_s`: of the budget, when the rates are known."""
    rates = measure(scene, config, options.weights, options.cores)
    # On a machine so busy that measuring took what the stages need, they get it all the same.
    least_s = min(options.budget_s, least_budget_s(rates))
    left_s = max(options.budget_s - spent_s(), least_s)
    decision = decide(rates, left_s, options.way, save_every_ps=options.save_every_ps, whole_s=options.budget_s)
    weights = rates.rolls.weights if decision.way == "rollout" and rates.rolls else ""
    return replace(record, rates=rates, decision=decision, weights=weights)


def _prepared(scene: str | Path | Scene, options: RunOptions) -> tuple[Scene, MDConfig]:
    """Return the scene and the settings of its MD."""
    molecule = prepare_scene(scene, options, quiet=options.quiet)
    return resolve_run(molecule, md_options(options), {"time_ps": 0.0}, quiet=options.quiet)[:2]


def _new_record(scene: str | Path | Scene, molecule: Scene, options: RunOptions) -> RunRecord:
    from importlib.metadata import version

    import openmm

    programs = {"surromd": version("surromd"), "openmm": openmm.__version__, "python": sys.version.split()[0]}
    return RunRecord(
        scene=_named(scene),
        molecule=molecule.name,
        formula=molecule.formula,
        topology_hash=molecule.topology_hash,
        settings=settings_of_run(options),
        programs=programs,
        started=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def _named(scene: str | Path | Scene) -> str:
    return str(scene) if isinstance(scene, str | Path) else scene.name


def _open_folder(folder: Path, options: RunOptions) -> RunRecord | None:
    """Return the record of the run to go on with, None for a new one in an empty folder. Raises InputError."""
    if options.resume and options.overwrite:
        raise InputError("`resume` and `overwrite` exclude each other.")
    if folder.is_file():
        raise InputError(f"{folder} is a file; name a folder.")
    is_run = (folder / RUN_NAME).is_file()
    if is_run and options.resume:
        return read_run(folder)
    if is_run and not options.overwrite:
        raise InputError(f"{folder} holds a run; add `resume=True` to go on, or `overwrite=True` to start over.")
    if is_run:
        _clear(folder)
    elif folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir()):
        raise InputError(f"{folder} is not empty and no run's folder; name another.")
    folder.mkdir(parents=True, exist_ok=True)
    return None


def _clear(folder: Path) -> None:
    """Remove what an earlier run wrote, its record last."""
    for name in ("reference", "trajectory"):
        shutil.rmtree(folder / name, ignore_errors=True)
    for pattern in ("report.*", "weights.*", "equilibrium.json", LOG_NAME, RUN_NAME):
        for path in folder.glob(pattern):
            with suppress(FileNotFoundError):
                path.unlink()
