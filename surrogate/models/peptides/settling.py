"""Frames of peptides as the flow leaves them, set right by small turns: into their states, and out of each other.

A flow draws some torsions a few degrees beyond the end of the state that it was told, rotors above all, and some atoms
nearer to each other than they ever come in MD. Drawing whole chunks again for that costs more than the chunks
themselves, and favours tight ones. Torsions are mirrored at the end of their state instead, and those of frames in
which atoms overlap are turned downhill until none do: by a few degrees. What takes more is left to be drawn again.
"""

from __future__ import annotations

import torch
from torch import Tensor

from surrogate.models.peptides.chains import ChainFeatures
from surrogate.models.peptides.torsion_states import StatedTorsions

# A torsion is mirrored that is not further beyond the end of its state; it then stands at least so far inside.
_MIRRORED_DEG, _INSIDE_DEG = 30.0, 0.05
# Turns of a frame in which atoms overlap: how many at most, how far each (rad), and how far beyond what it would take.
_TURNS, _FURTHEST, _BEYOND = 8, 0.3, 1.5
# Atoms are moved apart by so much more than they must be.
_ROOM = 1.03
# Frames that are turned at once.
_BLOCK = 1024


def settle(tokens: Tensor, states: Tensor, chain: ChainFeatures) -> tuple[Tensor, Tensor, Tensor]:
    """Tokens `(n, n_residues, n_slots)` of frames that should be in `states` (n, n_residues, MOST_TORSIONS) -> frames
    `(n, n_atoms, 3)` nm, in the pose that the root has; and which of them `(n,)` could not be set right: those with a
    torsion that is in another state, and those in which atoms overlap."""
    tokens, astray = _within_states(tokens, states, chain)
    frames = chain.code.decode(tokens)
    crowded = chain.overlap(frames)
    if not crowded.any():
        return frames, astray, crowded
    for rows in torch.nonzero(crowded)[:, 0].split(_BLOCK):
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
