"""What a force of PAINET as a potential costs, by torch and by SIMD, alone and in batches, beside GFN2-xTB's, in
processor time of one core (the least of several).

    python docs/studies/surrogates/potential_speed.py [--batches 1,32,256] [--weights NAME] [SMILES...]

Of the size that training begins with, or of that of some weights.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial

import torch

from md_reference.forces.quantum import Potential
from surrogate.models.architecture import weights_path
from surrogate.models.painet.energy import PotentialConfig
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.potential import gradient_of
from surrogate.models.propagator import Molecule
from surrogate.models.weights import read_header
from systems.prepare.molecule import scene_from_smiles

# Glycol, aspirin, paracetamol.
MOLECULES = ("OCCO", "CC(=O)Oc1ccccc1C(=O)O", "CC(=O)Nc1ccc(O)cc1")
ROUNDS = 8


def least_ms(call: Callable[[], object]) -> float:
    """Return the least processor time of a call in ms, after two that do not count."""
    times = []
    for _ in range(2 + ROUNDS):
        began = time.process_time()
        call()
        times.append(1e3 * (time.process_time() - began))
    return min(times[2:])


def ask(reference: Potential, frames: Iterator[torch.Tensor]) -> None:
    """Have the reference answer at the next frame: at the one before it would begin where it ended."""
    reference(next(frames).numpy())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("molecules", nargs="*", default=MOLECULES)
    parser.add_argument("--batches", default="1,32,256")
    parser.add_argument("--weights")
    given = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    own = {} if given.weights is None else read_header(weights_path(given.weights)).config
    model = PainetPotential(PotentialConfig.from_dict(own)).eval().requires_grad_(False)
    for smiles in given.molecules:
        scene = scene_from_smiles(smiles)
        molecule, reference = Molecule.of(scene), Potential(scene)
        at = torch.tensor(scene.positions_nm)[None]
        topology = model.topology(molecule)
        made = model.network.prepare(topology, at)
        moved = iter(at + 0.003 * torch.randn(2 + ROUNDS, *at.shape[1:], dtype=at.dtype))
        line = [f"{smiles}, {scene.n_atoms} atoms: GFN2-xTB {least_ms(partial(ask, reference, moved)):.3g} ms"]
        for rows in map(int, given.batches.split(",")):
            x = at + 0.003 * torch.randn(rows, *at.shape[1:], dtype=at.dtype)
            by_torch = gradient_of(partial(model.members, topology=topology, made=made))
            costs = [least_ms(partial(force, x)) / rows for force in (by_torch, model.gradient(x, molecule))]
            line.append(f"batch {rows}: " + ", by SIMD ".join(f"{cost:.3g}" for cost in costs))
        sys.stdout.write("; ".join(line) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
