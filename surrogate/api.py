"""The verbs, as plain functions: each does what the command of the same name does, and returns what it printed.

Times are in ps, temperatures in K, frictions in 1/ps, masses in dalton; a text carries its own unit (`time_ps="10ns"`,
`temperature_k="310K"`). A `scene` is a `systems.scene.Scene`, or what the command line takes: a library name, a path,
`smiles:CCO` or `sequence:ACE-ALA-NME`. Everything a user can get wrong raises a `systems.errors.SurromdError` whose
message is one line.
"""

from surrogate.verbs.compare import compare, demo
from surrogate.verbs.info import info
from surrogate.verbs.inputs import systems
from surrogate.verbs.run.run_scenes import run
from surrogate.verbs.simulate import campaign, plan, reference, rollout
from surrogate.verbs.train import explain_training, train, windows

__all__ = [
    "campaign",
    "compare",
    "demo",
    "explain_training",
    "info",
    "plan",
    "reference",
    "rollout",
    "run",
    "systems",
    "train",
    "windows",
]
