"""Write systems/library/data/phosaa14SB.xml: Amber's phosphorylated amino acids beside ff14SB, as an OpenMM force
field.

    python docs/studies/reference/phosphorylated_residues.py [--output FILE]

Reads phosaa14SB.lib and frcmod.phosaa14SB of the AmberTools found here (its parameter files are in the public domain).
Source: Raguette, Cuomo, Belfon, Tian, Hazoglou, Witek, Telehany, Wu and Simmerling, J. Chem. Theory Comput. 20, 7199
(2024). Types that ff14SB has already keep OpenMM's names for them. tests/physics/test_chains.py holds the file against
tleap.
"""

from __future__ import annotations

import argparse
import re
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree

from md_reference.forces.programs import ambertools

KCAL = 4.184
# Columns that the types of a term take.
WIDTHS = {"MASS": 2, "BOND": 5, "ANGL": 8, "DIHE": 11, "IMPR": 11, "NONB": 2}
# Rows of parm10.dat about P, which the frcmod leaves to it.
PARM10 = {
    "BOND": [("NA-P", "250.0", "1.840")],
    "ANGL": [("CC-NA-P", "76.7", "125.10"), ("CR-NA-P", "76.7", "125.10"), ("NA-P-OP", "42.9", "102.38")],
    "DIHE": [("CR-NA-P-OP", "1", "0.00", "0.0", "3.")],
    "IMPR": [("CR-CC-NA-P", "1.1", "180.", "2.")],
    "NONB": [("P", "2.1000", "0.2000")],
}
ELEMENTS = {"C": "C", "O": "O", "P": "P"}


