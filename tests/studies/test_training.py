"""Trainings of shipped weights: which peptides, from which starts; umbrella sampling; lags."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import lag_errors
import numpy as np
import peptide_campaign
import peptide_correction
import peptide_equilibrium
import peptide_populations
import peptide_reference
import peptide_runs
import peptide_seeds
import peptide_transfer
import peptide_unseen
import peptide_water
import pytest
import torch
from peptide_correction import CELLS, Correction
from peptide_energies import trained_with, wham
from peptide_equilibrium import Equilibrium, positive_phis, set_signs, step, teach
from peptide_list import (
    FURTHER_PAIRS,
    RESIDUES,
    TEST_CHAINS,
    TEST_FREE_CHAINS,
    TEST_PAIRS,
    held_out_peptides,
    training_peptides,
    unseen_peptides,
    wide_peptides,
)
from peptide_scores import Turn, psi_crossings, turns_of

from small_scenes import beyond, rotated, with_phi_turned
from surrogate.comparison.rows.published_metrics import TABLE
from surrogate.models.architecture import weights_path
from surrogate.models.peptides.balance import Change
from surrogate.models.peptides.layout import chain_features
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.weights import Weights, load_weights, save_weights
from systems.chemistry.geometry import torsion
from systems.errors import InputError
from systems.prepare.peptide import build_peptide
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory


def test_every_residue_stands_three_times_at_either_place_of_the_capped_pairs() -> None:
    pairs = [p.residues for p in training_peptides() if p.capped and len(p.residues) == 2]
    assert len(pairs) == len(set(pairs)) == 66 + len(FURTHER_PAIRS)
    assert tuple(pairs[66:]) == FURTHER_PAIRS
    pairs = pairs[:66]
    for place in (0, 1):
        assert Counter(p[place] for p in pairs) == dict.fromkeys(RESIDUES, 3)
        assert Counter(p[place] for p in pairs[: len(RESIDUES)]) == dict.fromkeys(RESIDUES, 1)


def test_no_test_molecule_is_trained_on() -> None:
    trained = {(p.residues, p.capped) for p in training_peptides()}
    tested = {(p, True) for p in (*TEST_PAIRS, *TEST_CHAINS)} | {(p, False) for p in TEST_FREE_CHAINS}
    assert not trained & tested
    # A pair with free termini would teach the capped one, and a free chain the capped one of the same residues.
    assert not {r for r, _ in trained} & {r for r, _ in tested}


def test_no_molecule_that_tests_is_in_the_wide_campaign() -> None:
    wide, unseen = wide_peptides(), unseen_peptides()
    tested = {p.residues for p in (*unseen, *held_out_peptides()) if len(p.residues) > 1}
    assert len({p.name for p in wide}) == len(wide) == 22 + 300 + 200 + 66 + 120
    assert len({p.name for p in unseen}) == len(unseen)
    assert not {p.residues for p in wide} & tested
    assert sum(not p.capped for p in wide) == 68 + 66 + 120 and wide_peptides() == wide
    assert not any(p.capped or len(p.residues) == 2 for p in wide[-120:])
    tenth = wide[22 : 22 + 56]
    pairs = [p for p in tenth if len(p.residues) == 2]
    assert sum(p.capped for p in pairs) == 30 and 4 < sum(not p.capped for p in pairs) < 9
    assert 4 < sum(not p.capped for p in tenth if len(p.residues) > 2) < 10
    assert sum(not p.capped and len(p.residues) == 4 for p in unseen) == 12
    missing = {r for p in unseen for r in p.residues} - {r for p in wide for r in p.residues}
    assert not missing


def test_metadynamics_fills_the_basins_and_not_the_clash() -> None:
    scene = build_peptide("ACE-ALA-NME")
    frames, (free,) = peptide_seeds.metadynamics(
        scene, time_ps=80, temperature_k=500, bias_factor=8, seed=4, platform="Reference"
    )
    assert frames.shape == (80, 22, 3)
    # Minus the bias: no deeper than what was deposited, deepest in alpha and beta, and none at phi = psi = 0.
    n = len(free) - 1
    at = np.rint((np.radians([[-70, -30], [-70, 150], [0, 0]]) + np.pi) / (2 * np.pi) * n).astype(int)
    alpha, beta, clash = (free[psi, phi] for phi, psi in at)
    assert max(alpha, beta) < clash - 3.0


def test_runs_start_at_their_seeds_and_are_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alanine = replace(training_peptides()[0], n_starts=18, time_ps=3.0)
    scene = build_peptide(alanine.sequence)
    seeds = peptide_seeds.Seeds(np.stack([scene.positions_nm] * 18), ("basin",) * 17 + ("phi>0",))
    monkeypatch.setattr(peptide_runs, "_seeds", lambda *_: seeds)
    kept = peptide_runs.run_path(tmp_path, 4)
    kept.write_bytes(b"there")
    peptide_runs.simulate_peptide(tmp_path, alanine, math.inf)
    assert sorted(p.name for p in tmp_path.glob("*.h5")) == [f"run_{k:03d}.h5" for k in range(18)]
    assert kept.read_bytes() == b"there"
    with (
        open_trajectory(peptide_runs.run_path(tmp_path, 17)) as last,
        open_trajectory(tmp_path / "run_000.h5") as first,
    ):
        assert last.n_frames == first.n_frames == 3
        assert last.record["start"] == {"group": "phi>0", "index": 17, "discarded_ps": 20.0}
        assert last.record["force_field"] == "ff14SB"
        assert not np.allclose(last.read(), first.read())
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_what_is_tested_is_never_made_for_training(tmp_path: Path) -> None:
    order = peptide_runs._order()
    assert len(order) == len(training_peptides()) + len(held_out_peptides())
    assert not {p.residues for p, training in order if training and len(p.residues) > 1} & {
        p.residues for p, training in order if not training
    }


CENTRES = np.linspace(np.radians(82.0), np.radians(-185.0), 16)
STIFF = 40.0
EDGES = np.linspace(-np.pi, np.pi, 73)


def _energy(phi: np.ndarray) -> np.ndarray:
    """Two basins, the one at 60 degrees 4 kT higher, behind barriers of 12 and 20 kT."""
    return np.asarray(6.0 * (1 - np.cos(phi + 1.2)) + 4.0 * (1 - np.cos(2 * phi - 0.3)))


def _biased_draws(rng: np.random.Generator, n: int) -> np.ndarray:
    fine = np.linspace(-np.pi, np.pi, 20_001)
    rows = []
    for centre in CENTRES:
        p = np.exp(-_energy(fine) + STIFF * (np.cos(fine - centre) - 1))
        rows.append(rng.choice(fine, size=n, p=p / p.sum()))
    return np.stack(rows)


def test_wham_recovers_what_was_biased() -> None:
    draws = _biased_draws(np.random.default_rng(0), 4000)
    found = wham(draws, CENTRES, STIFF)
    fine = np.linspace(-np.pi, np.pi, 20_001)
    true = np.exp(-_energy(fine))
    ratio = np.log(true[fine < 0].sum() / true[fine > 0].sum())
    positive = np.arange(72) >= 36
    assert np.log(found[~positive].sum() / found[positive].sum()) == pytest.approx(ratio, abs=0.1)
    # What the copies show by themselves is another.
    wrong = wham(draws, CENTRES, 0.0)
    assert abs(np.log(wrong[~positive].sum() / wrong[positive].sum()) - ratio) > 0.5


def test_correlation_and_distance_of_known_processes() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=20_000)
    assert lag_errors._correlation(x, 0.6 * x + 0.8 * rng.normal(size=20_000)) == pytest.approx(0.6, abs=0.02)
    assert lag_errors._correlation(x, rng.normal(size=20_000)) == pytest.approx(0.0, abs=0.02)
    angles = rng.uniform(-np.pi, np.pi, (20_000, 2))
    assert lag_errors.joint_distance(angles, angles) == 0.0
    assert lag_errors.joint_distance(angles, 0.1 * angles) > 0.7


def processes(memory: float, shift: float, seed: int) -> list[np.ndarray]:
    """Return eight runs of two angles that move about `shift` and keep `memory` of where they were."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(8, 4000, 2))
    for k in range(1, 4000):
        x[:, k] = memory * x[:, k - 1] + math.sqrt(1 - memory**2) * x[:, k]
    return list(shift + 0.6 * x)


