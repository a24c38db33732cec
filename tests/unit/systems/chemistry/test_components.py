"""Residues of the chemical component dictionary: their hydrogens, charges and links, and cycles."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.graph import backbone_torsions, molecule_key
from systems.chemistry.residues import component, hydrogens_of, known_template, template_for
from systems.errors import PreparationError
from systems.library.named_scenes import prepare
from systems.prepare.molecule import scene_from_smiles
from systems.prepare.peptide import build_peptide
from systems.scene import Scene

INSIDE = {"N": 1, "C": 1}


def counts(name: str, *, ph: float = 7.0, links: dict[str, int] | None = None, without: str = "OXT") -> Counter[str]:
    found = component(name)
    assert found is not None
    rows = hydrogens_of(found, set(found.heavy) - set(without.split()), INSIDE if links is None else links, ph=ph)
    assert len({h for h, _ in rows}) == len(rows)
    return Counter(parent for _, parent in rows)


@pytest.mark.parametrize("name", ["ALA", "ARG", "CYS", "GLN", "GLY", "ILE", "LEU", "LYS", "MET", "PHE", "PRO", "SER",
                                  "THR", "TRP", "TYR", "VAL", "ASP", "GLU", "ASN"])  # fmt: skip
def test_rules_give_standard_residues_the_hydrogens_that_modeller_gives_them(name: str) -> None:
    scene = build_peptide(f"ACE-{name}-NME")
    at = [i for i in range(scene.n_atoms) if scene.residue_names[scene.residue_of_atom[i]] == name]
    near = scene.neighbours()
    theirs = {scene.atom_names[i]: sum(scene.elements[j] == "H" for j in near[i]) for i in at}
    assert counts(name) == Counter({a: n for a, n in theirs.items() if n})


def test_groups_are_charged_by_ph() -> None:
    assert (counts("SEP", ph=7)["O2P"], counts("SEP", ph=7)["O3P"]) == (0, 0)
    assert counts("SEP", ph=4)["O2P"] + counts("SEP", ph=4)["O3P"] == 1
    assert counts("ORN", ph=7)["NE"] == 3 and counts("ORN", ph=12)["NE"] == 2
    assert counts("HRG", ph=7)["NH1"] + counts("HRG", ph=7)["NH2"] == 4
    assert counts("ALY")["NZ"] == 1 and counts("PCA", links={"C": 1})["N"] == 1  # amides stay neutral
    assert counts("M3L")["NZ"] == 0 and counts("TYS")["O3"] == 0


def test_links_and_ends_take_and_give_hydrogens() -> None:
    assert (counts("NLE")["N"], counts("NLE", links={"C": 1})["N"], counts("MLE")["N"]) == (1, 3, 0)
    assert counts("NLE", links={"N": 1}, without="")["OXT"] == 0
    assert counts("CYS", links=INSIDE | {"SG": 1})["SG"] == 0
    assert counts("A", links={"O3'": 1}, without="OP3 P OP1 OP2")["O5'"] == 1  # the 5' end
    assert counts("NAG", links={"C1": 1, "O4": 1}, without="O1")["O4"] == 0


def test_every_component_can_be_read() -> None:
    from systems.chemistry.residues import _lines

    for name in list(_lines())[::12]:
        found = component(name)
        assert found is not None and len(found.heavy) == len(found.elements) == len(found.hydrogens)
        assert all(i < len(found.heavy) > j for i, j, _ in found.bonds)
    assert known_template("ALA") == template_for("ALA") and known_template("NOSUCH") is None


def heavy_pdb(scene: Scene, path: Path, *, names: dict[str, str] | None = None) -> Path:
    """The scene's heavy atoms, residues renamed, without CONECT."""
    lines = []
    for i in scene.heavy_idx.tolist():
        r = int(scene.residue_of_atom[i])
        residue = (names or {}).get(scene.residue_ids[r], scene.residue_names[r])
        x, y, z = (scene.positions_nm[i] * 10).tolist()
        head = f"ATOM  {len(lines) + 1:5d}  {scene.atom_names[i]:<4s}{residue:>3s} A{int(scene.residue_ids[r]):4d}"
        lines.append(f"{head}    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00          {scene.elements[i].upper():>2s}")
    path.write_text("\n".join([*lines, "END", ""]))
    return path


