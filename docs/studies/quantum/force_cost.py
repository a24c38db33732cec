"""What a force of a potential for any drug-like molecule costs, beside GFN2-xTB and what other packages have.

    python docs/studies/quantum/force_cost.py [SMILES ...] [-o docs/results/tables/force_cost.json]

Processor time of one core for one frame, ms, least of several calls; potentials in batches of 4 or 32,
whichever is cheaper. PAINET:
`drug-like-gfn2-xtb`, compiled (SIMD). TorchANI: eight networks of ANI-2x's size with its descriptors; MACE: two layers
of 64 scalars and vectors, 5 Å (`rivals`). Both are their packages' own modules (`pip install torchani mace-torch`), by
torch in float32 with random weights: time does not depend on these.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from rivals import MaceEnergy
from torch import Tensor

from md_reference.forces.quantum import Potential
from md_reference.run.machine import machine_name
from surrogate.models.architecture import weights_path
from surrogate.models.potential import Potential as LearnedPotential
from surrogate.models.potential import gradient_of
from surrogate.models.propagator import Molecule
from surrogate.models.weights import load_weights
from systems.prepare.molecule import scene_from_smiles

# Aspirin, lidocaine, and icosane.
MOLECULES = ("CC(=O)Oc1ccccc1C(=O)O", "CCN(CC)CC(=O)Nc1c(C)cccc1C", "C" * 20)
ANI_ELEMENTS = ("H", "C", "N", "O", "F", "S", "Cl")
BATCHES, ROUNDS, ANGSTROM, SEED = (4, 32), 5, 10.0, 0


def least_ms(call: Callable[[Tensor], object], x: Tensor) -> float:
    """Return the least processor time of a call in ms a frame of `x`, after one that does not count."""
    times = []
    for _ in range(1 + ROUNDS):
        began = time.process_time()
        call(x)
        times.append(1e3 * (time.process_time() - began) / len(x))
    return min(times[1:])


def ani_energy(molecule: Molecule) -> Callable[[Tensor], Tensor]:
    """Return energies `(rows, 1)` of frames in nm by a network of ANI-2x's size."""
    from torchani.arch import simple_ani

    network = simple_ani(ANI_ELEMENTS, lot="wb97x-631gd", ensemble_size=8, self_energies="zero", strategy="pyaev")
    network = network.float().eval().requires_grad_(False)

    def energies(positions_nm: Tensor) -> Tensor:
        elements = molecule.elements.expand(len(positions_nm), -1)
        found: Tensor = network((elements, ANGSTROM * positions_nm.float())).energies
        return found[:, None]

    return energies


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("molecules", nargs="*", default=MOLECULES)
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(SEED)
    model = load_weights(weights_path("drug-like-gfn2-xtb")).model
    assert isinstance(model, LearnedPotential)
    table_rows = []
    for smiles in given.molecules:
        scene = scene_from_smiles(smiles)
        molecule, reference = Molecule.of(scene), Potential(scene)
        at = torch.tensor(scene.positions_nm)
        x = at + 0.003 * torch.randn(max(BATCHES), *at.shape, dtype=at.dtype)
        frames = iter(x.numpy())
        costs = [least_ms(lambda some, ask=reference, frames=frames: ask(next(frames)), at[None])]  # type: ignore[misc]
        mace = MaceEnergy(molecule).eval().requires_grad_(False)
        for force in (model.gradient(x, molecule), gradient_of(ani_energy(molecule)), gradient_of(mace)):
            costs.append(min(least_ms(force, x[:rows]) for rows in BATCHES))
        table_rows.append([smiles, str(scene.n_atoms), *(f"{cost:.2g}" for cost in costs)])
        sys.stdout.write(" | ".join(table_rows[-1]) + "\n")
        sys.stdout.flush()
    if given.out is not None:
        table = {
            "command": "python docs/studies/quantum/force_cost.py",
            "machine": machine_name(),
            "note": "ms of a core's processor time a force, batches of 4 or 32.",
            "columns": ["molecule", "atoms", "GFN2-xTB", "PAINET", "TorchANI", "MACE"],
            "rows": table_rows,
        }
        given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
