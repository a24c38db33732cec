"""Every torsion a molecule can turn about beside phi and psi: omega, chi, rotatable bonds, rotors, symmetry folded; and
the wells of an angle, its states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import networkx as nx
import numpy as np

from surrogate.comparison.measure.statistics import FloatArray, IntArray, Segments
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import atom_classes, backbone_torsions, bonded_graph, rotatable_torsions
from systems.chemistry.validity import small_rings
from systems.scene import Scene

Kind = Literal["ω", "χ", "rotatable", "rotor", "ring"]
Quad = tuple[int, int, int, int]

_FLAT = 0.25
_NEARLY = 0.8
_BINS = 72
# Peaks of an angle are two states where the density between them falls below this share of the lower one.
_SADDLE = 0.5
_LEAST_PEAK = 1e-3


class Torsion(NamedTuple):
    """One torsion: its four atoms, a name for people, its kind, and by how many equal positions it is folded. A `fold`
    of m means that turning by 2π/m gives the same molecule (3 for methyl, 2 for phenyl): m times the angle is measured.
    `equal` are the atoms that could be used as well, `quad` among them: the direction of the mean over them is taken,
    so that it does not matter which hydrogen of a methyl group is called the first."""

    quad: Quad
    label: str
    kind: Kind
    fold: int
    equal: tuple[Quad, ...] = ()


def residue_label(scene: Scene, atom: int) -> str:
    """Return the name of an atom's residue, such as 'ALA 2'."""
    residue = int(scene.residue_of_atom[atom])
    return f"{scene.residue_names[residue]} {scene.residue_ids[residue]}"


def find_torsions(scene: Scene) -> list[Torsion]:
    """Return omega of every peptide bond, chi of every side chain (MDTraj's, by the names of atoms), every other
    rotatable bond, every rotor, a group whose only further atoms are hydrogens (methyl, hydroxyl, ammonium), and one
    torsion within every ring of 4 to 7 atoms that is not flat, which shows its pucker. Phi and psi are left out
    (`structure.backbone` has them)."""
    graph = bonded_graph(scene)
    backbone = backbone_torsions(scene)
    classes = atom_classes(scene).tolist()
    taken = {frozenset(q[1:3]) for name in ("phi", "psi", "omega") for q in backbone[name].tolist()}
    found = [Torsion((a, b, c, d), f"ω {_where(scene, b, c)}", "ω", 1) for a, b, c, d in backbone["omega"].tolist()]
    chi = _chi_torsions(scene)
    for a, b, c, d in rotatable_torsions(scene, rotors=True).tolist():
        if frozenset((b, c)) not in taken:
            found.append(_named(scene, graph, classes, chi, (a, b, c, d)))
    for ring in small_rings(scene):
        # Without hydrogens valence does not show; the torsion of a flat ring stays where it is.
        if "H" not in scene.elements or any(graph.degree(i) == 4 for i in ring):
            a, b, c, d = _puckered(scene, ring)
            found.append(Torsion((a, b, c, d), f"ring {bond_label(scene, b, c)}", "ring", 1))
    return found


def _puckered(scene: Scene, ring: list[int]) -> Quad:
    """Return a torsion of a ring that its pucker turns: the first, from the lowest atom on, that is nearly as far from
    flat as any. The one about a half chair's double bond stays at zero."""
    start = ring.index(min(ring))
    around = [*ring[start:], *ring[:start]] * 2
    quads = [(around[k], around[k + 1], around[k + 2], around[k + 3]) for k in range(len(ring))]
    angles = np.abs(np.asarray(torsion(scene.positions_nm[None], np.array(quads)))[0])
    bent = np.minimum(angles, np.pi - angles)
    return quads[int(np.argmax(bent >= _NEARLY * bent.max()))]


def _chi_torsions(scene: Scene) -> dict[frozenset[int], tuple[Quad, str]]:
    """Return the atoms and the name of every side-chain torsion, by the two atoms of its bond."""
    from mdtraj.geometry import dihedral

    topology = scene.to_mdtraj_topology()
    found = {}
    for number in range(1, 6):
        for a, b, c, d in getattr(dihedral, f"indices_chi{number}")(topology).tolist():
            found[frozenset((b, c))] = ((a, b, c, d), f"χ{number} {residue_label(scene, b)}")
    return found


def _named(
    scene: Scene, graph: nx.Graph, classes: Sequence[int], chi: dict[frozenset[int], tuple[Quad, str]], quad: Quad
) -> Torsion:
    """Return the torsion about the bond of `quad`, chi by its own atoms."""
    kind: Kind = "rotatable"
    if frozenset(quad[1:3]) in chi:
        kind, (quad, label) = "χ", chi[frozenset(quad[1:3])]
    a, b, c, d = quad
    turns = [_equal_positions(scene, graph, classes, *bond) for bond in ((b, c), (c, b))]
    starts, ends = (
        [j for j in sorted(graph[i]) if j != other] if n > 1 else [alone]
        for i, other, alone, n in ((b, c, a, turns[0]), (c, b, d, turns[1]))
    )
    if any(all(scene.elements[j] == "H" for j in graph[i] if j != k) for i, k in ((b, c), (c, b))):
        kind, label = "rotor", f"rotor {bond_label(scene, b, c)}"
    elif kind == "rotatable":
        label = f"torsion {bond_label(scene, b, c)}"
    return Torsion(quad, label, kind, math.lcm(*turns), tuple((i, b, c, j) for i in starts for j in ends))