def labelled(smiles: str, chain: str) -> Scene:
    """A peptide of glycines, alanines, ... from SMILES, its atoms named from the graph: N, CA, C, O and CB1, CB2."""
    scene = scene_from_smiles(smiles)
    near, symbol = scene.neighbours(), scene.elements
    torsions = backbone_torsions(scene)
    rows = torsions["psi"][:, :3].tolist()
    names, residue = list(scene.atom_names), np.zeros(scene.n_atoms, dtype=np.int64)
    for k, (n, alpha, c) in enumerate(rows):
        o = next(j for j in near[c] if symbol[j] == "O")
        side = [j for j in near[alpha] if symbol[j] == "C" and j != c]
        named = {n: "N", alpha: "CA", c: "C", o: "O"}
        named |= {j: "CB" if len(side) == 1 else f"CB{m + 1}" for m, j in enumerate(side)}
        for i, name in named.items():
            names[i], residue[i] = name, k
    order = np.argsort(residue[scene.heavy_idx], kind="stable")
    chosen = scene.heavy_idx[order]
    return Scene(
        name="cycle",
        atom_names=tuple(names[i] for i in chosen),
        elements=tuple(symbol[i] for i in chosen),
        residue_of_atom=residue[chosen],
        residue_names=tuple(chain.split()),
        residue_ids=tuple(str(k + 1) for k in range(len(rows))),
        chain_of_residue=tuple("A" for _ in rows),
        bonds=np.empty((0, 2), dtype=np.int64),
        bond_orders=np.empty(0),
        formal_charges=np.zeros(len(chosen), dtype=np.int64),
        masses_da=scene.masses_da[chosen],
        positions_nm=scene.positions_nm[chosen],
    )


def test_a_cycle_without_hydrogens_gets_them_and_stays_one(tmp_path: Path) -> None:
    smiles = "N1[C@@H](C)C(=O)NCC(=O)NC(C)(C)C(=O)N[C@@H](C)C(=O)NCC(=O)N[C@@H](C)C(=O)1"
    path = heavy_pdb(labelled(smiles, "ALA GLY AIB ALA GLY ALA"), tmp_path / "cycle.pdb")
    scene = prepare(str(path))
    assert molecule_key(scene) == molecule_key(scene_from_smiles(smiles.replace("C(=O)1", "C1=O")))
    assert "OXT" not in scene.atom_names


def test_a_phosphoserine_without_hydrogens_is_charged_and_covered(tmp_path: Path) -> None:
    from md_reference.forces.forcefield import resolve
    from md_reference.forces.spec import ForceFieldSpec

    scene = build_peptide("ACE-ALA-SER-ALA-NME")
    at = {scene.atom_names[i]: i for i in range(scene.n_atoms) if scene.residue_of_atom[i] == 2}
    text = heavy_pdb(scene, tmp_path / "x.pdb", names={scene.residue_ids[2]: "SEP"}).read_text()
    og, cb = scene.positions_nm[at["OG"]] * 10, scene.positions_nm[at["CB"]] * 10
    p = og + 1.6 * (og - cb) / np.linalg.norm(og - cb)
    sideways = np.cross(og - cb, [0.3, 0.5, 0.8])
    sideways /= np.linalg.norm(sideways)
    upwards = np.cross(sideways, (og - cb) / np.linalg.norm(og - cb))
    away = (og - cb) / np.linalg.norm(og - cb)
    added = []
    for name, angle in (("O1P", 0.0), ("O2P", 2.094), ("O3P", 4.189)):
        added.append((name, "O", p + 1.5 * (0.33 * away + 0.94 * (np.cos(angle) * sideways + np.sin(angle) * upwards))))
    lines = [line for line in text.splitlines() if not line.startswith("END")]
    last = max(k for k, line in enumerate(lines) if line[17:20] == "SEP")
    for name, symbol, (x, y, z) in [("P", "P", p), *added]:
        last += 1
        head = f"ATOM   99{last:02d}  {name:<4s}SEP A{int(scene.residue_ids[2]):4d}"
        lines.insert(last, f"{head}    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00           {symbol}")
    path = tmp_path / "sep.pdb"
    path.write_text("\n".join([*lines, "END", ""]))
    prepared = prepare(str(path))
    assert int(prepared.formal_charges.sum()) == -2
    assert any("Component Dictionary" in line and "SEP" in line for line in prepared.provenance["repairs"])
    assert resolve(prepared, ForceFieldSpec("auto", "auto")).force_field == "ff14SB"


LACTAM = "CC(=O)N[C@H]1CCCCNC(=O)CC[C@H](NC(=O)[C@H](C)NC(=O)[C@H](C)NC(=O)[C@H](C)NC1=O)C(=O)NC"


