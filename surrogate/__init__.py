"""Learned simulators, the comparison that compares them with the reference, and the command line.

`import surrogate as sm; sm.rollout(scene, weights, out, time_ps=...)`: the verbs of `surrogate.api`, loaded on use
(PEP 562), so that importing the package costs nothing. Beside them `sm.Simulation`, a surrogate that OpenMM's reporters
take for `openmm.app.Simulation`, `sm.to_mdtraj` and `sm.to_mdanalysis`, trajectories as these libraries' objects, and
`sm.frame_weights`, the weights that MD's answer gives to frames.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surrogate.api import *  # noqa: F403
    from surrogate.sampling.simulation import Simulation as Simulation
    from systems.trajectory.codec import frame_weights as frame_weights
    from systems.trajectory.codec import to_mdanalysis as to_mdanalysis
    from systems.trajectory.codec import to_mdtraj as to_mdtraj

__version__ = "0.1.0"

_ELSEWHERE = {
    "Simulation": "surrogate.sampling.simulation",
    "frame_weights": "systems.trajectory.codec",
    "to_mdanalysis": "systems.trajectory.codec",
    "to_mdtraj": "systems.trajectory.codec",
}


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name in _ELSEWHERE:
        return getattr(import_module(_ELSEWHERE[name]), name)
    if name == "__all__":
        return sorted([*import_module("surrogate.api").__all__, *_ELSEWHERE])
    if not name.startswith("_") and name in (api := import_module("surrogate.api")).__all__:
        return getattr(api, name)
    raise AttributeError(f"module 'surrogate' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__getattr__("__all__")})
