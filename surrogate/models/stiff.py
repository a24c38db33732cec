"""Stiff terms taken from the reference: bonds that it holds rigid, and the width of its other bonds and its angles.

Bonds and angles forget within a picosecond, so a frame's are no more than draws from what its torsions leave them: a
normal distribution about a mean that depends on the torsions. A network comes close to that and stays too narrow; here
they are drawn anew, every torsion left as the network has it. The molecule is placed atom by atom along its tree of
bonds: by a bond length, an angle, and either a torsion or, for an atom beside one that is placed, the angle between
their planes.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from systems.imposed import ANGLES, BONDS, RIGID_BONDS

# A frame with a bond so far off, or an angle so many widths, is no frame of the ensemble: it stays as it was drawn, for
# the guards to see.
MOST_STRETCH, MOST_WIDTHS = 0.2, 6.0
_HARMONICS = 3


@dataclass(frozen=True)
class StiffPlan:
    """Which terms are taken from the reference: the bonds (hydrogen, parent) in `rigid`, and, where there are `rows`,
    all other bonds and angles.

    `rows`: atom, and the up to three placed before it that it is placed by, its parent first; -1 where there are fewer.
    `soft`: the rows whose last number is a torsion; that of the others is the angle between two planes.
    """

    rigid: tuple[tuple[int, int], ...]
    rows: tuple[tuple[int, int, int, int], ...] = ()
    soft: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class StiffTerms:
    """A plan with its numbers, of which those of `rows` may be empty. All tensors are float64.

    `rigid_nm (n_rigid,)` lengths. The drawn terms q are flexible bonds (nm), then angles, then angles between planes
    (rad), each in the order of rows: `rest (n_q,)` their means, `spread (n_q,)` their widths, `weights (n_features,
    n_q)` of their deviation from rest given the torsions, held within `low` and `high (n_q,)`, `root (n_q, n_q)` of the
    covariance about that.
    """

    plan: StiffPlan
    numbers: dict[str, Tensor]

    NAMES = ("rigid_nm", "rest", "spread", "weights", "low", "high", "root")

    @property
    def imposed(self) -> tuple[str, ...]:
        """What a trajectory's record calls these terms (systems.imposed)."""
        rigid = (RIGID_BONDS,) if self.plan.rigid else ()
        return (*rigid, BONDS, ANGLES) if self.plan.rows else rigid

    def apply(self, frames_nm: Tensor, seeds: Sequence[int]) -> Tensor:
        """Return frames `(b, n, n_atoms, 3)` nm with their stiff terms from the reference, row k drawn with `seeds[k]`.

        Torsions stay, and so do place and direction of the tree's first bond. A row does not depend on those beside it.
        """
        frames = frames_nm.double()
        if not self.plan.rows:
            return self._hold(frames)
        size = (frames.shape[1], len(self.numbers["rest"]))
        noise = torch.stack([torch.randn(size, generator=_generator(seed), dtype=torch.float64) for seed in seeds])
        return self.draw(frames.flatten(0, 1), noise.flatten(0, 1)).unflatten(0, frames.shape[:2])

    def draw(self, x: Tensor, noise: Tensor) -> Tensor:
        """Frames `(n, n_atoms, 3)` nm and standard normal `noise (n, n_q)` -> frames with terms drawn given their
        torsions."""
        tree, numbers = self.tree, self.numbers
        lengths, angles, turns = tree.measure(x)
        terms, rest = tree.terms(lengths, angles, turns), numbers["rest"]
        off = tree.deviation(terms, rest)
        mean = (tree.features(turns) @ numbers["weights"]).clamp(numbers["low"], numbers["high"])
        drawn = rest + mean + noise @ numbers["root"].T
        lengths[:, tree.rigid] = numbers["rigid_nm"]
        tree.put(drawn, lengths, angles, turns)
        placed = tree.place(x, lengths, angles, turns)
        n_bonds = len(tree.flexible)
        held = torch.linalg.vector_norm(self._rigid_bonds(x), dim=-1) / numbers["rigid_nm"] - 1.0
        stretch = torch.cat([off[:, :n_bonds] / rest[:n_bonds], held], dim=1).abs()
        widths = (off / numbers["spread"])[:, n_bonds:].abs()
        usual = (stretch < MOST_STRETCH).all(1) & (widths < MOST_WIDTHS).all(1)
        return torch.where(usual[:, None, None], placed, x)

    @cached_property
    def tree(self) -> Tree:
        return Tree(self.plan)

    def _hold(self, frames: Tensor) -> Tensor:
        """Move each hydrogen of a rigid bond along it to its length, in frames where none is far off."""
        bond = self._rigid_bonds(frames)
        length = torch.linalg.vector_norm(bond, dim=-1, keepdim=True)
        kept = self.numbers["rigid_nm"][:, None]
        usual = ((length / kept - 1.0).abs() < MOST_STRETCH).all(dim=-2, keepdim=True)
        hydrogen, parent = self._rigid
        held = frames.index_copy(-2, hydrogen, frames[..., parent, :] + bond / length.clamp(min=1e-9) * kept)
        return torch.where(usual, held, frames)

    def _rigid_bonds(self, frames: Tensor) -> Tensor:
        hydrogen, parent = self._rigid
        return frames[..., hydrogen, :] - frames[..., parent, :]

    @cached_property
    def _rigid(self) -> tuple[Tensor, Tensor]:
        pairs = torch.tensor(self.plan.rigid, dtype=torch.long).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]


