"""What is made of inputs with faults that people reported of other programs: a line or two each.

    python docs/studies/preparation/reports.py [--data ../shared/data/reports]

The folder's README says what is right. Structures are prepared, lists of molecules read, trajectories opened with the
topology that they belong to.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from surrogate.verbs.run.run_scenes import molecules_in
from systems.errors import SurromdError
from systems.library.named_scenes import prepare
from systems.trajectory.codec import open_trajectory

TOPOLOGIES = {"ref.h5", "ref.pdb", "eth.h5", "eth.pdb", "README.md"}


def structure(path: Path) -> Iterator[str]:
    scene = prepare(str(path))
    yield f"{scene.n_atoms} atoms, charge {int(scene.formal_charges.sum())}"
    yield from map(str, scene.provenance.get("repairs", []))


def molecule_list(path: Path) -> Iterator[str]:
    found = molecules_in(path)
    assert found is not None
    yield f"{len(found.scenes)} molecules: {', '.join(spec.name for spec in found.scenes)}"


def trajectory(path: Path, tops: list[Path]) -> Iterator[str]:
    """Yield what a file holds, with the first topology that fits."""
    failure: SurromdError | None = None
    for top in (None, *tops):
        try:
            with open_trajectory(path, top=top) as reader:
                times = f"{reader.time_ps[-1]:g} ps" if reader.times_known else "unknown times"
                yield f"{reader.n_frames} frames of {reader.n_atoms} atoms, {times}"
                yield from reader.notes
                return
        except SurromdError as error:
            failure = error
    raise failure or AssertionError


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/reports"))
    data = parser.parse_args().data
    for path in sorted(p for p in data.iterdir() if p.name not in TOPOLOGIES):
        try:
            if path.suffix == ".smi":
                found = list(molecule_list(path))
            elif path.suffix == ".pdb" and "models" not in path.name:
                found = list(structure(path))
            else:
                found = list(trajectory(path, [data / "ref.pdb", data / "eth.pdb"]))
        except SurromdError as error:
            found = [f"refused: {error}"]
        sys.stdout.write(f"{path.name}\n" + "".join(f"    {line}\n" for line in found))


if __name__ == "__main__":
    main()
