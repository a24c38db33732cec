"""How much of its time a torsion spends beyond an angle, and how often it crosses that angle.

    python docs/studies/quantum/torsion_states.py ATOMS BEYOND TRAJECTORY...

ATOMS are four numbers from 0 on, such as 6,7,8,17; BEYOND an angle in degrees, counted from cis, of either sign. The
standard error is that over trajectories.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from four_molecules import frames_of

from systems.chemistry.geometry import torsion


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("atoms", type=lambda text: [int(atom) for atom in text.split(",")])
    parser.add_argument("beyond", type=float)
    parser.add_argument("trajectories", type=Path, nargs="+")
    given = parser.parse_args()
    shares, turns = [], 0
    for path in given.trajectories:
        angle = torsion(frames_of(path), [given.atoms])[:, 0]
        beyond = np.abs(angle) > np.deg2rad(given.beyond)
        shares.append(100.0 * beyond.mean())
        turns += int((beyond[1:] != beyond[:-1]).sum())
    error = np.std(shares, ddof=1) / np.sqrt(len(shares)) if len(shares) > 1 else np.nan
    sys.stdout.write(
        f"{len(shares)} trajectories: {np.mean(shares):.0f} ± {error:.0f} % of frames, {turns} crossings\n"
    )


if __name__ == "__main__":
    main()
