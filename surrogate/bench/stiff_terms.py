"""Give weights the stiff terms of a reference (models.stiff): `python -m surrogate.bench.stiff_terms WEIGHTS REF... -o
OUT`.

The network stays as it is, rounded to float16 as weights are shipped; rollouts then hold rigid bonds rigid and draw the
width of other bonds and of angles given the torsions.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from surrogate.bench.alanine_dipeptide import ship
from surrogate.data.shipped import weights_path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="name of shipped weights, or a file")
    parser.add_argument("references", nargs="+", type=Path)
    parser.add_argument("--out", "-o", type=Path, required=True)
    args = parser.parse_args()
    ship(weights_path(args.weights), args.out, args.references)


if __name__ == "__main__":
    main()
