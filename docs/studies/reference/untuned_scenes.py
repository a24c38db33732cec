"""Ten scenes that nobody tuned for, each by `surromd run` with a small budget: wall time, way, verdict.

    python docs/studies/reference/untuned_scenes.py FOLDER [-o docs/results/tables/untuned_scenes.json]

Five drug-like molecules by SMILES and five capped and free peptides by PDB files without hydrogens, two and a half
minutes each. Every run is left in FOLDER, report and all; one that is there and done is not made again.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import surrogate as sm
from md_reference.run.machine import machine_name
from surrogate.verbs.run.run_record import RUN_NAME, RunResult
from systems.errors import SurromdError
from systems.prepare.peptide import build_peptide
from systems.trajectory.companion_writer import pdb_text
from systems.units import format_time_ps, format_wall

MOLECULES = {
    "nicotine": "CN1CCC[C@H]1c1cccnc1",
    "caffeine": "Cn1cnc2c1c(=O)n(C)c(=O)n2C",
    "benzocaine": "CCOC(=O)c1ccc(N)cc1",
    "phenacetin": "CCOc1ccc(NC(C)=O)cc1",
    "diglyme": "COCCOCCOC",
}
PEPTIDES = ("ACE-ASN-GLY-NME", "ACE-PRO-VAL-NME", "ACE-MET-NME", "GLY-HIS-LYS", "SER-PHE-VAL")
BUDGET_S = 150.0


def heavy_pdb(sequence: str, folder: Path) -> Path:
    """Write a peptide's heavy atoms as a PDB file, as a structure database would have them, and return its path."""
    atoms = [line for line in pdb_text(build_peptide(sequence)).splitlines() if line.startswith(("ATOM", "HETATM"))]
    path = folder / f"{sequence}.pdb"
    path.write_text("\n".join([*(line for line in atoms if line[76:78].strip() != "H"), "TER", "END", ""]))
    return path


def evaluated(name: str, scene: str, folder: Path) -> dict[str, Any]:
    """Return the record of a scene's run, with `failed` where it came to nothing."""
    out = folder / name
    is_there = (out / RUN_NAME).is_file()
    if is_there and (record := RunResult.of(out))["outcome"]:
        return record
    try:
        return sm.run(scene, out, budget_s=BUDGET_S, quiet=True, resume=is_there)
    except SurromdError as error:
        record = RunResult.of(out) if (out / RUN_NAME).is_file() else {}
        return record | {"failed": str(error)}


def row(name: str, record: dict[str, Any]) -> list[str]:
    """Return a line of the table."""
    rates, outcome = record.get("rates"), record.get("outcome")
    others = f"{1 - 1 / rates['stretch']:.0%}" if rates else ""
    if record.get("failed") or outcome is None:
        return [name, format_wall(record.get("spent_s", 0.0)), others, "", "", "",
                f"failed: {record.get('failed')}"]  # fmt: skip
    way = record["decision"]["way"] + (" by SIMD" if rates["at_once"] > 1 else "")
    lengths = [format_time_ps(outcome[key], 2) for key in ("rolled_ps", "held_out_ps")]
    return [f"{name}, {rates['n_atoms']}", format_wall(record["spent_s"]), others, way,
            " + ".join(lengths), outcome["equivalent_time"] or "not told", outcome["status"]]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    cases = [(name, f"smiles:{smiles}") for name, smiles in MOLECULES.items()]
    cases += [(name, str(heavy_pdb(name, given.folder))) for name in PEPTIDES]
    rows = []
    for name, scene in cases:
        rows.append(row(name, evaluated(name, scene, given.folder)))
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
        sys.stdout.flush()
    if given.out is not None:
        record = {
            "command": "python docs/studies/reference/untuned_scenes.py FOLDER",
            "machine": machine_name(),
            "note": f"A budget of {format_wall(BUDGET_S)} each. Taken by others: of the cores, in the first seconds.",
            "columns": ["scene, atoms", "wall time", "taken by others", "way", "evaluated + held out",
                        "equivalent MD time", "verdict"],
            "rows": rows,
        }  # fmt: skip
        given.out.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
