"""Guards and what they do about caught frames: a scripted model with faults on purpose, real OpenMM beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from surrogate.data.weights import TrainingDomain, Weights
from surrogate.models.interface import Chunk, Molecule, Surrogate
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.guards import CAUGHT, Guard
from surrogate.sampling.interventions import none_through
from surrogate.sampling.openmm.coupling import Coupling
from surrogate.sampling.rollout_account import DRAWN_AGAIN, MD_AFTER_FAILURE, MD_BETWEEN, REPAIRED, Tally
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.chemistry.geometry import superpose
from systems.chemistry.limits import limits_from_frames
from systems.chemistry.validity import CHIRALITY, ENERGY, INVALID, geometry_from_frames
from systems.errors import InputError, SimulationError, UnknownNameError
from systems.scene import Scene
from systems.trajectory.checkpoint import frames_in
from systems.trajectory.codec import open_trajectory

LAG_PS, N_NEW = 0.1, 8
CONDITIONS = {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0, "friction_per_ps": 1.0,
              "timestep_ps": 0.004, "hydrogen_mass_da": 3.0}  # fmt: skip
# Fault: frames (n_new, n_atoms, 3) nm of one replica and its noise in, frames out.
Fault = Callable[[Tensor, Tensor], Tensor]


class Scripted(Surrogate):
    """Trembles about the last frame by 0.0005 nm; what goes wrong is written in `fault`."""

    arch: ClassVar[str] = "scripted"
    canonical = True
    n_conditioning = 1
    n_new = N_NEW
    largest_batch = 1000

    def __init__(self, fault: Fault | None = None) -> None:
        super().__init__()
        self.fault = fault
        self.rows: list[int] = []

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (N_NEW, n_atoms, 3)

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        if len(last_frames_nm) > self.largest_batch:
            raise RuntimeError("[enforce fail] DefaultCPUAllocator: not enough memory: you tried to allocate a lot")
        self.rows.append(len(last_frames_nm))
        frames = last_frames_nm[:, -1:] + 0.0005 * noise
        if self.fault is not None:
            frames = torch.stack([self.fault(x.clone(), z) for x, z in zip(frames, noise, strict=True)])
        return Chunk(frames)


def unlucky(noise: Tensor) -> bool:
    """True for half of all draws."""
    return bool(noise[0, 0, 0] > 0)


def stretch(frames: Tensor, noise: Tensor) -> Tensor:
    """In half of all draws a carbonyl bond is 0.08 nm too long, in frame 5 alone."""
    if unlucky(noise):
        step = frames[5, 5] - frames[5, 4]
        frames[5, 5] += 0.08 * step / step.norm()
    return frames


def invert(frames: Tensor, noise: Tensor) -> Tensor:
    """In half of all draws CA and its hydrogen are reflected through the plane of the other three, in frame 5 alone."""
    if unlucky(noise):
        a, b, c = frames[5, 6], frames[5, 10], frames[5, 14]
        normal = torch.linalg.cross(b - a, c - a)
        normal = normal / normal.norm()
        for atom in (8, 9):
            frames[5, atom] -= 2 * ((frames[5, atom] - a) @ normal) * normal
    return frames


def twist(frames: Tensor, noise: Tensor) -> Tensor:
    """Frame 2 is turned by 60 degrees about the first peptide bond: still trans, so that no geometry check minds."""
    axis = frames[2, 6] - frames[2, 4]
    x, y, z = (axis / axis.norm()).tolist()
    k = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = torch.eye(3) + np.sin(np.pi / 3) * k + (1 - np.cos(np.pi / 3)) * k @ k
    frames[2, 6:] = frames[2, 6] + (frames[2, 6:] - frames[2, 6]) @ rotation.T
    return frames


def scatter(frames: Tensor, noise: Tensor) -> Tensor:
    """Every frame is a cloud."""
    return 0.3 * noise


@pytest.fixture(scope="module")
def md(alanine_dipeptide: Scene) -> Iterator[np.ndarray]:
    """30 ps of MD, frames 0.1 ps apart, superposed: what the scripted model would have been trained on."""
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.config import Conditions
    from md_reference.run.engine import Engine

    with Engine(
        alanine_dipeptide, Conditions(force=ForceFieldSpec("ff14SB", "obc2", 3.0), timestep_ps=0.002, seed=3)
    ) as engine:
        engine.minimise(max_iterations=100)
        engine.thermalise()
        engine.step(1000)
        frames = []
        for _ in range(300):
            engine.step(50)
            frames.append(engine.positions())
    yield superpose(np.stack(frames), alanine_dipeptide.positions_nm, idx=alanine_dipeptide.heavy_idx)


@pytest.fixture(scope="module")
def scene(alanine_dipeptide: Scene, md: np.ndarray) -> Scene:
    return alanine_dipeptide.with_positions(md[-1] + [3.0, 0.0, -2.0])


@pytest.fixture(scope="module")
def domain(alanine_dipeptide: Scene, md: np.ndarray) -> TrainingDomain:
    geometry = geometry_from_frames(alanine_dipeptide, md)
    # The scripted model trembles less than MD moves; what is to be caught of it is its faults.
    limits = replace(limits_from_frames(alanine_dipeptide, md[:-1], md[1:]), jump_min_nm=1e-9)
    return TrainingDomain(alanine_dipeptide, LAG_PS, CONDITIONS, geometry.to_dict(), limits.to_dict())


@pytest.fixture
def short_energy_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the MD that energies are otherwise measured against."""
    from surrogate.sampling.openmm import coupling

    monkeypatch.setattr(coupling, "_SETTLE_PS", 2.0)
    monkeypatch.setattr(coupling, "_SAMPLES", 30)


