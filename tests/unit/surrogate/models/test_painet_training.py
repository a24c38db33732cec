"""PAINET's training on a system with a known answer: harmonic vibration, whose flow over a chunk is a linear map."""

from __future__ import annotations

import csv
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from surrogate.data import TrainingFrames, at_rest, collect_frames, load_frames, quantise
from surrogate.models.painet.model import (
    Painet,
    PainetConfig,
    PainetTraining,
    StateWindows,
    for_frames,
    forecast_errors,
    train_painet,
)
from surrogate.models.propagator import Chunk, Molecule
from surrogate.models.weights import load_weights
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer

LAG_PS = 0.002
SMALL = PainetConfig(n_new=3, width=16, n_heads=2, head_dim=8, n_decoder_layers=2)
QUICK = PainetTraining(steps=6, batch=8, validate_every_s=1e9)


@pytest.fixture(scope="module")
def diatomic() -> Scene:
    """Hydrogen fluoride: two atoms, one bond, so that a spring is all its mechanics."""
    return Scene(
        name="hydrogen-fluoride",
        atom_names=("H", "F"),
        elements=("H", "F"),
        residue_of_atom=np.zeros(2, dtype=np.int64),
        residue_names=("MOL",),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=np.array([[0, 1]]),
        bond_orders=np.ones(1),
        formal_charges=np.zeros(2, dtype=np.int64),
        masses_da=np.array([1.008, 18.998]),
        positions_nm=np.array([[0.0, 0.0, 0.0], [0.092, 0.0, 0.0]]),
    )


