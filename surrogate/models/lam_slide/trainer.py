"""Train LaM-SLidE: stage one (autoencoder), then stage two (latent flow) on the frozen encoder's latents."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data.features.stiff_terms import LOOKED_AT, drawn_terms, rigid_terms
from surrogate.data.frames import TrainingFrames
from surrogate.data.rarity import rare_kinds, window_kinds, window_sampler
from surrogate.data.strides import StrideSampler, strides_up_to
from surrogate.data.weights import Weights, save_weights
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.losses import FlowWindows, autoencoder_loss, draw_flow_times, flow_loss
from surrogate.models.lam_slide.model import LamSlide
from surrogate.models.lam_slide.subjects import Subject, normalise_latents
from surrogate.models.precision import bf16_pays
from surrogate.models.stiff import StiffTerms
from surrogate.training.devices import is_first_process, wait_for_all
from surrogate.training.loop import ProgressFn, StageConfig, StagePlace, run_stage
from surrogate.training.provenance import provenance_of, training_domain
from systems.errors import InputError
from systems.units import whole_steps

# Latents beyond this are not kept: windows are encoded when they are drawn.
LATENT_CACHE_BYTES = 2_000_000_000
# Share of the whole budget that stage one gets.
STAGE_ONE_SHARE = 0.2


@dataclass(frozen=True)
class TrainingConfig:
    """Both stages' optimisation (AdamW, EMA 0.999; appendix E.5). Budgets in seconds of training, or steps."""

    budget_s: float | None = None
    stage_one_steps: int | None = None
    stage_two_steps: int | None = None
    stage_one_batch: int = 128
    stage_two_batch: int = 64
    stage_one_rate: float = 2e-3
    stage_two_rate: float = 1e-3
    seed: int = 0
    bf16: bool = True
    device: str = "cpu"
    validate_every_s: float = 60.0
    snapshot_every_s: float | None = None
    # Compile stage two's network and the decoder; needs a C++ compiler on the machine.
    compile: bool = False
    # Present every other window backwards: exact for positions of a system in equilibrium (microscopic
    # reversibility), and each rare event then shows how it begins and how it ends.
    time_reversal: bool = False
    # Share of stage two's windows drawn for a rare state they show, weighted down by as much (data.rarity); 0 is plain.
    rare_draws: float = 0.0
    # Tell the network which rare state a window visits, and learn the odds of each kind by themselves: rare windows
    # then count as much as others and yet come as often as they should.
    rare_kinds: bool = False
    # Windows are drawn with strides up to this lag, each as likely, and the network is told which.
    longest_lag_ps: float | None = None
    # What rollouts take from the reference (models.stiff): 'held', the bonds that it holds rigid; 'drawn', the width of
    # its other bonds and of its angles too; 'modelled', nothing.
    stiff: str = "held"

    def __post_init__(self) -> None:
        if self.stiff not in ("held", "drawn", "modelled"):
            raise InputError(f"training.stiff = {self.stiff!r} is unknown; choose held, drawn or modelled.")

    def stages(self, *, with_autoencoder: bool = True) -> tuple[StageConfig, StageConfig]:
        """Return both stages; stage two gets the whole budget where there is no autoencoder to train."""
        share = STAGE_ONE_SHARE if with_autoencoder else 0.0
        budget_one = None if self.budget_s is None else self.budget_s * share
        budget_two = None if self.budget_s is None else self.budget_s * (1 - share)
        common: dict[str, Any] = {"bf16": self.bf16, "validate_every_s": self.validate_every_s}
        one = StageConfig("autoencoder", self.stage_one_batch, self.stage_one_rate, budget_one, self.stage_one_steps,
                          seed=self.seed, **common)  # fmt: skip
        two = StageConfig("flow", self.stage_two_batch, self.stage_two_rate, budget_two, self.stage_two_steps,
                          seed=self.seed + 1, **common)  # fmt: skip
        return one, two


def is_trained(out: Path) -> bool:
    """Return whether `out` is there and no state of an interrupted training is beside it."""
    return out.exists() and not list(out.parent.glob(f"{out.stem}.*.train.safetensors"))


