"""The verb `demo`: reference, rollout and comparison of alanine dipeptide."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogate.models.architecture import weights_path
from surrogate.verbs.compare import compare
from surrogate.verbs.options import DemoOptions, PathLike
from surrogate.verbs.reference import reference
from surrogate.verbs.rollout import rollout
from systems.errors import InputError
from systems.options import options_as_keywords

if TYPE_CHECKING:
    from surrogate.comparison.comparison import Comparison


@options_as_keywords(DemoOptions)
def demo(out_dir: PathLike = "surromd-demo", *, options: DemoOptions) -> Comparison:
    """The whole way on alanine dipeptide: two OpenMM runs, longer rollouts with shipped weights, the comparison.

    Writes reference_r0.h5, reference_r1.h5 (the replicate), surrogate_r0.h5, ..., report.html and report.json into
    `out_dir`, replacing those of an earlier demo.
    """
    folder = Path(out_dir)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(f"{folder} is a file; name a folder with `out`.") from None
    name, weights = "alanine-dipeptide", "peptides"
    weights_path(weights)  # missing weights are noticed before anything is simulated
    try:
        shared: dict[str, Any] = {"seed": options.seed, "quiet": options.quiet, "overwrite": True}
        out = folder / "reference.h5"
        ref, replicate = reference(name, out, time_ps=options.reference_ps, replicas=2, **shared)
        out, n = folder / "surrogate.h5", options.rollout_replicas
        saved = {"save_every_ps": options.rollout_save_every_ps}
        rolled = rollout(name, weights, out, time_ps=options.rollout_ps, replicas=n, **saved, **shared)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"what was written is in {folder}; the demo starts over when it is run again") from None
    return compare(ref, [rolled], folder / "report.html", replicate=replicate, labels=["surrogate"], overwrite=True)