def weights_of(domain: TrainingDomain, fault: Fault | None = None) -> Weights:
    return Weights(Scripted(fault), domain, {}, "scripted", Path("scripted.safetensors"))


class Rolled:
    """What a rollout left in its file."""

    def __init__(self, path: Path) -> None:
        with open_trajectory(path) as reader:
            self.frames, self.flags, self.record = reader.read(), reader.flags, dict(reader.record)
            self.marks, self.times = reader.scalars["intervention"], reader.time_ps
            self.scalars, self.scene = dict(reader.scalars), reader.scene
        self.account: dict[str, Any] = self.record["interventions"]


def roll(out: Path, scene: Scene, weights: Weights, guard: str, n_chunks: int = 4, **settings: Any) -> Rolled:
    config = RolloutConfig(time_ps=n_chunks * N_NEW * LAG_PS, guard=guard, precision="fp32", seed=4, **settings)
    rollout(scene, weights, [out], config)
    return Rolled(out)


def test_a_sound_model_is_left_alone_under_every_guard(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    frames = []
    for guard in ("off", "flag", "resample", "repair", "fallback"):
        found = roll(tmp_path / f"{guard}.h5", scene, weights_of(domain), guard)
        assert not found.marks.any() and found.account["chunks"] == 4 and found.account["chunks_caught"] == 0
        assert not (found.flags & np.uint16(CAUGHT)).any()
        frames.append(found.frames)
    assert all(np.array_equal(frames[0], other) for other in frames[1:])


def test_flag_marks_the_frame_and_changes_nothing(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, stretch), "flag")
    bad = np.flatnonzero(found.flags & np.uint16(INVALID))
    assert len(bad) and (bad % N_NEW == 5).all(), "the frames that the script breaks, and no other"
    assert not found.marks.any()
    assert found.account["chunks_caught"] == len(bad)
    assert found.account["reasons"]["bond more than 0.5 Å off"] == len(bad)
    assert found.account["bias"] == []


