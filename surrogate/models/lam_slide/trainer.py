"""Train LaM-SLidE: stage one (autoencoder), then stage two (latent flow) on the frozen encoder's latents."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from surrogate.data.features.stiff_terms import LOOKED_AT, drawn_terms, holds_hydrogens, rigid_terms
from surrogate.data.frames import TrainingFrames
from surrogate.data.molecules import FrameSets
from surrogate.data.rarity import rare_kinds, window_kinds, window_sampler
from surrogate.data.strides import StrideSampler, strides_up_to
from surrogate.data.weights import Weights, save_weights
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.heavy_trainer import on_heavy_atoms
from surrogate.models.lam_slide.losses import FlowWindows, autoencoder_loss, draw_flow_times, flow_loss
from surrogate.models.lam_slide.model import LamSlide
from surrogate.models.lam_slide.subjects import Subject, normalise_latents, pick
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
    # its other bonds and of its angles too; 'modelled', nothing. A model of many molecules holds them by itself.
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
    frames: TrainingFrames | FrameSets,
    out: str | Path,
    model_config: LamSlideConfig,
    config: TrainingConfig,
    *,
    start: Weights | None = None,
    resume: bool = False,
    progress: ProgressFn | None = None,
) -> Path:
    """Train on `frames` and write `out` (.safetensors); beside it a CSV of the curves and, until done, resume states.

    Frames of several molecules (`data.molecules`) need a configuration with `graph`; each step is shown one of them.
    With `start`, stage two goes on from those weights for the whole budget, and stage one is taken over as it is.
    Raises InputError when the frames do not suit the configuration, SimulationError when training diverges.
    """
    out = Path(out)
    heavy = None
    stiff = None
    if not model_config.graph:
        stiff = _stiff_terms(frames.trained[0] if isinstance(frames, FrameSets) else frames, config, start)
    elif config.stiff == "drawn":
        raise InputError("training.stiff = 'drawn' is for one molecule; leave it out where model.graph = true.")
    if model_config.on_heavy_atoms:
        heavy = on_heavy_atoms(frames, model_config, start, several_lags=config.longest_lag_ps is not None)
        frames, model_config, start = heavy.frames, heavy.config, heavy.start
    sets = frames if isinstance(frames, FrameSets) else FrameSets((frames,))
    first = sets.trained[0]
    model_config = _settle(sets, model_config, config)
    held = model_config.graph and all(holds_hydrogens(f.scene, f.some_nm(LOOKED_AT)) for f in sets.trained)
    if held and start is None:
        model_config = replace(model_config, atoms=replace(model_config.atoms, rigid_hydrogens=True))
    length = model_config.approximator.chunk_frames
    told_of = model_config.approximator.rare_kinds
    kinds = window_kinds(first, told_of, length) if told_of else None
    strides = _strides(sets, model_config)
    torch.manual_seed(config.seed)
    device = torch.device(config.device)
    model = LamSlide(model_config).to(device)
    subjects, unseen = ([Subject.of(f, model) for f in some] for some in (sets.trained, sets.unseen))
    log_path = out.with_suffix(".csv")
    states = [out.with_name(f"{out.stem}.{stage}.train.safetensors") for stage in ("autoencoder", "flow")]
    if not resume and is_first_process():
        for path in (*states, log_path):
            path.unlink(missing_ok=True)
    places = [StagePlace(state, log_path, device, resume) for state in states]
    shown = _Shown(model, subjects, unseen, kinds, strides)
    if start is None:
        one, two = config.stages(with_autoencoder=model.first_stage is not None)
        spent_one = 0.0
        if model.first_stage is not None:
            spent_one = _stage_one(shown, model.first_stage, one, places[0], progress)
        normalise_latents(model, subjects, config.seed)
    else:
        _check_start(start, first, model_config)
        two = config.stages(with_autoencoder=False)[1]
        spent_one = 0.0
        _take_over(model, start)
    if kinds is not None and (start is None or not start.model.config.approximator.rare_kinds):
        own = first.window_starts(length, validation=False)
        model.approximator.set_odds(np.bincount(kinds[own], minlength=len(told_of) + 1) / len(own))

    domains = [training_domain(f, strides=strides if len(strides) > 1 else ()) for f in sets.trained]
    domain = replace(domains[0], further=tuple(domains[1:]), transferable=model_config.graph)

    origin, told = sets.origin, _told(config, [frames.scene.name for frames in sets.unseen])

    def write(spent_s: float) -> None:
        whole, of = (model, domain) if heavy is None else heavy.dressed(model)
        settings = told | {"stage_one_s": round(spent_one, 1), "stage_two_s": round(spent_s, 1)}
        save_weights(out, whole, of, provenance_of(origin, settings, start), stiff=stiff)

    spent_two = _stage_two(shown, config, two, places[1], progress, write)
    if is_first_process():
        write(spent_two)
        for path in states:
            path.unlink(missing_ok=True)
    wait_for_all()
    return out


def _settle(sets: FrameSets, model_config: LamSlideConfig, config: TrainingConfig) -> LamSlideConfig:
    """Return the configuration with what the frames decide. Raises InputError where the two do not fit."""
    first = sets.trained[0]
    if any(f.canonical != model_config.canonical for f in (*sets.trained, *sets.unseen)):
        raise InputError("frames and model disagree on canonical frames; make the windows with the same setting.")
    if not model_config.graph:
        if len(sets.trained) > 1 or sets.unseen:
            raise InputError(
                f"{sets.names}: a model of several molecules knows atoms by their bonds; set model.graph = true."
            )
        residues = model_config.residues
        n, what = (first.scene.n_atoms, "atoms") if residues is None else (len(residues.types), "residues")
        if n > model_config.autoencoder.identifier_pool:
            raise InputError(
                f"{n} {what} need autoencoder.identifier_pool >= {n}, not {model_config.autoencoder.identifier_pool}."
            )
    told = model_config.approximator
    if config.longest_lag_ps is not None:
        told = replace(told, lag_range_ps=(first.lag_ps, config.longest_lag_ps))
    if (model_config.graph or told.lag_range_ps) and (config.rare_draws or config.rare_kinds or told.rare_kinds):
        raise InputError("rare windows are told of one molecule at one lag; leave rare_draws and rare_kinds out.")
    if config.rare_kinds and not told.rare_kinds:
        told = replace(told, rare_kinds=rare_kinds(first, told.chunk_frames))
    return replace(model_config, approximator=told)


def _stiff_terms(frames: TrainingFrames, config: TrainingConfig, start: Weights | None) -> StiffTerms | None:
    """Return the stiff terms that the weights are to have: drawn where they are asked for, or were before."""
    before = None if start is None else start.stiff
    if config.stiff == "drawn" or (before is not None and before.plan.rows):
        return drawn_terms(frames)
    return rigid_terms(frames.scene, frames.some_nm(LOOKED_AT)) if config.stiff == "held" else None


def _strides(sets: FrameSets, model_config: LamSlideConfig) -> tuple[int, ...]:
    """Return the strides that windows are drawn with. Raises InputError for lags that the frames do not have."""
    frames, lags = sets.trained[0], model_config.approximator.lag_range_ps
    if lags is None:
        return (1,)
    if not np.isclose(lags[0], frames.lag_ps, rtol=1e-4):
        raise InputError(f"the model's lags begin at {lags[0]:g} ps, frames of {frames.scene.name} are saved every "
                         f"{frames.lag_ps:g} ps.")  # fmt: skip
    longest = whole_steps(lags[1], frames.lag_ps, "the longest lag in the frames' spacing")
    if longest < 2:
        raise InputError("the longest lag must be at least twice the frames' spacing; leave it out for one lag alone.")
    strides = strides_up_to(longest)
    for each in sets.trained:  # too short a reference is refused before the first stage has been trained
        StrideSampler.of(each, model_config.approximator.chunk_frames, strides)
    return strides


@dataclass(frozen=True, eq=False)
class _Shown:
    """What both stages are shown: molecules to learn from, and those held out whole. `kinds` (n_frames,) of the windows
    from each frame on (data.rarity), where the network is told; `strides` that windows are drawn with."""

    model: LamSlide
    subjects: list[Subject]
    unseen: list[Subject]
    kinds: npt.NDArray[np.int64] | None
    strides: tuple[int, ...]


def _stage_one(
    shown: _Shown, trained: nn.Module, stage: StageConfig, place: StagePlace, progress: ProgressFn | None
) -> float:
    model, subjects, unseen = shown.model, shown.subjects, shown.unseen
    starts = [subject.frames.window_starts(1, validation=False) for subject in subjects]

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        k = pick(subjects, generator)
        subject, own = subjects[k], starts[k]
        idx = own[torch.randint(len(own), (stage.batch,), generator=generator).numpy()]
        x = torch.from_numpy(subject.frames.positions_nm(idx))
        x, atoms = subject.seen(model, x, subject.poses(model, len(x), generator))
        return autoencoder_loss(model, x, subject.molecule.elements, generator, atoms)

    @torch.no_grad()
    def validate() -> dict[str, float]:
        found = {"validation_rmsd_nm": subjects, "unseen_rmsd_nm": unseen}
        return {
            name: float(np.mean([subject.reconstruction_error_nm(model) for subject in some]))
            for name, some in found.items()
            if some
        }

    return run_stage(trained, stage, loss_fn, validate, place, progress=progress)


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
    model, subjects, unseen, kinds, strides = shown.model, shown.subjects, shown.unseen, shown.kinds, shown.strides
    length, device = model.config.approximator.chunk_frames, model.latent_mean.device
    if len(strides) > 1:
        wide = [StrideSampler.of(subject.frames, length, strides) for subject in subjects]
    else:
        plain = [window_sampler(subject.frames, length, config.rare_draws, kinds) for subject in subjects]
    if model.first_stage is not None:
        model.first_stage.requires_grad_(False)
    if config.compile:
        model.approximator.compile()
        model.autoencoder.decode = torch.compile(model.autoencoder.decode)  # type: ignore[method-assign]
    turned = model.config.graph and model.config.atoms.turn
    numbers = sum(subject.frames.n_frames * math.prod(model.noise_shape(subject.n_atoms)) for subject in subjects)
    if model.canonical and not turned and 4 * numbers // length <= LATENT_CACHE_BYTES:
        for subject in subjects:
            subject.keep_latents(model)

    def loss_of(subject: Subject, idx: Tensor, stride: Tensor | None, tau: Tensor, generator: torch.Generator,
                **more: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
        latents, atoms = subject.windows(model, idx, generator)
        lags = None if stride is None else (stride * subject.frames.lag_ps).to(device)
        told = model.told(atoms, lags, len(idx))
        return flow_loss(model, FlowWindows(latents, subject.n_atoms, atoms, told, **more), tau, generator)

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        k = pick(subjects, generator)
        importance = kind = stride = None
        if len(strides) > 1:
            first, stride = wide[k].draw(stage.batch, generator)
        else:
            first, importance, kind = plain[k].draw(stage.batch, generator)
        tau = draw_flow_times(model, stage.batch, generator).to(device)
        idx = window_frames(first, length, generator, time_reversal=config.time_reversal, stride=stride)
        weight = None if importance is None else importance.to(device)
        return loss_of(subjects[k], idx, stride, tau, generator, importance=weight,
                       kind=None if kind is None else kind.to(device))  # fmt: skip

    held = {name: [_held_windows(subject, length, strides, kinds) for subject in some]
            for name, some in (("validation", subjects), ("unseen", unseen)) if some}  # fmt: skip

    with_bf16 = stage.bf16 and bf16_pays(device.type)

    @torch.no_grad()
    def validate() -> dict[str, float]:
        found: dict[str, list[float]] = {}
        for name, windows in held.items():
            for subject, idx, stride, kind in windows:
                # The same noise and flow times each time, so that the curve shows the model and not the draw.
                generator = torch.Generator().manual_seed(0)
                tau = draw_flow_times(model, len(idx), generator).to(device)
                with torch.autocast(device.type, dtype=torch.bfloat16, enabled=with_bf16):
                    _, terms = loss_of(subject, idx, stride, tau, generator,
                                       kind=None if kind is None else kind.to(device))  # fmt: skip
                for key, value in terms.items():
                    found.setdefault(f"{name}_{key}", []).append(float(value))
        return {key: float(np.mean(values)) for key, values in found.items()}

    next_snapshot = [config.snapshot_every_s or float("inf")]

    def on_save(spent_s: float) -> None:
        write(spent_s)
        if spent_s >= next_snapshot[0]:
            out = place.state.with_name(place.state.name.replace(".flow.train.safetensors", ".safetensors"))
            shutil.copy(out, out.with_name(f"{out.stem}.at{round(spent_s / 60)}min.safetensors"))
            next_snapshot[0] = spent_s + (config.snapshot_every_s or float("inf"))

    return run_stage(model.second_stage, stage, loss_fn, validate, place, progress=progress, on_save=on_save)


def _held_windows(
    subject: Subject, length: int, strides: tuple[int, ...], kinds: npt.NDArray[np.int64] | None
) -> tuple[Subject, Tensor, Tensor | None, Tensor | None]:
    """Return up to 256 held-out windows, evenly spaced, as frames `(b, length)`, their strides and kinds."""
    if len(strides) > 1:
        sampler = StrideSampler.of(subject.frames, length, strides, validation=True)
        first, stride = sampler.draw(256, torch.Generator().manual_seed(0))
        return subject, first[:, None] + torch.arange(length) * stride[:, None], stride, None
    held = torch.from_numpy(subject.frames.window_starts(length, validation=True))
    held = held[torch.linspace(0, len(held) - 1, min(256, len(held))).long()]
    return subject, held[:, None] + torch.arange(length), None, None if kinds is None else torch.from_numpy(kinds)[held]


def _check_start(start: Weights, frames: TrainingFrames, model_config: LamSlideConfig) -> None:
    """Refuse (InputError) to go on from weights of another molecule, frame spacing or configuration."""
    name, of = start.path.name, start.domain
    # Weights that know no kinds may learn them.
    told = start.model.config.approximator.rare_kinds or model_config.approximator.rare_kinds
    same = replace(start.model.config, approximator=replace(start.model.config.approximator, rare_kinds=told))
    if same != model_config:
        raise InputError(f"{name} has another configuration; a training goes on with the one it began with.")
    if not model_config.graph and of.scene.topology_hash != frames.scene.topology_hash:
        raise InputError(f"{name} was trained on {of.scene.name}, not on {frames.scene.name} in this atom order.")
    if not np.isclose(of.lag_ps, frames.lag_ps, rtol=1e-4):
        raise InputError(f"{name} steps {of.lag_ps:g} ps from frame to frame; these trajectories {frames.lag_ps:g} ps.")


def _take_over(model: LamSlide, start: Weights) -> None:
    """Load the tensors of `start`; what tells rare kinds may be new."""
    missing, surplus = model.load_state_dict(start.model.state_dict(), strict=False)
    assert not surplus and all(name.startswith(("approximator.embed_kind", "approximator.odds")) for name in missing)


def _told(config: TrainingConfig, held_out: list[str]) -> dict[str, Any]:
    """Return what the weights' provenance says of the settings."""
    settings: dict[str, Any] = {
        "seed": config.seed,
        "time_reversal": config.time_reversal,
        "rare_draws": config.rare_draws,
        "rare_kinds": config.rare_kinds,
    }
    return settings | ({"held_out_molecules": held_out} if held_out else {})