def all_count(runs: list[np.ndarray]) -> list[np.ndarray]:
    return [np.ones(len(x)) for x in runs]


def test_distances_over_those_of_md_itself_tell_what_is_off() -> None:
    md, like, off = processes(0.9, 0.0, 1), processes(0.9, 0.0, 2), processes(0.9, 0.1, 3)
    for measure in (peptide_unseen.single, peptide_unseen.pooled):
        own, *others = (peptide_unseen.densities(x, all_count(x)) for x in (md, like, off))
        same, shifted = (peptide_unseen.over(measure, own, x) for x in others)
        assert same[0] == pytest.approx(1.0, abs=0.1) and shifted[0] > 1.3
        assert 0.0 < same[1] < 0.2 and shifted[0] - 1.0 > 2.0 * shifted[1]
    (joint,) = peptide_unseen.joint_densities(md[:1], all_count(md[:1]), [(0, 1)])
    assert joint.shape == (1, 36 * 36) and joint.sum() == 4000


def test_a_rare_positive_phi_plays_no_part() -> None:
    md = [0.3 * x - 1.5 for x in processes(0.9, 0.0, 1)]
    md[0][:1000, 0] = 1.0
    (first, *others) = peptide_unseen.shown(md, [0])
    assert first[:1000].all() and not first[1000:].any() and not np.concatenate(others).any()
    assert len(peptide_unseen.never(md, [0])) == 7 and len(peptide_unseen.never(md, [])) == 8
    for x in md[:5]:
        x[:10, 0] = 1.0
    assert len(peptide_unseen.never(md, [0])) == 8, "too few are without"


