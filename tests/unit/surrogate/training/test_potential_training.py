"""PAINET learns a potential whose answer is known: bonds and angles of a small molecule, as a force field has them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from surrogate.models.painet import potential_trainer as trainer
from surrogate.models.painet.energy import PotentialConfig
from surrogate.models.painet.potential_trainer import (
    Learner,
    PotentialTraining,
    Samples,
    domain_of,
    learn_potential,
    samples_path,
)
from surrogate.models.propagator import Molecule, draw_noise
from surrogate.models.weights import load_weights
from surrogate.training import loop
from systems.chemistry.validity import ANGLE, DRIFT, Limits, check_limits
from systems.errors import InputError, SimulationError
from systems.prepare.molecule import scene_from_smiles
from systems.scene import Scene

SMALL = PotentialConfig(width=24, n_radial=8, n_scalars=6, n_vectors=4, n_tensors=2, n_heads=2, head_dim=4, n_new=2,
                        lag_ps=0.01, timestep_ps=0.001)  # fmt: skip
QUICK = PotentialTraining(steps=12, batch=8, first=24, most=60, rounds=2, tolerance_kj_mol_nm=0.0,
                          temperatures_k=(300.0, 600.0))  # fmt: skip


@dataclass
class Answers:
    positions_nm: Any
    energies_kj_mol: Any
    forces_kj_mol_nm: Any


class Springs:
    """A cheap reference: springs between all atoms at most two bonds apart."""

    def __init__(self, *, silent: bool = False, zero_kj_mol: float = -7000.0) -> None:
        self.scene: Scene = scene_from_smiles("O")
        self.silent, self.asked, self.zero_kj_mol = silent, 0, zero_kj_mol
        x = self.scene.positions_nm
        pairs = [(i, j) for i in range(3) for j in range(i + 1, 3)]
        self.pairs = [(i, j, float(np.linalg.norm(x[i] - x[j]))) for i, j in pairs]

    def explore(self, n_states: int, temperatures_k: tuple[float, ...], *, seed: int) -> Any:
        rng = np.random.default_rng(seed)
        return self.scene.positions_nm + 0.006 * rng.normal(size=(n_states, 3, 3))

    def motion(self, n_frames: int, lag_ps: float, temperature_k: float, *, seed: int, **_: bool) -> Any:
        return self.explore(n_frames, (temperature_k,), seed=seed)

    def label(self, positions_nm: Any) -> Answers:
        self.asked += len(positions_nm)
        x = positions_nm[:0] if self.silent else np.asarray(positions_nm, dtype=np.float64)
        energies, forces = np.full(len(x), self.zero_kj_mol), np.zeros_like(x)
        for i, j, rest in self.pairs:
            apart = x[:, i] - x[:, j]
            length = np.linalg.norm(apart, axis=-1)
            energies += 0.5 * 2e5 * (length - rest) ** 2
            pull = (2e5 * (length - rest) / length)[:, None] * apart
            forces[:, i] -= pull
            forces[:, j] += pull
        return Answers(x, energies, forces)


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Springs, Path]:
    """A reference that was asked, and the weights that learned from it."""
    reference, out = Springs(), tmp_path_factory.mktemp("learned") / "w.safetensors"
    config = replace(QUICK, steps=100, learning_rate=5e-3, matrix_rate=0.05)
    learn_potential(reference, out, SMALL, config)
    return reference, out


def test_it_learns_forces_and_asks_about_more_states(learned: tuple[Springs, Path]) -> None:
    reference, out = learned
    weights = load_weights(out)
    found = weights.provenance
    assert found["force_rms"] < 0.4 * found["mean_force"]
    assert found["evaluations"] > QUICK.first
    samples = Samples.load(samples_path(out), reference.scene.topology_hash)
    assert len(samples) == found["evaluations"] <= reference.asked
    assert 0 < samples.held.sum() < 0.3 * len(samples)
    # The file gives back the potential: its forces at held-out states, and a rollout that stays whole.
    model, molecule = weights.model, Molecule.of(reference.scene)
    held = samples.where(samples.held)
    forces = model.forces(torch.from_numpy(held.positions_nm), molecule).numpy()
    error = np.sqrt(np.mean((forces - held.forces_kj_mol_nm) ** 2))
    assert error == pytest.approx(found["force_rms"], rel=0.01)
    noise = draw_noise(model, 3, [torch.Generator().manual_seed(0)])
    chunk = model.next_chunk(torch.tensor(reference.scene.positions_nm[None, None]).float(), molecule, noise)
    lengths = (chunk.frames_nm[..., 0, :] - chunk.frames_nm[..., 1, :]).norm(dim=-1)
    assert ((lengths - reference.pairs[0][2]).abs() < 0.05).all()


def test_it_begins_with_what_other_weights_know(learned: tuple[Springs, Path], tmp_path: Path) -> None:
    _, known = learned
    few = replace(QUICK, steps=2, learning_rate=1e-5, matrix_rate=1e-5)
    found, wide = {}, load_weights(known)
    walls = wide.model.network.nearest_nm.mul_(0.5).clone()
    for name, network in (("fresh", SMALL), ("pretrained", wide)):
        out = tmp_path / f"{name}.safetensors"
        learn_potential(Springs(zero_kj_mol=900.0), out, network, few)
        found[name] = load_weights(out)
    fresh, pretrained = (found[name].provenance for name in ("fresh", "pretrained"))
    assert pretrained["force_rms"] < 0.4 * fresh["force_rms"]
    assert pretrained["from"]["hash"] == load_weights(known).hash and "from" not in fresh
    # What they have seen stays open.
    assert torch.equal(found["pretrained"].model.network.nearest_nm, walls) and float(walls.max()) > 0.0
    assert bool((found["fresh"].model.network.nearest_nm >= 1.5 * walls)[walls > 0.0].all())
    # Zeros of energy are those of the molecule that is learned.
    x, energies, _ = Samples.load(
        samples_path(tmp_path / "pretrained.safetensors"), Springs().scene.topology_hash
    ).tensors()
    told = found["pretrained"].model.evaluate(x, Molecule.of(Springs().scene)).energy_kj_mol
    assert float((told - energies).mean().abs()) < 0.1 * float(energies.std()) < 100.0


def test_a_budget_is_for_all_that_a_training_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock of its own: a label takes a second, cheap MD a tenth of one a frame, a step nothing."""
    clock, stages = [0.0], []

    class Slow(Springs):
        def motion(self, n_frames: int, lag_ps: float, temperature_k: float, *, seed: int, **_: bool) -> Any:
            clock[0] += 0.1 * n_frames
            return super().motion(n_frames, lag_ps, temperature_k, seed=seed)

        def label(self, positions_nm: Any) -> Answers:
            clock[0] += len(positions_nm)
            return super().label(positions_nm)

    def run(stage: Any, *_: Any, **__: Any) -> float:
        stages.append(stage.config)
        return 0.0

    monkeypatch.setattr(trainer.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(loop, "run_stage", run)
    config = replace(QUICK, steps=None, budget_s=200.0)
    learn_potential(Slow(), tmp_path / "a.safetensors", SMALL, config, before_s=15.0, after_s=20.0)
    # 15 before, 400 frames of MD at two temperatures, 24 first labels, 20 for what comes after.
    assert stages[0].budget_s == pytest.approx(200.0 - 15.0 - 40.0 - 24.0 - 20.0)
    learn_potential(Slow(), tmp_path / "b.safetensors", SMALL, replace(config, budget_s=90.0), before_s=15.0)
    assert stages[1].budget_s == pytest.approx(0.3 * 90.0), "a share is for steps however short the budget"


def test_where_members_differ_is_where_the_model_knows_least(tmp_path: Path) -> None:
    reference = Springs()
    from surrogate.models.painet.painet_potential import PainetPotential

    torch.manual_seed(0)
    learner = Learner(PainetPotential(SMALL), reference, QUICK, tmp_path / "w.safetensors", resume=False)
    optimiser = torch.optim.Adam(learner.model.parameters(), 5e-3)
    generator = torch.Generator().manual_seed(0)
    for _ in range(200):
        loss, _ = learner.loss(generator)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    near = torch.from_numpy(reference.explore(20, (300.0,), seed=9))
    far = near + 0.03 * torch.randn(near.shape, generator=generator, dtype=near.dtype)
    far_kj, near_kj = (np.median(learner.model.spread(x, learner.molecule)) for x in (far, near))
    assert far_kj > 1.3 * near_kj


def test_an_interrupted_training_goes_on(tmp_path: Path) -> None:
    reference, out = Springs(), tmp_path / "w.safetensors"

    class Stopped(Exception):
        pass

    def stop(line: str, share: float, metrics: dict[str, float]) -> None:
        if metrics:
            raise Stopped

    config = replace(QUICK, validate_every_s=0.0)
    with pytest.raises(Stopped):
        learn_potential(reference, out, SMALL, config, progress=stop)
    assert not out.exists() and samples_path(out).exists()
    first = Samples.load(samples_path(out), reference.scene.topology_hash)
    learn_potential(reference, out, SMALL, config, resume=True)
    assert out.exists()
    # What was answered is not asked again.
    samples = Samples.load(samples_path(out), reference.scene.topology_hash)
    np.testing.assert_array_equal(samples.positions_nm[: len(first)], first.positions_nm)
    assert not list(tmp_path.glob("*.train.safetensors"))


def test_samples_alone_are_enough_to_go_on_from(tmp_path: Path) -> None:
    from surrogate.models.painet.painet_potential import PainetPotential

    reference, models = Springs(), [PainetPotential(SMALL) for _ in range(2)]
    for model, resume in zip(models, (False, True), strict=True):
        Learner(model, reference, QUICK, tmp_path / "w.safetensors", resume=resume)
    assert reference.asked == QUICK.first
    scales = [float(model.energy_scale_kj_mol) for model in models]
    assert scales[0] == scales[1] and scales[0] != float(PainetPotential(SMALL).energy_scale_kj_mol)
    assert float(models[0].energy_offset_kj_mol) == float(models[1].energy_offset_kj_mol)


def test_a_reference_without_answers_and_foreign_samples_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match="no answer"):
        learn_potential(Springs(silent=True), tmp_path / "w.safetensors", SMALL, QUICK)
    Samples.none(3).save(tmp_path / "s.safetensors", "mine")
    with pytest.raises(InputError, match="another molecule"):
        Samples.load(tmp_path / "s.safetensors", "yours")
    blob = bytearray((tmp_path / "s.safetensors").read_bytes())
    (tmp_path / "s.safetensors").write_bytes(blob[:40])
    with pytest.raises(InputError, match="resume"):
        Samples.load(tmp_path / "s.safetensors", "mine")
    for wrong in ({"first": 4}, {"batch": 0}, {"held_share": 0.0}, {"temperatures_k": ()}):
        with pytest.raises(InputError):
            replace(QUICK, **wrong)