def train_lam_slide(
    frames: TrainingFrames,
    out: str | Path,
    model_config: LamSlideConfig,
    config: TrainingConfig,
    *,
    start: Weights | None = None,
    resume: bool = False,
    progress: ProgressFn | None = None,
) -> Path:
    """Train on `frames` and write `out` (.safetensors); beside it a CSV of the curves and, until done, resume states.

    With `start`, stage two goes on from those weights for the whole budget, and stage one is taken over as it is.
    Raises InputError when the frames do not suit the configuration, SimulationError when training diverges.
    """
    out = Path(out)
    stiff = _stiff_terms(frames, config, start)
    model_config = _settle(frames, model_config, config)
    length = model_config.approximator.chunk_frames
    told_of = model_config.approximator.rare_kinds
    kinds = window_kinds(frames, told_of, length) if told_of else None
    strides = _strides(frames, model_config)
    torch.manual_seed(config.seed)
    device = torch.device(config.device)
    model = LamSlide(model_config).to(device)
    subject = Subject.of(frames, model)
    log_path = out.with_suffix(".csv")
    states = [out.with_name(f"{out.stem}.{stage}.train.safetensors") for stage in ("autoencoder", "flow")]
    if not resume and is_first_process():
        for path in (*states, log_path):
            path.unlink(missing_ok=True)
    places = [StagePlace(state, log_path, device, resume) for state in states]
    shown = _Shown(model, subject, kinds, strides)
    one, two = config.stages(with_autoencoder=start is None)
    spent_one = 0.0
    if start is None:
        spent_one = _stage_one(shown, one, places[0], progress)
        normalise_latents(model, subject, config.seed)
    else:
        _check_start(start, frames, model_config)
        _take_over(model, start)
    if kinds is not None and (start is None or not start.model.config.approximator.rare_kinds):
        own = frames.window_starts(length, validation=False)
        model.approximator.set_odds(np.bincount(kinds[own], minlength=len(told_of) + 1) / len(own))

    domain = training_domain(frames, strides=strides if len(strides) > 1 else ())
    origin = {"reference_ns": frames.total_ps * 1e-3, "sources": list(frames.sources)}

    def write(spent_s: float) -> None:
        settings = _told(config) | {"stage_one_s": round(spent_one, 1), "stage_two_s": round(spent_s, 1)}
        save_weights(out, model, domain, provenance_of(origin, settings, start), stiff=stiff)

    spent_two = _stage_two(shown, config, two, places[1], progress, write)
    if is_first_process():
        write(spent_two)
        for path in states:
            path.unlink(missing_ok=True)
    wait_for_all()
    return out


def _settle(frames: TrainingFrames, model_config: LamSlideConfig, config: TrainingConfig) -> LamSlideConfig:
    """Return the configuration with what the frames decide. Raises InputError where the two do not fit."""
    if frames.canonical != model_config.canonical:
        raise InputError("frames and model disagree on canonical frames; make the windows with the same setting.")
    n, pool = frames.scene.n_atoms, model_config.autoencoder.identifier_pool
    if n > pool:
        raise InputError(f"{n} atoms need autoencoder.identifier_pool >= {n}, not {pool}.")
    told = model_config.approximator
    if config.longest_lag_ps is not None:
        told = replace(told, lag_range_ps=(frames.lag_ps, config.longest_lag_ps))
    if told.lag_range_ps and (config.rare_draws or config.rare_kinds or told.rare_kinds):
        raise InputError("rare windows are told of one molecule at one lag; leave rare_draws and rare_kinds out.")
    if config.rare_kinds and not told.rare_kinds:
        told = replace(told, rare_kinds=rare_kinds(frames, told.chunk_frames))
    return replace(model_config, approximator=told)


def _stiff_terms(frames: TrainingFrames, config: TrainingConfig, start: Weights | None) -> StiffTerms | None:
    """Return the stiff terms that the weights are to have: drawn where they are asked for, or were before."""
    before = None if start is None else start.stiff
    if config.stiff == "drawn" or (before is not None and before.plan.rows):
        return drawn_terms(frames)
    return rigid_terms(frames.scene, frames.some_nm(LOOKED_AT)) if config.stiff == "held" else None


