"""The known architectures: which configuration and which model a weights file's `arch` names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from surrogate.models.baselines.model import BASELINES, BaselineConfig
from surrogate.models.interface import Surrogate
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.heavy_atoms import lam_slide_model
from surrogate.models.lam_slide.model import LamSlide
from surrogate.models.painet.config import PainetConfig
from surrogate.models.painet.model import EgnnForecaster, Painet
from surrogate.models.peptides.model import PeptideConfig, PeptideSlide
from systems.errors import UnknownNameError, nearest


@dataclass(frozen=True)
class Architecture:
    """`config` builds a configuration from a record (InputError for unknown keys), `model` a model from that."""

    config: Callable[[dict[str, Any]], Any]
    model: Callable[[Any], Surrogate]


ARCHITECTURES: dict[str, Architecture] = {
    LamSlide.arch: Architecture(LamSlideConfig.from_dict, lam_slide_model),
    PeptideSlide.arch: Architecture(PeptideConfig.from_dict, PeptideSlide),
    Painet.arch: Architecture(PainetConfig.from_dict, Painet),
    EgnnForecaster.arch: Architecture(PainetConfig.from_dict, EgnnForecaster),
    **{kind.arch: Architecture(BaselineConfig.from_dict, kind) for kind in BASELINES},
}


def architecture(name: str) -> Architecture:
    """Return the architecture of this name. Raises UnknownNameError, naming the nearest."""
    if name not in ARCHITECTURES:
        raise UnknownNameError(
            f"unknown architecture {name!r}; known: {', '.join(ARCHITECTURES)}.{nearest(name, list(ARCHITECTURES))}"
        )
    return ARCHITECTURES[name]
