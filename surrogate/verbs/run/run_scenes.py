"""The verb `run`: a scene and a budget in, an evaluated trajectory out, by whatever way pays best on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogate.verbs.options import PathLike, RunOptions, tell
from surrogate.verbs.run.decision import table
from surrogate.verbs.run.many_scenes import molecules_in, run_many
from surrogate.verbs.run.one_scene import plan_scene, run_scene
from surrogate.verbs.run.run_record import RunRecord
from surrogate.verbs.run.run_result import RunResult
from systems.errors import InputError
from systems.options import options_as_keywords

if TYPE_CHECKING:
    from systems.scene import Scene


@options_as_keywords(RunOptions)
def run(scene: PathLike | Scene, out: PathLike | None = None, *, options: RunOptions) -> dict[str, Any]:
    """Simulate a molecule in `budget_s` of wall time by whatever way pays best here, evaluate it, and return the
    record.

    What MD and the weights that cover the scene simulate is measured in the first seconds, and decides: weights that
    cover it and outrun MD are rolled for a short while to find the states, and MD runs from their frames; where nothing
    covers it and MD is cheap, MD takes the whole budget, its replicas beginning in many states (`starts`); at
    `level='gfn2-xtb'` a potential learns the molecule first. `way` overrides that. `dry_run`: the decision alone. The
    answer is MD's: its transitions give populations, free energies and timescales with errors (`equilibrium.json`), and
    each frame of MD a weight (`sm.frame_weights`); the surrogate is reported beside that.

    The folder `out` holds `report.html`, whose first line says what was achieved, the trajectory, `reference/`, the
    weights that were trained, `run.json` (the record that is returned: rates, decision, stages, seeds, versions) and
    `log.txt`. Ctrl-C and a kill lose nothing that was written; `resume` goes on, within the same budget.

    Many molecules are a list of SMILES (.smi: one a line, a name behind it), a folder of structure files, or the
    [[scenes]] of a campaign's TOML: they share the budget, a core each, on Dask's `workers`, and `out` holds a folder
    for each and one table of results, index.html. What fails is listed with its reason.
    Raises InputError, PreparationError, OutOfDomainError (`weights` that do not cover the scene), SimulationError.
    """
    molecules = molecules_in(scene)
    if options.dry_run and molecules is not None:
        raise InputError("`dry_run` takes one molecule: each is measured and decided by itself.")
    if options.dry_run:
        record = plan_scene(scene, options)
        return {"decision_table": decision_table(record, options), **record.to_dict()}
    if out is None:
        raise InputError("name a folder for the trajectory and the report with `out`.")
    folder = Path(out)
    if molecules is not None:
        return run_many(molecules, folder, options)

    def told(found: RunRecord) -> None:
        if not options.quiet:
            for name, text in decision_table(found, options).items():
                tell(found.molecule, f"{name}: {text}")

    run_scene(scene, folder, options, told)
    return RunResult.of(folder)


def decision_table(record: RunRecord, options: RunOptions) -> dict[str, str]:
    """Return a run's rates and its decision, line by line."""
    assert record.rates is not None and record.decision is not None
    lines: dict[str, str] = {}
    for name, text in table(record.rates, record.decision, options.budget_s):
        lines[name] = f"{lines[name]}; {text}" if name in lines else text
    return lines
