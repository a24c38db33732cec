"""What a model of one peptide learns, each a table: `python docs/studies/training/peptide_gates.py lag FOLDER ...`.

`lag`: one model of alanine dipeptide (or any one peptide with phi and psi), trained for a number of steps on `--train`,
is started from frames of `--test`, which it never saw. At each lag: the correlation of cos psi one lag later and the
joint phi/psi distance, beside MD from the same starts; and Chapman and Kolmogorov's test: ten steps of 10 ps against
one of 100 ps, beside two halves of MD. `--plain` trains without innovations, the ablation.

`seeds`: another model of the same peptide, trained on short runs from many starts (`--runs`, a folder of
`peptide_runs`), and other `--weights` (that of `lag`) roll as long and as often as `--test` did: joint phi/psi
distances, and the free energy of phi > 0 of many more and longer rollouts, how often they enter and leave that state,
beside what the short runs and a Markov model of them say. How likely phi > 0 is, the records of `peptide_energies` or
`free-energy` in FOLDER tell the training: short runs leave that state and never enter it.

`code`: how far frames of the molecules below `--test`, coded by residues as in training and rebuilt, lie from
themselves: heavy atoms (RMSD, Å) and torsions (degrees). The scale of the numbers is that of the monomers in `--train`.

`free-energy`: of phi > 0 of a capped residue, in kT, by two well-tempered metadynamics runs, which must agree, and by
the runs of `--md`. What is finished in FOLDER is not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from lag_errors import Row, evenly_started, hold_against, joint_distance, table, torsions
from peptide_energies import known_energies
from peptide_list import training_peptides
from peptide_rollouts import (
    FRAMES_PS,
    REPLICA_LAG_PS,
    REPLICA_PS,
    REPLICAS,
    frame_weights,
    free_energy,
    rolled,
    thinned,
)

from systems.chemistry.validity import Geometry
from systems.units import GAS_CONSTANT_KJ_MOL_K

if TYPE_CHECKING:
    from surrogate.data import TrainingFrames
    from surrogate.models.weights import Weights

FloatArray = npt.NDArray[np.float64]
LAGS_PS = (1, 3, 10, 30, 100, 300, 1000)
STEPS = 7300
STARTS = 5000
_KELVIN, _BIAS_FACTOR = 300.0, 8.0
_SHORT_PS, _STEPS_OF_SHORT = 10.0, 10


def train(
    references: Sequence[Path], out: Path, *, steps: int, innovation: bool,
    positive_phi_kt: dict[str, float] | None = None,
) -> None:  # fmt: skip
    """Train on one peptide's references; what is there stays, what was interrupted goes on."""
    from processes import is_trained

    from surrogate.data import collect_frames
    from surrogate.models.peptides.layout import PeptideConfig
    from surrogate.models.peptides.trainer import PeptideTraining, train_peptides

    if is_trained(out):
        return
    training = PeptideTraining(steps=steps, time_reversal=True, positive_phi_kt=positive_phi_kt or {})
    train_peptides([collect_frames(list(references))], out, PeptideConfig(innovation=innovation), training, resume=True)


def draw(weights: Weights, first_nm: FloatArray, lag_ps: float, n_chunks: int = 1) -> FloatArray:
    """Return the frames `(n_starts, n, n_atoms, 3)` nm that follow `first_nm` (n_starts, n_atoms, 3)."""
    from surrogate.sampling.chunks import ChunkSampler, noise_seed
    from surrogate.sampling.domain import fit_weights

    fitted, _ = fit_weights(weights.domain.scene, weights, lag_ps=lag_ps)
    sampler = ChunkSampler(fitted)
    sampler.batch = 256
    found = [first_nm[:, None]]
    for k in range(n_chunks):
        seeds = [noise_seed(0, row, k) for row in range(len(first_nm))]
        found.append(np.asarray(sampler.draw(found[-1][:, -1:], seeds).frames_nm, dtype=np.float64))
    return np.concatenate(found[1:], axis=1)


def lag_rows(weights: Weights, test: TrainingFrames, lag_ps: float, n_starts: int) -> list[Row]:
    """Return the rows of MD and of the model at one lag, of the first frame after each start alone."""
    known = evenly_started(test, 2, round(lag_ps / test.lag_ps), n_starts)
    geometry = Geometry.from_dict(weights.domain.geometry)
    sources = {"MD": known[:, 1:], "model": draw(weights, known[:, 0], lag_ps)[:, :1]}
    return [hold_against(test, known[:, 0], x, geometry, lag_ps, name) for name, x in sources.items()]


