"""The pose of a scene that its own shape decides, so that a molecule that no training saw has one too."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from systems.scene import Scene

FloatArray = npt.NDArray[np.float64]


def fitted_atoms(scene: Scene) -> npt.NDArray[np.int64]:
    """Return the atoms that frames are superposed by: the heavy ones, all where fewer than three are heavy."""
    return scene.heavy_idx if len(scene.heavy_idx) >= 3 else np.arange(scene.n_atoms)


def standard_turn(scene: Scene) -> FloatArray:
    """Return the rotation `(3, 3)` R that lays a scene along its own axes: x moves to `x @ R.T`.

    Axes are the principal ones of the fitted atoms, the longest first; the first two point to where the third moment of
    all atoms does, the third completes a right-handed system. A scene turned first gives the same result, but for
    shapes that leave the axes open (one atom, a line, a symmetric top, mirror-symmetric along an axis): there the pose
    depends on how the scene came.
    """
    idx = fitted_atoms(scene)
    centred = scene.positions_nm - scene.positions_nm[idx].mean(axis=0)
    _, vectors = np.linalg.eigh(centred[idx].T @ centred[idx])
    axes = vectors[:, ::-1].T.copy()
    along = centred @ axes.T
    for k in (0, 1):
        if (along[:, k] ** 3).sum() < 0.0:
            axes[k] = -axes[k]
    axes[2] = np.cross(axes[0], axes[1])
    return axes


def in_standard_pose(scene: Scene) -> Scene:
    """Return the scene laid along its own axes (`standard_turn`), the middle of the fitted atoms at the origin."""
    centred = scene.positions_nm - scene.positions_nm[fitted_atoms(scene)].mean(axis=0)
    return scene.with_positions(centred @ standard_turn(scene).T)
