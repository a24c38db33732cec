"""How near atoms come to each other in MD that are more than three bonds apart: where `CLASH_NM` comes from.

    python docs/studies/preparation/contacts.py FILE_OR_GLOB ... [--stride 3]

For each pair of contact classes the nearest distance of all frames, 0.8 of it, the limit, and which atoms of which
molecule came so near; then the share of each molecule's frames that the limits call a clash, which MD at 300 K should
have none of. All files of one folder are of one molecule.
"""

from __future__ import annotations

import argparse
import glob
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from surrogate.comparison.read.ensemble import load_ensemble
from systems.chemistry.geometry import column_blocks, squared_distance
from systems.chemistry.validity import (
    CLASH,
    CLASH_NM,
    CLASH_SHARE_OF_LEAST,
    CONTACT_CLASSES,
    check_frames,
    geometry_from_scene,
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+")
    parser.add_argument("--stride", type=int, default=3)
    given = parser.parse_args()
    by_folder: dict[Path, list[Path]] = defaultdict(list)
    for pattern in given.files:
        for name in sorted(glob.glob(pattern)):
            by_folder[Path(name).parent].append(Path(name))
    nearest: dict[tuple[int, int], tuple[float, str]] = {}
    for folder, files in by_folder.items():
        ensemble = load_ensemble(files)
        scene, geometry = ensemble.scene, geometry_from_scene(ensemble.scene)
        frames = np.concatenate([np.asarray(s[:: given.stride]) for s in ensemble.segments])
        classes = np.sort(geometry.contact_class[geometry.clash_idx], axis=1)
        least = np.full(len(classes), np.inf)
        for _, columns in column_blocks(frames, len(classes)):
            least = np.minimum(least, squared_distance(columns, geometry.clash_idx).min(axis=1))
        for (a, b), (i, j), square in zip(classes.tolist(), geometry.clash_idx.tolist(), least, strict=True):
            distance = float(np.sqrt(square))
            if distance < nearest.get((a, b), (np.inf, ""))[0]:
                nearest[a, b] = distance, f"{scene.atom_names[i]}-{scene.atom_names[j]} of {folder.name}"
        flags = check_frames(frames, geometry) & CLASH
        sys.stdout.write(f"{folder.name}: {len(frames):,} frames, {np.count_nonzero(flags)} clash\n")
    for (a, b), (distance, where) in sorted(nearest.items()):
        sys.stdout.write(
            f"{CONTACT_CLASSES[a]}, {CONTACT_CLASSES[b]}: {distance:.3f} nm, {CLASH_SHARE_OF_LEAST * distance:.3f}; "
            f"limit {CLASH_NM[a, b]:.3f} ({where})\n"
        )


if __name__ == "__main__":
    main()