def test_populations_by_longer_steps_are_off_beyond_what_rollouts_err_by(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def by_rollouts(weights: Weights, solvent: str, scene: Scene, folder: Path, lag_ps: float) -> tuple[Any, Any]:
        moved = {10.0: 0.0, 20.0: 0.03, 100.0: 0.1}[lag_ps] if solvent == "tip3p" else 0.0
        return [], {(1, "ψ"): (np.array([0.5 + moved, 0.5 - moved]), np.array([0.03, 0.04]) / math.sqrt(2.0))}

    monkeypatch.setattr(peptide_populations, "by_rollouts", by_rollouts)
    peptide_populations.main(["lags", str(tmp_path), "-o", str(out := tmp_path / "lags.json")])
    wet, dry = json.loads(out.read_text("utf-8"))["rows"]
    # The root of (0.1² - 0.03² + 0.1² - 0.04²) / 2.
    assert wet[1:3] == ["0.0", "9.4"] and dry[1:3] == ["0.0", "0.0"]
    assert wet[3] == "ψ of LEU in LEU-SER: 50 ± 2 and 60 ± 2" and dry[3] == ""


def test_md_of_tests_is_told_by_its_torsions(tmp_path: Path) -> None:
    """A record parts every bin of histograms as the angles do, and each molecule is built in the order of its runs."""
    scene, rng = build_peptide("ALA-GLY"), np.random.default_rng(0)
    frames = [scene.positions_nm + 0.01 * rng.normal(size=(40, scene.n_atoms, 3)) for _ in range(4)]
    turned = [rng.uniform(-np.pi, np.pi, size=(500, len(turns_of(scene)))) for _ in range(4)]
    some = peptide_reference.Reference("free-ALA-GLY", scene, "obc2", turned, np.stack([x[0] for x in frames]))
    peptide_reference.write(tmp_path / "a.npz", [some])
    (found,) = peptide_reference.references(tmp_path / "a.npz")
    assert found.scene.topology_hash == scene.topology_hash and (found.name, found.solvent) == (some.name, "obc2")
    assert found.time_ps == 5000.0 and not found.files
    np.testing.assert_allclose(found.starts_nm, some.starts_nm, atol=1e-6)
    for one, other in zip(found.torsions, turned, strict=True):
        np.testing.assert_allclose(one, other, atol=np.pi / 900 + 1e-9)
    count = [np.ones(500)] * 4
    for histograms in (peptide_unseen.densities, partial(peptide_unseen.joint_densities, pairs=[(0, 1)])):
        for one, other in zip(histograms(found.torsions, count), histograms(turned, count), strict=True):
            np.testing.assert_array_equal(one, other)
    # What is written again stays what it is.
    peptide_reference.write(tmp_path / "b.npz", [found])
    (again,) = peptide_reference.references(tmp_path / "b.npz")
    np.testing.assert_array_equal(again.torsions, found.torsions)
    with pytest.raises(InputError, match="no molecule"):
        list(peptide_reference.references(tmp_path))


def test_mdgens_recipe_is_over_a_replicate() -> None:
    scene = build_peptide("ALA-GLY-ALA-SER")
    noise = np.random.default_rng(0).normal(size=(5, 600, scene.n_atoms, 3)).cumsum(axis=1)
    runs = [scene.positions_nm + 0.02 * np.tanh(0.05 * x) for x in noise]
    stiff = [scene.positions_nm + 0.1 * (x - scene.positions_nm) for x in runs]
    same, off = (peptide_unseen.published(scene, runs, of) for of in (runs, stiff))
    assert same is not None and off is not None and same.keys() == {*TABLE}
    assert [same[name][2] for name in TABLE[:5]] == pytest.approx([1.0] * 5)
    assert off["all torsions"][2] > 1.2 and off["all torsions"][1] == same["all torsions"][1]


def test_kinetics_and_lags_are_over_those_of_md() -> None:
    md, slow = processes(0.9, 0.0, 1), processes(0.95, 0.0, 2)
    found = peptide_unseen.kinetics(md, slow, [1])
    assert found.keys() == {"ψ 1", "TICA 0", "TICA 1"}
    assert all(1.6 < x < 2.6 for x in found.values()), "(1 + a) / (1 - a) is 19 and 39"
    assert all(x == pytest.approx(1.0) for x in peptide_unseen.kinetics(md, md, [1]).values())
    two = [np.where(x > 0, 2.0, -2.0) + 0.1 * x for x in md]
    moved = [np.where(x > 0.3, 2.0, -2.0) + 0.1 * x for x in md]
    errors = peptide_unseen.lag_errors(two, two, {100.0: two, 1000.0: moved})
    assert errors["100 ps"] == 0.0 and errors["1000 ps"] > 3.0


def test_the_farthest_state_is_named_with_both_populations() -> None:
    turns = [Turn("phi", 0, (0, 1, 2, 3)), Turn("psi", 0, (0, 1, 2, 3))]
    rng = np.random.default_rng(0)

    def runs(share: float) -> list[np.ndarray]:
        sides = rng.random((8, 1000, 2)) < (0.1, share)
        return list(np.where(sides, 1.5, -1.5) + 0.2 * rng.normal(size=(8, 1000, 2)))

    md, of = runs(0.3), runs(0.6)
    found = peptide_unseen.farthest_state(turns, ["ALA"], md, of, [])
    shares = re.fullmatch(r"psi of ALA 1, -180° to 0°: (\d+) ± [01] for (\d+) ± [01] %", found)
    assert shares and abs(int(shares[1]) - 40) <= 2 and abs(int(shares[2]) - 70) <= 2
    assert peptide_unseen.farthest_state(turns, ["ALA"], md, of, [1]).startswith("phi of ALA 1, ")


def test_what_is_trained_and_measured_in_water() -> None:
    assert peptide_water.tasks(["new", "whole"], [1, 16])[:3] == [("new", 16), ("whole", 16), ("new", 1)]
    degrees = np.array([-60.0, -40, 60, -50, 150, 170, -170, 140, 20, 0, 130])
    assert psi_crossings(np.radians(degrees)) == 3, "60 and -170 degrees are in neither middle"
    counts = np.array([[30.0, 10.0], [10.0, 10.0]])
    assert peptide_water.with_error(lambda some: np.divide(*counts[some].sum(axis=0)), 2) == "2 ± 1"
    assert peptide_water.with_error(lambda some: 10.0 * len(some) + 0.1 * (0 in some), 2) == "20.10 ± 0.05"


def test_populations_are_of_weighted_frames_with_every_phi_negative_wherever_runs_begin() -> None:
    """Threonine's, whose chi1 the model tells by another atom."""
    scene = build_peptide("ACE-THR-NME")
    model = load_weights(weights_path("peptides")).model
    assert isinstance(model, PeptideSlide)
    chain = chain_features(scene, model.config)
    atoms = [scene.atom_names.index(name) for name in ("N", "CA", "CB", "OG1")]
    wanted = np.radians([60.0, 180.0, 300.0]) - torsion(scene.positions_nm[None], [atoms])[0, 0]
    side = beyond(scene, atoms[1], atoms[2])
    forms = [rotated(scene.positions_nm, side, (atoms[1], atoms[2]), turn) for turn in wanted]
    left_handed = [with_phi_turned(replace(scene, positions_nm=x)) for x in forms]
    rng, hops = np.random.default_rng(0), np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.1, 0.9]])
    orders = np.zeros((40, 31), dtype=int)  # all begin in the first; in equilibrium it has a quarter, the next a half
    for k in range(30):
        orders[:, k + 1] = [rng.choice(3, p=hops[x]) for x in orders[:, k]]
    runs = [np.stack([*(forms[x] for x in order), left_handed[order[-1]]]) for order in orders]
    factors = [np.array([*(order == 2) + 1.0, 1e3]) for order in orders]
    found = peptide_populations.populations(scene, chain, runs, factors)
    assert set(found) == {(1, "ψ"), (1, "χ1")}, "states of methyl groups are alike"
    psi, (shares, errors) = found[1, "ψ"][0], found[1, "χ1"]
    assert psi == pytest.approx([1.0, 0.0]), "the structure as built is a strand"
    assert (orders == 0).mean() > 0.4 and 0.02 < errors.max() < 0.1
    assert shares == pytest.approx([0.2, 0.4, 0.4], abs=0.08), "gauche+, trans, gauche-, which counts twice"