def _strides(frames: TrainingFrames, model_config: LamSlideConfig) -> tuple[int, ...]:
    """Return the strides that windows are drawn with. Raises InputError for lags that the frames do not have."""
    lags = model_config.approximator.lag_range_ps
    if lags is None:
        return (1,)
    if not np.isclose(lags[0], frames.lag_ps, rtol=1e-4):
        raise InputError(f"the model's lags begin at {lags[0]:g} ps, frames of {frames.scene.name} are saved every "
                         f"{frames.lag_ps:g} ps.")  # fmt: skip
    longest = whole_steps(lags[1], frames.lag_ps, "the longest lag in the frames' spacing")
    if longest < 2:
        raise InputError("the longest lag must be at least twice the frames' spacing; leave it out for one lag alone.")
    strides = strides_up_to(longest)
    # Too short a reference is refused before the first stage has been trained.
    StrideSampler.of(frames, model_config.approximator.chunk_frames, strides)
    return strides


@dataclass(frozen=True, eq=False)
class _Shown:
    """What both stages are shown. `kinds` (n_frames,) of the windows from each frame on (data.rarity), where the
    network is told; `strides` that windows are drawn with."""

    model: LamSlide
    subject: Subject
    kinds: npt.NDArray[np.int64] | None
    strides: tuple[int, ...]


def _stage_one(shown: _Shown, stage: StageConfig, place: StagePlace, progress: ProgressFn | None) -> float:
    model, subject = shown.model, shown.subject
    own = subject.frames.window_starts(1, validation=False)

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        idx = own[torch.randint(len(own), (stage.batch,), generator=generator).numpy()]
        x = torch.from_numpy(subject.frames.positions_nm(idx))
        x = subject.seen(x, subject.poses(model, len(x), generator))
        return autoencoder_loss(model, x, subject.molecule.elements, generator)

    def validate() -> dict[str, float]:
        return {"validation_rmsd_nm": subject.reconstruction_error_nm(model)}

    return run_stage(model.autoencoder, stage, loss_fn, validate, place, progress=progress)


def window_frames(first: Tensor, length: int, generator: torch.Generator, *, time_reversal: bool,
                  stride: Tensor | None = None) -> Tensor:  # fmt: skip
    """Return the frames `(b, length)` of windows from their first frames `(b,)`, `stride` (b,) apart, one apart where
    None; reversed ones with probability 1/2."""
    ahead = torch.arange(length)[None]
    idx = first[:, None] + (ahead if stride is None else ahead * stride[:, None])
    if not time_reversal:
        return idx
    backwards = torch.rand(len(idx), 1, generator=generator) < 0.5
    return torch.where(backwards, idx.flip(1), idx)


