"""Where LaM-SLidE's error on charged particles comes from: `python docs/studies/surrogates/n_body_causes.py FOLDER`.

One change a line, at equal steps of equal batches: the code of a frame, what it is told, flow times, targets, and
particles as their own latents. FOLDER holds the data that `surromd reproduce n-body-charged` made (made where missing);
curves go to FOLDER/causes/*.csv, the table to FOLDER/causes.json. What is there is not done again.
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
from torch import Tensor

from md_reference.run.machine import machine_name
from surrogate.bench.reproduce.forecast_errors import forecast_errors
from surrogate.bench.reproduce.forecast_methods import N_GIVEN, Array, Settings, sampled
from surrogate.bench.reproduce.n_body import SIZES
from surrogate.bench.reproduce.n_body_data import make_sets
from surrogate.bench.reproduce.n_body_methods import best_polynomial, set_forecaster
from surrogate.bench.reproduce.n_body_views import ParticleView, WindowView
from surrogate.data.particle_sets import ParticleSet, read_set
from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.codes.base import Code, Decoded
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.losses import (
    FlowWindows,
    autoencoder_loss,
    draw_flow_times,
    flow_loss,
    random_rotations,
)
from surrogate.models.lam_slide.model import LamSlide
from surrogate.models.particles.flow_trainer import ParticleWindows, sample_ahead
from surrogate.models.particles.particle_flow import ParticleFlow, ParticleFlowConfig
from surrogate.models.particles.trainer import DrawWindows, encode_windows, normalise_latents, turned_windows
from surrogate.training.loop import StageConfig, StagePlace, run_stage
from systems.files.whole_file import create_whole

NAME = "n-body-charged"
BATCH, CODE_BATCH, CODE_STEPS = 64, 256, 1500
_HELD = 200
# Given frames, types and pairs of a set -> forecasts (K, n, n_new, n_particles, 3) nm; K samples, solver steps.
Forecast = Callable[[ParticleSet, int, int], Array]
# Windows, a generator -> loss and its terms.
Loss = Callable[[torch.Generator], tuple[Tensor, dict[str, Tensor]]]


@dataclass(frozen=True)
class Change:
    """One line: `code` and `flow` replace settings of the set of latents, `particles` those of particles as latents.
    `exact`: coordinates themselves for a code. `motion`: of given frames steps and their changes, else positions alone.
    `mean_only`: a plain regression, flow time 0 and no noise. `n_train`: so few trajectories, not turned, to be learned
    by heart. `steps`: fewer, where a step is dear."""

    name: str
    code: dict[str, Any] = field(default_factory=dict)
    flow: dict[str, Any] = field(default_factory=dict)
    particles: dict[str, Any] | None = None
    exact: bool = False
    motion: bool = True
    polynomial: bool = True
    fixed_order: bool = False
    told_charges: bool = True
    mean_only: bool = False
    n_train: int | None = None
    steps: int | None = None


_AS_IT_WAS: dict[str, Any] = {"precondition": True, "uniform_tau": False}
_EXACT: dict[str, Any] = {"n_latents": 5, "latent_dim": 3}
CHANGES = (
    Change("set: as it was", {"type_weight": 0.0}, _AS_IT_WAS),
    Change("set: flow times and weights of the paper", {"type_weight": 0.0}),
    Change("set: and charges in the code"),
    Change("set: and absolute positions", polynomial=False),
    Change("set: and auxiliary losses", flow={"position_weight": 0.25, "distance_weight": 0.25}),
    Change("set: and clean conditioning", flow={"clean_conditioning": True}),
    Change("set: regression instead of a flow", mean_only=True),
    Change("set: 16 trajectories by heart", n_train=16),
    Change("set: identifiers in one order", fixed_order=True),
    Change("exact code: a token for all particles of a frame", _EXACT, {"latents_per_token": 5}, exact=True),
    Change("exact code: a token for each particle of a frame", _EXACT, {"latents_per_token": 1}, exact=True),
    Change("set: 5 latents", {"n_latents": 5, "latent_dim": 16}, {"latents_per_token": 1}),
    Change("set: 16 latents", {"n_latents": 16}, {"latents_per_token": 1}, steps=120),
    Change("particles: a token for 5 frames", particles={"frames_per_token": 5, "pair_messages": False}),
    Change("particles: a token each, positions given", particles={"pair_messages": False}, motion=False),
    Change("particles: a token each", particles={"pair_messages": False}),
    Change("particles: not told of charges", particles={"pair_messages": False}, told_charges=False),
    Change("particles: absolute positions", particles={"pair_messages": False}, polynomial=False),
    Change("particles: and messages along pairs", particles={}),
    Change("particles: regression instead of a flow", particles={}, mean_only=True),
    Change("particles: 16 trajectories by heart", particles={}, n_train=16),
)


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
    weights = best_polynomial(held)[2] if change.polynomial else None
    if change.n_train is not None:
        held = train = train.first(change.n_train)
    steps = min(steps, change.steps or steps)
    place = StagePlace(
        folder / f"{_slug(change.name)}.train.safetensors", folder / f"{_slug(change.name)}.csv", torch.device("cpu")
    )
    place.log.unlink(missing_ok=True)
    code: dict[str, float] = {}
    if change.particles is None:
        network, loss, forecast, code = _of_a_set(change, train, held, weights, folder)
    else:
        network, loss, forecast = _of_particles(change, train, weights)

    def validate() -> dict[str, float]:
        mean = _errors(forecast, held, 1, 1)
        sample = mean if change.mean_only else _errors(forecast, held, 2, 10)
        return {"mean_ade": mean[0], "sample_ade": sample[0], "sample_fde": sample[1]}

    stage = StageConfig("flow", BATCH, 2e-3, None, steps, warmup_steps=50, ema_decay=0.99, validate_every_s=20.0)
    seconds = run_stage(network, stage, loss, validate, place)
    place.state.unlink()
    return Found(change.name, steps, round(seconds, 1), **validate(), **code)


def _of_a_set(
    change: Change, train: ParticleSet, held: ParticleSet, weights: Array | None, folder: Path
) -> tuple[torch.nn.Module, Loss, Forecast, dict[str, float]]:
    settings = Settings(folder)
    config = set_forecaster(settings, train.n_particles).config
    config = replace(
        config,
        autoencoder=replace(config.autoencoder, **change.code),
        approximator=replace(config.approximator, **change.flow),
    )
    view, model = WindowView.of(train, weights), LamSlide(config)
    if change.exact:
        model.autoencoder = ExactCode(config.autoencoder.n_latents)
    seen, types = torch.from_numpy(view.to_model(train.positions_nm)).float(), torch.from_numpy(train.types)
    draw = turned_windows(seen, types) if change.n_train is None else _as_they_are(seen, types)
    if change.fixed_order:
        draw = _turned_alone(seen, types)
    if not change.exact:
        _code(model, draw, folder / f"code-{_key(config, change)}.train.safetensors")
    normalise_latents(model, draw)
    model.autoencoder.requires_grad_(False)

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        x, kinds = draw(BATCH, generator)
        with torch.no_grad(), torch.autocast("cpu", enabled=False):
            latents = encode_windows(model, x, kinds)
        tau = torch.zeros(BATCH) if change.mean_only else draw_flow_times(model, BATCH, generator)
        return flow_loss(model, FlowWindows(latents, x.shape[2]), tau, generator)

    @torch.no_grad()
    def forecast(data: ParticleSet, n_samples: int, solver_steps: int) -> Array:
        given = data.positions_nm[:, :N_GIVEN]
        known = encode_windows(model, torch.from_numpy(view.given(given)).float(), torch.from_numpy(data.types))
        generator, asked = torch.Generator().manual_seed(0), replace(settings, solver_steps=solver_steps)
        drawn = sampled(model, known, data.n_particles, n_samples, asked, generator)
        return np.stack([view.from_model(given, x) for x in drawn])

    return model.approximator, loss, forecast, _code_errors(model, view, held)


def _of_particles(change: Change, train: ParticleSet, weights: Array | None) -> tuple[torch.nn.Module, Loss, Forecast]:
    def told(data: ParticleSet) -> ParticleSet:
        return data if change.told_charges else replace(data, types=0 * data.types, pairs=0 * data.pairs)

    view, train = ParticleView.of(train, weights), told(train)
    view = view if change.motion else PositionsView(view.window, view.sizes_nm)
    n_features = view.given(train.positions_nm[:1, :N_GIVEN]).shape[-1]
    model = ParticleFlow(ParticleFlowConfig(n_features, **(change.particles or {})))
    turned = view.drawn(train, mirrored=False)

    def draw(generator: torch.Generator) -> ParticleWindows:
        if change.n_train is None:
            return turned(BATCH, generator)
        chosen = train.rows(torch.randint(len(train), (BATCH,), generator=generator).numpy())
        return view.to_model(chosen.positions_nm, chosen)

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        windows = draw(generator)
        tau = torch.rand(BATCH, generator=generator) * (0.0 if change.mean_only else 1.0)
        noise = torch.randn(windows.ahead.shape, generator=generator)
        at = flow.expand(tau, noise)
        found = (model(at * windows.ahead + (1 - at) * noise, tau, windows.given) - windows.ahead).square().mean()
        return found, {"flow": found.detach()}

    def forecast(data: ParticleSet, n_samples: int, solver_steps: int) -> Array:
        given, generator = data.positions_nm[:, :N_GIVEN], torch.Generator().manual_seed(0)
        known = view.known(given, told(data))
        drawn = [sample_ahead(model, known, solver_steps, generator) for _ in range(n_samples)]
        return np.stack([view.from_model(given, x.double().numpy()) for x in drawn])

    return model, loss, forecast


class ExactCode(Code):
    """Particles' coordinates as they are: what stage two could do if stage one lost nothing."""

    latent_dim = 3

    def __init__(self, n_particles: int) -> None:
        super().__init__()
        self.n_latents = n_particles

    def n_entities(self, n_atoms: int) -> int:
        return n_atoms

    def types(self, elements: Tensor) -> Tensor:
        return elements

    def encode(self, x: Tensor, elements: Tensor, identifiers: Tensor, mask: Tensor | None = None) -> Tensor:
        return x

    def decode(self, latents: Tensor, identifiers: Tensor, *, with_types: bool = False) -> Decoded:
        return Decoded(latents, None)


