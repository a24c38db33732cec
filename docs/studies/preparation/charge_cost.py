"""Cost of AM1-BCC charges against atoms: processor seconds of antechamber and sqm, and a power law through them.

    python docs/studies/preparation/charge_cost.py [--largest 90]

Prints a row for each molecule and the law given in `md_reference/forces/gaff.py`.
Processor time of the children is counted, so that a busy machine changes little. Needs AmberTools; nothing is cached.
"""

from __future__ import annotations

import argparse
import resource
import sys

import numpy as np

from md_reference.forces import gaff
from systems.prepare.molecule import scene_from_smiles

SMILES = {
    "ethanol": "CCO",
    "benzene": "c1ccccc1",
    "alanine dipeptide": "CC(=O)N[C@@H](C)C(=O)NC",
    "aspirin": "CC(=O)Oc1ccccc1C(=O)O",
    "capped norleucine": "CC(=O)N[C@@H](CCCC)C(=O)NC",
    "ibuprofen": "CC(C)Cc1ccc(cc1)C(C)C(=O)O",
    "capped homoarginine": "CC(=O)N[C@@H](CCCCNC(N)=[NH2+])C(=O)NC",
    "capped alanyl alanine": "CC(=O)N[C@@H](C)C(=O)N[C@@H](C)C(=O)NC",
    "diphenhydramine": "CN(C)CCOC(c1ccccc1)c1ccccc1",
    "capped triazole": "CC(=O)N[C@@H](CCCCn1cc(CCc2ccccc2)nn1)C(=O)NC",
    "imatinib": "Cc1ccc(cc1Nc1nccc(n1)-c1cccnc1)NC(=O)c1ccc(cc1)CN1CCN(C)CC1",
    "capped hexaalanine": "CC(=O)" + "N[C@@H](C)C(=O)" * 6 + "NC",
    "capped octaalanine": "CC(=O)" + "N[C@@H](C)C(=O)" * 8 + "NC",
}


def main() -> None:
    """Measure, fit and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--largest", type=int, default=90, help="atoms of the largest molecule that is measured")
    largest = parser.parse_args().largest
    rows = []
    for name, smiles in SMILES.items():
        scene = scene_from_smiles(smiles)
        if scene.n_atoms > largest:
            continue
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        gaff.entry(scene, cached=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        rows.append((scene.n_atoms, seconds))
        sys.stdout.write(f"{name:24s} {scene.n_atoms:4d} atoms {seconds:8.1f} s\n")
        sys.stdout.flush()
    # Below 20 atoms the programs' start counts as much as the charges.
    atoms, seconds_of = np.array([row for row in rows if row[0] >= 20]).T
    slope, intercept = np.polyfit(np.log(atoms / 30.0), np.log(seconds_of), 1)
    worst = np.exp(np.abs(np.log(seconds_of) - intercept - slope * np.log(atoms / 30.0)).max())
    law = f"{np.exp(intercept):.1f} s x (atoms / 30)^{slope:.2f}"
    sys.stdout.write(f"law: {law}; no molecule off by more than a factor {worst:.1f}\n")


if __name__ == "__main__":
    main()
