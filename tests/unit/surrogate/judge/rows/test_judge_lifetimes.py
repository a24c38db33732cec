"""Hydrogen-bond lifetimes: of a chain with a known rate, across segments and blocks, and on real trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surrogate.judge.comparison import compare
from surrogate.judge.measure.statistics import Blocks, make_blocks
from surrogate.judge.read.ensemble import Ensemble, load_ensemble
from surrogate.judge.rows.motion.lifetimes import lifetime_sums
from surrogate.judge.rows.rows import Options


def chain(n: int, leave: float, enter: float, rng: np.random.Generator) -> np.ndarray:
    out = np.empty(n, dtype=bool)
    state = False
    for t, u in enumerate(rng.random(n)):
        state = u >= leave if state else u < enter
        out[t] = state
    return out


def test_a_known_rate_is_found_and_blocks_add_up() -> None:
    rng = np.random.default_rng(0)
    formed = [chain(20_000, 0.05, 0.1, rng), chain(9_000, 0.05, 0.1, rng)]
    held, broken = lifetime_sums(formed, make_blocks([20_000, 9_000], 300))
    n_events = broken.sum()
    assert held.sum() / n_events == pytest.approx(20.0, rel=4 / np.sqrt(n_events))
    whole = lifetime_sums(formed, Blocks.whole([20_000, 9_000]))
    assert held.sum() == whole[0].sum() and n_events == whole[1].sum()
    # Brute force, run by run, without the ones that the end of a segment cuts off.
    lengths = []
    for series in formed:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], series.view(np.int8), [0]])))
        lengths += [stop - start for start, stop in zip(edges[::2], edges[1::2], strict=True) if stop < len(series)]
    assert len(lengths) == n_events and np.mean(lengths) == pytest.approx(held.sum() / n_events, rel=0.01)
    shuffled = [rng.permutation(x) for x in formed]
    held, broken = lifetime_sums(shuffled, make_blocks([20_000, 9_000], 300))
    assert held.sum() / broken.sum() < 4.0, "negative control: order matters"


def test_bonds_that_never_form_or_never_break() -> None:
    for series, expected in ((np.zeros(10, dtype=bool), (0, 0)), (np.ones(10, dtype=bool), (9, 0))):
        held, broken = lifetime_sums([series], make_blocks([10], 5))
        assert (held.sum(), broken.sum()) == expected


def test_real_replicates_agree_and_a_shuffled_one_does_not(shared_data: Path) -> None:
    folder = shared_data / "alanine-dipeptide"
    top = folder / "ala2.pdb"
    runs: list[Ensemble] = [load_ensemble([folder / f"trajectory-{k}.dcd"], top=top, lag_ps=1.0) for k in (1, 2, 3)]
    frames = np.array(runs[1].segments[0])
    np.random.default_rng(0).shuffle(frames)
    shuffled = Ensemble("shuffled", [frames], 1.0, runs[1].scene)
    options = Options(n_bootstrap=100, n_permutations=50, peptide_recipe=False)
    fair, wrong = compare(runs[0], [runs[1], shuffled], runs[2], options=options).judgements
    assert fair.row("hydrogen_bond_lifetime").verdict in ("agrees", "undecided")
    row = wrong.row("hydrogen_bond_lifetime")
    assert row.verdict == "differs" and "too fast" in row.statement
    assert row.candidate.value == pytest.approx(1.0, abs=0.1), "4 % are formed: shuffled, the next frame is not"
