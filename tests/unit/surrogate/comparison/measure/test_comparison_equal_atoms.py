"""Atoms that a molecule's symmetry makes equal: which of them is called the first changes no row of structure."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from surrogate.comparison.measure.statistics import make_blocks
from surrogate.comparison.measure.structure import MAX_COLUMNS, Baseline, _foremost
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.rows import ComparisonInput, Options, Row, make_sample
from surrogate.comparison.rows.structure_rows import angle_rows, contact_rows, hydrogen_bond_rows, shape_rows
from systems.library.named_scenes import prepare
from systems.scene import Scene

METRICS = (shape_rows, angle_rows, contact_rows, hydrogen_bond_rows)
OPTIONS = Options(n_bootstrap=50, n_permutations=20)
N = 1500

Comparison = Callable[[np.ndarray], tuple[dict[str, Row], list[object]]]


@pytest.fixture(scope="module")
def glycine() -> Scene:
    """The zwitterion: three equal hydrogens that give, two equal oxygens that take."""
    return prepare("smiles:[NH3+]CC(=O)[O-]")


def rattled(scene: Scene, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = rng.normal(scale=0.03, size=(N, scene.n_atoms, 3))
    for t in range(1, N):
        noise[t] = 0.8 * noise[t - 1] + 0.6 * noise[t]
    return scene.positions_nm + noise


@pytest.fixture(scope="module")
def evaluated(glycine: Scene) -> Comparison:
    reference = Ensemble("reference", [rattled(glycine, 1).astype(np.float32)], 1.0, glycine)
    baseline = Baseline.of(reference)

    def measured(frames: np.ndarray):  # type: ignore[no-untyped-def]
        return baseline.measure(Ensemble("x", [frames.astype(np.float32)], 1.0, glycine))

    fixed = baseline.measure(reference), measured(rattled(glycine, 3))

    def compare(frames: np.ndarray) -> tuple[dict[str, Row], list[object]]:
        three = fixed[0], measured(frames), fixed[1]
        samples = [make_sample(f, make_blocks(f.segment_lengths, 100), OPTIONS, k) for k, f in enumerate(three)]
        inputs = ComparisonInput(glycine, baseline.torsions, baseline.geometry, *samples, OPTIONS)
        found = [measure(inputs) for measure in METRICS]
        return {row.key: row for rows, _, _ in found for row in rows}, [c for _, charts, _ in found for c in charts]

    return compare


def swapped(frames: np.ndarray, a: int, b: int) -> np.ndarray:
    out = frames.copy()
    out[:, [a, b]] = frames[:, [b, a]]
    return out


def givers(scene: Scene) -> list[int]:
    nitrogen = scene.elements.index("N")
    return sorted({i for bond in scene.bonds.tolist() if nitrogen in bond for i in bond if scene.elements[i] == "H"})


def bars(charts: list[object], title: str) -> tuple[tuple[str, ...], np.ndarray]:
    chart = next(c for c in charts if getattr(c, "title", "") == title)
    return chart.names, chart.lines[1].y  # type: ignore[attr-defined]


def test_two_equal_hydrogens_swapped_change_nothing(evaluated: Comparison, glycine: Scene) -> None:
    frames = rattled(glycine, 2)
    bonded = givers(glycine)[2]  # the one that lies at an oxygen
    other = swapped(frames, givers(glycine)[0], bonded)
    (plain, charts), (turned, others) = evaluated(frames), evaluated(other)
    assert "hydrogen_bond_shift" in plain
    assert set(plain) == set(turned)
    for key, row in plain.items():
        assert turned[key].candidate.value == pytest.approx(row.candidate.value, rel=1e-5), key
        assert turned[key].p_value == pytest.approx(row.p_value, rel=1e-3, abs=1e-9), key
        assert turned[key].statement == row.statement
    for title in ("Hydrogen bonds", "RMSF"):
        assert bars(charts, title)[0] == bars(others, title)[0]
        assert bars(charts, title)[1] == pytest.approx(bars(others, title)[1], rel=1e-4)
    # Negative controls: one by one they do differ, and a hydrogen of another kind is not equal to them.
    probes = Baseline.of(Ensemble("x", [frames.astype(np.float32)], 1.0, glycine)).probes
    assert probes is not None
    one_by_one = [probes.measure(x.astype(np.float32))["hydrogen_bonds"].mean(0) for x in (frames, other)]
    assert np.abs(one_by_one[0] - one_by_one[1]).max() > 0.3
    stranger = next(i for i, e in enumerate(glycine.elements) if e == "H" and i not in givers(glycine))
    wrong, _ = evaluated(swapped(frames, bonded, stranger))
    key = "hydrogen_bond_shift"
    assert abs(wrong[key].candidate.value - plain[key].candidate.value) > 1.0


def test_equal_atoms_share_a_name_and_a_bar(evaluated: Comparison, glycine: Scene) -> None:
    rows, charts = evaluated(rattled(glycine, 2))
    names, shares = bars(charts, "Hydrogen bonds")
    assert len(names) == 1 and names[0].endswith(" and 5 equal"), "three hydrogens times two oxygens"
    assert rows["hydrogen_bonds"].candidate.value == pytest.approx(6 * shares[0] / 100, rel=1e-6)
    names, fluctuations = bars(charts, "RMSF")
    assert len(names) == 4 and sum(name.endswith(" and 1 equal") for name in names) == 1
    # The mean is one of squares: over all five atoms they make the row's.
    weights = np.array([2 if name.endswith("equal") else 1 for name in names])
    assert np.sqrt((weights * fluctuations**2).sum() / 5) == pytest.approx(rows["rmsf"].candidate.value, rel=1e-6)


def test_equal_columns_are_followed_together_or_not_at_all() -> None:
    share = np.repeat(np.linspace(1.0, 0.1, 100), 3)
    groups = [np.arange(k, k + 3) for k in range(0, 300, 3)]
    left_out: list[tuple[str, str]] = []
    chosen = _foremost(share, groups, "things", left_out)
    assert MAX_COLUMNS - 3 < len(chosen) <= MAX_COLUMNS
    assert chosen.tolist() == list(range(255)) and left_out[0][1].startswith("255 of 300")
