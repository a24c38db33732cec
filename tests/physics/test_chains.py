"""Chains with residues beyond the twenty: phosphorylated ones and nucleic acids by templates, others by GAFF2."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from energies import energy_terms
from md_reference.forces import nonstandard
from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.gaff import POWER, SECONDS_AT_30_ATOMS, announce, expected_s
from md_reference.forces.mixture import regroup
from md_reference.forces.nonstandard import cap, make_template
from md_reference.forces.programs import find_ambertools, run
from md_reference.forces.spec import ForceFieldSpec
from systems.chemistry.bond_orders import perceive
from systems.chemistry.graph import backbone_torsions
from systems.errors import PreparationError
from systems.library.named_scenes import load, prepare
from systems.prepare.molecule import scene_from_smiles
from systems.scene import Scene

needs_ambertools = pytest.mark.skipif(find_ambertools() is None, reason="AmberTools is not installed")


def leap_scene(
    sequence: str,
    folder: Path,
    sources: tuple[str, ...],
    *,
    lines: Sequence[str] = (),
    names: Mapping[str, str] | None = None,
) -> tuple[Scene, Any]:
    """A sequence (or what `lines` make of x) as tleap builds it, 0.05 Å off its own geometry, residues under new
    `names`, and the System of tleap's prmtop."""
    from openmm import app, unit

    script = [f"source leaprc.{name}" for name in sources]
    script += [*(lines or [f"x = sequence {{ {sequence} }}"]), "saveamberparm x x.prmtop x.inpcrd", "quit", ""]
    (folder / "leap.in").write_text("\n".join(script))
    run("tleap", ["-f", "leap.in"], folder)
    prmtop = app.AmberPrmtopFile(str(folder / "x.prmtop"))
    topology = prmtop.topology
    residues = list(topology.residues())
    elements = [a.element.symbol for a in topology.atoms()]
    bonds = np.array(sorted(tuple(sorted((a.index, b.index))) for a, b in topology.bonds()), dtype=np.int64)
    orders, charges = perceive(elements, bonds)
    read = app.AmberInpcrdFile(str(folder / "x.inpcrd")).positions
    positions_nm = np.array(read.value_in_unit(unit.nanometer))
    positions_nm += 0.005 * np.random.default_rng(0).normal(size=positions_nm.shape)
    scene = Scene(
        name=sequence,
        atom_names=tuple(a.name for a in topology.atoms()),
        elements=tuple(elements),
        residue_of_atom=np.array([a.residue.index for a in topology.atoms()], dtype=np.int64),
        residue_names=tuple((names or {}).get(r.name, r.name) for r in residues),
        residue_ids=tuple(str(r.index + 1) for r in residues),
        chain_of_residue=tuple("A" for _ in residues),
        bonds=bonds,
        bond_orders=orders,
        formal_charges=charges,
        masses_da=np.array([a.element.mass._value for a in topology.atoms()]),
        positions_nm=positions_nm,
    )
    return scene, prmtop.createSystem(nonbondedMethod=app.NoCutoff, constraints=None, removeCMMotion=False)


def ours_and_theirs(scene: Scene, theirs: Any) -> tuple[dict[str, float], dict[str, float]]:
    """The energy terms in vacuum of the force field that we choose, which is ff14SB, and of tleap's System."""
    spec = resolve(scene, ForceFieldSpec("auto", "vacuum", None, False))
    assert spec.force_field == "ff14SB"
    return energy_terms(build_system(scene, spec), scene.positions_nm), energy_terms(theirs, scene.positions_nm)


@needs_ambertools
@pytest.mark.parametrize("name", ["SEP", "S1P", "TPO", "T1P", "PTR", "Y1P", "H1D", "H2D", "H1E", "H2E"])
def test_phosphorylated_residues_have_tleaps_energies(name: str, tmp_path: Path) -> None:
    scene, theirs = leap_scene(f"ACE ALA {name} GLY NME", tmp_path, ("protein.ff14SB", "phosaa14SB"))
    ours, expected = ours_and_theirs(scene, theirs)
    for force in ("HarmonicBondForce", "HarmonicAngleForce", "NonbondedForce"):
        assert ours[force] == pytest.approx(expected[force], abs=0.02), force
    # Impropers of rings depend on the order of their atoms (`regrouping`): two of 4.6 kJ/mol in a tyrosine.
    ring = 0.3 if name in ("PTR", "Y1P") or name.startswith("H") else 0.0
    assert ours["PeriodicTorsionForce"] == pytest.approx(expected["PeriodicTorsionForce"], abs=0.02 + ring)


