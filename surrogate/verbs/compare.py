"""The comparison as a verb: files in, a comparison and its report out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogate.verbs.options import CompareOptions, PathLike, Trajectories
from surrogate.verbs.outputs import check_outputs, find_trajectories
from systems.errors import InputError
from systems.options import options_as_keywords

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from surrogate.comparison.comparison import Comparison
    from systems.scene import Scene


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
    for the reference, each candidate and the replicate in this order, None where the file says it itself. `energies`:
    evaluate the potential energy of every k-th frame too, by the force field that the reference's file names. A report
    that is there stays unless `overwrite`. Raises InputError, TrajectoryError, OutOfDomainError.
    """
    from surrogate.comparison.comparison import compare as compare
    from surrogate.comparison.read.ensemble import load_ensemble

    if isinstance(candidates, str | Path):
        candidates = [candidates]
    labels = [options.labels] if isinstance(options.labels, str) else options.labels
    if not candidates:
        raise InputError("Nothing to compare: name at least one trajectory besides the reference.")
    if labels is not None and len(labels) != len(candidates):
        raise InputError(f"{len(labels)} labels for {len(candidates)} candidates.")
    if out_html is not None:
        page = Path(out_html)
        check_outputs([page], [".html"], overwrite=options.overwrite)
        beside = [page.with_suffix(".json"), page.with_suffix(".md")]
        check_outputs(beside, [".json", ".md"], overwrite=options.overwrite)
    n = 1 + len(candidates) + (options.replicate is not None)
    tops, lags = _one_each("top", options.top, n), _one_each("dt_ps", options.dt_ps, n)
    ref = load_ensemble(find_trajectories(reference), top=tops[0], lag_ps=lags[0])
    others = [
        load_ensemble(
            find_trajectories(candidate),
            label=labels[k] if labels else None,
            template=ref.scene,
            top=tops[1 + k],
            lag_ps=lags[1 + k],
        )
        for k, candidate in enumerate(candidates)
    ]
    replicate_baseline = None
    if options.replicate is not None:
        replicate_baseline = load_ensemble(
            find_trajectories(options.replicate), template=ref.scene, top=tops[-1], lag_ps=lags[-1]
        )
    energy_fn = _relaxed_energy(ref.scene, ref.record) if options.energies else None
    result = compare(ref, others, replicate_baseline, ref.scene, energy_fn=energy_fn)
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


def _relaxed_energy(scene: Scene, record: dict[str, Any]) -> Callable[[npt.NDArray[np.float64]], float]:
    """Return what gives the energy in kJ/mol of a frame with its stiff bonds at rest, infinity where there is none."""
    from md_reference.forces.forcefield import build_system, resolve
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.frame_relaxation import Relaxer
    from systems.errors import SimulationError

    if record.get("force_field") is None or record.get("solvent") is None:
        raise InputError("`energies`: the reference's file does not say with which force field it was made.")
    spec = resolve(scene, ForceFieldSpec.of(record))
    relaxer = Relaxer(scene, build_system(scene, spec), born=spec.is_born)

    def energy(positions_nm: npt.NDArray[np.float64]) -> float:
        try:
            return relaxer.relax(positions_nm).potential_kj_mol
        except SimulationError:
            return math.inf

    return energy
