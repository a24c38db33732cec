"""How a peptide's atoms follow from internal coordinates, residue by residue, and the scale of these in references."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice, product

import networkx as nx
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data import fitted_atoms
from surrogate.models.architecture import ModelConfig
from surrogate.models.peptides import chains
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions, bonded_graph, exclusions, match_atoms, ring_bonds
from systems.chemistry.residues import template_for
from systems.chemistry.validity import CLASH_NM, CLASH_SHARE_OF_LEAST, contact_classes
from systems.errors import InputError, OutOfDomainError, PreparationError
from systems.prepare.peptide import build_peptide
from systems.scene import Scene

# Forms of a residue that differ in hydrogens alone, the commonest at pH 7 first.
_FORMS = {"HIS": ("HIE", "HID", "HIP"), "ASP": ("ASP", "ASH"), "GLU": ("GLU", "GLH"), "LYS": ("LYS", "LYN")}
# Hydrogens that a form has more than its residue's commonest.
_EXTRA_H = {"HIP": 1, "ASH": 1, "GLH": 1, "LYN": -1}
# Hydrogens of residues tell most forms apart; of what is left, so many are tried.
_MOST_TRIED = 8


def standard_peptide(scene: Scene) -> tuple[Scene, npt.NDArray[np.int64]]:
    """Return the peptide as `build_peptide` makes it, at the positions of `scene`, and its `order` (n_atoms,): atom k
    is atom `order[k]` of `scene`.

    The sequence is read from the residues' names, those of Amber, CHARMM and GROMACS included; atoms are matched by
    their bonds and handedness. Raises InputError for a scene that is no single chain of the twenty L amino acids
    between their usual ends.
    """
    names = [template.name if (template := template_for(name)) else name for name in scene.residue_names]
    if not any(map(template_for, scene.residue_names)):
        raise InputError(f"{scene.name} is no chain of amino acids.")
    choices, refusal = [_FORMS.get(name, (name,)) for name in names], ""
    try:
        usual = build_peptide("-".join(forms[0] for forms in choices))
        extra = _hydrogens(scene) - _hydrogens(usual)
        choices = [
            tuple(form for form in forms if _EXTRA_H.get(form, 0) == n)
            for forms, n in zip(choices, extra.tolist(), strict=True)
        ]
    except PreparationError as error:
        choices, refusal = [], str(error)
    for forms in islice(product(*choices) if choices else (), _MOST_TRIED):
        try:
            built = build_peptide("-".join(forms))
            order = match_atoms(scene, built)
        except (PreparationError, OutOfDomainError) as error:
            refusal = str(error)
            continue
        return built.with_positions(scene.positions_nm[order]), order
    raise InputError(
        f"{scene.name} is no chain of standard residues with usual ends: {refusal or 'its hydrogens fit no usual form'}"
    )


def _hydrogens(scene: Scene) -> npt.NDArray[np.int64]:
    """Return the number of hydrogens of each residue, `(n_residues,)`."""
    is_hydrogen = np.array(scene.elements) == "H"
    return np.bincount(scene.residue_of_atom[is_hydrogen], minlength=len(scene.residue_names))


# Of the nearest that atoms of two classes come in MD: where frames are mended or drawn again.
_SHARE_OF_NEAREST = 0.96
# A length that varies by less, by rounding alone, is one that the reference holds rigid.
RIGID_NM = 2e-4
# Before the first residue, and after the last.
ENDS = ("<", ">")
_LAGS_PER_DECADE = 8
_LENGTH, _ANGLE, _DIHEDRAL = "length", "angle", "dihedral"
# Where the first residue's atoms are placed from: caps (ACE), then amino acids.
_ROOTS = (("CH3", "C", "O"), ("N", "CA", "C"))
# The free ends of a chain, whose coordinates are alike whatever residue bears them. Proline's nitrogen, which is in a
# ring, bears an end of its own, and so does lysine's, whose rotor has no states.
_AMMONIUM, _CARBOXYLATE = chains.FREE_ENDS
# Glycine's phi has no higher barrier, proline's ring holds it.
_FREE_PHI = ("GLY", "PRO")
# Side chains with as many torsions as there are places.
_LONGEST = ("LYS",)
_BACKBONE = ("N", "CA", "C", "CH3")
# Neighbours of an atom whose bonds point to the corners of a tetrahedron.
_TETRAHEDRAL = {"C": 4, "N": 4, "O": 2, "S": 2}


def chain_layout(scene: Scene) -> chains.ChainLayout:
    """Return how the atoms of one peptide chain, named as by `systems.prepare.peptide.build_peptide`, follow from
    internal coordinates. Raises InputError for a scene that is no single chain with at least one peptide bond."""
    graph = bonded_graph(scene)
    if not len(backbone_torsions(scene)["omega"]) or not nx.is_connected(graph):
        raise InputError(f"{scene.name} is no single peptide chain, which residues as tokens need.")
    return _Builder(scene, graph).layout()


class _Builder:
    """Walks along the bonds of a chain, placing each atom by three before it."""

    def __init__(self, scene: Scene, graph: nx.Graph) -> None:
        self.scene, self.graph = scene, graph
        self.ring = {frozenset(bond) for bond in ring_bonds(scene).tolist()}
        self.residue = scene.residue_of_atom.tolist()
        self.names = self._names()
        self.free_end = self._free_ends()
        self.placed: list[tuple[int, int, int, int]] = []
        self.closing: list[bool] = []
        self.primary: list[int] = []
        self.residue_of: list[int] = []
        self.keys: list[str] = []
        self.motions: list[int] = []

    def layout(self) -> chains.ChainLayout:
        a, b, c = root = self._root()
        self._add(self.residue[b], (_LENGTH, (a, b)), (_LENGTH, (c, b)), (_ANGLE, (a, b, c)))
        before = {a: b, c: b}
        seen, queue = set(root), [b, a, c]
        while queue:
            near = queue.pop(0)
            # From the root's middle the other two stand beside an atom, not behind it.
            next_ = before.get(near, a)
            last = c if near == b else before.get(next_, c if near == a else a)
            beyond = sorted((i for i in self.graph[near] if i not in seen), key=lambda i: self._rank(i, near))
            first = len(self.placed)
            for atom in beyond:
                across = self._ring_neighbours(atom, seen - {near})
                beside = self._ring_neighbours(near, seen - {next_})
                seen.add(atom)
                queue.append(atom)
                before[atom] = near
                if across:
                    self._close(atom, near, across[0], next_)
                elif beside and near != b:
                    # Beside the rest of a ring, whatever that does.
                    self._place(atom, near, next_, beside[0], None)
                else:
                    self._place(atom, near, next_, last, None if near == b else first)
        return chains.ChainLayout(
            self.scene.n_atoms, root, tuple(self.placed), tuple(self.closing), tuple(self.primary),
            tuple(self.residue_of), tuple(self.keys), tuple(self.motions), tuple(self.scene.residue_names),
        )  # fmt: skip

    def _ring_neighbours(self, atom: int, among: set[int]) -> list[int]:
        """Return those of its neighbours `among` some atoms to which a bond of a ring leads, by name."""
        found = [i for i in self.graph[atom] if i in among and frozenset((atom, i)) in self.ring]
        return sorted(found, key=lambda i: self.names[i])

    def _root(self) -> tuple[int, int, int]:
        at = {self.names[i]: i for i in range(self.scene.n_atoms) if self.residue[i] == 0}
        for names in _ROOTS:
            if all(name in at for name in names):
                return at[names[0]], at[names[1]], at[names[2]]
        raise InputError(f"{self.scene.name} begins with {self.scene.residue_names[0]}, no cap and no amino acid.")

    def _names(self) -> list[str]:
        """Return the atoms' names, those of hydrogens on one atom given anew by where they stand: which of two is HB2
        differs between programs, and no motion turns one into the other."""
        names, x = list(self.scene.atom_names), self.scene.positions_nm
        for near in range(self.scene.n_atoms):
            hydrogens = [i for i in self.graph[near] if self.scene.elements[i] == "H"]
            heavy = sorted((i for i in self.graph[near] if i not in hydrogens), key=lambda i: names[i])
            if len(hydrogens) < 2 or not heavy:
                continue
            ordered = sorted(hydrogens, key=lambda i: names[i])
            if len(hydrogens) == 2 and len(heavy) == 1:
                # Flat, as amides are: the one on the side of what lies beyond, first by name, is the first.
                beyond = min((i for i in self.graph[heavy[0]] if i != near), key=lambda i: names[i])
                away = np.abs(torsion(x, [[i, near, heavy[0], beyond] for i in ordered]))
                ordered = [ordered[k] for k in np.argsort(away, kind="stable")]
            else:
                # Around the bond to one neighbour, from another one or from the first hydrogen.
                start = heavy[1] if len(heavy) > 1 else ordered[0]
                turned = torsion(x, [[start, heavy[0], near, i] for i in ordered]) % (2 * np.pi)
                ordered = [
                    ordered[k] for k in np.argsort(np.where(np.array(ordered) == start, 0.0, turned), kind="stable")
                ]
            for atom, name in zip(ordered, sorted(names[i] for i in hydrogens), strict=True):
                names[atom] = name
        return names

    def _free_ends(self) -> dict[int, str]:
        """Return which atoms make up which free end."""
        found: dict[int, str] = {}
        for atom in range(self.scene.n_atoms):
            beside = list(self.graph[atom])
            hydrogens = [i for i in beside if self.scene.elements[i] == "H"]
            oxygens = [i for i in beside if self.scene.elements[i] == "O" and self.graph.degree[i] == 1]
            own = self.scene.residue_names[self.residue[atom]] in _LONGEST
            if self.names[atom] == "N" and len(hydrogens) == 3 and not own:
                found |= dict.fromkeys(hydrogens, _AMMONIUM)
            if self.names[atom] == "C" and len(oxygens) == 2:
                found |= dict.fromkeys(oxygens, _CARBOXYLATE)
        return found

    def _rank(self, atom: int, near: int) -> tuple[bool, bool, str]:
        """Sorts what lies beyond a bond: on along the backbone first, then heavy atoms, then by name."""
        onwards = {"N": ("CA", "CH3"), "CA": ("C",), "C": ("N",)}.get(self.names[near], ())
        along = self.names[atom] in onwards and self.residue[atom] >= self.residue[near]
        return not along, self.scene.elements[atom] == "H", self.names[atom]

    def _place(self, atom: int, near: int, next_: int, last: int, first: int | None) -> None:
        """Place an atom by three; `first`: the row whose dihedral about the same bond is the torsion, if one is."""
        row = len(self.placed)
        self.placed.append((atom, near, next_, last))
        self.closing.append(False)
        self.primary.append(row if first is None else first)
        # Counted from the torsion, a dihedral does not depend on what the torsion is counted from.
        origin = last if first in (None, row) else self.placed[first or 0][0]
        # The next residue's N is placed by this one's psi.
        owner = self.residue[near] if self.names[atom] == "N" else self.residue[atom]
        self._add(
            owner, (_LENGTH, (atom, near)), (_ANGLE, (atom, near, next_)), (_DIHEDRAL, (atom, near, next_, origin)),
            turning=first == row and frozenset((near, next_)) not in self.ring,
        )  # fmt: skip

    def _close(self, atom: int, near: int, across: int, beside: int) -> None:
        """Place the atom that closes a ring by its bonds to both sides, and how far it is out of the plane through them
        and the atom `beside` one: the pucker of a saturated ring, which has two sides as torsions have."""
        self.primary.append(len(self.placed))
        self.placed.append((atom, near, across, beside))
        self.closing.append(True)
        self._add(
            self.residue[atom], (_LENGTH, (atom, near)), (_LENGTH, (atom, across)),
            (_DIHEDRAL, (atom, near, across, beside)), turning=self.graph.degree[atom] == _TETRAHEDRAL["C"],
        )  # fmt: skip

    def _add(self, owner: int, *coordinates: tuple[str, tuple[int, ...]], turning: bool = False) -> None:
        for what, atoms in coordinates:
            self.residue_of.append(owner)
            self.motions.append(chains.TURNING if turning and what == _DIHEDRAL else chains.STIFF)
            names = [self._name(i, owner) for i in atoms]
            if what != _DIHEDRAL and names[0] > names[-1]:
                names.reverse()
            self.keys.append(" ".join((self.free_end.get(atoms[0], self.scene.residue_names[owner]), what, *names)))

    def _name(self, atom: int, owner: int) -> str:
        """Return an atom's name as its coordinate's residue sees it; a cap's methyl stands where a neighbour has CA."""
        away = self.residue[atom] - owner
        if away == 0:
            return self.names[atom]
        return f"{'CA' if self.names[atom] == 'CH3' else self.names[atom]}{away:+d}"


