"""Learned simulators, the judge that compares them with the truth, and the command line.

`import surrogate as sm; sm.rollout(scene, weights, out, time_ps=...)`: the verbs of `surrogate.api`, loaded on use
(PEP 562), so that importing the package costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surrogate.api import campaign, compare, demo, info, plan, reference, rollout, systems, train, windows

__version__ = "0.1.0"

__all__ = ["campaign", "compare", "demo", "info", "plan", "reference", "rollout", "systems", "train", "windows"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from surrogate import api

        return getattr(api, name)
    raise AttributeError(f"module 'surrogate' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
