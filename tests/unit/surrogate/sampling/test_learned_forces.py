"""A learned potential behind OpenMM's and ASE's faces, and the weights that make its frames those of the reference."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mdtraj
import numpy as np
import pytest
import torch

from md_reference.forces.quantum import Potential
from surrogate.comparison.read.ensemble import load_ensemble
from surrogate.models.architecture import weights_path
from surrogate.models.painet.energy import PotentialConfig
from surrogate.models.painet.model import Painet, PainetConfig
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.weights import TrainingDomain, Weights, load_weights
from surrogate.sampling import runner
from surrogate.sampling.chunks import BLOWN_UP
from surrogate.sampling.coupling import PotentialChecks
from surrogate.sampling.domain import in_bath
from surrogate.sampling.runner import RolloutConfig, rollout
from surrogate.sampling.simulation import KJ_MOL_PER_EV, LearnedForces
from surrogate.verbs.info import rollout_lines
from systems.chemistry.graph import match_atoms
from systems.chemistry.validity import ENERGY, UNSURE, geometry_from_frames
from systems.errors import InputError, OutOfDomainError, SimulationError, SurromdError
from systems.prepare.molecule import scene_from_smiles
from systems.trajectory.codec import DIFFERENCE_COLUMN, open_trajectory

SMALL = PotentialConfig(width=16, n_radial=8, n_scalars=4, n_vectors=3, n_tensors=2, n_heads=2, head_dim=4,
                        timestep_ps=0.001, hydrogen_mass_da=None)  # fmt: skip


def weights(model: PainetPotential | Painet | None = None) -> Weights:
    scene = scene_from_smiles("CO")
    torch.manual_seed(0)
    model = model or PainetPotential(SMALL)
    frames = scene.positions_nm + 0.01 * np.random.default_rng(0).normal(size=(50, scene.n_atoms, 3))
    domain = TrainingDomain(scene, 0.1, {"temperature_k": 300.0}, geometry_from_frames(scene, frames).to_dict())
    return Weights(model.eval().requires_grad_(False), domain, {}, "0", Path("w.safetensors"))


def test_forces_follow_the_scenes_own_order_of_atoms() -> None:
    loaded = weights()
    scene = loaded.domain.scene
    energy, forces = LearnedForces(scene, loaded)(scene.positions_nm)
    order = match_atoms(mixed := scene_from_smiles("OC"), scene)
    placed = np.empty_like(scene.positions_nm)
    placed[order] = scene.positions_nm
    other, turned = LearnedForces(mixed, loaded)(placed)
    assert mixed.elements != scene.elements
    assert other == pytest.approx(energy)
    np.testing.assert_allclose(turned[order], forces, atol=1e-3)
    assert np.abs(forces).max() > 1.0


def test_openmm_and_ase_see_the_same_energy_and_forces() -> None:
    import openmm

    loaded = weights()
    scene = loaded.domain.scene
    learned = LearnedForces(scene, loaded)
    energy, forces = learned(scene.positions_nm)
    system = openmm.System()
    for mass in scene.masses_da.tolist():
        system.addParticle(mass)
    system.addForce(learned.openmm_force())
    context = openmm.Context(system, openmm.VerletIntegrator(0.0005), openmm.Platform.getPlatform("Reference"))
    context.setPositions(scene.positions_nm)
    state = context.getState(energy=True, forces=True)
    assert state.getPotentialEnergy()._value == pytest.approx(energy, abs=1e-6)
    np.testing.assert_allclose(state.getForces(asNumpy=True)._value, forces, atol=1e-6)
    ase = pytest.importorskip("ase")
    atoms = ase.Atoms(list(scene.elements), positions=10.0 * scene.positions_nm, calculator=learned.ase_calculator())
    assert atoms.get_potential_energy() == pytest.approx(energy / KJ_MOL_PER_EV, rel=1e-6)
    np.testing.assert_allclose(atoms.get_forces(), 0.1 * forces / KJ_MOL_PER_EV, atol=1e-6)
    others = ase.Atoms(list(scene.elements)[::-1], positions=10.0 * scene.positions_nm)
    others.calc = learned.ase_calculator()
    with pytest.raises(InputError, match="order"):
        others.get_forces()


def test_other_weights_and_other_molecules_are_refused() -> None:
    with pytest.raises(InputError, match="frames, not forces"):
        LearnedForces(scene_from_smiles("CO"), weights(Painet(PainetConfig(n_new=2, width=16))))
    with pytest.raises(OutOfDomainError):
        LearnedForces(scene_from_smiles("CCO"), weights())


def test_a_potential_is_rolled_in_the_bath_that_is_asked_for(tmp_path: Path) -> None:
    potential = PainetPotential(replace(SMALL, n_new=2, lag_ps=0.002))
    loaded = weights(potential)
    loaded = replace(loaded, domain=replace(loaded.domain, lag_ps=0.002))
    frames = {}
    for name, asked in {
        "cold": {"temperature_k": 10.0},
        "hot": {"temperature_k": 600.0, "friction_per_ps": 2.0},
        "free": {"ensemble": "nve", "timestep_ps": 0.0005},
        "heavy": {"ensemble": "nve", "timestep_ps": 0.0005, "hydrogen_mass_da": 3.0},
    }.items():
        out = tmp_path / f"{name}.h5"
        rollout(loaded.domain.scene, loaded, [out], RolloutConfig(time_ps=0.02, guard="off", **asked))
        with open_trajectory(out) as reader:
            frames[name] = np.asarray(reader.read())
    moved = {name: np.abs(x - x[0]).max() for name, x in frames.items()}
    assert moved["hot"] > 2.0 * moved["cold"]
    assert not np.allclose(frames["free"][1:], frames["hot"][1:], atol=1e-4)
    assert not np.allclose(frames["heavy"][1:], frames["free"][1:], atol=1e-4)
    assert potential.config.temperature_k == 300.0
    with pytest.raises(InputError, match="hydrogen"):
        RolloutConfig(time_ps=0.02, hydrogen_mass_da=50.0)


def test_annealed_replicas_start_all_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = load_weights(weights_path("paracetamol-gfn2-xtb"))
    scene, methyl = loaded.domain.scene, [11, 0, 1, 2]
    asked: list[float] = []
    frames: list[int] = []

    def rolled(name: str, anneal_ps: float) -> Any:
        outs = [tmp_path / f"{name}_r{k}.h5" for k in range(4)]
        rollout(scene, loaded, outs, RolloutConfig(time_ps=0.1, guard="off", anneal_ps=anneal_ps))
        frames = [scene.positions_nm, *(open_trajectory(out).read()[0] for out in outs)]
        run = mdtraj.Trajectory(np.stack(frames), scene.to_mdtraj_topology())
        turned = np.rad2deg(mdtraj.compute_dihedrals(run, [methyl])[:, 0])
        return (turned[1:] - turned[0] + 180.0) % 360.0 - 180.0

    at = runner.ChunkSampler.at

    def at_asked(self: Any, temperature_k: float, n_new: int, friction_per_ps: float) -> Any:
        asked.append(temperature_k)
        frames.append(n_new)
        found = at(self, temperature_k, n_new, friction_per_ps)
        # 4 fs is too long where it is hot.
        assert found._model.config.timestep_ps == pytest.approx(0.0025) and self._model.config.timestep_ps == 0.004
        return found

    monkeypatch.setattr(runner.ChunkSampler, "at", at_asked)
    still = rolled("still", 0.0)
    assert np.abs(still).max() < 60.0
    turned = rolled("turned", 10.0)
    assert np.abs(turned).max() > 90.0
    assert asked[:3] == [600.0] * 3 and asked[-1] == pytest.approx(300.0) and (np.diff(asked[2:]) < 0.0).all()
    frames.clear()
    rolled("shortly", 2.0)
    assert frames == [2] * 10, "of 0.1 ps, not a whole chunk each"
    # One that flies apart starts as it was.
    draw = runner.ChunkSampler.draw
    calls = iter(range(100))

    def flying(self: Any, *given: Any) -> Any:
        drawn = draw(self, *given)
        if next(calls) == 9:
            drawn.frames_nm[1] = np.nan
        return drawn

    monkeypatch.setattr(runner.ChunkSampler, "draw", flying)
    lost = rolled("lost", 10.0)
    assert abs(lost[1]) < 60.0
    assert abs(lost[0] - turned[0]) < 1e-3
    other = weights(Painet(PainetConfig(n_new=2, width=16)))
    with pytest.raises(InputError, match="learned potentials"):
        rollout(other.domain.scene, other, [tmp_path / "x.h5"], RolloutConfig(time_ps=0.1, anneal_ps=1.0))


@pytest.mark.slow
def test_a_short_annealing_ends_as_cold_as_a_long_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = load_weights(weights_path("paracetamol-gfn2-xtb"))
    scene = loaded.domain.scene
    assert isinstance(loaded.model, PainetPotential)
    model, molecule = loaded.model, loaded.model.featurise(scene)

    def energy(anneal_ps: float) -> float:
        outs = [tmp_path / f"{anneal_ps}_r{k}.h5" for k in range(32)]
        rollout(scene, loaded, outs, RolloutConfig(time_ps=0.1, guard="off", anneal_ps=anneal_ps), overwrite=True)
        x = torch.tensor(np.stack([open_trajectory(out).read()[0] for out in outs]), dtype=torch.float64)
        return float(model.evaluate(x, molecule).energy_kj_mol.mean())

    # Of some 45 degrees of freedom, half a kT each: 56 kJ/mol above the minimum, 2 of error.
    long, short = energy(6.0), energy(1.0)
    assert abs(short - long) < 10.0
    monkeypatch.setattr(runner, "_COOLINGS", 0.0)
    try:
        hot = energy(1.0)
    except SimulationError:  # 4 fs is too long where it is hot
        hot = math.inf
    assert hot > long + 10.0, "negative control"


def test_torsion_moves_turn_what_md_does_not_and_no_frame_is_caught_for_it(tmp_path: Path) -> None:
    loaded = load_weights(weights_path("paracetamol-gfn2-xtb"))
    scene, hydroxyl = loaded.domain.scene, [5, 7, 8, 17]
    assert [scene.elements[i] for i in hydroxyl] == ["C", "C", "O", "H"]

    def rolled(name: str, moves: int) -> tuple[Any, list[Any]]:
        outs = [tmp_path / f"{name}_r{k}.h5" for k in range(8)]
        config = RolloutConfig(time_ps=1.0, guard="flag", torsion_moves=moves)
        readers = [open_trajectory(out) for out in rollout(scene, loaded, outs, config)]
        run = mdtraj.Trajectory(np.concatenate([r.read() for r in readers]), scene.to_mdtraj_topology())
        cosines = np.cos(mdtraj.compute_dihedrals(run, [hydroxyl])).reshape(8, -1)
        assert not any(r.flags.any() for r in readers)
        return cosines, [r.record for r in readers]

    still, (record, *_) = rolled("still", 0)
    assert (np.sign(still) == np.sign(still[0, 0])).all() and not any("Monte Carlo" in x for x in rollout_lines(record))
    turned, (record, *_) = rolled("turned", 5)
    assert (np.abs(np.diff(np.sign(turned), axis=1)) > 0).any(axis=1).sum() >= 4
    assert "torsions turned by Monte Carlo, 5 moves a frame: a sample of states, without kinetics" in rollout_lines(
        record
    )


def test_models_of_frames_take_no_other_bath() -> None:
    loaded = weights(Painet(PainetConfig(n_new=2, width=16)))
    # A temperature is compared with theirs, later.
    assert in_bath(loaded, {"temperature_k": 500.0}) is loaded
    with pytest.raises(InputError, match="`friction_per_ps`"):
        in_bath(loaded, {"friction_per_ps": 2.0})
    with pytest.raises(SurromdError, match="time steps"):
        in_bath(weights(), {"timestep_ps": 0.003})


def test_a_rollout_asks_the_reference_about_its_frames_and_the_comparison_reweights_them(tmp_path: Path) -> None:
    """A model that knows nothing: every difference is large, and its members differ from each other."""
    pytest.importorskip("tblite")
    torch.manual_seed(0)
    given = weights(PainetPotential(replace(SMALL, n_new=4, lag_ps=0.002)))
    bath = {"force_field": "gfn2-xtb", "solvent": "vacuum", "temperature_k": 300.0, "timestep_ps": 0.001,
            "hydrogen_mass_da": None, "constrain_hydrogens": False}  # fmt: skip
    domain = replace(given.domain, lag_ps=0.002, conditions=bath)
    frames, flags = {}, {}
    for error_kj_mol in (1e-6, 1e9):
        loaded = replace(given, domain=domain, provenance={"energy_mae": error_kj_mol, "energy_spread": error_kj_mol})
        out = tmp_path / f"{error_kj_mol}.h5"
        rollout(domain.scene, loaded, [out], RolloutConfig(time_ps=0.024, guard="off", energy_every=1))
        with open_trajectory(out) as reader:
            frames[error_kj_mol], flags[error_kj_mol] = reader.read(), np.asarray(reader.flags)
            differences = reader.scalars[DIFFERENCE_COLUMN]
    np.testing.assert_array_equal(*frames.values())
    assert np.isfinite(differences).all()
    reference, learned = Potential(domain.scene), LearnedForces(domain.scene, given)
    x = frames[1e9][1].astype(np.float64)
    assert differences[1] == pytest.approx(reference(x)[0] - learned(x)[0], abs=0.05)
    poor, fine = flags.values()
    assert (poor & np.uint16(UNSURE)).all() and not (fine & np.uint16(UNSURE | ENERGY)).any()
    # A frame that is caught already is not asked about.
    assert not (poor & np.uint16(ENERGY)).any()
    (note,) = [note for note in load_ensemble([out]).notes if "Reweighted" in note]
    assert "asked about 12 frames" in note and "of 12 frames are effective" in note


def test_energies_of_a_molecule_that_was_not_trained_on_count_from_the_start() -> None:
    """Their zero is arbitrary."""
    given = replace(weights(), provenance={"energy_mae": 1.0})
    limits = {"jump_idx": []}
    for domain, wrong in ((given.domain, [False, True]), (replace(given.domain, limits=limits), [True, True])):
        asked = replace(given, domain=domain)
        learned = LearnedForces(domain.scene, asked)
        checks = PotentialChecks(asked, SimpleNamespace(energy_kj_mol=lambda x, u=learned: u(x)[0] - 1e5))  # type: ignore[arg-type]
        frame = domain.scene.positions_nm + 1e-3 * np.arange(domain.scene.n_atoms)[:, None]
        difference = checks.difference(frame)
        assert [checks.is_wrong(difference + off) for off in (0.0, 100.0)] == wrong


@pytest.mark.parametrize(("reason", "said"), [(BLOWN_UP, "Try a shorter `timestep_ps`"), ("clash", "nothing stops it")])
def test_what_to_do_fits_why_a_rollout_stopped(reason: str, said: str) -> None:
    config, sampler = SimpleNamespace(guard="flag"), SimpleNamespace(precision=SimpleNamespace(bf16=False))
    run: Any = SimpleNamespace(plan=SimpleNamespace(config=config, weights=weights()), sampler=sampler,
                               outs=[Path("a.h5")], state=SimpleNamespace(steps=0))  # fmt: skip
    found = runner._Rollout.why_stopped(run, 0, reason)
    assert said in found and ("timestep" in found) != ("nothing stops it" in found)