def chapman_kolmogorov(weights: Weights, test: TrainingFrames, n_starts: int) -> dict[str, float]:
    """Return the joint phi/psi distance of ten short steps to one long one, and that of two halves of MD.

    Half as many frames lie further apart by chance, so MD's halves are of as many frames as the model's two sets.
    """
    stride = round(_SHORT_PS * _STEPS_OF_SHORT / test.lag_ps)
    known = evenly_started(test, 2, stride, 2 * n_starts)
    first = known[:n_starts, 0]
    one_chunk = draw(weights, first[:1], _SHORT_PS).shape[1]
    short = draw(weights, first, _SHORT_PS, -(-_STEPS_OF_SHORT // one_chunk))[:, _STEPS_OF_SHORT - 1]
    long = draw(weights, first, _SHORT_PS * _STEPS_OF_SHORT)[:, 0]
    return {
        "ten steps against one": joint_distance(torsions(test.scene, short), torsions(test.scene, long)),
        "halves of MD": joint_distance(torsions(test.scene, known[::2, 1]), torsions(test.scene, known[1::2, 1])),
    }


def lag_gate(a: argparse.Namespace) -> None:
    """Train on one peptide, measure each lag and Chapman and Kolmogorov's test, print and keep the table."""
    from surrogate.data import collect_frames
    from surrogate.models.weights import load_weights

    name = "lag-plain" if a.plain else "lag"
    train(a.train, a.folder / f"{name}.safetensors", steps=a.steps, innovation=not a.plain)
    weights, test = load_weights(a.folder / f"{name}.safetensors"), collect_frames(list(a.test))
    rows = []
    for lag_ps in LAGS_PS:
        if lag_ps <= weights.domain.longest_lag_ps * (1 + 1e-6):
            rows += lag_rows(weights, test, lag_ps, a.starts)
            sys.stderr.write(f"{lag_ps} ps measured\n")
    found = chapman_kolmogorov(weights, test, a.starts)
    record: dict[str, Any] = {"provenance": weights.provenance, "rows": [asdict(row) for row in rows], **found}
    (a.folder / f"{name}.json").write_text(json.dumps(record, indent=1))
    sys.stdout.write(table(rows) + "\n" + "\n".join(f"{what}: {value:.3f}" for what, value in found.items()) + "\n")


def seeds_gate(a: argparse.Namespace) -> None:
    """Train on seeded runs, roll this model and the others, print and keep distances and free energies."""
    from peptide_scores import crossings

    from surrogate.models.weights import load_weights

    models = {path.stem: path for path in a.weights}
    runs = [] if a.runs is None else sorted(a.runs.glob("run_*.h5"))
    if runs:
        models["seeds"] = a.folder / "seeds.safetensors"
        train(runs, models["seeds"], steps=a.steps, innovation=True, positive_phi_kt=known_energies(a.folder))
    scene, reference, time_ps = thinned(a.test)
    angles = [torsions(scene, x) for x in reference]
    md = crossings([x[:, 0] for x in angles], FRAMES_PS)
    record: dict[str, Any] = {"MD": {"distance": [joint_distance(x, y) for x, y in combinations(angles, 2)],
                                     **free_energy([float((x[:, 0] > 0).mean()) for x in angles]), **md}}  # fmt: skip
    for name, path in models.items():
        weights, folder = load_weights(path), a.folder / f"{name}-rollouts"
        same = rolled(weights, scene, [folder / f"same_{k}.h5" for k in range(len(reference))], time_ps)
        found = [joint_distance(torsions(scene, x), y) for x in same for y in angles]
        many = [folder / f"long_{k:02d}.h5" for k in range(REPLICAS)]
        phi = [torsions(scene, x)[:, 0] for x in rolled(weights, scene, many, REPLICA_PS, REPLICA_LAG_PS)]
        record[name] = {"distance": found, **free_energy([float((x > 0).mean()) for x in phi]),
                        **crossings(phi, REPLICA_LAG_PS)}  # fmt: skip
    if runs:
        _, short, _ = thinned(runs)
        both = [torsions(scene, x) for x in short]
        share = float(frame_weights(both)[np.concatenate(both)[:, 0] > 0].sum())
        record["Markov model"] = {"free_energy_kt": float(np.log((1 - share) / share)) if share > 0 else None,
                                  **crossings([x[:, 0] for x in both], FRAMES_PS)}  # fmt: skip
    (a.folder / "seeds.json").write_text(json.dumps(record, indent=1))
    sys.stdout.write(json.dumps({k: {x: np.round(y, 3).tolist() for x, y in v.items() if y is not None}
                                 for k, v in record.items()}, indent=1) + "\n")  # fmt: skip


def code_gate(a: argparse.Namespace) -> None:
    """Code and rebuild frames of every test molecule, print and keep what is lost."""
    from peptide_scores import rebuilt

    from surrogate.data import collect_frames
    from surrogate.models.peptides.layout import PeptideConfig
    from surrogate.models.peptides.trainer import with_scale

    monomers = [p for p in training_peptides() if len(p.residues) == 1]
    files = [sorted((a.train / p.name).glob("run_*.h5"))[:2] for p in monomers]
    config = with_scale(PeptideConfig(), [collect_frames(some) for some in files if some])
    record = {}
    for molecule in sorted(path for path in a.test.iterdir() if path.is_dir()):
        runs = sorted(molecule.rglob("*.h5"))
        if runs:
            scene, frames, _ = thinned(runs[:1])
            record[molecule.name] = rebuilt(scene, frames[0], config)
    (a.folder / "code.json").write_text(json.dumps(record, indent=1))
    sys.stdout.write(json.dumps(record, indent=1) + "\n")


def free_energy_gate(a: argparse.Namespace) -> None:
    """Run metadynamics twice, print and keep the free energies of phi > 0."""
    from peptide_seeds import metadynamics

    from systems.prepare.peptide import build_peptide
    from systems.trajectory.codec import open_trajectory

    scene = build_peptide(a.sequence)
    record: dict[str, Any] = {"sequence": a.sequence, "metadynamics_ps": a.time_ps}
    for seed in (1, 2):
        path = a.folder / f"{a.sequence}-metadynamics-{seed}.npz"
        if not path.exists():
            _, free = metadynamics(
                scene, time_ps=a.time_ps, temperature_k=_KELVIN, bias_factor=_BIAS_FACTOR, seed=seed,
                platform="Reference",
            )  # fmt: skip
            np.savez(path, free_kj_mol=free[0])
        record[f"metadynamics {seed}"] = positive_phi_kt(np.load(path)["free_kj_mol"])
    shares = []
    for path in a.md:
        with open_trajectory(path) as reader:
            phi = torsions(scene, reader.read(stride=10).astype(np.float64))[:, 0]
            shares.append(float((phi > 0).mean()))
    if shares:
        record["md"] = free_energy(shares)
    (a.folder / f"{a.sequence}-free-energy.json").write_text(json.dumps(record, indent=1))
    sys.stdout.write(json.dumps(record, indent=1) + "\n")


def positive_phi_kt(free_kj_mol: FloatArray, temperature_k: float = _KELVIN) -> float:
    """Return the free energy of phi > 0 over phi < 0, kT, of a surface `(n_psi, n_phi)` from -π to π, ends included."""
    kt = GAS_CONSTANT_KJ_MOL_K * temperature_k
    weights = np.exp(-(free_kj_mol - free_kj_mol.min()) / kt)[:-1, :-1]
    phi = np.linspace(-np.pi, np.pi, free_kj_mol.shape[1])[:-1]
    # The two grid lines on which phi changes its sign belong to either side by half.
    share = np.where(np.isclose(phi, 0) | np.isclose(phi, -np.pi), 0.5, (phi > 0).astype(float))
    positive = float((weights * share).sum())
    return float(-np.log(positive / (float(weights.sum()) - positive)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse and run one gate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    gates = parser.add_subparsers(dest="gate", required=True)
    names = ("lag", "seeds", "code", "free-energy")
    lag, seeds, code, energy = (gates.add_parser(name) for name in names)
    for gate in (lag, seeds, code, energy):
        gate.add_argument("folder", type=Path)
    for gate in (lag, seeds):
        gate.add_argument("--steps", type=int, default=STEPS, help="optimisation steps of the training")
    lag.add_argument("--train", type=Path, nargs="+", required=True, help="references of one peptide")
    for gate in (lag, seeds):
        gate.add_argument("--test", type=Path, nargs="+", required=True, help="references that training does not see")
    seeds.add_argument("--runs", type=Path, help="folder of short runs of the same peptide; without, none is trained")
    seeds.add_argument("--weights", type=Path, nargs="*", default=(), help="other models to roll beside it")
    lag.add_argument("--starts", type=int, default=STARTS, help="frames that each lag is started from")
    lag.add_argument("--plain", action="store_true", help="train on the coordinates themselves, not on innovations")
    code.add_argument("--train", type=Path, required=True, help="`train` in a folder of `peptide_runs`")
    code.add_argument("--test", type=Path, required=True, help="`test` in a folder of `peptide_runs`")
    energy.add_argument("--sequence", default="ACE-ALA-NME")
    energy.add_argument("--time-ps", type=float, default=50_000.0, help="of each metadynamics run")
    energy.add_argument("--md", type=Path, nargs="*", default=(), help="long runs of the same molecule")
    a = parser.parse_args(arguments)
    a.folder.mkdir(parents=True, exist_ok=True)
    gate_of = dict(zip(names, (lag_gate, seeds_gate, code_gate, free_energy_gate), strict=True))
    gate_of[a.gate](a)


if __name__ == "__main__":
    main()
