"""Print the handedness of C1 to C5 of the sugars in md_reference/forces/templates.py, from the dictionary's ideal
coordinates.

    python docs/studies/preparation/sugar_handedness.py

Needs the package `biotite`, which holds the wwPDB's chemical component dictionary.
"""

from __future__ import annotations

import sys

import biotite.structure.info as info

from md_reference.forces.templates import CENTRES, SUGARS
from systems.chemistry.geometry import signed_volumes


def main() -> None:
    """Compute, print, and say where the table differs."""
    for name, (letters, known) in SUGARS.items():
        residue = info.residue(name)
        at = {atom: k for k, atom in enumerate(residue.atom_name.tolist())}
        found = ""
        for row in CENTRES:
            if set(row) <= set(at):
                volume = signed_volumes(residue.coord.astype(float), [[at[atom] for atom in row]])[0]
                found += "+" if volume > 0 else "-"
            else:
                found += "."
        sys.stdout.write(f"{name} {letters} {found}{'' if found == known else f' but the table says {known}'}\n")


if __name__ == "__main__":
    main()
