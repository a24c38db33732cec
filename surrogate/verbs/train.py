"""The verbs `windows` and `train`: training data in one file; an architecture and settings that suit the references,
or a potential of one molecule at an expensive level of theory, then the training and its verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from surrogate.models.architecture import architecture, names, weights_path
from surrogate.progress import progress_bar
from surrogate.verbs.options import PathLike, TrainOptions, Trajectories, WindowsOptions, tell
from surrogate.verbs.outputs import check_outputs, find_trajectories
from surrogate.verbs.scenes import prepare_scene
from systems.errors import InputError
from systems.files.whole_file import OutputLock
from systems.options import Preparation, options_as_keywords
from systems.scene import Scene

if TYPE_CHECKING:
    from surrogate.data import References
    from surrogate.models.architecture import Choice, Trainer, TrainingRequest


POTENTIAL = "painet-potential"


@options_as_keywords(WindowsOptions)
def windows(references: Trajectories, out: PathLike, options: WindowsOptions) -> Path:
    """Read reference trajectories of one scene, canonicalise them once, and write one compact file for training.

    They may be larger than memory. `validation`: trajectories held out whole; without any, the last twentieth of each
    is. `velocities` keeps these as well, for PAINET, and leaves frames in their own pose. Raises InputError when
    scenes, save intervals or conditions differ, TrajectoryError for damaged files.
    """
    from surrogate.data import collect_frames

    out = Path(out)
    check_outputs([out], [".h5"], overwrite=options.overwrite)
    paths = find_trajectories(references, verify=True)
    held = [] if options.validation is None else find_trajectories(options.validation, verify=True)
    canonical = options.canonical and not options.velocities
    frames = collect_frames(paths, canonical=canonical, velocities=options.velocities, held=held, spool=out.parent)
    frames.refuse_leaks()
    frames.save(out)
    return out


@dataclass(frozen=True)
class _Plan:
    """What will be trained and how. `why`: one line for the architecture and one for each setting that was chosen."""

    trainer: Trainer
    references: References
    request: TrainingRequest
    choices: tuple[Choice, ...]
    why: str

    def lines(self) -> list[str]:
        return [f"arch = {self.request.arch}: {self.why}", *(choice.line() for choice in self.choices)]


@options_as_keywords(TrainOptions)
def train(references: Trajectories, out: PathLike, options: TrainOptions) -> Path:
    """Train a surrogate on trajectories, or on one windows file, and return the weights written (.safetensors).

    With `level='gfn2-xtb'` it learns one molecule, named as by `reference`, from that level's energies and forces:
    painet as a potential, which asks about the states that it is least sure of. The samples stay beside the weights
    (NAME.samples.safetensors).

    Architecture and settings that are not given are chosen to suit the references, and each choice is said with its
    reason (`explain_training` returns them all); one molecule at one spacing of frames gets lam-slide as it is.

    `arch`: an installed architecture (`models.architecture.names`): lam-slide; lam-slide-peptides; painet or its
    decoder alone, egnn, which learn from velocities (a reference made with `save_velocities=True` and natural hydrogen
    masses); or a baseline that is fitted in one go: frozen, resampling, normal-modes. The others end after `budget_s`
    seconds of training or `steps` optimiser steps over all stages, whichever is given. `start_from`: weights (name or
    file) whose second stage is trained further, with their configuration. `validation`: trajectories that the curves
    are measured on; without any it is the last twentieth of each; molecules that are in `validation` alone are held out
    whole. A stretch of motion that would be both trained on and validated on is refused. `longest_lag_ps`: every
    spacing of frames from that of the references to this one is learned. `device`: 'auto', 'cpu' or 'cuda'.

    Beside `out`, a CSV holds the training curves and, until done, files the state that `resume` goes on from; at the
    end the curves are drawn (.svg), and a short rollout that is checked frame by frame says whether the weights are
    usable and, where they are not, what would help (NAME.verdict.json, surrogate.verbs.train_verdict).
    Raises InputError, TrajectoryError, SimulationError (training diverged), StorageError.
    """
    out = Path(out)
    asked = _asked(options, out)
    if asked.arch and options.level is None:
        architecture(asked.arch).trainer().check(asked)
    check_outputs([out], [".safetensors"], resume=options.resume, overwrite=options.overwrite)
    states = sorted(out.parent.glob(f"{out.stem}.*.train.safetensors"))
    if states and not (options.resume or options.overwrite):
        raise InputError(f"{states[0]} is the state of an interrupted training; add `resume=True` or `overwrite=True`.")
    if options.resume and out.exists() and not states:
        if not options.quiet:
            tell(out.name, "this training is done, and nothing was changed; overwrite it to train anew")
        return out
    if options.level is not None:
        with OutputLock(out), progress_bar(f"training {out.stem}", quiet=options.quiet) as bar, _said_when_stopped(out):
            written = learn_molecule(references, asked, options, _shown(bar))
        _conclude(written, fitted=False, quiet=options.quiet)
        return written
    from surrogate.training.devices import choose_device

    plan = _plan(references, options.validation, replace(asked, device=choose_device(options.device)))
    prepared = plan.trainer.prepare(plan.references, plan.request)
    if not options.quiet:
        for line in plan.lines():
            tell(out.name, line)
    with (
        OutputLock(out),
        progress_bar(f"training {prepared.scene}", quiet=options.quiet) as bar,
        _said_when_stopped(out),
    ):
        written = prepared.start(_shown(bar))
    _conclude(written, fitted=plan.trainer.fitted, quiet=options.quiet)
    return written


def _shown(bar: Callable[..., None] | None) -> Callable[[str, float], None]:
    """Return what a training reports its stage and share to."""

    def advance(stage: str, share: float) -> None:
        if bar is not None:
            bar(round(1000 * share), 1000, stage)

    return advance


@options_as_keywords(TrainOptions)
def explain_training(references: Trajectories, options: TrainOptions) -> str:
    """Return the configuration file, filled in, that a training on these references would use; nothing is trained.

    Given as `config` of `train` it gives the same training. What was chosen stands at its head, with the reasons.
    Budget, seed and device belong to the command and are left out. Raises InputError, TrajectoryError.
    """
    from surrogate.models.architecture import toml_text

    plan = _plan(references, options.validation, _asked(options, Path("explained.safetensors")), explained=True)
    head = "".join(f"# {line}\n" for line in plan.lines())
    tables = plan.trainer.settings(plan.request).tables()
    if plan.request.start_from is not None:
        tables.pop("model", None)
    return head + toml_text({"arch": plan.request.arch, **tables})


def _asked(options: TrainOptions, out: Path) -> TrainingRequest:
    """Return the request; `arch` is empty where nothing names one. Raises InputError for an unknown one."""
    from surrogate.models.architecture import TrainingRequest

    start, arch = options.start_from, options.arch
    file = None if start is None else weights_path(start)
    if arch is None and file is not None:
        from surrogate.models.weights import read_header

        arch = read_header(file).arch
    if arch is not None:
        architecture(arch)
    return TrainingRequest(
        arch=arch or "",
        out=out,
        budget_s=options.budget_s,
        steps=options.steps,
        start_from=file,
        longest_lag_ps=options.longest_lag_ps,
        seed=options.seed,
        resume=options.resume,
        model=options.model or {},
        training=options.training or {},
    )


def _plan(references: Trajectories, validation: Trajectories | None, asked: TrainingRequest, *,
          explained: bool = False) -> _Plan:  # fmt: skip
    """Find the references and choose what is not asked for."""
    from surrogate.data import References

    if asked.arch and asked.start_from is not None:
        from surrogate.models.weights import read_header

        if (found_arch := read_header(asked.start_from).arch) != asked.arch:
            raise InputError(f"{asked.start_from} holds {found_arch}, not {asked.arch}.")
    paths = find_trajectories(references, verify=True)
    held = [] if validation is None else find_trajectories(validation, verify=True)
    found = References(tuple(paths), tuple(held), spool=asked.out.parent)
    why = "asked for"
    if not asked.arch:
        name, why = _suited(found)
        asked = replace(asked, arch=name)
    trainer: Trainer = architecture(asked.arch).trainer()
    if not explained:
        trainer.check(asked)
    choices = trainer.choose(found, asked)
    return _Plan(trainer, found, asked.with_choices(choices), choices, why)


def _suited(references: References) -> tuple[str, str]:
    """Return the name of the architecture that suits the references best, and why."""
    survey = references.survey
    fits = [(*fit, name) for name in names() if (fit := architecture(name).suits(survey)) is not None]
    if not fits:
        raise InputError("no installed architecture suits these references by itself; name one with `arch`.")
    _, why, name = max(fits)
    return name, why


@contextmanager
def _said_when_stopped(out: Path) -> Iterator[None]:
    """Say, when a training is interrupted, what of it is kept."""
    try:
        yield
    except KeyboardInterrupt:
        states = sorted(out.parent.glob(f"{out.stem}.*.train.safetensors"))
        samples = out.with_name(f"{out.stem}.samples.safetensors")
        if states:
            kept = f"the state is in {states[-1]}"
        elif samples.exists():
            kept = f"the samples are in {samples}"
        else:
            raise KeyboardInterrupt("no training state had been saved yet") from None
        raise KeyboardInterrupt(f"{kept}; the same again with `resume=True` goes on") from None


def _conclude(written: Path, *, fitted: bool, quiet: bool) -> None:
    """Draw the curves and try the weights; say what they are good for."""
    curves = written.with_suffix(".csv")
    if curves.exists():
        from surrogate.training.loop import plot_curves

        plot_curves(curves)
    if fitted:
        return
    from surrogate.verbs.train_verdict import compare_training, write_verdict

    try:
        verdict = compare_training(written)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{written} is written; only the rollout that tries it was cut short") from None
    write_verdict(written, verdict)
    if not quiet:
        for line in verdict.lines():
            tell(written.name, line)


# ---- one molecule ----------------------------------------------------------------------------------------------------


def learn_molecule(
    given: Trajectories | Scene, request: TrainingRequest, options: TrainOptions, advance: Callable[[str, float], None]
) -> Path:
    """Learn the molecule that `given` names from `options.level` and return the weights.

    The budget is of wall time for all of it: the molecule's preparation, answers, steps, and the verdict that the
    caller comes to (`train_verdict.compare_training`). Raises InputError for what means nothing here, PreparationError
    for what the level of theory refuses.
    """
    began = time.monotonic()
    from md_reference.forces.spec import QUANTUM, at_level

    if at_level(options.level, None) != QUANTUM:
        raise InputError(
            f"a level is worth learning where it is expensive; use `level='{QUANTUM}'`, or a reference of MD."
        )
    if request.arch not in ("", "painet", POTENTIAL):
        raise InputError(f"{request.arch} learns from trajectories; use `arch='painet'`, or leave `level` out.")
    unknown = {"`start_from`": options.start_from, "`longest_lag_ps`": options.longest_lag_ps,
               "`validation`": options.validation}  # fmt: skip
    if given_too := [name for name, value in unknown.items() if value is not None]:
        raise InputError(f"{', '.join(given_too)}: a potential learns from states that it asks about; leave it out.")
    if request.budget_s is None and request.steps is None:
        raise InputError("say how long to train: `budget_s='30min'` or `steps=10000`.")
    if not isinstance(given, str | Path | Scene):
        named = list(given)
        if len(named) != 1:
            raise InputError(f"one molecule a model: {len(named)} are given.")
        given = named[0]
    scene = prepare_scene(given, Preparation(), quiet=options.quiet)

    from md_reference.run.labeller import Labeller
    from surrogate.models.painet.energy import PainetPotential
    from surrogate.models.painet.potential_trainer import PotentialTrainer
    from surrogate.verbs.train_verdict import trial_s

    trainer: PotentialTrainer = architecture(POTENTIAL).trainer()
    config = trainer.settings(request).model  # what is wrong with it is known before anything is computed
    with Labeller(scene) as reference:
        if not options.quiet:
            tell(request.out.name, f"{scene.name} ({scene.formula}) by {QUANTUM}; weights know this molecule alone")
        after_s = trial_s(PainetPotential(config), scene)
        out = trainer.learn(reference, request, advance, before_s=time.monotonic() - began, after_s=after_s)
        if reference.n_rearranged and not options.quiet:
            tell(
                out.name, f"{reference.n_rearranged} states left out: they are another molecule, by bonds or handedness"
            )
        return out
