"""The methods of `surromd reproduce`: each is trained on a set and forecasts another. What goes beyond the published
protocol is a field of `Settings` and said in a method's note."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surrogate.bench.reproduce.forecast_errors import forecast_errors
from systems.errors import UnknownNameError, nearest

if TYPE_CHECKING:
    import torch

    from surrogate.data.particle_sets import ParticleSet
    from surrogate.models.lam_slide.model import LamSlide
    from surrogate.models.particles.trainer import Training
    from surrogate.training.loop import ProgressFn

Array = npt.NDArray[np.float64]
# Test set, number of samples -> positions (K, n, n_new, n_particles, 3) nm; K is 1 of what is deterministic.
Forecast = Callable[["ParticleSet", int], Array]

N_GIVEN, N_NEW, N_SAMPLES = 10, 20, 5
_BLOCK = 100


@dataclass(frozen=True)
class Settings:
    """`budget_s` of wall time or `steps` for each method that is trained. `solver_steps` of LaM-SLidE: a single one,
    from noise straight to the predicted data, is the mean of what may come, nearer to what does come than a sample.

    Beyond the papers: `extrapolate`: LaM-SLidE learns what the polynomial extrapolation of the given frames
    misses, each predicted frame in units of its own size, instead of absolute positions; `any_start`: EGNN learns from
    every frame of a trajectory, not from the tenth alone; `from_velocity`: EGNN adds the motion at constant velocity;
    `predicted_only`: LaM-SLidE's loss leaves out the given frames. Of molecules alone, `clean_conditioning`: in
    LaM-SLidE given frames see neither flow time nor what follows, so that evaluations compute them once; `canonical`:
    LaM-SLidE sees windows in the body frame instead of turned at random; there `extrapolate` is the best linear
    forecast, and `any_start` takes every training window, not the protocol's 5,000.
    """

    folder: Path
    budget_s: float | None = 600.0
    steps: int | None = None
    seed: int = 0
    resume: bool = False
    extrapolate: bool = True
    any_start: bool = True
    from_velocity: bool = True
    canonical: bool = True
    predicted_only: bool = True
    clean_conditioning: bool = False
    device: str = "cpu"
    solver_steps: int = 10
    progress: ProgressFn | None = None

    def training(self, name: str) -> Training:
        """Return the settings of one method's training. One thread: the tensors are small."""
        import torch

        from surrogate.models.particles.trainer import Training

        torch.set_num_threads(1)
        torch.manual_seed(self.seed)
        self.folder.mkdir(parents=True, exist_ok=True)
        made = Training(name, self.folder, self.budget_s, self.steps, self.seed, self.resume,
                        progress=self.progress, device=self.device)  # fmt: skip
        if not self.resume:
            for path in (made.log, *self.folder.glob(f"{name}.*.train.safetensors")):
                path.unlink(missing_ok=True)
        return made


SWITCHES = ("extrapolate", "any-start", "from-velocity", "canonical", "predicted-only")


def without_switches(settings: Settings, without: Sequence[str]) -> Settings:
    """Return the settings with these switches off. Raises UnknownNameError."""
    for one in without:
        if one not in SWITCHES:
            known = ", ".join(SWITCHES)
            raise UnknownNameError(f"unknown switch {one!r}; known: {known}.{nearest(one, list(SWITCHES))}")
    return replace(
        settings,
        extrapolate=settings.extrapolate and "extrapolate" not in without,
        any_start=settings.any_start and "any-start" not in without,
        from_velocity=settings.from_velocity and "from-velocity" not in without,
        canonical=settings.canonical and "canonical" not in without,
        predicted_only=settings.predicted_only and "predicted-only" not in without,
    )


@dataclass(frozen=True)
class Fitted:
    """A method ready to forecast; `seconds` of training, `note` what it is told and what goes beyond the papers."""

    forecast: Forecast
    note: str
    seconds: float = 0.0
    n_parameters: int = 0


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


def best_polynomial(data: ParticleSet) -> tuple[int, int, Array]:
    """Return the degree, the points and the weights with the least ADE on a set."""
    given, truth = data.positions_nm[:, :N_GIVEN], data.positions_nm[:, N_GIVEN:]
    tried = []
    for n_points in range(1, N_GIVEN + 1):
        for degree in range(n_points):
            weights = polynomial_weights(degree, n_points)
            ade = forecast_errors(extrapolate(given, weights)[None], truth)[0].mean()
            tried.append((float(ade), degree, n_points, weights))
    _, degree, n_points, weights = min(tried, key=lambda entry: entry[0])
    return degree, n_points, weights


