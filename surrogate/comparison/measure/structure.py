"""What is measured on each frame, in one pass over the positions: torsions, bonds, validity flags, shape, contacts.

`Baseline.of` looks at the reference once and finds index arrays and names (`Probes`); `Baseline.measure` measures every
trajectory alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, TypeVar

import networkx as nx
import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.statistics import AnyFloat, BoolArray, FloatArray, IntArray
from surrogate.comparison.measure.torsions import Torsion, find_torsions, residue_label
from surrogate.comparison.read.ensemble import Ensemble, Flags, InSegments
from systems.chemistry.geometry import bond_angle, column_blocks, squared_distance, superpose, torsion_angle
from systems.chemistry.graph import atom_classes, backbone_torsions, bonded_graph, exclusions
from systems.chemistry.validity import Geometry, check_frames, geometry_from_frames
from systems.scene import Scene

Series = npt.NDArray[np.float32]
Groups = Sequence[npt.NDArray[np.intp]]
T = TypeVar("T")

# The columns of each family, `(n_frames, n_columns)`; see `Probes`.
Family = Literal["torsions", "angles", "shape", "deviation", "contacts", "hydrogen_bonds", "secondary"]

_BLOCK_FRAMES = 2048
_BLOCK_VALUES = 20_000_000
_GEOMETRY_FRAMES = 20_000
_PROBE_FRAMES = 2_000
# A thermal bond is 2 pm or more wide; what is narrower than this was held by a constraint.
CONSTRAINED_BELOW_NM = 5e-4
_ATOM_CONTACT_NM, _RESIDUE_CONTACT_NM = 0.45, 0.8
MAX_COLUMNS = 256
_MANY_RESIDUES = 5
_MANY_ATOMS = 100
_ROUNDS = 5
_BACKBONE = ("N", "CA", "C", "O", "OXT")
_HYDROGEN_BOND_NM, _HYDROGEN_BOND_COSINE = 0.25, -0.5
COIL, HELIX, STRAND = 0, 1, 2
# A turn of a 3-10 helix spans four residues, and two that follow each other make it a helix.
LEAST_RESIDUES = 5
# Of more bonds or angles than this, evenly chosen ones have histograms: those of a protein say the same many times.
MOST_HISTOGRAMS = 128


class Residue(NamedTuple):
    """One residue with both backbone torsions: columns of `Features.phi` and `Features.psi`, and its name."""

    phi: int
    psi: int
    label: str


class Backbone(NamedTuple):
    """Backbone torsions of a scene: quadruples `(k, 4)`, their labels, and the residues that have both."""

    phi: IntArray
    psi: IntArray
    phi_labels: tuple[str, ...]
    psi_labels: tuple[str, ...]
    residues: tuple[Residue, ...]


def backbone(scene: Scene, kept: IntArray | None = None) -> Backbone:
    """Return the backbone torsions of `scene`, found in its bond graph, with labels such as 'ALA 2'; with `kept`, the
    atoms of `scene` that are left, those whose atoms all are, counted among them."""
    phi, psi = (np.asarray(backbone_torsions(scene)[x], dtype=np.int64).reshape(-1, 4) for x in ("phi", "psi"))
    if kept is not None:
        phi, psi = (rows[np.isin(rows, kept).all(axis=1)] for rows in (phi, psi))
    # phi is C-N-CA-C and psi N-CA-C-N: the residue is that of CA.
    of_phi, of_psi = phi[:, 2].tolist(), psi[:, 1].tolist()
    residues = tuple(
        Residue(k, of_psi.index(alpha), residue_label(scene, alpha))
        for k, alpha in enumerate(of_phi)
        if alpha in of_psi
    )
    labels = [tuple(residue_label(scene, alpha) for alpha in alphas) for alphas in (of_phi, of_psi)]
    if kept is not None:
        phi, psi = (np.searchsorted(kept, rows) for rows in (phi, psi))
    return Backbone(phi, psi, labels[0], labels[1], residues)


@dataclass(frozen=True, eq=False)
class Probes:
    """What every frame is measured for, beside phi, psi, bonds and validity. Families and their columns:

    "torsions" `(n, len(torsions))` rad, folded (m times the angle, on [-pi, pi]); "angles" `(n, n_angles)` rad; "shape"
    `(n, 5)`: radius of gyration, RMSD, end-to-end distance (nm), contacts formed, share of the reference's contacts
    kept; "deviation" `(n, n_fit)` squared distance in nm² of each fitted atom from the reference's mean structure;
    "contacts" and "hydrogen_bonds" `(n, k)` bool; "secondary" `(n, n_residues)` int8, the structure of each amino acid
    in `chains`. A frame that is not finite has NaN, False in the families of bool, and coil.

    `all_contacts` are the pairs counted in "shape", `contacts` and `hydrogen_bonds` those with a column of their own
    (all, or the `MAX_COLUMNS` that the reference forms most evenly or most often), `native` those that it forms in more
    than half of its frames. `classes` `(n_atoms,)`: equal for atoms without an identity of their own, such as the
    hydrogens of a methyl group; what they make equal is chosen together. `left_out` says what is not measured, and why.
    """

    scene: Scene
    torsions: tuple[Torsion, ...]
    angles: IntArray
    fit_idx: IntArray
    mean_nm: FloatArray
    ends: tuple[int, int] | None
    contact_nm: float
    all_contacts: IntArray
    contacts: IntArray
    native: IntArray
    hydrogen_bonds: IntArray
    classes: IntArray
    chains: IntArray = field(default_factory=lambda: np.empty((0, 4), np.int64))
    left_out: tuple[tuple[str, str], ...] = ()

    def labels(self, family: Family) -> list[str]:
        """Return a name per column of a family."""

        def joined(*atoms: int, of: int = 0) -> str:
            names = "-".join(self.scene.atom_names[i] for i in atoms)
            return f"{names} ({residue_label(self.scene, atoms[of])})"

        made: dict[str, list[str]] = {
            "torsions": [t.label for t in self.torsions],
            "angles": [joined(*row, of=1) for row in self.angles.tolist()],
            "deviation": [joined(i) for i in self.fit_idx.tolist()],
            "contacts": [f"{joined(i)} ... {joined(j)}" for i, j in self.contacts.tolist()],
            "hydrogen_bonds": [f"{joined(d, h)} ... {joined(a)}" for d, h, a in self.hydrogen_bonds.tolist()],
            "secondary": [residue_label(self.scene, row[1]) for row in self.chains.tolist()],
        }
        return made[family]

    def measure(self, frames_nm: Series) -> dict[Family, npt.NDArray[Any]]:
        """Return every family for frames `(n, n_atoms, 3)` nm."""
        n = len(frames_nm)
        out: dict[Family, npt.NDArray[Any]] = {
            "torsions": np.empty((n, len(self.torsions)), dtype=np.float32),
            "angles": np.empty((n, len(self.angles)), dtype=np.float32),
            "shape": np.full((n, 5), np.nan, dtype=np.float32),
            "deviation": np.empty((n, len(self.fit_idx)), dtype=np.float32),
            "contacts": np.zeros((n, len(self.contacts)), dtype=bool),
            "hydrogen_bonds": np.zeros((n, len(self.hydrogen_bonds)), dtype=bool),
            "secondary": secondary_structure(frames_nm, self.scene, self.chains),
        }
        quads = np.array([q for t in self.torsions for q in t.equal or (t.quad,)], dtype=np.int64).reshape(-1, 4)
        of_torsion = np.repeat(np.arange(len(self.torsions)), [len(t.equal) or 1 for t in self.torsions])
        masses = self.scene.masses_da / max(float(self.scene.masses_da.sum()), 1e-9)
        with np.errstate(invalid="ignore", over="ignore"):
            moved = superpose(frames_nm[:, self.fit_idx], self.mean_nm)
            squared = ((moved - self.mean_nm.astype(np.float32)) ** 2).sum(axis=2)
            out["deviation"][:] = squared
            out["shape"][:, 1] = np.sqrt(squared.mean(axis=1))
            for start, x in column_blocks(frames_nm, _widest(self.all_contacts, self.hydrogen_bonds, self.angles)):
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
        broken = ~np.isfinite(frames_nm).all(axis=(1, 2))
        if broken.any():
            for values in out.values():
                values[broken] = np.nan if values.dtype.kind == "f" else 0
        return out


def find_probes(
    scene: Scene, sample_nm: AnyFloat, *, parent: Scene | None = None, kept: IntArray | None = None
) -> Probes:
    """Return what to measure on `scene`, given finite frames of the reference `(n, n_atoms, 3)` nm. Where `scene` is
    what is left of a larger `parent`, its atoms `kept`, torsions are found in the parent, and those whose atoms are all
    left are measured."""
    whole = parent or scene
    atoms = np.arange(scene.n_atoms) if kept is None else kept
    place = {int(atom): k for k, atom in enumerate(atoms)}

    def placed(rows: Sequence[Sequence[int]]) -> Any:
        return tuple(tuple(place[i] for i in row) for row in rows if all(i in place for i in row))

    torsions = tuple(
        t._replace(quad=placed([t.quad])[0], equal=placed(t.equal)) for t in find_torsions(whole) if placed([t.quad])
    )
    left_out: list[tuple[str, str]] = []
    angles = _angles(scene)
    if len(angles) > MAX_COLUMNS:
        left_out.append(("All angles", f"{MAX_COLUMNS} of {len(angles)}, evenly chosen, are measured"))
        angles = angles[np.linspace(0, len(angles) - 1, MAX_COLUMNS).astype(int)]
    fit = _fitted_atoms(scene)
    contacts, contact_nm = _contact_pairs(scene)
    triplets = find_triplets(scene)
    with np.errstate(invalid="ignore"):
        blocks = [block for _, block in column_blocks(sample_nm, _widest(contacts, triplets, angles))]
    classes = atom_classes(whole)[atoms]
    equal_contacts, equal_triplets = equal_rows(contacts, classes), equal_rows(triplets, classes)
    in_contact = _share(lambda x: squared_distance(x, contacts) < contact_nm**2, blocks, equal_contacts)
    bonded = _share(lambda x: is_formed(x, triplets), blocks, equal_triplets)
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
        classes=classes,
        chains=find_chains(scene),
        left_out=tuple(left_out),
    )


def _folded(angles_rad: FloatArray, fold: int) -> FloatArray:
    """Return `fold` times the torsion by each of some equal atoms `(k, n)`, their mean direction `(n,)`."""
    turned = fold * angles_rad
    if len(turned) > 1:
        return np.asarray(np.arctan2(np.sin(turned).sum(axis=0), np.cos(turned).sum(axis=0)))
    return np.asarray(turned[0] - 2 * np.pi * np.round(turned[0] / (2 * np.pi)))


def mean_structure(frames_nm: AnyFloat) -> FloatArray:
    """Return the mean `(n_atoms, 3)` nm of frames laid over it, found by superposing and averaging in turn from the
    frame in the middle on, `_ROUNDS` times (generalised Procrustes analysis, Gower, Psychometrika 40, 33, 1975)."""
    frames = np.asarray(frames_nm, dtype=np.float64)
    mean: FloatArray = frames[len(frames) // 2]
    for _ in range(_ROUNDS):
        mean = superpose(frames, mean).mean(axis=0)
    return mean


def _widest(*rows: IntArray) -> int:
    return max(1, *(len(r) for r in rows))


def _share(formed: Callable[[AnyFloat], BoolArray], blocks: Sequence[AnyFloat], groups: Groups) -> FloatArray:
    """Return the share of frames `(k,)` in which each is formed, of equal ones their mean."""
    n, total = sum(map(len, groups)), sum(block.shape[2] for block in blocks)
    if not total or not n:
        return np.zeros(n)
    share = np.asarray(sum(formed(block).sum(axis=1) for block in blocks) / total, dtype=np.float64)
    out = share.copy()
    for group in groups:
        out[group] = share[group].mean()
    return out


def _foremost(share: FloatArray, groups: Groups, what: str, left_out: list[tuple[str, str]]) -> IntArray:
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


def _angles(scene: Scene) -> IntArray:
    """Bonded triples i-j-k with i < k; only those of heavy atoms where there are more than can be kept."""
    graph = bonded_graph(scene)
    rows = [(i, j, k) for j in range(scene.n_atoms) for i in sorted(graph[j]) for k in sorted(graph[j]) if i < k]
    if len(rows) > MAX_COLUMNS:
        rows = [row for row in rows if all(scene.elements[i] != "H" for i in row)]
    return np.array(rows, dtype=np.int64).reshape(-1, 3)


def _fitted_atoms(scene: Scene) -> IntArray:
    """Heavy atoms; alpha carbons of what is large; all atoms where that leaves fewer than three."""
    heavy, alphas = scene.heavy_idx, _alpha_carbons(scene)
    if len(heavy) > _MANY_ATOMS and len(alphas) >= 3:
        return alphas
    return heavy if len(heavy) >= 3 else np.arange(scene.n_atoms)


def _alpha_carbons(scene: Scene) -> IntArray:
    named = zip(scene.atom_names, scene.elements, strict=True)
    return np.array([i for i, (name, e) in enumerate(named) if name == "CA" and e == "C"], dtype=np.int64)


def _contact_pairs(scene: Scene) -> tuple[IntArray, float]:
    """Pairs that may touch, and the distance below which they do: in chains of `_MANY_RESIDUES` or more alpha carbons
    three or more residues apart, 0.8 nm; otherwise heavy atoms more than three bonds apart, 0.45 nm."""
    alphas = _alpha_carbons(scene)
    if len(alphas) >= _MANY_RESIDUES:
        residue = scene.residue_of_atom[alphas]
        chain = np.array([scene.chain_of_residue[r] for r in residue.tolist()])
        i, j = np.triu_indices(len(alphas), k=1)
        apart = (np.abs(residue[i] - residue[j]) >= 3) | (chain[i] != chain[j])
        return np.stack([alphas[i[apart]], alphas[j[apart]]], axis=1), _RESIDUE_CONTACT_NM
    near = {tuple(p) for p in exclusions(scene).tolist()}
    heavy = scene.heavy_idx.tolist()
    rows = [(i, j) for a, i in enumerate(heavy) for j in heavy[a + 1 :] if (i, j) not in near]
    return np.array(rows, dtype=np.int64).reshape(-1, 2), _ATOM_CONTACT_NM


def _ends(scene: Scene) -> tuple[int, int] | None:
    """The two heavy atoms furthest apart in bonds (the lowest such pair), None below four bonds; of chains of three
    residues and more the first and the last alpha carbon, of shorter ones atoms of the backbone or of caps."""
    alphas = _alpha_carbons(scene)
    chains = [scene.chain_of_residue[r] for r in scene.residue_of_atom[alphas].tolist()]
    if len(alphas) >= 3 and chains.count(chains[0]) >= 3:
        return int(alphas[0]), int(alphas[len(chains) - 1 - chains[::-1].index(chains[0])])
    residue, heavy = scene.residue_of_atom.tolist(), scene.heavy_idx.tolist()
    called: dict[int, set[str]] = {}
    for i in heavy:
        called.setdefault(residue[i], set()).add(scene.atom_names[i])
    chain = [i for i in heavy if scene.atom_names[i] in _BACKBONE or not {"N", "CA", "C"} <= called[residue[i]]]
    graph = bonded_graph(scene).subgraph(chain)
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


def find_triplets(scene: Scene) -> IntArray:
    """Return all (donor, hydrogen, acceptor) `(k, 3)`: donors and acceptors are N and O at least three bonds apart."""
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


def is_formed(columns: AnyFloat, triplets: IntArray) -> BoolArray:
    """Return `(k, n)`: whether each triplet is a hydrogen bond in each frame of coordinates `(3, n_atoms, n)` nm: H...A
    below 0.25 nm and D-H...A above 120° (Baker and Hubbard, Prog. Biophys. Mol. Biol. 44, 97, 1984, as in
    `mdtraj.baker_hubbard`). Frames that are not finite form none."""
    donor, hydrogen, acceptor = triplets.T
    with np.errstate(invalid="ignore", over="ignore"):
        to_acceptor = squared_distance(columns, triplets[:, 1:])
        to_donor = squared_distance(columns, triplets[:, :2])
        along = np.zeros_like(to_acceptor)
        for axis in columns:
            along += (axis[donor] - axis[hydrogen]) * (axis[acceptor] - axis[hydrogen])
        bent = along < _HYDROGEN_BOND_COSINE * np.sqrt(to_acceptor * to_donor)
        formed: BoolArray = bent & (to_acceptor < _HYDROGEN_BOND_NM**2)
    return formed


def find_chains(scene: Scene) -> IntArray:
    """Return atoms N, CA, C, O of every amino acid `(n_residues, 4)`, by their names; none of fewer than
    `LEAST_RESIDUES`."""
    keys = zip(scene.residue_of_atom.tolist(), scene.atom_names, strict=True)
    place = {key: atom for atom, key in enumerate(keys)}
    rows = [[place.get((k, name), -1) for name in _BACKBONE[:4]] for k in range(len(scene.residue_names))]
    whole = [row for row in rows if min(row) >= 0]
    return np.array(whole if len(whole) >= LEAST_RESIDUES else [], dtype=np.int64).reshape(-1, 4)


def secondary_structure(frames_nm: AnyFloat, scene: Scene, chains: IntArray) -> npt.NDArray[np.int8]:
    """Return `COIL`, `HELIX` or `STRAND` of each amino acid `(n, n_residues)` in frames `(n, n_atoms, 3)` nm.

    DSSP (Kabsch and Sander, Biopolymers 22, 2577, 1983) as MDTraj computes it, in its three letters: helix is H, G and
    I, strand E and B, coil the rest. A frame that is not finite is coil.
    """
    out = np.zeros((len(frames_nm), len(chains)), dtype=np.int8)
    finite = np.isfinite(frames_nm).all(axis=(1, 2))
    if len(chains) and finite.any():
        import mdtraj

        atoms = np.sort(chains.ravel())
        backbone = np.asarray(frames_nm[finite][:, atoms], dtype=np.float32)
        letters = mdtraj.compute_dssp(mdtraj.Trajectory(backbone, scene.to_mdtraj_topology().subset(atoms)))
        out[finite] = HELIX * (letters == "H") + STRAND * (letters == "E")
    return out


def equal_rows(rows: IntArray, classes: IntArray) -> list[npt.NDArray[np.intp]]:
    """Return the groups of `rows` of atoms `(k, m)`, forwards or backwards, that the molecule's symmetry makes equal,
    in order of their first row: the six C-H bonds of two equal methyl groups are one. `classes` `(n_atoms,)` are equal
    for atoms without an identity of their own."""
    found: dict[tuple[int, ...], list[int]] = {}
    for k, row in enumerate(classes[rows].tolist()):
        found.setdefault(min(tuple(row), tuple(row[::-1])), []).append(k)
    return [np.array(group, dtype=np.intp) for group in found.values()]


def group_labels(labels: Sequence[str], groups: Groups) -> list[str]:
    """Return the name of the first of each group, and how many more are equal to it."""
    return [labels[g[0]] + (f" and {len(g) - 1} equal" if len(g) > 1 else "") for g in groups]


def over_groups(values: FloatArray, groups: Groups) -> FloatArray:
    """Return the means over groups of the last axis, `(..., n_groups)`."""
    if not groups:
        return values[..., :0]
    return np.stack([values[..., g].mean(axis=-1) for g in groups], axis=-1)


def evenly(items: Sequence[T], most: int) -> list[T]:
    """Return all items, or at most `most` of them, evenly chosen."""
    return list(items[:: -(-len(items) // most)]) if items else []


@dataclass(frozen=True, eq=False)
class Features(InSegments):
    """Per-frame measurements of one ensemble, one array per segment.

    `phi` `(n, n_phi)` and `psi` `(n, n_psi)` rad, `bonds_nm` `(n, n_bonds)`, `flags` `(n,)`; all NaN-carrying where a
    frame is not finite. `chunk_idx` `(n,)` or None;
    `moved_nm` `(n,)` how far atoms are, root mean square, from where they were in the frame before
    (NaN for the first), centres of both laid together, or None; `grid_nm` what coordinates were rounded to, 0 for
    nothing. `series` holds the families `(n, k)` of `probes`, both or neither.
    """

    label: str
    lag_ps: float
    phi: Sequence[Series]
    psi: Sequence[Series]
    bonds_nm: Sequence[Series]
    flags: Sequence[Flags]
    chunk_idx: Sequence[npt.NDArray[np.int32]] | None
    series: Mapping[Family, Sequence[npt.NDArray[Any]]] = field(default_factory=dict)
    probes: Probes | None = None
    moved_nm: Sequence[Series] | None = None
    grid_nm: float = 0.0

    @property
    def segment_lengths(self) -> list[int]:
        return [len(f) for f in self.flags]

    def column(self, family: Family | Literal["phi", "psi"], k: int) -> list[npt.NDArray[Any]]:
        """Return one column `(n,)` per segment of phi, of psi or of a family."""
        columns = self.phi if family == "phi" else self.psi if family == "psi" else self.series[family]
        return [x[:, k] for x in columns]

    def frames(self, start: int, stop: int) -> Features:
        """Return frames `start:stop`, counted through the segments in order; segments keep their bounds."""
        spans = []
        offset = 0
        for n in self.segment_lengths:
            spans.append((max(start - offset, 0), max(min(stop - offset, n), 0)))
            offset += n

        def cut(series: Sequence[npt.NDArray[Any]]) -> list[npt.NDArray[Any]]:
            return [s[a:b] for s, (a, b) in zip(series, spans, strict=True) if b > a]

        names = ("phi", "psi", "bonds_nm", "flags", "chunk_idx", "moved_nm")
        parts: dict[str, Any] = {name: cut(getattr(self, name)) for name in names if getattr(self, name) is not None}
        return replace(self, **parts, series={family: cut(values) for family, values in self.series.items()})


class Baseline(NamedTuple):
    """What every frame of a comparison is measured by: torsions of the backbone, what valid frames look like, and what
    else is measured, `probes`, None for nothing."""

    torsions: Backbone
    geometry: Geometry
    probes: Probes | None

    @staticmethod
    def of(
        reference: Ensemble, *, parent: Scene | None = None, kept: IntArray | None = None, probing: bool = True
    ) -> Baseline:
        """Return the baseline that a reference gives: geometry from at most 20,000 of its frames, probes (where
        `probing`) chosen on at most 2,000. `parent`, `kept`: see `backbone` and `find_probes`."""
        scene = reference.scene
        probes = find_probes(scene, reference.sample(_PROBE_FRAMES), parent=parent, kept=kept) if probing else None
        geometry = geometry_from_frames(scene, reference.sample(_GEOMETRY_FRAMES))
        return Baseline(backbone(parent or scene, kept), geometry, probes)

    def measure(self, ensemble: Ensemble) -> Features:
        """Measure every frame of `ensemble`, block by block: no more than a block of positions is held at a time."""
        torsions, geometry, probes = self.torsions, self.geometry, self.probes
        bonds = np.asarray(geometry.bond_idx, dtype=np.int64).reshape(-1, 2)
        phi, psi, lengths, flags, moved = [], [], [], [], []
        series: dict[Family, list[npt.NDArray[Any]]] = {}
        size = max(min(_BLOCK_FRAMES, _BLOCK_VALUES // max(3 * ensemble.scene.n_atoms, 1)), 1)
        for segment in ensemble.segments:
            n = len(segment)
            phi.append(np.empty((n, len(torsions.phi)), dtype=np.float32))
            psi.append(np.empty((n, len(torsions.psi)), dtype=np.float32))
            lengths.append(np.empty((n, len(bonds)), dtype=np.float32))
            flags.append(np.empty(n, dtype=np.uint16))
            moved.append(np.full(n, np.nan, dtype=np.float32))
            before = np.empty((0, ensemble.scene.n_atoms, 3), dtype=np.float32)
            for start in range(0, n, size):
                part = slice(start, min(start + size, n))
                block = segment[part]
                broken = ~np.isfinite(block).all(axis=(1, 2))
                before = _moved(before, block, moved[-1][part])
                with np.errstate(invalid="ignore", over="ignore"):
                    for first, x in column_blocks(block, max(len(bonds), 1)):
                        rows = slice(start + first, start + first + x.shape[2])
                        phi[-1][rows] = torsion_angle(x, torsions.phi).T
                        psi[-1][rows] = torsion_angle(x, torsions.psi).T
                        lengths[-1][rows] = np.sqrt(squared_distance(x, bonds)).T
                    flags[-1][part] = check_frames(block, geometry)
                for column in (phi[-1], psi[-1], lengths[-1]):
                    column[part][broken] = np.nan
                for family, values in (probes.measure(block) if probes is not None else {}).items():
                    if start == 0:
                        series.setdefault(family, []).append(np.empty((n, values.shape[1]), dtype=values.dtype))
                    series[family][-1][part] = values
        return Features(
            ensemble.label, ensemble.lag_ps, phi, psi, lengths, flags, ensemble.chunk_idx, series, probes, moved,
            ensemble.grid_nm,
        )  # fmt: skip


def _moved(before: Series, block: Series, out: Series) -> Series:
    """Write how far each frame of `block` is from the one before it, `before` `(0 or 1, n_atoms, 3)` being that of the
    first; return the last frame."""
    frames = np.concatenate([before, block])
    with np.errstate(invalid="ignore", over="ignore"):
        centred = frames - frames.mean(axis=1, keepdims=True)
        step = np.sqrt((np.diff(centred, axis=0) ** 2).sum(axis=2).mean(axis=1))
    out[len(out) - len(step) :] = step
    return np.asarray(frames[-1:])
