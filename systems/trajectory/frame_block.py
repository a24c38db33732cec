"""FrameBlock: frames of one append, checked, as every writer takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FrameBlock:
    """Frames that belong together, checked: positions `(n, n_atoms, 3)` float32 nm, series `(n,)`.

    Where they are kept: velocities and forces `(n, n_atoms, 3)` float32, box vectors `(n, 3, 3)`.
    """

    positions_nm: Float32Array
    time_ps: Float64Array
    flags: npt.NDArray[np.uint16] | None
    chunk_idx: npt.NDArray[np.int32]
    scalars: dict[str, Float64Array]
    velocities_nm_ps: Float32Array | None = None
    forces_kj_mol_nm: Float32Array | None = None
    cell_nm: Float64Array | None = None

    def __len__(self) -> int:
        return len(self.time_ps)
