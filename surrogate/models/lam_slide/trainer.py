"""Train LaM-SLidE: stage one (autoencoder), then stage two (latent flow) on the frozen encoder's latents."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F

from surrogate.data import References, StrideSampler, TrainingFrames, strides_up_to
from surrogate.models import architecture as arch
from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.model import AutoencoderConfig, LamSlide, LamSlideConfig, draw_identifiers
from surrogate.models.weights import Weights, load_weights, provenance_of, read_header, save_weights, training_domain
from surrogate.training.devices import bf16_pays
from surrogate.training.loop import ProgressFn, Stage, StageConfig, train_stages
from systems.errors import InputError
from systems.units import whole_steps

# The two stages' losses: reconstruction (stage one) and data-prediction flow matching (stage two).

# The weight 1 / sigma^2 diverges at the data end; flow times stop just before it.
TAU_MAX = 0.995


def random_rotations(n: int, generator: torch.Generator) -> Tensor:
    """Return `(n, 3, 3)` rotations, uniform over SO(3): normalised Gaussian quaternions."""
    from scipy.spatial.transform import Rotation

    real_last = torch.randn(n, 4, generator=generator).roll(-1, dims=1)
    return torch.from_numpy(Rotation.from_quat(real_last.numpy()).as_matrix()).float()


def pair_distances(x: Tensor) -> Tensor:
    """Return distances `(..., n, n)` (eq. 15), differentiable on the diagonal."""
    difference = x.unsqueeze(-2) - x.unsqueeze(-3)
    return (difference.square().sum(-1) + 1e-12).sqrt()


def autoencoder_loss(
    model: LamSlide, frames_nm: Tensor, elements: Tensor, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Stage one on frames `(b, n_atoms, 3)` nm: eq. 13, 14 and 16 with table weights; identifiers of Algorithm 1."""
    c = model.config.autoencoder
    batch, n_atoms, _ = frames_nm.shape
    x = frames_nm / model.config.position_scale_nm
    identifiers = model.identifiers(n_atoms).expand(batch, -1)
    if c.random_identifiers > 0:
        drawn = draw_identifiers(identifiers.shape[1], c.identifier_pool, batch, generator).to(x.device)
        pick = torch.rand(batch, 1, generator=generator).to(x.device) < c.random_identifiers
        identifiers = torch.where(pick, drawn, identifiers)
    numbers = elements.expand(batch, n_atoms)
    latents = model.autoencoder.encode(x, numbers, identifiers)
    noise = torch.randn(latents.shape, generator=generator).to(x.device)
    decoded = model.autoencoder.decode(latents + c.latent_noise * noise, identifiers, with_types=c.type_weight > 0)
    position = (x - decoded.positions).square().sum(-1).mean()
    distance = (pair_distances(x) - pair_distances(decoded.positions)).square().mean()
    loss = c.position_weight * position + c.distance_weight * distance
    terms = {"position": position, "distance": distance}
    if decoded.type_logits is not None:
        terms["type"] = F.cross_entropy(decoded.type_logits.flatten(0, 1), numbers.flatten())
        loss = loss + c.type_weight * terms["type"]
    return loss, {k: v.detach() for k, v in terms.items()}


def draw_flow_times(model: LamSlide, batch: int, generator: torch.Generator) -> Tensor:
    """Return flow times `(batch,)` in [0, TAU_MAX], logit-normal or uniform."""
    c = model.config.approximator
    if c.uniform_tau:
        return torch.rand(batch, generator=generator).clamp(max=TAU_MAX)
    draws = torch.randn(batch, generator=generator) * c.tau_scale + c.tau_location
    return torch.sigmoid(draws).clamp(max=TAU_MAX)


