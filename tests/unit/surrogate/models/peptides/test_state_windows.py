"""Windows for the probabilities of states: what is rare comes oftener, and counts so much less where it must."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from surrogate.models.peptides import subjects as state_windows
from surrogate.models.peptides.layout import PeptideConfig
from surrogate.models.peptides.subjects import PeptideSubject, StateWindows

_LENGTH = 400_000


def _subject() -> Any:
    """Two torsions in equilibrium: one is 1 % of the time in its second state, one enters it every 2000 frames."""
    rng = np.random.default_rng(0)
    states = np.zeros((_LENGTH, 2), dtype=np.int64)
    for torsion, (enter, leave) in enumerate(((0.001, 0.099), (0.0005, 0.02))):
        draws, now = rng.random(_LENGTH), 0
        for k in range(_LENGTH):
            now = int(draws[k] < enter) if now == 0 else int(draws[k] >= leave)
            states[k, torsion] = now

    def windows(n: int, _: object, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        first = torch.randint(0, _LENGTH - 4, (n, 1), generator=generator)
        return first + torch.arange(4), torch.arange(1.0, 4.0).expand(n, -1)

    stated = SimpleNamespace(residue=torch.tensor([0, 0]), slot=torch.tensor([0, 1]), n_residues=1)
    conditioning = torch.from_numpy(states)[:, None]
    return SimpleNamespace(windows=windows, states=lambda idx: conditioning[idx], chain=SimpleNamespace(stated=stated))


def test_rare_states_and_changes_come_oftener_and_probabilities_stay_what_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(state_windows, "_POOL", 100_000)
    subject = _subject()
    pool = StateWindows.of(cast(PeptideSubject, subject), PeptideConfig())
    idx, times, share = pool.draw(200_000, torch.Generator().manual_seed(1))
    assert idx.shape == (200_000, 4) and times.shape == (200_000, 3) and share.shape == (200_000, 1, 7)
    assert share[:, 0].mean(0).tolist() == pytest.approx([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0], abs=0.05)
    plain, drawn = subject.states(pool.idx)[:, :, 0], subject.states(idx)[:, :, 0]
    rare = drawn[:, 0, 0] == 1
    assert float((plain[:, 0, 0] == 1).float().mean()) < 0.013
    assert float((share[:, 0, 0] * rare).mean()) > 0.25, "windows start in the rare state"
    for torsion, state in ((0, 0), (0, 1), (1, 0), (1, 1)):
        shares, probabilities = [], []
        for found, counted in ((plain, torch.ones(len(plain))), (drawn, share[:, 0, torsion])):
            starts = (found[:, 0, torsion] == state).float()
            changes = (found[:, 1, torsion] != state) * starts
            probabilities.append(float((counted * changes).sum() / (counted * starts).sum()))
            shares.append(float(changes.sum() / starts.sum()))
        assert probabilities[1] == pytest.approx(probabilities[0], rel=0.12), (torsion, state)
        if state == 0:
            assert shares[1] > 5 * shares[0], "changes come oftener, and would be overrated if all counted alike"
