"""Torsion profiles of potentials against GFN2-xTB's.

    python docs/studies/quantum/torsion_profiles.py WEIGHTS... [-o docs/results/tables/torsion_profiles.json]
    python docs/studies/quantum/torsion_profiles.py NAME --unseen 20 [--tuned "FOLDER/tuned_{}_180s.safetensors"]

Each rotatable bond, methyl and hydroxyl included, is turned rigidly in 24 steps from GFN2-xTB's minimum. Energies are
compared, less their mean, where GFN2-xTB's are below 25 kJ/mol. `--unseen`: of so many test molecules of
docs/studies/training/drug_like.tsv, a line each. `--tuned`: each by its own weights, named by its place in that list,
as `drug_like_potential.py tune` leaves them.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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
from systems.errors import SurromdError
from systems.library.named_scenes import prepare
from systems.scene import FloatArray, Scene

STEPS, HIGHEST_KJ_MOL = 24, 25.0
ERRORS = ("states compared", "root mean square error", "largest")


def minimum(scene: Scene) -> FloatArray:
    """Return positions `(n_atoms, 3)` nm of GFN2-xTB's minimum next to the scene's."""
    spec = ForceFieldSpec(QUANTUM, "vacuum", None, constrain_hydrogens=False)
    with Engine(scene, Conditions(force=spec, timestep_ps=0.001, platform="Reference")) as engine:
        engine.minimise(max_iterations=500)
        return engine.positions()


LIST = Path(__file__).parents[1] / "training" / "drug_like.tsv"


def unseen(name: str, n: int, tuned: str | None) -> list[list[str]]:
    """Return a line for each of so many test molecules with a torsion."""
    weights, found, offs = load_weights(weights_path(name)), [], []
    for number, line in enumerate(LIST.read_text("utf-8").splitlines()[1:]):
        smiles, split, *_ = line.split("\t")
        if split != "test" or len(found) == n:
            continue
        try:
            scene = prepare(f"smiles:{smiles}")
            model = (weights if tuned is None else load_weights(Path(tuned.format(number)))).model
            lines = [off for _, _, off in profiles(scene, model.eval())]
        except SurromdError as error:
            sys.stderr.write(f"{smiles}: {error}\n")
            continue
        if lines:
            off = np.concatenate(lines)
            offs.append(off)
            found.append([f"`{smiles}`", str(len(lines)), str(len(off)), f"{np.sqrt(np.square(off).mean()):.2f}",
                          f"{np.abs(off).max():.2f}"])  # fmt: skip
    every = np.concatenate(offs)
    middle = np.median([np.sqrt(np.square(off).mean()) for off in offs])
    found.append([f"all; median of molecules {middle:.2f}", "", str(len(every)),
                  f"{np.sqrt(np.square(every).mean()):.2f}", f"{np.abs(every).max():.2f}"])  # fmt: skip
    return found


def rows(name: str) -> list[list[str]]:
    """Return a line for each torsion."""
    weights = load_weights(weights_path(name))
    return [
        [Path(name).stem, torsion, f"{np.ptp(asked):.1f}", f"{len(off)} of {STEPS}",
         f"{np.sqrt(np.square(off).mean()):.2f}", f"{np.abs(off).max():.2f}"]
        for torsion, asked, off in profiles(weights.domain.scene, weights.model.eval())
    ]  # fmt: skip


def profiles(scene: Scene, model: Any) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Yield each torsion, GFN2-xTB's energies along it, and by how much the model's differ where these are low."""
    at, reference, graph = minimum(scene), Potential(scene), bonded_graph(scene)
    molecule = Molecule.of(scene)
    for quad in rotatable_torsions(scene, rotors=True).tolist():
        scan = np.stack([turned(at, quad, 2.0 * np.pi * k / STEPS, graph) for k in range(STEPS)])
        asked = np.array([reference(x)[0] for x in scan])
        energies = model.evaluate(torch.tensor(scan), molecule).energy_kj_mol.numpy()
        low = asked - asked.min() < HIGHEST_KJ_MOL
        off = (energies - asked)[low] - (energies - asked)[low].mean()
        yield "-".join(f"{scene.elements[k]}{k}" for k in quad), asked, off


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", nargs="+")
    parser.add_argument("-o", "--out", type=Path)
    parser.add_argument("--unseen", type=int, default=0)
    parser.add_argument("--tuned", metavar="NAME_WITH_{}")
    given = parser.parse_args()
    found = [
        line
        for name in given.weights
        for line in (unseen(name, given.unseen, given.tuned) if given.unseen else rows(name))
    ]
    for line in found:
        sys.stdout.write(" | ".join(line) + "\n")
    if given.out is not None:
        table = {
            "command": f"python docs/studies/quantum/torsion_profiles.py {' '.join(sys.argv[1:-2])}",
            "machine": machine_name(),
            "note": f"Rigid turns from GFN2-xTB's minimum; kJ/mol; compared below {HIGHEST_KJ_MOL:g}.",
            "columns": ["molecule", "torsions", *ERRORS]
            if given.unseen
            else ["weights", "torsion", "barrier", *ERRORS],
            "rows": found,
        }
        given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
