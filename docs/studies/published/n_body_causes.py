"""Where LaM-SLidE's error on charged particles comes from: `python docs/studies/published/n_body_causes.py FOLDER`.

One change a line, at equal steps of equal batches: the code of a frame, what it is told, flow times, targets, and
particles as their own latents. FOLDER holds the data of `reproduce.py n-body-charged` (made if missing); curves go to
FOLDER/causes/*.csv, what was found to FOLDER/causes.json. What is there is not done again; what `--table`
has of other runs stays.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from forecast_errors import forecast_errors
from forecast_methods import N_GIVEN, N_NEW, Array, Settings, sampled
from forecaster_training import DrawWindows, encode_windows, normalise_latents, turned_windows
from n_body import SIZES
from n_body_cause_views import InnovationsView, PositionsView, VelocitiesView, next_velocities
from n_body_data import make_sets
from n_body_methods import best_polynomial, set_forecaster
from n_body_views import ParticleView, WindowView
from particle_flow import ParticleFlow, ParticleFlowConfig
from particle_flow_training import sample_ahead
from particle_sets import ParticleSet, read_set
from torch import Tensor, nn

from md_reference.run.machine import machine_name
from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.model import Decoded, LamSlide, LamSlideConfig
from surrogate.models.lam_slide.trainer import (
    autoencoder_loss,
    draw_flow_times,
    flow_loss,
    random_rotations,
)
from surrogate.training.loop import Stage, StageConfig, StagePlace, run_stage
from systems.files.whole_file import create_whole

NAME = "n-body-charged"
BATCH, FEW, CODE_STEPS = 64, 16, 1500
# Frames of a step of the code, by windows of a step of the flow.
_CODE_SHARE = 4
_HELD = 200
# Given frames, types and pairs of a set -> forecasts (K, n, n_new, n_particles, 3) nm; K samples, solver steps.
Forecast = Callable[[ParticleSet, int, int], Array]
# Windows, a generator -> loss and its terms.
Loss = Callable[[torch.Generator], tuple[Tensor, dict[str, Tensor]]]


@dataclass(frozen=True)
class Change:
    """One line: `code` and `flow` replace settings of the set of latents, `particles` those of particles as latents.
    `exact`: coordinates themselves for a code. `motion`: of given frames steps and their changes, else positions alone.
    `targets`: positions ("absolute"), what a "polynomial" through the given frames leaves of them, or "innovations",
    what one through the frames before leaves of each. `velocities`: told those of the next frame, which nobody knows.
    `noised`: noise on what is given in training, in units of its size. `mean_only`: a plain regression, flow time 0 and
    no noise. `n_train`: so few trajectories, not turned, to be learned by heart. `batch`, `steps`: fewer where a step
    is expensive."""

    name: str
    code: dict[str, Any] = field(default_factory=dict)
    flow: dict[str, Any] = field(default_factory=dict)
    particles: dict[str, Any] | None = None
    exact: bool = False
    motion: bool = True
    targets: str = "polynomial"
    told_charges: bool = True
    velocities: bool = False
    noised: float = 0.0
    mean_only: bool = False
    n_train: int | None = None
    batch: int = BATCH
    steps: int | None = None


_EXACT: dict[str, Any] = {"n_latents": 5, "latent_dim": 3}
_ALONE: dict[str, Any] = {"pair_messages": False}
CHANGES = (
    Change("set: as it was", {"type_weight": 0.0}, {"precondition": True, "uniform_tau": False}),
    Change("set: flow times of the paper, charges in the code"),
    Change("set: regression instead of a flow", mean_only=True),
    Change("set: 16 trajectories by heart", n_train=16),
    Change("exact code: a token for all particles of a frame", _EXACT, {"latents_per_token": 5}, exact=True),
    Change("particles: a token for 5 frames", particles={"frames_per_token": 5, "pair_messages": False}),
    Change("particles: a token each, positions given", particles=_ALONE, motion=False),
    Change("particles: a token each", particles=_ALONE),
    Change("particles: not told of charges", particles=_ALONE, told_charges=False),
    Change("particles: given frames noised by 5 %", particles=_ALONE, noised=0.05),
    Change("particles: absolute positions", particles=_ALONE, targets="absolute"),
    Change("particles: innovations", particles=_ALONE, targets="innovations"),
    Change("particles: and the next frame's true velocities", particles=_ALONE, velocities=True),
    Change("particles: and messages along pairs", particles={}),
    Change("particles: regression instead of a flow", particles={}, mean_only=True),
    Change("particles: 16 trajectories by heart", particles={}, n_train=16),
    Change("16 windows, particles: a token each", particles=_ALONE, batch=FEW),
    Change("16 windows, particles: a token each, positions given", particles=_ALONE, motion=False,
           batch=FEW, steps=500),
    Change("16 windows, particles: a token each frame, positions given", particles=_ALONE | {"frames_per_token": 1},
           motion=False, batch=FEW, steps=500),
    Change("16 windows, set: 2 latents in a token", batch=FEW),
    Change("16 windows, set: and auxiliary losses", flow={"position_weight": 0.25, "distance_weight": 0.25}, batch=FEW),
    Change("16 windows, set: and clean conditioning", flow={"clean_conditioning": True}, batch=FEW),
    Change("16 windows, set: and the next frame's true velocities", velocities=True, batch=FEW),
    Change("16 windows, set: 5 latents, a token each", {"n_latents": 5, "latent_dim": 16}, {"latents_per_token": 1},
           batch=FEW, steps=500),
    Change("16 windows, exact code: a token for each particle of a frame", _EXACT, {"latents_per_token": 1},
           exact=True, batch=FEW, steps=500),
    Change("16 windows, set: 16 latents, a token each", {"n_latents": 16}, {"latents_per_token": 1},
           batch=FEW, steps=500),
)  # fmt: skip


@dataclass(frozen=True)
class Found:
    """Errors on held-out trajectories (on those learned by heart where `n_train` says so), nm: of the mean forecast and
    of samples; of a code, how far decoded predicted frames and steps between given ones lie from the true."""

    name: str
    steps: int
    seconds: float
    mean_ade: float
    sample_ade: float
    sample_fde: float
    code_ade: float | None = None
    code_step: float | None = None


def run(change: Change, train: ParticleSet, held: ParticleSet, folder: Path, steps: int) -> Found:
    """Train one line and measure it; its curve is written beside."""
    torch.manual_seed(0)
    weights = None if change.targets == "absolute" else best_polynomial(held)[2]
    if change.n_train is not None:
        held = train = train.first(change.n_train)
    steps = min(steps, change.steps or steps)
    state = folder / f"{_slug(change.name)}.train.safetensors"
    place = StagePlace(state, folder / f"{_slug(change.name)}.csv", torch.device("cpu"), resume=True)
    if not state.exists():
        place.log.unlink(missing_ok=True)
    code: dict[str, float] = {}
    if change.particles is None:
        network, loss, forecast, code = _of_a_set(change, train, held, weights, folder)
    else:
        network, loss, forecast = _of_particles(change, train, weights)

    errors: dict[str, float] = {}

    def validate() -> dict[str, float]:
        mean = _errors(forecast, held, 1, 1)
        sample = mean if change.mean_only else _errors(forecast, held, 2, 10)
        errors.update(mean_ade=mean[0], sample_ade=sample[0], sample_fde=sample[1])
        return errors

    every_s = 100.0 if change.steps is None else 600.0  # where a step is expensive, so are forecasts
    stage = StageConfig(
        "flow", change.batch, 2e-3, None, steps, warmup_steps=50, ema_decay=0.99, validate_every_s=every_s
    )
    seconds = run_stage(Stage(network, stage, loss, validate), place)
    state.unlink()
    return Found(change.name, steps, round(seconds, 1), **(errors or validate()), **code)


def _of_a_set(
    change: Change, train: ParticleSet, held: ParticleSet, weights: Array | None, folder: Path
) -> tuple[torch.nn.Module, Loss, Forecast, dict[str, float]]:
    settings, n_known = Settings(folder), N_GIVEN + change.velocities
    config = set_forecaster(settings, train.n_particles).config
    frames = {"n_conditioning": n_known, "chunk_frames": n_known + N_NEW}
    config = replace(
        config,
        autoencoder=replace(config.autoencoder, **change.code),
        approximator=replace(config.approximator, **frames, **change.flow),
    )
    view, model = WindowView.of(train, weights), LamSlide(config)
    if change.exact:
        model.autoencoder = ExactCode()

    def seen(data: ParticleSet) -> tuple[Tensor, Tensor]:
        x = view.to_model(data.positions_nm)
        if change.velocities:
            x = np.insert(x, N_GIVEN, next_velocities(data), axis=1)
        return torch.from_numpy(x).float(), torch.from_numpy(data.types)

    draw = turned_windows(*seen(train)) if change.n_train is None else _as_they_are(*seen(train))
    if not change.exact:
        _code(model, draw, _CODE_SHARE * change.batch, folder / f"code-{_key(config, change)}.train.safetensors")
    normalise_latents(model, draw)
    model.autoencoder.requires_grad_(False)

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        x, kinds = draw(change.batch, generator)
        with torch.no_grad(), torch.autocast("cpu", enabled=False):
            latents = encode_windows(model, x, kinds)
        tau = torch.zeros(change.batch) if change.mean_only else draw_flow_times(model, change.batch, generator)
        return flow_loss(model, latents, x.shape[2], tau, generator)

    @torch.no_grad()
    def forecast(data: ParticleSet, n_samples: int, solver_steps: int) -> Array:
        x, types = seen(data)
        known, generator = encode_windows(model, x[:, :n_known], types), torch.Generator().manual_seed(0)
        asked = replace(settings, solver_steps=solver_steps)
        drawn = sampled(model, known, data.n_particles, n_samples, asked, generator)
        return np.stack([view.from_model(data.positions_nm[:, :N_GIVEN], ahead) for ahead in drawn])

    with torch.no_grad():
        back = model.decode(encode_windows(model, *seen(held)), held.n_particles).double().numpy()
    return model.approximator, loss, forecast, _code_errors(view, back, held)


def _of_particles(change: Change, train: ParticleSet, weights: Array | None) -> tuple[torch.nn.Module, Loss, Forecast]:
    def told(data: ParticleSet) -> ParticleSet:
        return data if change.told_charges else replace(data, types=0 * data.types, pairs=0 * data.pairs)

    train = told(train)
    view = ParticleView.of(train, weights)
    if change.targets == "innovations":
        view = replace(view, window=InnovationsView.of(train, weights))
    if change.velocities or not change.motion:
        view = (VelocitiesView if change.velocities else PositionsView)(view.window, view.sizes_nm)
    n_features = view.known(train.positions_nm[:1, :N_GIVEN], train.first(1)).features.shape[-1]
    model = ParticleFlow(ParticleFlowConfig(n_features, **(change.particles or {})))

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        chosen = train.rows(torch.randint(len(train), (change.batch,), generator=generator).numpy())
        chosen = _turned(chosen, generator) if change.n_train is None else chosen
        windows = view.to_model(chosen.positions_nm, chosen)
        tau = torch.rand(change.batch, generator=generator) * (0.0 if change.mean_only else 1.0)
        noise = torch.randn(windows.ahead.shape, generator=generator)
        at, given = flow.expand(tau, noise), windows.given
        if change.noised:
            more = torch.randn(given.features.shape, generator=generator)
            given = replace(given, features=given.features + change.noised * more)
        found = (model(at * windows.ahead + (1 - at) * noise, tau, given) - windows.ahead).square().mean()
        return found, {"flow": found.detach()}

    def forecast(data: ParticleSet, n_samples: int, solver_steps: int) -> Array:
        given, generator = data.positions_nm[:, :N_GIVEN], torch.Generator().manual_seed(0)
        known = view.known(given, told(data))
        drawn = [sample_ahead(model, known, solver_steps, generator) for _ in range(n_samples)]
        return np.stack([view.from_model(given, x.double().numpy()) for x in drawn])

    return model, loss, forecast


class ExactCode(nn.Module):
    """Particles' coordinates as they are, each a latent: what stage two could do if stage one lost nothing."""

    def encode(self, x: Tensor, elements: Tensor, identifiers: Tensor) -> Tensor:
        return x

    def decode(self, latents: Tensor, identifiers: Tensor) -> Decoded:
        return Decoded(latents, None)


