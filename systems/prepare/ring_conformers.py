"""Other puckers of a molecule's rings: a chair turns over in microseconds, so that MD stays in the one it began in."""

from __future__ import annotations

from typing import Any

import networkx as nx
import numpy as np

from systems.chemistry.geometry import torsion
from systems.chemistry.graph import bonded_graph
from systems.chemistry.validity import (
    CHIRALITY,
    NOT_FINITE,
    OMEGA,
    RING,
    check_frames,
    geometry_from_scene,
    small_rings,
)
from systems.scene import ATOMIC_NUMBERS, FloatArray, IntArray, Scene

# Rings of fewer atoms turn over within picoseconds.
_LEAST_RING = 6
# Conformers that are drawn, and those kept at most, each of other puckers and no further above the lowest.
_DRAWN, _KEPT, _HIGHEST_KJ_MOL = 40, 6, 15.0
_MOST_ATOMS = 100
_FLAT_RAD, _SEED, _CLEAN_UP_STEPS = 0.5, 7, 500
_KJ_PER_KCAL = 4.184


def ring_conformers(scene: Scene) -> FloatArray:
    """Return positions `(k, n_atoms, 3)` nm of a molecule: its own, and conformers whose rings of six or seven atoms
    pucker otherwise, the lowest first (RDKit: ETKDG, then MMFF94; at most 15 kJ/mol above the lowest). Its own alone
    where no ring can pucker, of several or of large molecules, and where bond orders or MMFF94's parameters lack."""
    own = np.asarray(scene.positions_nm)[None]
    quads = _ring_torsions(scene)
    one = nx.is_connected(bonded_graph(scene)) and scene.n_atoms <= _MOST_ATOMS and scene.cell_nm is None
    if not len(quads) or not one or not scene.bond_orders.all():
        return own
    drawn, energies = _drawn(scene)
    if not len(drawn):
        return own
    geometry = geometry_from_scene(scene)
    same = check_frames(drawn, geometry) & (NOT_FINITE | CHIRALITY | OMEGA | RING) == 0
    low = energies <= energies[same].min(initial=np.inf) + _HIGHEST_KJ_MOL
    found, known = [own[0]], {_pucker(own[0], quads)}
    for k in np.argsort(energies):
        if same[k] and low[k] and len(found) < _KEPT and (pucker := _pucker(drawn[k], quads)) not in known:
            known.add(pucker)
            found.append(drawn[k])
    return np.stack(found)


def conformer_of(replica: int, n_conformers: int) -> int:
    """Return which of so many conformers a replica begins in: two of three in the first, so that most know the given
    one, the others by turns."""
    return 0 if n_conformers == 1 or replica % 3 < 2 else 1 + (replica // 3) % (n_conformers - 1)


def _ring_torsions(scene: Scene) -> IntArray:
    """Return the torsions `(k, 4)` of each ring that is large enough and has a saturated atom."""
    graph = bonded_graph(scene)
    rings = [r for r in small_rings(scene) if len(r) >= _LEAST_RING and any(graph.degree(i) == 4 for i in r)]
    quads = [[*ring[k:], *ring[:k]][:4] for ring in rings for k in range(len(ring))]
    return np.array(quads, dtype=np.int64).reshape(-1, 4)


def _pucker(positions_nm: FloatArray, quads: IntArray) -> tuple[int, ...]:
    """Return to which side each torsion turns, 0 where it is nearly flat."""
    angles = np.asarray(torsion(positions_nm[None], quads))[0]
    return tuple(int(np.sign(a)) if abs(a) > _FLAT_RAD else 0 for a in angles)


def _drawn(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return conformers `(n, n_atoms, 3)` nm and their energies in kJ/mol by MMFF94; none where RDKit cannot."""
    from rdkit import Chem, rdBase
    from rdkit.Chem import rdDistGeom
    from rdkit.Chem import rdForceFieldHelpers as force_fields

    none = np.zeros((0, scene.n_atoms, 3)), np.zeros(0)
    with rdBase.BlockLogs():
        try:
            molecule = _molecule_of(scene, Chem)
        except ValueError:  # RDKit's errors of valence are
            return none
        parameters: Any = rdDistGeom.ETKDGv3()
        parameters.randomSeed = _SEED
        numbers = list(rdDistGeom.EmbedMultipleConfs(molecule, _DRAWN, parameters))
        if not numbers or not force_fields.MMFFHasAllMoleculeParams(molecule):
            return none
        kcal = [energy for _, energy in force_fields.MMFFOptimizeMoleculeConfs(molecule, maxIters=_CLEAN_UP_STEPS)]
    positions = np.stack([molecule.GetConformer(k).GetPositions() / 10.0 for k in numbers])
    return positions, _KJ_PER_KCAL * np.array(kcal)


def _molecule_of(scene: Scene, chem: Any) -> Any:
    molecule = chem.RWMol()
    for element, charge in zip(scene.elements, scene.formal_charges.tolist(), strict=True):
        atom = chem.Atom(ATOMIC_NUMBERS[element])
        atom.SetFormalCharge(charge)
        atom.SetNoImplicit(True)
        molecule.AddAtom(atom)
    orders = {1.0: chem.BondType.SINGLE, 2.0: chem.BondType.DOUBLE, 3.0: chem.BondType.TRIPLE}
    for (i, j), order in zip(scene.bonds.tolist(), scene.bond_orders.tolist(), strict=True):
        molecule.AddBond(i, j, orders.get(order, chem.BondType.AROMATIC))
    conformer = chem.Conformer(scene.n_atoms)
    conformer.SetPositions(10.0 * np.asarray(scene.positions_nm, dtype=np.float64))
    molecule.AddConformer(conformer)
    chem.SanitizeMol(molecule)
    chem.AssignStereochemistryFrom3D(molecule)
    # MD keeps the hand of every atom by its neighbours' numbers, like ones among them.
    chem.AssignAtomChiralTagsFromStructure(molecule)
    return molecule
