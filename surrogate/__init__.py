"""Learned simulators, the judge that compares them with the truth, and the command line.

`import surrogate as sm; sm.rollout(scene, weights, out, time_ps=...)`: the verbs of `surrogate.api`, loaded on use
(PEP 562), so that importing the package costs nothing. Beside them `sm.Simulation`, a surrogate that OpenMM's reporters
take for `openmm.app.Simulation`, and `sm.to_mdtraj` and `sm.to_mdanalysis`, trajectories as these libraries' objects.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surrogate.api import (
        bursts,
        campaign,
        compare,
        demo,
        explain_training,
        info,
        plan,
        reference,
        rollout,
        systems,
        train,
        windows,
    )
    from surrogate.sampling.openmm.simulation import Simulation
    from systems.trajectory.converted import to_mdanalysis, to_mdtraj

__version__ = "0.1.0"

_VERBS = (
    "bursts",
    "campaign",
    "compare",
    "demo",
    "explain_training",
    "info",
    "plan",
    "reference",
    "rollout",
    "systems",
    "train",
    "windows",
)
_ELSEWHERE = {
    "Simulation": "surrogate.sampling.openmm.simulation",
    "to_mdanalysis": "systems.trajectory.converted",
    "to_mdtraj": "systems.trajectory.converted",
}

__all__ = [
    "Simulation",
    "bursts",
    "campaign",
    "compare",
    "demo",
    "explain_training",
    "info",
    "plan",
    "reference",
    "rollout",
    "systems",
    "to_mdanalysis",
    "to_mdtraj",
    "train",
    "windows",
]


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name in _VERBS:
        return getattr(import_module("surrogate.api"), name)
    if name in _ELSEWHERE:
        return getattr(import_module(_ELSEWHERE[name]), name)
    raise AttributeError(f"module 'surrogate' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
