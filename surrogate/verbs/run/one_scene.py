"""A run of one scene: its folder, its clock, its stages one after the other within the budget, the report last."""

from __future__ import annotations

import contextvars
import math
import shutil
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

from md_reference.run.config import MDConfig
from surrogate.progress import ProgressFn, progress_bar
from surrogate.verbs.inputs import prepare_scene
from surrogate.verbs.options import RunOptions, tell
from surrogate.verbs.run.decision import (
    ALL_MD_STAGES,
    LEAST_MD_S,
    MD_STAGES,
    RESTART_S,
    Decision,
    PlannedStage,
    Stage,
    decide,
    least_budget_s,
    seconds_of_first,
    table,
)
from surrogate.verbs.run.rates import by_openmm, measure
from surrogate.verbs.run.run_record import (
    ANSWER_NAME,
    ENERGIES_NAME,
    RUN_NAME,
    RunRecord,
    StageEntry,
    read_run,
    settings_of_run,
    write_run,
)
from surrogate.verbs.run.stages import STAGES, Site, md_options
from surrogate.verbs.simulate import resolve_run
from systems.errors import InputError, SimulationError, SurromdError
from systems.files.whole_file import OutputLock
from systems.interrupts import deferred_interrupt, stop_when
from systems.scene import Scene
from systems.units import format_wall

T = TypeVar("T")
LOG_NAME = "log.txt"
_TICK_S = 0.2
_SAVE_EVERY_S = 2.0
# Without these there is nothing to evaluate; a run that lost them to a fault of the surrogate goes on by MD.
_OF_SURROGATE = ("train", "rollout")


def plan_scene(scene: str | Path | Scene, options: RunOptions) -> RunRecord:
    """Return what a run of a scene would be: rates, measured now, and the decision. Nothing is written."""
    molecule, config = _prepared(scene, options)
    return _decide(_new_record(scene, molecule, options), molecule, config, options, lambda: 0.0)


def run_scene(scene: str | Path | Scene, folder: Path, options: RunOptions) -> RunRecord:
    """Run a scene into `folder`, or go on with the run there, and return its record, which is done.

    Raises InputError for a folder that is not ours, KeyboardInterrupt with what is kept, and what preparing a scene or
    MD of it raises.
    """
    before, named = _open_folder(folder, options), _named(scene)
    try:
        with OutputLock(folder / RUN_NAME), progress_bar(f"run {named}", quiet=options.quiet) as advance:
            run = _Run(folder, named, options, before, advance)
            molecule, config = run.before_stages("preparing", lambda: _prepared(scene, options))
            if before is None:
                record = _new_record(scene, molecule, options)
            else:
                before.check_same(settings_of_run(options), molecule.topology_hash, folder)
                record = _taken_up(before, options)
            run.keep(record)
            if record.decision is None:
                new = record
                record = run.before_stages(
                    "measuring", lambda: _decide(new, molecule, config, options, lambda: run.clock.spent_s)
                )
                run.keep(record)
            if not options.quiet and record.rates is not None and record.decision is not None:
                for name, text in table(record.rates, record.decision, options.budget_s).items():
                    tell(molecule.name, f"{name}: {text}")
            return run.to_the_end(Site(folder, molecule, config, options))
    except KeyboardInterrupt as stop:
        if not (folder / RUN_NAME).exists():
            raise
        said = f"{stop.args[0].split(';')[0]}; " if stop.args else ""
        raise KeyboardInterrupt(
            f"{said}{folder} keeps what was done; the same again with `resume=True` goes on"
        ) from None


