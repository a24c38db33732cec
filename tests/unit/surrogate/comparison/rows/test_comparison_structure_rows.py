"""Structure beyond phi and psi: a replicate passes, and every wrong trajectory offends the row that it should."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from small_scenes import beyond
from small_scenes import turn_frames as turn
from surrogate.comparison.equivalent_time import EquivalentTime, equivalent_time_charts
from surrogate.comparison.measure.statistics import make_blocks
from surrogate.comparison.measure.structure import Baseline, Features, _ends, backbone
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.rows import ComparisonInput, Options, Row, make_sample
from surrogate.comparison.rows.structure_rows import angle_rows, contact_rows, hydrogen_bond_rows, shape_rows
from surrogate.comparison.rows.torsion_rows import other_torsion_rows
from surrogate.comparison.verdict import evaluated_rows
from systems.chemistry.graph import backbone_torsions

METRICS = (shape_rows, angle_rows, other_torsion_rows, contact_rows, hydrogen_bond_rows)
OPTIONS = Options(n_bootstrap=100, n_permutations=2000)
BAD = ("differs", "fails")
N = 4000

Comparison = Callable[[np.ndarray], dict[str, Row]]


@pytest.fixture(scope="module")
def ensembles(simulate: Callable[..., Ensemble]) -> tuple[Ensemble, Ensemble, Ensemble]:
    return simulate(51, N), simulate(52, N), simulate(53, N)


@pytest.fixture(scope="module")
def evaluated(ensembles: tuple[Ensemble, Ensemble, Ensemble]) -> Comparison:
    """Rows by key of the candidate's frames, words included, between reference and replicate."""
    reference = ensembles[0]
    baseline = Baseline.of(reference)

    def measured(ensemble: Ensemble, frames: np.ndarray | None = None):  # type: ignore[no-untyped-def]
        made = ensemble if frames is None else Ensemble("wrong", [frames.astype(np.float32)], 1.0, ensemble.scene)
        return baseline.measure(made)

    fixed = measured(ensembles[0]), measured(ensembles[2])

    def compare(frames: np.ndarray) -> dict[str, Row]:
        three = fixed[0], measured(ensembles[1], frames), fixed[1]
        samples = [make_sample(f, make_blocks(f.segment_lengths, 200), OPTIONS, k) for k, f in enumerate(three)]
        inputs = ComparisonInput(reference.scene, baseline.torsions, baseline.geometry, *samples, OPTIONS)
        return {row.key: row for row in evaluated_rows([r for measure in METRICS for r in measure(inputs).rows])}

    return compare


@pytest.fixture(scope="module")
def fair(evaluated: Comparison, ensembles: tuple[Ensemble, Ensemble, Ensemble]) -> dict[str, Row]:
    return evaluated(ensembles[1].segments[0][:])


def frames_of(ensembles: tuple[Ensemble, Ensemble, Ensemble]) -> np.ndarray:
    return np.array(ensembles[1].segments[0][:], dtype=np.float64)


def test_an_equally_good_trajectory_passes(fair: dict[str, Row]) -> None:
    assert {r.verdict for r in fair.values()} <= {"agrees", "undecided"}, {
        k: r.verdict for k, r in fair.items() if r.verdict in BAD
    }
    expected = {"rg_mean", "rg_jsd", "rmsd_jsd", "end_to_end_mean", "rmsf", "angle_shift", "angle_jsd",
                "torsions_jsd:ω", "torsions_jsd:rotor", "contacts", "contact_shift"}  # fmt: skip
    assert expected <= set(fair)


def test_two_percent_larger_is_seen_in_size(
    evaluated: Comparison, ensembles: tuple[Ensemble, Ensemble, Ensemble]
) -> None:
    found = evaluated(frames_of(ensembles) * 1.05)
    assert found["rg_mean"].verdict in BAD and "instead of" in found["rg_mean"].statement
    assert found["rg_mean"].candidate.value == pytest.approx(1.05 * found["rg_mean"].reference.value, rel=5e-3)  # type: ignore[union-attr]
    assert found["rg_jsd"].verdict in BAD
    assert found["angle_shift"].verdict == "agrees", "angles do not change with size"


