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
        "Length of a rollout, all replicas; repeatable.", None, within=(1, None), unset="10000 and 100000"
    )
    replicas: int | None = option("Of the rollouts.", None, within=(1, None), unset="16")
    guards: Sequence[str] | None = option("Of the rollouts.", None, words=("guard",), unset="flag and repair")
    sections: Sequence[str] | None = option(
        "Only this: length, invariance, inputs, precision, batches, solvers, openmm. Repeatable.",
        None,
        words=("section",),
    )
    scene: str | None = option("Of weights for many molecules: the one to try, such as smiles:CCO.", None)
    quick: bool = option("Short runs of everything: a minute or two.", False)
