"""Errors of a potential's forces and energies at states that it never saw, against GFN2-xTB.

    python docs/studies/quantum/force_errors.py WEIGHTS...

States of MD by GFN2-xTB at 300 K as `surromd reference --level gfn2-xtb` runs it (200, 0.1 ps apart), and by GAFF2 at
300, 500 and 700 K (80 each, 1 ps apart). Energies are compared less their mean.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import torch
from four_molecules import force_error, frames_of

import surrogate as sm
from md_reference.run.labeller import Labeller
from surrogate.models.architecture import weights_path
from surrogate.models.propagator import Molecule
from surrogate.models.weights import load_weights

SEED = 977


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", nargs="+")
    for name in parser.parse_args().weights:
        weights = load_weights(weights_path(name))
        scene, model = weights.domain.scene, weights.model.eval()
        molecule = Molecule.of(scene)
        with tempfile.TemporaryDirectory() as folder, Labeller(scene) as ref:
            (md,) = sm.reference(scene, Path(folder) / "md.h5", time_ps=20.0, save_every_ps=0.1, equilibrate_ps=2.0,
                                 level="gfn2-xtb", seed=SEED, quiet=True)  # fmt: skip
            sets = {"GFN2-xTB, 300 K": frames_of(md)}
            sets |= {f"GAFF2, {t:g} K": ref.motion(80, 1.0, t, seed=SEED) for t in (300.0, 500.0, 700.0)}
            for what, states in sets.items():
                asked = ref.label(states)
                found = model.evaluate(torch.tensor(asked.positions_nm), molecule)
                error = force_error(found.forces_kj_mol_nm.numpy(), asked.forces_kj_mol_nm)
                off = (found.energy_kj_mol.numpy() - asked.energies_kj_mol).std()
                sys.stdout.write(f"{Path(name).stem} | MD by {what} | {len(asked.positions_nm)} | "
                                 f"{error:.2f} kcal/mol/Å | {off:.2f} kJ/mol\n")  # fmt: skip
                sys.stdout.flush()


if __name__ == "__main__":
    main()
