"""Is this scene what the weights were trained for? Asked before anything is computed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from systems.errors import OutOfDomainError
from systems.matching import match_atoms
from systems.scene import Scene

if TYPE_CHECKING:
    # Sampling and training know nothing of each other at run time: the api hands the weights over.
    from surrogate.data.weights import Weights


def match_scene(scene: Scene, weights: Weights) -> npt.NDArray[np.int64]:
    """Return `order (n_atoms,)`: model atom k is scene atom order[k].

    Raises OutOfDomainError, which says what the weights cover and what to run instead.
    """
    try:
        return match_atoms(scene, weights.domain.scene)
    except OutOfDomainError as error:
        reason = str(error).rstrip(".")
        raise OutOfDomainError(
            f"{weights.path.name} does not cover {scene.name}: {reason}. These weights cover "
            f"{weights.domain.describe()}. Run `surromd reference` for this molecule, then `surromd train` on it."
        ) from error