def main() -> None:
    """Convert and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(__file__).parents[3] / "systems" / "library" / "data" / "phosaa14SB.xml"
    parser.add_argument("--output", type=Path, default=default)
    output = parser.parse_args().output
    tables = ambertools().gaff2_table.parent
    sections = read_frcmod((tables / "frcmod.phosaa14SB").read_text())
    library = (tables.parent / "lib" / "phosaa14SB.lib").read_text()
    for section, rows in PARM10.items():
        sections[section] = [[*row] for row in rows] + sections[section]
    new = {row[0]: float(row[1]) for row in sections["MASS"]} | {"P": 30.97}
    root = ElementTree.Element("ForceField")
    info = ElementTree.SubElement(root, "Info")
    source = f"phosaa14SB.lib and frcmod.phosaa14SB of AmberTools {ambertools().version}"
    ElementTree.SubElement(info, "Source").text = source
    types = ElementTree.SubElement(root, "AtomTypes")
    for name, mass in new.items():
        row = {"name": typed(name, new), "class": typed(name, new), "element": ELEMENTS[name[0]], "mass": repr(mass)}
        ElementTree.SubElement(types, "Type", row)
    residues = ElementTree.SubElement(root, "Residues")
    for name in re.findall(r"!entry\.(\w+)\.unit\.atoms ", library):
        add_residue(residues, name, library, new)
    bonds = ElementTree.SubElement(root, "HarmonicBondForce")
    for kinds, k, length in terms(sections["BOND"], 2):
        row = {"length": repr(length / 10), "k": repr(2 * k * KCAL * 100)}
        ElementTree.SubElement(bonds, "Bond", slots(kinds, new) | row)
    angles = ElementTree.SubElement(root, "HarmonicAngleForce")
    for kinds, k, degrees in terms(sections["ANGL"], 3):
        row = {"angle": repr(degrees * 3.141592653589793 / 180), "k": repr(2 * k * KCAL)}
        ElementTree.SubElement(angles, "Angle", slots(kinds, new) | row)
    torsions = ElementTree.SubElement(root, "PeriodicTorsionForce", ordering="amber")
    series: dict[tuple[str, ...], list[tuple[float, float, float]]] = defaultdict(list)
    for kinds, divider, k, phase, period in terms(sections["DIHE"], 4):
        series[kinds].append((abs(period), phase, k / divider))
    for kinds, rows in series.items():
        ElementTree.SubElement(torsions, "Proper", slots(kinds, new) | periodic(rows))
    for kinds, k, phase, period in terms(sections["IMPR"], 4):
        order = (kinds[2], kinds[0], kinds[1], kinds[3])
        ElementTree.SubElement(torsions, "Improper", slots(order, new) | periodic([(period, phase, k)]))
    nonbonded = ElementTree.SubElement(root, "NonbondedForce", coulomb14scale=repr(1 / 1.2), lj14scale="0.5")
    ElementTree.SubElement(nonbonded, "UseAttributeFromResidue", name="charge")
    for name, half_minimum, depth in ((row[0], float(row[1]), float(row[2])) for row in sections["NONB"]):
        sigma_nm = half_minimum * 2 ** (5 / 6) / 10
        row = {"type": typed(name, new), "sigma": repr(sigma_nm), "epsilon": repr(depth * KCAL)}
        ElementTree.SubElement(nonbonded, "Atom", row)
    ElementTree.indent(root, space=" ")
    output.write_text(ElementTree.tostring(root, encoding="unicode") + "\n")


def read_frcmod(text: str) -> dict[str, list[list[str]]]:
    """Return the rows of each section, split into words; the types of a term are one word, `N-CX-2C-OR`."""
    sections: dict[str, list[list[str]]] = {}
    section = ""
    for line in text.splitlines()[1:]:
        if line.strip() in WIDTHS:
            section = line.strip()
            sections[section] = []
        elif line.strip():
            width = WIDTHS[section]
            sections[section].append([line[:width].replace(" ", "").strip(), *line[width:].split()])
    return sections


def terms(rows: list[list[str]], count: int) -> list[tuple]:
    """Return (types, numbers ...) of each row."""
    out = []
    for row in rows:
        kinds = tuple(row[0].split("-"))
        if len(kinds) != count:
            raise SystemExit(f"cannot read {' '.join(row)}")
        numbers = []
        for word in row[1:]:
            try:
                numbers.append(float(word))
            except ValueError:
                break
        out.append((kinds, *numbers[: 4 if count == 4 and len(numbers) >= 4 else 3 if count == 4 else 2]))
    return out


def typed(kind: str, new: dict[str, float]) -> str:
    """OpenMM's name of an Amber type: ff14SB's own, or one of this file."""
    return f"{'phospho' if kind in new else 'protein'}-{kind}"


def slots(kinds: tuple[str, ...], new: dict[str, float]) -> dict[str, str]:
    """Attributes type1, type2 ..."""
    return {f"type{k + 1}": "" if kind == "X" else typed(kind, new) for k, kind in enumerate(kinds)}


def periodic(rows: list[tuple[float, float, float]]) -> dict[str, str]:
    """Attributes of a torsion's series."""
    out = {}
    for k, (period, phase, strength) in enumerate(rows, start=1):
        out |= {f"periodicity{k}": str(int(period)), f"phase{k}": repr(phase * 3.141592653589793 / 180)}
        out[f"k{k}"] = repr(strength * KCAL)
    return out


def add_residue(parent: ElementTree.Element, name: str, library: str, new: dict[str, float]) -> None:
    """Add a residue of a leap library."""
    atoms = re.findall(r'^ "(\S+)" "(\S+)" .* (\S+)$', block(library, name, "atoms"), re.MULTILINE)
    residue = ElementTree.SubElement(parent, "Residue", name=name)
    for atom, kind, charge in atoms:
        ElementTree.SubElement(residue, "Atom", name=atom, type=typed(kind, new), charge=charge)
    for i, j in re.findall(r"^ (\d+) (\d+) \d+$", block(library, name, "connectivity"), re.MULTILINE):
        row = {"atomName1": atoms[int(i) - 1][0], "atomName2": atoms[int(j) - 1][0]}
        ElementTree.SubElement(residue, "Bond", row)
    for i in block(library, name, "connect").split()[-2:]:
        ElementTree.SubElement(residue, "ExternalBond", atomName=atoms[int(i) - 1][0])


def block(library: str, name: str, what: str) -> str:
    """Return the lines of one table of a leap library."""
    found = re.search(rf"!entry\.{name}\.unit\.{what} [^\n]*\n([^!]*)", library)
    if found is None:
        raise SystemExit(f"{name} has no {what}")
    return found[1]


if __name__ == "__main__":
    main()
