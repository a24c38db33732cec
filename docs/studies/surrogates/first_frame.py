"""Time from typing to a closed file of one chunk: `python docs/studies/surrogates/first_frame.py [--rounds 7]`.

Processor and wall seconds of whole processes, `surromd rollout SCENE --time 31ps`, of a named scene and of a PDB file,
with and without `--weights`; the least of some rounds, and the processor time of `import torch` alone beside it, which
no rollout can do without. `--package FOLDER` runs the code of another checkout, too, by turns with this one.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from systems.library.named_scenes import load
from systems.trajectory.companion_writer import pdb_text

SCENE = "alanine-dipeptide"
HERE = Path(__file__).resolve().parents[3]


def seconds(code: str, arguments: list[str], package: Path) -> tuple[float, float]:
    """Return processor and wall seconds of a process of its own that runs `code`."""
    before, began = os.times(), time.perf_counter()
    subprocess.run([sys.executable, "-c", code, *arguments], cwd=package, check=True)  # code is looked for there first
    after = os.times()
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return spent, time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--package", type=Path, default=None)
    args = parser.parse_args()
    packages = {"here": HERE} | ({} if args.package is None else {str(args.package): args.package})
    with tempfile.TemporaryDirectory() as folder:
        pdb = Path(folder) / "my.pdb"
        pdb.write_text(pdb_text(load(SCENE)), encoding="utf-8")
        end = ["--time", "31ps", "-o", str(Path(folder) / "out.h5"), "--overwrite", "--quiet"]
        verb = "from surrogate.cli.main import main; main()"
        cases = {"import torch": ("import torch", [])}
        cases |= {
            f"{what}{', weights named' if named else ''}": (verb, ["rollout", scene, *named, *end])
            for what, scene in (("named scene", SCENE), ("PDB file", str(pdb)))
            for named in ([], ["--weights", SCENE])
        }
        found: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for _ in range(args.rounds):
            for what, (code, arguments) in cases.items():
                for name, package in packages.items():
                    found.setdefault((what, name), []).append(seconds(code, arguments, package))
    for (what, name), times in found.items():
        cpu, wall = (min(column) for column in zip(*times, strict=True))
        sys.stdout.write(f"{what:28} {name:20} {cpu:6.2f} s of processor time, {wall:6.2f} s wall\n")


if __name__ == "__main__":
    main()
