"""Matching of one scene's atoms to another's: a graph isomorphism that keeps every chirality."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations

import numpy as np
import numpy.typing as npt

from systems.chemistry.geometry import signed_volumes, torsion
from systems.chemistry.symmetry import AtomClasses, classify
from systems.errors import OutOfDomainError
from systems.scene import FloatArray, Scene

_PATIENCE = 50_000
_FLAT = 0.05
_WRONG_HAND = 1000.0


def match_atoms(scene: Scene, template: Scene) -> npt.NDArray[np.int64]:
    """Return `order (n_atoms,)` such that template atom k is scene atom `order[k]`.

    Elements, connectivity, total charge and stereo must agree; names, order, residues and bond orders play no part.
    Of the equivalent assignments one is taken in which every four-coordinate atom keeps its handedness at the two
    scenes' positions, prochiral groups, CH2 and methyl hydrogens included, so that `positions_nm[order]` superposes on
    the template with no group inverted; rotors and planar NH2 take the labelling nearest in torsion.
    Particles of a model system are matched one by one in their order, and their laws must agree.
    Raises OutOfDomainError with the reason: another formula, charge, connectivity or law, the mirror image, a
    stereoisomer.
    """
    if scene.interactions != template.interactions:
        raise OutOfDomainError(f"{scene.name} and {template.name} are under different laws: not the same model system.")
    if scene.interactions is not None:
        return np.arange(scene.n_atoms)
    if sorted(scene.elements) != sorted(template.elements):
        raise OutOfDomainError(f"{scene.name} is {scene.formula}, but {template.name} is {template.formula}.")
    charges = int(scene.formal_charges.sum()), int(template.formal_charges.sum())
    if charges[0] != charges[1]:
        raise OutOfDomainError(f"{scene.name} has charge {charges[0]:+d}, but {template.name} has {charges[1]:+d}.")
    classes, wanted = classify(scene), classify(template)
    if classes.fingerprint != wanted.fingerprint:
        raise OutOfDomainError(_why_not(scene, template, wanted))
    ours, theirs = _Side.of(scene, classes), _Side.of(template, wanted)
    found = None
    for check_planar in (True, False):
        found = _match_skeletons(ours, theirs, check_planar)
        if found is not None:
            break
    if found is None:
        raise OutOfDomainError(f"{scene.name} is a stereoisomer of {template.name}, not the same molecule.")
    return _match_hydrogens(ours, theirs, found)


def _why_not(scene: Scene, template: Scene, theirs: AtomClasses) -> str:
    if classify(scene, stereo=False).fingerprint != classify(template, stereo=False).fingerprint:
        return f"{scene.name} has the formula of {template.name} ({template.formula}) but other bonds."
    if classify(scene, mirrored=True).fingerprint == theirs.fingerprint:
        return f"{scene.name} is the mirror image (enantiomer) of {template.name}."
    return f"{scene.name} is a stereoisomer of {template.name}: some stereocentres or double bonds differ."


@dataclass(frozen=True, eq=False)
class _Side:
    """One of the two molecules as the search sees it; `leaves` are hydrogens with one bond, to a heavy atom."""

    positions_nm: FloatArray
    near: list[list[int]]
    colours: tuple[int, ...]
    leaves: frozenset[int]

    @staticmethod
    def of(scene: Scene, classes: AtomClasses) -> _Side:
        near, symbol = scene.neighbours(), scene.elements
        leaves = (i for i, on in enumerate(near) if symbol[i] == "H" and len(on) == 1 and symbol[on[0]] != "H")
        return _Side(scene.positions_nm, near, classes.colours, frozenset(leaves))


class _Check:
    """A geometric relation among four template atoms that the image must keep."""

    def __init__(self, quad: tuple[int, int, int, int], positive: bool, planar: bool) -> None:
        self.quad, self.positive, self.planar = quad, positive, planar

    def holds(self, positions_nm: FloatArray, image: dict[int, int]) -> bool:
        mapped = [[image[i] for i in self.quad]]
        return _positive(positions_nm, mapped, self.planar) == self.positive


def _positive(positions_nm: FloatArray, quads: list[list[int]], planar: bool) -> bool:
    if planar:
        return bool(np.cos(torsion(positions_nm, quads)[0]) > 0)
    return bool(signed_volumes(positions_nm, quads)[0] > 0)


def _match_skeletons(ours: _Side, theirs: _Side, check_planar: bool) -> dict[int, int] | None:
    """Depth-first search over all atoms but terminal hydrogens, in breadth-first order, checking geometry as it goes.

    Colours leave a choice only among equivalent atoms, and breadth-first order puts these side by side, so a wrong
    choice shows within a few atoms; `_PATIENCE` bounds what is left.
    """
    atoms = _walk(theirs)
    rank = {i: k for k, (i, _) in enumerate(atoms)}
    checks: dict[int, list[_Check]] = {}
    for check in _checks(theirs, set(rank), check_planar):
        checks.setdefault(max(check.quad, key=lambda i: rank[i]), []).append(check)
    by_colour: dict[int, list[int]] = {}
    for i, colour in enumerate(ours.colours):
        if i not in ours.leaves:
            by_colour.setdefault(colour, []).append(i)
    image: dict[int, int] = {}
    used: set[int] = set()

    def candidates(k: int) -> Iterator[int]:
        atom, parent = atoms[k]
        pool = by_colour.get(theirs.colours[atom], []) if parent is None else ours.near[image[parent]]
        mapped = [image[j] for j in theirs.near[atom] if j in image]
        for i in pool:
            if i not in used and ours.colours[i] == theirs.colours[atom] and all(j in ours.near[i] for j in mapped):
                yield i

    if not atoms:
        return image
    stack = [candidates(0)]
    for _ in range(_PATIENCE + 20 * len(atoms)):
        atom = atoms[len(stack) - 1][0]
        if atom in image:
            used.discard(image.pop(atom))
        choice = next(stack[-1], None)
        if choice is None:
            stack.pop()
            if not stack:
                return None
            continue
        image[atom] = choice
        used.add(choice)
        if all(check.holds(ours.positions_nm, image) for check in checks.get(atom, [])):
            if len(stack) == len(atoms):
                return image
            stack.append(candidates(len(stack)))
    return None


def _walk(side: _Side) -> list[tuple[int, int | None]]:
    """Atoms but terminal hydrogens in breadth-first order, rare classes first, each with its parent."""
    kept = [i for i in range(len(side.near)) if i not in side.leaves]
    count: dict[int, int] = {}
    for i in kept:
        count[side.colours[i]] = count.get(side.colours[i], 0) + 1
    out: list[tuple[int, int | None]] = []
    seen: set[int] = set()
    for start in sorted(kept, key=lambda i: (count[side.colours[i]], i)):
        if start in seen:
            continue
        queue: list[tuple[int, int | None]] = [(start, None)]
        seen.add(start)
        for atom, parent in queue:
            out.append((atom, parent))
            for j in side.near[atom]:
                if j not in seen and j not in side.leaves:
                    seen.add(j)
                    queue.append((j, atom))
    return out


def _checks(side: _Side, kept: set[int], check_planar: bool) -> Iterator[_Check]:
    x, near = side.positions_nm, side.near
    for i in kept:
        heavy = [j for j in near[i] if j in kept]
        if len(near[i]) == 4 and len(heavy) >= 3:
            quad = (i, heavy[0], heavy[1], heavy[2])
            yield _Check(quad, _positive(x, [list(quad)], False), planar=False)
    if not check_planar:
        return
    for b, c in ((b, c) for b, on in enumerate(near) for c in on if b < c):
        if b not in kept or c not in kept or len(near[b]) != 3 or len(near[c]) != 3:
            continue
        left = [j for j in near[b] if j != c and j in kept]
        right = [j for j in near[c] if j != b and j in kept]
        tied = any(len(pair) == 2 and side.colours[pair[0]] == side.colours[pair[1]] for pair in (left, right))
        if tied and left and right and _is_flat(x, b, near[b]) and _is_flat(x, c, near[c]):
            quad = (left[0], b, c, right[0])
            yield _Check(quad, _positive(x, [list(quad)], True), planar=True)


def _is_flat(x: npt.NDArray[np.float64], i: int, near: list[int]) -> bool:
    a, b, c = (x[j] - x[i] for j in near)
    size = float(np.linalg.norm(a) * np.linalg.norm(b) * np.linalg.norm(c))
    return abs(float(np.dot(np.cross(a, b), c))) < 5 * _FLAT * size


def _match_hydrogens(ours: _Side, theirs: _Side, image: dict[int, int]) -> npt.NDArray[np.int64]:
    full = dict(image)
    for parent in image:
        free = [j for j in ours.near[image[parent]] if j in ours.leaves]
        hydrogens = [j for j in theirs.near[parent] if j in theirs.leaves]
        if not hydrogens:
            continue
        rows = _hydrogen_rows(theirs.near, full, parent, hydrogens)

        def cost(chosen: tuple[int, ...], hydrogens: list[int] = hydrogens, rows: _Rows = rows) -> float:
            trial = full | dict(zip(hydrogens, chosen, strict=True))
            total = 0.0
            for row, planar in rows:
                mapped = [[trial[i] for i in row]]
                if planar:
                    gap = torsion(ours.positions_nm, mapped)[0] - torsion(theirs.positions_nm, [row])[0]
                    total += 1.0 - float(np.cos(gap))
                elif _positive(ours.positions_nm, mapped, False) != _positive(theirs.positions_nm, [row], False):
                    total += _WRONG_HAND
            return total

        best = min(permutations(free), key=cost) if len(free) > 1 else tuple(free)
        full.update(zip(hydrogens, best, strict=True))
    return np.array([full[k] for k in range(len(theirs.near))], dtype=np.int64)


_Rows = list[tuple[list[int], bool]]


def _hydrogen_rows(near: list[list[int]], mapped: dict[int, int], parent: int, hydrogens: list[int]) -> _Rows:
    """What the labelling of `hydrogens` on `parent` should keep: handedness (False) first, torsions (True) second."""
    rows: _Rows = []
    others = [j for j in near[parent] if j not in hydrogens]
    if len(near[parent]) == 4 and len(hydrogens) >= 2:
        inputs = [*others, *hydrogens][-3:]
        rows.append(([parent, *inputs], False))
    for b in others:
        far = [a for a in near[b] if a != parent and a in mapped]
        if far:
            rows.extend(([far[0], b, parent, h], True) for h in hydrogens)
            break
    return rows
