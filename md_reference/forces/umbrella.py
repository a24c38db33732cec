"""An umbrella potential: energy that is added to torsions so that MD crosses their barriers more often.

Each torsion gets the negative of its free energy where that is high, as a Fourier series; the free energy is known
beforehand from MD in implicit solvent or from a surrogate (adaptive umbrella sampling: Bartels and Karplus, J. Comput.
Chem. 18, 1450 (1997)). A frame with the umbrella energy U counts exp(U / kT) at equilibrium (Torrie and Valleau, J.
Comput. Phys. 23, 187 (1977)). How fast torsions turn under it tells nothing of how fast they turn without.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from systems.units import GAS_CONSTANT_KJ_MOL_K

if TYPE_CHECKING:
    import numpy.typing as npt

    from systems.scene import FloatArray, IntArray, Scene

_PERIODS, _BINS = 6, 72
# How far above its lowest free energy psi, and a side chain or any other rotatable bond, is left.
_LEFT_KT = (1.5, 2.5)
# What is hardly ever visited may lie as high as one likes; it is made so much likelier at most.
_DEEPEST_KT = 5.0


@dataclass(frozen=True)
class Umbrella:
    """`torsions`: four atoms each; `series_kj_mol`: of each the amplitudes of cosine and sine of 1, 2, ... 6 times its
    angle, in turn."""

    torsions: tuple[tuple[int, ...], ...]
    series_kj_mol: tuple[tuple[float, ...], ...]

    @staticmethod
    def of(
        torsions: npt.ArrayLike, angles_rad: npt.ArrayLike, left_kt: Sequence[float], temperature_k: float
    ) -> Umbrella:
        """Return what lowers the free energy of each of `torsions` `(k, 4)`, whose angles `(n, k)` a sample has, to
        `left_kt` (k,) above its lowest, by 5 kT at most."""
        import numpy as np

        angles, kt = np.asarray(angles_rad, dtype=np.float64), GAS_CONSTANT_KJ_MOL_K * temperature_k
        middles = (np.arange(_BINS) + 0.5) * 2.0 * np.pi / _BINS - np.pi
        series = []
        for left, column in zip(left_kt, angles.T, strict=True):
            counts = np.histogram(column, bins=_BINS, range=(-np.pi, np.pi))[0]
            energy = -np.log(counts + 0.5)
            added = -kt * np.clip(energy - energy.min() - left, 0.0, _DEEPEST_KT)
            each = [
                2.0 * np.mean(added * wave(n * middles)) for n in range(1, _PERIODS + 1) for wave in (np.cos, np.sin)
            ]
            series.append(tuple(float(f"{x:.6g}") for x in each))
        return Umbrella(tuple(tuple(int(a) for a in quad) for quad in np.asarray(torsions)), tuple(series))

    def force(self) -> Any:
        """Return it as an `openmm.PeriodicTorsionForce`."""
        import openmm

        force = openmm.PeriodicTorsionForce()
        for quad, series in zip(self.torsions, self.series_kj_mol, strict=True):
            for n, (a, b) in enumerate(zip(series[::2], series[1::2], strict=True), 1):
                force.addTorsion(*quad, n, math.atan2(b, a), math.hypot(a, b))
        return force

    def energies_kj_mol(self, positions_nm: npt.ArrayLike) -> FloatArray:
        """Return the energies `(n,)` of that force in frames `(n, n_atoms, 3)`."""
        from systems.chemistry.geometry import torsion

        return self.energies_of(torsion(positions_nm, self.torsions))

    def energies_of(self, angles_rad: npt.ArrayLike) -> FloatArray:
        """Return the energies `(n,)` at angles `(n, k)` of the torsions."""
        import numpy as np

        angles = np.asarray(angles_rad, dtype=np.float64)
        found = np.zeros(len(angles))
        for column, series in zip(angles.T, self.series_kj_mol, strict=True):
            for n, (a, b) in enumerate(zip(series[::2], series[1::2], strict=True), 1):
                found += math.hypot(a, b) + a * np.cos(n * column) + b * np.sin(n * column)
        return found


def umbrella_torsions(scene: Scene) -> tuple[IntArray, list[float]]:
    """Return the torsions `(k, 4)` of a molecule that an umbrella potential is of, and what is left of the free energy
    of each, in kT: every psi, then those of other rotatable bonds but phi, whose high barriers no MD resolves."""
    import numpy as np

    from systems.chemistry.graph import backbone_torsions, rotatable_torsions

    backbone = backbone_torsions(scene)
    bonds = {tuple(sorted(quad[1:3])) for kind in ("phi", "psi") for quad in backbone[kind].tolist()}
    side = [quad for quad in rotatable_torsions(scene).tolist() if tuple(sorted(quad[1:3])) not in bonds]
    quads = np.concatenate([backbone["psi"], np.array(side, dtype=np.int64).reshape(-1, 4)])
    return quads, [_LEFT_KT[k >= len(backbone["psi"])] for k in range(len(quads))]