@dataclass(frozen=True)
class PeptideConfig(ModelConfig):
    """`types`: of residues that training saw. `shortest_ps`, `longest_ps`: times after the given frame that it was
    shown. `innovation`: the flow runs on innovations, else on the coordinates themselves. `conditioning_noise`: added
    to the given frame in training, in standard deviations. `turning_weight`: what a torsion's numbers count in the loss
    beside a stiff one. `usual_steps`, `usual_solver`: of rollouts; those that the flow was taught, if it was distilled.
    `coupled`: neighbours' types and new states count in full when states are drawn (`StateJumps`). `solvents`: those
    that training saw, where there are several; the first is meant where none is named. Flow times are logit-normal, as
    elsewhere."""

    width: int = 128
    n_layers: int = 6
    n_heads: int = 4
    chunk_frames: int = 16
    shortest_ps: float = 1.0
    longest_ps: float = 1000.0
    innovation: bool = True
    conditioning_noise: float = 0.03
    turning_weight: float = 4.0
    usual_steps: int = 6
    usual_solver: str = "gaussian"
    tau_location: float = 0.5
    tau_scale: float = 1.4
    coupled: bool = False
    solvents: tuple[str, ...] = ()
    types: tuple[str, ...] = ()
    scale: chains.ChainScale | None = None

    @property
    def forgotten_ps(self) -> float:
        """A time that stands for one at which nothing is left of the given frame."""
        return 10.0 * self.longest_ps

    @property
    def lags_ps(self) -> Tensor:
        """The times at which correlations are kept."""
        decades = math.log10(self.longest_ps / self.shortest_ps)
        n = max(2, round(_LAGS_PER_DECADE * decades) + 1)
        return torch.logspace(math.log10(self.shortest_ps), math.log10(self.longest_ps), n, dtype=torch.float64).float()

    @property
    def n_types(self) -> int:
        """Residue types, and the two ends of a chain."""
        return len(ENDS) + len(self.types)

    def places(self, residues: tuple[str, ...], solvent: str | None = None) -> Tensor:
        """Return the numbers `(n_residues, 4)` of each residue's type, the one's before and the one's after, and of the
        solvent. Raises InputError for a type or a solvent that training did not see."""
        numbers = {name: k for k, name in enumerate((*ENDS, *self.types))}
        if unseen := [name for name in residues if name not in numbers]:
            raise InputError(
                f"residue {unseen[0]} is none that these weights were trained on ({', '.join(self.types)})."
            )
        if solvent is not None and self.solvents and solvent not in self.solvents:
            raise InputError(f"these weights were trained in {' and '.join(self.solvents)}, not in {solvent}.")
        row = [numbers[name] for name in (ENDS[0], *residues, ENDS[1])]
        at = self.solvents.index(solvent) if self.solvents and solvent is not None else 0
        return torch.tensor([row[1:-1], row[:-2], row[2:], [at] * len(residues)]).T


