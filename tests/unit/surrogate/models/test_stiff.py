"""Stiff terms of a reference: found, drawn as wide as they should be, held rigid; torsions and broken frames stay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from impose_stiff_terms import energies
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor

from surrogate.data.features.stiff_terms import LOOKED_AT, drawn_terms, plan_terms, rigid_hydrogens, rigid_terms
from surrogate.data.frames import TrainingFrames, quantise
from surrogate.data.shipped import weights_path
from surrogate.data.weights import Weights, load_weights, save_weights
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
from surrogate.models.stiff import StiffTerms, Tree
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.errors import InputError, WeightsError
from systems.imposed import ANGLES, BONDS, RIGID_BONDS, imposed_terms
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

N = 6000
BOND_NM, ANGLE_RAD, SHIFT_RAD = 0.003, 0.05, 0.06


def _made(scene: Scene, share: float, seed: int) -> Tensor:
    """Frames `(N, n_atoms, 3)` nm: torsions anywhere, bonds to hydrogen rigid, other bonds and angles as wide as
    `share` of what they should be about means that shift with the first torsion."""
    draw = torch.Generator().manual_seed(seed)
    plan = plan_terms(scene)
    tree = Tree(plan)
    x = torch.tensor(scene.positions_nm.tolist(), dtype=torch.float64)[None].expand(N, -1, -1)
    lengths, angles, turns = (part.clone() for part in tree.measure(x))
    turns[:, tree.soft] = 6.28 * torch.rand(N, len(tree.soft), generator=draw, dtype=torch.float64) - 3.14
    heavy = torch.tensor([scene.elements[row[0]] != "H" for row in plan.rows])
    for part, width, chosen in (
        (lengths, BOND_NM, heavy),
        (angles, ANGLE_RAD, tree.bent),
        (turns, ANGLE_RAD, tree.planes),
    ):
        noise = torch.randn(N, part[:, chosen].shape[1], generator=draw, dtype=torch.float64)
        part[:, chosen] += share * width * noise
    angles[:, tree.bent] += SHIFT_RAD * turns[:, tree.soft[:1]].cos()
    return tree.place(x, lengths, angles, turns)


@pytest.fixture(scope="module")
def reference(alanine_dipeptide: Scene) -> TrainingFrames:
    positions = _made(alanine_dipeptide, 1.0, 0).numpy()
    return TrainingFrames(alanine_dipeptide, quantise(positions), np.array([0, N]), 1.0, True, {}, ())


@pytest.fixture(scope="module")
def terms(reference: TrainingFrames) -> StiffTerms:
    return drawn_terms(reference)


def _looked_at(frames: TrainingFrames) -> tuple[Scene, np.ndarray]:
    return frames.scene, frames.some_nm(LOOKED_AT)


def _off(terms: StiffTerms, x: Tensor) -> Tensor:
    lengths, angles, turns = terms.tree.measure(x)
    found = terms.tree.deviation(terms.tree.terms(lengths, angles, turns), terms.numbers["rest"])
    found[:, len(terms.tree.flexible) : -len(terms.tree.planes)] -= SHIFT_RAD * turns[:, terms.tree.soft[:1]].cos()
    return found


def test_torsions_of_the_tree_are_those_of_the_backbone(alanine_dipeptide: Scene) -> None:
    plan = plan_terms(alanine_dipeptide)
    soft = {tuple(sorted((plan.rows[k], plan.rows[k][::-1]))[0]) for k in plan.soft}
    assert {(4, 6, 8, 14), (6, 8, 14, 16)} <= soft and len(soft) == 7
    assert sorted(row[0] for row in plan.rows) == [i for i in range(22) if i != plan.rows[0][1]]


def test_too_narrow_frames_get_the_width_and_keep_their_torsions(
    reference: TrainingFrames, terms: StiffTerms, alanine_dipeptide: Scene
) -> None:
    assert sorted(terms.plan.rigid) == sorted(rigid_hydrogens(*_looked_at(reference))) and len(terms.plan.rigid) == 12
    assert terms.imposed == (RIGID_BONDS, BONDS, ANGLES)
    narrow = _made(alanine_dipeptide, 0.5, 1)
    drawn = terms.apply(narrow[None], [5])[0]
    n = len(terms.tree.flexible)
    widths = torch.full((len(terms.numbers["rest"]),), ANGLE_RAD, dtype=torch.float64)
    widths[:n] = BOND_NM
    assert (_off(terms, narrow).std(0) / widths).max() < 0.6, "what is given is too narrow"
    np.testing.assert_allclose(_off(terms, drawn).std(0) / widths, 1.0, atol=0.05)
    assert (_off(terms, drawn).mean(0) / widths).abs().max() < 0.1, "means follow the torsions"
    lengths, _, turns = terms.tree.measure(drawn)
    np.testing.assert_allclose(turns[:, terms.tree.soft], terms.tree.measure(narrow)[2][:, terms.tree.soft], atol=1e-9)
    assert (lengths[:, terms.tree.rigid] - terms.numbers["rigid_nm"]).abs().max() < 1e-12


def test_a_row_is_its_own_and_turns_with_the_molecule(terms: StiffTerms, alanine_dipeptide: Scene) -> None:
    frames = _made(alanine_dipeptide, 0.5, 2)[:12].reshape(3, 4, 22, 3)
    drawn = terms.apply(frames, [1, 2, 3])
    assert torch.equal(drawn, terms.apply(frames, [1, 2, 3])) and frames.dtype == torch.float64
    torch.testing.assert_close(terms.apply(frames[1:2], [2]), drawn[1:2], rtol=0, atol=1e-12)
    assert (terms.apply(frames, [1, 9, 3])[1] - drawn[1]).abs().max() > 1e-3
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    turn = turn * torch.linalg.det(turn)
    torch.testing.assert_close(terms.apply(frames @ turn.T + 0.3, [1, 2, 3]), drawn @ turn.T + 0.3, rtol=0, atol=1e-10)


@pytest.mark.parametrize("what", ["bond", "rigid bond", "angle"])
def test_a_frame_that_is_none_of_the_ensemble_stays_for_the_guards(
    terms: StiffTerms, alanine_dipeptide: Scene, what: str
) -> None:
    frames = _made(alanine_dipeptide, 0.5, 3)[:2]
    tree = terms.tree
    lengths, angles, turns = tree.measure(frames)
    if what == "angle":
        angles[1, tree.bent[3]] += 0.6
    else:
        lengths[1, tree.flexible[2] if what == "bond" else tree.rigid[4]] *= 1.3
    frames = tree.place(frames, lengths, angles, turns)
    drawn = terms.apply(frames[None], [0])[0]
    assert torch.equal(drawn[1], frames[1]) and not torch.equal(drawn[0], frames[0])


def test_rigid_bonds_alone_move_hydrogens_alone(reference: TrainingFrames, alanine_dipeptide: Scene) -> None:
    terms = rigid_terms(*_looked_at(reference))
    assert terms is not None and terms.imposed == (RIGID_BONDS,)
    shaken = _made(alanine_dipeptide, 1.0, 4)[:50]
    shaken = shaken + 0.0008 * torch.randn(
        shaken.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    held = terms.apply(shaken[None], [0])[0]
    hydrogen, parent = torch.tensor(terms.plan.rigid).T
    lengths = (held[:, hydrogen] - held[:, parent]).norm(dim=-1)
    assert (lengths - terms.numbers["rigid_nm"]).abs().max() < 1e-12
    assert (held - shaken).abs().sum(-1).amax(0).gt(0).nonzero()[:, 0].tolist() == sorted(hydrogen.tolist())
    broken = shaken.clone()
    broken[0, hydrogen[0]] += 0.1
    assert torch.equal(terms.apply(broken[None], [0])[0, 0], broken[0])


def test_a_reference_without_rigid_bonds_has_none(harmonic_frames: TrainingFrames) -> None:
    assert rigid_terms(*_looked_at(harmonic_frames)) is None
    assert drawn_terms(harmonic_frames).imposed == (BONDS, ANGLES)


@pytest.mark.parametrize("smiles", ["c1ccccc1", "C#CC", "O"])
def test_rings_straight_angles_and_small_molecules_are_refused(smiles: str) -> None:
    from systems.prepare.molecule import scene_from_smiles

    scene = scene_from_smiles(smiles)
    shaken = scene.positions_nm + 1e-3 * np.random.default_rng(0).normal(size=(50, scene.n_atoms, 3))
    frames = TrainingFrames(scene, quantise(shaken), np.array([0, 50]), 1.0, True, {}, ())
    with pytest.raises(InputError, match="stiff terms are modelled"):
        drawn_terms(frames)


@pytest.fixture(scope="module")
def with_terms(
    small_weights: Weights, harmonic_frames: TrainingFrames, tmp_path_factory: pytest.TempPathFactory
) -> Weights:
    terms = drawn_terms(harmonic_frames)
    out = tmp_path_factory.mktemp("stiff") / "stiff.safetensors"
    save_weights(out, small_weights.model, small_weights.domain, small_weights.provenance, stiff=terms)
    return load_weights(out)


def test_files_keep_them_and_leave_the_network_alone(
    tmp_path: Path, small_weights: Weights, with_terms: Weights, harmonic_frames: TrainingFrames
) -> None:
    terms = drawn_terms(harmonic_frames)
    assert with_terms.stiff is not None and with_terms.stiff.plan == terms.plan
    for name, values in terms.numbers.items():
        torch.testing.assert_close(with_terms.stiff.numbers[name], values, rtol=1e-6, atol=1e-9)
    before, after = load_file(small_weights.path), load_file(with_terms.path)
    assert all(torch.equal(after[name], values) for name, values in before.items())
    half = tmp_path / "half.safetensors"
    save_weights(half, with_terms.model, with_terms.domain, {}, stiff=with_terms.stiff, half=True)
    assert {v.dtype for k, v in load_file(half).items() if k.startswith("stiff.")} == {torch.float32}
    torch.testing.assert_close(load_weights(half).stiff.numbers, with_terms.stiff.numbers)  # type: ignore[union-attr]
    with safe_open(small_weights.path, framework="pt") as handle:
        assert '"stiff"' not in handle.metadata()["surromd"]


def test_a_file_that_lacks_some_is_damaged(tmp_path: Path, with_terms: Weights) -> None:
    assert with_terms.stiff is not None
    numbers = {name: v for name, v in with_terms.stiff.numbers.items() if name != "root"}
    out = tmp_path / "cut.safetensors"
    save_weights(out, with_terms.model, with_terms.domain, {}, stiff=replace(with_terms.stiff, numbers=numbers))
    with pytest.raises(WeightsError, match="not whole"):
        load_weights(out)


def test_rollouts_of_shipped_weights_are_as_wide_as_md_and_say_what_is_imposed(
    tmp_path: Path, alanine_dipeptide: Scene
) -> None:
    """MD's flexible bonds vary by 0.0278 Å, those of the network alone by 0.022; hydrogens keep their distance."""
    shipped = load_weights(weights_path("alanine-dipeptide"))
    without = replace(shipped, stiff=None)
    assert shipped.stiff is not None

    def roll(name: str, weights: Weights, stiff: str | None) -> tuple[np.ndarray, tuple[str, ...]]:
        outs = [tmp_path / f"{name}{k}.h5" for k in range(8)]
        rollout(alanine_dipeptide, weights, outs, RolloutConfig(time_ps=31.0, solver_steps=5, stiff=stiff))
        found = []
        for out in outs:
            with open_trajectory(out) as reader:
                found.append(reader.read())
                said = imposed_terms(reader.record)
        return np.concatenate(found).astype(np.float64), said

    modelled, none = roll("modelled", shipped, "modelled")
    plain, also_none = roll("plain", without, None)
    assert np.array_equal(modelled, plain) and none == also_none == ()
    imposed, said = roll("imposed", shipped, None)
    assert said == (RIGID_BONDS, BONDS, ANGLES)
    tree, rigid_nm = shipped.stiff.tree, shipped.stiff.numbers["rigid_nm"]
    widths, held = [], []
    for frames in (modelled, imposed):
        lengths = tree.measure(torch.from_numpy(frames))[0]
        widths.append(10.0 * float(lengths[:, tree.flexible].var(0).mean().sqrt()))
        held.append(float(((lengths[:, tree.rigid] - rigid_nm).abs() < 1e-6).all(1).double().mean()))
    assert widths[0] < 0.025 and widths[1] == pytest.approx(0.0278, rel=0.05)
    # But for a frame that is no frame of the ensemble.
    assert held[0] == 0.0 and held[1] > 0.98
    # The median energy of MD's frames; a network that is too narrow is as if it were colder.
    off = [abs(float(np.median(energies(alanine_dipeptide, shipped.domain.conditions, x))) + 83.5)
           for x in (modelled, imposed)]  # fmt: skip
    assert off[0] > 6.0 and off[1] < 4.0
    with pytest.raises(InputError, match="no stiff terms"):
        roll("none", without, "imposed")
    with pytest.raises(InputError, match="choose modelled or imposed"):
        RolloutConfig(time_ps=1.0, stiff="drawn")


def test_training_measures_them(tmp_path: Path, reference: TrainingFrames, small_model_config: LamSlideConfig) -> None:
    few = replace(reference, coordinates=reference.coordinates[:600], starts=np.array([0, 600]))
    found = {}
    for stiff in ("held", "drawn", "modelled"):
        config = TrainingConfig(stage_one_steps=1, stage_two_steps=1, stage_one_batch=4, stage_two_batch=2, bf16=False,
                                stiff=stiff)  # fmt: skip
        out = tmp_path / f"{stiff}.safetensors"
        found[stiff] = load_weights(train_lam_slide(few, out, small_model_config, config))
    assert found["modelled"].stiff is None
    assert found["held"].stiff is not None and found["held"].stiff.imposed == (RIGID_BONDS,)
    assert found["drawn"].stiff is not None and found["drawn"].stiff.imposed == (RIGID_BONDS, BONDS, ANGLES)
    with pytest.raises(InputError, match="choose held, drawn or modelled"):
        TrainingConfig(stiff="imposed")