def test_frames_may_move_as_far_as_those_of_hot_md() -> None:
    scene, rng = scene_from_smiles("OCCO"), np.random.default_rng(0)
    cold, hot = (scene.positions_nm + width * rng.normal(size=(50, scene.n_atoms, 3)) for width in (0.002, 0.02))
    samples = Samples(cold, np.zeros(50), np.zeros_like(cold), np.zeros(50, bool))

    def jumps(*moving: np.ndarray) -> tuple[float, float]:
        limits = Limits.from_dict(domain_of(scene, samples, list(moving), SMALL).limits)
        return limits.jump_min_nm, limits.jump_max_nm

    both = jumps(cold, hot)
    # Runs end where they end: from the last cold frame to the first hot one nothing moved.
    assert both == pytest.approx((jumps(cold)[0], jumps(hot)[1])) and both[1] > 5.0 * jumps(cold)[1]
    # And angles bend as far: the samples, which are few, are cold.
    flagged = [check_limits(hot, Limits.from_dict(domain_of(scene, samples, of, SMALL).limits), hot) & ANGLE > 0
               for of in ([cold, hot], [cold])]  # fmt: skip
    assert not flagged[0].any() and flagged[1].mean() > 0.9
    # Turned about only, nothing changes but for rounding, which is no more than is stated.
    assert jumps(np.stack([Rotation.random(rng=k).apply(cold[0]) for k in range(9)]))[1] < 1e-9


