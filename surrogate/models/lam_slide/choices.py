"""LaM-SLidE behind the verb `train`: choices for the references, settings, and the start of the training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surrogate.data.rarity import rare_kinds
from surrogate.data.references import References
from surrogate.data.weights import load_weights, read_header
from surrogate.models.architecture import Survey
from surrogate.models.lam_slide.config import AutoencoderConfig, LamSlideConfig, of_weights
from surrogate.models.lam_slide.trainer import STAGE_ONE_SHARE, TrainingConfig, train_lam_slide
from surrogate.training.trainer import AdvanceFn, Choice, Prepared, Settings, Trainer, TrainingRequest
from systems.errors import InputError

# Frames from which on rare states are weighted in a further training: fewer do not tell how often they come.
_FRAMES_FOR_RARE = 50_000
_RARE_DRAWS = 0.3
_SETTLED = frozenset({"budget_s", "stage_one_steps", "stage_two_steps", "seed", "device"})


class LamSlideTrainer(Trainer):
    """Trains LaM-SLidE. One molecule at one spacing of frames gets the defaults if they hold its atoms."""

    goes_on = True
    learns_lags = True

    def check(self, request: TrainingRequest) -> None:
        """See `Trainer.check`."""
        super().check(request)
        if request.steps is not None and request.steps < 2:
            raise InputError("`steps` must be at least 2: one for each stage.")

    def choose(self, references: References, request: TrainingRequest) -> tuple[Choice, ...]:
        """See `Trainer.choose`."""
        survey, found = references.survey, list[Choice]()
        if request.start_from is not None:
            found = _rare_states(references, survey, self.settings(request).model)
        else:
            default = AutoencoderConfig.identifier_pool
            pool = request.model.get("autoencoder", {}).get("identifier_pool", default)
            if (n := survey.scenes[0].n_atoms) > pool:
                found.append(Choice("model.autoencoder.identifier_pool", n, f"{n} atoms, more than {pool} identifiers"))
            if (request.longest_lag_ps or request.training.get("longest_lag_ps")) and survey.equilibrium:
                found.append(Choice("training.time_reversal", True, "MD at constant temperature reads alike backwards"))
        return tuple(choice for choice in found if not _is_set(choice.key, request))

    def settings(self, request: TrainingRequest) -> Settings:
        """See `Trainer.settings`."""
        if request.start_from is not None:
            model = of_weights(read_header(request.start_from).config)
        else:
            model = LamSlideConfig.from_dict(request.model)
        steps, first = request.steps, None
        if steps is not None:
            first = 0 if request.start_from is not None else max(1, round(steps * STAGE_ONE_SHARE))
        asked: dict[str, Any] = {
            "budget_s": request.budget_s,
            "stage_one_steps": first,
            "stage_two_steps": None if steps is None or first is None else steps - first,
            "seed": request.seed,
            "device": request.device,
        }
        if request.longest_lag_ps is not None:
            asked["longest_lag_ps"] = request.longest_lag_ps
        return Settings(model, request.settings(TrainingConfig, asked), _SETTLED)

    def prepare(self, references: References, request: TrainingRequest) -> Prepared:
        """See `Trainer.prepare`."""
        settings = self.settings(request)
        model: LamSlideConfig = settings.model
        start = None if request.start_from is None else load_weights(request.start_from)
        frames = references.frames(canonical=model.canonical)
        for validation in (False, True):  # too short a reference is refused before the first stage has been trained
            frames.window_starts(model.approximator.chunk_frames, validation=validation)
        share_one = 0.0 if start is not None else STAGE_ONE_SHARE

        def run(advance: AdvanceFn) -> Path:
            def report(stage: str, share: float, metrics: dict[str, float]) -> None:
                advance(stage, share * share_one if stage == "autoencoder" else share_one + share * (1 - share_one))

            return train_lam_slide(
                frames, request.out, model, settings.training, start=start, resume=request.resume, progress=report
            )

        return Prepared(frames.scene.name, run)


def _is_set(key: str, request: TrainingRequest) -> bool:
    """Return whether the configuration file holds this key already."""
    found: Any = {"model": request.model, "training": request.training}
    for name in key.split("."):
        if not isinstance(found, dict) or name not in found:
            return False
        found = found[name]
    return True


def _rare_states(references: References, survey: Survey, model: LamSlideConfig) -> list[Choice]:
    """Return how rare states are weighted in a further training of one molecule at one lag, where it shows any."""
    told = model.approximator
    if told.lag_range_ps or survey.n_frames < _FRAMES_FOR_RARE or not survey.one_molecule:
        return []
    try:
        n = len(rare_kinds(references.frames(canonical=model.canonical), told.chunk_frames))
    except InputError:
        return []
    why = f"{n} kinds of rare windows in {survey.n_frames} frames"
    return [
        Choice("training.rare_kinds", True, f"{why}, known to the network"),
        Choice("training.rare_draws", _RARE_DRAWS, "rare windows drawn more often, each weighted down by as much"),
    ]
