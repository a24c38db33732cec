"""LaM-SLidE in the registry: the general model of one molecule or many."""

from __future__ import annotations

from typing import TYPE_CHECKING

from surrogate.models.architecture import Architecture, Suitability, Survey
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.heavy_atoms import lam_slide_model

if TYPE_CHECKING:
    from surrogate.training.trainer import Trainer


def _trainer() -> Trainer:
    from surrogate.models.lam_slide.choices import LamSlideTrainer

    return LamSlideTrainer()


def _suits(survey: Survey) -> Suitability:
    return Suitability(0, "one molecule" if survey.one_molecule else "several molecules")


LAM_SLIDE = Architecture("lam-slide", LamSlideConfig.from_dict, lam_slide_model, _trainer, _suits)
