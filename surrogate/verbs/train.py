"""The verbs `windows` and `train`: training data in one file; an architecture and settings that suit the references,
or a potential of one molecule at an expensive level of theory, then the training and its verdict: how far it came, what
its weights do in a short guarded rollout, and what would help."""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from md_reference.forces.spec import QUANTUM, at_level
from surrogate.models.architecture import Trainer, TrainingRequest, architecture, names, toml_text, weights_path
from surrogate.progress import progress_bar
from surrogate.verbs.inputs import check_outputs, find_trajectories, prepare_scene
from surrogate.verbs.options import PathLike, TrainOptions, Trajectories, WindowsOptions, tell
from systems.chemistry.validity import flag_names
from systems.errors import InputError, SurromdError
from systems.files.whole_file import OutputLock, create_whole
from systems.options import Preparation, options_as_keywords
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory
from systems.units import format_time_ps

if TYPE_CHECKING:
    from surrogate.data import References
    from surrogate.models.potential import Potential
    from surrogate.models.weights import Weights


POTENTIAL = "painet-potential"
# Frames that pass the guards, in per cent: from the first on the weights can be rolled as they are, from the second on
# with a guard that helps.
USABLE, WITH_HELP = 99.0, 90.0
_REPLICAS, _CHUNKS, _MOLECULES = 4, 6, 6
_TIMED_FORCES = 9
# A validation error that falls by this share over the second half of the last stage has not settled; one this many
# times the error in training is of frames that the network knows by heart.
_STILL_FALLS, _BY_HEART = 0.03, 1.5
_FEW_FRAMES = 20_000


@options_as_keywords(WindowsOptions)
def windows(references: Trajectories, out: PathLike, options: WindowsOptions) -> Path:
    """Read reference trajectories of one scene, canonicalise them once, and write one compact file for training.

    They may be larger than memory. `validation`: trajectories held out whole; without any, the last twentieth of each
    is. `velocities` keeps these as well, for PAINET, and leaves frames in their own pose. Raises InputError when
    scenes, save intervals or conditions differ, TrajectoryError for damaged files.
    """
    from surrogate.data import collect_frames, rollouts_among

    out = Path(out)
    check_outputs([out], [".h5"], overwrite=options.overwrite)
    paths = find_trajectories(references, verify=True)
    held = [] if options.validation is None else find_trajectories(options.validation, verify=True)
    canonical = options.canonical and not options.velocities
    frames = collect_frames(paths, canonical=canonical, velocities=options.velocities, held=held, spool=out.parent)
    frames.refuse_leaks()
    for line in rollouts_among(paths):
        tell(out.name, line, quiet=options.quiet)
    frames.save(out)
    return out


