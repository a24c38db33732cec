"""Scores of peptides: the floor is MD's own scatter, the library is blind to couplings, a shift is seen."""

from __future__ import annotations

import numpy as np
import pytest

from surrogate.bench.recipes.peptide_rollouts import frame_weights
from surrogate.bench.recipes.peptide_scores import (
    FloatArray,
    Turn,
    angles,
    crossings,
    floor,
    library,
    rarely_positive,
    rebuilt,
    score,
    turns_of,
    without,
)
from surrogate.data.frames import TrainingFrames, canonicalise, quantise
from surrogate.data.splits import Split
from surrogate.models.peptides.chains import ChainCode
from surrogate.models.peptides.model import PeptideConfig
from surrogate.models.peptides.trainer import with_scale
from systems.prepare.peptide import build_peptide


def test_all_turns_of_a_pair_are_found_and_folded() -> None:
    turns = turns_of(build_peptide("ACE-PHE-ASN-NME"))
    found = {(t.residue, t.kind): t.fold for t in turns}
    assert found == {
        (0, "phi"): 1, (0, "psi"): 1, (0, "chi1"): 1, (0, "chi2"): 2,
        (1, "phi"): 1, (1, "psi"): 1, (1, "chi1"): 1, (1, "chi2"): 1,
    }  # fmt: skip


def test_angles_are_those_of_the_frames() -> None:
    scene = build_peptide("ACE-PHE-NME")
    turns = turns_of(scene)
    values = angles(turns, np.stack([scene.positions_nm, scene.positions_nm * np.array([1.0, 1.0, -1.0])]))
    assert values[0] == pytest.approx(-values[1], abs=1e-6), "a mirror image turns all signs"
    by_kind = {t.kind: np.degrees(values[0, k]) for k, t in enumerate(turns)}
    assert by_kind["phi"] == pytest.approx(-140, abs=15) and by_kind["psi"] == pytest.approx(140, abs=15)


def test_crossings_count_whole_ways_between_cores() -> None:
    run = np.radians([-80.0, -80, 10, -80, 10, 60, 60, 10, 60, -80, -80, -20])
    found = crossings([run, run[::-1]], 100.0)
    assert (found["entries"], found["exits"]) == (2, 2), "turning back on the barrier is no crossing"
    # Frames on the barrier belong to the core before: 8 and 6 are below, 4 and 5 above.
    assert found["entries_per_ns"] == pytest.approx(2 / 1.4, rel=0.01)
    assert found["exits_per_ns"] == pytest.approx(2 / 0.9, rel=0.01)
    assert crossings([np.radians([10.0, 20.0])], 1.0)["entries"] == 0


def test_a_positive_phi_that_md_hardly_enters_leaves_the_maps() -> None:
    """The first phi is entered twice in all, the second twelve times: frames with the first above 0 go, and a run that
    is mostly there goes whole."""
    turns = [Turn("phi", 0, (0, 1, 2, 3)), Turn("phi", 1, (0, 1, 2, 3)), Turn("psi", 0, (0, 1, 2, 3))]
    often = np.radians(np.tile([-60.0, -60.0, 60.0, 60.0], 6))
    seldom = np.radians(np.r_[np.full(20, -60.0), np.full(4, 60.0)])
    runs = [np.stack([seldom, often, np.arange(24.0)], axis=1)] * 2
    rare = rarely_positive(turns, runs)
    assert rare == [0]
    stuck = np.stack([np.radians(np.full(24, 60.0)), often, np.arange(24.0)], axis=1)
    found = without([*runs, stuck], rare)
    assert [len(x) for x in found] == [20, 20] and found[0][:, 2].tolist() == list(range(20))
    # Beyond the second barrier it is the far end of the strands' basin.
    assert len(without([np.radians([[170.0, 60.0, 0.0]])], rare)) == 1


