"""Write systems/library/data/components.tsv.gz: residues of the wwPDB chemical component dictionary that chains are
made of.

    python docs/studies/preparation/component_subset.py [--output FILE]

The dictionary (CC0, wwPDB) comes with the package `biotite` (structure/info/components.bcif), which only this script
needs. Taken: every released component that links into a peptide, of elements that force fields know, and the standard
nucleotides and common saccharides named below. Kept: names, elements, bonds with their orders, charges and the
hydrogens of each atom; not the coordinates.

A line for each component: name, type, heavy atoms (NAME or NAME:ELEMENT, then +1 or -1), bonds (i-j, with # and the
order where it is not 1), hydrogens of each heavy atom (their names joined by commas; those that leave when the atom is
bonded to another residue first), atoms separated by spaces.
"""

from __future__ import annotations

import argparse
import gzip
import sys
from collections import defaultdict
from pathlib import Path

from biotite import __version__ as biotite_version
from biotite.structure.info.ccd import get_ccd

ELEMENTS = {"H", "C", "N", "O", "S", "P", "F", "CL", "BR", "I", "SE", "B"}
MOST_HEAVY_ATOMS = 50
NUCLEOTIDES = "A C G U DA DC DG DT DU I DI PSU 5MC 5MU OMC OMG OMU 1MA 2MG M2G 7MG H2U"
SACCHARIDES = "NAG NDG NGA A2G MAN BMA GLC BGC GAL GLA FUC FUL XYP XYS SIA SLB RIB GCU BDP IDS RAM"
ORDERS = {"sing": 1, "doub": 2, "trip": 3}


def main() -> None:
    """Select and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(__file__).parents[3] / "systems" / "library" / "data" / "components.tsv.gz"
    parser.add_argument("--output", type=Path, default=default)
    output = parser.parse_args().output
    ccd = get_ccd()
    kinds = chosen(ccd["chem_comp"])
    atoms = rows_of(ccd["chem_comp_atom"], kinds, "atom_id", "type_symbol", "charge", "pdbx_leaving_atom_flag")
    bonds = rows_of(ccd["chem_comp_bond"], kinds, "atom_id_1", "atom_id_2", "value_order")
    lines = [line for name in sorted(kinds) if (line := encoded(name, kinds[name], atoms[name], bonds[name]))]
    head = (
        f"# wwPDB chemical component dictionary (CC0) as of biotite {biotite_version}; made by "
        f"docs/studies/preparation/component_subset.py, which explains the columns. {len(lines)} components."
    )
    output.write_bytes(gzip.compress("\n".join([head, *lines, ""]).encode(), mtime=0))
    sys.stdout.write(f"{len(lines)} components, {output.stat().st_size / 1000:.0f} kB\n")


def chosen(table: object) -> dict[str, str]:
    """Return the type of each component that is taken: peptide, or other."""
    columns = [table[key].as_array().astype(str).tolist() for key in ("id", "type", "pdbx_release_status")]
    kinds = {}
    for name, kind, status in zip(*columns, strict=True):
        kind = kind.lower()
        if status == "REL" and "peptide" in kind and kind != "peptide-like":
            kinds[name] = "peptide"
        elif name in NUCLEOTIDES.split() or name in SACCHARIDES.split():
            kinds[name] = "nucleotide" if name in NUCLEOTIDES.split() else "saccharide"
    return kinds


def rows_of(table: object, names: dict[str, str], *keys: str) -> dict[str, list[tuple[str, ...]]]:
    """Return the rows of each wanted component."""
    columns = [table[key].as_array().astype(str).tolist() for key in ("comp_id", *keys)]
    out: dict[str, list[tuple[str, ...]]] = defaultdict(list)
    for name, *row in zip(*columns, strict=True):
        if name in names:
            out[name].append(tuple(row))
    return out


def encoded(name: str, kind: str, atoms: list[tuple[str, ...]], bonds: list[tuple[str, ...]]) -> str:
    """Return a component's line; empty for one that is not taken after all."""
    heavy = [row for row in atoms if row[1] not in ("H", "D")]
    if not 2 <= len(heavy) <= MOST_HEAVY_ATOMS or {row[1] for row in atoms} - ELEMENTS - {"D"}:
        return ""
    number = {row[0]: k for k, row in enumerate(heavy)}
    leaves = {row[0]: row[3] == "Y" for row in atoms}
    hydrogens: dict[int, list[str]] = defaultdict(list)
    joined = []
    for a, b, order in bonds:
        if a in number and b in number:
            value = ORDERS[order.lower()]
            joined.append(f"{number[a]}-{number[b]}" + ("" if value == 1 else f"#{value}"))
        elif a in number or b in number:
            parent, hydrogen = (a, b) if a in number else (b, a)
            hydrogens[number[parent]].append(hydrogen)
    words = []
    for atom, symbol, charge, _ in heavy:
        element = symbol.capitalize()
        sign = f"{int(charge):+d}" if charge not in ("?", ".", "0") else ""
        words.append(atom + ("" if atom[0] == element and len(element) == 1 else f":{element}") + sign)
    owned = [",".join(sorted(hydrogens[k], key=lambda h: not leaves[h])) for k in range(len(heavy))]
    return "\t".join([name, kind, " ".join(words), " ".join(joined), ";".join(owned)])


if __name__ == "__main__":
    main()
