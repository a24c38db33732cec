"""What `reproduce` can be told; light to import (`systems.options`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from surrogate.verbs.options import Quiet, Resuming, Seeded
from systems.options import option

_SIZE = "Trajectories (md17: windows of each molecule), instead of the published number."


@dataclass(frozen=True, kw_only=True)
class ReproduceOptions(Seeded, Resuming, Quiet):
    """What `reproduce` can be told."""

    budget_s: float = option("Wall time of each method's training.", 600.0)
    methods: Sequence[str] | None = option(
        "Only this; may be repeated. Baselines, egnn, lam-slide, lam-slide-particles, and (n-body) pair-forces.",
        None,
        words=("method",),
    )
    n_train: int | None = option(_SIZE, None, within=(2, None), words=("train",))
    n_test: int | None = option(_SIZE, None, within=(2, None), words=("test",))
    n_validation: int | None = option(
        "The same.", None, within=(2, None), words=("validation",), unset="a tenth of the test's; md17: as the test's"
    )
    plain: bool = option("Leave out what goes beyond the papers: all that can be left out.", False)
    without: Sequence[str] | None = option(
        "Leave out: extrapolate, any-start, from-velocity, canonical, predicted-only, mirrored, pair-messages. "
        "Value to try; repeatable.",
        None,
    )
    clean_conditioning: bool = option("md17: LaM-SLidE computes given frames once a chunk.", False)
    molecules: Sequence[str] | None = option(
        "md17: only this; may be repeated.", None, words=("molecule",), unset="all eight"
    )
    time_ps: float = option("md17: trajectory of each molecule.", 200.0)
    md17_ethanol: Path | None = option("md17: an .npz of MD17's own ethanol to forecast as well.", None)
    steps: int | None = option("Number of optimiser steps, instead of a budget.", None, within=(1, None))
    call_s: float | None = option(
        "End this call, with exit code 1, at the first saved state after so long; the same with `resume` goes on.",
        None,
        within=(0, None),
    )
    paper_size: bool = option(
        "LaM-SLidE of the published sizes (n-body: and epochs, unless `steps` says otherwise): for a GPU, in calls.",
        False,
    )
    solver_steps: int = option("LaM-SLidE's; 1 gives its mean forecast instead of samples.", 10, within=(1, None))
    workers: int | None = option("n-body: processes that simulate.", None, within=(1, None), unset="one a core")
    device: str = option("Where to train: auto, cpu or cuda.", "auto")