def test_batches_of_populations_are_taken_together(tmp_path: Path) -> None:
    record = tmp_path / "record.tsv"
    lines = ["\t".join(peptide_populations.COLUMNS), "ALA-SER\t0\t3\t2\tχ1\t50.0 30.0 20.0\t10.0 8.0 6.0",
             "ALA-SER\t1\t1\t2\tχ1\t10.0 50.0 40.0\t10.0 8.0 6.0"]  # fmt: skip
    record.write_text("\n".join(lines), "utf-8")
    rows = peptide_populations.read(record)
    (both,) = peptide_populations.together(rows)
    assert both.at == (2, "χ1") and both.ns == 4.0
    assert both.shares == pytest.approx([0.4, 0.35, 0.25])
    assert both.errors == pytest.approx(np.array([0.1, 0.08, 0.06]) * math.sqrt(10.0) / 4.0)
    # As many independent frames as err as much: of a half, 10 % is 25.
    half = rows[0]._replace(shares=np.array([0.5, 0.5]), errors=np.array([0.1, 0.1]))
    assert half.counted == pytest.approx(25.0) and half.variance(0, 1) == pytest.approx(2.0 / 13.0)
    assert half.log_ratio(np.array([1.0, 0.0]), 0, 1) == pytest.approx(math.log(0.5 / 25.5))