def test_resample_draws_again_from_the_last_valid_frame(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    flagged = roll(tmp_path / "flag.h5", scene, weights_of(domain, stretch), "flag", n_chunks=1, solver_steps=3)
    assert flagged.flags[5] & INVALID, "this seed is unlucky in its first chunk"
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, stretch), "resample")
    assert not (found.flags & np.uint16(CAUGHT)).any()
    assert np.array_equal(found.frames[:5], flagged.frames[:5]), "what was valid stays"
    assert found.marks[:N_NEW].tolist() == [0] * 5 + [DRAWN_AGAIN] * 3
    assert np.abs(found.frames[5] - found.frames[4]).max() < 0.02, "and the new frames follow from it"
    account = found.account
    assert account["draws"] >= account["chunks_caught"] >= 1
    assert account["frames"] == {"drawn again": int((found.marks == DRAWN_AGAIN).sum())}
    assert account["log"][0] == {"chunk": 0, "step": 6, "reasons": account["log"][0]["reasons"]}
    assert len(account["bias"]) == 1 and "visited less" in account["bias"][0]
    assert found.record["cost"]["network_evaluations"] == account["chunks"] + account["draws"]


def test_repair_restores_the_bond_and_leaves_the_other_frames(
    tmp_path: Path, scene: Scene, domain: TrainingDomain
) -> None:
    flagged = roll(tmp_path / "flag.h5", scene, weights_of(domain, stretch), "flag")
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, stretch), "repair")
    assert not (found.flags & np.uint16(CAUGHT)).any()
    bad = np.flatnonzero(flagged.flags & np.uint16(CAUGHT))
    assert np.array_equal(np.flatnonzero(found.marks), bad) and (found.marks[bad] == REPAIRED).all()
    good = np.delete(np.arange(len(found.frames)), bad)
    np.testing.assert_allclose(found.frames[good], flagged.frames[good], rtol=0, atol=1e-6)
    length = np.linalg.norm(found.frames[bad, 5] - found.frames[bad, 4], axis=1)
    assert np.abs(length - 0.1229).max() < 0.004, "C=O of ff14SB"
    assert np.linalg.norm(found.frames[bad] - flagged.frames[bad], axis=2).max() < 0.12
    assert found.account["seconds"]["relax"] > 0 and found.account["draws"] == 0


def test_what_cannot_be_repaired_is_drawn_again(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    flagged = roll(tmp_path / "flag.h5", scene, weights_of(domain, invert), "flag")
    assert (flagged.flags & np.uint16(CHIRALITY)).any()
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, invert), "repair")
    assert not (found.flags & np.uint16(CAUGHT)).any()
    assert found.account["draws"] > 0
    assert set(found.marks.tolist()) <= {0, DRAWN_AGAIN, REPAIRED} and DRAWN_AGAIN in found.marks


def test_fallback_runs_md_to_the_end_of_the_chunk(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    flagged = roll(tmp_path / "flag.h5", scene, weights_of(domain, stretch), "flag", n_chunks=1)
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, stretch), "fallback")
    assert not (found.flags & np.uint16(INVALID)).any()
    assert np.array_equal(found.frames[:5], flagged.frames[:5])
    assert found.marks[:N_NEW].tolist() == [0] * 5 + [MD_AFTER_FAILURE] * 3
    # The frames are MD: bonds to hydrogen have their one length, which the trembling model's have not.
    hydrogens = np.array([(i, j) for i, j in scene.bonds.tolist() if "H" in (scene.elements[i], scene.elements[j])])
    length = np.linalg.norm(found.frames[:, hydrogens[:, 0]] - found.frames[:, hydrogens[:, 1]], axis=2)
    is_md = found.marks == MD_AFTER_FAILURE
    assert np.ptp(length[is_md], axis=0).max() < 1e-5 < np.ptp(length[~is_md], axis=0).min()
    # They lie where the molecule was, and the surrogate goes on from the last of them.
    assert np.abs(found.frames.mean(axis=1) - scene.positions_nm.mean(axis=0)).max() < 0.02
    assert np.abs(found.frames[N_NEW] - found.frames[N_NEW - 1]).max() < 0.02
    again = roll(tmp_path / "b.h5", scene, weights_of(domain, stretch), "fallback")
    assert np.array_equal(again.frames, found.frames)


