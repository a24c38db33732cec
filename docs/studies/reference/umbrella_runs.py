"""Error of what `surromd run` says of peptides in explicit water, beside MD under an umbrella potential.

    python docs/studies/reference/umbrella_runs.py WATER RUNS [RUNS ...] [-o TABLE.json]

WATER is a folder of `peptide_campaign --umbrella`, each of RUNS holds runs, `RUNS/NAME`, of molecules in
WATER/umbrella_test. Root mean square error of the populations of states of φ < 0, less the reference's own, in per cent
of time; and the error that is stated, root mean square. Answers are those of the present program.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from error_against_minutes import answer_again, same_state

from md_reference.run.machine import machine_name
from surrogate.comparison.answer import StateEnergy
from surrogate.comparison.md_answer import md_answer
from surrogate.comparison.read.ensemble import load_ensemble
from surrogate.verbs.run.run_record import RunResult

TABLES = Path(__file__).parents[2] / "results" / "tables"
COLUMNS = ["run", "populations by", "ψ", "side chains", "all", "stated"]


def row(folder: Path, reference: Sequence[StateEnergy]) -> list[str]:
    """Return a line of the table."""
    answer = answer_again(RunResult.of(folder), None)
    assert answer is not None
    found = [(s, r) for s in answer.states for r in reference
             if s.state != "left-handed" and s.torsion == r.torsion and same_state(s.state, r.state)]  # fmt: skip

    def error(some: Sequence[tuple[StateEnergy, StateEnergy]]) -> str:
        square = float(np.mean([(s.share - r.share) ** 2 - r.error**2 for s, r in some]))
        return f"{100.0 * math.sqrt(max(0.0, square)):.1f}"

    side = [each for each in found if each[0].torsion.startswith("χ")]
    psi = [each for each in found if each not in side]
    stated = 100.0 * math.sqrt(float(np.mean([s.error**2 for s, _ in found])))
    words = f"{folder.name}, {folder.parent.name}"
    return [words, answer.to_dict()["populations_by"], error(psi), error(side), error(found), f"{stated:.1f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("water", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("-o", "--out", type=Path, default=TABLES / "water_umbrella_runs.json")
    given = parser.parse_args()
    rows, said = [], []
    for place in sorted((given.water / "umbrella_test").iterdir()):
        md = load_ensemble(sorted(place.glob("run_*.h5")))
        reference = md_answer(md, 300.0).states
        rows += [row(runs / place.name, reference) for runs in given.runs if (runs / place.name).is_dir()]
        own = 100.0 * math.sqrt(float(np.mean([s.error**2 for s in reference if s.state != "left-handed"])))
        said.append(f"{md.length_words} of {place.name} (which err by {own:.1f})")
    note = (
        f"Root mean square error in % of time, φ < 0. Reference: MD under an umbrella potential, {'; '.join(said)}. "
        "One run each, of ten minutes of one core."
    )
    table = {"command": "python docs/studies/reference/umbrella_runs.py WATER RUNS ...", "machine": machine_name(),
             "note": note, "columns": COLUMNS, "rows": rows}  # fmt: skip
    given.out.write_text(json.dumps(table, ensure_ascii=False, indent=1) + "\n", "utf-8")
    sys.stdout.write("\n".join(" | ".join(line) for line in (*rows, [note])) + "\n")


if __name__ == "__main__":
    main()