def test_what_a_code_loses_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = build_peptide("ACE-SER-LEU-NME")
    frames = scene.positions_nm + np.random.default_rng(0).normal(0.0, 0.003, (5, scene.n_atoms, 3))
    known = TrainingFrames(
        scene, quantise(canonicalise(frames, scene)), np.array([0, 5]), 1.0, True, {}, (), split=Split(0.2)
    )
    config = with_scale(PeptideConfig(), [known])
    found = rebuilt(scene, frames, config)
    assert found["rmsd_angstrom_most"] < 1e-4 and found["torsions_degrees_most"] < 0.05
    decode = ChainCode.decode
    monkeypatch.setattr(ChainCode, "decode", lambda self, tokens: decode(self, tokens + 0.02))
    worse = rebuilt(scene, frames, config)
    assert worse["rmsd_angstrom"] > 0.01 and worse["torsions_degrees_most"] > 0.5


@pytest.fixture(scope="module")
def runs() -> tuple[list[FloatArray], list[FloatArray]]:
    """Truth and a source of a made-up pair: phi of the second residue follows psi of the first."""
    rng = np.random.default_rng(0)

    def coupled(n: int = 4000) -> FloatArray:
        psi = np.where(rng.random(n) < 0.5, -0.7, 2.4)
        phi = np.where(psi > 0, -2.2, -1.2) + 0.3 * rng.normal(size=n)
        return np.stack([-1.3 + 0.4 * rng.normal(size=n), psi + 0.3 * rng.normal(size=n), phi,
                         0.5 * rng.normal(size=n)], axis=1)  # fmt: skip

    return [coupled() for _ in range(3)], [coupled() for _ in range(3)]


def test_a_perfect_source_is_as_far_as_md_and_the_library_fails_on_joint_maps_alone(
    runs: tuple[list[FloatArray], list[FloatArray]],
) -> None:
    truth, source = runs
    turns = [t for t in turns_of(build_peptide("ACE-ALA-ALA-NME")) if t.kind in ("phi", "psi")]
    order = [("phi", 0), ("psi", 0), ("phi", 1), ("psi", 1)]
    turns = [next(t for t in turns if (t.kind, t.residue) == key) for key in order]
    least = floor(turns, truth)
    perfect = score(turns, truth, source, "perfect")
    assert perfect.single == pytest.approx(least.single, rel=0.25)
    assert perfect.joint == pytest.approx(least.joint, rel=0.25)
    # Monomers with the right distribution of each residue, told apart: single torsions right, the coupling lost.
    own = [[t for t in turns if t.residue == k] for k in (0, 1)]
    monomers = [np.concatenate(truth)[:, [turns.index(t) for t in some]] for some in own]
    rng = np.random.default_rng(1)
    even = [np.full(len(values), 1 / len(values)) for values in monomers]
    blind = [library(turns, monomers, even, own, 4000, rng) for _ in range(3)]
    rival = score(turns, truth, blind, "library")
    assert rival.single < 1.25 * least.single
    assert rival.joint > 2.0 * least.joint
    # Frames of seeded runs count by how likely they are: here those of the second basin alone.
    likely = [np.where(monomers[0][:, 1] > 0, 1.0, 0.0), even[1]]
    one_sided = library(turns, monomers, [likely[0] / likely[0].sum(), even[1]], own, 500, rng)
    assert (one_sided[:, 1] > 0).all()
    shifted = score(turns, truth, [x + 0.3 for x in source], "shifted")
    assert shifted.single > 3.0 * least.single


def test_seeded_runs_that_only_leave_phi_above_zero_are_weighted_by_its_free_energy() -> None:
    """Half of the runs begin on the left-handed side and are there for the first third."""
    rng = np.random.default_rng(0)
    runs = []
    for k in range(24):
        phi = np.radians(np.where(np.arange(150) < 50 * (k % 2), 55.0, -80.0) + 8.0 * rng.normal(size=150))
        runs.append(np.stack([phi, rng.uniform(-np.pi, np.pi, 150)], axis=1))
    positive = np.concatenate(runs)[:, 0] > 0
    assert frame_weights(runs, 0, 6.0)[positive].sum() == pytest.approx(np.exp(-6.0) / (1 + np.exp(-6.0)), rel=1e-3)
    assert frame_weights(runs)[positive].sum() > 0.01, "runs alone show it too often"
