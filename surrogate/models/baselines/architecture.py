"""The baselines in the registry: fitted in one go, when asked for by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from surrogate.models.architecture import Architecture
from surrogate.models.baselines.model import (
    Baseline,
    BaselineConfig,
    ConstantVelocity,
    FrozenFrame,
    MarkovStateModel,
    NormalModes,
    TrainingFrameResampling,
)

if TYPE_CHECKING:
    from surrogate.training.trainer import Trainer


def _trainer() -> Trainer:
    from surrogate.models.baselines.trainer import BaselineTrainer

    return BaselineTrainer()


def _baseline(kind: type[Baseline]) -> Architecture:
    return Architecture(kind.arch, BaselineConfig.from_dict, kind, _trainer)


FROZEN = _baseline(FrozenFrame)
CONSTANT_VELOCITY = _baseline(ConstantVelocity)
RESAMPLING = _baseline(TrainingFrameResampling)
NORMAL_MODES = _baseline(NormalModes)
MSM = _baseline(MarkovStateModel)
