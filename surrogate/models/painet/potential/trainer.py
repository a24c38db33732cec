"""What `train` can do with PAINET as a potential: it learns from forces that are computed for it, not from frames."""

from __future__ import annotations

from surrogate.data.references import References
from surrogate.models.painet.potential.config import PotentialConfig
from surrogate.training.trainer import Prepared, Settings, Trainer, TrainingRequest
from systems.errors import InputError


class PotentialTrainer(Trainer):
    """Refuses trajectories, which say too little about forces."""

    def check(self, request: TrainingRequest) -> None:
        raise InputError(
            f"{request.arch} learns from forces that are computed for it; give a molecule, `arch='painet'` and "
            "`level='gfn2-xtb'`."
        )

    def settings(self, request: TrainingRequest) -> Settings:
        return Settings(PotentialConfig.from_dict(request.model), None)

    def prepare(self, references: References, request: TrainingRequest) -> Prepared:
        self.check(request)
        raise AssertionError("refused above")
