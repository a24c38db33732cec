"""Umbrella sampling of phi: WHAM and exchanges recover a distribution that is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from surrogate.bench.recipes.peptide_energies import exchanged, free_energy_kt, known_energies, wham

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


def test_exchanges_keep_the_distribution_of_each_window() -> None:
    """Copies that are drawn anew in their windows and then exchanged have, in each window, the draws' own mean."""
    rng = np.random.default_rng(1)
    draws = _biased_draws(rng, 3000)
    held = np.arange(16)
    seen = np.empty((16, 3000))
    moved = 0
    for k in range(3000):
        angles = draws[held, k]
        new = exchanged(held, angles, CENTRES, STIFF, k % 2, rng)
        moved += int((new != held).sum())
        held = new
        assert sorted(held) == list(range(16))
        seen[held, k] = angles
    assert moved > 3000
    error = draws.std(1) * np.sqrt(2 / 3000)
    assert (np.abs(seen.mean(1) - draws.mean(1)) < 6 * error + 0.002).all()


def test_records_are_read_by_residue(tmp_path: Path) -> None:
    """Of bins 5 degrees wide, 26 lie between 0 and 130 degrees; what lies beyond belongs to the strands."""
    flat = np.ones(72)
    beyond = flat.copy()
    beyond[62:] = 100.0
    for name, population in (("VAL", flat), ("LEU", beyond)):
        record = {"sequence": f"ACE-{name}-NME", "umbrella_ps": 10.0, "umbrella 1": list(population)}
        record["umbrella 2"] = record["umbrella 1"]
        (tmp_path / f"ACE-{name}-NME-phi.json").write_text(json.dumps(record))
    found = known_energies(tmp_path)
    assert found["VAL"] == pytest.approx(np.log(46 / 26))
    assert found["LEU"] == pytest.approx(np.log(1036 / 26))
    assert free_energy_kt(flat) == pytest.approx(0.0)
    assert free_energy_kt(beyond) == pytest.approx(np.log(36 / 1026))