def test_a_small_molecule_may_turn_about_its_centre_of_mass_but_not_leave() -> None:
    scene, rng = scene_from_smiles("CBr"), np.random.default_rng(0)
    share = scene.masses_da / scene.masses_da.sum()
    x = scene.positions_nm - share @ scene.positions_nm

    def run(n: int, speed_nm: float = 0.0) -> np.ndarray:
        """Turn by up to half a radian a frame, and leave along x."""
        frames, turn = [], np.eye(3)
        for k in range(n):
            turn = turn @ Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3)).as_matrix()
            frames.append(x @ turn.T + [speed_nm * k, 0.0, 0.0] + 1e-4 * rng.normal(size=x.shape))
        return np.stack(frames)

    samples = Samples(run(50), np.zeros(50), np.zeros((50, *x.shape)), np.zeros(50, bool))
    limits = Limits.from_dict(domain_of(scene, samples, [run(200), run(200)], SMALL).limits)
    turned, left = run(50), run(50, speed_nm=0.2)
    assert not (check_limits(turned[1:], limits, turned[:-1]) & DRIFT).any()
    assert ((check_limits(left[1:], limits, left[:-1]) & DRIFT) != 0).mean() > 0.9
    assert (check_limits(turned[1:], replace(limits, drift_max_nm=0.0), turned[:-1]) & DRIFT).any()


@pytest.mark.parametrize(("share", "asked"), [(0.1, False), (0.5, True), (0.8, False)])
def test_states_that_a_pause_let_miss_their_time_are_asked_for_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float, asked: bool
) -> None:
    from surrogate.models.painet.painet_potential import PainetPotential

    reference = Springs()
    learner = Learner(PainetPotential(SMALL), reference, QUICK, tmp_path / "w.safetensors", resume=False)
    monkeypatch.setattr(Learner, "share", property(lambda self: share))
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        learner.loss(generator)
    assert (len(learner.samples) > QUICK.first) == asked
    assert len(learner.samples) <= QUICK.most