def test_an_angle_opened_by_four_degrees_is_named(
    evaluated: Comparison, ensembles: tuple[Ensemble, Ensemble, Ensemble], fair: dict[str, Row]
) -> None:
    x, scene = frames_of(ensembles), ensembles[0].scene
    n, ca, c, _ = backbone_torsions(scene)["psi"][0].tolist()
    atoms = beyond(scene, ca, c)
    normal = np.cross(x[:, n] - x[:, ca], x[:, c] - x[:, ca])
    ghost = np.concatenate([x, (x[:, ca] + normal / np.linalg.norm(normal, axis=1, keepdims=True))[:, None]], axis=1)
    shifted = ghost.copy()
    shifted[:, atoms] -= x[:, ca][:, None]
    pivot = np.concatenate([np.zeros((len(x), 1, 3)), (ghost[:, -1] - x[:, ca])[:, None], shifted[:, atoms]], axis=1)
    axis = pivot[:, 1]
    v = pivot[:, 2:]
    cos, sin = np.cos(np.radians(4.0)), np.sin(np.radians(4.0))
    k = axis[:, None]
    x[:, atoms] = v * cos + np.cross(k, v) * sin + k * (k * v).sum(-1, keepdims=True) * (1 - cos) + x[:, ca][:, None]
    found = evaluated(x)
    assert found["angle_shift"].verdict in BAD
    assert found["angle_shift"].candidate.value == pytest.approx(4.0, abs=0.3)
    assert "N-CA-C (ALA 2)" in found["angle_shift"].statement and "° instead of" in found["angle_shift"].statement
    assert found["angle_jsd"].candidate.value > 1.5 * fair["angle_jsd"].candidate.value


def test_rotors_may_jump_but_not_stand_between(
    evaluated: Comparison, ensembles: tuple[Ensemble, Ensemble, Ensemble], fair: dict[str, Row]
) -> None:
    """Methyl turned by 120° in random frames is the same molecule; by 60° it is eclipsed."""
    scene = ensembles[0].scene
    ca, cb = (scene.atom_names.index(name) for name in ("CA", "CB"))
    atoms = beyond(scene, ca, cb)
    rng = np.random.default_rng(3)
    same, wrong = frames_of(ensembles), frames_of(ensembles)
    turn(same, ca, cb, atoms, rng.integers(0, 3, N) * 2 * np.pi / 3)
    turn(wrong, ca, cb, atoms, np.full(N, np.pi / 3))
    # The toy's methyl is not ideal: 120° of turning is 120° of torsion to within a degree or two.
    assert evaluated(same)["torsions_jsd:rotor"].verdict in ("agrees", "close")
    found = evaluated(wrong)["torsions_jsd:rotor"]
    assert found.verdict in BAD and found.candidate.value > 3 * fair["torsions_jsd:rotor"].candidate.value


def test_a_flipped_peptide_bond_shows_in_omega(
    evaluated: Comparison, ensembles: tuple[Ensemble, Ensemble, Ensemble]
) -> None:
    x, scene = frames_of(ensembles), ensembles[0].scene
    _, c, n, _ = backbone_torsions(scene)["omega"][1].tolist()
    part = x[::20].copy()
    turn(part, c, n, beyond(scene, c, n), np.full(len(part), np.pi))
    x[::20] = part
    assert evaluated(x)["torsions_jsd:ω"].verdict in BAD


def test_noise_shows_in_angles_and_fluctuations(
    evaluated: Comparison, ensembles: tuple[Ensemble, Ensemble, Ensemble]
) -> None:
    x = frames_of(ensembles)
    found = evaluated(x + 0.005 * np.random.default_rng(4).standard_normal(x.shape))
    assert found["angle_jsd"].verdict in BAD
    assert found["angle_shift"].verdict in ("agrees", "close"), "noise widens, and shifts little"


def test_the_shape_of_one_basin_only(evaluated: Comparison, ensembles: tuple[Ensemble, Ensemble, Ensemble]) -> None:
    """Frames of the extended states alone: size, contacts and fluctuation all say so."""
    from systems.chemistry.geometry import torsion

    x, scene = frames_of(ensembles), ensembles[0].scene
    phi = torsion(x, backbone(scene).phi)[:, 0]
    left = np.flatnonzero(phi > 0)
    found = evaluated(x[left][np.arange(N) % len(left)])
    for key in ("end_to_end_mean", "end_to_end_jsd", "contact_shift", "rmsd_jsd"):
        assert found[key].verdict in BAD, key


def test_one_exploded_frame_drowns_nothing(
    evaluated: Comparison, ensembles: tuple[Ensemble, Ensemble, Ensemble], fair: dict[str, Row]
) -> None:
    x = frames_of(ensembles)
    x[1234] *= 1e5
    x[77] = np.nan
    found = evaluated(x)
    for key in ("rg_mean", "end_to_end_mean", "rmsf", "angle_shift", "contacts"):
        assert found[key].verdict == fair[key].verdict, key
        assert found[key].candidate.value == pytest.approx(fair[key].candidate.value, rel=0.02, abs=0.02)


