"""Fifty drug-like SMILES through preparation, parameters and a short run: `python
docs/studies/preparation/drug_like_smiles.py`.

Each either runs or is refused with a reason that is printed; what runs must end finite, unbroken and with the stereo of
its SMILES. The list (systems/library/data/drug_like_smiles.tsv) has charged, zwitterionic, halogenated, sulfur and
phosphorus compounds, macrocycles, stereocentres, radicals, salts, metals and unusual elements, with the formulas,
charges and CIP labels they are known by.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from importlib.resources import files
from pathlib import Path

import numpy as np

from systems.errors import SurromdError
from systems.scene import Scene
from systems.units import parse_time_ps

_STRETCHED = 1.3


@dataclass(frozen=True)
class Case:
    """A SMILES string and what is known of it: formula, charge, multiplicity and sorted CIP labels, or the refusal."""

    name: str
    smiles: str
    kind: str
    formula: str = ""
    charge: int = 0
    multiplicity: int = 1
    stereo: str = ""
    refusal: str = ""


@dataclass(frozen=True)
class Outcome:
    """What became of a case: 'ran', 'refused' or 'failed', its size and cost, and the one line that says why."""

    name: str
    kind: str
    status: str
    n_atoms: int = 0
    force_field: str = ""
    seconds: float = 0.0
    reason: str = ""
    notes: tuple[str, ...] = ()


def cases() -> list[Case]:
    """Return the committed list."""
    found = []
    text = (files("systems.library") / "data" / "drug_like_smiles.tsv").read_text()
    for line in text.splitlines():
        if line.startswith("#") or not line.strip():
            continue
        name, smiles, kind, formula, *rest = line.split("\t")
        if formula == "refused":
            found.append(Case(name, smiles, kind, refusal=rest[0]))
        else:
            stereo = "" if rest[2] == "-" else rest[2]
            found.append(Case(name, smiles, kind, formula, int(rest[0]), int(rest[1]), stereo))
    return found


def run_case(case: Case, *, time_ps: float, timestep_ps: float, force_field: str) -> Outcome:
    """Prepare, parametrise and simulate one molecule; what refuses it ends in the outcome."""
    from surrogate import api
    from systems.library.named_scenes import prepare
    from systems.trajectory.codec import open_trajectory

    start = time.perf_counter()
    outcome = Outcome(case.name, case.kind, "refused")
    try:
        scene = prepare(f"smiles:{case.smiles}")
        outcome = replace(outcome, n_atoms=scene.n_atoms, notes=tuple(scene.provenance["repairs"]))
        with tempfile.TemporaryDirectory() as folder:
            written = api.reference(
                scene, Path(folder) / "run.h5", time_ps=time_ps, save_every_ps=time_ps / 10, timestep_ps=timestep_ps,
                hydrogen_mass_da=None, force_field=force_field, solvent="auto", quiet=True,
            )  # fmt: skip
            with open_trajectory(written[0]) as frames:
                positions_nm = np.asarray(frames.read(frames.n_frames - 1, frames.n_frames)[0], dtype=np.float64)
                used = str(frames.record.get("force_field", force_field))
    except SurromdError as error:
        return replace(outcome, reason=str(error), seconds=time.perf_counter() - start)
    seconds = time.perf_counter() - start
    fault = what_is_wrong(scene, positions_nm)
    status = "failed" if fault else "ran"
    return replace(outcome, status=status, reason=fault, seconds=seconds, force_field=used)


def what_is_wrong(scene: Scene, positions_nm: np.ndarray) -> str:
    """Return what a frame `(n_atoms, 3)` nm of the scene's run has lost of its molecule, or an empty string."""
    from rdkit_of_scene import to_rdkit

    from systems.prepare.molecule import stereo_labels

    if not np.isfinite(positions_nm).all():
        return "positions are not finite"
    before, after = (
        np.linalg.norm(x[scene.bonds[:, 0]] - x[scene.bonds[:, 1]], axis=1) for x in (scene.positions_nm, positions_nm)
    )
    if (after > _STRETCHED * before).any():
        i, j = scene.bonds[int((after / before).argmax())]
        return f"the bond {scene.atom_names[i]}-{scene.atom_names[j]} broke"
    had, has = (stereo_labels(to_rdkit(scene.with_positions(x))) for x in (scene.positions_nm, positions_nm))
    lost = {k: v for k, v in had.items() if v in "RSEZ" and has.get(k) != v}
    if lost:
        where, label = next(iter(lost.items()))
        return f"{'='.join(scene.atom_names[i] for i in where)} was {label} and is {has.get(where, 'flat')}"
    return ""


def main() -> None:
    """Run the list, or the molecules named, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="molecules of the list; all by default")
    parser.add_argument("--time", default="2ps")
    parser.add_argument("--timestep", default="2fs")
    parser.add_argument("--force-field", default="auto")
    parser.add_argument("--json", type=Path, default=None, help="also write the outcomes here")
    args = parser.parse_args()
    chosen = [c for c in cases() if not args.names or c.name in args.names]
    outcomes = []
    for case in chosen:
        outcome = run_case(
            case,
            time_ps=parse_time_ps(args.time, "--time"),
            timestep_ps=parse_time_ps(args.timestep, "--timestep"),
            force_field=args.force_field,
        )
        outcomes.append(outcome)
        said = outcome.reason or "; ".join(outcome.notes)
        sys.stdout.write(
            f"{outcome.name:30s} {outcome.kind:11s} {outcome.status:8s} {outcome.n_atoms:4d} atoms "
            f"{outcome.seconds:6.1f} s  {outcome.force_field:8s} {said}\n"
        )
        sys.stdout.flush()
        if args.json is not None:
            args.json.write_text(json.dumps([asdict(o) for o in outcomes], indent=1))
    counts = {s: sum(o.status == s for o in outcomes) for s in ("ran", "refused", "failed")}
    sys.stdout.write(", ".join(f"{n} {s}" for s, n in counts.items()) + "\n")
    raise SystemExit(1 if counts["failed"] else 0)


if __name__ == "__main__":
    main()