class PositionsView(ParticleView):
    """Given frames as positions alone, about the centre of the last."""

    def given(self, given: Array) -> Array:
        return self.window.given(given).swapaxes(1, 2).reshape(len(given), given.shape[2], -1)


def _code(model: LamSlide, draw: DrawWindows, state: Path) -> None:
    """Train the code of a frame, or take it where a line before has trained the same."""

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        x, kinds = draw(CODE_BATCH, generator)
        at = torch.randint(x.shape[1], (CODE_BATCH,), generator=generator)
        return autoencoder_loss(model, x[torch.arange(CODE_BATCH), at], kinds, generator)

    stage = StageConfig("code", CODE_BATCH, 2e-3, None, CODE_STEPS, warmup_steps=50, ema_decay=0.99, bf16=False)
    place = StagePlace(state, state.with_suffix("").with_suffix(".csv"), torch.device("cpu"), resume=True)
    run_stage(model.autoencoder, stage, loss, dict, place)


@torch.no_grad()
def _code_errors(model: LamSlide, view: WindowView, held: ParticleSet) -> dict[str, float]:
    x = held.positions_nm
    seen = torch.from_numpy(view.to_model(x)).float()
    back = model.decode(encode_windows(model, seen, torch.from_numpy(held.types)), held.n_particles).double().numpy()
    ahead = view.from_model(x[:, :N_GIVEN], back[:, N_GIVEN:])
    steps = np.diff(back[:, :N_GIVEN], axis=1) * view.scale_nm - np.diff(x[:, :N_GIVEN], axis=1)
    return {
        "code_ade": float(np.linalg.norm(ahead - x[:, N_GIVEN:], axis=-1).mean()),
        "code_step": float(np.linalg.norm(steps, axis=-1).mean()),
    }