def test_pairs_under_an_umbrella_are_of_all_residues_and_no_test(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peptide_campaign, "recorded", lambda: {("LEU-SER", 0), ("TRP-SER", 0), ("TRP-SER", 1)})
    order = peptide_campaign.umbrella_order("tip3p")
    again = [(p.name, number) for _, p, number in order]
    assert ("VAL-ASN", 0) in again and not {("LEU-SER", 0), ("TRP-SER", 0), ("TRP-SER", 1)} & {*again}
    assert {("LEU-SER", 1), ("TRP-SER", 2)} <= {*again}
    monkeypatch.setattr(peptide_campaign, "recorded", set)
    order = [(kind, p, number) for kind, p, number in peptide_campaign.umbrella_order("tip3p") if number == 0]
    tests = [p.name for kind, p, _ in order if kind == "umbrella_test"]
    pairs = [p for kind, p, _ in order if kind == "umbrella"]
    assert tests == ["LEU-SER", "VAL-ASN"] and not set(tests) & {p.name for p in pairs}
    first = [p.residues for p in pairs[: len(RESIDUES)]]
    assert all(len({pair[place] for pair in first}) >= len(RESIDUES) - 1 for place in (0, 1))
    assert {"LEU", "SER", "VAL", "ASN"} & set(first[0])


def test_a_campaign_of_some_molecules_is_of_these_alone() -> None:
    found = peptide_campaign.batches("obc2", False, ["free-GLU-GLN-LEU-PRO", "LYS-CYS"])
    assert [(kind, p.name) for kind, p, _ in found] == [("train", "LYS-CYS"), ("test", "free-GLU-GLN-LEU-PRO")]
    assert peptide_campaign.batches("obc2", False, ()) == peptide_campaign.order("obc2")
    with pytest.raises(SystemExit, match="holds no ALA-FOO; names are like"):
        peptide_campaign.batches("obc2", True, ["ALA-FOO"])