@pytest.mark.parametrize("guard", ["flag", "resample", "repair", "fallback"])
def test_a_wrong_model_is_stopped_within_one_chunk(
    tmp_path: Path, scene: Scene, domain: TrainingDomain, guard: str
) -> None:
    out = tmp_path / "a.h5"
    with pytest.raises(SimulationError, match=r"replica 0, in its first chunk: .*(valid|passes)"):
        roll(out, scene, weights_of(domain, scatter), guard, n_chunks=50)
    if guard == "flag":
        with open_trajectory(out) as reader:
            assert reader.record["completed"] is False
            assert reader.record["interventions"]["chunks_caught"] == 1
            assert reader.n_frames == N_NEW and (reader.flags & np.uint16(INVALID)).all()
        out.unlink()
        out.with_suffix(".pdb").unlink()
    assert list(tmp_path.iterdir()) == [], "no invalid frame is written, and no file without frames is left"


def tear(frames: Tensor, noise: Tensor) -> Tensor:
    """Two frames of every chunk have a carbonyl bond that is 0.08 nm too long."""
    for k in (2, 5):
        step = frames[k, 5] - frames[k, 4]
        frames[k, 5] += 0.08 * step / step.norm()
    return frames


@pytest.mark.parametrize(("asked", "drawn"), [(50, 8), (3, 3), (1, 1)])
def test_a_model_that_gets_no_chunk_through_does_not_end_well(
    tmp_path: Path, scene: Scene, domain: TrainingDomain, asked: int, drawn: int
) -> None:
    """None of its chunks is broken throughout, and none is whole: it stops after some, or at its end."""
    said = f"every one of {drawn} chunks was caught" if drawn > 1 else "its one chunk was caught"
    with pytest.raises(SimulationError, match=rf"{said} \((25|38) % of frames: bond .*are marked in"):
        roll(tmp_path / "a.h5", scene, weights_of(domain, tear), "flag", n_chunks=asked)
    with open_trajectory(tmp_path / "a.h5") as reader:
        assert reader.n_frames == drawn * N_NEW and reader.record["completed"] is False
        assert (reader.flags & np.uint16(INVALID)).any()
    assert roll(tmp_path / "b.h5", scene, weights_of(domain, tear), "off").record["completed"]


def test_one_chunk_got_through_and_few_frames_caught_prove_a_model() -> None:
    def tallies(chunks: int, caught: int, frames: int) -> list[Tally]:
        return [Tally(chunks, caught, frames, {"clash": frames}), Tally(chunks, chunks, frames)]

    assert none_through(tallies(8, 8, 100), 64, at_end=False) == (
        0,
        "every one of 16 chunks was caught (20 % of frames: clash)",
    )
    assert none_through(tallies(8, 7, 100), 64, at_end=True) is None
    assert none_through(tallies(7, 7, 100), 64, at_end=False) is None
    assert none_through(tallies(8, 8, 8), 64, at_end=True) is None, "a frame in each chunk of 64"
    jumping = [Tally(8, 8, 100, {"jump between frames": 100})]
    assert none_through(jumping, 16, at_end=True) is not None
    assert none_through(jumping, 16, at_end=True, may_jump=True) is None, "baselines that leap by design"


@pytest.mark.parametrize(("guard", "mark"), [("resample", DRAWN_AGAIN), ("fallback", MD_AFTER_FAILURE)])
def test_a_proven_model_is_helped_through_a_chunk_without_a_valid_frame(
    tmp_path: Path, scene: Scene, domain: TrainingDomain, guard: str, mark: int
) -> None:
    """Chunks of two frames may well have none that passes, twice; the same in the first chunk says more."""
    drawn = 0

    def scatter_some(frames: Tensor, noise: Tensor) -> Tensor:
        nonlocal drawn
        drawn += 1
        return scatter(frames, noise) if first <= drawn < first + 2 else frames

    first = 2
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, scatter_some), guard)
    assert not (found.flags & np.uint16(INVALID)).any()
    assert found.marks.tolist() == [0] * N_NEW + [mark] * N_NEW + [0] * 2 * N_NEW
    assert found.account["chunks_caught"] == 1 and found.account["draws"] == (2 if guard == "resample" else 1)
    drawn, first = 0, 1
    with pytest.raises(SimulationError, match=r"in its first chunk: two draws gave no frame that passes"):
        roll(tmp_path / "b.h5", scene, weights_of(domain, scatter_some), guard)


