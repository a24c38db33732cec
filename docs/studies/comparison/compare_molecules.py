"""False alarms of the comparison on molecules of all kinds: `python docs/studies/comparison/compare_molecules.py -o
FOLDER`.

Replicas of drugs, peptides and a protein are made with OpenMM (once: a run that is there is not repeated), and each is
evaluated as the candidate against two others. Nothing is wrong with any of them; at a significance of 5 % over all rows
at most one comparison in twenty may end in a word worse than "undecided".
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from compare_alarms import Alarms, count_alarms, report

if TYPE_CHECKING:
    from surrogate.comparison.read.ensemble import Ensemble


STRUCTURES = Path(__file__).resolve().parents[4] / "shared" / "data" / "structures"
_EQUILIBRATE_PS = 20.0


@dataclass(frozen=True)
class Molecule:
    """What is simulated: `n_replicas` runs of `scene`, `time_ps` each, a frame every `every_ps`.

    `scene`: as `surromd reference` takes it, or a file of the folder of shared structures.
    """

    name: str
    kind: str
    scene: str
    time_ps: float
    n_replicas: int = 3
    every_ps: float = 1.0


MOLECULES = (
    Molecule("butane", "small molecule", "smiles:CCCC", 20_000.0, 4),
    Molecule("glycol", "small molecule", "smiles:OCCO", 50_000.0, 4, 2.0),
    Molecule("methylcyclohexane", "small molecule", "smiles:CC1CCCCC1", 5000.0, 4),
    Molecule("aspirin", "drug", "smiles:CC(=O)Oc1ccccc1C(=O)O", 10_000.0, 4),
    Molecule("paracetamol", "drug", "smiles:CC(=O)Nc1ccc(O)cc1", 20_000.0),
    Molecule("caffeine", "drug", "smiles:Cn1c(=O)c2c(ncn2C)n(C)c1=O", 2000.0),
    Molecule("ibuprofen", "drug", "smiles:CC(C)Cc1ccc(cc1)C(C)C(=O)O", 10_000.0),
    Molecule("lidocaine", "drug", "smiles:CCN(CC)CC(=O)Nc1c(C)cccc1C", 10_000.0),
    Molecule("valine", "peptide", "ACE-VAL-NME", 5000.0, 4),
    Molecule("two glycines", "peptide", "ACE-GLY-GLY-NME", 5000.0, 4),
    Molecule("trialanine", "peptide", "ac-ala3-nhme", 1000.0),
    Molecule("SDFS", "peptide", "SDFS", 1000.0),
    Molecule("trpzip2", "protein", "rcsb_cif__Amber-MD__1LE1.cif", 100.0, every_ps=0.2),
    Molecule("trp-cage", "protein", "rcsb_pdb__Amber-MD__1l2y.pdb", 60.0, every_ps=0.2),
    Molecule("NTL9", "protein", "charmm__PanosAntonia__ntl9_folded.pdb", 5.0, every_ps=0.02),
)


def make_runs(molecule: Molecule, folder: Path, first_seed: int = 0) -> list[Path]:
    """Simulate what is missing of the replicas of a molecule, seeds from `first_seed` on; return their files.

    A run that was interrupted goes on from its checkpoint. Raises what `surromd reference` raises.
    """
    from surrogate import api

    seeds = range(first_seed, first_seed + molecule.n_replicas)
    paths = [folder / f"{molecule.name.replace(' ', '_')}_{seed}.h5" for seed in seeds]
    scene = STRUCTURES / molecule.scene if molecule.scene.endswith((".pdb", ".cif")) else molecule.scene
    for seed, path in zip(seeds, paths, strict=True):
        if not path.exists():
            part = path.with_name(f"{path.stem}.part.h5")
            begun = Path(f"{part}.checkpoint").exists()
            api.reference(
                scene,
                part,
                time_ps=molecule.time_ps,
                save_every_ps=molecule.every_ps,
                equilibrate_ps=_EQUILIBRATE_PS,
                seed=seed,
                resume=begun,
                overwrite=not begun,
                quiet=True,
            )
            part.rename(path)
    return paths


def load_runs(paths: Sequence[Path]) -> list[Ensemble]:
    """Return the runs, atoms in the order of the first."""
    from surrogate.comparison.read.ensemble import load_ensemble

    first = load_ensemble([paths[0]])
    return [first, *(load_ensemble([path], template=first.scene) for path in paths[1:])]


def count_all(molecules: Sequence[Molecule], folder: Path, first_seed: int = 0) -> dict[str, Alarms]:
    """Return the false alarms of each molecule; what was counted is kept in `folder/NAME.json` and not repeated."""
    found = {}
    for molecule in molecules:
        kept = folder / f"{molecule.name}.json"
        if kept.exists():
            found[molecule.name] = Alarms(**json.loads(kept.read_text()))
            continue
        start = time.monotonic()
        found[molecule.name] = count_alarms(load_runs(make_runs(molecule, folder, first_seed)), molecule.time_ps)
        kept.write_text(json.dumps(vars(found[molecule.name])))
        spent = time.monotonic() - start
        sys.stdout.write(f"{molecule.name} ({molecule.kind}), {spent:.0f} s: {report(found[molecule.name])}\n")
        sys.stdout.flush()
    return found


def together(found: Sequence[Alarms]) -> Alarms:
    """Return the counts of all molecules as one."""
    status, rows = Counter[str](), Counter[str]()
    for alarms in found:
        status.update(alarms.status)
        rows.update(alarms.rows)
    return Alarms(sum(a.n for a in found), 0.0, dict(status), dict(rows), sum(a.replicate_off for a in found))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FOLDER", help="runs and counts are kept here")
    parser.add_argument("--only", nargs="*", default=None, metavar="NAME", help="these molecules")
    parser.add_argument("--first-seed", type=int, default=0, help="fresh replicas (in a FOLDER of their own)")
    parser.add_argument("--simulate-only", action="store_true", help="make the runs, evaluate nothing")
    args = parser.parse_args(arguments)
    args.out.mkdir(parents=True, exist_ok=True)
    chosen = [m for m in MOLECULES if args.only is None or m.name in args.only]
    if args.simulate_only:
        for molecule in chosen:
            make_runs(molecule, args.out, args.first_seed)
        return
    found = count_all(chosen, args.out, args.first_seed)
    sys.stdout.write(f"all {len(found)} molecules: {report(together(list(found.values())))}\n")


if __name__ == "__main__":
    main()
