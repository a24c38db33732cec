"""Studies of potentials: profiles against GFN2-xTB's, energy without a bath, and a rival that learns."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import corrected_md
import energy_conservation
import gain
import numpy as np
import pytest
import rivals
import torch
import torsion_profiles
import torsion_states

from surrogate.comparison.equivalent_time import EquivalentTime
from surrogate.models.architecture import weights_path
from surrogate.models.painet.potential_trainer import Samples
from surrogate.models.propagator import Molecule
from surrogate.models.weights import Weights, load_weights, save_weights
from systems.prepare.molecule import scene_from_smiles
from systems.units import GAS_CONSTANT_KJ_MOL_K

SHIPPED = "paracetamol-gfn2-xtb"


@pytest.fixture(scope="module")
def shipped() -> Weights:
    return load_weights(weights_path(SHIPPED))


def test_profiles_tell_right_weights_from_shaken_ones(shipped: Weights, tmp_path: Path) -> None:
    right = torsion_profiles.rows(SHIPPED)
    assert [row[1] for row in right] == ["H11-C0-C1-O2", "C1-N3-C4-C5", "C6-C7-O8-H17"]
    assert all(float(row[5]) < 1.0 for row in right)  # kJ/mol, the largest error of each
    assert [float(row[2]) for row in right] == pytest.approx([4.3, 25.3, 23.6], abs=0.3)  # GFN2-xTB's barriers
    wrong = tmp_path / "wrong.safetensors"
    model = load_weights(weights_path(SHIPPED)).model
    with torch.no_grad():
        for p in model.parameters():
            p.mul_(1.0 + 0.3 * torch.randn(p.shape, generator=torch.Generator().manual_seed(0)))
    save_weights(wrong, model, shipped.domain, shipped.provenance)
    assert max(float(row[5]) for row in torsion_profiles.rows(str(wrong))) > 2.0


@pytest.mark.skipif(shutil.which("g++") is None, reason="by torch it takes minutes")
def test_fluctuations_of_energy_go_with_the_square_of_the_step(
    shipped: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(energy_conservation, "DISCARDED_PS", 0.5)
    model, scene = shipped.model, shipped.domain.scene
    model.config = replace(model.config, timestep_ps=0.0005, hydrogen_mass_da=None)
    run = energy_conservation.Run(model.eval().requires_grad_(False), scene.positions_nm, Molecule.of(scene))
    steps = [0.0005, 0.001]
    widths = [float(run.energies(step, 0.2, 0.005).std(0).mean()) for step in steps]
    assert energy_conservation.slope(steps, widths) == pytest.approx(2.0, abs=0.25)
    # Forces that are no energy's gradient heat or cool.
    exact = model.forces
    monkeypatch.setattr(model, "forces", lambda x, m: exact(x, m) + 0.02 * exact(x, m).roll(1, -1))
    assert run.energies(0.0005, 0.2, 0.005).std(0).mean() > 5 * widths[0]


def test_a_corrected_chain_follows_the_reference_whatever_moves_it() -> None:
    masses = torch.tensor([[12.0], [16.0]], dtype=torch.float64)
    true, wrong = 4_000.0, 6_000.0  # kJ/mol/nm^2 of a spring of no length between two atoms

    def springs(k: float) -> corrected_md.Energies:
        return lambda x: 0.5 * k * (x[:, 0] - x[:, 1]).square().sum(-1)

    def leapfrog(x: torch.Tensor, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        pull = torch.tensor([[-1.0], [1.0]], dtype=x.dtype)
        for _ in range(6):
            v = v + 0.005 * wrong * pull * (x[:, :1] - x[:, 1:]) / masses
            x = x + 0.01 * v
            v = v + 0.005 * wrong * pull * (x[:, :1] - x[:, 1:]) / masses
        return x, v

    def spread(k: float) -> float:
        x = torch.zeros(2_000, 2, 3, dtype=torch.float64)
        chain = corrected_md.Chain(x, masses, springs(k), leapfrog, lambda v, x: v, 0)
        found = []
        for step in range(120):
            chain.step()
            if step >= 60:
                found.append((chain.x[:, 0] - chain.x[:, 1]).square().mean())
        assert 0.5 < chain.accepted / chain.asked < 1.0
        assert (masses * chain.v).sum(1).abs().max() < 1e-9, "the centre of mass stays at rest"
        return float(torch.stack(found).mean())

    kt = GAS_CONSTANT_KJ_MOL_K * corrected_md.TEMPERATURE_K
    assert spread(true) == pytest.approx(kt / true, rel=0.01)
    assert spread(wrong) == pytest.approx(kt / wrong, rel=0.01)


def test_a_turn_that_is_offered_leaves_the_law_alone() -> None:
    masses = torch.tensor([[12.0], [16.0]], dtype=torch.float64)
    spring, pull = 4_000.0, 60.0  # kJ/mol/nm^2, kJ/mol/nm along x

    def energies(x: torch.Tensor) -> torch.Tensor:
        apart = x[:, 0] - x[:, 1]
        return 0.5 * spring * apart.square().sum(-1) + pull * apart[:, 0]

    def still(x: torch.Tensor, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return x + 0.005 * v, v

    x = torch.zeros(2_000, 2, 3, dtype=torch.float64)
    chain = corrected_md.Chain(x, masses, energies, still, lambda v, x: v, 0, lambda x: x.flip(1))
    found = []
    for step in range(400):
        chain.step()
        if step >= 100:
            found.append((chain.x[:, 0] - chain.x[:, 1])[:, 0].mean())
    assert 0.2 < chain.turned / chain.asked < 0.7
    assert float(torch.stack(found).mean()) == pytest.approx(-pull / spring, rel=0.02)


def test_a_chain_that_never_moves_begins_where_another_is() -> None:
    def energies(x: torch.Tensor) -> torch.Tensor:
        return torch.where(
            x[:, 0, 0] > 5.0, -1e9 * x[:, 0, 0], 0.0
        )  # whatever leaves the first replica's start is refused

    def away(x: torch.Tensor, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return x - 0.01, v

    x = torch.zeros(3, 2, 3, dtype=torch.float64)
    x[1] = 9.0
    chain = corrected_md.Chain(x, torch.ones(2, 1, dtype=x.dtype), energies, away, lambda v, x: v, 0)
    for _ in range(5):
        chain.step()
    assert chain.moves.tolist() == [True, False, True]
    assert chain.free() == 1
    assert torch.equal(chain.x[1], chain.x[0]) and chain.energy[1] == 0.0


def test_half_a_turn_twice_is_none_and_keeps_bonds() -> None:
    scene = scene_from_smiles("CC(=O)Nc1ccc(O)cc1")
    turn, x = corrected_md.half_turn(scene, [6, 7, 8, 17]), torch.tensor(scene.positions_nm)[None]
    assert torch.allclose(turn(turn(x)), x, atol=1e-12)
    moved = torch.nonzero((turn(x) - x)[0].abs().amax(-1) > 1e-6).flatten().tolist()
    assert moved == [17]
    assert (turn(x)[0, 17] - x[0, 8]).norm() == pytest.approx(float((x[0, 17] - x[0, 8]).norm()))


def test_chains_start_all_over() -> None:
    scene = scene_from_smiles("CC(=O)Nc1ccc(O)cc1")
    found = corrected_md.starts(scene, 12, 0)
    bonds = np.linalg.norm(found[:, scene.bonds[:, 0]] - found[:, scene.bonds[:, 1]], axis=-1)
    assert np.ptp(bonds, axis=0).max() < 1e-6 and len({round(float(x), 6) for x in found[:, 17, 2]}) == 12


def test_speed_up_is_equivalent_time_over_what_the_time_buys() -> None:
    equivalent_time = EquivalentTime(
        "rotors", "distribution", "rotors", 4_000.0, 1_000.0, None, "at least", 0.1, (1e3, 4e3), (2.0, 1.0), (), ()
    )
    assert gain.speed_up_words(equivalent_time, 800.0) == "at least 5 [1.2, ...]"
    assert gain.speed_up_words(replace(equivalent_time, bound="", high_ps=6_000.0), 2_000.0) == "2 [0.5, 3]"
    assert gain.speed_up_words(replace(equivalent_time, low_ps=None), 800.0) == "at least 5"


def test_chains_that_forget_slowly_are_less_md() -> None:
    def row(chains: float, rollout: float, key: str = "correlation_time:x") -> Any:
        return SimpleNamespace(
            key=key, reference=SimpleNamespace(value=chains), candidate=SimpleNamespace(value=rollout)
        )

    evaluated: Any = SimpleNamespace(rows=[row(0.8, 0.4), row(0.8, 0.6), row(8.0, 0.1, "torsion"), row(1.0, 3.0)])
    assert gain.pace(evaluated) == pytest.approx(0.5)
    evaluated.rows = [row(0.4, 0.8)]
    assert gain.pace(evaluated) == 1.0


def test_states_of_a_torsion_are_counted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def frames(path: Path) -> np.ndarray:
        angles = np.deg2rad([0.0, 100.0, -170.0, 80.0] if path.name == "a" else [-100.0] * 4)
        x = np.zeros((4, 4, 3))
        x[:, 2] = (0.0, 0.0, 1.0)
        x[:, 3] = np.stack([np.cos(angles), np.sin(angles), np.ones(4)], axis=1)
        x[:, 0] = (1.0, 0.0, 0.0)
        return x

    monkeypatch.setattr(torsion_states, "frames_of", frames)
    monkeypatch.setattr("sys.argv", ["torsion_states.py", "0,1,2,3", "90", "a", "b"])
    torsion_states.main()
    assert capsys.readouterr().out == "2 trajectories: 75 ± 25 % of frames, 2 crossings\n"


@pytest.mark.slow
def test_a_rival_learns_what_it_is_shown() -> None:
    scene = scene_from_smiles("O")
    molecule, rng = Molecule.of(scene), np.random.default_rng(0)
    x = scene.positions_nm + 0.005 * rng.normal(size=(60, 3, 3))

    def springs(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        energy, forces = np.zeros(len(x)), np.zeros_like(x)
        for i, j in scene.bonds.tolist():
            apart = x[:, i] - x[:, j]
            length = np.linalg.norm(apart, axis=-1, keepdims=True)
            pull = 2e5 * (length - 0.096) * apart / length
            energy += 1e5 * (length[:, 0] - 0.096) ** 2
            forces[:, i] -= pull
            forces[:, j] += pull
        return energy, forces

    energies, forces = springs(x)
    torch.manual_seed(0)
    network = rivals.EgnnEnergy(molecule, width=16, n_layers=2)
    error = []
    for budget_s in (0.05, 4.0):
        _, scale, _ = rivals.learn(network, Samples(x, energies, forces, np.zeros(60, bool)), budget_s)
        found = rivals.gradient_of(network)(torch.tensor(x))[1].double().numpy()
        error.append(float(np.abs(-scale * found - forces).mean()))
    assert error[1] < 0.5 * error[0] and error[1] < 0.4 * np.abs(forces).mean()
    frames, forces_a_s = rivals.roll(network.eval(), scale, scene.positions_nm, molecule, 0.2, 60.0)
    assert frames.shape == (2, 32, 3, 3) and forces_a_s > 0
