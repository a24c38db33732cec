"""The training set of the weights `peptides`: which molecules, from which starts, in which files."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.bench.recipes import peptide_runs, peptide_seeds
from surrogate.bench.recipes.peptide_list import (
    FURTHER_PAIRS,
    RESIDUES,
    TEST_CHAINS,
    TEST_FREE_CHAINS,
    TEST_PAIRS,
    held_out_peptides,
    training_peptides,
)
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import bonded_graph, turned
from systems.errors import InputError
from systems.library import named_scenes
from systems.prepare.peptide import build_peptide
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


def test_residues_are_those_that_the_library_has_capped() -> None:
    assert set(RESIDUES) == {n.split("-")[1] for n in named_scenes.names() if n.startswith("ACE-")} | {"ALA"}


def test_a_turned_peptide_bond_is_cis() -> None:
    scene = build_peptide("ACE-ALA-PRO-NME")
    proline = next(r for r in peptide_seeds.residue_torsions(scene) if r.name == "PRO")
    assert proline.omega is not None
    cis = turned(scene.positions_nm, proline.omega, np.pi, bonded_graph(scene))
    before, after = (float(torsion(x, np.array([proline.omega]))[0]) for x in (scene.positions_nm, cis))
    assert abs(np.degrees(before)) > 170
    assert abs(np.degrees(after)) < 10


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


def test_pairs_with_free_termini_are_biased_by_the_torsions_between_them() -> None:
    """The first residue has no phi and the second no psi: twelve training peptides are such."""
    free = [p for p in training_peptides() if not p.capped]
    assert len(free) == 12 and {len(p.residues) for p in free} == {2}
    scene = build_peptide(free[0].sequence)
    first, second = residues = peptide_seeds.residue_torsions(scene)
    assert first.phi is None and second.psi is None
    assert peptide_seeds.biased_torsions(residues) == [(second.phi, first.psi)]
    frames, (surface,) = peptide_seeds.metadynamics(
        scene, time_ps=20, temperature_k=500, bias_factor=8, seed=4, platform="Reference"
    )
    assert len(frames) == 20 and surface.min() < -1.0, "hills were laid"
    # What is visited has hills, and marks of barriers are where it has few.
    marks = peptide_seeds._near_barriers(frames, residues, [surface])
    assert 1 <= marks.sum() <= 10
    capped = peptide_seeds.residue_torsions(build_peptide("ACE-ALA-GLY-NME"))
    assert peptide_seeds.biased_torsions(capped) == [(r.phi, r.psi) for r in capped], "as before"
    with pytest.raises(InputError, match="no phi and psi to bias"):
        peptide_seeds.biased_torsions([first])


def test_frames_are_drawn_evenly_over_cells() -> None:
    cells = np.array([0] * 950 + [1] * 50)
    drawn = peptide_seeds._evenly(np.arange(1000), cells, 40, np.random.default_rng(0))
    assert len(set(drawn)) == 40
    assert 10 <= sum(k >= 950 for k in drawn) <= 30


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


def test_runs_for_testing_start_from_the_built_structure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peptide_runs, "TEST_DISCARD_PS", 1.0)
    alanine = replace(training_peptides()[0], n_starts=2, time_ps=2.0)
    peptide_runs.simulate_peptide(tmp_path, alanine, math.inf, seeded=False)
    with open_trajectory(peptide_runs.run_path(tmp_path, 1)) as reader:
        assert reader.record["start"] == {"group": "built", "index": 1, "discarded_ps": 1.0}
    assert not (tmp_path / "seeds.npz").exists()


def test_what_is_tested_is_never_made_for_training(tmp_path: Path) -> None:
    order = peptide_runs._order()
    assert len(order) == len(training_peptides()) + len(held_out_peptides())
    assert not {p.residues for p, training in order if training and len(p.residues) > 1} & {
        p.residues for p, training in order if not training
    }
