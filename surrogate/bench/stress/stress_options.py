"""What `stress` can be told; light to import (`systems.options`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from surrogate.verbs.options import Quiet, Seeded
from systems.options import option


@dataclass(frozen=True, kw_only=True)
class StressOptions(Seeded, Quiet):
    """What `stress` can be told."""

    frames: Sequence[int] | None = option(
        "Rollout length in frames, all replicas together; repeatable.", None, within=(1, None), unset="10000 and 100000"
    )
    replicas: int | None = option("Number of rollout replicas.", None, within=(1, None), unset="16")
    guards: Sequence[str] | None = option(
        "Guard policy of the rollouts; repeatable.", None, words=("guard",), unset="flag and repair"
    )
    sections: Sequence[str] | None = option(
        "Test to run: length, invariance, inputs, precision, batches, solvers, openmm; repeatable.",
        None,
        words=("section",),
    )
    scene: str | None = option(
        "Scene to test, for weights of several peptides, such as sequence:ACE-LEU-SER-NME.", None
    )
    quick: bool = option("Short runs: a minute or two.", False)
