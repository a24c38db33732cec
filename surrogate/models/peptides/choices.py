"""The model of peptides behind the verb `train`: choices for the references, settings, and the start."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from surrogate.data.features.standard_peptide import standard_peptide
from surrogate.data.frames import TrainingFrames
from surrogate.data.references import References
from surrogate.data.weights import load_weights, read_header
from surrogate.models.peptides.model import PeptideConfig
from surrogate.models.peptides.trainer import JUMPS_SHARE, PeptideTraining, train_peptides
from surrogate.training.trainer import AdvanceFn, Choice, Prepared, Settings, Trainer, TrainingRequest

# Share of the longest trajectory that a window may span: its end is held out.
_SPAN = 0.9


class PeptideTrainer(Trainer):
    """One flow for peptides of any sequence and any spacing of frames."""

    goes_on = True
    learns_lags = True

    def choose(self, references: References, request: TrainingRequest) -> tuple[Choice, ...]:
        """See `Trainer.choose`."""
        survey, known = references.survey, PeptideConfig()
        found = []
        going_on = request.start_from is not None
        if not going_on and "shortest_ps" not in request.model and survey.lag_ps != known.shortest_ps:
            found.append(Choice("model.shortest_ps", survey.lag_ps, "the references' spacing of frames"))
        if not going_on and "longest_ps" not in request.model:
            reach = int(_SPAN * min(survey.longest)) * survey.lag_ps
            if request.longest_lag_ps is not None:
                found.append(Choice("model.longest_ps", request.longest_lag_ps, "`longest_lag_ps`"))
            elif reach < known.longest_ps:
                found.append(Choice("model.longest_ps", reach, "as far as every reference reaches"))
        if "time_reversal" not in request.training and survey.equilibrium:
            found.append(Choice("training.time_reversal", True, "MD at constant temperature reads alike backwards"))
        return tuple(found)

    def settings(self, request: TrainingRequest) -> Settings:
        """See `Trainer.settings`."""
        asked = {"budget_s": request.budget_s, "steps": request.steps, "seed": request.seed, "device": request.device}
        training = request.settings(PeptideTraining, asked)
        model = request.model if request.start_from is None else read_header(request.start_from).config
        if request.start_from is not None:  # learning further, a flow forgets the few steps that it was taught
            model = {key: value for key, value in model.items() if key not in ("usual_steps", "usual_solver")}
        return Settings(PeptideConfig.from_dict(model), training, frozenset(asked))

    def prepare(self, references: References, request: TrainingRequest) -> Prepared:
        """See `Trainer.prepare`."""
        settings, sets = self.settings(request), references.sets()
        start = None if request.start_from is None else load_weights(request.start_from)

        def report(advance: AdvanceFn, stage: str, share: float, metrics: dict[str, float]) -> None:
            done = 1 - JUMPS_SHARE if stage == "jumps" else 0.0
            advance(stage, done + share * (JUMPS_SHARE if stage == "jumps" else 1 - JUMPS_SHARE))

        def run(advance: AdvanceFn) -> Path:
            trained, unseen = (
                [_under_standard_names(frames) for frames in some] for some in (sets.trained, sets.unseen)
            )
            return train_peptides(
                trained, request.out, settings.model, settings.training, unseen=unseen, start=start,
                resume=request.resume, progress=partial(report, advance),
            )  # fmt: skip

        return Prepared(sets.names, run)


def _under_standard_names(frames: TrainingFrames) -> TrainingFrames:
    """Return frames of a peptide from any program's file, atoms in the order and residues under the names of ours."""
    standard, order = standard_peptide(frames.scene)
    if standard.residue_names == frames.scene.residue_names and (order == np.arange(len(order))).all():
        return frames
    return replace(
        frames, scene=replace(standard, name=frames.scene.name), coordinates=frames.coordinates[:, order],
        velocities=None if frames.velocities is None else frames.velocities[:, order],
    )  # fmt: skip
