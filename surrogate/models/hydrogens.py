"""Hydrogens placed about heavy atoms: for a model that works on heavy atoms alone.

A heavy atom with two or more heavy neighbours holds its hydrogens where those leave room (CH, CH2, NH, aromatic CH):
their mean place in axes laid through the neighbours is linear in the cosines of the angles between these. One with a
single heavy neighbour is a rotor (methyl, ammonium, amine, hydroxyl): its hydrogens share one angle about the bond,
which moves from frame to frame as it did in the training reference, a Markov chain over N_PHASES directions. About
either, hydrogens swing with the reference's covariance, and bonds have its lengths. Hydrogens turn with the molecule,
and beside three neighbours that of the mirror image lies mirrored.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

# Directions around the circle that a rotor's angle is told by: five degrees each.
N_PHASES = 72
# Terms that a held hydrogen's place has along each axis: one, and each cosine between three neighbours.
_N_TERMS = 4
# Cosines are told from here, between tetrahedral and trigonal.
_USUAL_COSINE = -0.4


@dataclass(frozen=True)
class Site:
    """The `hydrogens` of the heavy atom `parent`, all numbers in the scene's order.

    `around`: of a rotor (`turns`) its heavy neighbour and one further atom that the angle is counted from, else the two
    or three heavy neighbours. `hands`: 2 where the reference shows both sides of a pyramidal nitrogen, else 1.
    """

    parent: int
    hydrogens: tuple[int, ...]
    around: tuple[int, ...]
    turns: bool
    hands: int = 1

    @property
    def n_states(self) -> int:
        return self.hands * (N_PHASES if self.turns else 1)


@dataclass(frozen=True)
class HydrogenPlan:
    """Where a scene of `n_atoms` atoms has its hydrogens; every other atom is heavy."""

    n_atoms: int
    sites: tuple[Site, ...]

    @property
    def heavy(self) -> tuple[int, ...]:
        """The heavy atoms, ascending: those that the model works on, in its order."""
        hydrogens = {h for site in self.sites for h in site.hydrogens}
        return tuple(i for i in range(self.n_atoms) if i not in hydrogens)


class SiteGroup(nn.Module):
    """Sites of one kind: `n` of them with `k` hydrogens each, and what the reference says of these.

    `shape`: of a rotor `(n, hands, k, 2)`, the angle at the parent and that about the bond relative to the site's; else
    `(n, hands, k, 12)`, the weights of the features that place it. `lengths_nm`, `length_spread_nm (n, k)`; `swing
    (n, hands, d, d)` a root of the covariance of what is left, d = 2k angles (rad) or 3k coordinates (nm); `shares
    (n, S)` of the states and `moves (n, S, S)` the probabilities of the next one, from row to column.
    """

    parent: Tensor
    around: Tensor
    three: Tensor
    hydrogens: Tensor
    shape: Tensor
    lengths_nm: Tensor
    length_spread_nm: Tensor
    swing: Tensor
    shares: Tensor
    moves: Tensor

    def __init__(self, sites: list[Site]) -> None:
        super().__init__()
        first = sites[0]
        self.turns, self.hands, self.n_states = first.turns, first.hands, first.n_states
        n, self.k = len(sites), len(first.hydrogens)
        self.n_coordinates = (2 if self.turns else 3) * self.k
        # Numbers drawn for one frame: swings, lengths, the state and the place within it.
        self.n_noise = n * (self.n_coordinates + self.k + 2)
        fixed = {
            "parent": torch.tensor([s.parent for s in sites]),
            "around": torch.tensor([[*s.around, s.around[-1]][:3] for s in sites]),
            "three": torch.tensor([len(s.around) > 2 for s in sites]),
            "hydrogens": torch.tensor([s.hydrogens for s in sites]),
        }
        for name, tensor in fixed.items():
            self.register_buffer(name, tensor, persistent=False)
        self.register_buffer("shape", torch.zeros(n, self.hands, self.k, 2 if self.turns else 3 * _N_TERMS))
        self.register_buffer("lengths_nm", torch.full((n, self.k), 0.1))
        self.register_buffer("length_spread_nm", torch.zeros(n, self.k))
        self.register_buffer("swing", torch.zeros(n, self.hands, self.n_coordinates, self.n_coordinates))
        self.register_buffer("shares", torch.full((n, self.n_states), 1.0 / self.n_states))
        self.register_buffer("moves", torch.full((n, self.n_states, self.n_states), 1.0 / self.n_states))

    # ---- reading frames --------------------------------------------------------------------------------------------

    def axes(self, x: Tensor) -> Tensor:
        """Return the orthonormal axes `(..., n, 3 axes, 3)` of each site in frames `x (..., n_atoms, 3)`.

        A rotor's first axis runs along the bond towards the parent and its second towards the further atom; the others'
        first lies between the two first neighbours and their third is normal to both, towards a third one.
        """
        if self.turns:
            bond = x[..., self.parent, :] - x[..., self.around[:, 0], :]
            side = x[..., self.around[:, 1], :] - x[..., self.around[:, 0], :]
            first = _unit(bond)
            second = _unit(side - (side * first).sum(-1, keepdim=True) * first)
        else:
            near = self._directions(x)
            first, second = _unit(near[..., 0, :] + near[..., 1, :]), _unit(near[..., 0, :] - near[..., 1, :])
        third = torch.linalg.cross(first, second)
        if not self.turns:
            away = (near[..., 2, :] * third).sum(-1, keepdim=True) < 0
            third = torch.where(self.three[:, None] & away, -third, third)
        return torch.stack([first, second, third], dim=-2)

    def features(self, x: Tensor) -> Tensor:
        """Return the vectors `(..., n, 12, 3)` whose weighted sum places hydrogens that do not turn: each axis, by
        itself and times each cosine between neighbours."""
        near = self._directions(x)
        cosines = (near[..., (0, 0, 1), :] * near[..., (1, 2, 2), :]).sum(-1) - _USUAL_COSINE
        # Two neighbours have one angle.
        known = torch.stack([torch.ones_like(self.three), self.three, self.three], dim=-1)
        terms = torch.cat([torch.ones_like(cosines[..., :1]), torch.where(known, cosines, 0.0)], dim=-1)
        return (terms[..., :, None, None] * self.axes(x)[..., None, :, :]).flatten(-3, -2)

    def bonds(self, x: Tensor) -> Tensor:
        """Return the vectors `(..., n, k, 3)` nm from parents to hydrogens in frames of all atoms."""
        return x[..., self.hydrogens, :] - x[..., self.parent, None, :]

    def angles(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return of rotors the angle at the parent and the angle about the bond, `(..., n, k)` rad each: those of
        neighbour-parent-hydrogen and, by the IUPAC convention, of further atom-neighbour-parent-hydrogen."""
        along, second, third = torch.einsum("...naj,...nkj->a...nk", self.axes(x), self.bonds(x))
        return torch.atan2(torch.hypot(second, third), -along), torch.atan2(third, second)

    def hand(self, x: Tensor) -> Tensor:
        """Return the side `(..., n)` that hydrogens stand on: 0 or 1; 0 throughout where there is one hand."""
        if self.hands == 1:
            return torch.zeros(*x.shape[:-2], len(self.parent), dtype=torch.long, device=x.device)
        if self.turns:
            about = self.angles(x)[1]
            return (torch.sin(about[..., 1] - about[..., 0]) > 0).long()
        return ((self.bonds(x)[..., 0, :] * self.axes(x)[..., 2, :]).sum(-1) > 0).long()

    def phase(self, x: Tensor, hand: Tensor) -> Tensor:
        """Return a rotor's angle `(..., n)` rad: the mean over its hydrogens, each less its place in the shape."""
        turned = self.angles(x)[1] - self._of_hand(self.shape, hand)[..., 1]
        return torch.atan2(turned.sin().sum(-1), turned.cos().sum(-1))

    def states(self, x: Tensor) -> Tensor:
        """Return the state `(..., n)` of each site in frames of all atoms: its hand and, of a rotor, its direction."""
        hand = self.hand(x)
        if not self.turns:
            return hand
        place = ((self.phase(x, hand) / (2 * math.pi) + 0.5) * N_PHASES).long().clamp(0, N_PHASES - 1)
        return hand * N_PHASES + place

    # ---- placing ---------------------------------------------------------------------------------------------------

    def forward(self, x: Tensor, last: Tensor | None, noise: Tensor | None) -> Tensor:
        """Return the hydrogens `(b, T, n, k, 3)` nm of frames `x (b, T, n_atoms, 3)`, of which heavy atoms count.

        `last (b, n_atoms, 3)`: the frame before, whose states the first frame's follow from; None draws them from their
        shares. `noise (b, T, n_noise)` standard normal; without it hydrogens neither swing nor turn further.
        """
        b, n_frames, n = x.shape[0], x.shape[1], len(self.parent)
        swing, stretch, draw, within = self._split(x.new_zeros(b, n_frames, self.n_noise) if noise is None else noise)
        states = self._follow(last, torch.special.ndtr(draw.double()), b, still=noise is None)
        hand = states // N_PHASES if self.turns else states
        shape = self._of_hand(self.shape, hand)
        left = torch.einsum("...nij,...nj->...ni", self._of_hand(self.swing, hand), swing)
        length = (self.lengths_nm + self.length_spread_nm * stretch).unsqueeze(-1)
        if self.turns:
            left = left.unflatten(-1, (2, self.k))
            place = (states % N_PHASES).float() + torch.special.ndtr(within)
            phase = place / N_PHASES * (2 * math.pi) - math.pi
            opening = shape[..., 0] + left[..., 0, :]
            about = phase.unsqueeze(-1) + shape[..., 1] + left[..., 1, :]
            parts = (-opening.cos(), opening.sin() * about.cos(), opening.sin() * about.sin())
            directions = torch.einsum("...nka,...naj->...nkj", torch.stack(parts, -1), self.axes(x))
        else:
            mean = _unit(torch.einsum("...nkf,...nfj->...nkj", shape, self.features(x))) * self.lengths_nm[..., None]
            swung = torch.einsum("...nka,...naj->...nkj", left.unflatten(-1, (self.k, 3)), self.axes(x))
            directions = _unit(mean + swung)
        parents = x[..., self.parent, None, :]
        placed: Tensor = parents + length * directions
        assert placed.shape == (b, n_frames, n, self.k, 3)
        return placed

    def _follow(self, last: Tensor | None, uniform: Tensor, b: int, *, still: bool) -> Tensor:
        """Return states `(b, T, n)`, each drawn by its number of `uniform (b, T, n)` from those that follow the one
        before."""
        n = len(self.parent)
        sites = torch.arange(n, device=uniform.device)
        known = None if last is None else self.states(last)
        if self.n_states == 1:
            return torch.zeros(uniform.shape, dtype=torch.long, device=uniform.device)
        if still:
            if known is None:
                known = self.shares.argmax(-1).expand(b, n)
            return known[:, None].expand(uniform.shape)
        shares, moves = _cumulative(self.shares), _cumulative(self.moves)
        found = []
        for t in range(uniform.shape[1]):
            upper = shares.expand(b, n, -1) if known is None else moves[sites, known]
            known = (uniform[:, t, :, None] >= upper).sum(-1).clamp(max=self.n_states - 1)
            found.append(known)
        return torch.stack(found, dim=1)

    def _split(self, noise: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        n = len(self.parent)
        swing, stretch, draw, within = noise.split([n * self.n_coordinates, n * self.k, n, n], dim=-1)
        return swing.unflatten(-1, (n, self.n_coordinates)), stretch.unflatten(-1, (n, self.k)), draw, within

    def _of_hand(self, table: Tensor, hand: Tensor) -> Tensor:
        """Return the rows `(..., n, ...)` of a table `(n, hands, ...)` for hands `(..., n)`."""
        return table[torch.arange(len(self.parent), device=hand.device), hand]

    def _directions(self, x: Tensor) -> Tensor:
        return _unit(x[..., self.around, :] - x[..., self.parent, None, :])


class HydrogenPlacer(nn.Module):
    """Gives frames of heavy atoms their hydrogens."""

    heavy: Tensor

    def __init__(self, plan: HydrogenPlan) -> None:
        super().__init__()
        self.plan = plan
        self.register_buffer("heavy", torch.tensor(plan.heavy), persistent=False)
        kinds: dict[tuple[bool, int, int], list[Site]] = {}
        for site in plan.sites:
            kinds.setdefault((site.turns, len(site.hydrogens), site.hands), []).append(site)
        self.groups = nn.ModuleList(SiteGroup(sites) for _, sites in sorted(kinds.items()))

    @property
    def n_noise(self) -> int:
        """Numbers that one frame takes."""
        return sum(group.n_noise for group in self._groups())

    def forward(self, heavy_nm: Tensor, last_nm: Tensor | None = None, noise: Tensor | None = None) -> Tensor:
        """Frames `(b, T, n_heavy, 3)` nm of heavy atoms -> frames `(b, T, n_atoms, 3)` of all atoms.

        `last_nm (b, n_atoms, 3)` is the frame before, `noise (b, T, n_noise)` standard normal; see `SiteGroup.forward`.
        """
        with torch.autocast(heavy_nm.device.type, enabled=False):
            x = heavy_nm.new_zeros(*heavy_nm.shape[:2], self.plan.n_atoms, 3, dtype=torch.float32)
            x[..., self.heavy, :] = heavy_nm.float()
            last = None if last_nm is None else last_nm.float()
            groups = list(self._groups())
            parts: Iterable[Tensor | None] = [None] * len(groups)
            if noise is not None:
                parts = noise.split([group.n_noise for group in groups], dim=-1)
            placed = [group(x, last, part) for group, part in zip(groups, parts, strict=True)]
            for group, hydrogens in zip(groups, placed, strict=True):
                x[..., group.hydrogens, :] = hydrogens
        return x

    def _groups(self) -> Iterable[SiteGroup]:
        for group in self.groups:
            assert isinstance(group, SiteGroup)
            yield group


def _cumulative(probabilities: Tensor) -> Tensor:
    """Running sums along the last axis, of which the last is one: tables may have been rounded to float16."""
    sums = probabilities.double().cumsum(-1)
    return sums / sums[..., -1:]


def _unit(x: Tensor) -> Tensor:
    return x / x.norm(dim=-1, keepdim=True).clamp(min=1e-9)
