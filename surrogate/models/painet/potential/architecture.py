"""PAINET as a potential in the registry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from surrogate.models.architecture import Architecture
from surrogate.models.painet.potential.config import PotentialConfig
from surrogate.models.painet.potential.model import PainetPotential

if TYPE_CHECKING:
    from surrogate.training.trainer import Trainer


def _potential() -> Trainer:
    from surrogate.models.painet.potential.trainer import PotentialTrainer

    return PotentialTrainer()


PAINET_POTENTIAL = Architecture("painet-potential", PotentialConfig.from_dict, PainetPotential, _potential)