@options_as_keywords(TrainOptions)
def train(references: Trajectories, out: PathLike, options: TrainOptions) -> Path:
    """Train a surrogate on trajectories, or on one windows file, and return the weights written (.safetensors).

    With `level='gfn2-xtb'` it learns one molecule, named as by `reference`, from that level's energies and forces:
    painet as a potential, which asks about the states that it is least sure of. The samples stay beside the weights
    (NAME.samples.safetensors). With `start_from` it begins with the network of a potential, of whatever molecule.

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
    usable and, where they are not, what would help (NAME.verdict.json).
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
    if options.level is None:
        from surrogate.training.devices import choose_device

        asked = replace(asked, device=choose_device(options.device))
        trainer, found, asked, lines = _plan(references, options.validation, asked)
        prepared = trainer.prepare(found, asked)
        for line in lines:
            tell(out.name, line, quiet=options.quiet)
        name, fitted, start = prepared.scene, trainer.fitted, prepared.start
    else:
        name, fitted, start = out.stem, False, partial(learn_molecule, references, asked, options)
    with OutputLock(out), progress_bar(f"training {name}", quiet=options.quiet) as bar, _said_when_stopped(out):
        written = start(_shown(bar))
    _conclude(written, fitted=fitted, quiet=options.quiet)
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
    if options.level is not None:
        raise InputError("`explain` is for trainings on trajectories; leave `level` out.")
    asked = _asked(options, Path("explained.safetensors"))
    trainer, _, asked, lines = _plan(references, options.validation, asked, explained=True)
    tables = trainer.settings(asked).tables()
    if asked.start_from is not None:
        tables.pop("model", None)
    return "".join(f"# {line}\n" for line in lines) + toml_text({"arch": asked.arch, **tables})


def _asked(options: TrainOptions, out: Path) -> TrainingRequest:
    """Return the request; `arch` is empty where nothing names one. Raises InputError for an unknown one."""
    arch = POTENTIAL if options.level is not None and options.arch in (None, "painet") else options.arch
    file = None if options.start_from is None else weights_path(options.start_from)
    if file is not None:
        from surrogate.models.weights import read_header

        found = read_header(file).arch
        if arch not in (None, found):
            raise InputError(f"{file} holds {found}, not {arch}.")
        arch = found
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


def _plan(
    references: Trajectories, validation: Trajectories | None, asked: TrainingRequest, *, explained: bool = False
) -> tuple[Trainer, References, TrainingRequest, list[str]]:
    """Find the references and choose what is not asked for; return what trains, on what, how, and the reasons: a line
    for the architecture and one for each setting that was chosen."""
    from surrogate.data import References, rollouts_among

    paths = find_trajectories(references, verify=True)
    held = [] if validation is None else find_trajectories(validation, verify=True)
    found = References(tuple(paths), tuple(held), spool=asked.out.parent)
    why = "asked for"
    if not asked.arch:
        fits = [(*fit, name) for name in names() if (fit := architecture(name).suits(found.survey)) is not None]
        if not fits:
            raise InputError("no installed architecture suits these references by itself; name one with `arch`.")
        _, why, name = max(fits)
        asked = replace(asked, arch=name)
    trainer: Trainer = architecture(asked.arch).trainer()
    if not explained:
        trainer.check(asked)
    choices = trainer.choose(found, asked)
    lines = [f"arch = {asked.arch}: {why}", *(choice.line() for choice in choices), *rollouts_among(paths)]
    return trainer, found, asked.with_choices(choices), lines


@contextmanager
def _said_when_stopped(out: Path) -> Iterator[None]:
    """Say, when a training is interrupted, what of it is kept."""
    try:
        yield
    except KeyboardInterrupt:
        kept = sorted(out.parent.glob(f"{out.stem}.*.safetensors"))
        if not kept:
            raise KeyboardInterrupt("no training state had been saved yet") from None
        raise KeyboardInterrupt(f"the state is in {kept[-1]}; the same again with `resume=True` goes on") from None


def _conclude(written: Path, *, fitted: bool, quiet: bool) -> None:
    """Draw the curves and try the weights; say what they are good for."""
    curves = written.with_suffix(".csv")
    if curves.exists():
        from surrogate.training.loop import plot_curves

        plot_curves(curves)
    if fitted:
        return
    try:
        verdict = compare_training(written)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{written} is written; only the rollout that tries it was cut short") from None
    create_whole(written.with_suffix(".verdict.json"), json.dumps(asdict(verdict), indent=1) + "\n")
    for line in verdict.lines():
        tell(written.name, line, quiet=quiet)


# ---- one molecule ----------------------------------------------------------------------------------------------------


def learn_molecule(
    given: Trajectories | Scene, request: TrainingRequest, options: TrainOptions, advance: Callable[[str, float], None]
) -> Path:
    """Learn the molecule that `given` names from `options.level` and return the weights.

    The budget is of wall time for all of it: the molecule's preparation, answers, steps, and the verdict that the
    caller comes to (`compare_training`). Raises InputError for what means nothing here, PreparationError
    for what the level of theory refuses.
    """
    began = time.monotonic()
    if at_level(options.level, None) != QUANTUM:
        raise InputError(
            f"a level is worth learning where it is expensive; use `level='{QUANTUM}'`, or a reference of MD."
        )
    if request.arch != POTENTIAL:
        raise InputError(f"{request.arch} learns from trajectories; use `arch='painet'`, or leave `level` out.")
    unknown = {"`longest_lag_ps`": options.longest_lag_ps, "`validation`": options.validation}
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
    from surrogate.models.painet.painet_potential import PainetPotential
    from surrogate.models.painet.potential_trainer import PotentialTrainer

    trainer: PotentialTrainer = architecture(POTENTIAL).trainer()
    config = trainer.settings(request).model  # what is wrong with it is known before anything is computed
    with Labeller(scene) as reference:
        if not options.quiet:
            tell(request.out.name, f"{scene.name} ({scene.formula}) by {QUANTUM}; weights know this molecule alone")
        after_s = trial_s(PainetPotential(config), scene)
        out = trainer.learn(reference, request, advance, before_s=time.monotonic() - began, after_s=after_s)
        if n := reference.n_rearranged:
            left_out = f"{n} states left out: they are another molecule, by bonds or handedness"
            tell(out.name, left_out, quiet=options.quiet)
        return out


# ---- the verdict ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrainingVerdict:
    """How a training went. `steps` and `validation` (named as in the curves) by stage; of the rollout the frames, how
    many in per cent pass the guards, and what is wrong with the others, in frames; `stopped`: why it could not go on.

    `word`: 'usable', 'usable with help' (`guard='repair'` or resample) or 'not usable'; `advice`: what would help.
    """

    steps: dict[str, int]
    validation: dict[str, dict[str, float]]
    rolled_ps: float
    n_frames: int
    percent_valid: float
    reasons: dict[str, int]
    stopped: str
    word: str
    advice: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return it for people."""
        done = ", ".join(f"{name} {steps} steps" for name, steps in self.steps.items())
        last = [each for columns in self.validation.values() for each in columns.items()]
        errors = ", ".join(f"{column.removeprefix('validation_')} {value:.3g}" for column, value in last)
        wrong = "; the others: " * bool(self.reasons) + ", ".join(f"{name} ({n})" for name, n in self.reasons.items())
        found = f"{self.percent_valid:.3g} % of {self.n_frames} frames pass the guards{wrong}"
        lines = [
            f"trained: {done}; validation error: {errors}",
            f"rolled {format_time_ps(self.rolled_ps)} without help: {found}",
        ]
        if self.stopped:
            lines.append(f"the rollout stopped: {self.stopped}")
        if self.word == "usable":
            return [*lines, "usable; whether populations and time scales are right, `surromd compare` with MD shows"]
        help_ = "usable with `guard='repair'` or resample alone" if self.word != "not usable" else "not usable as it is"
        return [*lines, f"{help_}; what would help: {'; '.join(self.advice)}"]