def flow_loss(
    model: LamSlide, latents: Tensor, n_atoms: int, tau: Tensor, generator: torch.Generator, lag: Tensor | None = None,
    noise: Tensor | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
    """Return stage two's loss on windows' clean `latents` (b, T, L, dim) at flow times `tau (b,)`, and its terms: eq. 9
    on the predicted frames (with `loss_on_given` on all), plus decoded position and distance. `lag`: see
    `LamSlide.embedded_lag`. `noise`, as `latents`: else drawn.

    With preconditioning the error is divided by c_out^2, so that every flow time asks for the same relative precision.
    Decoded terms compare with the decoded clean latents: the decoder's own error is none of the approximator's.
    """
    c = model.config.approximator
    known = latents[:, : c.n_conditioning]
    if noise is None:
        noise = torch.randn(latents.shape, generator=generator).to(latents.device)
    first = 0 if c.loss_on_given else c.n_conditioning
    prediction = model.approximator(flow.mixed(latents, noise, tau), tau, known, lag=lag)[:, first:]
    target = latents[:, first:]
    weight = torch.ones_like(tau)
    if c.precondition:
        weight = flow.preconditioning(tau)[1].square().reciprocal()
    loss = ((prediction - target).square().flatten(1).mean(1) * weight).mean()
    terms = {"flow": loss.detach()}
    if c.auxiliary_frames and (c.position_weight or c.distance_weight):
        pick = torch.randint(target.shape[1], (c.auxiliary_frames,), generator=generator)
        scale = model.config.position_scale_nm
        decoded = model.decode(prediction[:, pick], n_atoms) / scale
        with torch.no_grad():
            clean = model.decode(target[:, pick], n_atoms) / scale
        w = weight.reshape(-1, 1, 1, 1).sqrt()
        position = ((decoded - clean) * w).square().sum(-1).mean()
        i, j = torch.triu_indices(n_atoms, n_atoms, 1)
        span = lambda x: ((x[..., i, :] - x[..., j, :]).square().sum(-1) + 1e-12).sqrt()  # noqa: E731
        distance = ((span(decoded) - span(clean)) * w[..., 0]).square().mean()
        loss = loss + c.position_weight * position + c.distance_weight * distance
        terms |= {"position": position.detach(), "distance": distance.detach()}
    return loss, terms


# The two stages on one molecule.

_HELD_FRAMES, _HELD_WINDOWS = 2048, 256
_BLOCK = 8192
_MEASURED_FRAMES = 20_000


@dataclass(eq=False)
class Subject:
    """One molecule's frames and the model that learns them; windows are drawn with any of `strides`. `latents`
    (n_frames, n_latents, dim): those of all frames, once stage one is over, where poses stay and memory suffices."""

    frames: TrainingFrames
    model: LamSlide
    strides: tuple[int, ...]
    latents: Tensor | None = None

    def __post_init__(self) -> None:
        self.device = self.model.latent_mean.device
        self.elements = self.model.featurise(self.frames.scene).elements.to(self.device)

    def seen(self, idx: npt.NDArray[np.int64], generator: torch.Generator | None = None) -> Tensor:
        """Return frames `(*idx.shape, n_atoms, 3)` nm; with a generator each row of them in a pose of its own, unless
        the model's frames are canonical."""
        x = torch.from_numpy(self.frames.positions_nm(idx))
        if generator is not None and not self.model.config.canonical:
            x = torch.einsum("bij,b...nj->b...ni", random_rotations(len(x), generator), x)
        return x.to(self.device)

    @torch.no_grad()
    def encode(self, idx: npt.NDArray[np.int64], generator: torch.Generator | None = None) -> Tensor:
        """Return the latents `(*idx.shape, n_latents, dim)` of frames."""
        return self.model.encode(self.seen(idx, generator), self.elements)

    @torch.no_grad()
    def reconstruction_error_nm(self) -> float:
        """Return the root mean square error of held-out frames that went through the autoencoder."""
        x = self.seen(self.frames.spread_starts(_HELD_FRAMES, validation=True))
        error = self.model.decode(self.model.encode(x, self.elements), len(self.elements)) - x
        return float(error.square().sum(-1).mean().sqrt())

    def keep_latents(self) -> None:
        """Encode every frame once and keep the latents, where that may be done."""
        n, c = self.frames.n_frames, self.model.config.autoencoder
        if self.model.config.canonical and 4 * n * c.n_latents * c.latent_dim <= LATENT_CACHE_BYTES:
            parts = [self.encode(np.arange(k, min(k + _BLOCK, n))).cpu() for k in range(0, n, _BLOCK)]
            self.latents = torch.cat(parts).to(self.device)

    def windows(self, idx: Tensor, generator: torch.Generator) -> Tensor:
        """Return the latents `(b, length, n_latents, dim)` of frames `idx` (b, length), each window in its own pose."""
        return self.encode(idx.numpy(), generator) if self.latents is None else self.latents[idx.to(self.device)]

    @torch.no_grad()
    def normalise_latents(self, seed: int) -> None:
        """Measure the latents' means and common scale on training frames and set them."""
        model = self.model
        model.latent_mean.zero_()
        model.latent_scale.fill_(1.0)
        starts = self.frames.window_starts(1, validation=False)
        n = min(_MEASURED_FRAMES, len(starts))
        z = self.encode(starts[np.sort(np.random.default_rng(seed).choice(len(starts), size=n, replace=False))])
        model.latent_mean.copy_(z.mean(0))
        model.latent_scale.copy_((z - z.mean(0)).square().mean().sqrt())


def pick(subjects: Sequence[object], generator: torch.Generator) -> int:
    """Return which subject a batch is of, each as likely; a single one costs no random number."""
    if len(subjects) == 1:
        return 0
    return int(torch.randint(len(subjects), (1,), generator=generator))


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
    # Present every other window backwards: exact for positions of a system in equilibrium (microscopic
    # reversibility), and each rare event then shows how it begins and how it ends.
    time_reversal: bool = False
    # Windows are drawn with strides up to this lag, each as likely; the network takes the lag as an input.
    longest_lag_ps: float | None = None

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


def train_lam_slide(
    frames: TrainingFrames, out: str | Path, model_config: LamSlideConfig, config: TrainingConfig, *,
    start: Weights | None = None, resume: bool = False, progress: ProgressFn | None = None,
) -> Path:  # fmt: skip
    """Train on `frames` and write `out` (.safetensors); beside it a CSV of the curves and, until done, resume states.

    With `start`, stage two goes on from those weights for the whole budget, and stage one is taken over as it is.
    Raises InputError when the frames do not suit the configuration, SimulationError when training diverges.
    """
    out = Path(out)
    model_config = _resolve(frames, model_config, config)
    strides = _strides(frames, model_config)
    torch.manual_seed(config.seed)
    device = torch.device(config.device)
    model = LamSlide(model_config).to(device)
    subject = Subject(frames, model, strides)
    one, two = config.stages(with_autoencoder=start is None)
    if start is not None:
        _check_start(start, frames, model_config)
        model.load_state_dict(start.model.state_dict())
    domain = training_domain(frames, strides=strides if len(strides) > 1 else ())

    def stages() -> Iterator[Stage]:
        if start is None:
            yield _stage_one(subject, one)
            subject.normalise_latents(config.seed)
        yield _stage_two(subject, config, two)

    def write(spent_s: list[float]) -> None:
        spent_one, spent_two = [0.0, *spent_s][-2:]
        settings = {"seed": config.seed, "time_reversal": config.time_reversal, "stage_one_s": round(spent_one, 1),
                    "stage_two_s": round(spent_two, 1)}  # fmt: skip
        save_weights(out, model, domain, provenance_of(frames.origin, settings, start))

    train_stages(stages(), out, write, device=device, resume=resume, progress=progress)
    return out


def _resolve(frames: TrainingFrames, model_config: LamSlideConfig, config: TrainingConfig) -> LamSlideConfig:
    """Return the configuration with what the frames decide. Raises InputError where the two do not fit."""
    if frames.canonical != model_config.canonical:
        raise InputError("frames and model disagree on canonical frames; make the windows with the same setting.")
    n, pool = frames.scene.n_atoms, model_config.autoencoder.identifier_pool
    if n > pool:
        raise InputError(f"{n} atoms need autoencoder.identifier_pool >= {n}, not {pool}.")
    if config.longest_lag_ps is None:
        return model_config
    lags = replace(model_config.approximator, lag_range_ps=(frames.lag_ps, config.longest_lag_ps))
    return replace(model_config, approximator=lags)


def _strides(frames: TrainingFrames, model_config: LamSlideConfig) -> tuple[int, ...]:
    """Return the strides that windows are drawn with. Raises InputError for lags that the frames do not have."""
    lags = model_config.approximator.lag_range_ps
    strides: tuple[int, ...] = (1,)
    if lags is not None:
        if not np.isclose(lags[0], frames.lag_ps, rtol=1e-4):
            raise InputError(f"the model's lags begin at {lags[0]:g} ps, frames of {frames.scene.name} are saved every "
                             f"{frames.lag_ps:g} ps.")  # fmt: skip
        longest = whole_steps(lags[1], frames.lag_ps, "the longest lag in the frames' spacing")
        if longest < 2:
            raise InputError(
                "the longest lag must be at least twice the frames' spacing; leave it out for one lag alone."
            )
        strides = strides_up_to(longest)
    for validation in (False, True):  # too short a reference is refused before the first stage has been trained
        StrideSampler.of(frames, model_config.approximator.chunk_frames, strides, validation=validation)
    return strides


def _stage_one(subject: Subject, stage: StageConfig) -> Stage:
    own = subject.frames.window_starts(1, validation=False)

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        idx = own[torch.randint(len(own), (stage.batch,), generator=generator).numpy()]
        return autoencoder_loss(subject.model, subject.seen(idx, generator), subject.elements, generator)

    def validate() -> dict[str, float]:
        return {"validation_rmsd_nm": subject.reconstruction_error_nm()}

    return Stage(subject.model.autoencoder, stage, loss_fn, validate, saves=False)


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


def _stage_two(subject: Subject, config: TrainingConfig, stage: StageConfig) -> Stage:
    model, device, frames = subject.model, subject.device, subject.frames
    length = model.config.approximator.chunk_frames
    own, others = (StrideSampler.of(frames, length, subject.strides, validation=held) for held in (False, True))
    model.autoencoder.requires_grad_(False)
    subject.keep_latents()

    def loss_of(
        idx: Tensor, stride: Tensor, tau: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        latents = subject.windows(idx, generator)
        lag = model.embedded_lag((stride * frames.lag_ps).to(device), len(idx))
        return flow_loss(model, latents, len(subject.elements), tau, generator, lag)

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        first, stride = own.draw(stage.batch, generator)
        tau = draw_flow_times(model, stage.batch, generator).to(device)
        idx = window_frames(first, length, generator, time_reversal=config.time_reversal, stride=stride)
        return loss_of(idx, stride, tau, generator)

    held, held_stride = others.draw(_HELD_WINDOWS, torch.Generator().manual_seed(0))
    if len(subject.strides) == 1:
        every = others.starts[0]
        held = every[torch.linspace(0, len(every) - 1, min(_HELD_WINDOWS, len(every))).long()]
        held_stride = torch.ones_like(held)
    held = window_frames(held, length, torch.Generator(), time_reversal=False, stride=held_stride)
    with_bf16 = stage.bf16 and bf16_pays(device.type)

    @torch.no_grad()
    def validate() -> dict[str, float]:
        # The same noise and flow times each time, so that the curve shows the model and not the draw.
        generator = torch.Generator().manual_seed(0)
        tau = draw_flow_times(model, len(held), generator).to(device)
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=with_bf16):
            _, terms = loss_of(held, held_stride, tau, generator)
        return {f"validation_{key}": float(value) for key, value in terms.items()}

    return Stage(model.approximator, stage, loss_fn, validate)


def _check_start(start: Weights, frames: TrainingFrames, model_config: LamSlideConfig) -> None:
    """Refuse (InputError) to go on from weights of another molecule, frame spacing or configuration."""
    name, of = start.path.name, start.domain
    if start.model.config != model_config:
        raise InputError(f"{name} has another configuration; a training goes on with the one it began with.")
    if of.scene.topology_hash != frames.scene.topology_hash:
        raise InputError(f"{name} was trained on {of.scene.name}, not on {frames.scene.name} in this atom order.")
    if not np.isclose(of.lag_ps, frames.lag_ps, rtol=1e-4):
        raise InputError(f"{name} steps {of.lag_ps:g} ps from frame to frame; these trajectories {frames.lag_ps:g} ps.")


REVERSIBLE = arch.Choice("training.time_reversal", True, "MD at constant temperature reads alike backwards")
_RESOLVED = frozenset({"budget_s", "stage_one_steps", "stage_two_steps", "seed", "device"})


class LamSlideTrainer(arch.Trainer):
    """Trains LaM-SLidE. One molecule at one spacing of frames gets the defaults if they hold its atoms."""

    goes_on = True
    learns_lags = True

    def check(self, request: arch.TrainingRequest) -> None:
        super().check(request)
        if request.steps is not None and request.steps < 2:
            raise InputError("`steps` must be at least 2: one for each stage.")

    def choose(self, references: References, request: arch.TrainingRequest) -> tuple[arch.Choice, ...]:
        survey, found = references.survey, list[arch.Choice]()
        if request.start_from is not None:
            return ()
        pool = AutoencoderConfig.identifier_pool
        if "identifier_pool" not in request.model.get("autoencoder", {}) and (n := survey.scenes[0].n_atoms) > pool:
            why = f"{n} atoms, more than {pool} identifiers"
            found.append(arch.Choice("model.autoencoder.identifier_pool", n, why))
        lags = request.longest_lag_ps or request.training.get("longest_lag_ps")
        if lags and survey.equilibrium and "time_reversal" not in request.training:
            found.append(REVERSIBLE)
        return tuple(found)

    def settings(self, request: arch.TrainingRequest) -> arch.Settings:
        model = request.model if request.start_from is None else read_header(request.start_from).config
        steps, first = request.steps, None
        if steps is not None:
            first = 0 if request.start_from is not None else max(1, round(steps * STAGE_ONE_SHARE))
        asked: dict[str, Any] = {
            "budget_s": request.budget_s,
            "stage_one_steps": first,
            "stage_two_steps": None if steps is None or first is None else steps - first,
            "seed": request.seed,
            "device": request.device,
        }
        if request.longest_lag_ps is not None:
            asked["longest_lag_ps"] = request.longest_lag_ps
        return arch.Settings(LamSlideConfig.from_dict(model), request.settings(TrainingConfig, asked), _RESOLVED)

    def prepare(self, references: References, request: arch.TrainingRequest) -> arch.Prepared:
        settings = self.settings(request)
        model: LamSlideConfig = settings.model
        start = None if request.start_from is None else load_weights(request.start_from)
        frames = references.frames(canonical=model.canonical)
        for validation in (False, True):  # too short a reference is refused before anything is said
            frames.window_starts(model.approximator.chunk_frames, validation=validation)
        share_one = 0.0 if start is not None else STAGE_ONE_SHARE

        def run(advance: arch.AdvanceFn) -> Path:
            def report(stage: str, share: float, metrics: dict[str, float]) -> None:
                advance(stage, share * share_one if stage == "autoencoder" else share_one + share * (1 - share_one))

            return train_lam_slide(
                frames, request.out, model, settings.training, start=start, resume=request.resume, progress=report
            )

        return arch.Prepared(frames.scene.name, run)


LAM_SLIDE = arch.Architecture(
    "lam-slide", LamSlideConfig.from_dict, LamSlide, LamSlideTrainer,
    lambda survey: (0, "one molecule") if len(survey.scenes) == 1 and not survey.unseen else None,
)  # fmt: skip