# ---- residues from GAFF2 -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["aspirin", "uracil"])
def test_a_template_gives_each_term_of_the_molecule_it_was_made_of(name: str) -> None:
    import io

    from openmm import app

    scene = load(name)
    template = make_template(*cap(scene, 0), "MOL-1")
    ours = app.ForceField(io.StringIO(template)).createSystem(scene.to_openmm_topology(), removeCMMotion=False)
    x = scene.positions_nm + 0.005 * np.random.default_rng(0).normal(size=scene.positions_nm.shape)
    theirs = energy_terms(build_system(scene, ForceFieldSpec("gaff2", "vacuum", None, False)), x)
    for force, energy in energy_terms(ours, x).items():
        assert energy == pytest.approx(theirs[force], abs=1e-4), force


@pytest.fixture(scope="module")
def aib_chain(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """ACE-ALA-AIB-ALA-NME, its chain and its System; one AM1-BCC calculation of 25 atoms."""
    if find_ambertools() is None:
        pytest.skip("AmberTools is not installed")
    patch = pytest.MonkeyPatch()
    patch.setenv("SURROMD_CACHE", str(tmp_path_factory.mktemp("cache")))
    scene = scene_from_smiles("CC(=O)N[C@@H](C)C(=O)NC(C)(C)C(=O)N[C@@H](C)C(=O)NC")
    chain = nonstandard.find_chain(scene)
    assert chain is not None
    yield scene, chain, build_system(scene, ForceFieldSpec("auto", "auto", None, False))
    patch.undo()


def test_only_the_residue_without_a_template_is_charged_anew(aib_chain: Any) -> None:
    from openmm import NonbondedForce

    scene, chain, system = aib_chain
    assert resolve(scene, ForceFieldSpec("auto", "auto")).force_field == "ff14SB+gaff2"
    assert len(chain.unknown) == 1
    capped, n_own = cap(chain.scene, chain.unknown[0])
    assert (capped.formula, n_own) == ("C7H14N2O2", 13)  # ACE-AIB-NME
    force = next(f for f in system.getForces() if isinstance(f, NonbondedForce))
    charges_e = np.array([force.getParticleParameters(i)[0]._value for i in range(scene.n_atoms)])
    residue = chain.scene.residue_of_atom[np.argsort(chain.order)]
    for r in range(len(chain.scene.residue_names)):
        assert charges_e[residue == r].sum() == pytest.approx(0.0, abs=1e-6)
    alanine = Counter(np.round(charges_e[residue == 1], 4).tolist())
    assert alanine[-0.4157] == alanine[0.5973] == alanine[-0.5679] == 1  # N, C and O of ff14SB


def test_backbone_torsions_of_such_a_residue_are_those_of_alanine(aib_chain: Any) -> None:
    from openmm import PeriodicTorsionForce

    scene, _, system = aib_chain
    force = next(f for f in system.getForces() if isinstance(f, PeriodicTorsionForce))
    terms: dict[tuple[int, ...], set[tuple[float, ...]]] = {}
    for k in range(force.getNumTorsions()):
        i, j, m, n, period, phase, strength = force.getTorsionParameters(k)
        row = (period, round(phase._value, 4), round(strength._value, 4))
        for atoms in ((i, j, m, n), (n, m, j, i)):
            terms.setdefault(atoms, set()).add(row)
    torsions = backbone_torsions(scene)
    for name in ("phi", "psi"):
        alanine, aib, _ = [terms[tuple(row)] for row in torsions[name].tolist()]
        assert len(alanine) > 1 and aib == alanine, name


def test_such_a_chain_stays_whole_at_300_k(aib_chain: Any) -> None:
    from md_reference.run.config import Conditions
    from md_reference.run.engine import Engine

    scene, _, _ = aib_chain
    spec = resolve(scene, ForceFieldSpec("auto", "auto"))
    with Engine(
        scene, Conditions(force=spec, temperature_k=300.0, friction_per_ps=1.0, timestep_ps=0.004, platform="CPU")
    ) as engine:
        engine.minimise()
        engine.thermalise()
        engine.step(1000)
        x = engine.state().positions_nm
    i, j = scene.bonds.T
    stretch = np.linalg.norm(x[i] - x[j], axis=1) / np.linalg.norm(
        scene.positions_nm[i] - scene.positions_nm[j], axis=1
    )
    assert np.isfinite(x).all() and stretch.min() > 0.85 and stretch.max() < 1.15


def test_a_missing_term_is_refused(aib_chain: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import re

    from md_reference.forces import nonstandard as module

    def with_a_hole(capped: Scene, n_own: int, name: str) -> str:
        return re.sub(r"<Angle [^>]*/>", "", make_template(capped, n_own, name), count=1)

    monkeypatch.setattr(module, "make_template", with_a_hole)
    with pytest.raises(PreparationError, match=r"no parameters for .* angles"):
        build_system(aib_chain[0], ForceFieldSpec("auto", "auto"))


def test_other_protein_force_fields_send_such_chains_to_ff14sb() -> None:
    scene = scene_from_smiles("CC(=O)N[C@@H](C)C(=O)NC(C)(C)C(=O)N[C@@H](C)C(=O)NC")
    with pytest.raises(PreparationError, match=r"use `force_field='ff14SB\+gaff2"):
        build_system(scene, ForceFieldSpec("ff19SB+gaff2", "vacuum"))
    with pytest.raises(PreparationError, match=r"`force_field='ff14SB\+gaff2"):
        build_system(scene, ForceFieldSpec("ff14SB", "vacuum"))


def test_the_amide_that_ends_a_chain_is_a_residue_and_asparagines_is_not() -> None:
    scene = scene_from_smiles("CC(=O)N[C@@H](CC(N)=O)C(=O)N[C@@H](C)C(N)=O")  # ACE-ASN-ALA-NH2 in one residue
    regrouped, _ = regroup(scene)
    sizes = Counter(regrouped.residue_of_atom.tolist())
    assert sorted(sizes.values()) == [3, 6, 10, 14]
    assert resolve(scene, ForceFieldSpec("auto", "auto")).force_field == "ff14SB"


# ---- nucleic acids -------------------------------------------------------------------------------------------------


@needs_ambertools
@pytest.mark.parametrize(("sequence", "source"), [("DA5 DT DG3", "DNA.OL15"), ("A5 U G C3", "RNA.OL3")])
def test_nucleic_acids_have_tleaps_energies(sequence: str, source: str, tmp_path: Path) -> None:
    scene, theirs = leap_scene(sequence, tmp_path, (source,))
    ours, expected = ours_and_theirs(scene, theirs)
    for force, energy in expected.items():
        if force in ours:
            assert ours[force] == pytest.approx(energy, rel=2e-4, abs=0.3), force


# ---- sugars --------------------------------------------------------------------------------------------------------

# The Protein Data Bank's names of GLYCAM's residues.
_PDB_NAMES = {"4YB": "NAG", "VMB": "BMA", "0MA": "MAN", "NLN": "ASN", "0fA": "FUC", "UYB": "NAG"}


def glycopeptide(folder: Path, names: dict[str, str]) -> tuple[Scene, Any]:
    """ACE-ASN-NME with NAG(FUC)-NAG-BMA(MAN)MAN, 0.05 Å off tleap's geometry, residues renamed; and tleap's System."""
    lines = [
        "p = sequence { ACE NLN NME }", "a = sequence { UYB }", "b = sequence { 4YB }", "c = sequence { VMB }",
        "d = sequence { 0MA }", "e = sequence { 0MA }", "f = sequence { 0fA }", "x = combine { p a b c d e f }",
        "bond x.2.ND2 x.4.C1", "bond x.4.O4 x.5.C1", "bond x.5.O4 x.6.C1", "bond x.6.O3 x.7.C1", "bond x.6.O6 x.8.C1",
        "bond x.4.O6 x.9.C1",
    ]  # fmt: skip
    return leap_scene("", folder, ("protein.ff14SB", "GLYCAM_06j-1"), lines=lines, names=names)


# ---- what is said about charges ------------------------------------------------------------------------------------


def test_the_cost_of_charges_grows_as_measured() -> None:
    assert expected_s(30) == pytest.approx(SECONDS_AT_30_ATOMS)
    assert 15 < expected_s(40) < 60 and expected_s(60) / expected_s(30) == pytest.approx(2**POWER)


def test_charges_are_announced_where_they_take_long(caplog: pytest.LogCaptureFixture) -> None:
    announce(load("ethanol"))
    assert not caplog.records
    announce(replace(load("aspirin"), name="aspirin"))
    (record,) = caplog.records
    assert "aspirin: computing AM1-BCC charges for 21 atoms (about 2 s on an idle core)" in record.getMessage()


@needs_ambertools
def test_a_glycopeptide_without_hydrogens_is_completed(tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    scene, _ = glycopeptide(tmp_path, _PDB_NAMES)
    dictionary = {"C2N": "C7", "O2N": "O7", "CME": "C8"}
    # Sugars stand where tleap makes them, on one another: link by link they are moved to a bond's length.
    x = np.array(scene.positions_nm)
    at = {(int(r), n): i for i, (r, n) in enumerate(zip(scene.residue_of_atom, scene.atom_names, strict=True))}
    links = [((1, "ND2"), 3), ((3, "O4"), 4), ((4, "O4"), 5), ((5, "O3"), 6), ((5, "O6"), 7), ((3, "O6"), 8)]
    near = scene.neighbours()
    for anchor, sugar in links:
        a, c1 = at[anchor], at[sugar, "C1"]
        inner = next(j for j in near[a] if scene.residue_of_atom[j] == anchor[0] and scene.elements[j] == "C")
        outward = (x[a] - x[inner]) / np.linalg.norm(x[a] - x[inner])
        members = np.flatnonzero(scene.residue_of_atom == sugar)
        free = -sum((x[j] - x[c1]) / np.linalg.norm(x[j] - x[c1]) for j in near[c1] if j in members)
        turn, _ = Rotation.align_vectors([-outward], [free])
        x[members] = x[a] + 0.143 * outward + turn.apply(x[members] - x[c1])
    lines = []
    for i in scene.heavy_idx.tolist():
        r = int(scene.residue_of_atom[i])
        name = dictionary.get(scene.atom_names[i], scene.atom_names[i])
        head = f"ATOM  {len(lines) + 1:5d}  {name:<4s}{scene.residue_names[r]:>3s} A{r + 1:4d}"
        position = "".join(f"{v:8.3f}" for v in (x[i] * 10).tolist())
        lines.append(f"{head}    {position}  1.00  0.00          {scene.elements[i]:>2s}")
    path = tmp_path / "glycan.pdb"
    path.write_text("\n".join([*lines, "END", ""]))
    prepared = prepare(str(path))
    assert prepared.formula == scene.formula
    assert resolve(prepared, ForceFieldSpec("auto", "auto")).force_field == "gaff2"


@needs_ambertools
def test_a_nucleic_acid_too_large_for_charges_names_what_no_template_fits(tmp_path: Path) -> None:
    scene, _ = leap_scene("A5 U G C U G A U G C3", tmp_path, ("RNA.OL3",))
    at = next(i for i in range(scene.n_atoms) if scene.atom_names[i] == "H5" and scene.residue_of_atom[i] == 4)
    fluorinated = replace(scene, elements=(*scene.elements[:at], "F", *scene.elements[at + 1 :]))
    with pytest.raises(PreparationError, match=r"which lacks U 5; AM1-BCC charges for them take about .* h"):
        build_system(fluorinated, ForceFieldSpec("auto", "auto"))