def compare_training(path: Path) -> TrainingVerdict:
    """Roll freshly trained weights from the structures they know, and say what they are good for. Draws each chunk
    once, so that the share of frames that pass is the network's own. Raises WeightsError, InputError."""
    from surrogate.models.weights import load_weights
    from surrogate.training.loop import read_curves, series

    weights = load_weights(path)
    rolled_ps, n_frames, reasons, n_caught, stopped = _roll(weights)
    curves = path.with_suffix(".csv")
    stages = read_curves(curves) if curves.exists() else {}
    validation: dict[str, dict[str, float]] = {}
    for stage, rows in stages.items():
        columns = [c for c in rows[-1] if c.startswith("validation_")]
        validation[stage] = {c: values[-1] for c in columns if (values := series(rows, c)[1])}
    valid = 100.0 * (1.0 - n_caught / max(n_frames, 1))
    word = word_of(valid, stopped)
    return TrainingVerdict(
        steps={stage: int(rows[-1]["step"]) for stage, rows in stages.items()},
        validation=validation,
        rolled_ps=rolled_ps,
        n_frames=n_frames,
        percent_valid=valid,
        reasons=dict(reasons.most_common()),
        stopped=stopped,
        word=word,
        advice=() if word == "usable" else tuple(_advice(weights, stages)),
    )


