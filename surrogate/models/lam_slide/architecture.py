"""LaM-SLidE in the registry: the general model of one molecule."""

from __future__ import annotations

from typing import TYPE_CHECKING

from surrogate.models.architecture import Architecture, Suitability, Survey
from surrogate.models.lam_slide.config import of_weights
from surrogate.models.lam_slide.model import LamSlide

if TYPE_CHECKING:
    from surrogate.training.trainer import Trainer


def _trainer() -> Trainer:
    from surrogate.models.lam_slide.choices import LamSlideTrainer

    return LamSlideTrainer()


def _suits(survey: Survey) -> Suitability | None:
    return Suitability(0, "one molecule") if survey.one_molecule else None


LAM_SLIDE = Architecture("lam-slide", of_weights, LamSlide, _trainer, _suits)