def _turned_alone(windows: Tensor, types: Tensor) -> DrawWindows:
    plain = _as_they_are(windows, types)

    def draw(batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        x, kinds = plain(batch, generator)
        return x @ random_rotations(batch, generator)[:, None].mT, kinds

    return draw


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
    seen = f"poly{change.polynomial:d}-order{change.fixed_order:d}-n{change.n_train or 0}"
    return f"{c.n_latents}x{c.latent_dim}-type{c.type_weight:g}-{seen}"


def table_of(rows: list[Found], folder: Path) -> dict[str, Any]:
    """Return the manual's table of these lines, with their curves: [step, samples' ADE, mean forecast's ADE]."""
    curves, places = {}, [change.name for change in CHANGES]
    rows = sorted(rows, key=lambda row: places.index(row.name))
    for row in rows:
        with (folder / f"{_slug(row.name)}.csv").open(newline="") as handle:
            points = list(csv.DictReader(handle))
        curves[row.name] = [
            [int(p["step"]), *(round(float(p[k]), 4) for k in ("sample_ade", "mean_ade"))] for p in points
        ]
    return {
        "command": "python docs/studies/surrogates/n_body_causes.py FOLDER",
        "machine": f"one core, busy with others' work ({machine_name()})",
        "columns": ["", "mean forecast", "samples", "code's own error", "of a step", "steps"],
        "rows": [
            [row.name, *("" if x is None else f"{x:.3f}" for x in (row.mean_ade, row.sample_ade, row.code_ade)),
             "" if row.code_step is None else f"{row.code_step:.4f}", f"{row.steps:,}"] for row in rows
        ],
        "curves": curves,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--table", type=Path, help="where to write the manual's table")
    parser.add_argument("--only", default="", help="lines whose name contains this")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    path = asked.folder / f"{NAME}.h5"
    make_sets(NAME, path, SIZES)
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
        create_whole(asked.table, json.dumps(table_of([Found(**row) for row in rows], folder), indent=1))


if __name__ == "__main__":
    main()
