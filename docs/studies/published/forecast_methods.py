"""Parts that the methods of all forecasting tasks share: settings, extrapolation, the latent model, costs.

Whatever goes beyond the published protocol is a field of `Settings` and said in a method's note."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
from forecast_errors import forecast_errors

from systems.errors import UnknownNameError, nearest

if TYPE_CHECKING:
    import torch
    from forecaster_training import Training

    from surrogate.models.lam_slide.model import AutoencoderConfig, LamSlide
    from surrogate.training.loop import ProgressFn

Array = npt.NDArray[np.float64]
# What is forecast: a set of particle systems, or one molecule.
Subject = TypeVar("Subject")

N_GIVEN, N_NEW, N_SAMPLES = 10, 20, 5


@dataclass(frozen=True)
class Settings:
    """`budget_s` of wall time or `steps` for each method that is trained; `call_s`: end after so much wall time, saved.
    `paper_size`: LaM-SLidE of the paper's sizes; `paper_form`: of its form, smaller. `solver_steps` of LaM-SLidE: one,
    from noise straight to the predicted data, is the mean of what may come, nearer to what does come than a sample.

    Beyond the papers: `extrapolate`: LaM-SLidE learns what the polynomial extrapolation of the given frames
    misses, each predicted frame in units of its own size, instead of absolute positions; `any_start`: EGNN learns from
    every frame of a trajectory, not from the tenth alone; `from_velocity`: EGNN adds the motion at constant velocity;
    `predicted_only`: LaM-SLidE's loss leaves out the given frames. Of particles as latents alone, `mirrored`: windows
    are reflected and run backwards, too; `pair_messages`: layers pass messages along pairs. Of molecules alone,
    `clean_conditioning`: in LaM-SLidE given frames see neither flow time nor what follows, so that evaluations compute
    them once; `canonical`: LaM-SLidE sees windows in the body frame instead of turned at random; there `extrapolate` is
    the best linear forecast, and `any_start` takes every training window, not the protocol's 5,000.
    """

    folder: Path
    budget_s: float | None = 600.0
    steps: int | None = None
    call_s: float | None = None
    paper_size: bool = False
    paper_form: bool = False
    seed: int = 0
    resume: bool = False
    extrapolate: bool = True
    any_start: bool = True
    from_velocity: bool = True
    canonical: bool = True
    predicted_only: bool = True
    mirrored: bool = True
    pair_messages: bool = True
    clean_conditioning: bool = False
    device: str = "cpu"
    solver_steps: int = 10
    progress: ProgressFn | None = None

    @cached_property
    def _ends_at(self) -> float | None:
        return None if self.call_s is None else time.monotonic() + self.call_s

    def training(self, name: str) -> Training:
        """Return the settings of one method's training. One thread: the tensors are small."""
        import torch
        from forecaster_training import Training

        torch.set_num_threads(1)
        torch.manual_seed(self.seed)
        self.folder.mkdir(parents=True, exist_ok=True)
        # A call that ends early saves often enough to end in time.
        every_s = 60.0 if self.call_s is None else min(60.0, self.call_s / 8)
        made = Training(name, self.folder, self.budget_s, self.steps, self.seed, self.resume, every_s,
                        progress=self.progress, device=self.device, ends_at=self._ends_at)  # fmt: skip
        if not self.resume:
            for path in (made.log, *self.folder.glob(f"{name}.*.train.safetensors")):
                path.unlink(missing_ok=True)
        return made


SWITCHES = ("extrapolate", "any-start", "from-velocity", "canonical", "predicted-only", "mirrored", "pair-messages")


def without_switches(settings: Settings, without: Sequence[str]) -> Settings:
    """Return the settings with these switches off. Raises UnknownNameError."""
    check_known(switch=(without, SWITCHES))
    off: dict[str, Any] = {name.replace("-", "_"): False for name in without}
    return replace(settings, **off)


@dataclass(frozen=True)
class Fitted(Generic[Subject]):
    """A method ready to forecast; `seconds` of training, `note` what it is told and what goes beyond the papers.

    `forecast`: the subject, its given frames `(n, n_given, n_atoms, 3)` nm and a number of samples K -> positions
    `(K, n, n_new, n_atoms, 3)` nm; K is 1 of what is deterministic.
    """

    forecast: Callable[[Subject, Array, int], Array]
    note: str
    seconds: float = 0.0
    n_parameters: int = 0


@dataclass(frozen=True)
class MethodSummary:
    """What a method cost, and what is to be said of it."""

    method: str
    note: str
    n_parameters: int
    training_s: float
    cpu_s: float
    forecast_s: float


def measured(
    method: str, fit: Callable[[], Fitted[Subject]], tests: Sequence[tuple[Subject, Array]]
) -> tuple[MethodSummary, list[tuple[Array, Array]]]:
    """Fit a method; return what it cost, and ADE and FDE (n,) of each of `tests`: a subject and its windows
    `(n, n_given + n_new, n_atoms, 3)` nm."""
    cpu = time.process_time()
    fitted = fit()
    cpu, began = time.process_time() - cpu, time.perf_counter()
    errors = [
        forecast_errors(fitted.forecast(subject, windows[:, :N_GIVEN], N_SAMPLES), windows[:, N_GIVEN:])
        for subject, windows in tests
    ]
    took = time.perf_counter() - began
    summary = MethodSummary(method, fitted.note, fitted.n_parameters, round(fitted.seconds, 1), round(cpu, 1),
                            round(took, 2))  # fmt: skip
    return summary, errors