def _equal_positions(scene: Scene, graph: nx.Graph, classes: Sequence[int], atom: int, other: int) -> int:
    """How many turns about other-atom bring the far side of `atom` onto itself."""
    far = [j for j in graph[atom] if j != other]
    if len({classes[j] for j in far}) != 1:
        return 1
    if len(far) == 2:
        a, b, c = (scene.positions_nm[j] - scene.positions_nm[atom] for j in (*far, other))
        size = float(np.linalg.norm(a) * np.linalg.norm(b) * np.linalg.norm(c))
        return 2 if abs(float(np.dot(np.cross(a, b), c))) < _FLAT * size else 1
    return 3 if len(far) == 3 else 1


def _where(scene: Scene, i: int, j: int) -> str:
    return " - ".join(dict.fromkeys(residue_label(scene, atom) for atom in (i, j)))


def bond_label(scene: Scene, i: int, j: int) -> str:
    """Return a bond's name for people: 'C-N (ACE 1 - ALA 2)' or 'CA-HA (ALA 2)'."""
    return f"{scene.atom_names[i]}-{scene.atom_names[j]} ({_where(scene, i, j)})"


class Wells(NamedTuple):
    """States of one angle: `of_bin` `(72,)` holds the state of each bin of 5 degrees, -1 on a rim between two."""

    of_bin: IntArray
    names: tuple[str, ...]

    def assign(self, segments: Segments) -> list[IntArray]:
        """Return the state of every frame: on a rim, that which was left last."""
        out = []
        for values in segments:
            angle = np.asarray(values, dtype=np.float64)
            finite = np.isfinite(angle)
            raw = np.where(finite, self.of_bin[_bins_of(np.where(finite, angle, 0.0))], -1)
            known = np.flatnonzero(raw >= 0)
            if not len(known):
                out.append(np.zeros(len(raw), dtype=np.int64))
                continue
            before = np.searchsorted(known, np.arange(len(raw)), side="right") - 1
            out.append(raw[known[np.maximum(before, 0)]])
        return out

    def labels(self, segments: Segments) -> list[IntArray]:
        """Return the same, -1 for frames that are not finite."""
        return [np.where(np.isfinite(x), s, -1) for x, s in zip(segments, self.assign(segments), strict=True)]


def find_wells(*samples: Segments, fold: int = 1) -> Wells:
    """Return the states of an angle: peaks of its density, mean over the samples, that a deep enough minimum parts. Of
    an angle times its `fold` names are in degrees of the angle itself."""
    density = np.zeros(_BINS)
    for segments in filter(len, samples):
        values = np.concatenate([np.asarray(x, dtype=np.float64) for x in segments])
        values = values[np.isfinite(values)]
        if len(values):
            density += np.bincount(_bins_of(values), minlength=_BINS) / len(values)
    # What vibrates by 10 degrees is one peak, of however few frames.
    kernel = np.exp(-0.5 * (np.arange(-6, 7) / 2.0) ** 2)
    smooth = sum(w * np.roll(density, k) for k, w in zip(range(-6, 7), kernel / kernel.sum(), strict=True))
    assert isinstance(smooth, np.ndarray)
    edges = _minima(smooth)
    if len(edges) < 2:
        return Wells(np.zeros(_BINS, dtype=np.int64), ("",))
    of_bin = np.searchsorted(edges, np.arange(_BINS), side="right") - 1
    of_bin = np.where(of_bin < 0, len(edges) - 1, of_bin)
    degrees = [f"{(5 * e - 180) / fold:.3g}" for e in edges]
    names = tuple(f"{a}° to {b}°" for a, b in zip(degrees, degrees[1:] + degrees[:1], strict=True))
    rim = np.concatenate([(edges - 2) % _BINS, (edges - 1) % _BINS, edges, (edges + 1) % _BINS])
    cores = of_bin.copy()
    cores[rim] = -1
    # A state that is all rim keeps its bins.
    for k in range(len(names)):
        if not (cores == k).any():
            cores[of_bin == k] = k
    return Wells(cores, names)


def _minima(smooth: FloatArray) -> IntArray:
    """Return the bins at which states of a circular density begin, ascending: the minima between its peaks."""
    before, after = np.roll(smooth, 1), np.roll(smooth, -1)
    peaks = np.flatnonzero((smooth > before) & (smooth >= after) & (smooth > _LEAST_PEAK / 10)).tolist()

    def saddle(a: int, b: int) -> tuple[float, int]:
        path = np.arange(a, b + _BINS * (b <= a) + 1) % _BINS
        # The middle of a level minimum, such as of empty bins.
        lowest = np.flatnonzero(smooth[path] <= smooth[path].min() + 1e-12)
        return float(smooth[path].min()), int(path[lowest[len(lowest) // 2]])

    while len(peaks) > 1:
        depth = [saddle(a, b)[0] / min(smooth[a], smooth[b]) for a, b in zip(peaks, peaks[1:] + peaks[:1], strict=True)]
        worst = int(np.argmax(depth))
        if depth[worst] <= _SADDLE:
            break
        pair = (worst, (worst + 1) % len(peaks))
        peaks.pop(min(pair, key=lambda i: smooth[peaks[i]]))
    if len(peaks) < 2:
        return np.empty(0, dtype=np.int64)
    return np.sort([saddle(a, b)[1] for a, b in zip(peaks, peaks[1:] + peaks[:1], strict=True)])


def _bins_of(angle: FloatArray) -> IntArray:
    return np.floor((angle + math.pi) / (2 * math.pi) * _BINS).astype(np.int64) % _BINS
