"""What runs of single residues in another solvent say of rollouts: weights of frames, and a clock.

The simplest transfer from one solvent to another, which trains nothing: each frame counts exp(-ΣΔF/kT), ΔF the
difference of the free energies of a residue's (φ, ψ) between both solvents by MD of its monomer ACE-X-NME, and times
are stretched by one factor, the median ratio of the times in which ψ goes from one basin to the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from peptide_rollouts import FRAMES_PS, thinned
from peptide_scores import Turn, angles, psi_crossings, turns_of

from systems.errors import InputError

FloatArray = npt.NDArray[np.float64]
# Cells of a map; frames that each is given beforehand; no frame counts more than so many average ones.
CELLS, PRIOR, MOST = 18, 1.0, 20.0
_EDGES = np.linspace(-math.pi, math.pi, CELLS + 1)


@dataclass(frozen=True)
class Correction:
    """`clock`: time in the other solvent over that of rollouts. `log_ratio`: by residue type, the logarithm of how much
    more likely each cell of its (φ, ψ) map is there, `(CELLS, CELLS)`."""

    clock: float
    log_ratio: dict[str, FloatArray]

    @classmethod
    def of(cls, there: Path, here: Path) -> Correction:
        """Measure it on the monomers that both folders have runs of. Raises InputError where there are none."""
        ratios, clocks = {}, []
        for folder in sorted(path for path in there.iterdir() if (here / path.name).is_dir()):
            runs = [sorted(place.glob("run_*.h5")) for place in (folder, here / folder.name)]
            if "-" in folder.name or not all(runs):
                continue
            maps, times = zip(*map(_map_and_time, runs), strict=True)
            ratios[folder.name] = np.log(maps[0]) - np.log(maps[1])
            clocks.append(times[0] / times[1])
        if not ratios:
            raise InputError(f"{there} and {here} hold no runs of one capped residue in common.")
        return cls(float(np.median(clocks)), ratios)

    def weights(self, turns: Sequence[Turn], residues: Sequence[str], run: FloatArray) -> FloatArray:
        """Return what each frame counts `(n_frames,)`, of mean 1; `residues`: the types of amino acids, in order."""
        total = np.zeros(len(run))
        at = {(t.kind, t.residue): k for k, t in enumerate(turns)}
        for r, name in enumerate(residues):
            if name in self.log_ratio and ("phi", r) in at and ("psi", r) in at:
                phi, psi = (_cell(run[:, at[kind, r]]) for kind in ("phi", "psi"))
                total += self.log_ratio[name][phi, psi]
        found = np.exp(total - total.max())
        return np.asarray(np.minimum(found / found.mean(), MOST))


def _cell(x: FloatArray) -> npt.NDArray[np.int64]:
    return np.clip(np.digitize(x, _EDGES) - 1, 0, CELLS - 1)


def _map_and_time(runs: Sequence[Path]) -> tuple[FloatArray, float]:
    """Return the (φ, ψ) map of a monomer, and the mean time between crossings of its ψ, ps."""
    scene, frames, _ = thinned(runs)
    turns = turns_of(scene)
    found = [angles(turns, x) for x in frames]
    phi, psi = (next(k for k, t in enumerate(turns) if t.kind == kind) for kind in ("phi", "psi"))
    whole = np.concatenate(found)
    counts = PRIOR / CELLS**2 * len(runs) + np.histogram2d(whole[:, phi], whole[:, psi], (_EDGES, _EDGES))[0]
    # One more than were seen, or none would be for ever.
    return counts / counts.sum(), FRAMES_PS * len(whole) / (1 + sum(psi_crossings(x[:, psi]) for x in found))
