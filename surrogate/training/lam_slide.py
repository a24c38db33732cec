"""Train LaM-SLidE: stage one (autoencoder), then stage two (latent flow) on the frozen encoder's latents."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data.frames import TrainingFrames
from surrogate.data.rarity import rare_kinds, window_kinds, window_sampler
from surrogate.data.weights import Weights, save_weights
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.model import LamSlide
from surrogate.training.devices import is_first_process, wait_for_all
from surrogate.training.loop import ProgressFn, StageConfig, run_stage
from surrogate.training.objectives import autoencoder_loss, draw_flow_times, flow_loss, random_rotations
from surrogate.training.provenance import provenance_of, training_domain
from systems.elements import ATOMIC_NUMBERS
from systems.errors import InputError

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

    def stages(self) -> tuple[StageConfig, StageConfig]:
        share = STAGE_ONE_SHARE
        budget_one = None if self.budget_s is None else self.budget_s * share
        budget_two = None if self.budget_s is None else self.budget_s * (1 - share)
        common: dict[str, Any] = {"bf16": self.bf16, "validate_every_s": self.validate_every_s}
        one = StageConfig("autoencoder", self.stage_one_batch, self.stage_one_rate, budget_one, self.stage_one_steps,
                          seed=self.seed, **common)  # fmt: skip
        two = StageConfig("flow", self.stage_two_batch, self.stage_two_rate, budget_two, self.stage_two_steps,
                          seed=self.seed + 1, **common)  # fmt: skip
        return one, two


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
    n_atoms = frames.scene.n_atoms
    if frames.canonical != model_config.canonical:
        raise InputError("frames and model disagree on canonical frames; make the windows with the same setting.")
    if n_atoms > model_config.autoencoder.identifier_pool:
        raise InputError(
            f"{n_atoms} atoms need autoencoder.identifier_pool >= {n_atoms}, not "
            f"{model_config.autoencoder.identifier_pool}."
        )
    length = model_config.approximator.chunk_frames
    if config.rare_kinds and not model_config.approximator.rare_kinds:
        told = replace(model_config.approximator, rare_kinds=rare_kinds(frames, length))
        model_config = replace(model_config, approximator=told)
    told_of = model_config.approximator.rare_kinds
    kinds = window_kinds(frames, told_of, length) if told_of else None
    torch.manual_seed(config.seed)
    device = torch.device(config.device)
    model = LamSlide(model_config).to(device)
    elements = torch.tensor([ATOMIC_NUMBERS[e] for e in frames.scene.elements], device=device)
    log_path = out.with_suffix(".csv")
    states = [out.with_name(f"{out.stem}.{stage}.train.safetensors") for stage in ("autoencoder", "flow")]
    if not resume and is_first_process():
        for path in (*states, log_path):
            path.unlink(missing_ok=True)
    if start is None:
        one, two = config.stages()
        spent_one = _stage_one(model, frames, elements, one, states[0], log_path, resume, progress)
        normalise_latents(model, frames, elements, config.seed)
    else:
        _check_start(start, frames, model_config)
        two = replace(config.stages()[1], budget_s=config.budget_s)
        spent_one = 0.0
        _take_over(model, start)
    if kinds is not None and (start is None or not start.model.config.approximator.rare_kinds):
        own = frames.window_starts(length, validation=False)
        model.approximator.set_odds(np.bincount(kinds[own], minlength=len(told_of) + 1) / len(own))

    domain = training_domain(frames)

    def write(spent_s: float) -> None:
        save_weights(out, model, domain, _provenance(frames, config, spent_one, spent_s, start))

    spent_two = _stage_two(model, frames, elements, two, states[1], log_path, resume, progress, write, config, kinds)
    if is_first_process():
        write(spent_two)
        for path in states:
            path.unlink(missing_ok=True)
    wait_for_all()
    return out


def _stage_one(model: LamSlide, frames: TrainingFrames, elements: Tensor, stage: StageConfig, state: Path, log: Path,
               resume: bool, progress: ProgressFn | None) -> float:  # fmt: skip
    starts = frames.window_starts(1, validation=False)
    held = frames.window_starts(1, validation=True)
    held = held[np.linspace(0, len(held) - 1, min(2048, len(held))).astype(int)]
    device = elements.device

    def draw(generator: torch.Generator) -> Tensor:
        idx = torch.randint(len(starts), (stage.batch,), generator=generator).numpy()
        x = torch.from_numpy(frames.positions_nm(starts[idx]))
        if not model.canonical:
            x = torch.einsum("bij,bnj->bni", random_rotations(len(x), generator), x)
        return x.to(device)

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        return autoencoder_loss(model, draw(generator), elements, generator)

    @torch.no_grad()
    def validate() -> dict[str, float]:
        x = torch.from_numpy(frames.positions_nm(held)).to(device)
        error = model.decode(model.encode(x, elements), frames.scene.n_atoms) - x
        return {"validation_rmsd_nm": float(error.square().sum(-1).mean().sqrt())}

    return run_stage(model.autoencoder, stage, loss_fn, validate, state_path=state, log_path=log, resume=resume,
                     device=device, progress=progress)  # fmt: skip


@torch.no_grad()
def normalise_latents(model: LamSlide, frames: TrainingFrames, elements: Tensor, seed: int) -> None:
    """Measure the latents' means and common scale on training frames and set them in the model."""
    starts = frames.window_starts(1, validation=False)
    idx = np.random.default_rng(seed).choice(len(starts), size=min(20_000, len(starts)), replace=False)
    x = torch.from_numpy(frames.positions_nm(starts[np.sort(idx)])).to(elements.device)
    model.latent_mean.zero_()
    model.latent_scale.fill_(1.0)
    z = model.encode(x, elements)
    model.latent_mean.copy_(z.mean(0))
    model.latent_scale.copy_((z - z.mean(0)).square().mean().sqrt())


