"""PAINET, and its decoder alone, in the registry. Both learn from velocities and are trained when asked for by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from surrogate.models.architecture import Architecture
from surrogate.models.painet.config import PainetConfig
from surrogate.models.painet.model import EgnnForecaster, Painet

if TYPE_CHECKING:
    from surrogate.training.trainer import Trainer


def _painet() -> Trainer:
    from surrogate.models.painet.trainer import PainetTrainer

    return PainetTrainer(Painet)


def _egnn() -> Trainer:
    from surrogate.models.painet.trainer import PainetTrainer

    return PainetTrainer(EgnnForecaster)


PAINET = Architecture("painet", PainetConfig.from_dict, Painet, _painet)
EGNN = Architecture("egnn", PainetConfig.from_dict, EgnnForecaster, _egnn)