def trial_s(model: Potential, scene: Scene) -> float:
    """Return about how many seconds the rollout of `compare_training` takes with a potential of a scene, by timing its
    forces."""
    import torch

    from surrogate.models.propagator import Molecule

    molecule = Molecule.of(scene)
    frames = torch.tensor(scene.positions_nm)[None].expand(_REPLICAS, -1, -1)
    model.eval()
    taken = []
    for _ in range(1 + _TIMED_FORCES):
        began = time.monotonic()
        model.forces(frames, molecule)
        taken.append(time.monotonic() - began)
    # The first prepares the molecule.
    return _CHUNKS * model.n_new * model.steps_per_frame * statistics.median(taken[1:])


def word_of(percent_valid: float, stopped: str = "") -> str:
    """Return a verdict on weights in a word: by how many frames of a rollout are valid, and whether it `stopped`."""
    if stopped or percent_valid < WITH_HELP:
        return "not usable"
    return "usable" if percent_valid >= USABLE else "usable with help"


def _roll(weights: Weights) -> tuple[float, int, Counter[str], int, str]:
    """Roll up to six of the molecules trained on, four replicas of six chunks each; return the time in ps and the
    frames of all, how many the guards caught and why, and what stopped the rollout."""
    from surrogate.sampling.chunks import caught
    from surrogate.sampling.runner import RolloutConfig, rollout

    time_ps, n_frames, n_caught, reasons, stopped = 0.0, 0, 0, Counter[str](), ""
    members, lag_ps = weights.domain.members, weights.domain.lag_ps
    config = RolloutConfig(
        time_ps=_CHUNKS * weights.model.n_new * lag_ps, lag_ps=lag_ps if weights.domain.jumps else None
    )
    for domain in members[:: -(-len(members) // _MOLECULES)]:
        with tempfile.TemporaryDirectory(prefix="surromd-verdict-") as folder:
            outs = [Path(folder) / f"r{k}.h5" for k in range(_REPLICAS)]
            try:
                rollout(domain.scene, weights, outs, config)
            except SurromdError as error:  # also a structure that the checks of its own reference do not pass
                stopped = stopped or str(error).split(";")[0]
            for out in filter(Path.exists, outs):
                with open_trajectory(out) as reader:
                    flags = np.zeros(0, np.uint16) if reader.flags is None else np.asarray(reader.flags, np.uint16)
                wrong = flags[caught(flags)]
                n_frames, n_caught = n_frames + len(flags), n_caught + len(wrong)
                time_ps += len(flags) * domain.lag_ps
                reasons.update(name for bits in wrong.tolist() for name in flag_names(bits))
    return time_ps, n_frames, reasons, n_caught, stopped


def _advice(weights: Weights, stages: dict[str, list[dict[str, str]]]) -> list[str]:
    """Return what would help, what is likeliest first."""
    from surrogate.models.potential import Potential
    from surrogate.training.loop import series

    found: list[str] = []
    # A potential learned from states, which need be no MD.
    sources = [] if isinstance(weights.model, Potential) else weights.provenance.get("sources", ())
    n_frames = sum(int(source.get("n_frames", 0)) for source in sources)
    rows = list(stages.values())[-1] if stages else []
    column = next((c for c in (rows[-1] if rows else {}) if c.startswith("validation_")), "")
    values, trained = (
        series(rows, column.replace("validation_", kind))[1] if column else [] for kind in ("validation_", "train_")
    )
    if len(values) < 4 or values[-1] < (1.0 - _STILL_FALLS) * values[len(values) // 2]:
        found.append("more minutes (`budget_s`): the validation error had not settled")
    if values and trained and values[-1] > _BY_HEART * trained[-1]:
        times = values[-1] / trained[-1]
        found.append(f"more reference MD: the validation error is {times:.2g} times that in training")
    elif 0 < n_frames < _FEW_FRAMES:
        found.append(f"more reference MD: {n_frames} frames are few")
    return found or ["more minutes (`budget_s`) and more reference MD"]