class Tree:
    """A plan's rows as index tensors, grouped by what can be placed at once."""

    def __init__(self, plan: StiffPlan) -> None:
        rows = torch.tensor(plan.rows)
        self.atom, self.near, self.next, self.far = rows.T
        held = set(plan.rigid)
        is_rigid = torch.tensor([(row[0], row[1]) in held for row in plan.rows])
        # Rigid rows in the plan's order of rigid bonds.
        row_of = {row[:2]: k for k, row in enumerate(plan.rows)}
        self.rigid = torch.tensor([row_of[pair] for pair in plan.rigid], dtype=torch.long)
        self.flexible = torch.nonzero(~is_rigid)[:, 0]
        self.bent = torch.nonzero(self.next >= 0)[:, 0]
        self.soft = torch.tensor(plan.soft, dtype=torch.long)
        planes = self.far >= 0
        planes[self.soft] = False
        self.planes = torch.nonzero(planes)[:, 0]
        depth = {plan.rows[0][1]: 0}
        for atom, *others in plan.rows:
            depth[atom] = 1 + max(depth[k] for k in others if k >= 0)
        depths = torch.tensor([depth[row[0]] for row in plan.rows])
        whole = self.far >= 0
        self.levels = [
            found
            for level in sorted(set(depths.tolist()))
            if len(found := torch.nonzero((depths == level) & whole)[:, 0])
        ]
        middles = [set(plan.rows[k][1:3]) for k in plan.soft]
        pairs = [(i, j) for j in range(len(middles)) for i in range(j) if middles[i] & middles[j]]
        self.pairs = torch.tensor(pairs, dtype=torch.long).reshape(-1, 2)

    def measure(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return lengths (nm), angles and turns (rad), each `(n, n_rows)`, of frames `(n, n_atoms, 3)`; what a row does
        not have means nothing."""
        first, second = x[:, self.near] - x[:, self.atom], x[:, self.next] - x[:, self.near]
        third = x[:, self.far] - x[:, self.next]
        lengths = torch.linalg.vector_norm(first, dim=-1)
        over, under = torch.linalg.cross(first, second), torch.linalg.cross(second, third)
        angles = torch.atan2(torch.linalg.vector_norm(over, dim=-1), -(first * second).sum(-1))
        sine = (first * under).sum(-1) * torch.linalg.vector_norm(second, dim=-1)
        return lengths, angles, torch.atan2(sine, (over * under).sum(-1))

    def terms(self, lengths: Tensor, angles: Tensor, turns: Tensor) -> Tensor:
        """Return the terms `(n, n_q)` that are drawn."""
        return torch.cat([lengths[:, self.flexible], angles[:, self.bent], turns[:, self.planes]], dim=1)

    def put(self, terms: Tensor, lengths: Tensor, angles: Tensor, turns: Tensor) -> None:
        """Set the terms in what `measure` returned."""
        sizes = [len(self.flexible), len(self.bent), len(self.planes)]
        lengths[:, self.flexible], angles[:, self.bent], turns[:, self.planes] = terms.split(sizes, dim=1)

    def deviation(self, terms: Tensor, rest: Tensor) -> Tensor:
        """Return how far terms lie from `rest`; angles between planes the short way round."""
        off = terms - rest
        n = off.shape[1] - len(self.planes)
        return torch.cat([off[:, :n], torch.remainder(off[:, n:] + math.pi, 2 * math.pi) - math.pi], dim=1)

    def features(self, turns: Tensor) -> Tensor:
        """Return what means are linear in, `(n, n_features)`: one, harmonics of each torsion, products of those whose
        bonds share an atom."""
        soft = turns[:, self.soft]
        parts = [torch.ones_like(turns[:, :1])]
        for harmonic in range(1, _HARMONICS + 1):
            parts += [(harmonic * soft).cos(), (harmonic * soft).sin()]
        cosine, sine = soft.cos(), soft.sin()
        i, j = self.pairs.T
        parts += [one[:, i] * other[:, j] for one in (cosine, sine) for other in (cosine, sine)]
        return torch.cat(parts, dim=1)

    def place(self, x: Tensor, lengths: Tensor, angles: Tensor, turns: Tensor) -> Tensor:
        """Return frames `(n, n_atoms, 3)` with these lengths, angles and turns; the first two bonds lie as in `x`."""
        out = x.clone()
        for k in torch.nonzero(self.far < 0)[:, 0].tolist():
            atom, centre, first = int(self.atom[k]), int(self.near[k]), int(self.next[k])
            along = x[:, atom] - x[:, centre]
            if first < 0:
                out[:, atom] = out[:, centre] + _unit(along) * lengths[:, k, None]
                continue
            axis = _unit(out[:, centre] - out[:, first])
            across = _unit(along - (along * axis).sum(-1, keepdim=True) * axis)
            bent = angles[:, k, None]
            out[:, atom] = out[:, centre] + lengths[:, k, None] * (bent.sin() * across - bent.cos() * axis)
        for rows in self.levels:
            near, beyond = out[:, self.near[rows]], out[:, self.next[rows]]
            axis = _unit(near - beyond)
            normal = _unit(torch.linalg.cross(beyond - out[:, self.far[rows]], axis))
            bent, turn = angles[:, rows, None], turns[:, rows, None]
            across = turn.cos() * torch.linalg.cross(normal, axis) + turn.sin() * normal
            out[:, self.atom[rows]] = near + lengths[:, rows, None] * (bent.sin() * across - bent.cos() * axis)
        return out


def _generator(seed: int) -> torch.Generator:
    """One of its own, so that a chunk's noise stays as it is without these terms."""
    text = f"stiff/{seed}".encode()
    return torch.Generator().manual_seed(int.from_bytes(hashlib.sha256(text).digest()[:8], "little") >> 1)


def _unit(x: Tensor) -> Tensor:
    return x / torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp(min=1e-12)