def chain_features(scene: Scene, config: PeptideConfig, solvent: str | None = None) -> chains.ChainFeatures:
    """Return a peptide's features, in a solvent that training saw (None: the first). Raises InputError as
    `chain_layout`, `resolved` and `PeptideConfig.places` do."""
    if config.scale is None:
        raise InputError("these weights do not say how peptides' coordinates are scaled.")
    layout = resolved(chain_layout(scene), config.scale)
    fitted = fitted_atoms(scene)
    template_nm = scene.positions_nm - scene.positions_nm[fitted].mean(axis=0)
    return chains.ChainFeatures(
        chains.ChainCode(layout, config.scale), config.places(layout.types, solvent), template_nm, fitted,
        stated_torsions(scene, layout), _least_distances(scene),
    )  # fmt: skip


def _least_distances(scene: Scene) -> torch.Tensor:
    """Return how near atoms come that are more than three bonds apart, nm `(n_atoms, n_atoms)`: nearly as near as in MD
    (checks of frames allow less, `systems.chemistry.validity`); 0 for all others."""
    classes = contact_classes(scene)
    least = _SHARE_OF_NEAREST / CLASH_SHARE_OF_LEAST * CLASH_NM[classes[:, None], classes]
    near = exclusions(scene, depth=3)
    least[near[:, 0], near[:, 1]] = least[near[:, 1], near[:, 0]] = 0.0
    np.fill_diagonal(least, 0.0)
    return torch.from_numpy(least).float()


