"""Torsion moves of a potential's rollout: the distribution that energies give, the bath's temperature, rigid parts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from surrogate.models.architecture import weights_path
from surrogate.models.potential import IntegratorConfig, Potential, Turns, at_rest
from surrogate.models.propagator import Molecule, draw_noise
from surrogate.models.weights import load_weights
from systems.chemistry.validity import CLASH, check_frames, geometry_from_scene
from systems.errors import InputError
from systems.prepare.molecule import scene_from_smiles
from systems.scene import Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K

KT = GAS_CONSTANT_KJ_MOL_K * 300.0


def angles(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Frames `(..., 4, 3)` of a chain -> cosines of its two angles `(..., 2)`, sine and cosine of its torsion."""
    a, b, c = x.diff(dim=-2).unbind(-2)
    m, n = torch.linalg.cross(a, b), torch.linalg.cross(b, c)
    size = m.norm(dim=-1) * n.norm(dim=-1)
    sine = (torch.linalg.cross(m, n) * b).sum(-1) / (size * b.norm(dim=-1))
    ends = [-(u * v).sum(-1) / (u.norm(dim=-1) * v.norm(dim=-1)) for u, v in ((a, b), (b, c))]
    return torch.stack(ends, dim=-1), sine, (m * n).sum(-1) / size