def check_known(**asked: tuple[Sequence[str], Mapping[str, object] | Sequence[str]]) -> None:
    """Raise UnknownNameError for a name that is not among the known ones, naming the nearest; `kind=(asked, known)`."""
    for kind, (names, known) in asked.items():
        for name in names:
            if name not in known:
                raise UnknownNameError(
                    f"unknown {kind} {name!r}; known: {', '.join(known)}.{nearest(name, list(known))}"
                )


def frozen() -> Fitted[Subject]:
    """Return the forecast of those who stay: the last given frame."""
    return extrapolated(polynomial_weights(0, 1))


def constant_velocity() -> Fitted[Subject]:
    """Return the step between the last two given frames, again and again."""
    return extrapolated(polynomial_weights(1, 2))


def extrapolated(weights: Array, note: str = "positions") -> Fitted[Subject]:
    """Return the forecast of a polynomial, by its weights."""
    return Fitted(lambda subject, given, n_samples: extrapolate(given, weights)[None], note)


def polynomial_weights(degree: int, n_points: int, n_given: int = N_GIVEN, n_new: int = N_NEW) -> Array:
    """Return weights `(n_new, n_given)` of the given frames that extrapolate the polynomial of this degree through the
    last `n_points` of them (least squares where there are more points than coefficients)."""
    if not degree < n_points <= n_given:
        raise ValueError(f"degree {degree} needs more than {degree} and at most {n_given} points, not {n_points}")
    past = np.arange(-n_points + 1, 1) / n_points
    future = np.arange(1, n_new + 1) / n_points
    weights = np.zeros((n_new, n_given))
    weights[:, n_given - n_points :] = np.vander(future, degree + 1) @ np.linalg.pinv(np.vander(past, degree + 1))
    return weights


def extrapolate(given: Array, weights: Array) -> Array:
    """Given frames `(n, n_given, n_particles, 3)` -> `(n, n_new, n_particles, 3)`, in float64: differences of frames
    carry velocities."""
    # About the last frame, which the weights (they sum to one) move nowhere.
    last = given[:, -1:]
    return last + np.einsum("ts,nsad->ntad", weights, given - last)


def motion_sizes(given: Array) -> tuple[float, float, float]:
    """Return the sizes of what `motion_features` tells of these frames, nm."""
    last, step, bend = (float(np.sqrt((part**2).mean())) for part in _motion(given))
    return last, step, max(bend, 1e-3 * step)


def motion_features(given: Array, sizes_nm: tuple[float, float, float]) -> Array:
    """Given frames `(n, n_given, n_particles, 3)` nm -> what each particle does, `(n, n_particles, n_features)`
    (`n_body_views.ParticleView`)."""
    parts = [part[:, ::-1] / size for part, size in zip(_motion(given), sizes_nm, strict=True)]
    return np.concatenate(parts, axis=1).swapaxes(1, 2).reshape(len(given), given.shape[2], -1)


def _motion(given: Array) -> tuple[Array, Array, Array]:
    """Return the last frame, the steps, and their changes, about each frame's centre: `(n, 1 or less, n_particles, 3)`
    each."""
    inside = given - given.mean(axis=2, keepdims=True)
    return inside[:, -1:], np.diff(inside, axis=1), np.diff(inside, 2, axis=1)


def latent_forecaster(
    settings: Settings, autoencoder: AutoencoderConfig, *, latents_per_token: int, width: int, n_layers: int,
    plain_flow: bool = False,
) -> LamSlide:  # fmt: skip
    """Return LaM-SLidE for windows of this protocol: positions as the task's view makes them, no auxiliary losses.

    `plain_flow`: as in the paper, uniform flow times of weight one and no preconditioning.
    """
    from surrogate.models.lam_slide.model import ApproximatorConfig, LamSlide, LamSlideConfig

    return LamSlide(
        LamSlideConfig(
            canonical=False,
            position_scale_nm=1.0,
            autoencoder=autoencoder,
            approximator=ApproximatorConfig(
                chunk_frames=N_GIVEN + N_NEW,
                loss_on_given=not settings.predicted_only,
                clean_conditioning=settings.clean_conditioning,
                n_conditioning=N_GIVEN,
                latents_per_token=latents_per_token,
                width=width,
                n_layers=n_layers,
                precondition=not plain_flow,
                uniform_tau=plain_flow,
                position_weight=0.0,
                distance_weight=0.0,
            ),
        )
    )


def sampled(
    model: LamSlide, known: torch.Tensor, n: int, n_samples: int, settings: Settings, generator: torch.Generator
) -> Array:
    """Draw frames to come after the latents `known` (b, n_given, n_latents, latent_dim) of systems of `n` entities, as
    the model sees them: `(n_samples, b, n_new, n, 3)`. What is given is encoded once for all samples. Without
    preconditioning by Euler steps, as in the paper."""
    import torch

    from surrogate.models.lam_slide import flow

    def predict(o: torch.Tensor, tau: torch.Tensor) -> torch.Tensor:
        with torch.autocast(known.device.type, dtype=torch.bfloat16):  # as it was trained
            return model.approximator(o, tau, known)

    solve = flow.multistep if model.config.approximator.precondition else flow.euler
    samples = []
    for _ in range(n_samples):
        noise = torch.randn((len(known), *model.noise_shape(n)), generator=generator).to(known.device)
        latents = solve(predict, noise, settings.solver_steps)
        samples.append(model.decode(latents[:, known.shape[1] :], n).double().cpu().numpy())
    return np.stack(samples)


def n_parameters(model: torch.nn.Module) -> int:
    """Return how many numbers of a model are learned."""
    return sum(p.numel() for p in model.parameters())


def beyond(switches: dict[str, bool]) -> str:
    """Return the end of a method's note: the switches that are on and in no paper."""
    on = [name for name, value in switches.items() if value]
    return f"; beyond the paper: {', '.join(on)}" if on else ""
