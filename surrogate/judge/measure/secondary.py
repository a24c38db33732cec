"""Secondary structure by hydrogen bonds of the backbone: which residues are in helix or strand, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.scene import Scene

IntArray = npt.NDArray[np.int64]

COIL, HELIX, STRAND = 0, 1, 2
# A turn of a 3-10 helix spans four residues, and two that follow each other make it a helix.
LEAST_RESIDUES = 5
_CODES = {"H": HELIX, "E": STRAND}


@dataclass(frozen=True, eq=False)
class Chains:
    """The backbone of every amino acid: atoms N, CA, C, O `(n_residues, 4)`, in order along the chains.

    `chain` `(n_residues,)` counts the chains, `is_proline` `(n_residues,)` marks those without a hydrogen on N, and
    `labels` are such as 'ALA 2'.
    """

    atoms: IntArray
    chain: IntArray
    is_proline: npt.NDArray[np.bool_]
    labels: tuple[str, ...]


NO_CHAINS = Chains(np.empty((0, 4), np.int64), np.empty(0, np.int64), np.empty(0, bool), ())


def find_chains(scene: Scene, place: dict[int, int]) -> Chains:
    """Return the amino acids of `scene`, found in its bond graph, whose four atoms all have a `place` (atom of the
    scene to column of the frames); none where fewer than `LEAST_RESIDUES` are left."""
    from systems.chemistry.graph import backbone_torsions, bonded_graph

    graph, found = bonded_graph(scene), backbone_torsions(scene)
    units = {int(q[2]): (int(q[1]), int(q[2]), int(q[3])) for q in found["phi"]}
    units |= {int(q[1]): (int(q[0]), int(q[1]), int(q[2])) for q in found["psi"]}
    following = {int(q[2]): int(q[3]) for q in found["psi"]}
    of_nitrogen = {n: alpha for alpha, (n, _, _) in units.items()}
    later = {n for n in following.values() if n in of_nitrogen}
    rows, chain, labels, proline = [], [], [], []
    for number, start in enumerate(n for n in of_nitrogen if n not in later):
        nitrogen: int | None = start
        while nitrogen in of_nitrogen:
            n, alpha, carbon = units[of_nitrogen[nitrogen]]
            oxygens = sorted(i for i in graph[carbon] if scene.elements[i] == "O" and graph.degree(i) == 1)
            named = [i for i in oxygens if scene.atom_names[i] == "O"]
            atoms = (n, alpha, carbon, *(named or oxygens)[:1])
            if len(atoms) == 4 and all(i in place for i in atoms):
                residue = int(scene.residue_of_atom[alpha])
                rows.append([place[i] for i in atoms])
                chain.append(number)
                labels.append(f"{scene.residue_names[residue]} {scene.residue_ids[residue]}")
                proline.append(sum(scene.elements[i] == "C" for i in graph[n]) == 3)
            nitrogen = following.get(carbon)
    if len(rows) < LEAST_RESIDUES:
        return NO_CHAINS
    return Chains(np.array(rows, np.int64), np.array(chain, np.int64), np.array(proline, bool), tuple(labels))


def secondary_structure(frames_nm: npt.NDArray[np.floating[Any]], chains: Chains) -> npt.NDArray[np.int8]:
    """Return `COIL`, `HELIX` or `STRAND` of each residue `(n, n_residues)` in frames `(n, n_atoms, 3)` nm.

    DSSP (Kabsch and Sander, Biopolymers 22, 2577, 1983) as MDTraj computes it, in its three letters: helix is H, G and
    I, strand E and B, coil the rest. Hydrogens are placed by the backbone. A frame that is not finite is coil.
    """
    import mdtraj

    out = np.zeros((len(frames_nm), len(chains.atoms)), dtype=np.int8)
    if not len(chains.atoms):
        return out
    backbone = np.asarray(frames_nm[:, chains.atoms.ravel()], dtype=np.float32)
    finite = np.isfinite(backbone).all(axis=(1, 2))
    if finite.any():
        letters = mdtraj.compute_dssp(mdtraj.Trajectory(backbone[finite], _topology(chains)))
        codes = np.zeros(letters.shape, dtype=np.int8)
        for letter, code in _CODES.items():
            codes[letters == letter] = code
        out[finite] = codes
    return out


def _topology(chains: Chains) -> Any:
    """Return MDTraj's topology of the backbones alone: names as DSSP asks for them, whatever the file calls them."""
    import mdtraj
    from mdtraj.core import element

    topology = mdtraj.Topology()
    chain: Any = None
    for k, proline in enumerate(chains.is_proline):
        if k == 0 or chains.chain[k] != chains.chain[k - 1]:
            chain = topology.add_chain()
        residue = topology.add_residue("PRO" if proline else "ALA", chain)
        for name, symbol in (("N", "nitrogen"), ("CA", "carbon"), ("C", "carbon"), ("O", "oxygen")):
            topology.add_atom(name, getattr(element, symbol), residue)
    return topology
