"""Teach weights of peptides to arrive in few evaluations: `python docs/studies/training/peptide_distil.py OUT ...`.

`--train`: folders of training runs (`train` in a folder of `peptide_campaign` or `peptide_runs`), of which windows are
drawn. `--earlier TAUGHT LABELLER`: weights that were taught before, and by which; those taught now begin as these,
changed by what the labeller has learned since, and need minutes instead of an hour. What is in OUT half done is gone on
with.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import torch
from peptide_transfer import sets_of
from torch import Tensor

from surrogate.data import FrameSets, TrainingFrames
from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.trainer import pick
from surrogate.models.peptides.chains import ChainFeatures, conditioning_states
from surrogate.models.peptides.layout import chain_features
from surrogate.models.peptides.model import PeptideFlow, PeptideSlide
from surrogate.models.peptides.subjects import PeptideSubject
from surrogate.models.peptides.trainer import PeptideTraining, by_kind, disturbed
from surrogate.models.weights import Weights, load_weights, provenance_of, save_weights
from surrogate.training.loop import Stage, StageConfig, train_stages
from systems.units import parse_wall_s

# A flow of peptides that arrives in very few evaluations: taught where its labeller arrives in many.
# The state of every torsion is drawn before, so what is left to a flow is one basin, and where its solver ends is a
# smooth map of the noise. A copy of the flow is trained through all steps of its own solver to end where the labeller
# ends from the same noise (as in progressive distillation, Salimans and Ho, arXiv:2202.00512, but in one round, since
# so few steps can be differentiated as one). The probabilities of states are the labeller's.

# Evaluations of the labeller: more of them end in the same distribution.
_LABELLER_STEPS = 6
# Two of its steps leave bonds and angles as wide as they are. By `gaussian` a copy had to make up for half of the
# variance, and left them cold.
_SOLVER = "angular"
# Of each molecule, of many fewer of each: validation solves as often as training does, and is to stay a small share.
_HELD_WINDOWS, _LEAST_HELD, _HELD_IN_ALL, _HELD_SEED = 32, 2, 256, 0


def distil(
    sets: Sequence[TrainingFrames],
    start: Weights,
    out: Path,
    training: PeptideTraining,
    *,
    steps: int,
    earlier: tuple[Weights, Weights] | None = None,
    resume: bool = False,
) -> Path:
    """Write weights `out` that roll in `steps` evaluations, taught by those of `start` on windows of `sets`; beside it
    a CSV of how far both end apart, in the units of the flow. `earlier`: weights taught before, and the labeller of
    those, from which `start` was trained further. Raises SimulationError when training diverges."""
    torch.manual_seed(training.seed)
    assert isinstance(start.model, PeptideSlide)
    device = torch.device(training.device)
    labeller = start.model.to(device).flow
    config = replace(start.model.config, usual_steps=steps, usual_solver=_SOLVER)
    model = PeptideSlide(config).to(device)
    model.load_state_dict(start.model.state_dict())
    if earlier is not None:
        taught, before = (cast(PeptideSlide, weights.model).flow.state_dict() for weights in earlier)
        model.flow.load_state_dict({k: taught[k] + now - before[k] for k, now in labeller.state_dict().items()})
    subjects = [
        PeptideSubject(f, chain_features(f.scene, model.config, f.conditions.get("solvent")).to(device)) for f in sets
    ]
    n_held = min(_HELD_WINDOWS, max(_LEAST_HELD, _HELD_IN_ALL // len(subjects)))
    held = [
        (subject, *subject.windows(n_held, model.config, torch.Generator().manual_seed(_HELD_SEED), validation=True))
        for subject in subjects
    ]

    def apart(subject: PeptideSubject, idx: Tensor, times: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        return arrival_loss(model, labeller, subject.chain, *subject.seen(model, idx), times.to(device), generator)

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        subject = subjects[pick(subjects, generator)]
        found = apart(subject, *subject.batch(training.batch, model.config, generator), generator)
        return found["apart"], {name: term.detach() for name, term in found.items()}

    @torch.no_grad()
    def validate() -> dict[str, float]:
        generator = torch.Generator().manual_seed(_HELD_SEED)
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=training.bf16):
            found = [apart(*each, generator) for each in held]
        return {f"validation_{name}": float(np.mean([float(terms[name]) for terms in found])) for name in found[0]}

    def write(spent_s: list[float]) -> None:
        settings = {"seed": training.seed, "spent_s": round(sum(spent_s), 1), "distilled_to_steps": steps}
        save_weights(out, model, start.domain, provenance_of(FrameSets(tuple(sets)).origin, settings, start))

    stage = StageConfig(
        "arrival", training.batch, training.learning_rate, training.budget_s, training.steps, seed=training.seed,
        bf16=training.bf16, validate_every_s=training.validate_every_s,
    )  # fmt: skip
    train_stages([Stage(model.flow, stage, loss, validate)], out, write, device=device, resume=resume)
    return out


def arrival_loss(
    model: PeptideSlide, labeller: PeptideFlow, chain: ChainFeatures, numbers: Tensor, states: Tensor, times_ps: Tensor,
    generator: torch.Generator,
) -> dict[str, Tensor]:  # fmt: skip
    """Return the mean square of how far from the labeller's the model's innovations end from the same noise, `apart`,
    and its parts: of torsions' numbers, of stiff ones. `numbers` and `states` of windows as `peptide_loss` takes them,
    of which only the first frame's numbers are used."""
    filled = chain.code.filled
    known = disturbed(numbers[:, 0], chain, model.config, generator)
    noise = torch.randn(numbers[:, 1:].shape, generator=generator).to(numbers.device) * filled
    of_states = conditioning_states(states, chain.stated.counts)

    def arrived(by: PeptideFlow, n_steps: int) -> Tensor:
        conditioning = by.conditioning(known, times_ps, chain.places, of_states)

        def predict(o: Tensor, tau: Tensor) -> Tensor:
            return torch.where(filled, by(o, tau, conditioning), 0.0)

        return flow.SOLVERS[_SOLVER](predict, noise, n_steps)

    with torch.no_grad():
        target = arrived(labeller, _LABELLER_STEPS)
    error = (arrived(model.flow, model.config.usual_steps) - target).square()
    return dict(zip(("apart", "turning", "stiff"), by_kind(error, chain, model.config), strict=True))


_LEARNING_RATE, _VALIDATE_S = 2e-4, 300.0


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--weights", type=Path, required=True, help="of the labeller")
    parser.add_argument("--train", type=Path, nargs="+", required=True)
    parser.add_argument("--earlier", type=Path, nargs=2, metavar=("TAUGHT", "LABELLER"))
    parser.add_argument("--steps", type=int, default=2, help="evaluations of a rollout")
    parser.add_argument("--budget", required=True, help="wall time, as 40min")
    a = parser.parse_args(arguments)
    earlier = None if a.earlier is None else (load_weights(a.earlier[0]), load_weights(a.earlier[1]))
    training = PeptideTraining(
        budget_s=parse_wall_s(a.budget, "--budget"), learning_rate=_LEARNING_RATE, validate_every_s=_VALIDATE_S
    )
    start, sets = load_weights(a.weights), sets_of(a.train)
    distil(sets, start, a.out, training, steps=a.steps, earlier=earlier, resume=True)


if __name__ == "__main__":
    main()
