"""Modes of motion that reach over the whole molecule, learned in its own frame: ours, beside PAINET's attention.

To first order in its excursions a molecule's future is linear in its state, x(t) = <x> + A(t) (x - <x>) + B(t) v, with
all pairs of atoms in A and B: normal modes. Attention between scalar embeddings cannot carry vectors, and EGNN's
messages carry no neighbour's velocity. Here every atom has a row in each mode, told from its surroundings and its place
in the template; amplitudes are sums over atoms, and what they do to each later frame is one number per mode and frame,
the cosine and sine of a normal mode if that were all there is. The cost is linear in atoms. Superposing the molecule on
its template makes it exactly equivariant to rotations and translations; reflections are told apart. Where groups turn
freely (a methyl on a ring) a linear map in one frame does not help.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

# Root mean square excursion from the template, in the model's unit (0.1 nm).
EXCURSION = 0.2
# Share of the shorter of a template's two long axes in the longer below which atoms lie in a line: no frame is theirs.
NARROWEST = 1e-3
OUTPUT_SCALE = 0.25


def centred_template(template_nm: Tensor, masses_da: Tensor, length_scale_nm: float) -> Tensor | None:
    """Return the template about its centre of mass in the model's unit, None where its atoms lie in a line."""
    share = (masses_da / masses_da.sum())[:, None]
    centred = (template_nm - (share * template_nm).sum(0)) / length_scale_nm
    along = torch.linalg.svdvals((share.sqrt() * centred).double())
    if len(centred) < 3 or along[1] <= NARROWEST * along[0]:
        return None
    return centred


def superposing_turns(x: Tensor, template: Tensor, masses_da: Tensor) -> Tensor:
    """Return rotations `(b, 3, 3)` for which x @ turn lies best on the template (Kabsch 1976), both centred."""
    share = masses_da / masses_da.sum()
    u, _, vt = torch.linalg.svd(torch.einsum("n,bni,nj->bij", share, x, template).double())
    hand = torch.sign(torch.linalg.det(u @ vt))
    u = torch.cat([u[:, :, :2], u[:, :, 2:] * hand[:, None, None]], dim=-1)
    return (u @ vt).to(x.dtype)


class Modes(nn.Module):
    """Changes of positions and velocities over `n_new` frames, in units of what they change by over a chunk."""

    def __init__(self, width: int, n_modes: int, n_new: int) -> None:
        super().__init__()
        self.n_modes, self.n_new = n_modes, n_new
        self.of_place = nn.Sequential(nn.Linear(3, 64), nn.SiLU(), nn.Linear(64, width))
        self.mix = nn.Sequential(nn.Linear(width, width), nn.SiLU())
        # Rows of an atom in the modes: of its excursion, of its velocity, and of what they do to it.
        self.into, self.out_of = nn.Linear(width, 6 * n_modes), nn.Linear(width, 3 * n_modes)
        # What excursions and velocities (third axis) do to positions and velocities (second axis).
        self.over_time = nn.Parameter(0.1 * torch.randn(n_new, 2, 2, n_modes))
        self.mean = nn.Linear(width, 3 * n_new)
        nn.init.zeros_(self.mean.weight)
        nn.init.zeros_(self.mean.bias)

    def forward(self, z: Tensor, x: Tensor, v: Tensor, template: Tensor, masses_da: Tensor) -> tuple[Tensor, Tensor]:
        """Types `(n, width)`, centred states `(b, n, 3)`, the template `(n, 3)` -> two of `(b, n_new, n, 3)`."""
        turn = superposing_turns(x, template, masses_da)
        z = self.mix(z + self.of_place(template / EXCURSION))
        state = torch.stack([(x @ turn - template) / EXCURSION, v @ turn], dim=-2)
        into = self.into(z).unflatten(-1, (2, 3, self.n_modes)) / len(z) ** 0.5
        out_of = OUTPUT_SCALE * self.out_of(z).unflatten(-1, (3, self.n_modes))
        amplitudes = torch.einsum("bnwi,nwid->bwd", state, into)
        later = torch.einsum("bwd,tswd->btsd", amplitudes, self.over_time)
        moved = torch.einsum("btsd,nid->btsni", later, out_of)
        mean = self.mean(z).unflatten(-1, (self.n_new, 3)).transpose(0, 1)
        back = turn.transpose(-1, -2)[:, None]
        return (moved[:, :, 0] + mean) @ back, moved[:, :, 1] @ back