@torch.no_grad()
def encode_all(model: LamSlide, frames: TrainingFrames, elements: Tensor, block: int = 8192) -> Tensor:
    """Encode every frame once: `(n_frames, n_latents, latent_dim)` float32 on the CPU."""
    parts = []
    for start in range(0, frames.n_frames, block):
        idx = np.arange(start, min(start + block, frames.n_frames))
        x = torch.from_numpy(frames.positions_nm(idx)).to(elements.device)
        parts.append(model.encode(x, elements).cpu())
    return torch.cat(parts)


def window_frames(first: Tensor, length: int, generator: torch.Generator, *, time_reversal: bool) -> Tensor:
    """Return the frames `(b, length)` of windows from their first frames `(b,)`; reversed ones with probability 1/2."""
    idx = first[:, None] + torch.arange(length)
    if not time_reversal:
        return idx
    backwards = torch.rand(len(idx), 1, generator=generator) < 0.5
    return torch.where(backwards, idx.flip(1), idx)


def _stage_two(model: LamSlide, frames: TrainingFrames, elements: Tensor, stage: StageConfig, state: Path, log: Path,
               resume: bool, progress: ProgressFn | None, write: Any, config: TrainingConfig,
               kinds: npt.NDArray[np.int64] | None) -> float:  # fmt: skip
    length = model.config.approximator.chunk_frames
    n_atoms, device = frames.scene.n_atoms, elements.device
    sampler = window_sampler(frames, length, config.rare_draws, kinds)
    held = torch.from_numpy(frames.window_starts(length, validation=True))
    held = held[torch.linspace(0, len(held) - 1, min(256, len(held))).long()]
    held_kinds = None if kinds is None else torch.from_numpy(kinds)[held].to(device)
    model.autoencoder.requires_grad_(False)
    if config.compile:
        model.approximator.compile()
        model.autoencoder.decode = torch.compile(model.autoencoder.decode)  # type: ignore[method-assign]
    ae = model.config.autoencoder
    fits = 4 * frames.n_frames * ae.n_latents * ae.latent_dim <= LATENT_CACHE_BYTES
    cache = encode_all(model, frames, elements).to(device) if model.canonical and fits else None

    def windows(first: Tensor, generator: torch.Generator, *, time_reversal: bool = False) -> Tensor:
        idx = window_frames(first, length, generator, time_reversal=time_reversal)
        if cache is not None:
            return cache[idx.to(device)]
        x = torch.from_numpy(frames.positions_nm(idx.numpy()))
        if not model.canonical:
            x = torch.einsum("bij,btnj->btni", random_rotations(len(x), generator), x)
        with torch.no_grad():
            return model.encode(x.to(device), elements)

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        first, importance, kind = sampler.draw(stage.batch, generator)
        tau = draw_flow_times(model, stage.batch, generator).to(device)
        batch = windows(first, generator, time_reversal=config.time_reversal)
        kind = None if kind is None else kind.to(device)
        return flow_loss(model, batch, n_atoms, tau, generator, importance=importance.to(device), kind=kind)

    @torch.no_grad()
    def validate() -> dict[str, float]:
        # The same noise and flow times each time, so that the curve shows the model and not the draw.
        generator = torch.Generator().manual_seed(0)
        tau = draw_flow_times(model, len(held), generator).to(device)
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=stage.bf16):
            _, terms = flow_loss(model, windows(held, generator), n_atoms, tau, generator, kind=held_kinds)
        return {f"validation_{k}": float(v) for k, v in terms.items()}

    next_snapshot = [config.snapshot_every_s or float("inf")]

    def on_save(spent_s: float) -> None:
        write(spent_s)
        if spent_s >= next_snapshot[0]:
            out = state.with_name(state.name.replace(".flow.train.safetensors", ".safetensors"))
            shutil.copy(out, out.with_name(f"{out.stem}.at{round(spent_s / 60)}min.safetensors"))
            next_snapshot[0] = spent_s + (config.snapshot_every_s or float("inf"))

    return run_stage(model.approximator, stage, loss_fn, validate, state_path=state, log_path=log, resume=resume,
                     device=device, progress=progress, on_save=on_save)  # fmt: skip


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


def _provenance(frames: TrainingFrames, config: TrainingConfig, spent_one: float, spent_two: float,
                start: Weights | None) -> dict[str, Any]:  # fmt: skip
    settings = {
        "seed": config.seed,
        "time_reversal": config.time_reversal,
        "rare_draws": config.rare_draws,
        "rare_kinds": config.rare_kinds,
        "stage_one_s": round(spent_one, 1),
        "stage_two_s": round(spent_two, 1),
    }
    return provenance_of(frames, settings, start)