def frozen(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted:
    """The last given frame."""
    return _polynomial(polynomial_weights(0, 1), "positions")


def constant_velocity(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted:
    """The step between the last two given frames, again and again."""
    return _polynomial(polynomial_weights(1, 2), "positions")


def polynomial(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted:
    """The polynomial through the last given frames whose degree and number of frames suit the validation set best."""
    degree, n_points, weights = best_polynomial(validation)
    return _polynomial(weights, f"positions; degree {degree} through the last {n_points} frames")


def _polynomial(weights: Array, note: str) -> Fitted:
    return Fitted(lambda data, n_samples: extrapolate(data.positions_nm[:, :N_GIVEN], weights)[None], note)


def egnn(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted:
    """EGNN from the last given frame and its velocity, as in the published row (told of charges and springs)."""
    import torch

    from surrogate.models.particles.model import EgnnJump, EgnnJumpConfig
    from surrogate.models.particles.trainer import Tensors, held_jumps, jumps_of, train_egnn

    training = settings.training("egnn")
    config = EgnnJumpConfig(n_new=N_NEW, lag_ps=train.lag_ps, from_velocity=settings.from_velocity)
    model = EgnnJump(config)
    draw = jumps_of(train, N_GIVEN, any_start=settings.any_start)
    seconds = train_egnn(model, draw, [held_jumps(validation, N_GIVEN)], training)
    model.cpu()
    last = N_GIVEN - 1

    @torch.no_grad()
    def forecast(data: ParticleSet, n_samples: int) -> Array:
        t = Tensors.of(data)
        return model.all_frames(t.x[:, last], t.v[:, last], t.types, t.pairs).double().numpy()[None]

    more = beyond({"any start": settings.any_start, "moved on at its velocity": settings.from_velocity})
    return Fitted(forecast, f"last frame and velocity, pair kinds{more}", seconds, n_parameters(model))


def pair_forces(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted:
    """A learned force between each pair, integrated; from given positions alone, told of charges and springs."""
    import torch

    from surrogate.models.particles.model import PairForces, PairForcesConfig
    from surrogate.models.particles.trainer import train_pair_forces

    training = settings.training("pair-forces")
    model = PairForces(PairForcesConfig(lag_ps=train.lag_ps))
    seconds = train_pair_forces(model, train, validation, training)
    model.double()

    @torch.no_grad()
    def forecast(data: ParticleSet, n_samples: int) -> Array:
        given, pairs = torch.from_numpy(data.positions_nm[:, :N_GIVEN]), torch.from_numpy(data.pairs)
        return model.forecast(given, pairs, N_NEW).numpy()[None]

    note = (
        f"last {model.config.velocity_frames} positions, pair kinds; beyond the papers: integrates learned pair forces"
    )
    return Fitted(forecast, note, seconds, n_parameters(model))


def lam_slide(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted:
    """LaM-SLidE: ten given frames, random identifiers and rotations, loss on predicted frames; told of charges."""
    import torch

    from surrogate.models.lam_slide.config import ApproximatorConfig, AutoencoderConfig, LamSlideConfig
    from surrogate.models.lam_slide.model import LamSlide
    from surrogate.models.particles.trainer import encode_windows, train_lam_slide_on_windows, turned_windows

    training = settings.training("lam-slide")
    degree, _, weights = best_polynomial(validation) if settings.extrapolate else (0, 0, None)
    view = WindowView.of(train, weights)
    model = LamSlide(
        LamSlideConfig(
            canonical=False,
            position_scale_nm=1.0,
            autoencoder=AutoencoderConfig(
                n_latents=2, latent_dim=32, width=64, identifier_pool=train.n_particles, n_octaves=3, type_weight=0.0
            ),
            approximator=ApproximatorConfig(
                chunk_frames=N_GIVEN + N_NEW,
                loss_on_given=not settings.predicted_only,
                n_conditioning=N_GIVEN,
                latents_per_token=2,
                width=128,
                n_layers=4,
                position_weight=0.0,
                distance_weight=0.0,
            ),
        )
    )
    held = validation.first(min(100, len(validation)))
    seen = [(torch.from_numpy(view.to_model(s.positions_nm)).float(), torch.from_numpy(s.types)) for s in (train, held)]
    seconds = train_lam_slide_on_windows(model, turned_windows(*seen[0]), [seen[1]], training)
    model.cpu().eval()

    @torch.no_grad()
    def forecast(data: ParticleSet, n_samples: int) -> Array:
        n, types = data.n_particles, torch.from_numpy(data.types)
        given = data.positions_nm[:, :N_GIVEN]
        known = encode_windows(model, torch.from_numpy(view.given(given)).float(), types)
        generator = torch.Generator().manual_seed(settings.seed)
        seen_ahead = sampled(model, known, n, n_samples, settings, generator)
        return np.stack([view.from_model(given, sample) for sample in seen_ahead])

    more = beyond({f"corrects a polynomial of degree {degree}": settings.extrapolate,
                   "loss on predicted frames alone": settings.predicted_only})  # fmt: skip
    return Fitted(
        forecast, f"positions, charges, {settings.solver_steps} solver steps{more}", seconds, n_parameters(model)
    )


def sampled(
    model: LamSlide, known: torch.Tensor, n: int, n_samples: int, settings: Settings, generator: torch.Generator
) -> Array:
    """Draw frames to come after the latents `known` (b, n_given, n_latents, latent_dim) of systems of `n` entities, as
    the model sees them: `(n_samples, b, n_new, n, 3)`. What is given is encoded once for all samples."""
    import torch

    from surrogate.models.lam_slide import flow

    def predict(o: torch.Tensor, tau: torch.Tensor) -> torch.Tensor:
        with torch.autocast(known.device.type, dtype=torch.bfloat16):  # as it was trained
            return model.approximator(o, tau, known)

    samples = []
    for _ in range(n_samples):
        noise = torch.randn((len(known), *model.noise_shape(n)), generator=generator).to(known.device)
        latents = flow.multistep(predict, noise, settings.solver_steps, "linear")
        samples.append(model.decode(latents[:, N_GIVEN:], n).double().cpu().numpy())
    return np.stack(samples)


@dataclass(frozen=True, eq=False)
class WindowView:
    """How LaM-SLidE sees windows `(n, n_frames, n_particles, 3)`: given frames about the mean of the last one's
    particles in units of `scale_nm`; those to predict likewise or, with `weights`, as the difference from the
    extrapolation, frame by frame in units of `scales_nm` (n_new,)."""

    scale_nm: float
    scales_nm: Array
    weights: Array | None

    @staticmethod
    def of(data: ParticleSet, weights: Array | None) -> WindowView:
        """Measure the scales on a set."""
        x = data.positions_nm
        about = x - _centre(x[:, :N_GIVEN])
        scale = float(np.sqrt((about[:, :N_GIVEN] ** 2).mean()))
        if weights is None:
            return WindowView(scale, np.full(N_NEW, float(np.sqrt((about**2).mean()))), None)
        left = x[:, N_GIVEN:] - extrapolate(x[:, :N_GIVEN], weights)
        return WindowView(scale, np.sqrt((left**2).mean(axis=(0, 2, 3))), weights)

    def given(self, given: Array) -> Array:
        return (given - _centre(given)) / self.scale_nm

    def to_model(self, windows: Array) -> Array:
        given, ahead = windows[:, :N_GIVEN], windows[:, N_GIVEN:]
        rest = (ahead - self._base(given)) / self.scales_nm[:, None, None]
        return np.concatenate([self.given(given), rest], axis=1)

    def from_model(self, given: Array, seen: Array) -> Array:
        """Given frames and predicted ones as the model sees them -> predicted positions, nm."""
        return self._base(given) + seen * self.scales_nm[:, None, None]

    def _base(self, given: Array) -> Array:
        return _centre(given) if self.weights is None else extrapolate(given, self.weights)


def _centre(given: Array) -> Array:
    return given[:, -1:].mean(axis=2, keepdims=True)


def n_parameters(model: torch.nn.Module) -> int:
    """Return how many numbers of a model are learned."""
    return sum(p.numel() for p in model.parameters())


def beyond(switches: dict[str, bool]) -> str:
    """Return the end of a method's note: the switches that are on and in no paper."""
    on = [name for name, value in switches.items() if value]
    return f"; beyond the paper: {', '.join(on)}" if on else ""


METHODS: dict[str, Callable[[ParticleSet, ParticleSet, Settings], Fitted]] = {
    "frozen": frozen,
    "constant-velocity": constant_velocity,
    "polynomial": polynomial,
    "egnn": egnn,
    "lam-slide": lam_slide,
    "pair-forces": pair_forces,
}
