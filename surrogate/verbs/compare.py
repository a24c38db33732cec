"""The verbs `compare` (files in, a comparison and its report out) and `demo`, which makes such files first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogate.models.architecture import weights_path
from surrogate.verbs.inputs import check_outputs, find_trajectories
from surrogate.verbs.options import CompareOptions, DemoOptions, PathLike, Trajectories
from surrogate.verbs.simulate import reference as run_reference
from surrogate.verbs.simulate import rollout
from systems.errors import InputError
from systems.options import options_as_keywords

if TYPE_CHECKING:
    from surrogate.comparison.comparison import Comparison


@options_as_keywords(CompareOptions)
def compare(
    reference: Trajectories,
    candidates: PathLike | Sequence[Trajectories],
    out_html: PathLike | None = None,
    *,
    options: CompareOptions,
) -> Comparison:
    """Evaluate candidates against a reference, write the report (NAME.html, .json and .md) and return the comparison.

    The reference, each candidate and the replicate (another run of the reference, the replicate baseline of every
    figure) is a file, a folder, a glob, a comma-separated list or a sequence of files that are replicas of each other;
    a single path for
    `candidates` is one candidate, and a sequence holds one each. `top`: topology for files that carry none. `dt_ps`:
    the time between frames, where the files do not say or say it wrongly. Of both, one stands for all, or there is one
    for the reference, each candidate and the replicate in this order, None where the file says it itself. A report
    that is there stays unless `overwrite`. Raises InputError, TrajectoryError, OutOfDomainError.
    """
    from surrogate.comparison.comparison import compare as evaluate
    from surrogate.comparison.read.ensemble import load_ensemble

    if isinstance(candidates, str) or not isinstance(candidates, Sequence):
        candidates = [candidates]
    labels = [options.labels] if isinstance(options.labels, str) else options.labels
    if not candidates:
        raise InputError("Nothing to compare: name at least one trajectory besides the reference.")
    if labels is not None and len(labels) != len(candidates):
        raise InputError(f"{len(labels)} labels for {len(candidates)} candidates.")
    if out_html is not None:
        page = Path(out_html)
        for suffix in (".html", ".json", ".md"):
            named = page if suffix == ".html" else page.with_suffix(suffix)
            check_outputs([named], [suffix], overwrite=options.overwrite)
    n = 1 + len(candidates) + (options.replicate is not None)
    tops, lags = _one_each("top", options.top, n), _one_each("dt_ps", options.dt_ps, n)
    ref = load_ensemble(find_trajectories(reference), top=tops[0], lag_ps=lags[0])
    others = []
    for k, candidate in enumerate(candidates, 1):
        label = labels[k - 1] if labels else None
        files = find_trajectories(candidate)
        others.append(load_ensemble(files, label=label, template=ref.scene, top=tops[k], lag_ps=lags[k]))
    replicate = None
    if options.replicate is not None:
        files = find_trajectories(options.replicate)
        replicate = load_ensemble(files, template=ref.scene, top=tops[-1], lag_ps=lags[-1])
    result = evaluate(ref, others, replicate)
    if out_html is not None:
        from surrogate.comparison.report.report import write_report

        write_report(result, Path(out_html))
    return result


def _one_each(name: str, given: Any, n: int) -> list[Any]:
    """Return what is said of each of `n` trajectories, one value standing for all. Raises InputError."""
    if given is None or isinstance(given, str | Path | float | int):
        return [given] * n
    values = list(given)
    if len(values) == 1:
        return values * n
    if len(values) != n:
        raise InputError(
            f"{len(values)} values of {name} for {n} trajectories: give one for all, or one for the reference, each "
            "candidate and the replicate, in this order."
        )
    return values


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
        ref, replicate = run_reference(name, out, time_ps=options.reference_ps, replicas=2, **shared)
        out, n = folder / "surrogate.h5", options.rollout_replicas
        saved = {"save_every_ps": options.rollout_save_every_ps}
        rolled = rollout(name, weights, out, time_ps=options.rollout_ps, replicas=n, **saved, **shared)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"what was written is in {folder}; the demo starts over when it is run again") from None
    return compare(ref, [rolled], folder / "report.html", replicate=replicate, labels=["surrogate"], overwrite=True)