def test_no_training_takes_what_is_tested_by(tmp_path: Path) -> None:
    for name in ("GLN-ILE", "free-GLN-ILE", "GLY-VAL"):
        (tmp_path / name / name).mkdir(parents=True)
        with pytest.raises(InputError, match="weights are tested on these residues"):
            peptide_transfer.sets_of([tmp_path / name], 16)
    orders = [peptide_campaign.order(solvent) for solvent in ("obc2", "tip3p")]
    tested = {p.residues for order in orders for kind, p, _ in order if kind == "test" and len(p.residues) > 1}
    assert not tested & {p.residues for order in orders for kind, p, _ in order if kind != "test"}
    assert trained_with({"from": {"from": {"positive_phi_kt": {"ALA": 4.0}}}}) == {"ALA": 4.0}


def test_a_correction_weighs_frames_by_their_residues_maps(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    turns = [Turn(kind, r, (0, 1, 2, 3)) for r in (0, 1) for kind in ("phi", "psi")]
    table = np.zeros((CELLS, CELLS))
    table[CELLS // 2 :] = math.log(3.0)
    correction = Correction(2.0, {"ALA": table})
    run = np.array([[-1.0, 0, 1, 0], [1.0, 0, -1, 0]])
    weights = correction.weights(turns, ["ALA", "GLY"], run)
    assert weights[1] / weights[0] == pytest.approx(3.0) and weights.mean() == pytest.approx(1.0)
    assert correction.weights(turns, ["ALA", "ALA"], run) == pytest.approx(np.ones(2))
    for place in ("there/ALA", "here/ALA", "there/ALA-GLY", "here/ALA-GLY", "there/GLY"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "run_000.h5").touch()
    maps = {"there": table + 2.0, "here": table + 1.0}
    monkeypatch.setattr(peptide_correction, "_map_and_time", lambda runs: (
        np.exp(maps[runs[0].parts[-3]]), 30.0 if "there" in runs[0].parts else 20.0))  # fmt: skip
    found = Correction.of(tmp_path / "there", tmp_path / "here")
    assert found.clock == 1.5 and found.log_ratio.keys() == {"ALA"}
    assert found.log_ratio["ALA"] == pytest.approx(np.ones((CELLS, CELLS)))


def test_steps_are_taught_to_keep_what_is_drawn_at_endless_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By other weights, by which psi of alanine is in its second state more often, and phi > 0 as free energies say."""
    some = wide_peptides()[:2]
    for name, value in {"_FRAMES": 300, "_HELD": 1, "_RATE": 2e-2, "wide_peptides": lambda: some}.items():
        monkeypatch.setattr(peptide_equilibrium, name, value)
    monkeypatch.setattr(peptide_equilibrium, "trained_with", lambda provenance: {"ALA": 2.5})
    shipped = load_weights(weights_path("peptides"))
    begun, other = (cast(PeptideSlide, load_weights(weights_path("peptides")).model) for _ in range(2))
    with torch.no_grad():
        other.jumps.of_change[0, :, 1, 0, 1] += 1.3
        other.jumps.of_change[0, :, 1, 1, 0] -= 1.3
        # By steps of 10 ps phi > 0 is too frequent, not at endless times.
        other.jumps.of_change[1, :, 0, 0, 1] -= 0.3
        other.jumps.of_change[0, :, 0, 0, 1] += 0.3 * math.log10(begun.config.forgotten_ps)
    provenance = {"umbrella_states": 5}
    save_weights(source := tmp_path / "other.safetensors", other, shipped.domain, provenance, half=True)
    found = load_weights(teach(shipped.path, tmp_path / "taught.safetensors", 1, 100, source))
    taught = cast(PeptideSlide, found.model)
    assert found.provenance["umbrella_states"] == 5 and found.provenance["from"]["hash"] == shipped.hash
    set_signs(other, ["ACE-ALA-NME"], {"ALA": 2.5})
    frames = Equilibrium.of(other, "ACE-ALA-NME", 1, 800)
    phi, psi = 0, 1

    def of(which: int, model: PeptideSlide, time_ps: float) -> tuple[float, float]:
        """How many more go to the second state than come back, and how many more of both than by the shipped ones."""
        rows, generator = torch.arange(len(frames.states)), torch.Generator().manual_seed(0)
        found = step(model, begun, frames, rows, torch.tensor([time_ps]), generator)
        return float(found.unbalanced[:, which].mean()), float(found.faster[:, which].mean())

    assert of(psi, begun, 10.0)[0] < -0.8 and of(phi, other, 10.0)[0] > 0.8
    for which in (phi, psi):
        assert abs(of(which, taught, 10.0)[0]) < 0.3 and abs(of(which, taught, 10.0)[1]) < 0.3
    endless = begun.config.forgotten_ps
    assert abs(of(psi, other, endless)[0]) < 0.3 and abs(of(psi, taught, endless)[0]) < 0.3
    assert of(psi, begun, endless)[0] < -0.8
    weights = frames.weights / frames.weights.sum()
    p = {model: float(weights @ positive_phis(model, frames, endless)[:, 0]) for model in (begun, other, taught)}
    assert -math.log(p[other] / (1 - p[other])) == pytest.approx(2.5, abs=0.1)
    assert p[begun] < 0.5 * p[other] and p[taught] == pytest.approx(p[other], rel=0.3)
    moved = {k.split(".")[0] for k, x in taught.state_dict().items() if not torch.equal(x, begun.state_dict()[k])}
    assert moved == {"jumps"}


def test_a_solvent_may_take_over_what_other_weights_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the first keeps what it has."""
    start, other = (load_weights(weights_path("peptides")) for _ in range(2))
    before, taken = cast(PeptideSlide, start.model).jumps.of_change.clone(), cast(PeptideSlide, other.model).jumps
    with torch.no_grad():
        taken.of_change += 1.0

    def as_the_first(model: PeptideSlide, _: Any) -> None:
        model.jumps_elsewhere[0].load_state_dict(model.jumps.state_dict())

    monkeypatch.setitem(peptide_transfer.LEVELS, "transfer", as_the_first)
    peptide_transfer.with_levels([], start, {}, tmp_path / "w.safetensors", "transfer", other)
    found = cast(PeptideSlide, load_weights(tmp_path / "w.safetensors").model)
    assert torch.equal(found.jumps.of_change, before)
    torch.testing.assert_close(found.jumps_elsewhere[0].of_change, before + 1.0, atol=1e-3, rtol=1e-3)
    with pytest.raises(SystemExit):
        peptide_transfer.main(["w.safetensors", "--start", "peptides", "--tuned", "pace", "--of", "peptides"])


def test_populations_are_set_once_however_many_passes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Rollouts are taken to lack what is given less what levels have added."""
    start = load_weights(weights_path("peptides"))
    model = start.model
    assert isinstance(model, PeptideSlide)
    kind = 2 + model.config.types.index("SER")
    dry, wet = ({name: x.clone() for name, x in jumps.state_dict().items()} for jumps in model.all_jumps)

    def lacking(weights: Weights, torsions: object, folder: Path) -> dict[str, list[Change]]:
        of = model.all_jumps[1].state_dict()["of_change"] - wet["of_change"]
        added = float(of[0, kind, 2, 0, 1] - of[0, kind, 2, 1, 0])
        return {"ALA-SER": [Change((kind, kind, kind), 2, (0, 1), 1.0 - added, 0.4)]}

    torsion = peptide_populations.Torsion("TYR-CYS", "", 3.0, 1, "ψ", np.array([0.5, 0.5]), np.array([0.1, 0.1]))
    monkeypatch.setattr(peptide_populations, "lacking", lacking)
    monkeypatch.setattr(peptide_populations, "learned", lambda: [torsion])
    peptide_populations.set_populations(tmp_path / "out.safetensors", start)
    found = load_weights(tmp_path / "out.safetensors")
    assert isinstance(found.model, PeptideSlide)
    moved = found.model.all_jumps[1].state_dict()["of_change"][0] - wet["of_change"][0]
    # N(1, 0.4 + 0.1) beside N(0, 0.1), half of it either way; weights are kept as float16.
    assert [float(moved[kind, 2, *way]) for way in ((0, 1), (1, 0))] == pytest.approx([1 / 12, -1 / 12], abs=0.004)
    assert all(torch.equal(x, dry[name]) for name, x in found.model.all_jumps[0].state_dict().items())
    of_tip3p = [m for m in found.domain.members if m.conditions["solvent"] == "tip3p"]
    assert sum("ACE-TYR-CYS-NME" in member.sequences for member in of_tip3p) == 1
    assert {*start.domain.names} < {*found.domain.names} and found.provenance["umbrella_ns"] == 3.0