def stated_torsions(scene: Scene, layout: chains.ChainLayout) -> chains.StatedTorsions:
    """Return the torsions that have states: phi, psi, and in side chains those about bonds between tetrahedral atoms or
    from one to an aromatic ring, in the order in which they lie outwards, rotors (of methyl groups) among them; the
    side of its plane to which a saturated ring (of proline) is puckered; and, in the last place, the rotor of a free
    end's ammonium."""
    graph = bonded_graph(scene)
    ring = {int(i) for i in ring_bonds(scene).flatten()}
    rows: list[tuple[list[int], int, int, chains.StateBounds]] = []
    taken: dict[int, int] = {}
    for quad in layout.turning:
        atom, near, next_, _ = quad
        residue, names = int(scene.residue_of_atom[near]), tuple(scene.atom_names[i] for i in (atom, near, next_))
        slot, bounds = chains.FIRST_OF_SIDE_CHAIN, chains.RING  # the pucker of a ring, on either side of its plane
        if names[1:] == ("CA", "N"):
            if layout.types[residue] in _FREE_PHI:
                continue
            slot, bounds = 0, chains.PHI
        elif names == ("N", "C", "CA"):
            before_proline = layout.types[residue + 1 : residue + 2] == ("PRO",)
            slot, bounds = 1, chains.PSI_BEFORE_PROLINE if before_proline else chains.PSI
        elif names[1:] == ("N", "CA") and graph.has_edge(near, next_):
            if layout.types[residue] in _LONGEST:
                continue
            slot, bounds = chains.MOST_TORSIONS - 1, chains.THREEFOLD
        elif graph.has_edge(near, next_):
            tetrahedral = all(graph.degree[i] == _TETRAHEDRAL.get(scene.elements[i]) for i in (near, next_))
            slot = taken.get(residue, chains.FIRST_OF_SIDE_CHAIN)
            aromatic = near in ring and atom in ring
            if names[1] in _BACKBONE or not (tetrahedral or aromatic) or slot >= chains.MOST_TORSIONS:
                continue
            taken[residue] = slot + 1
            bounds = chains.THREEFOLD if tetrahedral else chains.RING
        rows.append((list(quad), residue, slot, bounds))
    return chains.StatedTorsions.of(rows, len(layout.types))


