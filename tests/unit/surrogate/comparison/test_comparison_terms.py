"""What is compared on equal terms, and what is refused: lengths, intervals, scenes without torsions, real files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from surrogate.comparison import comparison
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.rows.rows import Options
from systems.errors import InputError
from systems.scene import Scene

ComparisonInput = tuple[Ensemble, Ensemble, Ensemble]

# Without the published recipe: it takes most of the time here and no verdict rests on it.
compare = partial(comparison.compare, options=Options(peptide_recipe=False))


def test_without_a_replicate_the_reference_is_halved_and_says_so(inputs: ComparisonInput) -> None:
    reference, candidate, _ = inputs
    found = compare(reference, [candidate])
    evaluation = found.evaluations[0]
    assert evaluation.n_frames == reference.n_frames // 2
    assert any("cut in two halves" in note for note in found.notes)
    assert any(f"the first 6 ns of {candidate.total_ps / 1000:g} ns" in note for note in evaluation.notes)
    assert evaluation.status == "indistinguishable"


def test_lengths_are_made_equal(simulate: Callable[..., Ensemble], inputs: ComparisonInput) -> None:
    reference, _, replicate = inputs
    short = simulate(9, 3_000, n_segments=3)
    evaluation = compare(reference, [short], replicate).evaluations[0]
    assert evaluation.n_frames == 3_000 and evaluation.compared_ps == 3_000.0
    assert sum("at equal length; all of it for the tests" in n for n in evaluation.notes) == 2
    found = compare(reference, [simulate(9, 300)], replicate)
    assert sum("the first 6 ns for the tests" in n for n in found.evaluations[0].notes) == 2
    assert found.options.n_permutations == 50 * 76, "as many as were used"


def test_intervals_that_differ_are_thinned_to_a_common_one(inputs: ComparisonInput) -> None:
    reference, candidate, replicate = inputs
    thin = replace(candidate, segments=[candidate.segments[0][::3]], lag_ps=3.0)
    found = compare(reference, [thin], replicate)
    assert found.lag_ps == 3.0
    assert found.evaluations[0].row("correlation_time").verdict in ("agrees", "undecided")
    assert any("one frame in 3 is used" in note for note in found.notes)


def test_what_cannot_be_compared_is_refused(inputs: ComparisonInput) -> None:
    reference, candidate, replicate = inputs
    with pytest.raises(InputError, match="at least one trajectory"):
        compare(reference, [])
    with pytest.raises(InputError, match="only 12 frames"):
        compare(reference, [replace(candidate, segments=[candidate.segments[0][:12]])], replicate)
    with pytest.raises(InputError, match="no metric 'rmsd'"):
        compare(reference, [candidate], replicate).evaluations[0].row("rmsd")


def test_an_unvisited_state_is_undecided_not_fine(simulate: Callable[..., Ensemble]) -> None:
    """With 120 frames next to nothing can be known, and the comparison says so."""
    evaluation = compare(simulate(11, 120), [simulate(12, 120)], simulate(13, 120)).evaluations[0]
    assert evaluation.row("population").verdict == "undecided"
    assert evaluation.status == "undecided" and "(20 are needed)" in evaluation.verdict
    assert f"only {evaluation.effective_samples:.2g} independent samples" in evaluation.verdict
    assert " metrics are left undecided." in evaluation.verdict
    assert not evaluation.equivalent_time_words


def methanol() -> Scene:
    """Six atoms, no torsion about a peptide bond, no stereocentre, no ring."""
    positions = [[0.0, 0, 0], [0.143, 0, 0], [-0.036, 0.103, 0], [-0.036, -0.051, 0.089], [-0.036, -0.051, -0.089],
                 [0.175, 0.09, 0]]  # fmt: skip
    return Scene(
        name="methanol",
        atom_names=("C", "O", "H1", "H2", "H3", "HO"),
        elements=("C", "O", "H", "H", "H", "H"),
        residue_of_atom=np.zeros(6, dtype=np.int64),
        residue_names=("MOH",),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 5]]),
        bond_orders=np.ones(5),
        formal_charges=np.zeros(6, dtype=np.int64),
        masses_da=np.array([12.0, 16, 1, 1, 1, 1]),
        positions_nm=np.array(positions),
    )


def small_ensemble(seed: int, width_nm: float = 0.003) -> Ensemble:
    scene = methanol()
    rng = np.random.default_rng(seed)
    frames = scene.positions_nm + width_nm * rng.standard_normal((2_000, 6, 3))
    return Ensemble(f"methanol {seed}", [frames.astype(np.float32)], 0.5, scene)


def test_a_scene_without_torsions_is_evaluated_by_what_it_has() -> None:
    good, hot = compare(small_ensemble(1), [small_ensemble(2), small_ensemble(4, 0.006)], small_ensemble(3)).evaluations
    assert good.status == "indistinguishable"
    assert hot.row("bond_width").verdict == "differs"
    reasons = dict(good.skipped)
    assert reasons["Backbone torsions φ, ψ and their basins"] == "the scene has no φ or ψ torsion"
    assert reasons["Stereocentres"] == "none among the atoms compared"
    assert any(what.startswith("TICA") for what in reasons)
    assert not any(r.group in ("populations", "kinetics") for r in good.rows)


@pytest.mark.slow
def test_replicates_pass_at_the_stated_rate(simulate: Callable[..., Ensemble]) -> None:
    """At most 5 % of fair comparisons may end in 'close' or worse; more than 7 of 50 are chance once in 80 times."""
    alarms = 0
    for seed in range(50):
        a, b, c = (simulate(1000 + 3 * seed + k, 6_000) for k in range(3))
        alarms += compare(a, [b], c).evaluations[0].status not in ("indistinguishable", "undecided")
    assert alarms <= 7


def test_real_trajectories_of_one_molecule_agree(shared_data: Path, alanine_dipeptide: Scene) -> None:
    folder = shared_data / "alanine-dipeptide"

    def load(*numbers: int) -> Ensemble:
        files = [folder / f"trajectory-{i}.dcd" for i in numbers]
        return load_ensemble(files, template=alanine_dipeptide, top=folder / "ala2.pdb", lag_ps=1.0)

    found = compare(load(1, 2), [load(3, 4)], load(5, 6))
    evaluation = found.evaluations[0]
    assert evaluation.status in ("indistinguishable", "close", "undecided")
    assert evaluation.faults[1].n_invalid == 0
    assert evaluation.row("population:ψ in the β basin").candidate.value == pytest.approx(52, abs=6)
    assert 150 < evaluation.row("correlation_time").candidate.value < 400


def test_real_torsions_equal_mdtrajs(shared_data: Path) -> None:
    """An independent implementation on real frames."""
    import mdtraj

    from surrogate.comparison.measure import kinetics, structure
    from surrogate.comparison.measure.statistics import Blocks

    folder = shared_data / "alanine-dipeptide"
    files = [folder / "trajectory-1.dcd"]
    ensemble = load_ensemble(files, top=folder / "ala2.pdb", lag_ps=1.0)
    features = structure.Baseline.of(ensemble, probing=False).measure(ensemble)
    cosine = [np.cos(x[:, 0].astype(np.float64)) for x in features.psi]
    sums = kinetics.lag_sums(cosine, Blocks.whole(features.segment_lengths), 2)
    assert kinetics.autocorrelation(sums)[1] == pytest.approx(0.987, abs=0.003)
    theirs = mdtraj.load(str(files[0]), top=str(folder / "ala2.pdb"))
    for own, compute in ((features.phi, mdtraj.compute_phi), (features.psi, mdtraj.compute_psi)):
        step = own[0][:, 0] - compute(theirs)[1][:, 0]
        assert np.abs(np.angle(np.exp(1j * step))).max() < 2e-3
