"""`bursts` by real MD: a trajectory of the same force field passes, one that is said to be twice as fast does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surrogate import api
from systems.trajectory.codec import open_trajectory, open_writer


@pytest.mark.slow
def test_md_passes_and_md_with_a_wrong_clock_does_not(tmp_path: Path) -> None:
    """2 ns of alanine dipeptide in vacuum, whose C7eq and C5 exchange within ps."""
    made = api.reference("alanine-dipeptide", tmp_path / "md.h5", time_ps=2000.0, solvent="obc2", seed=5, quiet=True)
    right = api.bursts(made[0], n_bursts=300, burst_ps=5.0, quiet=True)
    assert right.p_value > 0.01
    with open_trajectory(made[0]) as reader:
        x, record, scene = reader.read(stride=8), dict(reader.record), reader.scene
    assert scene is not None
    with open_writer(tmp_path / "fast.h5", scene, record) as writer:
        writer.append(x, 1.0 + np.arange(len(x)))
    wrong = api.bursts(tmp_path / "fast.h5", n_bursts=200, burst_ps=5.0, quiet=True)
    assert wrong.p_value < 0.01