class Peroxide(Potential):
    """HOOH of two wells, at -90 and 90 degrees, that no MD of some ps goes between: 40 kJ/mol."""

    arch = "peroxide"

    def __init__(self, moves: int) -> None:
        super().__init__()
        self.config = IntegratorConfig(torsion_moves=moves)

    def energies(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        order = torch.tensor([2, 0, 1, 3])  # H O O H
        x = positions_nm[:, order]
        bonds = x.diff(dim=1).norm(dim=-1) - torch.tensor([0.097, 0.145, 0.097])
        bent, sine, cosine = angles(x)
        torsion = 20.0 * (1.0 + 2.0 * cosine.square() - 1.0) + 1.5 * sine
        return (1.5e5 * bonds.square().sum(1) + 200.0 * (bent + 0.2).square().sum(1) + torsion)[:, None]


@pytest.fixture(scope="module")
def peroxide() -> Scene:
    return scene_from_smiles("OO")


def rolled(moves: int, scene: Scene, rows: int = 384, chunks: int = 5) -> tuple[Tensor, Tensor]:
    """Sines `(rows, frames)` of the torsion, all from 90 degrees, and kinetic energies `(rows, chunks)`."""
    model = Peroxide(moves)
    molecule = model.featurise(scene)
    x = torch.tensor([[0.0, 0, 0], [0, 0, 0.145], [0.095, 0, -0.02], [0, -0.095, 0.165]]).double()
    if angles(x[[2, 0, 1, 3]])[1] < 0:
        x[3, 1] *= -1.0
    x, v = x.expand(rows, 1, -1, -1), None
    sines, kinetic, masses = [], [], model.masses_da(molecule)[:, None]
    for k in range(chunks):
        noise = draw_noise(model, 4, [torch.Generator().manual_seed(1000 * k + row) for row in range(rows)])
        chunk = model.next_chunk(x, molecule, noise, last_velocities_nm_ps=v)
        x, v = chunk.frames_nm[:, -1:], chunk.velocities_nm_ps
        assert v is not None
        sines.append(angles(chunk.frames_nm[:, :, [2, 0, 1, 3]])[1])
        kinetic.append(0.5 * (masses * v.square()).sum((1, 2)))
    return torch.cat(sines, dim=1), torch.stack(kinetic, dim=1)


def test_torsion_moves_visit_wells_as_their_energies_say_and_leave_the_temperature(peroxide: Scene) -> None:
    """Of two wells 3 kJ/mol apart; without moves nothing ever leaves the one it began in."""
    stays, _ = rolled(0, peroxide, rows=8, chunks=4)
    assert bool((stays > 0.0).all())
    sines, kinetic = rolled(2, peroxide)
    phi = np.linspace(-np.pi, np.pi, 3600)
    law = np.exp(-(40.0 * np.cos(phi) ** 2 + 1.5 * np.sin(phi)) / KT)
    expected = law[phi > 0].sum() / law.sum()
    assert expected < 0.3
    share = (sines[:, 20:] > 0.0).double().mean(1)
    error = float(share.std() / math.sqrt(len(share)))
    # Accepted whatever the energy they would be even, and by the wrong sign 1 - expected.
    assert error < 0.02 and abs(float(share.mean()) - expected) < 3.0 * error
    # As warm as without moves.
    both = [k[:, 2:].mean(1) for k in (rolled(0, peroxide)[1], kinetic)]
    apart, error = float(both[1].mean() - both[0].mean()), float((torch.stack(both).var(1).sum() / len(both[0])).sqrt())
    assert abs(apart) < 4.0 * error < 0.12 * float(both[0].mean())


def test_bonds_that_turn_are_those_whose_turning_makes_another_state() -> None:
    """Neither methyls nor amides, the smaller side of each."""
    scene = scene_from_smiles("CC(=O)Nc1ccc(O)cc1")
    turns = Turns.of(scene)
    ends = [{scene.elements[i] for i in pair} for pair in turns.ends.tolist()]
    assert ends == [{"N", "C"}, {"C", "O"}] and turns.side.sum(1).tolist() == [8, 2]
    assert all(bool(s[last]) and not bool(s[first]) for s, (first, last) in zip(turns.side, turns.ends, strict=True))
    unknown = replace(scene, bond_orders=np.zeros_like(scene.bond_orders))
    assert not any(len(Turns.of(none).ends) for none in (scene_from_smiles("CC"), unknown))


def test_both_sides_of_a_turned_bond_stay_as_they_are_and_move_on_as_they_did() -> None:
    scene = scene_from_smiles("CCC(=O)OC")
    turns, generator = Turns.of(scene), torch.Generator().manual_seed(3)
    x = torch.tensor(scene.positions_nm).expand(6, -1, -1)
    v = torch.randn(x.shape, generator=generator, dtype=torch.float64)
    which, angle = torch.arange(6) % len(turns.ends), torch.linspace(-3.0, 3.0, 6, dtype=torch.float64)
    there, moving = turns.turned(x, v, which, angle)

    def pairs(at: Tensor, moves: Tensor) -> tuple[Tensor, Tensor]:
        apart, along = at[:, :, None] - at[:, None], moves[:, :, None] - moves[:, None]
        return apart.norm(dim=-1), (apart * along).sum(-1)

    together = turns.side[which][:, :, None] == turns.side[which][:, None]
    for before, after in zip(pairs(x, v), pairs(there, moving), strict=True):
        torch.testing.assert_close(before[together], after[together], rtol=0, atol=1e-12)
        assert float((before - after)[~together].abs().max()) > 0.01
    torch.testing.assert_close(moving.square().sum(-1), v.square().sum(-1))
    for row, (first, last) in enumerate(turns.ends[which].tolist()):
        a = next(i for i in scene.neighbours()[first] if i != last)
        b = next(i for i in scene.neighbours()[last] if i != first)

        def torsion(at: Tensor, atoms: list[int]) -> float:
            _, sine, cosine = angles(at[atoms])
            return math.atan2(float(sine), float(cosine))

        grown = torsion(there[row], [a, first, last, b]) - torsion(x[row], [a, first, last, b])
        assert math.remainder(grown - float(angle[row]), 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)


class Flat(Potential):
    """A potential without forces, which every move is accepted by."""

    arch = "flat"

    def __init__(self) -> None:
        super().__init__()
        self.config = IntegratorConfig(torsion_moves=20)

    def energies(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        return 0.0 * positions_nm.sum((1, 2))[:, None]


def test_many_moves_leave_the_temperature_and_end_in_no_overlap() -> None:
    """Where all are accepted but those into overlaps."""
    scene, model, rows = scene_from_smiles("OCCO"), Flat(), 4000
    molecule = model.featurise(scene)
    masses, generator = model.masses_da(molecule)[:, None], torch.Generator().manual_seed(1)

    def drawn(*shape: int) -> Tensor:
        return torch.randn(rows, scene.n_atoms, *shape, generator=generator, dtype=torch.float64)

    x = torch.tensor(scene.positions_nm).repeat(rows, 1, 1)
    v = at_rest((KT / masses).sqrt() * drawn(3), masses)
    draw = drawn(20, 3)
    there, moving = model._turned(x, v, molecule, masses, draw)
    kinetic = 0.5 * (masses * moving.square()).sum((1, 2))
    expected = 0.5 * KT * 3 * (scene.n_atoms - 1)
    error = float(kinetic.std()) / rows**0.5
    assert abs(float(kinetic.mean()) - expected) < 3.0 * error < 0.02 * expected
    assert float((masses * moving).sum(1).abs().max()) < 1e-9
    unpaired = molecule.own.turns._replace(pairs=torch.zeros(0, 2, dtype=torch.int64), least_nm=torch.zeros(0))
    free = replace(molecule, own=molecule.own._replace(turns=unpaired))
    anyhow, _ = model._turned(x, v, free, masses, draw)
    overlaps = [check_frames(at.numpy(), geometry_from_scene(scene)) & CLASH > 0 for at in (there, anyhow)]
    assert not overlaps[0].any() and overlaps[1].sum() > 3


def test_energies_of_moves_are_those_of_the_frames_that_they_end_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Above 64 atoms, where pairs are those of the frames."""
    model = load_weights(weights_path("drug-like-gfn2-xtb")).model.in_bath({"torsion_moves": 1, "timestep_ps": 0.002})
    scene = scene_from_smiles("C" * 22)
    molecule = model.featurise(scene)
    asked: list[Tensor] = []
    gradient = model.gradient
    monkeypatch.setattr(model, "gradient", lambda x, molecule: asked.append(x) or gradient(x, molecule))
    x, masses = torch.tensor(scene.positions_nm)[None], model.masses_da(molecule)[:, None]
    draw = torch.randn(1, scene.n_atoms, 2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    model._turned(x, torch.zeros_like(x), molecule, masses, draw)
    assert len(asked) == 3 and all(float((at - x).abs().max()) > 0.01 for at in asked[1:])


def test_hydrogens_leave_the_atoms_that_bear_them_a_mass() -> None:
    model = Flat().in_bath({"hydrogen_mass_da": 5.0})
    with pytest.raises(InputError, match="leaves a heavy atom no mass; use less"):
        model.masses_da(Molecule.of(scene_from_smiles("C")))


def test_moves_without_a_temperature_are_refused() -> None:
    with pytest.raises(InputError, match="torsion moves are of a temperature"):
        IntegratorConfig(torsion_moves=1, ensemble="nve")
