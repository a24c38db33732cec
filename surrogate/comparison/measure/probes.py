"""What is measured beside phi, psi, bonds and validity: index arrays and names, found once per comparison.

`find_probes` looks at the scene and at a sample of the reference; `Probes.measure` measures frames with the result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.torsions import Torsion, find_torsions
from systems.chemistry.geometry import bond_angle, column_blocks, squared_distance, torsion_angle
from systems.scene import Scene

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.floating[Any]]

# The columns of each family, `(n_frames, n_columns)`; see `Probes`.
Family = Literal["torsions", "angles", "shape", "deviation", "contacts", "hydrogen_bonds", "puckers", "secondary"]
FAMILIES: tuple[Family, ...] = (
    "torsions", "angles", "shape", "deviation", "contacts", "hydrogen_bonds", "puckers", "secondary",
)  # fmt: skip

ATOM_CONTACT_NM = 0.45
RESIDUE_CONTACT_NM = 0.8
MAX_COLUMNS = 256
_MANY_RESIDUES = 5
_MANY_ATOMS = 100
_FLAT_RING_NM = 0.01
_ROUNDS = 5
_BACKBONE = ("N", "CA", "C", "O", "OXT")
_HYDROGEN_BOND_NM = 0.25
_HYDROGEN_BOND_COSINE = -0.5
Frames = npt.NDArray[np.floating]
COIL, HELIX, STRAND = 0, 1, 2
# A turn of a 3-10 helix spans four residues, and two that follow each other make it a helix.
LEAST_RESIDUES = 5
_CODES = {"H": HELIX, "E": STRAND}
Float64Array = npt.NDArray[np.float64]
T = TypeVar("T")

# Of more bonds or angles than this, evenly chosen ones have histograms: those of a protein say the same many times.
MOST_HISTOGRAMS = 128


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


@dataclass(frozen=True, eq=False)
class Probes:
    """What every frame of a comparison is measured for. Families and their columns:

    "torsions" `(n, len(torsions))` rad, folded (m times the angle, on [-pi, pi]); "angles" `(n, n_angles)` rad;
    "shape" `(n, 5)`: radius of gyration, RMSD, end-to-end distance (nm), contacts formed, share of the reference's
    contacts kept; "deviation" `(n, n_fit)` squared distance in nm² of each fitted atom from the reference's mean
    structure; "contacts" and "hydrogen_bonds" `(n, k)` bool; "puckers" `(n, 2 n_rings)`: amplitude nm, angle rad;
    "secondary" `(n, n_residues)` int8, the structure of each residue (`secondary_structure`). A frame that is
    not finite has NaN, False in the families of bool, and coil.

    `all_contacts` are the pairs counted in "shape", `contacts` and `hydrogen_bonds` those with a column of their own
    (all, or the `MAX_COLUMNS` that the reference forms most evenly or most often). `native` are the contacts that the
    reference forms in more than half of its frames. What the molecule's symmetry makes equal is chosen together.
    `classes` `(n_atoms,)`: equal for atoms that have no identity of
    their own, such as the hydrogens of a methyl group. `left_out` says what is not measured, and why; `whole` is False
    where atoms of the scene are missing.
    """

    scene: Scene
    torsions: tuple[Torsion, ...]
    angles: IntArray
    fit_idx: IntArray
    mean_nm: npt.NDArray[np.float64]
    ends: tuple[int, int] | None
    contact_nm: float
    all_contacts: IntArray
    contacts: IntArray
    native: IntArray
    hydrogen_bonds: IntArray
    rings: tuple[tuple[int, ...], ...]
    classes: IntArray
    chains: Chains = NO_CHAINS
    left_out: tuple[tuple[str, str], ...] = ()
    whole: bool = True

    def labels(self, family: Family) -> list[str]:
        """Return a name per column of a family."""
        names, scene = self.scene.atom_names, self.scene
        made: dict[Family, Callable[[], list[str]]] = {
            "torsions": lambda: [t.label for t in self.torsions],
            "angles": lambda: [_angle_label(scene, row) for row in self.angles.tolist()],
            "shape": lambda: ["radius of gyration", "RMSD", "end-to-end distance", "contacts", "contacts kept"],
            "deviation": lambda: [f"{names[i]} ({_residue(scene, i)})" for i in self.fit_idx.tolist()],
            "contacts": lambda: [_pair_label(scene, row) for row in self.contacts.tolist()],
            "hydrogen_bonds": lambda: [triplet_label(scene, row) for row in self.hydrogen_bonds],
            "puckers": lambda: [
                f"{what}, {ring_label(scene, ring)}" for ring in self.rings for what in ("amplitude", "angle")
            ],
            "secondary": lambda: list(self.chains.labels),
        }
        return made[family]()

    def measure(self, frames_nm: npt.NDArray[np.float32]) -> dict[Family, npt.NDArray[Any]]:
        """Return every family for frames `(n, n_atoms, 3)` nm."""
        from systems.chemistry.geometry import superpose

        n = len(frames_nm)
        out: dict[Family, npt.NDArray[Any]] = {
            "torsions": np.empty((n, len(self.torsions)), dtype=np.float32),
            "angles": np.empty((n, len(self.angles)), dtype=np.float32),
            "shape": np.full((n, 5), np.nan, dtype=np.float32),
            "deviation": np.empty((n, len(self.fit_idx)), dtype=np.float32),
            "contacts": np.zeros((n, len(self.contacts)), dtype=bool),
            "hydrogen_bonds": np.zeros((n, len(self.hydrogen_bonds)), dtype=bool),
            "puckers": np.empty((n, 2 * len(self.rings)), dtype=np.float32),
            "secondary": secondary_structure(frames_nm, self.chains),
        }
        quads = np.array([q for t in self.torsions for q in t.equal or (t.quad,)], dtype=np.int64).reshape(-1, 4)
        of_torsion = np.repeat(np.arange(len(self.torsions)), [len(t.equal) or 1 for t in self.torsions])
        masses = self.scene.masses_da / max(float(self.scene.masses_da.sum()), 1e-9)
        widest = _widest(self.all_contacts, self.hydrogen_bonds, self.angles)
        with np.errstate(invalid="ignore", over="ignore"):
            moved = superpose(frames_nm[:, self.fit_idx], self.mean_nm)
            squared = ((moved - self.mean_nm.astype(np.float32)) ** 2).sum(axis=2)
            out["deviation"][:] = squared
            out["shape"][:, 1] = np.sqrt(squared.mean(axis=1))
            for start, x in column_blocks(frames_nm, widest):
                part = slice(start, start + x.shape[2])
                angles = torsion_angle(x, quads)
                for k, torsion in enumerate(self.torsions):
                    out["torsions"][part, k] = _folded(angles[of_torsion == k], torsion.fold)
                out["angles"][part] = bond_angle(x, self.angles).T
                out["hydrogen_bonds"][part] = is_formed(x, self.hydrogen_bonds).T
                out["contacts"][part] = (squared_distance(x, self.contacts) < self.contact_nm**2).T
                centre = np.einsum("a,xan->xn", masses, x)
                out["shape"][part, 0] = np.sqrt(np.einsum("a,xan->n", masses, (x - centre[:, None]) ** 2))
                if self.ends is not None:
                    out["shape"][part, 2] = np.sqrt(squared_distance(x, np.array([self.ends]))[0])
                near = squared_distance(x, self.all_contacts) < self.contact_nm**2
                out["shape"][part, 3] = near.sum(axis=0)
                if len(self.native):
                    out["shape"][part, 4] = near[self.native].mean(axis=0)
                for k, ring in enumerate(self.rings):
                    out["puckers"][part, 2 * k : 2 * k + 2] = pucker(x, ring).T
        broken = ~np.isfinite(frames_nm).all(axis=(1, 2))
        if broken.any():
            for values in out.values():
                values[broken] = np.nan if values.dtype.kind == "f" else 0
        return out


def find_probes(
    scene: Scene, sample_nm: FloatArray, *, parent: Scene | None = None, kept: IntArray | None = None
) -> Probes:
    """Return what to measure on `scene`, given finite frames of the reference `(n, n_atoms, 3)` nm.

    Where `scene` is what is left of a larger `parent`, its atoms `kept`, torsions and rings are found in the parent,
    and those whose atoms are all left are measured.
    """
    from systems.chemistry.graph import atom_classes

    whole = parent or scene
    place = {int(atom): k for k, atom in enumerate(range(scene.n_atoms) if kept is None else kept)}
    torsions = tuple(
        t._replace(
            quad=_placed(t.quad, place),
            equal=tuple(_placed(q, place) for q in t.equal if all(i in place for i in q)),
        )
        for t in find_torsions(whole)
        if all(i in place for i in t.quad)
    )
    rings = tuple(_placed(r, place) for r in find_rings(whole) if all(i in place for i in r))
    left_out: list[tuple[str, str]] = []
    angles = _thin(_angles(scene), "angles", left_out)
    fit = _fitted_atoms(scene)
    contacts, contact_nm = _contact_pairs(scene)
    triplets = find_triplets(scene)
    with np.errstate(invalid="ignore"):
        blocks = [block for _, block in column_blocks(sample_nm, _widest(contacts, triplets, angles))]
    classes = atom_classes(whole)[np.arange(scene.n_atoms) if kept is None else kept]
    equal_contacts, equal_triplets = equal_rows(contacts, classes), equal_rows(triplets, classes)
    in_contact = _share(lambda x: squared_distance(x, contacts) < contact_nm**2, blocks, len(contacts))
    bonded = _share(lambda x: is_formed(x, triplets), blocks, len(triplets))
    in_contact, bonded = _evened(in_contact, equal_contacts), _evened(bonded, equal_triplets)
    amplitude = [np.mean(np.concatenate([pucker(b, r)[0] for b in blocks])) for r in rings]
    return Probes(
        scene=scene,
        torsions=torsions,
        angles=angles,
        fit_idx=fit,
        mean_nm=mean_structure(sample_nm[:, fit]) if len(sample_nm) else np.zeros((len(fit), 3)),
        ends=_ends(scene),
        contact_nm=contact_nm,
        all_contacts=contacts,
        contacts=contacts[_foremost(np.minimum(in_contact, 1 - in_contact), equal_contacts, "contacts", left_out)],
        native=np.flatnonzero(in_contact > 0.5),
        hydrogen_bonds=triplets[_foremost(bonded, equal_triplets, "hydrogen bonds", left_out)],
        rings=tuple(r for r, q in zip(rings, amplitude, strict=True) if q > _FLAT_RING_NM),
        classes=classes,
        chains=find_chains(whole, place),
        left_out=tuple(left_out),
        whole=kept is None,
    )


def _folded(angles_rad: FloatArray, fold: int) -> FloatArray:
    """Return `fold` times the torsion told from each of some equal atoms `(k, n)`, their mean direction `(n,)`."""
    turned = fold * angles_rad
    if len(turned) > 1:
        return np.asarray(np.arctan2(np.sin(turned).sum(axis=0), np.cos(turned).sum(axis=0)))
    return np.asarray(turned[0] - 2 * np.pi * np.round(turned[0] / (2 * np.pi)))


def mean_structure(frames_nm: FloatArray) -> npt.NDArray[np.float64]:
    """Return the mean `(n_atoms, 3)` nm of frames laid over it, found by superposing and averaging in turn.

    Starts at the frame in the middle; `_ROUNDS` turns, after which flexible molecules no longer move by more than the
    spread of their frames. Source: generalised Procrustes analysis, Gower, Psychometrika 40, 33 (1975).
    """
    from systems.chemistry.geometry import superpose

    frames = np.asarray(frames_nm, dtype=np.float64)
    mean: npt.NDArray[np.float64] = frames[len(frames) // 2]
    for _ in range(_ROUNDS):
        mean = superpose(frames, mean).mean(axis=0)
    return mean


def _placed(atoms: Sequence[int], place: dict[int, int]) -> Any:
    return tuple(place[i] for i in atoms)


def _widest(*rows: IntArray) -> int:
    return max(1, *(len(r) for r in rows))


def _share(
    formed: Callable[[FloatArray], npt.NDArray[np.bool_]], blocks: Sequence[FloatArray], n: int
) -> npt.NDArray[np.float64]:
    total = sum(block.shape[2] for block in blocks)
    if not total or not n:
        return np.zeros(n)
    return np.asarray(sum(formed(block).sum(axis=1) for block in blocks) / total, dtype=np.float64)


def _evened(share: npt.NDArray[np.float64], groups: Sequence[npt.NDArray[np.intp]]) -> npt.NDArray[np.float64]:
    """Return the share of each `(k,)` with that of equal ones in its place, their mean."""
    out = share.copy()
    for group in groups:
        out[group] = share[group].mean()
    return out


def _foremost(
    share: npt.NDArray[np.float64],
    groups: Sequence[npt.NDArray[np.intp]],
    what: str,
    left_out: list[tuple[str, str]],
) -> IntArray:
    """Return the columns of the greatest share, at most `MAX_COLUMNS`, with all that are equal to one of them."""
    if len(share) <= MAX_COLUMNS:
        return np.arange(len(share))
    chosen: list[int] = []
    for group in sorted(groups, key=lambda g: -share[g[0]]):
        if len(chosen) + len(group) > MAX_COLUMNS:
            break
        chosen += group.tolist()
    left_out.append((f"Single {what}", f"{len(chosen)} of {len(share)} possible ones are followed one by one"))
    return np.sort(np.array(chosen, dtype=np.int64))


def _thin(rows: IntArray, what: str, left_out: list[tuple[str, str]]) -> IntArray:
    if len(rows) <= MAX_COLUMNS:
        return rows
    left_out.append((f"All {what}", f"{MAX_COLUMNS} of {len(rows)}, evenly chosen, are measured"))
    return rows[np.linspace(0, len(rows) - 1, MAX_COLUMNS).astype(int)]


def _angles(scene: Scene) -> IntArray:
    """Bonded triples i-j-k with i < k; only those of heavy atoms where there are more than can be kept."""
    from systems.chemistry.graph import bonded_graph

    graph = bonded_graph(scene)
    rows = [(i, j, k) for j in range(scene.n_atoms) for i in sorted(graph[j]) for k in sorted(graph[j]) if i < k]
    if len(rows) > MAX_COLUMNS:
        rows = [row for row in rows if all(scene.elements[i] != "H" for i in row)]
    return np.array(rows, dtype=np.int64).reshape(-1, 3)


def _fitted_atoms(scene: Scene) -> IntArray:
    """Heavy atoms; alpha carbons of what is large; all atoms where that leaves fewer than three."""
    heavy = scene.heavy_idx
    alphas = _alpha_carbons(scene)
    if len(heavy) > _MANY_ATOMS and len(alphas) >= 3:
        return alphas
    return heavy if len(heavy) >= 3 else np.arange(scene.n_atoms)


def _alpha_carbons(scene: Scene) -> IntArray:
    """One atom per residue: CA by name, in residues that also hold another atom or are called as amino acids."""
    found = [i for i, (name, e) in enumerate(zip(scene.atom_names, scene.elements, strict=True))
             if name == "CA" and e == "C"]  # fmt: skip
    return np.array(found, dtype=np.int64)


def _contact_pairs(scene: Scene) -> tuple[IntArray, float]:
    """Pairs that may touch, and the distance below which they do.

    Chains of `_MANY_RESIDUES` or more: alpha carbons three or more residues apart, 0.8 nm. Otherwise heavy atoms more
    than three bonds apart, 0.45 nm.
    """
    from systems.chemistry.graph import exclusions

    alphas = _alpha_carbons(scene)
    if len(alphas) >= _MANY_RESIDUES:
        residue = scene.residue_of_atom[alphas]
        chain = np.array([scene.chain_of_residue[r] for r in residue.tolist()])
        i, j = np.triu_indices(len(alphas), k=1)
        apart = (np.abs(residue[i] - residue[j]) >= 3) | (chain[i] != chain[j])
        return np.stack([alphas[i[apart]], alphas[j[apart]]], axis=1), RESIDUE_CONTACT_NM
    near = {tuple(p) for p in exclusions(scene).tolist()}
    heavy = scene.heavy_idx.tolist()
    rows = [(i, j) for a, i in enumerate(heavy) for j in heavy[a + 1 :] if (i, j) not in near]
    return np.array(rows, dtype=np.int64).reshape(-1, 2), ATOM_CONTACT_NM


def _ends(scene: Scene) -> tuple[int, int] | None:
    """The two heavy atoms furthest apart in bonds (the lowest such pair), None below four bonds; of chains of three
    residues and more the first and the last alpha carbon, of shorter ones atoms of the backbone or of caps, lest a long
    side chain pass for the end."""
    from systems.chemistry.graph import bonded_graph

    alphas = _alpha_carbons(scene)
    chains = [scene.chain_of_residue[r] for r in scene.residue_of_atom[alphas].tolist()]
    if len(alphas) >= 3 and chains.count(chains[0]) >= 3:
        return int(alphas[0]), int(alphas[len(chains) - 1 - chains[::-1].index(chains[0])])
    called: dict[int, set[str]] = {}
    for i in scene.heavy_idx.tolist():
        called.setdefault(int(scene.residue_of_atom[i]), set()).add(scene.atom_names[i])
    chain = [
        i
        for i in scene.heavy_idx.tolist()
        if scene.atom_names[i] in _BACKBONE or not {"N", "CA", "C"} <= called[int(scene.residue_of_atom[i])]
    ]
    return _furthest(bonded_graph(scene).subgraph(chain))


def _furthest(graph: Any) -> tuple[int, int] | None:
    """The two atoms of a graph furthest apart in bonds, None below four."""
    import networkx as nx

    best, longest = None, 3
    for component in nx.connected_components(graph):
        start = min(component)
        # Twice breadth first finds the longest path of a tree, and nearly so with rings.
        for _ in range(2):
            lengths = nx.single_source_shortest_path_length(graph, start)
            far = min(lengths, key=lambda i: (-lengths[i], i))
            if lengths[far] > longest:
                best, longest = (min(start, far), max(start, far)), lengths[far]
            start = far
    return best


def _residue(scene: Scene, atom: int) -> str:
    residue = int(scene.residue_of_atom[atom])
    return f"{scene.residue_names[residue]} {scene.residue_ids[residue]}"


def _angle_label(scene: Scene, row: Sequence[int]) -> str:
    return f"{'-'.join(scene.atom_names[i] for i in row)} ({_residue(scene, row[1])})"


def _pair_label(scene: Scene, row: Sequence[int]) -> str:
    return " ... ".join(f"{scene.atom_names[i]} ({_residue(scene, i)})" for i in row)


def find_triplets(scene: Scene) -> IntArray:
    """Return all (donor, hydrogen, acceptor) `(k, 3)`: donors and acceptors are N and O at least three bonds apart."""
    from systems.chemistry.graph import bonded_graph, exclusions

    graph = bonded_graph(scene)
    polar = [i for i, e in enumerate(scene.elements) if e in ("N", "O")]
    near = {tuple(p) for p in exclusions(scene, depth=2).tolist()}
    rows = [
        (donor, hydrogen, acceptor)
        for donor in polar
        for hydrogen in sorted(graph[donor])
        if scene.elements[hydrogen] == "H"
        for acceptor in polar
        if acceptor != donor and (min(donor, acceptor), max(donor, acceptor)) not in near
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, 3)


def is_formed(columns: FloatArray, triplets: IntArray) -> npt.NDArray[np.bool_]:
    """Return `(k, n)`: whether each triplet is a hydrogen bond in each frame of coordinates `(3, n_atoms, n)` nm.

    H...A below 0.25 nm and D-H...A above 120°: Baker and Hubbard, Prog. Biophys. Mol. Biol. 44, 97 (1984), as in
    `mdtraj.baker_hubbard`. Frames that are not finite form none.
    """
    donor, hydrogen, acceptor = triplets.T
    with np.errstate(invalid="ignore", over="ignore"):
        to_acceptor = squared_distance(columns, triplets[:, 1:])
        to_donor = squared_distance(columns, triplets[:, :2])
        along = np.zeros_like(to_acceptor)
        for axis in columns:
            along += (axis[donor] - axis[hydrogen]) * (axis[acceptor] - axis[hydrogen])
        bent = along < _HYDROGEN_BOND_COSINE * np.sqrt(to_acceptor * to_donor)
        formed: npt.NDArray[np.bool_] = bent & (to_acceptor < _HYDROGEN_BOND_NM**2)
    return formed


def triplet_label(scene: Scene, triplet: npt.ArrayLike) -> str:
    """Return a name for people: 'N-H (NME 3) ... O (ACE 1)'."""
    donor, hydrogen, acceptor = (int(i) for i in np.asarray(triplet))

    def where(atom: int) -> str:
        residue = int(scene.residue_of_atom[atom])
        return f"({scene.residue_names[residue]} {scene.residue_ids[residue]})"

    names = scene.atom_names
    return f"{names[donor]}-{names[hydrogen]} {where(donor)} ... {names[acceptor]} {where(acceptor)}"


def find_rings(scene: Scene) -> tuple[tuple[int, ...], ...]:
    """Return the rings of 4 to 7 atoms, in order, that hold an atom with four neighbours: those that can pucker."""
    from systems.chemistry.graph import bonded_graph
    from systems.chemistry.validity import small_rings

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


def equal_rows(rows: npt.NDArray[np.int64], classes: npt.NDArray[np.int64]) -> list[npt.NDArray[np.intp]]:
    """Return the groups of `rows` of atoms `(k, m)`, forwards or backwards, that the molecule's symmetry makes equal.

    `classes` `(n_atoms,)` are equal for atoms without an identity of their own. Groups come in order of their first
    row: the six C-H bonds of two equal methyl groups are one, and which hydrogen is called the first does not matter.
    """
    found: dict[tuple[int, ...], list[int]] = {}
    for k, row in enumerate(classes[rows].tolist()):
        found.setdefault(min(tuple(row), tuple(row[::-1])), []).append(k)
    return [np.array(group, dtype=np.intp) for group in found.values()]


def group_labels(labels: Sequence[str], groups: Sequence[npt.NDArray[np.intp]]) -> list[str]:
    """Return the name of the first of each group, and how many more are equal to it."""
    return [labels[g[0]] + (f" and {len(g) - 1} equal" if len(g) > 1 else "") for g in groups]


def evenly(items: Sequence[T], most: int) -> list[T]:
    """Return all items, or at most `most` of them, evenly chosen."""
    return list(items[:: -(-len(items) // most)]) if items else []


def over_groups(values: Float64Array, groups: Sequence[npt.NDArray[np.intp]]) -> Float64Array:
    """Return the means over groups of the last axis, `(..., n_groups)`."""
    if not groups:
        return values[..., :0]
    return np.stack([values[..., g].mean(axis=-1) for g in groups], axis=-1)
