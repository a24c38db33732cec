"""Train weights for peptides on runs in one solvent or several, from nothing or from others.

    python docs/studies/training/peptide_transfer.py OUT.safetensors --train FOLDER [FOLDER ...] --budget 1h
               [--start WEIGHTS] [--tuned all|flow|states] [--coupled] [--runs 16] [--steps N] [--unseen 12] [--half]
    python docs/studies/training/peptide_transfer.py OUT.safetensors --train FOLDER [FOLDER ...] --start WEIGHTS
               --tuned pace
    python docs/studies/training/peptide_transfer.py OUT.safetensors --start WEIGHTS --tuned transfer
    python docs/studies/training/peptide_transfer.py OUT.safetensors --start WEIGHTS --tuned lags --steps N

FOLDER: `train` in a folder of `peptide_campaign` or `peptide_runs`, of each molecule in it the first `--runs`. `flow`
and `states` train the flow or the probabilities of torsion states alone, and need `--start`. `--unseen`: every so many
molecules of several residues one is left out, and the curves show its loss. `--half` rounds to float16 at the end. Free
energies of φ > 0 are those of `peptide_energies` beside OUT, or those that the weights gone on from were trained with.
A training that was stopped goes on. These take no MD: `transfer` gives TIP3P the probabilities of OBC2, as often as
its own have it (`balance.transfer`), in the mean over rollouts in it, which lie beside OUT; `lags` trains those of
TIP3P on its own rollouts by steps of 10 ps, so that longer steps lead where these do, and keeps those of these and of
shorter ones.
`pace` sets how often ψ changes its state beside other residues to what runs show (`balance.set_pace`). Populations:
`peptide_populations`.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from peptide_campaign import order
from peptide_energies import known_energies
from peptide_list import RESIDUES, Peptide, held_out_peptides, unseen_peptides
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
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions, bonded_graph, turned
from systems.errors import InputError
from systems.prepare.peptide import build_peptide
from systems.scene import FloatArray, Scene
from systems.units import parse_wall_s

_VALIDATE_S = 300.0
# The end of each run that is held out has at least so many frames, more than a chunk.
_HELD_FRAMES = 20
TIP3P = "tip3p"
_ROLLED = RolloutConfig(time_ps=5000.0, lag_ps=10.0, solvent=TIP3P, seed=3, guard="off", force=True)
# Rollouts of each molecule by which TIP3P takes over the probabilities of OBC2; by which longer steps agree with those
# of 10 ps, every fourth of which begins at a φ > 0, which is hardly ever entered; and by which shorter ones stay.
TAKING_OVER, AGREEING, STAYING = (
    (4, _ROLLED), (16, replace(_ROLLED, time_ps=6000.0, seed=5)),
    (16, replace(_ROLLED, time_ps=60.0, lag_ps=1.0, seed=6)),
)  # fmt: skip
_POSITIVE_EVERY, _POSITIVE_RAD = 4, math.radians(57.0)
# Frames of a piece, a few more than a chunk's and a divisor of a run's; and a rate by which what is known stays.
_PIECE, _STAYING_RATE = 20, 4e-4
# What is set to what runs show, without training.
LEVELS = {"pace": set_pace, "transfer": transfer}
# What goes on from weights without MD.
ALONE = ("transfer", "lags")


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


def trained_with(provenance: dict[str, Any] | None) -> dict[str, float]:
    """Return the free energies of φ > 0 that weights, or those that they began with, were trained with."""
    while provenance is not None:
        if found := provenance.get("positive_phi_kt"):
            return dict(found)
        provenance = provenance.get("from")
    return {}


def rolled_in_water(
    start: Weights, folder: Path, peptides: Sequence[Peptide], n: int, how: RolloutConfig,
    starts: Callable[[Scene, int], FloatArray] | None = None,
) -> Path:  # fmt: skip
    """Roll each peptide `n` times and return the folder with a folder of each; what is there stays."""
    for peptide in peptides:
        outs = [folder / peptide.name / f"run_{k:03d}.h5" for k in range(n)]
        if not all(out.exists() for out in outs):
            outs[0].parent.mkdir(parents=True, exist_ok=True)
            scene = build_peptide(peptide.sequence)
            rollout(scene, start, outs, how, starts_nm=starts and starts(scene, n), overwrite=True)
    return folder


def some_positive_phi(scene: Scene, n: int) -> FloatArray:
    """Return positions `(n, n_atoms, 3)` as built, in some of which one φ after the other is turned to where it is
    positive."""
    found, graph = np.repeat(scene.positions_nm[None], n, axis=0), bonded_graph(scene)
    quads = [q for q in backbone_torsions(scene)["phi"].tolist()
             if scene.residue_names[scene.residue_of_atom[q[2]]] != "PRO"]  # fmt: skip
    for turn, k in enumerate(range(0, n if quads else 0, _POSITIVE_EVERY)):
        quad = quads[turn % len(quads)]
        found[k] = turned(found[k], quad, _POSITIVE_RAD - float(torsion(found[k], [quad])[0]), graph)
    return found


def in_water(start: Weights) -> list[Peptide]:
    """Return residues and pairs between caps of the campaign in water, and the pairs with free ends that weights know
    there."""
    known = {"-".join(m.scene.residue_names) for m in start.domain.members if m.conditions.get("solvent") == TIP3P}
    some = [p for kind, p, number in order(TIP3P) if (kind, number) == ("train", 0) and len(p.residues) <= 2]
    return [p for p in some if p.capped or p.sequence in known]


def train_lags(start: Weights, energies: dict[str, float], out: Path, steps: int | None) -> None:
    """Write weights whose probabilities in TIP3P lead by any longer steps where those by steps of 10 ps do."""
    peptides = in_water(start)
    long, short = (
        rolled_in_water(start, out.with_name(f"{out.stem}-{how.lag_ps:g}ps"), peptides, n, how, some_positive_phi)
        for n, how in (AGREEING, STAYING)
    )
    agreeing, staying = sets_of([long]), sets_of([short])
    # Cut into pieces they hold no longer steps.
    staying += [replace(f, starts=np.arange(0, f.n_frames + 1, _PIECE), split=Split(0.1 / _PIECE)) for f in agreeing]
    training = PeptideTraining(steps=steps, learning_rate=_STAYING_RATE, time_reversal=True, positive_phi_kt=energies,
                               tuned="states", validate_every_s=_VALIDATE_S)  # fmt: skip
    of = FrameSets(tuple(agreeing), rehearsed=tuple(staying))
    trained = out.with_stem(f"{out.stem}-trained")
    found = load_weights(train_peptides(of, trained, PeptideConfig(), training, start=start, resume=True))
    # Rollouts are nothing that weights could cover.
    save_weights(out, found.model, start.domain, provenance_of({}, {"tuned": "lags", "steps": steps}, start), half=True)


def with_levels(
    sets: Sequence[TrainingFrames], start: Weights, energies: dict[str, float], out: Path, what: str
) -> None:
    """Write weights with the levels that frames show."""
    model = cast(PeptideSlide, start.model)
    chains = [chain_features(f.scene, model.config, f.conditions.get("solvent")) for f in sets]
    subjects = [PeptideSubject(f, chain).in_equilibrium(energies) for f, chain in zip(sets, chains, strict=True)]
    LEVELS[what](model, subjects)
    # Rollouts are nothing to learn from.
    learned = () if what == "transfer" else tuple(sets)
    domain = peptides_domain(learned, model.config, start.domain) if learned else start.domain
    provenance = provenance_of(FrameSets(learned).origin, {"tuned": what}, start)
    save_weights(out, model, domain, provenance, half=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--train", type=Path, nargs="+")
    parser.add_argument("--start")
    parser.add_argument("--tuned", choices=(*TUNED, *LEVELS, "lags"), default="all")
    parser.add_argument("--coupled", action="store_true")
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--unseen", type=int, default=0)
    parser.add_argument("--budget", type=lambda text: parse_wall_s(text, "--budget"))
    parser.add_argument("--steps", type=int)
    parser.add_argument("--half", action="store_true")
    a = parser.parse_args(arguments)
    if a.tuned not in TUNED and a.start is None:
        parser.error(f"--tuned {a.tuned} goes on from weights: name them by --start.")
    if a.tuned not in ALONE and not a.train:
        parser.error("name the folders of runs by --train.")
    if is_trained(a.out):
        return
    start = None if a.start is None else load_weights(weights_path(a.start))
    energies = known_energies(a.out.parent) or trained_with(None if start is None else start.provenance)
    if a.tuned == "lags" and start is not None:
        train_lags(start, energies, a.out, a.steps)
        return
    if a.tuned == "transfer" and start is not None:
        capped = [p for p in in_water(start) if p.capped]
        some = [p for n in (1, 2) for p in [p for p in capped if len(p.residues) == n][: len(RESIDUES)]]
        a.train = [rolled_in_water(start, a.out.with_name(f"{a.out.stem}-rollouts"), some, *TAKING_OVER)]
    sets = sets_of(a.train, a.runs)
    names = {id(frames): "-".join(frames.scene.residue_names) for frames in sets}
    alone = {f"ACE-{residue}-NME" for residue in RESIDUES}
    chains = sorted({*names.values()} - alone)
    left = chains[:: a.unseen] if a.unseen else []
    unseen = [frames for frames in sets if names[id(frames)] in left]
    sets = [frames for frames in sets if names[id(frames)] not in left]
    total_us = sum(frames.total_ps for frames in sets) * 1e-6
    sys.stdout.write(f"{len(sets)} sets of runs, {total_us:.3g} µs; left out: {', '.join(left) or 'none'}\n")
    if a.tuned in LEVELS and start is not None:
        with_levels(sets, start, energies, a.out, a.tuned)
        return
    training = PeptideTraining(
        budget_s=a.budget, steps=a.steps, time_reversal=True, positive_phi_kt=energies, tuned=a.tuned,
        validate_every_s=_VALIDATE_S,
    )  # fmt: skip
    of = FrameSets(tuple(sets), tuple(unseen))
    train_peptides(of, a.out, PeptideConfig(coupled=a.coupled), training, start=start, resume=True)
    if a.half:
        found = load_weights(a.out)
        save_weights(a.out, found.model, found.domain, found.provenance, half=True)


if __name__ == "__main__":
    main()