def _code(model: LamSlide, draw: DrawWindows, batch: int, state: Path) -> None:
    """Train the code of a frame, or take it where a line before has trained the same."""

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        x, kinds = draw(batch, generator)
        at = torch.randint(x.shape[1], (batch,), generator=generator)
        return autoencoder_loss(model, x[torch.arange(batch), at], kinds, generator)

    stage = StageConfig("code", batch, 2e-3, None, CODE_STEPS, warmup_steps=50, ema_decay=0.99, bf16=False)
    place = StagePlace(state, state.with_suffix("").with_suffix(".csv"), torch.device("cpu"), resume=True)
    run_stage(Stage(model.autoencoder, stage, loss, dict), place)


def _code_errors(view: WindowView, back: Array, held: ParticleSet) -> dict[str, float]:
    """Of frames as they come `back` from a code."""
    x = held.positions_nm
    ahead = view.from_model(x[:, :N_GIVEN], back[:, -N_NEW:])
    steps = np.diff(back[:, :N_GIVEN], axis=1) * view.scale_nm - np.diff(x[:, :N_GIVEN], axis=1)
    return {
        "code_ade": float(np.linalg.norm(ahead - x[:, N_GIVEN:], axis=-1).mean()),
        "code_step": float(np.linalg.norm(steps, axis=-1).mean()),
    }


