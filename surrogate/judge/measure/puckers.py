"""Ring puckers: Cremer and Pople's amplitude and angles of saturated rings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from systems.chemistry.geometry import FloatArray
from systems.scene import Scene

Frames = npt.NDArray[np.floating]


def find_rings(scene: Scene) -> tuple[tuple[int, ...], ...]:
    """Return the rings of 4 to 7 atoms, in order, that hold an atom with four neighbours: those that can pucker."""
    from systems.chemistry.geometry_rules import small_rings
    from systems.chemistry.graph import bonded_graph

    graph = bonded_graph(scene)
    # Without hydrogens, valence does not show in the graph; a flat ring is then found by its amplitude.
    has_hydrogen = "H" in scene.elements
    return tuple(
        _from_lowest(ring, graph)
        for ring in small_rings(scene)
        if not has_hydrogen or any(graph.degree(i) == 4 for i in ring)
    )


def _from_lowest(ring: Sequence[int], graph: object) -> tuple[int, ...]:
    start = ring.index(min(ring))
    turned = [*ring[start:], *ring[:start]]
    return tuple(turned if turned[1] < turned[-1] else [turned[0], *turned[:0:-1]])


def ring_label(scene: Scene, ring: Sequence[int]) -> str:
    """Return a name for people: 'ring N-CA-CB-CG-CD (PRO 2)'."""
    residue = int(scene.residue_of_atom[ring[0]])
    names = "-".join(scene.atom_names[i] for i in ring)
    return f"ring {names} ({scene.residue_names[residue]} {scene.residue_ids[residue]})"


def pucker(columns: FloatArray, ring: Sequence[int]) -> FloatArray:
    """Return `(2, n)`: the puckering amplitude Q in nm and an angle in rad, of coordinates `(3, n_atoms, n)` nm.

    The angle is the phase of the second harmonic, phi_2 in [-pi, pi]; for six-membered rings theta in [0, pi] (0 and pi
    are the chairs, pi/2 boats and twists). The first atom is the lowest in the scene, the second its lower neighbour.
    Four-membered rings have no second phase: the angle is 0 or pi, the sign of the fold. Source: Cremer and Pople, J.
    Am. Chem. Soc. 97, 1354 (1975), equations 4 to 14.
    """
    n = len(ring)
    x = columns[:, list(ring)].astype(np.float64)
    x = x - x.mean(axis=1, keepdims=True)
    turn = 2.0 * np.pi * np.arange(n) / n
    first = np.einsum("k,xkn->xn", np.sin(turn), x)
    second = np.einsum("k,xkn->xn", np.cos(turn), x)
    normal = np.cross(first, second, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.sqrt((normal * normal).sum(0))
    height = (x * normal[:, None]).sum(0)
    amplitude = np.sqrt((height**2).sum(0))
    if n == 4:
        angle = np.where(height[0] >= 0, 0.0, np.pi)
    else:
        in_phase = np.sqrt(2.0 / n) * np.einsum("k,kn->n", np.cos(2 * turn), height)
        out_of_phase = -np.sqrt(2.0 / n) * np.einsum("k,kn->n", np.sin(2 * turn), height)
        angle = np.arctan2(out_of_phase, in_phase)
        if n == 6:
            q3 = np.einsum("k,kn->n", np.cos(np.pi * np.arange(6)), height) / np.sqrt(6.0)
            angle = np.arctan2(np.hypot(in_phase, out_of_phase), q3)
    out: FloatArray = np.stack([amplitude, angle])
    return out