def chain_scale(
    frames: Iterable[tuple[chains.ChainLayout, npt.NDArray[np.float32]]], start: chains.ChainScale | None = None
) -> chains.ChainScale:
    """Measure stiff coordinates over frames `(n, n_atoms, 3)` nm of several peptides, each frame as much as any other.

    Lengths that vary by less than RIGID_NM are rigid: their deviation is 0. Residues of one type share slots. What
    `start` has stays as it is; what it lacks is added.
    """
    start = start or chains.ChainScale({}, {}, {}, 0)
    found: dict[str, list[npt.NDArray[np.float64]]] = {}
    turning: dict[str, None] = {}
    mean, deviation, slots = dict(start.mean), dict(start.deviation), dict(start.slots)
    for layout, x in frames:
        values = chains.internal_coordinates(torch.from_numpy(x).double(), layout).numpy()
        for k, (key, motion) in enumerate(zip(layout.keys, layout.motions, strict=True)):
            if key in start.mean or key in start.slots:
                continue
            if motion == chains.TURNING:
                turning[key] = None
            else:
                found.setdefault(key, []).append(values[:, k])
    for key, parts in found.items():
        values = np.concatenate(parts)
        middle = float(values.mean())
        if key.split()[1] == _DIHEDRAL:
            middle = float(np.angle(np.exp(1j * values).mean()))
            values = np.angle(np.exp(1j * (values - middle)))
        mean[key], deviation[key] = middle, float(values.std())
        if key.split()[1] == _LENGTH and deviation[key] < RIGID_NM:
            deviation[key] = 0.0
    taken: dict[str, set[int]] = {}
    for key, slot in slots.items():
        taken.setdefault(key.split()[0], set()).update((slot,) if key in mean else (slot, slot + 1))
    # Torsions first, so that the backbone's stand in the same places for all residues; free ends last, since theirs are
    # at the same places of all.
    order = (*sorted(turning, key=_backbone_first), *sorted(k for k in found if deviation[k] > 0.0))
    for key in sorted(order, key=lambda key: key.split()[0] in chains.FREE_ENDS):
        bearer, wanted = key.split()[0], 2 if key in turning else 1
        if bearer in chains.FREE_ENDS:
            first = 1 + max((slot for some in taken.values() for slot in some), default=-1)
        else:
            full = taken.get(bearer, set()).union(*(taken.get(end, ()) for end in chains.FREE_ENDS))
            first = next(k for k in itertools.count() if full.isdisjoint(range(k, k + wanted)))
        slots[key] = first
        taken.setdefault(bearer, set()).update(range(first, first + wanted))
    n_slots = 1 + max((slot for some in taken.values() for slot in some), default=-1)
    return chains.ChainScale(mean, deviation, slots, max(n_slots, start.n_slots))


