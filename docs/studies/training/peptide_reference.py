"""MD of peptides that weights are tested on, as files or as a record of its torsions.

    python docs/studies/training/peptide_reference.py CAMPAIGN/test

writes `unseen_torsions.npz`: of each molecule, the first 10 ns of each run, phi, psi and chi every 10 ps in steps of
0.4 degrees, which parts all bins of `peptide_unseen` evenly, and the first frames. What it holds of other molecules
stays. So rollouts can be compared with MD that took hours of a core and is not kept.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from peptide_rollouts import FRAMES_PS, thinned
from peptide_scores import FloatArray, angles, turns_of

from systems.errors import InputError
from systems.prepare.peptide import build_peptide
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

RECORD = Path(__file__).with_name("unseen_torsions.npz")
RUN_PS, LEAST_RUNS, STEPS = 10_000.0, 4, 900
# Steps are kept as so many coarse ones and the rest, which compress better apart.
FINE = 30


class Reference(NamedTuple):
    """Runs of MD of a molecule: their torsions `(n_frames, n_turns)` in rad (`peptide_scores.turns_of`), frames
    FRAMES_PS apart, and the first frames of all `(n_runs, n_atoms, 3)` nm. Where the runs are there as `files`, their
    frames `(n_frames, n_atoms, 3)` are, too."""

    name: str
    scene: Scene
    solvent: str
    torsions: list[FloatArray]
    starts_nm: FloatArray
    files: tuple[Path, ...] = ()
    frames_nm: tuple[FloatArray, ...] = ()

    @property
    def time_ps(self) -> float:
        return len(self.torsions[0]) * FRAMES_PS

    @classmethod
    def of(cls, files: Sequence[Path]) -> Reference:
        """Read runs, of each RUN_PS at most."""
        scene, frames, time_ps = thinned(files)
        frames = [x[: round(min(time_ps, RUN_PS) / FRAMES_PS)] for x in frames]
        with open_trajectory(files[0]) as reader:
            solvent = str(reader.record["solvent"])
        turns, starts = turns_of(scene), np.stack([x[0] for x in frames])
        torsions = [angles(turns, x) for x in frames]
        return cls(files[0].parent.name, scene, solvent, torsions, starts, tuple(files), tuple(frames))


def references(place: Path) -> Iterator[Reference]:
    """Yield every molecule of a folder, or of a record. Raises InputError where it holds none."""
    found = False
    if place.is_file():
        with np.load(place) as record:
            for key in (key for key in record.files if key.endswith("/torsions")):
                name, found = key.removesuffix("/torsions"), True
                sequence = name.removeprefix("free-") if name.startswith("free-") else f"ACE-{name}-NME"
                coarse, rest = record[key].astype(np.int64)
                torsions = (FINE * coarse + rest + 0.5) * (2.0 * math.pi / STEPS) - math.pi
                starts = record[f"{name}/starts"].astype(np.float64)
                yield Reference(name, build_peptide(sequence), str(record["solvent"]), list(torsions), starts)
    for folder in sorted(place.iterdir()) if place.is_dir() else ():
        if len(files := sorted(folder.glob("run_*.h5"))) >= LEAST_RUNS:
            found = True
            yield Reference.of(files)
    if not found:
        raise InputError(f"{place} holds no molecule with {LEAST_RUNS} runs or more.")


def write(record: Path, some: Sequence[Reference]) -> None:
    """Write molecules in one solvent to a record."""
    (solvent,) = {one.solvent for one in some}
    kept: dict[str, np.ndarray] = {"solvent": np.array(solvent)}
    for one in some:
        steps = np.floor((np.stack(one.torsions) + math.pi) * (STEPS / (2.0 * math.pi))) % STEPS
        kept[f"{one.name}/torsions"] = np.stack(np.divmod(steps, FINE)).astype(np.uint8)
        kept[f"{one.name}/starts"] = one.starts_nm.astype(np.float32)
    np.savez_compressed(record, **kept)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("test", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=RECORD)
    a = parser.parse_args(arguments)
    places = (*([a.out] if a.out.exists() else []), a.test)
    some = {one.name: one for place in places for one in references(place)}
    write(a.out, [some[name] for name in sorted(some)])
    sys.stdout.write("".join(f"{one.name}: {len(one.torsions)} runs of {one.time_ps:g} ps\n" for one in some.values()))


if __name__ == "__main__":
    main()