def vibration(scene: Scene, n_frames: int, seed: int, omega: float = 100.0) -> tuple[np.ndarray, np.ndarray]:
    """Positions nm and velocities nm/ps of a spring that turns slowly: exact, from one random state a trajectory."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    t = np.arange(n_frames) * LAG_PS
    amplitude, phase = 0.01 * rng.uniform(0.5, 1.5), rng.uniform(0, 2 * np.pi)
    length = 0.092 + amplitude * np.cos(omega * t + phase)
    speed = -amplitude * omega * np.sin(omega * t + phase)
    share = scene.masses_da[::-1] / scene.masses_da.sum() * np.array([-1.0, 1.0])
    arrange = lambda s: s[:, None, None] * share[None, :, None] * direction  # noqa: E731
    return arrange(length), arrange(speed)


def frames_of(scene: Scene, n_runs: int = 12, n_frames: int = 120) -> TrainingFrames:
    runs = [vibration(scene, n_frames, seed) for seed in range(n_runs)]
    conditions = {"force_field": "spring", "solvent": "none", "temperature_k": 400.0, "friction_per_ps": 0.5}
    starts = np.arange(n_runs + 1) * n_frames
    positions, velocities = (np.concatenate(parts) for parts in zip(*runs, strict=True))
    return TrainingFrames(scene, quantise(positions), starts, LAG_PS, False, conditions, (),
                          velocities.astype(np.float32))  # fmt: skip


def test_it_learns_the_flow_of_a_spring_better_than_the_frozen_frame(tmp_path: Path, diatomic: Scene) -> None:
    frames = frames_of(diatomic)
    config = PainetTraining(steps=150, batch=32, validate_every_s=1e9, learning_rate=1e-2)
    out = train_painet(frames, tmp_path / "m.safetensors", SMALL, config)
    (row,) = csv.DictReader(out.with_suffix(".csv").open())
    assert float(row["validation_a_mse_a2"]) < 0.05 * float(row["frozen_a_mse_a2"])
    weights = load_weights(out)
    assert weights.model.arch == "painet"
    assert weights.domain.lag_ps == LAG_PS
    c = weights.model.config
    assert (c.lag_ps, c.temperature_k, c.friction_per_ps) == (LAG_PS, 400.0, 0.5)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.csv", "m.safetensors"]
    # The last velocity is learned too: wrong by less than a third of what it changes by.
    changes = StateWindows(frames, c, torch.device("cpu")).change_scale_nm_ps
    assert float(row["validation_velocity_nm_ps"]) < changes / 3


class Spy(Painet):
    """Keeps what each chunk starts from and ends in."""

    def next_chunk(self, last_frames_nm: torch.Tensor, molecule: Molecule, noise: torch.Tensor, *,
                   solver_steps: int = 1, solver: str | None = None,
                   last_velocities_nm_ps: torch.Tensor | None = None) -> Chunk:  # fmt: skip
        chunk = super().next_chunk(last_frames_nm, molecule, noise, last_velocities_nm_ps=last_velocities_nm_ps)
        self.calls.append((last_frames_nm, last_velocities_nm_ps, chunk))
        return chunk


def _products(frames_nm: torch.Tensor, velocities_nm_ps: torch.Tensor) -> torch.Tensor:
    """The inner products of all positions, from their centre, and velocities."""
    rows = torch.cat([frames_nm - frames_nm.mean(1, keepdim=True), velocities_nm_ps], dim=1)
    return rows @ rows.transpose(1, 2)


def test_weights_roll_out_in_chunks_that_carry_velocities(tmp_path: Path, diatomic: Scene) -> None:
    frames = frames_of(diatomic)
    weights = load_weights(train_painet(frames, tmp_path / "m.safetensors", SMALL, QUICK))
    spy = Spy(weights.model.config).eval().requires_grad_(False)
    spy.load_state_dict(weights.model.state_dict())
    spy.calls = []
    config = RolloutConfig(time_ps=9 * LAG_PS, seed=4, precision="fp32")
    rollout(diatomic, replace(weights, model=spy), [tmp_path / f"r{k}.h5" for k in range(2)], config)
    with open_trajectory(tmp_path / "r1.h5") as reader:
        rolled, record = reader.read(), reader.record
    assert record["model"] == "painet"
    assert record["cost"]["network_evaluations"] == 3
    assert len(spy.calls) == 3
    assert spy.calls[0][1] is None, "the first chunk draws its velocities"
    for (_, _, before), (x, v, _) in pairwise(spy.calls):
        # Each chunk has a pose of its own: what a turn leaves alone is the same, to and fro.
        torch.testing.assert_close(_products(x[:, -1], v), _products(before.frames_nm[:, -1], before.velocities_nm_ps),
                                   rtol=1e-5, atol=1e-5)  # fmt: skip
    bonds = np.linalg.norm(rolled[:, 1] - rolled[:, 0], axis=-1)
    expected = torch.cat([chunk.frames_nm[1] for _, _, chunk in spy.calls])
    np.testing.assert_allclose(bonds, (expected[:, 1] - expected[:, 0]).norm(dim=-1), atol=1e-5)
    # Negative control: the replicas have velocities of their own.
    assert (spy.calls[1][1][0] - spy.calls[1][1][1]).abs().max() > 0.1


def test_a_resumed_training_equals_an_uninterrupted_one(tmp_path: Path, diatomic: Scene) -> None:
    frames = frames_of(diatomic)
    whole = train_painet(frames, tmp_path / "whole.safetensors", SMALL, QUICK)

    class Stop(Exception):
        pass

    def stop(stage: str, share: float, metrics: dict[str, float]) -> None:
        if metrics and share > 0.5:
            raise Stop

    often, cut = replace(QUICK, validate_every_s=0.0), tmp_path / "cut.safetensors"
    with pytest.raises(Stop):
        train_painet(frames, cut, SMALL, often, progress=stop)
    train_painet(frames, cut, SMALL, often, resume=True)
    first, second = load_weights(whole).model.state_dict(), load_weights(cut).model.state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)
    other = train_painet(frames, tmp_path / "o.safetensors", SMALL, replace(QUICK, seed=1))
    assert not torch.equal(load_weights(other).model.state_dict()["embed_frame"], first["embed_frame"])


def test_windows_hold_states_and_futures_at_the_stride(diatomic: Scene) -> None:
    frames = frames_of(diatomic, n_frames=160)
    windows = StateWindows(frames, replace(SMALL, frame_stride=2), torch.device("cpu"))
    first = np.array([7, 165])
    x_new, v_new = windows.future(first)
    assert torch.equal(x_new[:, 0], windows.state(first + 2)[0])
    assert torch.equal(x_new[:, 2], windows.state(first + 6)[0])
    assert torch.equal(v_new, windows.state(first + 6)[1])
    # A chunk and its successor lie within one trajectory, before its validation block.
    assert ((windows.starts % 160) + 2 * 6 < 152).all()
    assert (windows.held % 160 >= 152).all()
    with torch.no_grad():
        frozen = forecast_errors(Painet(for_frames(SMALL, frames)), Painet(SMALL).structure(Molecule.of(diatomic)),
                                 StateWindows(frames, SMALL, torch.device("cpu")))  # fmt: skip
    assert frozen["frozen_a_mse_a2"] > 1e-4


def test_frames_without_velocities_or_with_heavy_hydrogens_are_refused(tmp_path: Path, diatomic: Scene) -> None:
    positions, velocities = vibration(diatomic, 40, 0)
    shift = np.array([1.0, 2.0, 3.0])

    def write(name: str, *, moving: bool, hydrogen_mass_da: float | None = None) -> Path:
        columns = ["velocities"] if moving else []
        record = {"temperature_k": 300.0, "hydrogen_mass_da": hydrogen_mass_da}
        with open_writer(tmp_path / name, diatomic, record, columns=columns) as writer:
            extra = {"velocities_nm_ps": velocities + shift} if moving else {}
            writer.append(positions + shift, np.arange(40) * LAG_PS, **extra)
        return tmp_path / name

    with pytest.raises(InputError, match="`save_velocities"):
        collect_frames([write("a.h5", moving=False)], canonical=False, velocities=True)
    with pytest.raises(InputError, match="`hydrogen_mass_da='natural"):
        collect_frames([write("b.h5", moving=True, hydrogen_mass_da=3.0)], canonical=False, velocities=True)
    with pytest.raises(InputError, match="carry none"):
        train_painet(replace(frames_of(diatomic), velocities=None), tmp_path / "m.safetensors", SMALL, QUICK)
    found = collect_frames([write("c.h5", moving=True)], canonical=False, velocities=True)
    np.testing.assert_allclose(found.velocities, velocities, atol=1e-5)
    np.testing.assert_allclose(found.positions_nm(np.arange(40)), positions, atol=2e-4)
    assert "constrain_hydrogens" not in found.conditions, "rigid is usual and goes without saying"
    found.save(tmp_path / "w.h5")
    assert np.array_equal(load_frames(tmp_path / "w.h5").velocities, found.velocities)


def test_at_rest_takes_the_centre_of_mass_away() -> None:
    masses = np.array([1.0, 3.0])
    moved = at_rest(np.array([[[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]]), masses)
    np.testing.assert_allclose(moved[0, :, 0], [-3.0, 1.0])