def test_hydrogen_bonds_that_are_never_formed_are_missed(ensembles: tuple[Ensemble, Ensemble, Ensemble]) -> None:
    """Formed 30 % of the time in the reference, as often in a fair candidate, never in a wrong one."""
    reference = ensembles[0]
    baseline = Baseline.of(reference)
    plain = baseline.measure(reference)
    rng = np.random.default_rng(6)

    def with_bonds(share: float) -> Features:
        formed = np.zeros((N, 4), dtype=bool)
        formed[:, 2] = rng.random(N) < share
        return replace(plain, series={**plain.series, "hydrogen_bonds": [formed]})

    def rows(share: float) -> dict[str, Row]:
        three = with_bonds(0.3), with_bonds(share), with_bonds(0.3)
        samples = [make_sample(f, make_blocks(f.segment_lengths, 200), OPTIONS, k) for k, f in enumerate(three)]
        found, charts, _ = hydrogen_bond_rows(
            ComparisonInput(reference.scene, baseline.torsions, baseline.geometry, *samples, OPTIONS)
        )
        assert len(charts) == 1
        return {row.key: row for row in evaluated_rows(found)}

    key = "hydrogen_bond_shift"
    assert set(rows(0.3)) == {"hydrogen_bonds", key}
    assert {r.verdict for r in rows(0.3).values()} == {"agrees"}
    wrong = rows(0.0)
    assert {r.verdict for r in wrong.values()} == {"differs"}
    assert "N-H (NME 3) ... O (ACE 1): 0 % instead of" in wrong[key].statement


def test_a_ring_puckers_as_often_as_in_the_reference() -> None:
    """Tetrahydropyran's two chairs: half of the time each, or one of them rarely."""
    from systems.library.named_scenes import prepare
    from systems.prepare.ring_conformers import ring_conformers

    scene = prepare("smiles:C1CCOCC1")
    forms = np.stack(ring_conformers(scene)[:2])

    def run(seed: int, share: float) -> Ensemble:
        rng = np.random.default_rng(seed)
        x = forms[(rng.random(1000) < share).astype(int)]
        return Ensemble("x", [(x + rng.normal(0, 0.003, x.shape)).astype(np.float32)], 1.0, scene)

    baseline = Baseline.of(run(1, 0.5))
    for share, words in ((0.5, ("agrees",)), (0.04, BAD)):
        three = [baseline.measure(run(k, s)) for k, s in ((1, 0.5), (2, share), (3, 0.5))]
        samples = [make_sample(f, make_blocks(f.segment_lengths, 20), OPTIONS, k) for k, f in enumerate(three)]
        inputs = ComparisonInput(scene, baseline.torsions, baseline.geometry, *samples, OPTIONS)
        (row,) = (r for r in evaluated_rows(other_torsion_rows(inputs).rows) if r.key == "torsions_jsd:ring")
        assert row.verdict in words and row.metric == "Ring puckers, distance"


def test_ends_are_those_of_the_chain() -> None:
    from systems.library.named_scenes import prepare

    scene = prepare("sequence:ACE-LYS-ALA-ARG-NME")
    ends = _ends(scene)
    assert ends is not None and [scene.atom_names[i] for i in ends] == ["CA", "CA"]


def test_a_long_side_chain_is_no_end_of_a_short_chain() -> None:
    """Lysine between caps: longest along its side chain; its ends are the caps'. A drug has no side chains."""
    from systems.library.named_scenes import prepare
    from systems.prepare.peptide import build_peptide

    scene = build_peptide("ACE-LYS-NME")
    ends = _ends(scene)
    assert ends is not None
    assert {scene.residue_names[scene.residue_of_atom[i]] for i in ends} == {"ACE", "NME"}
    assert _ends(prepare("smiles:CCCCCC")) is not None


def test_an_interval_says_where_md_at_hand_ends() -> None:
    errors = (1.0, 0.1)
    equivalent_time = EquivalentTime(
        "x", "distribution", "x", 3400.0, 380.0, None, "", 0.1, (80.0, 1e4), errors, errors, errors
    )
    assert equivalent_time.in_words() == "3.4 ns [380 ps, > 10 ns]"
    assert replace(equivalent_time, high_ps=23_997.0).in_words() == "3.4 ns [380 ps, 24 ns]"
    assert (
        replace(equivalent_time, equivalent_ps=690.0, low_ps=41.0, high_ps=820.0).in_words() == "690 ps [41 ps, 820 ps]"
    )
    assert equivalent_time_charts([equivalent_time])[0].x_label == "length of MD / ns"
    short = replace(equivalent_time, lengths_ps=(0.04, 5.0))
    assert equivalent_time_charts([short])[0].x_label == "length of MD / ps", "no row of noughts below the axis"
