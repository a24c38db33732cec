"""What `bench reference` can be told; light to import (`systems.options`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from surrogate.verbs.options import Quiet
from systems.options import option


@dataclass(frozen=True, kw_only=True)
class SpeedOptions(Quiet):
    """What `bench reference` can be told."""

    quick: bool = option("Three sizes, short timings: a minute or two.", False)
    cases: Sequence[str] | None = option("Only this scene; may be repeated.", None, words=("case",))
    rounds: int | None = option("How often each is timed.", None, within=(1, None), unset="7; 3 if quick")
    timing_s: float | None = option("Of each timing.", None, words=("seconds",), unset="3s; 0.3s if quick")
    cores: int | None = option("Cores to use.", None, within=(1, None), unset="all")