@pytest.mark.parametrize("arch", ["lam-slide", "painet"])
def test_random_weights_of_a_real_architecture_are_stopped(
    tmp_path: Path, scene: Scene, domain: TrainingDomain, md: np.ndarray, small_model_config: Any, arch: str
) -> None:
    from surrogate.models.lam_slide.model import LamSlide
    from surrogate.models.painet.config import PainetConfig
    from surrogate.models.painet.model import Painet

    torch.manual_seed(0)
    small = PainetConfig(n_new=N_NEW, width=16, n_heads=2, head_dim=8, n_decoder_layers=2, lag_ps=LAG_PS)
    model: Surrogate = LamSlide(small_model_config) if arch == "lam-slide" else Painet(small)
    limits = limits_from_frames(scene, md[:-1], md[1:])
    weights = replace(weights_of(domain), model=model.eval(), domain=replace(domain, limits=limits.to_dict()))
    for guard in ("flag", "repair", "fallback"):
        with pytest.raises(SimulationError, match="replica 0, in its first chunk"):
            roll(tmp_path / f"{guard}.h5", scene, weights, guard, n_chunks=50, solver_steps=2)
        assert frames_in(tmp_path / f"{guard}.h5") <= weights.model.n_new


def test_off_goes_on_whatever_comes(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    found = roll(tmp_path / "a.h5", scene, weights_of(domain, scatter), "off")
    assert len(found.frames) == 4 * N_NEW and (found.flags & np.uint16(INVALID)).all()


def test_a_rollout_with_interventions_resumes_bit_for_bit(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    for guard in ("resample", "repair", "fallback"):
        config = RolloutConfig(time_ps=6 * N_NEW * LAG_PS, guard=guard, precision="fp32", seed=4)
        outs = [tmp_path / f"{guard}_whole{k}.h5" for k in range(2)]
        rollout(scene, weights_of(domain, stretch), outs, config)

        def kill(done: int, total: int, note: str) -> None:
            if done > total // 2:
                raise MemoryError("killed")

        cut = [tmp_path / f"{guard}_cut{k}.h5" for k in range(2)]
        with pytest.raises(MemoryError):
            rollout(scene, weights_of(domain, stretch), cut, config, progress=kill, flush_every_s=0.0)
        rollout(scene, weights_of(domain, stretch), cut, config, resume=True)
        for a, b in zip(outs, cut, strict=True):
            whole, resumed = Rolled(a), Rolled(b)
            assert np.array_equal(whole.frames, resumed.frames)
            assert np.array_equal(whole.marks, resumed.marks) and whole.marks.any()
            for key in ("chunks", "chunks_caught", "frames", "reasons", "draws", "log"):
                assert whole.account[key] == resumed.account[key]


def test_a_batch_that_memory_does_not_hold_is_halved(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    config = RolloutConfig(time_ps=3 * N_NEW * LAG_PS, precision="fp32", seed=4)
    whole = [tmp_path / f"whole{k}.h5" for k in range(6)]
    rollout(scene, weights_of(domain), whole, config)
    cramped, model = weights_of(domain), Scripted()
    model.largest_batch = 2
    halved = [tmp_path / f"halved{k}.h5" for k in range(6)]
    rollout(scene, replace(cramped, model=model), halved, config)
    assert model.rows == [2, 2, 2] * 3, "six do not go, nor three; two do, from then on"
    for a, b in zip(whole, halved, strict=True):
        np.testing.assert_allclose(Rolled(a).frames, Rolled(b).frames, rtol=0, atol=2e-6)
    assert Rolled(halved[0]).record["cost"]["batch"] == 2
    model.largest_batch = 0
    with pytest.raises(SimulationError, match="memory does not suffice for one replica"):
        rollout(scene, replace(cramped, model=model), [tmp_path / "one.h5"], config)


def test_md_between_chunks_is_marked_and_takes_its_time(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    found = roll(tmp_path / "a.h5", scene, weights_of(domain), "flag", n_chunks=5, md_between_ps=0.2)
    assert np.allclose(found.times, LAG_PS * np.arange(1, 41))
    assert found.marks.tolist() == ([0] * 8 + [MD_BETWEEN] * 2) * 4
    assert not (found.flags & np.uint16(CAUGHT)).any()
    assert found.account["seconds"]["md"] > 0
    assert "mixture" in found.account["bias"][0]


def test_energies_of_every_kth_frame_catch_what_geometry_does_not(
    tmp_path: Path, scene: Scene, domain: TrainingDomain, short_energy_sample: None
) -> None:
    found = roll(tmp_path / "a.h5", scene, weights_of(domain), "flag", n_chunks=2, energy_every=3)
    energies = found.scalars["relaxed_energy_kj_mol"]
    assert np.array_equal(np.flatnonzero(np.isfinite(energies)), [2, 5, 8, 11, 14])
    assert not (found.flags & np.uint16(ENERGY)).any()
    assert found.account["seconds"]["energy limit"] > found.account["seconds"]["energy"] > 0
    # A twisted peptide bond breaks no rule of geometry, once there are no limits; its energy shows it.
    loose = weights_of(replace(domain, limits=None), twist)
    twisted = roll(tmp_path / "b.h5", scene, loose, "flag", n_chunks=1, energy_every=3)
    assert twisted.account["unchecked"] == [Guard(loose.domain).unchecked[0]]
    assert twisted.flags.tolist() == [0, 0, ENERGY, 0, 0, 0, 0, 0]
    drawn = [roll(tmp_path / f"{k}.h5", scene, loose, "flag", n_chunks=1, energy_every=k).flags[2] for k in (2, 4)]
    assert drawn == [0, 0], "only every k-th frame is looked at"


def test_md_depends_on_start_and_seed_alone(domain: TrainingDomain, md: np.ndarray, short_energy_sample: None) -> None:
    coupling = Coupling(weights_of(domain))
    first = coupling.simulate(md[0], 5, seed=1)
    coupling.simulate(md[9], 3, seed=5)
    again = coupling.simulate(md[0], 5, seed=1)
    assert np.array_equal(first.frames_nm, again.frames_nm)
    assert np.abs(coupling.simulate(md[0], 5, seed=2).frames_nm - first.frames_nm).max() > 0.01
    # Velocities belong to the last frame in its pose: a short step along them is what MD does next.
    longer = coupling.simulate(md[0], 5, seed=1)
    kinetic = 0.5 * (domain.scene.masses_da[:, None] * longer.velocities_nm_ps**2).sum()
    assert 20.0 < kinetic < 110.0, "kJ/mol; 51 degrees of freedom have 64 at 300 K, half of it right after relaxing"
    assert np.abs(domain.scene.masses_da @ longer.velocities_nm_ps).max() < 1e-6
    energies = [coupling.relax(x).potential_kj_mol for x in md[::10]]
    assert max(energies) < coupling.energy_limit_kj_mol < max(energies) + 60.0
    coupling.close()


def test_help_has_flexible_bonds_where_the_reference_had(domain: TrainingDomain, md: np.ndarray) -> None:
    flexible = {**CONDITIONS, "timestep_ps": 0.0005, "hydrogen_mass_da": None, "constrain_hydrogens": False}
    spread = []
    for conditions in (CONDITIONS, flexible):
        coupling = Coupling(weights_of(replace(domain, conditions=conditions)))
        frames = coupling.simulate(md[0], 8, seed=1).frames_nm
        coupling.close()
        to_hydrogen = [pair for pair in domain.scene.bonds.tolist() if "H" in (domain.scene.elements[k] for k in pair)]
        spread.append(max(float(np.linalg.norm(frames[:, i] - frames[:, j], axis=-1).std()) for i, j in to_hydrogen))
    assert spread[0] < 1e-5 < 1e-3 < spread[1]


def test_weights_that_name_no_force_field_cannot_be_coupled(
    tmp_path: Path, scene: Scene, domain: TrainingDomain
) -> None:
    for conditions, said in (({}, "which force_field"), ({**CONDITIONS, "force_field": "ff00"}, "ff00")):
        weights = weights_of(replace(domain, conditions=conditions))
        with pytest.raises(InputError, match=f"cannot be coupled to OpenMM.*{said}"):
            roll(tmp_path / "a.h5", scene, weights, "repair")
        assert list(tmp_path.iterdir()) == [], "refused before anything is written"


def test_some_atoms_are_written_and_all_are_computed(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    whole = roll(tmp_path / "all.h5", scene, weights_of(domain), "flag")
    heavy = roll(tmp_path / "heavy.h5", scene, weights_of(domain), "flag", atoms="heavy")
    assert np.array_equal(heavy.frames, whole.frames[:, scene.heavy_idx])
    assert heavy.scene is not None and "H" not in heavy.scene.elements and len(heavy.scene.bonds) == 9
    backbone = roll(
        tmp_path / "b.dcd", scene, weights_of(domain), "flag", select="resname ALA and (name CA or name HA)"
    )
    assert backbone.scene is not None and backbone.scene.atom_names == ("CA", "HA")
    np.testing.assert_allclose(backbone.frames, whole.frames[:, [8, 9]], rtol=0, atol=1e-6)
    assert backbone.record["selection"]["of_atoms"] == 22
    for wrong, said in (("name CA and (", "cannot be read"), ("name XX", "means no atom")):
        with pytest.raises(InputError, match=said):
            roll(tmp_path / "c.h5", scene, weights_of(domain), "flag", select=wrong)
    with pytest.raises(InputError, match="no atom"):
        roll(tmp_path / "c.h5", scene, weights_of(domain), "flag", select="element H", atoms="heavy")
    assert not (tmp_path / "c.h5").exists()


def test_far_from_the_origin_nothing_is_lost(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    """A million nm away float32 resolves 0.06 nm: frames are written about the molecule, and the record says so."""
    near = roll(tmp_path / "near.h5", scene, weights_of(domain), "flag")
    far = roll(tmp_path / "far.h5", scene.with_positions(scene.positions_nm + 1e6), weights_of(domain), "flag")
    centre = scene.positions_nm.mean(axis=0)
    np.testing.assert_allclose(far.frames, near.frames - centre, rtol=0, atol=2e-6)
    np.testing.assert_allclose(far.record["moved_nm"], -(centre + 1e6))
    assert "moved_nm" not in near.record
    sampler = ChunkSampler(weights_of(domain), precision="fp32")
    drawn = [sampler.draw((x := scene.positions_nm + d)[None, None], [5]).frames_nm[0] - d for d in (0.0, 10.0, 1e6)]
    assert drawn[0].dtype == np.float64 and x.dtype == np.float64
    np.testing.assert_allclose(drawn[1], drawn[0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(drawn[2], drawn[0], rtol=0, atol=1e-6)


def test_settings_that_cannot_be_are_refused(domain: TrainingDomain) -> None:
    for wrong, error, said in (
        ({"guard": "repare"}, UnknownNameError, "Did you mean 'repair'"),
        ({"atoms": "none"}, InputError, "all or heavy"),
        ({"energy_every": -1}, InputError, "at least 0"),
        ({"md_between_ps": -1.0}, InputError, "at least 0"),
        ({"solver_steps": 0}, InputError, "at least 1"),
    ):
        with pytest.raises(error, match=said):
            RolloutConfig(time_ps=1.0, **wrong)  # type: ignore[arg-type]
    assert Guard(domain).unchecked == ()
