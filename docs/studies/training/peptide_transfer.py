"""Train weights for peptides on runs in one solvent or several, from nothing or from others.

    python docs/studies/training/peptide_transfer.py OUT.safetensors --train FOLDER [FOLDER ...] --budget 1h
               [--start WEIGHTS] [--tuned all|flow|states] [--coupled] [--runs 16] [--steps N] [--unseen 12] [--half]
    python docs/studies/training/peptide_transfer.py OUT.safetensors --train FOLDER [FOLDER ...] --start WEIGHTS
               --tuned pace
    python docs/studies/training/peptide_transfer.py OUT.safetensors --start WEIGHTS --tuned transfer [--of WEIGHTS]

FOLDER: `train` in a folder of `peptide_campaign` or `peptide_runs`, of each molecule in it the first `--runs`. `flow`
and `states` train the flow or the probabilities of torsion states alone, and need `--start`. `--unseen`: every so many
molecules of several residues one is left out, and the curves show its loss. `--half` rounds to float16 at the end. Free
energies of φ > 0 are those of `peptide_energies` beside OUT, or those that the weights gone on from were trained with.
A training that was stopped goes on. These train nothing: `transfer` gives TIP3P the probabilities of OBC2, as often as
its own have it (`balance.transfer`), in the mean over rollouts in it, which lie beside OUT, those of OBC2 as other
weights have them where these are named by `--of`; `pace` sets how often ψ changes its state beside other residues to
what runs show (`balance.set_pace`). Populations: `peptide_populations`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from peptide_campaign import order
from peptide_energies import known_energies, trained_with
from peptide_list import RESIDUES, held_out_peptides, unseen_peptides
from processes import is_trained

from surrogate.data import FrameSets, Split, TrainingFrames, collect_frames
from surrogate.models.architecture import weights_path
from surrogate.models.peptides.balance import set_pace, transfer
from surrogate.models.peptides.layout import PeptideConfig, chain_features
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.peptides.subjects import PeptideSubject
from surrogate.models.peptides.trainer import TUNED, PeptideTraining, peptides_domain, train_peptides
from surrogate.models.weights import Weights, load_weights, provenance_of, save_weights
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.errors import InputError
from systems.prepare.peptide import build_peptide
from systems.units import parse_wall_s

_VALIDATE_S = 300.0
# The end of each run that is held out has at least so many frames, more than a chunk.
_HELD_FRAMES = 20
# Of each molecule, to give TIP3P the probabilities of OBC2.
TIP3P, _ROLLOUTS = "tip3p", 4
_ROLLED = RolloutConfig(time_ps=5000.0, lag_ps=10.0, solvent=TIP3P, seed=3, guard="off", force=True)
# What is set to what runs show, without training.
LEVELS = {"pace": set_pace, "transfer": transfer}


def sets_of(folders: Sequence[Path], runs: int = 10_000) -> list[TrainingFrames]:
    """Return the frames of every molecule in folders, of so many runs at most. Raises InputError for no frames, and for
    residues that weights are tested on, whatever their ends."""
    tested = {"-".join(p.residues) for p in (*unseen_peptides(), *held_out_peptides()) if len(p.residues) > 1}
    found = []
    for place in (place for folder in folders for place in sorted(folder.iterdir()) if place.is_dir()):
        if place.name.removeprefix("free-") in tested:
            raise InputError(f"{place}: weights are tested on these residues; leave it out of training.")
        if files := sorted(place.glob("run_*.h5"))[:runs]:
            frames = collect_frames(files)
            share = max(Split.share, _HELD_FRAMES / int(np.diff(frames.starts).min()))
            found.append(replace(frames, split=Split(share)))
    if not found:
        raise InputError(f"{', '.join(map(str, folders))} hold no runs.")
    return found


def rolled_in_water(start: Weights, folder: Path) -> Path:
    """Roll every residue between caps, and as many pairs, in TIP3P, and return the folder with a folder of each."""
    water = [p for kind, p, number in order(TIP3P) if (kind, number) == ("train", 0) and p.capped]
    for n in (1, 2):
        for peptide in [p for p in water if len(p.residues) == n][: len(RESIDUES)]:
            outs = [folder / peptide.name / f"run_{k:03d}.h5" for k in range(_ROLLOUTS)]
            if not all(out.exists() for out in outs):
                outs[0].parent.mkdir(parents=True, exist_ok=True)
                rollout(build_peptide(peptide.sequence), start, outs, _ROLLED, overwrite=True)
    return folder


def with_levels(
    sets: Sequence[TrainingFrames], start: Weights, energies: dict[str, float], out: Path, what: str,
    of: Weights | None = None,
) -> None:  # fmt: skip
    """Write weights with the levels that frames show, beside the probabilities of OBC2 that others `of` have."""
    model = cast(PeptideSlide, start.model)
    chains = [chain_features(f.scene, model.config, f.conditions.get("solvent")) for f in sets]
    subjects = [PeptideSubject(f, chain).in_equilibrium(energies) for f, chain in zip(sets, chains, strict=True)]
    kept = deepcopy(model.jumps.state_dict())
    if of is not None:
        model.jumps.load_state_dict(cast(PeptideSlide, of.model).jumps.state_dict())
    LEVELS[what](model, subjects)
    if of is not None:
        model.jumps.load_state_dict(kept)
    # Rollouts are nothing to learn from.
    learned = () if what == "transfer" else tuple(sets)
    domain = peptides_domain(learned, model.config, start.domain) if learned else start.domain
    settings = {"tuned": what, **({} if of is None else {"of": of.hash})}
    provenance = provenance_of(FrameSets(learned).origin, settings, start)
    save_weights(out, model, domain, provenance, half=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--train", type=Path, nargs="+")
    parser.add_argument("--start")
    parser.add_argument("--of")
    parser.add_argument("--tuned", choices=(*TUNED, *LEVELS), default="all")
    parser.add_argument("--coupled", action="store_true")
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--unseen", type=int, default=0)
    parser.add_argument("--budget", type=lambda text: parse_wall_s(text, "--budget"))
    parser.add_argument("--steps", type=int)
    parser.add_argument("--half", action="store_true")
    a = parser.parse_args(arguments)
    if a.tuned in LEVELS and a.start is None:
        parser.error(f"--tuned {a.tuned} goes on from weights: name them by --start.")
    if a.of is not None and a.tuned != "transfer":
        parser.error("--of is for --tuned transfer.")
    if a.tuned != "transfer" and not a.train:
        parser.error("name the folders of runs by --train.")
    if is_trained(a.out):
        return
    start = None if a.start is None else load_weights(weights_path(a.start))
    if a.tuned == "transfer" and start is not None:
        a.train = [rolled_in_water(start, a.out.with_name(f"{a.out.stem}-rollouts"))]
    sets = sets_of(a.train, a.runs)
    names = {id(frames): "-".join(frames.scene.residue_names) for frames in sets}
    alone = {f"ACE-{residue}-NME" for residue in RESIDUES}
    chains = sorted({*names.values()} - alone)
    left = chains[:: a.unseen] if a.unseen else []
    unseen = [frames for frames in sets if names[id(frames)] in left]
    sets = [frames for frames in sets if names[id(frames)] not in left]
    total_us = sum(frames.total_ps for frames in sets) * 1e-6
    sys.stdout.write(f"{len(sets)} sets of runs, {total_us:.3g} µs; left out: {', '.join(left) or 'none'}\n")
    energies = known_energies(a.out.parent) or trained_with(None if start is None else start.provenance)
    if a.tuned in LEVELS and start is not None:
        with_levels(sets, start, energies, a.out, a.tuned, None if a.of is None else load_weights(weights_path(a.of)))
        return
    training = PeptideTraining(
        budget_s=a.budget, steps=a.steps, time_reversal=True, positive_phi_kt=energies, tuned=a.tuned,
        validate_every_s=_VALIDATE_S,
    )  # fmt: skip
    train_peptides(sets, a.out, PeptideConfig(coupled=a.coupled), training, unseen=unseen, start=start, resume=True)
    if a.half:
        found = load_weights(a.out)
        save_weights(a.out, found.model, found.domain, found.provenance, half=True)


if __name__ == "__main__":
    main()
