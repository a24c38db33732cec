"""A potential trained on many molecules: which others it covers, and when its own members refuse one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from surrogate.api import info, rollout
from surrogate.models import architecture
from surrogate.models.weights import Chemistry, Weights, load_weights, read_header, save_weights
from surrogate.sampling import domain as coverage
from surrogate.sampling.domain import choose_weights, match_domain
from surrogate.sampling.simulation import LearnedForces
from systems.errors import InputError, OutOfDomainError
from systems.library.named_scenes import prepare
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

TRUSTED = Chemistry(("C", "H", "N", "O"), 24, (-1, 0), 1e4)


@pytest.fixture(scope="module")
def alanine() -> Weights:
    return load_weights(architecture.shipped_weights()["alanine-dipeptide-gfn2-xtb"])


@pytest.fixture
def general(tmp_path: Path, alanine: Weights) -> Weights:
    """One molecule's potential that takes itself for one of many."""
    return saved(tmp_path / "general.safetensors", alanine, TRUSTED)


def saved(path: Path, weights: Weights, chemistry: Chemistry) -> Weights:
    domain = replace(weights.domain, transferable=True, chemistry=chemistry)
    save_weights(path, weights.model, domain, weights.provenance)
    return load_weights(path)


def test_a_file_keeps_what_is_covered(general: Weights, alanine: Weights) -> None:
    assert read_header(general.path).domain.chemistry == TRUSTED
    assert "molecules of C, H, N, O with up to 24 atoms, charges -1 to 0, gfn2-xtb/vacuum" in general.domain.describe()
    assert alanine.domain.chemistry is None and "chemistry" not in alanine.domain.to_dict()


@pytest.mark.parametrize(
    ("smiles", "reason"),
    [
        ("CCS", "holds S"),
        ("CC[NH3+]", "bears a charge of \\+1 e"),
        ("C[CH2]", "has an odd number of electrons"),
        ("CS[CH2]", "holds S and has an odd number of electrons"),
    ],
)
def test_other_chemistry_is_refused_and_cannot_be_forced(general: Weights, smiles: str, reason: str) -> None:
    scene = prepare(f"smiles:{smiles}")
    with pytest.raises(OutOfDomainError, match=rf"molecule: {reason}\. .*cover molecules of C, H, N, O"):
        match_domain(scene, general, force=True)


def test_more_atoms_can_be_forced(tmp_path: Path, alanine: Weights) -> None:
    scene, fewer = (
        prepare("smiles:CNC(C)=O"),
        saved(tmp_path / "fewer.safetensors", alanine, replace(TRUSTED, n_atoms=11)),
    )
    with pytest.raises(OutOfDomainError, match="size: 12 atoms; trained on up to 11"):
        match_domain(scene, fewer)
    assert [d.what for d in match_domain(scene, fewer, force=True).deviations] == ["size"]


def test_where_members_disagree_it_is_refused_with_the_spread(tmp_path: Path, alanine: Weights) -> None:
    scene = prepare("smiles:CNC(C)=O")
    strict = saved(tmp_path / "strict.safetensors", alanine, replace(TRUSTED, spread_kj_mol_nm=1.0))
    with pytest.raises(OutOfDomainError, match=r"forces differ by 1\.\d+ kJ/mol/nm in short MD; the limit is 1"):
        match_domain(scene, strict)
    (found,) = match_domain(scene, strict, force=True).deviations
    assert found.what == "spread" and found.forcible
    said = info(strict.path, "smiles:CNC(C)=O")
    assert said["covered"] == "only with force" and said["training"] == "never saw this molecule", "nor that they agree"
    # The molecule that it was trained on is never asked.
    assert match_domain(prepare("alanine-dipeptide"), strict).seen


def test_a_molecule_is_asked_once_and_again_where_it_or_the_limit_is_another(
    tmp_path: Path, alanine: Weights, general: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def agreeing(scene: Scene, model: object) -> tuple[float, int]:
        calls.append(scene.name)
        return 0.0, 0

    monkeypatch.setattr(coverage, "disagreement", agreeing)
    monkeypatch.setattr(coverage, "_doubts_of", {})
    scene = prepare("smiles:CNC(C)=O")
    strict = saved(tmp_path / "strict.safetensors", alanine, replace(TRUSTED, spread_kj_mol_nm=1.0))
    for weights in (general, general, strict):
        match_domain(scene, weights)
    match_domain(replace(scene, positions_nm=scene.positions_nm[:, ::-1].copy()), strict)
    assert len(calls) == 3
    for temperature_k in (300.0, 2000.0, 300.0, 2000.0):
        match_domain(scene, strict, temperature_k=temperature_k)
    assert len(calls) == 4, "in another bath, and what was asked in one is kept"


def test_a_molecule_that_flies_apart_is_refused(general: Weights) -> None:
    with pytest.raises(OutOfDomainError, match="spread: the molecule breaks or changes in 16 of 16 short test runs"):
        match_domain(prepare("smiles:CCO"), general)


def test_two_molecules_are_not_one(general: Weights) -> None:
    scene = prepare("smiles:CCO")
    cut = replace(scene, bonds=scene.bonds[1:], bond_orders=scene.bond_orders[1:])
    with pytest.raises(OutOfDomainError, match="molecule: is 2 molecules"):
        match_domain(cut, general, force=True)


def test_a_molecule_on_which_they_agree_is_rolled(
    tmp_path: Path, general: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coverage, "shipped_weights", lambda: {"general": general.path})
    weights, why = choose_weights(prepare("smiles:CNC(C)=O"), conditions={"force_field": "gfn2-xtb"})
    hot, _ = choose_weights(prepare("smiles:CNC(C)=O"), conditions={"force_field": "gfn2-xtb"}, temperature_k=350.0)
    assert hot.hash == general.hash and hot.model.config.temperature_k == 350.0, "a potential takes any"
    assert weights.hash == general.hash and "not in their training set" in why
    (out,) = rollout("smiles:CNC(C)=O", general.path, tmp_path / "out.h5", time_ps="2ps", quiet=True)
    with open_trajectory(out) as reader:
        assert reader.n_frames == 20 and not reader.flags.any()
    strict = saved(tmp_path / "strict.safetensors", general, replace(TRUSTED, spread_kj_mol_nm=1.0))
    monkeypatch.setattr(coverage, "shipped_weights", lambda: {"strict": strict.path})
    with pytest.raises(OutOfDomainError, match=r"no shipped weights cover .*; the limit is 1"):
        choose_weights(prepare("smiles:CNC(C)=O"), conditions={"force_field": "gfn2-xtb"})
    with pytest.raises(OutOfDomainError, match="The nearest: strict, where its level is asked for: `level='gfn2-xtb'`"):
        choose_weights(prepare("smiles:CNC(C)=O"))


def test_forces_are_those_of_the_molecule_that_is_asked_about(general: Weights) -> None:
    scene = prepare("smiles:CNC(C)=O")
    energy, forces = LearnedForces(scene, general.path)(scene.positions_nm)
    molecule = general.model.featurise(scene)
    expected = general.model.evaluate(torch.tensor(scene.positions_nm)[None], molecule)
    assert energy == pytest.approx(float(expected.energy_kj_mol), abs=0.01)
    assert forces == pytest.approx(expected.forces_kj_mol_nm[0].numpy(), abs=0.5)


def test_a_potential_is_not_taken_for_a_force_field(tmp_path: Path, general: Weights) -> None:
    with pytest.raises(InputError, match="is of gfn2-xtb; leave `level` out"):
        rollout("smiles:CNC(C)=O", general.path, tmp_path / "out.h5", time_ps="1ps", level="mm", quiet=True)