def _stage_two(
    shown: _Shown, config: TrainingConfig, stage: StageConfig, place: StagePlace, progress: ProgressFn | None,
    write: Callable[[float], None],
) -> float:  # fmt: skip
    model, subject, kinds, strides = shown.model, shown.subject, shown.kinds, shown.strides
    length, device = model.config.approximator.chunk_frames, model.latent_mean.device
    if len(strides) > 1:
        wide = StrideSampler.of(subject.frames, length, strides)
    else:
        plain = window_sampler(subject.frames, length, config.rare_draws, kinds)
    model.autoencoder.requires_grad_(False)
    if config.compile:
        model.approximator.compile()
        model.autoencoder.decode = torch.compile(model.autoencoder.decode)  # type: ignore[method-assign]
    c = model.config.autoencoder
    if model.canonical and 4 * subject.frames.n_frames * c.n_latents * c.latent_dim <= LATENT_CACHE_BYTES:
        subject.keep_latents(model)

    def loss_of(idx: Tensor, stride: Tensor | None, tau: Tensor, generator: torch.Generator,
                **more: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
        latents = subject.windows(model, idx, generator)
        lag = model.embedded_lag(None if stride is None else (stride * subject.frames.lag_ps).to(device), len(idx))
        return flow_loss(model, FlowWindows(latents, subject.n_atoms, lag, **more), tau, generator)

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        importance = kind = stride = None
        if len(strides) > 1:
            first, stride = wide.draw(stage.batch, generator)
        else:
            first, importance, kind = plain.draw(stage.batch, generator)
        tau = draw_flow_times(model, stage.batch, generator).to(device)
        idx = window_frames(first, length, generator, time_reversal=config.time_reversal, stride=stride)
        weight = None if importance is None else importance.to(device)
        return loss_of(idx, stride, tau, generator, importance=weight, kind=None if kind is None else kind.to(device))

    held, held_stride, held_kind = _held_windows(subject, length, strides, kinds)
    with_bf16 = stage.bf16 and bf16_pays(device.type)

    @torch.no_grad()
    def validate() -> dict[str, float]:
        # The same noise and flow times each time, so that the curve shows the model and not the draw.
        generator = torch.Generator().manual_seed(0)
        tau = draw_flow_times(model, len(held), generator).to(device)
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=with_bf16):
            _, terms = loss_of(held, held_stride, tau, generator,
                               kind=None if held_kind is None else held_kind.to(device))  # fmt: skip
        return {f"validation_{key}": float(value) for key, value in terms.items()}

    next_snapshot = [config.snapshot_every_s or float("inf")]

    def on_save(spent_s: float) -> None:
        write(spent_s)
        if spent_s >= next_snapshot[0]:
            out = place.state.with_name(place.state.name.replace(".flow.train.safetensors", ".safetensors"))
            shutil.copy(out, out.with_name(f"{out.stem}.at{round(spent_s / 60)}min.safetensors"))
            next_snapshot[0] = spent_s + (config.snapshot_every_s or float("inf"))

    return run_stage(model.approximator, stage, loss_fn, validate, place, progress=progress, on_save=on_save)


def _held_windows(
    subject: Subject, length: int, strides: tuple[int, ...], kinds: npt.NDArray[np.int64] | None
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Return up to 256 held-out windows, evenly spaced, as frames `(b, length)`, their strides and kinds."""
    if len(strides) > 1:
        sampler = StrideSampler.of(subject.frames, length, strides, validation=True)
        first, stride = sampler.draw(256, torch.Generator().manual_seed(0))
        return first[:, None] + torch.arange(length) * stride[:, None], stride, None
    held = torch.from_numpy(subject.frames.window_starts(length, validation=True))
    held = held[torch.linspace(0, len(held) - 1, min(256, len(held))).long()]
    return held[:, None] + torch.arange(length), None, None if kinds is None else torch.from_numpy(kinds)[held]


def _check_start(start: Weights, frames: TrainingFrames, model_config: LamSlideConfig) -> None:
    """Refuse (InputError) to go on from weights of another molecule, frame spacing or configuration."""
    name, of = start.path.name, start.domain
    # Weights that know no kinds may learn them.
    told = start.model.config.approximator.rare_kinds or model_config.approximator.rare_kinds
    same = replace(start.model.config, approximator=replace(start.model.config.approximator, rare_kinds=told))
    if same != model_config:
        raise InputError(f"{name} has another configuration; a training goes on with the one it began with.")
    if of.scene.topology_hash != frames.scene.topology_hash:
        raise InputError(f"{name} was trained on {of.scene.name}, not on {frames.scene.name} in this atom order.")
    if not np.isclose(of.lag_ps, frames.lag_ps, rtol=1e-4):
        raise InputError(f"{name} steps {of.lag_ps:g} ps from frame to frame; these trajectories {frames.lag_ps:g} ps.")


def _take_over(model: LamSlide, start: Weights) -> None:
    """Load the tensors of `start`; what tells rare kinds may be new."""
    missing, surplus = model.load_state_dict(start.model.state_dict(), strict=False)
    assert not surplus and all(name.startswith(("approximator.embed_kind", "approximator.odds")) for name in missing)


def _told(config: TrainingConfig) -> dict[str, Any]:
    """Return what the weights' provenance says of the settings."""
    return {
        "seed": config.seed,
        "time_reversal": config.time_reversal,
        "rare_draws": config.rare_draws,
        "rare_kinds": config.rare_kinds,
    }