def _turned(data: ParticleSet, generator: torch.Generator) -> ParticleSet:
    turns = random_rotations(len(data), generator).double().mT.numpy()[:, None]
    return replace(data, positions_nm=data.positions_nm @ turns, velocities_nm_ps=data.velocities_nm_ps @ turns)


def _as_they_are(windows: Tensor, types: Tensor) -> DrawWindows:
    def draw(batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        rows = torch.randint(len(windows), (batch,), generator=generator)
        return windows[rows], types[rows]

    return draw


def _errors(forecast: Forecast, data: ParticleSet, n_samples: int, solver_steps: int) -> tuple[float, float]:
    drawn = forecast(data, n_samples, solver_steps)
    ade, fde = forecast_errors(drawn, data.positions_nm[:, N_GIVEN:])
    return float(ade.mean()), float(fde.mean())


def _slug(name: str) -> str:
    return "-".join("".join(c if c.isalnum() else " " for c in name).split())


def _key(config: LamSlideConfig, change: Change) -> str:
    c = config.autoencoder
    seen = f"velocities{change.velocities:d}-n{change.n_train or 0}-batch{change.batch}"
    return f"{c.n_latents}x{c.latent_dim}-type{c.type_weight:g}-{seen}"


def table_of(rows: list[Found], folder: Path, before: dict[str, Any]) -> dict[str, Any]:
    """Return the manual's table of these lines, with their curves: [step, samples' ADE, mean forecast's ADE]. Lines of
    the table `before` that were not run again stay."""
    cells, curves = {row[0]: row for row in before.get("rows", [])}, before.get("curves", {})
    for row in rows:
        with (folder / f"{_slug(row.name)}.csv").open(newline="") as handle:
            points = list(csv.DictReader(handle))
        curves[row.name] = [
            [int(p["step"]), *(round(float(p[k]), 4) for k in ("sample_ade", "mean_ade"))] for p in points
        ]
        errors = ("" if x is None else f"{x:.3f}" for x in (row.mean_ade, row.sample_ade, row.code_ade))
        step = "" if row.code_step is None else f"{row.code_step:.4f}"
        cells[row.name] = [row.name, *errors, step, f"{row.steps:,}"]
    known = [change.name for change in CHANGES if change.name in cells]
    return {
        "command": "python docs/studies/published/n_body_causes.py FOLDER",
        "machine": f"one core, busy with others' work ({machine_name()})",
        "columns": ["", "mean forecast", "samples", "code's own error", "of a step", "steps"],
        "rows": [cells[name] for name in known],
        "curves": {name: curves[name] for name in known},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--table", type=Path, help="the manual's table, to be brought up to date")
    parser.add_argument("--only", default="", help="lines whose name contains this")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    path = asked.folder / f"{NAME}.h5"
    make_sets(NAME, path, {"train": SIZES["train"], "validation": _HELD})
    train, held = read_set(path, "train", SIZES["train"]), read_set(path, "validation", _HELD)
    folder, table = asked.folder / "causes", asked.folder / "causes.json"
    folder.mkdir(exist_ok=True)
    rows = json.loads(table.read_text()) if table.exists() else []
    for change in CHANGES:
        if asked.only not in change.name or any(row["name"] == change.name for row in rows):
            continue
        found = run(change, train, held, folder, asked.steps)
        rows.append(asdict(found))
        create_whole(table, json.dumps(rows, indent=1))
        sys.stdout.write(f"{found}\n")
    if asked.table is not None:
        before = json.loads(asked.table.read_text()) if asked.table.exists() else {}
        made = table_of([Found(**row) for row in rows], folder, before)
        create_whole(asked.table, json.dumps(made, indent=1))


if __name__ == "__main__":
    main()
