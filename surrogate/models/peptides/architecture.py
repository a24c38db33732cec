"""The model of peptides in the registry: it suits several sequences, each a single chain of amino acids."""

from __future__ import annotations

from typing import TYPE_CHECKING

from surrogate.models.architecture import Architecture, Suitability, Survey
from surrogate.models.peptides.model import PeptideConfig, PeptideSlide
from systems.errors import InputError

if TYPE_CHECKING:
    from surrogate.training.trainer import Trainer


def _trainer() -> Trainer:
    from surrogate.models.peptides.choices import PeptideTrainer

    return PeptideTrainer()


def _suits(survey: Survey) -> Suitability | None:
    from surrogate.data.features.peptide_chains import chain_layout

    if len(survey.scenes) < 2:
        return None
    try:
        for scene in (*survey.scenes, *survey.unseen):
            chain_layout(scene)
    except InputError:
        return None
    return Suitability(10, f"{len(survey.scenes)} peptides, known by their residues in internal coordinates")


PEPTIDES = Architecture("lam-slide-peptides", PeptideConfig.from_dict, PeptideSlide, _trainer, _suits)