def _backbone_first(key: str) -> tuple[int, str]:
    """Sorts torsions by the atom they place: omega, phi, psi, then the others by name."""
    atom = key.split()[2]
    return {"CA": 0, "C": 1, "N+1": 2, "O": 2}.get(atom, 3), key


def unknown_coordinates(layout: chains.ChainLayout, scale: chains.ChainScale) -> list[str]:
    """Return the coordinates of a layout that no data show."""
    pairs = zip(layout.keys, layout.motions, strict=True)
    return [key for key, motion in pairs if key not in (scale.slots if motion == chains.TURNING else scale.mean)]


def resolved(layout: chains.ChainLayout, scale: chains.ChainScale) -> chains.ChainLayout:
    """Return a layout that calls rigid what the data hold rigid. Raises InputError for coordinates no data show."""
    if unknown := unknown_coordinates(layout, scale):
        raise InputError(
            f"{len(unknown)} internal coordinates occur in no training molecule, the first is {unknown[0]!r}; train on "
            "a peptide that has this residue at such a place."
        )
    motions = tuple(
        chains.RIGID if motion == chains.STIFF and scale.deviation[key] == 0.0 else motion
        for key, motion in zip(layout.keys, layout.motions, strict=True)
    )
    return replace(layout, motions=motions)
