"""Torsion profiles of potentials against GFN2-xTB's.

    python docs/studies/quantum/torsion_profiles.py WEIGHTS... [-o docs/results/tables/torsion_profiles.json]

Each rotatable bond, methyl and hydroxyl included, is turned rigidly in 24 steps from GFN2-xTB's minimum. Energies are
compared, less their mean, where GFN2-xTB's are below 25 kJ/mol.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import torch

from md_reference.forces.quantum import Potential
from md_reference.forces.spec import QUANTUM, ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.machine import machine_name
from surrogate.models.architecture import weights_path
from surrogate.models.propagator import Molecule
from surrogate.models.weights import load_weights
from systems.chemistry.graph import bonded_graph, rotatable_torsions, turned
from systems.scene import FloatArray, Scene

STEPS, HIGHEST_KJ_MOL = 24, 25.0


def minimum(scene: Scene) -> FloatArray:
    """Return positions `(n_atoms, 3)` nm of GFN2-xTB's minimum next to the scene's."""
    spec = ForceFieldSpec(QUANTUM, "vacuum", None, constrain_hydrogens=False)
    with Engine(scene, Conditions(force=spec, timestep_ps=0.001, platform="Reference")) as engine:
        engine.minimise(max_iterations=500)
        return engine.positions()


def rows(name: str) -> list[list[str]]:
    """Return a line for each torsion."""
    weights = load_weights(weights_path(name))
    scene, model = weights.domain.scene, weights.model.eval()
    at, reference, graph = minimum(scene), Potential(scene), bonded_graph(scene)
    molecule = Molecule.of(scene)
    found = []
    for quad in rotatable_torsions(scene, rotors=True).tolist():
        scan = np.stack([turned(at, quad, 2.0 * np.pi * k / STEPS, graph) for k in range(STEPS)])
        asked = np.array([reference(x)[0] for x in scan])
        energies = model.evaluate(torch.tensor(scan), molecule).energy_kj_mol.numpy()
        low = asked - asked.min() < HIGHEST_KJ_MOL
        off = (energies - asked)[low] - (energies - asked)[low].mean()
        torsion = "-".join(f"{scene.elements[k]}{k}" for k in quad)
        found.append([Path(name).stem, torsion, f"{np.ptp(asked):.1f}", f"{low.sum()} of {STEPS}",
                      f"{np.sqrt(np.square(off).mean()):.2f}", f"{np.abs(off).max():.2f}"])  # fmt: skip
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", nargs="+")
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    lines = [line for name in given.weights for line in rows(name)]
    for line in lines:
        sys.stdout.write(" | ".join(line) + "\n")
    if given.out is not None:
        table = {
            "command": "python docs/studies/quantum/torsion_profiles.py WEIGHTS...",
            "machine": machine_name(),
            "note": f"Rigid turns from GFN2-xTB's minimum; kJ/mol; compared below {HIGHEST_KJ_MOL:g}.",
            "columns": ["weights", "torsion", "barrier", "states compared", "root mean square error", "largest"],
            "rows": lines,
        }
        given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
