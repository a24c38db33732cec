"""Generalised Born terms: OBC2 as OpenMM's native force, GBn2 as its custom one, radii as in Amber."""

from __future__ import annotations

from typing import Any

import networkx as nx
import numpy as np
import numpy.typing as npt

from systems.chemistry.graph import bonded_graph
from systems.scene import Scene

# Amber's radius set mbondi3: hydrogens on the guanidinium of arginine, in nm.
_GUANIDINIUM_H_NM = 0.117


def native_obc2(topology: Any, system: Any) -> Any:
    """OBC2 (Onufriev, Bashford and Case 2004, igb=5) as GBSAOBCForce.

    Charges from the NonbondedForce, radii (mbondi2) and scales from OpenMM's standard OBC2 table.
    """
    from openmm import GBSAOBCForce
    from openmm.app.internal.customgbforces import GBSAOBC2Force

    gb = GBSAOBCForce()
    gb.setNonbondedMethod(GBSAOBCForce.NoCutoff)
    gb.setSoluteDielectric(1.0)
    gb.setSolventDielectric(78.5)
    charges = _charges(system)
    for index, (radius_nm, scale) in enumerate(GBSAOBC2Force.getStandardParameters(topology)):
        gb.addParticle(charges[index], radius_nm, scale)
    return gb


def custom_obc2(topology: Any, system: Any) -> Any:
    """The same energies as `native_obc2` from the CustomGBForce of OpenMM's implicit/obc2.xml."""
    from openmm.app.internal.customgbforces import GBSAOBC2Force

    gb = GBSAOBC2Force(SA="ACE")
    charges = _charges(system)
    for charge, parameters in zip(charges, GBSAOBC2Force.getStandardParameters(topology), strict=True):
        gb.addParticle([charge, *parameters])
    gb.finalize()
    return gb


def gbn2(scene: Scene, topology: Any, system: Any, *, molecule_idx: npt.NDArray[np.int64] | None = None) -> Any:
    """GBn2 (Nguyen, Roe and Simmerling 2013, igb=8) as OpenMM's CustomGBForce, radii mbondi3.

    Atoms in `molecule_idx` (GAFF2) keep their mbondi2 radii: Amber changes those of protein residues alone. Arginine is
    known by its bonds, so that a peptide in residues of other names gets the same energy.
    """
    from openmm.app.internal.customgbforces import GBSAGBn2Force, GBSAOBC2Force

    gb = GBSAGBn2Force(SA="ACE")
    parameters = [list(map(float, row)) for row in GBSAGBn2Force.getStandardParameters(topology)]
    for i in _guanidinium_hydrogens(scene):
        parameters[i][0] = _GUANIDINIUM_H_NM
    if molecule_idx is not None and len(molecule_idx):
        plain = GBSAOBC2Force.getStandardParameters(topology)
        for i in molecule_idx.tolist():
            parameters[i][0] = float(plain[i][0])
    for charge, row in zip(_charges(system), parameters, strict=True):
        gb.addParticle([charge, *row])
    gb.finalize()
    return gb


def _charges(system: Any) -> list[Any]:
    from openmm import NonbondedForce

    nonbonded = next(f for f in system.getForces() if isinstance(f, NonbondedForce))
    return [nonbonded.getParticleParameters(i)[0] for i in range(nonbonded.getNumParticles())]


def _guanidinium_hydrogens(scene: Scene) -> list[int]:
    """Hydrogens on the nitrogens of carbons that have three of them."""
    graph: nx.Graph = bonded_graph(scene)
    symbol = scene.elements
    found = []
    for c in (i for i, e in enumerate(symbol) if e == "C"):
        nitrogens = [n for n in graph[c] if symbol[n] == "N"]
        if len(nitrogens) == 3:
            found += [h for n in nitrogens for h in graph[n] if symbol[h] == "H"]
    return found