def test_a_lactam_between_side_chains_keeps_its_bond_and_gets_no_oxygen(tmp_path: Path) -> None:
    chain = scene_from_smiles(LACTAM)  # ACE-LYS-ALA-ALA-ALA-GLU-NME, NZ bonded to CD
    near, symbol = chain.neighbours(), chain.elements
    rows = backbone_torsions(chain)["psi"][:, :3].tolist()
    backbone = [row for row in rows if any(symbol[j] == "C" for j in near[row[1]] if j not in row)]
    named: dict[int, tuple[int, str]] = {}
    for k, (n, alpha, c) in enumerate(backbone):
        named |= {n: (k + 1, "N"), alpha: (k + 1, "CA"), c: (k + 1, "C")}
        named[next(j for j in near[c] if symbol[j] == "O")] = (k + 1, "O")
        side = ["CB", "CG", "CD", "CE", "NZ"] if k == 0 else ["CB", "CG", "CD"] if k == 4 else ["CB"]
        at = alpha
        for name in side:
            at = next(j for j in near[at] if j not in named and symbol[j] == name[0])
            named[at] = (k + 1, name)
        if k == 4:
            named[next(j for j in near[at] if symbol[j] == "O")] = (5, "OE1")
    first, last = backbone[0][0], backbone[-1][2]
    c = next(j for j in near[first] if j not in named and symbol[j] == "C")
    named |= {c: (0, "C"), next(j for j in near[c] if symbol[j] == "O"): (0, "O")}
    named[next(j for j in near[c] if symbol[j] == "C")] = (0, "CH3")
    n = next(j for j in near[last] if j not in named and symbol[j] == "N")
    named |= {n: (6, "N"), next(j for j in near[n] if j not in named and symbol[j] == "C"): (6, "C")}
    residues = ["ACE", "LYS", "ALA", "ALA", "ALA", "GLU", "NME"]
    lines, link = [], {}
    for serial, i in enumerate(sorted(named, key=lambda i: named[i][0]), start=1):
        r, name = named[i]
        link[r, name] = serial
        position = "".join(f"{v:8.3f}" for v in (chain.positions_nm[i] * 10).tolist())
        lines.append(
            f"ATOM  {serial:5d}  {name:<4s}{residues[r]:>3s} A{r + 1:4d}    {position}  1.00  0.00{symbol[i]:>12s}"
        )
    lines.append(f"CONECT{link[1, 'NZ']:5d}{link[5, 'CD']:5d}")
    path = tmp_path / "lactam.pdb"
    path.write_text("\n".join([*lines, "END", ""]))
    scene = prepare(str(path))
    assert molecule_key(scene) == molecule_key(chain)
    assert "OE2" not in scene.atom_names


def test_a_component_that_lacks_heavy_atoms_is_refused(tmp_path: Path) -> None:
    smiles = "N1[C@@H](C)C(=O)NCC(=O)NC(C)(C)C(=O)N[C@@H](C)C(=O)NCC(=O)N[C@@H](C)C(=O)1"
    path = heavy_pdb(labelled(smiles, "ALA GLY AIB ALA GLY ALA"), tmp_path / "cycle.pdb")
    path.write_text("\n".join(line for line in path.read_text().splitlines() if " CB2 " not in line))
    with pytest.raises(PreparationError, match=r"AIB A3 lacks CB2"):
        prepare(str(path))


ADENYLATE = "P OP1 OP2 O5' C5' C4' O4' C3' O3' C2' O2' C1' N9 C8 N7 C5 C6 N6 N1 C2 N3 C4"


def test_a_phosphate_that_lacks_its_third_oxygen_is_refused(tmp_path: Path) -> None:
    ideal = scene_from_smiles(
        "OP(=O)(O)OC[C@H]1O[C@H]([C@H](O)[C@@H]1O)n1cnc2c(N)ncnc12"
    )  # AMP: positions do not matter, but for bonds that are too long
    lines = []
    for k, name in enumerate(ADENYLATE.split()):
        position = "".join(f"{v:8.3f}" for v in (ideal.positions_nm[k] * 2.5).tolist())
        lines.append(f"ATOM  {k + 1:5d}  {name:<4s}  A A   1    {position}  1.00  0.00{name[0]:>12s}")
    path = tmp_path / "a.pdb"
    path.write_text("\n".join([*lines, "END", ""]))
    with pytest.raises(PreparationError, match=r"A A1 lacks OP3.*, or leave its phosphate out"):
        prepare(str(path))


def test_another_molecule_under_a_components_name_is_none(tmp_path: Path) -> None:
    scene = build_peptide("ACE-VAL-NME")  # its CG1 and CG2 are no atoms of norleucine
    path = heavy_pdb(scene, tmp_path / "x.pdb", names={scene.residue_ids[1]: "NLE"})
    with pytest.raises(PreparationError, match=r"beside NLE"):
        prepare(str(path))
