"""One training per architecture: what the verb `train` reads, sets up and starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from systems.errors import InputError

if TYPE_CHECKING:
    from surrogate.data.frames import TrainingFrames

T = TypeVar("T")
# (stage, share of all that is to be done) -> None
AdvanceFn = Callable[[str, float], None]
# Names on the command line, what each needs: checked before torch is imported.
GENERATIVE = ("lam-slide",)
FORECASTERS = ("painet", "egnn")
FITTED = ("frozen", "constant-velocity", "resampling", "normal-modes", "msm")


@dataclass(frozen=True)
class TrainingRequest:
    """What `api.train` was asked for, checked as far as names and numbers go."""

    arch: str
    paths: list[Path]
    # Trajectories that are held out whole, for validation.
    held: list[Path]
    out: Path
    config: Path | None
    budget_s: float | None
    steps: int | None
    start_from: Path | None
    time_reversal: bool
    rare_draws: float
    rare_kinds: bool
    # 'modelled' or 'placed', 'atom' or 'residue'; None is what the configuration says.
    hydrogens: str | None
    entities: str | None
    graph: bool
    longest_lag_ps: float | None
    seed: int
    device: str
    resume: bool

    def check(self) -> None:
        """Raise InputError for options that mean nothing to this architecture."""
        if self.arch in FITTED:
            given = {"--budget": self.budget_s, "--steps": self.steps, "--config": self.config}
            self._refuse([k for k, v in given.items() if v is not None], "is fitted in one go")
        elif self.budget_s is None and self.steps is None:
            raise InputError("say how long to train: --budget 30min or --steps 10000.")
        if self.arch in GENERATIVE:
            if self.steps is not None and self.steps < 2:
                raise InputError("--steps must be at least 2: one for each stage.")
            if self.start_from is not None and self.config is not None:
                raise InputError("--from takes the configuration of its weights; leave --config out.")
            settings = {"--graph": self.graph, "--longest-lag": self.longest_lag_ps, "--hydrogens": self.hydrogens,
                        "--entities": self.entities}  # fmt: skip
            told = [k for k, v in settings.items() if v]
            if self.start_from is not None and told:
                raise InputError(f"--from takes the configuration of its weights; leave {' and '.join(told)} out.")
        else:
            others = {"--from": self.start_from, "--time-reversal": self.time_reversal, "--rare-draws": self.rare_draws,
                      "--rare-kinds": self.rare_kinds, "--hydrogens": self.hydrogens, "--entities": self.entities,
                      "--graph": self.graph, "--longest-lag": self.longest_lag_ps}  # fmt: skip
            self._refuse([k for k, v in others.items() if v], "does not know it")

    def _refuse(self, options: list[str], why: str) -> None:
        if options:
            raise InputError(f"{', '.join(options)}: {self.arch} {why}; leave it out.")


@dataclass(frozen=True)
class Prepared:
    """A training whose input has been read and found fit: `start(advance)` does it and returns the weights written."""

    scene: str
    start: Callable[[AdvanceFn], Path]


def prepare_training(request: TrainingRequest) -> Prepared:
    """Read the frames and settings of a training. Errors are those of `api.train`."""
    if request.arch in GENERATIVE:
        return _lam_slide(request)
    return _forecaster(request) if request.arch in FORECASTERS else _fitted(request)


def _lam_slide(request: TrainingRequest) -> Prepared:
    from surrogate.data.molecules import FrameSets, collect_sets
    from surrogate.data.weights import load_weights
    from surrogate.models.lam_slide.config import LamSlideConfig
    from surrogate.models.lam_slide.trainer import STAGE_ONE_SHARE, TrainingConfig, train_lam_slide

    start = None
    record, training = _read_config(request)
    if request.start_from is not None:
        start = load_weights(request.start_from)
        if start.model.arch != request.arch:
            raise InputError(f"{request.start_from} holds {start.model.arch}, not {request.arch}.")
        model_config = start.model.config
    else:
        graph = request.graph or record.get("graph")
        model_config = LamSlideConfig.of_many(record) if graph else LamSlideConfig.from_dict(record)
    told: dict[str, Any] = {"hydrogens": request.hydrogens, "entities": request.entities}
    model_config = replace(model_config, **{key: value for key, value in told.items() if value})
    if model_config.graph:
        sets = collect_sets(request.paths, held=request.held, spool=request.out.parent)
    else:
        sets = FrameSets((read_frames(request, canonical=model_config.canonical),))
    for frames in sets.trained:  # too short a reference is refused before the first stage has been trained
        for validation in (False, True):
            frames.window_starts(model_config.approximator.chunk_frames, validation=validation)
    steps = request.steps
    alone = start is not None or model_config.latents_are_atoms  # stage two: nothing else is to be trained
    first = None if steps is None else 0 if alone else max(1, round(steps * STAGE_ONE_SHARE))
    asked = {
        "budget_s": request.budget_s,
        "stage_one_steps": first,
        "stage_two_steps": None if steps is None or first is None else steps - first,
        "seed": request.seed,
        "device": request.device,
        "time_reversal": request.time_reversal,
        "rare_draws": request.rare_draws,
        "rare_kinds": request.rare_kinds,
        "longest_lag_ps": request.longest_lag_ps,
    }
    settings = _settings(TrainingConfig, request, training, asked)
    share_one = 0.0 if alone else STAGE_ONE_SHARE

    def run(advance: AdvanceFn) -> Path:
        def report(stage: str, share: float, metrics: dict[str, float]) -> None:
            advance(stage, share * share_one if stage == "autoencoder" else share_one + share * (1 - share_one))

        return train_lam_slide(
            sets, request.out, model_config, settings, start=start, resume=request.resume, progress=report
        )

    return Prepared(sets.names, run)


def _forecaster(request: TrainingRequest) -> Prepared:
    from surrogate.models.painet.config import PainetConfig
    from surrogate.models.painet.model import EgnnForecaster, Painet
    from surrogate.models.painet.trainer import PainetTraining, train_painet

    record, training = _read_config(request)
    model_config = PainetConfig.from_dict(record)
    asked = {"budget_s": request.budget_s, "steps": request.steps, "seed": request.seed, "device": request.device}
    settings = _settings(PainetTraining, request, training, asked)
    frames = read_frames(request, canonical=False, velocities=True)
    span = model_config.n_new * model_config.frame_stride
    frames.window_starts(2 * span + 1, validation=False)
    frames.window_starts(span + 1, validation=True)
    kind = EgnnForecaster if request.arch == EgnnForecaster.arch else Painet

    def run(advance: AdvanceFn) -> Path:
        def report(stage: str, share: float, metrics: dict[str, float]) -> None:
            advance(stage, share)

        return train_painet(
            frames, request.out, model_config, settings, model_class=kind, resume=request.resume, progress=report
        )

    return Prepared(frames.scene.name, run)


def _read_config(request: TrainingRequest) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the model's settings in the configuration file and its table `training`; both empty without a file."""
    from surrogate.models.settings import read_toml

    record = {} if request.config is None else read_toml(request.config)
    training = record.pop("training", {})
    if not isinstance(training, dict):
        raise InputError(f"{request.config}: training is a table, [training], not {training!r}.")
    return record, training


