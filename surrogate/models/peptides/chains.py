"""Peptides in internal coordinates, residue by residue: an exact code of frames that knows nothing of the sequence.

Every atom is placed by a bond length, a bond angle and a dihedral on three atoms before it (Parsons et al., J. Comput.
Chem. 26, 1063 (2005)), from a root in the first residue onwards. One dihedral about each bond that can turn is the
torsion, given by cosine and sine; the others about that bond by how far they are from it. These, lengths and angles
hardly vary: they are in standard deviations from the mean of their residue type, and those that references hold rigid
are constants. An atom that closes a ring is placed by the lengths of both its bonds in the ring instead of by an angle.
Whatever numbers a network returns, bonds, angles and handedness are as MD has them, and no error grows with chain
length. Each number has a place (slot) in its residue's token, the same for every residue of a type.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional as F

# A number in standard deviations, a torsion's cosine and sine, or what never changes.
STIFF, TURNING, RIGID = 0, 1, 2
# What stands for a residue's type in the keys of a free end's coordinates: hydrogens on the first nitrogen, oxygens on
# the last carbon.
FREE_ENDS = ("NH3+", "COO-")
_TINY = 1e-12
# Held in memory at once.
_MOST_DISTANCES = 4_000_000


@dataclass(frozen=True)
class ChainLayout:
    """How the `n_atoms` atoms of a peptide follow from internal coordinates.

    `root`: three bonded atoms. `placed`: rows (atom, b, c, d), each after those that it is placed by. `closing`: rows
    whose atom is bonded to c as well as to b, and which is placed by that length instead of an angle. `primary`: for
    each row the row whose dihedral its own is counted from (itself where it stands alone). Of the coordinates, three
    for the root (two lengths, an angle) and three for each row (length, angle or other length, dihedral):
    `residue_of`, the residue they belong to; `keys`, their names, equal for residues of one type and for free ends;
    `motions`, STIFF, TURNING or RIGID. `types`: of the residues, by name.
    """

    n_atoms: int
    root: tuple[int, int, int]
    placed: tuple[tuple[int, int, int, int], ...]
    closing: tuple[bool, ...]
    primary: tuple[int, ...]
    residue_of: tuple[int, ...]
    keys: tuple[str, ...]
    motions: tuple[int, ...]
    types: tuple[str, ...]

    @cached_property
    def tables(self) -> tuple[Tensor, Tensor, Tensor]:
        """`placed` (n, 4), `closing` (n,) and `primary` (n,) as tensors."""
        with torch.inference_mode(False):  # gradients may be taken through frames that follow from them
            rows = torch.tensor(self.placed, dtype=torch.long).reshape(-1, 4)
            return rows, torch.tensor(self.closing, dtype=torch.bool), torch.tensor(self.primary, dtype=torch.long)

    @cached_property
    def levels(self) -> list[list[int]]:
        """Rows of `placed` in groups that can be placed at once, one after the other."""
        level_of = dict.fromkeys(self.root, 0)
        found: list[list[int]] = []
        for k, (atom, *refs) in enumerate(self.placed):
            level_of[atom] = 1 + max(level_of[i] for i in refs)
            while len(found) < level_of[atom]:
                found.append([])
            found[level_of[atom] - 1].append(k)
        return found

    @property
    def turning(self) -> list[tuple[int, int, int, int]]:
        """The rows of `placed` whose dihedral is a torsion."""
        return [row for k, row in enumerate(self.placed) if self.motions[3 + 3 * k + 2] == TURNING]


@dataclass(frozen=True)
class ChainScale:
    """Mean and standard deviation of each stiff coordinate by its key, nm or rad; of a rigid one the deviation is 0.

    `slots`: the place of each coordinate's number in its residue's token of `n_slots`; a torsion takes two. Those of
    free ends are no other coordinate's in any residue.
    """

    mean: dict[str, float]
    deviation: dict[str, float]
    slots: dict[str, int]
    n_slots: int


class ChainCode(nn.Module):
    """Frames of one peptide into tokens of its residues and back, exactly but for what is rigid."""

    def __init__(self, layout: ChainLayout, scale: ChainScale) -> None:
        super().__init__()
        self.layout, self.n_slots, self.n_residues = layout, scale.n_slots, len(layout.types)
        stiff, turning = (torch.tensor([motion == one for motion in layout.motions]) for one in (STIFF, TURNING))
        slots = torch.tensor([scale.slots.get(key, 0) for key in layout.keys])
        at = torch.tensor(layout.residue_of) * self.n_slots + slots
        fixed = partial(nn.Buffer, persistent=False)
        self.mean = fixed(torch.tensor([scale.mean.get(key, 0.0) for key in layout.keys], dtype=torch.float64))
        deviation = [scale.deviation.get(key, 1.0) for key in layout.keys]
        self.deviation = fixed(torch.tensor(deviation, dtype=torch.float64))
        self.stiff, self.turning = fixed(stiff.nonzero()[:, 0]), fixed(turning.nonzero()[:, 0])
        self.stiff_at, self.turning_at = fixed(at[stiff]), fixed(at[turning])
        places = torch.zeros(2, self.n_residues * self.n_slots, dtype=torch.bool)
        places[0, self.stiff_at] = True
        places[1, torch.cat([self.turning_at, self.turning_at + 1])] = True
        # Places with stiff numbers and with those of torsions, `(n_residues, n_slots)`; and both.
        filled_stiff, filled_turning = places.unflatten(1, (self.n_residues, self.n_slots))
        self.filled_stiff, self.filled_turning = fixed(filled_stiff), fixed(filled_turning)
        self.filled = nn.Buffer(filled_stiff | filled_turning, persistent=False)

    def encode(self, frames: Tensor) -> Tensor:
        """Frames `(..., n_atoms, 3)` nm -> tokens `(..., n_residues, n_slots)`, zero in empty places; float32."""
        values = internal_coordinates(frames.double(), self.layout)
        tokens = frames.new_zeros(*frames.shape[:-2], self.n_residues * self.n_slots, dtype=torch.float64)
        stiff = values[..., self.stiff] - self.mean[self.stiff]
        # Dihedrals are angles: the nearest way round. Lengths and bond angles never differ by half a turn.
        stiff = (stiff + torch.pi) % (2 * torch.pi) - torch.pi
        tokens[..., self.stiff_at] = stiff / self.deviation[self.stiff]
        tokens[..., self.turning_at] = values[..., self.turning].cos()
        tokens[..., self.turning_at + 1] = values[..., self.turning].sin()
        return tokens.float().unflatten(-1, (self.n_residues, self.n_slots))

    def decode(self, tokens: Tensor) -> Tensor:
        """Tokens `(..., n_residues, n_slots)` -> frames `(..., n_atoms, 3)` nm in the pose that the root has; what
        stands in empty places plays no part, and cosine and sine need not have unit norm. float32."""
        flat = tokens.flatten(-2).double()
        values = self.mean.expand(*flat.shape[:-1], -1).clone()
        values[..., self.stiff] += flat[..., self.stiff_at] * self.deviation[self.stiff]
        values[..., self.turning] = torch.atan2(flat[..., self.turning_at + 1], flat[..., self.turning_at])
        return self._place(values).float()

    def _place(self, values: Tensor) -> Tensor:
        rows, closing, primary = (table.to(values.device) for table in self.layout.tables)
        lengths, angles, dihedrals = (values[..., 3 + k :: 3] for k in range(3))
        own = torch.arange(len(primary), device=values.device) == primary
        dihedrals = torch.where(own, dihedrals, dihedrals + dihedrals[..., primary])
        x = values.new_zeros(*values.shape[:-1], self.layout.n_atoms, 3)
        a, _, c = self.layout.root
        # The middle atom of the root in the origin, the first on the x axis, the third in the plane.
        x[..., a, 0] = values[..., 0]
        x[..., c, 0] = values[..., 1] * values[..., 2].cos()
        x[..., c, 1] = values[..., 1] * values[..., 2].sin()
        for level in self.layout.levels:
            which = torch.tensor(level, device=values.device)
            atom, b_, c_, d_ = rows[which].T
            length, angle = lengths[..., which], angles[..., which]
            if closing[which].any():
                met = _angle_between(length, (x[..., b_, :] - x[..., c_, :]).norm(dim=-1), opposite=angle)
                angle = torch.where(closing[which], met, angle)
            x[..., atom, :] = extend(x[..., d_, :], x[..., c_, :], x[..., b_, :], length, angle, dihedrals[..., which])
        return x


# States of torsions with barriers.

# Beyond the second barrier phi > 0 is the far end of the strands' basin, which reaches across 180 degrees.
POSITIVE_PHI_DEG = (0.0, 130.0)
# Well inside either side, away from both barriers.
POSITIVE_CORE_DEG, NEGATIVE_CORE_DEG = (30.0, 90.0), (-175.0, -45.0)
# Of one residue: phi, psi, then those of its side chain outwards; and of one torsion.
MOST_TORSIONS, MOST_STATES = 7, 3
FIRST_OF_SIDE_CHAIN = 2
# Where the first state begins and where the next ones do, counted from there, degrees: phi (negative, positive), psi
# (strands, helices), a bond between tetrahedral atoms (gauche+, trans, gauche-), one to an aromatic ring (its sides).
# Psi's barrier lies elsewhere before a proline, whose ring is in the way of helices.
StateBounds = tuple[float, tuple[float, float]]
PHI = (POSITIVE_PHI_DEG[1], (360.0 - POSITIVE_PHI_DEG[1], 360.0))
PSI = (75.0, (165.0, 360.0))
PSI_BEFORE_PROLINE = (25.0, (215.0, 360.0))
THREEFOLD = (0.0, (120.0, 240.0))
RING = (0.0, (180.0, 360.0))


@dataclass(frozen=True, eq=False)
class StatedTorsions:
    """The torsions of one peptide that have states: `quads` (n, 4) atoms; `residue` and `slot` (n,), where their states
    are in `(n_residues, MOST_TORSIONS)`; `first_deg` (n,), `edges_deg` (n, 2) as of PHI."""

    quads: Tensor
    residue: Tensor
    slot: Tensor
    first_deg: Tensor
    edges_deg: Tensor
    n_residues: int

    @staticmethod
    def of(rows: list[tuple[list[int], int, int, StateBounds]], n_residues: int) -> StatedTorsions:
        """Return those of `rows`: four atoms, residue, slot, and PHI, PSI, THREEFOLD or RING."""
        quads, residue, slot = (torch.tensor([row[k] for row in rows], dtype=torch.long) for k in range(3))
        first = torch.tensor([bounds[0] for *_, bounds in rows])
        edges = torch.tensor([bounds[1] for *_, bounds in rows]).reshape(-1, MOST_STATES - 1)
        return StatedTorsions(quads.reshape(-1, 4), residue, slot, first, edges, n_residues)

    def to(self, device: torch.device) -> StatedTorsions:
        tensors = {f.name: getattr(self, f.name).to(device) for f in fields(self) if f.name != "n_residues"}
        return replace(self, **tensors)

    @cached_property
    def ends_deg(self) -> Tensor:
        """Where each state begins and the next one does, `(n, MOST_STATES + 1)`, degrees from `first_deg` on."""
        ends = F.pad(self.edges_deg, (1, 1))
        ends[:, -1] = 360.0
        return ends

    @property
    def middles_deg(self) -> Tensor:
        """The middle of each state, `(n, MOST_STATES)`, degrees; of no meaning where there are fewer."""
        return self.first_deg[:, None] + (self.ends_deg[:, 1:] + self.ends_deg[:, :-1]) / 2.0

    @cached_property
    def counts(self) -> Tensor:
        """How many states each torsion has, `(n_residues, MOST_TORSIONS)`; 0 where there is none."""
        found = self.residue.new_zeros(self.n_residues, MOST_TORSIONS)
        found[self.residue, self.slot] = 1 + (self.edges_deg < 360.0).sum(-1)
        return found

    def states(self, angles: Tensor) -> Tensor:
        """Angles of these torsions `(..., n)`, rad -> their states `(..., n_residues, MOST_TORSIONS)`; 0 where there is
        no torsion."""
        ahead = (angles.rad2deg() - self.first_deg) % 360.0
        found = angles.new_zeros(*angles.shape[:-1], self.n_residues, MOST_TORSIONS, dtype=torch.long)
        found[..., self.residue, self.slot] = (ahead[..., None] >= self.edges_deg).sum(-1)
        return found


def conditioning_states(states: Tensor, counts: Tensor) -> Tensor:
    """States `(..., r, MOST_TORSIONS)` -> numbers `(..., r, MOST_TORSIONS * MOST_STATES)`, 1 for the state that each
    torsion is in, 0 for others and where `counts` (r, MOST_TORSIONS) says that there is none."""
    return (F.one_hot(states, MOST_STATES) * (counts > 0)[..., None]).flatten(-2).float()


@dataclass(frozen=True, eq=False)
class ChainFeatures:
    """A peptide's features: its `code`, the types of its residues and their neighbours and the solvent as numbers
    `places` (n_residues, 4), the `template_nm` (n_atoms, 3), which frames are laid on by the atoms `fitted`, the
    torsions that have states, `stated`, and how near two atoms may come, `least_nm` (n_atoms, n_atoms), 0 where they
    are bonded or nearly."""

    code: ChainCode
    places: Tensor
    template_nm: npt.NDArray[np.float64]
    fitted: npt.NDArray[np.int64]
    stated: StatedTorsions
    least_nm: Tensor

    def to(self, device: torch.device) -> ChainFeatures:
        code = copy.deepcopy(self.code).to(device)
        places, least_nm = self.places.to(device), self.least_nm.to(device)
        return replace(self, code=code, places=places, stated=self.stated.to(device), least_nm=least_nm)

    @property
    def solvent(self) -> int:
        """Which of the solvents that training saw the chain is in."""
        return int(self.places[0, 3])

    @property
    def signed(self) -> list[int]:
        """The residues whose phi has two sides, but those before a proline, whose ring leaves them no room."""
        types, residues = (*self.code.layout.types, ""), self.stated.residue[self.stated.slot == 0].tolist()
        return [residue for residue in residues if types[residue + 1] != "PRO"]

    @cached_property
    def stated_at(self) -> Tensor:
        """Where among all numbers of a frame the cosine of each torsion that has states stands, `(n,)`; its sine is
        next."""
        turning = dict(zip(self.code.layout.turning, self.code.turning_at.tolist(), strict=True))
        places = [turning[(a, b, c, d)] for a, b, c, d in self.stated.quads.tolist()]
        return torch.tensor(places, dtype=torch.long, device=self.places.device)

    @cached_property
    def state_at(self) -> Tensor:
        """Which of its residue's torsions each number belongs to, `(n_residues, n_slots)`; -1 without states."""
        found = torch.full_like(self.code.filled, -1, dtype=torch.long).flatten()
        found[self.stated_at] = found[self.stated_at + 1] = self.stated.slot
        return found.reshape(self.code.filled.shape)

    def state_of_numbers(self, states: Tensor) -> Tensor:
        """`states` (..., n_residues, MOST_TORSIONS) of torsions -> that of each number's torsion, `(..., n_residues,
        n_slots)`; 0 where that has none."""
        at = self.state_at.expand(*states.shape[:-1], -1)
        return torch.where(at < 0, 0, states.gather(-1, at.clamp(min=0)))

    def states(self, frames_nm: Tensor) -> Tensor:
        """Return the states of torsions `(..., n_residues, MOST_TORSIONS)` in frames `(..., n_atoms, 3)`."""
        quads = self.stated.quads
        return self.stated.states(dihedral(*(frames_nm[..., quads[:, k], :].float() for k in range(4))))

    def overlap(self, frames_nm: Tensor) -> Tensor:
        """Return in which frames `(..., n_atoms, 3)` atoms come nearer than they may, `(...)`."""
        flat = frames_nm.reshape(-1, *frames_nm.shape[-2:]).float()
        block = max(1, _MOST_DISTANCES // self.least_nm.numel())
        found = [
            (torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist") < self.least_nm).flatten(1).any(-1)
            for x in flat.split(block)
        ]
        return torch.cat(found).reshape(frames_nm.shape[:-2])


def internal_coordinates(x: Tensor, layout: ChainLayout) -> Tensor:
    """Return lengths, angles and dihedrals `(..., 3 + 3 n_placed)` of frames `(..., n_atoms, 3)`; dihedrals that are
    counted from another one as the difference, all in (-π, π] or a full turn beside. Of rows `closing` a ring the other
    bond's length stands in the place of the angle."""
    a, b, c = layout.root
    rows, closing, primary = (table.to(x.device) for table in layout.tables)
    head = torch.stack(
        [(x[..., a, :] - x[..., b, :]).norm(dim=-1), (x[..., c, :] - x[..., b, :]).norm(dim=-1),
         _angle(x[..., a, :], x[..., b, :], x[..., c, :])], dim=-1,
    )  # fmt: skip
    atom, near, next_, last = (x[..., rows[:, k], :] for k in range(4))
    dihedrals = dihedral(atom, near, next_, last)
    own = torch.arange(len(primary), device=x.device) == primary
    dihedrals = torch.where(own, dihedrals, dihedrals - dihedrals[..., primary])
    second = torch.where(closing, (atom - next_).norm(dim=-1), _angle(atom, near, next_))
    body = torch.stack([(atom - near).norm(dim=-1), second, dihedrals], dim=-1)
    return torch.cat([head, body.flatten(-2)], dim=-1)


def dihedral(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Return torsion angles `(...)` of atoms `(..., 3)`, signs by the IUPAC convention."""
    middle = c - b
    first, second = torch.linalg.cross(b - a, middle), torch.linalg.cross(middle, d - c)
    sine = ((b - a) * second).sum(-1) * middle.norm(dim=-1)
    return torch.atan2(sine, (first * second).sum(-1))


def extend(a: Tensor, b: Tensor, c: Tensor, length: Tensor, angle: Tensor, torsion: Tensor) -> Tensor:
    """Return the atom `(..., 3)` bonded to c at this length, angle to b, and torsion about b-c from a."""
    along = _unit(c - b)
    normal = _unit(torch.linalg.cross(b - a, along))
    across = torch.linalg.cross(normal, along)
    flat, up = length * angle.sin() * torsion.cos(), length * angle.sin() * torsion.sin()
    return c - (length * angle.cos())[..., None] * along + flat[..., None] * across + up[..., None] * normal


def _angle(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    u, v = a - b, c - b
    return torch.atan2(torch.linalg.cross(u, v).norm(dim=-1), (u * v).sum(-1))


def _angle_between(one: Tensor, other: Tensor, *, opposite: Tensor) -> Tensor:
    """Return the angle of a triangle between two sides, as near to it as sides can be that do not meet."""
    cosine = (one.square() + other.square() - opposite.square()) / (2.0 * one * other)
    return cosine.clamp(-1.0, 1.0).acos()


def _unit(x: Tensor) -> Tensor:
    return x / (x.square().sum(-1, keepdim=True) + _TINY).sqrt()


# Frames of peptides as the flow leaves them, mended by small turns. A flow draws some torsions a few degrees beyond the
# end of the state that it should be in, and some atoms nearer to each other than they ever come in MD. Drawing whole
# chunks again for that is expensive and favours tight ones: torsions are mirrored at the end of their state instead,
# and those of frames in which atoms overlap are turned downhill until none do.

# A torsion is mirrored that is not further beyond the end of its state; it then stands at least so far inside.
_MIRRORED_DEG, _INSIDE_DEG = 30.0, 0.05
# Turns of a frame in which atoms overlap: how many at most, how far each (rad), and how far beyond what it would take.
_TURNS, _FURTHEST, _BEYOND = 8, 0.3, 1.5
# Atoms are moved apart by so much more than they must be.
_ROOM = 1.03
# Frames that are turned at once.
_TURNED_AT_ONCE = 1024


def mended(tokens: Tensor, states: Tensor, chain: ChainFeatures) -> tuple[Tensor, Tensor, Tensor]:
    """Tokens `(n, n_residues, n_slots)` of frames that should be in `states` (n, n_residues, MOST_TORSIONS) -> frames
    `(n, n_atoms, 3)` nm, in the pose that the root has; and which of them `(n,)` could not be set right: those with a
    torsion that is in another state, and those in which atoms overlap."""
    tokens, astray = _within_states(tokens, states, chain)
    frames = chain.code.decode(tokens)
    crowded = chain.overlap(frames)
    if not crowded.any():
        return frames, astray, crowded
    for rows in torch.nonzero(crowded)[:, 0].split(_TURNED_AT_ONCE):
        turned, strayed = _within_states(_apart(tokens[rows], chain), states[rows], chain)
        frames[rows] = chain.code.decode(turned)
        crowded[rows] = chain.overlap(frames[rows])
        astray[rows] |= strayed
    return frames, astray, crowded


def mirrored(angles: Tensor, states: Tensor, stated: StatedTorsions) -> tuple[Tensor, Tensor]:
    """Return the angles `(..., n)` rad of the torsions that have states, those a little beyond the end of theirs, of
    `states` (..., n_residues, MOST_TORSIONS), mirrored there; and which are further beyond `(..., n)`."""
    own = states[..., stated.residue, stated.slot]
    ends = stated.ends_deg
    row = torch.arange(len(ends), device=own.device)
    low = stated.first_deg + ends[row, own]
    width = ends[row, own + 1] - ends[row, own]
    ahead = (angles.rad2deg() - low) % 360.0
    above, below = ahead - width, 360.0 - ahead
    outside = above >= 0.0
    back = torch.where(above <= below, width - above - _INSIDE_DEG, below + _INSIDE_DEG)
    far = outside & (torch.minimum(above, below) > _MIRRORED_DEG)
    return torch.where(outside & ~far, (low + back).deg2rad(), angles), far


def _within_states(tokens: Tensor, states: Tensor, chain: ChainFeatures) -> tuple[Tensor, Tensor]:
    """Return the tokens with torsions mirrored, and in which frames one is too far beyond its state."""
    at, flat = chain.stated_at, tokens.flatten(-2)
    cosine, sine = flat[..., at], flat[..., at + 1]
    angles, far = mirrored(torch.atan2(sine, cosine), states, chain.stated)
    return _with_torsions(tokens, at, angles), far.any(-1)


def _apart(tokens: Tensor, chain: ChainFeatures) -> Tensor:
    """Return the tokens with torsions turned until no atoms overlap: steps down the gradient of the squared overlaps,
    each as long as reaches zero if these were linear (Polyak)."""
    at = chain.code.turning_at
    with torch.inference_mode(False), torch.enable_grad(), torch.autocast(tokens.device.type, enabled=False):
        # Gradients are not taken through tensors made without them: copies are.
        kept, least = tokens.clone(), chain.least_nm.clone().triu()
        one, other = torch.nonzero(least, as_tuple=True)
        room = _ROOM * least[one, other]
        angles = torch.atan2(kept.flatten(-2)[..., at + 1], kept.flatten(-2)[..., at])
        for _ in range(_TURNS):
            angles = angles.detach().requires_grad_()
            x = chain.code.decode(_with_torsions(kept, at, angles))
            overlaps = (room - (x[:, one] - x[:, other]).norm(dim=-1)).clamp(min=0.0).square().sum(-1)
            if not overlaps.any():
                break
            (slope,) = torch.autograd.grad(overlaps.sum(), angles)
            turn = _BEYOND * overlaps[:, None] / slope.square().sum(-1, keepdim=True).clamp(min=1e-12) * slope
            length = turn.norm(dim=-1, keepdim=True)
            angles = angles - turn * (_FURTHEST / length.clamp(min=_FURTHEST))
        return _with_torsions(kept, at, angles.detach())


def _with_torsions(tokens: Tensor, at: Tensor, angles: Tensor) -> Tensor:
    """Return the tokens with the torsions whose cosines stand at the places `at` of all numbers set to `angles`."""
    flat = tokens.flatten(-2).index_copy(-1, at, angles.cos()).index_copy(-1, at + 1, angles.sin())
    return flat.unflatten(-1, tokens.shape[-2:])