class Clock:
    """Counts the wall time of a run, of earlier sittings too (`spent_s`). `save` gets every few seconds what is spent,
    so that a run that is killed does not start its budget over; `advance` shows it, `warn` says once, and while it
    happens, that the budget is overrun."""

    def __init__(
        self,
        budget_s: float,
        spent_s: float,
        save: Callable[[float], None],
        advance: ProgressFn | None = None,
        warn: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.budget_s = budget_s
        self._before_s, self._began = spent_s, time.monotonic()
        self._save, self._advance, self._warn = save, advance, warn
        self._is_over = spent_s > budget_s

    @property
    def spent_s(self) -> float:
        return self._before_s + time.monotonic() - self._began

    def work(self, said: str, may_take_s: float, stage: Callable[[], T]) -> T | None:
        """Do a stage and return its result; None where it was asked to stop, as Ctrl-C asks, when its time was up.

        A stage runs in a thread of its own, and must end with KeyboardInterrupt when it is asked to
        (`deferred_interrupt`, `stop_if_asked`). Ctrl-C stops it likewise: KeyboardInterrupt with the stage's own words.
        Raises what it raises.
        """
        until = time.monotonic() + may_take_s
        results: list[T] = []
        errors: list[BaseException] = []
        with deferred_interrupt() as asked_to_stop:

            def body() -> None:
                try:
                    with stop_when(lambda: asked_to_stop() or time.monotonic() > until):
                        results.append(stage())
                except BaseException as error:
                    errors.append(error)

            thread = threading.Thread(target=contextvars.copy_context().run, args=(body,), name=said, daemon=True)
            thread.start()
            saved = time.monotonic()
            while thread.is_alive():
                thread.join(_TICK_S)
                self._show(said)
                if time.monotonic() - saved > _SAVE_EVERY_S:
                    saved = time.monotonic()
                    self._save(self.spent_s)
            self._save(self.spent_s)
            if errors and isinstance(errors[0], KeyboardInterrupt):
                if asked_to_stop():
                    raise KeyboardInterrupt(*errors[0].args) from None
                return None
            if errors:
                raise errors[0]
            if asked_to_stop():
                raise KeyboardInterrupt
        return results[0]

    def _show(self, said: str) -> None:
        spent_s = self.spent_s
        if spent_s > self.budget_s + _SAVE_EVERY_S and not self._is_over:
            self._is_over = True
            self._warn(
                f"{said}: over the budget of {format_wall(self.budget_s)}, as busy as the machine is; it goes on"
            )
        if self._advance is not None:
            note = f"{said}, {format_wall(round(spent_s))} of {format_wall(self.budget_s)}"
            spent_s = min(spent_s, self.budget_s)
            self._advance(round(10 * spent_s), round(10 * self.budget_s), note)


class _Run:
    """A run under way. Every change of its record is on disk before the next stage, and every few seconds what is
    spent, in all and in the stage under way, so that a kill costs no more."""

    site: Site

    def __init__(
        self, folder: Path, name: str, options: RunOptions, record: RunRecord | None, advance: ProgressFn | None
    ) -> None:
        self._folder, self._name, self._quiet, self._record = folder, name, options.quiet, record
        self._stage = ""
        self.clock = Clock(options.budget_s, record.spent_s if record else 0.0, self._note_spent, advance, self.say)

    @property
    def record(self) -> RunRecord:
        assert self._record is not None
        return self._record

    @property
    def decision(self) -> Decision:
        assert self.record.decision is not None
        return self.record.decision

    def keep(self, record: RunRecord) -> None:
        """Make `record` the run's, here and on disk."""
        self._record = replace(record, spent_s=round(self.clock.spent_s, 1))
        write_run(self._folder, self._record)

    def _note_spent(self, spent_s: float) -> None:
        if self._record is None:
            return
        spent_in = dict(self._record.spent_in)
        if self._stage:
            spent_in[self._stage] = round(spent_in.get(self._stage, 0.0) + spent_s - self._record.spent_s, 1)
        self.keep(replace(self._record, spent_in=spent_in))

    def say(self, line: str) -> None:
        """Write a line into the log, and show it."""
        with open(self._folder / LOG_NAME, "a", encoding="utf-8") as file:
            file.write(f"{datetime.now(UTC).isoformat(timespec='seconds')} {line}\n")
        tell(self._name, line, quiet=self._quiet)

    def before_stages(self, doing: str, work: Callable[[], T]) -> T:
        """Return what comes of work that is done before there are stages. Raises InputError where the budget ends
        first."""
        found = self.clock.work(doing, self.clock.budget_s, work)
        if found is None:
            budget_s = self.clock.budget_s
            raise InputError(
                f"the budget of {format_wall(budget_s)} is spent while {doing}, before anything is simulated. Use "
                f"`budget_s='{math.ceil(max(2.0 * budget_s, 60.0))}s'` or more."
            )
        return found

    def to_the_end(self, site: Site) -> RunRecord:
        """Do the stages that have not ended and return the record."""
        self.site = site
        while pending := [stage for stage in self.decision.stages if self.record.ended(stage.name) is None]:
            self._do(pending)
        return self.record

    def _do(self, pending: list[PlannedStage]) -> None:
        """Do the first of the stages that have not ended."""
        name: Stage = pending[0].name
        stage, record = STAGES[name], self.record
        assert record.rates is not None
        there = stage.found(self.site, record) if name in (*ALL_MD_STAGES, "rollout") else None
        may_take_s = seconds_of_first(pending, self.clock.budget_s - self.clock.spent_s)
        if name in (*MD_STAGES, "energies") and there is None:  # without what to compare with all else was in vain
            may_take_s = max(may_take_s, LEAST_MD_S * max(1.0, 0.5 * record.rates.stretch))
        if name == "report":  # it is made however long it takes, for the same reason
            may_take_s = math.inf
        if may_take_s <= RESTART_S * record.rates.stretch and there is not None and (name != "md" or there.held_out):
            self._ended(there, StageEntry(name, "out of time", 0.0))
            return
        self.say(f"{name}: for {may_take_s:.0f} s" if name != "report" else name)
        self._stage = name
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
            self._stage = ""
        found = stage.found(self.site, record) if done is None else done
        if found is None:
            self._failed(name, "nothing came of it in its time")
        else:
            self._ended(found, StageEntry(name, "out of time" if done is None else "done", 0.0))

    def _failed(self, name: str, reason: str) -> None:
        self.say(f"{name} failed: {reason}")
        self._ended(STAGES[name].found(self.site, self.record) or self.record, StageEntry(name, "failed", 0.0, reason))
        if name in _OF_SURROGATE and not self.record.trajectory and self.decision.way != "md":
            self._by_md(f"{name} failed ({reason})")
            self.say("MD for the rest of the budget")

    def _ended(self, found: RunRecord, entry: StageEntry) -> None:
        """Enter what a stage came to, and how it ended."""
        spent_in = self.record.spent_in
        entry = replace(entry, wall_s=spent_in.get(entry.name, 0.0))
        self.keep(replace(found, stages=(*found.stages, entry), spent_in=spent_in))

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
        stages = tuple(stage for stage in decision.stages if self.record.ended(stage.name) is None)
        decision = replace(decision, why=(why,), stages=stages)
        self.keep(replace(self.record, decision=decision, trajectory=()))


def _taken_up(record: RunRecord, options: RunOptions) -> RunRecord:
    """Return the record of a run that goes on. With a longer budget the stages that ran out of time, or failed, go on
    for as much longer as the same decision would have given them."""
    before_s = record.settings["budget_s"]
    if record.rates is None or record.decision is None or options.budget_s <= before_s:
        return record
    way = "md" if record.decision.way == "md" else "surrogate"
    longer = decide(
        record.rates, options.budget_s, way, save_every_ps=record.decision.save_every_ps,
        umbrella=record.decision.seconds("umbrella md") > 0.0,
    )  # fmt: skip
    if longer.way != record.decision.way:  # a surrogate that failed
        return record
    decision = replace(longer, why=record.decision.why, equilibrate_ps=record.decision.equilibrate_ps)
    ended = tuple(
        entry for entry in record.stages if entry.status == "done" and entry.name not in ("energies", "report")
    )
    return replace(record, decision=decision, stages=ended, outcome=None, settings=settings_of_run(options))


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
    for pattern in ("report.*", "weights.*", ANSWER_NAME, ENERGIES_NAME, LOG_NAME, RUN_NAME):
        for path in folder.glob(pattern):
            with suppress(FileNotFoundError):
                path.unlink()