def _settings(kind: type[T], request: TrainingRequest, training: dict[str, Any], asked: dict[str, Any]) -> T:
    """Return a training's settings from the file's and those `asked` for, which the file may not hold as well."""
    from surrogate.models.settings import build

    if twice := sorted(asked.keys() & training):
        raise InputError(f"{request.config}: training.{twice[0]} is set on the command line, not in this file.")
    return build(kind, {**training, **asked}, "training.")


def _fitted(request: TrainingRequest) -> Prepared:
    from surrogate.models.baselines.trainer import fit_baseline

    frames = read_frames(request, canonical=True)
    return Prepared(
        frames.scene.name, lambda advance: fit_baseline(request.arch, frames, request.out, seed=request.seed)
    )


def read_frames(request: TrainingRequest, *, canonical: bool, velocities: bool = False) -> TrainingFrames:
    """Return the frames of one windows file or of trajectories, as the architecture wants them."""
    from surrogate.data.frames import collect_frames, is_windows, load_frames

    if not any(is_windows(path) for path in request.paths):
        frames = collect_frames(
            request.paths, canonical=canonical, velocities=velocities, held=request.held, spool=request.out.parent
        )
        frames.refuse_leaks()
        return frames
    if request.held:
        raise InputError("--validation needs trajectories to train on; a windows file keeps its own split.")
    if len(request.paths) > 1:
        raise InputError("give either trajectories or one windows file to train on.")
    frames = load_frames(request.paths[0])
    if velocities and frames.velocities is None:
        raise InputError(
            f"{request.paths[0]} holds no velocities, which {request.arch} learns from; make it with "
            "`surromd windows --velocities`."
        )
    frames.refuse_leaks()
    return frames
