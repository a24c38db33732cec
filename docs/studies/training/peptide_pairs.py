"""What training on pairs teaches of pairs that were never seen: the gate `pairs` of `peptide_gates`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from peptide_energies import known_energies
from peptide_list import training_peptides
from peptide_rollouts import FRAMES_PS, frame_weights, rolled, thinned

from systems.chemistry.validity import INVALID, Geometry, check_frames
from systems.errors import InputError
from systems.units import parse_wall_s

if TYPE_CHECKING:
    from peptide_scores import Scores

    from surrogate.models.weights import Weights

_VALIDATE_S = 300.0


def train_on_pairs(
    runs: Path, out: Path, n_pairs: int, n_chains: int = 0, n_free: int = 0, *, steps: int | None,
    budget_s: float | None = None, start: Path | None = None,
) -> None:  # fmt: skip
    """Train on all monomers below `runs` and the first `n_pairs` capped pairs, `n_chains` longer chains and `n_free`
    pairs with free ends that are there; what is there stays.

    `start`: weights to go on from. Free energies of phi > 0 are those in the folder of `out`. Raises InputError when
    fewer of a kind have runs.
    """
    from peptide_subset import has_frames, training_sets
    from processes import is_trained

    from surrogate.models.peptides.layout import PeptideConfig
    from surrogate.models.peptides.trainer import PeptideTraining, train_peptides
    from surrogate.models.weights import load_weights

    if is_trained(out):
        return
    kinds: dict[str, list[Path]] = {"monomers": [], "pairs": [], "chains": [], "pairs with free ends": []}
    for peptide in training_peptides():
        kind = list(kinds)[min(3, len(peptide.residues)) - 1] if peptide.capped else "pairs with free ends"
        if has_frames(runs / peptide.name):
            kinds[kind].append(runs / peptide.name)
    chosen = kinds["monomers"]
    for (what, there), asked in zip(list(kinds.items())[1:], (n_pairs, n_chains, n_free), strict=True):
        if len(there) < asked:
            raise InputError(f"{runs} holds runs of {len(there)} {what}, {asked} are asked for; simulate more first.")
        chosen = chosen + there[:asked]
    sets = [frames for folder in chosen for frames in training_sets(folder)]
    training = PeptideTraining(
        steps=steps, budget_s=budget_s, time_reversal=True, positive_phi_kt=known_energies(out.parent),
        validate_every_s=_VALIDATE_S,
    )  # fmt: skip
    known_weights = None if start is None else load_weights(start)
    train_peptides(sets, out, PeptideConfig(), training, start=known_weights, resume=True)


def molecule_scores(
    weights: Weights, runs: Sequence[Path], monomers: Path, folder: Path, positive_kt: Mapping[str, float]
) -> list[Scores]:
    """Return the distances of one test molecule: MD's own, the model's, and those of the library of `monomers`.

    `positive_kt`: of residue types, how likely phi > 0 is, for the library, which seeded runs do not tell. The model
    rolls as often and as long as the `runs` of MD, frames FRAMES_PS apart; its files stay in `folder`.
    """
    from peptide_scores import (
        angles,
        floor,
        library,
        rarely_positive,
        score,
        turns_of,
        without,
    )

    from surrogate.sampling.domain import fit_weights

    scene, reference, time_ps = thinned(runs)
    turns = turns_of(scene)
    model = rolled(weights, scene, [folder / f"{runs[0].stem}-{k}.h5" for k in range(len(runs))], time_ps)
    fitted, _ = fit_weights(scene, weights, lag_ps=FRAMES_PS, force=True)
    geometry = Geometry.from_dict(fitted.domain.geometry)
    valid = [
        float(np.mean([((check_frames(x, geometry) & INVALID) == 0).mean() for x in some]))
        for some in (reference, model)
    ]
    reference, model = ([angles(turns, x) for x in some] for some in (reference, model))
    names = [name for name in scene.residue_names if name not in ("ACE", "NME")]
    alone = [thinned(sorted((monomers / name).glob("run_*.h5"))) for name in names]
    own = [turns_of(of) for of, _, _ in alone]
    values = [[angles(t, run) for run in x] for t, (_, x, _) in zip(own, alone, strict=True)]
    phi = [next((k for k, turn in enumerate(t) if turn.kind == "phi"), None) for t in own]
    likely = [frame_weights(x, k, positive_kt.get(name)) for x, k, name in zip(values, phi, names, strict=True)]
    rng = np.random.default_rng(0)
    drawn = [
        library(turns, [np.concatenate(x) for x in values], likely, own, len(reference[0]), rng) for _ in runs
    ]  # fmt: skip
    rare = rarely_positive(turns, reference)
    reference, model, drawn = (without(x, rare) for x in (reference, model, drawn))
    return [
        replace(floor(turns, reference), valid=valid[0]),
        replace(score(turns, reference, model, "model"), valid=valid[1]),
        score(turns, reference, drawn, "library"),
    ]


def pairs_gate(a: argparse.Namespace) -> None:
    """Train on each number of pairs, roll every test molecule, print and keep the table."""
    from surrogate.models.weights import load_weights

    rows = []
    for n_pairs in a.pairs:
        further = "".join(f"-{what}-{n}" for what, n in (("chains", a.chains), ("free", a.free)) if n)
        out = a.folder / f"pairs-{n_pairs}{further}.safetensors"
        budget_s = None if a.budget is None else parse_wall_s(a.budget, "--budget")
        steps = a.steps if a.budget is None else None
        train_on_pairs(a.train, out, n_pairs, a.chains, a.free, steps=steps, budget_s=budget_s, start=a.start)
        weights, energies = load_weights(out), known_energies(a.folder)
        for molecule in sorted(path for path in a.test.iterdir() if path.is_dir()):
            runs = sorted(path for path in molecule.rglob("*.h5") if not path.name.startswith("."))
            if len(runs) < 2:
                continue
            for scores in molecule_scores(weights, runs, a.train, a.folder / out.stem / molecule.name, energies):
                rows.append({"pairs": n_pairs, "molecule": molecule.name, **asdict(scores)})
            sys.stderr.write(f"{n_pairs} pairs: {molecule.name} measured\n")
    (a.folder / "pairs.json").write_text(json.dumps(rows, indent=1))
    sys.stdout.write(pairs_table(rows) + "\n")


def pairs_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows as Markdown, distances as multiples of MD's own."""
    lines = [
        "| pairs | molecule | source | torsions | over MD's own | joint maps | over MD's own | valid, % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    least: dict[str, Any] = {}
    for row in rows:
        least = row if row["source"] == "MD" else least
        lines.append(
            f"| {row['pairs']} | {row['molecule']} | {row['source']} "
            f"| {row['single']:.3f} ± {row['single_error']:.3f} | {row['single'] / least['single']:.2f} "
            f"| {row['joint']:.3f} ± {row['joint_error']:.3f} | {row['joint'] / least['joint']:.2f} "
            f"| {100 * row['valid']:.2f} |"
        )
    return "\n".join(lines)
