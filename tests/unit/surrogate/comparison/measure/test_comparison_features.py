"""What is measured of each frame equals MDTraj and MDAnalysis on real data, and known answers where there are some."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from small_scenes import beyond, rotated
from surrogate.comparison.measure.structure import find_probes, mean_structure
from surrogate.comparison.measure.torsions import find_torsions
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from systems.prepare.peptide import build_peptide
from systems.scene import Scene

mdtraj = pytest.importorskip("mdtraj")
mda = pytest.importorskip("MDAnalysis")


@pytest.fixture(scope="module")
def real(shared_data: Path) -> Ensemble:
    """2,000 frames, evenly spread over ten published nanoseconds of alanine dipeptide."""
    folder = shared_data / "alanine-dipeptide"
    whole = load_ensemble([folder / "trajectory-1.dcd"], top=folder / "ala2.pdb")
    return whole.strided(5)


@pytest.fixture(scope="module")
def as_mdtraj(real: Ensemble) -> object:
    frames = mdtraj.Trajectory(real.segments[0][:], real.scene.to_mdtraj_topology())
    return frames


@pytest.fixture(scope="module")
def peptide() -> Scene:
    return build_peptide("ACE-VAL-PHE-PRO-LYS-THR-NME")


def names(scene: Scene, quad: tuple[int, ...]) -> str:
    return "-".join(scene.atom_names[i] for i in quad)


# ---- equality with other programs on real data ---------------------------------------------------------------------


def test_shape_equals_mdtraj(real: Ensemble, as_mdtraj: object) -> None:
    frames = real.segments[0][:]
    probes = find_probes(real.scene, frames)
    measured = probes.measure(frames)
    # MDTraj weighs distances from the unweighted centre; with equal weights both mean the same.
    equal = find_probes(replace(real.scene, masses_da=np.ones(22)), frames)
    assert equal.measure(frames)["shape"][:, 0] == pytest.approx(mdtraj.compute_rg(as_mdtraj), abs=2e-6)
    universe = mda.Universe.empty(22, trajectory=True)
    universe.add_TopologyAttr("masses", real.scene.masses_da)
    for k in range(0, 2000, 400):
        universe.atoms.positions = frames[k]
        assert measured["shape"][k, 0] == pytest.approx(universe.atoms.radius_of_gyration(), abs=2e-6)
    target = mdtraj.Trajectory(probes.mean_nm[None], as_mdtraj.topology.subset(probes.fit_idx))  # type: ignore[attr-defined]
    heavy = as_mdtraj.atom_slice(probes.fit_idx)  # type: ignore[attr-defined]
    assert measured["shape"][:, 1] == pytest.approx(mdtraj.rmsd(heavy, target), abs=2e-5)
    rmsf = np.sqrt(measured["deviation"].mean(axis=0))
    assert rmsf == pytest.approx(mdtraj.rmsf(heavy, target, 0), abs=2e-5)
    assert probes.ends is not None
    ends = mdtraj.compute_distances(as_mdtraj, [probes.ends], periodic=False)[:, 0]
    assert measured["shape"][:, 2] == pytest.approx(ends, abs=1e-6)
    contacts = mdtraj.compute_distances(as_mdtraj, probes.contacts, periodic=False)
    clear = np.abs(contacts - 0.45) > 1e-5
    assert np.array_equal(measured["contacts"][clear], (contacts < 0.45)[clear])
    assert measured["shape"][:, 3] == pytest.approx(measured["contacts"].sum(axis=1))


def test_angles_equal_mdanalysis(real: Ensemble) -> None:
    from MDAnalysis.lib import distances

    frames = real.segments[0][:300]
    probes = find_probes(real.scene, frames)
    a, b, c = (frames[:, probes.angles[:, k]].reshape(-1, 3) for k in range(3))
    expected = distances.calc_angles(a, b, c).reshape(len(frames), -1)
    assert probes.measure(frames)["angles"] == pytest.approx(expected, abs=2e-5)
    assert probes.angles.shape == (36, 3)


def test_hydrogen_bonds_equal_mdtraj(real: Ensemble, as_mdtraj: object) -> None:
    frames = real.segments[0][:]
    probes = find_probes(real.scene, frames)
    formed = probes.measure(frames)["hydrogen_bonds"]
    ours = {tuple(t): float(share) for t, share in zip(probes.hydrogen_bonds.tolist(), formed.mean(0), strict=True)}
    for threshold in (0.001, 0.01, 0.02):
        theirs = {tuple(t) for t in mdtraj.baker_hubbard(as_mdtraj, freq=threshold, periodic=False).tolist()}
        assert {t for t, share in ours.items() if share > threshold} == theirs
    assert any(share > 0.001 for share in ours.values()), "the C7 ring of alanine dipeptide closes now and then"


def test_chi_torsions_equal_mdtraj(peptide: Scene) -> None:
    """One torsion per chi with IUPAC's atoms, and values that MDTraj finds in the same frames."""
    rng = np.random.default_rng(0)
    frames = (peptide.positions_nm + 0.02 * rng.standard_normal((20, peptide.n_atoms, 3))).astype(np.float32)
    trajectory = mdtraj.Trajectory(frames, peptide.to_mdtraj_topology())
    probes = find_probes(peptide, frames)
    measured = probes.measure(frames)["torsions"]
    ours = {t.quad: (k, t.fold) for k, t in enumerate(probes.torsions) if t.kind == "χ"}
    theirs: dict[tuple[int, ...], np.ndarray] = {}
    for compute in (mdtraj.compute_chi1, mdtraj.compute_chi2, mdtraj.compute_chi3, mdtraj.compute_chi4):
        idx, values = compute(trajectory, periodic=False)
        theirs |= {tuple(q): values[:, k] for k, q in enumerate(idx.tolist())}
    in_ring = {q for q in theirs if peptide.residue_names[int(peptide.residue_of_atom[q[1]])] == "PRO"}
    assert set(ours) == set(theirs) - in_ring, [names(peptide, q) for q in set(ours) ^ (set(theirs) - in_ring)]
    for quad, (k, fold) in ours.items():
        equal = probes.torsions[k].equal
        assert quad in equal and len(equal) == fold
        told = mdtraj.compute_dihedrals(trajectory, np.array(equal), periodic=False)
        gap = measured[:, k] - (fold * theirs[quad] if fold == 1 else np.angle(np.exp(1j * fold * told).sum(axis=1)))
        assert np.cos(gap) == pytest.approx(np.ones(20), abs=1e-5), names(peptide, quad)
    labels = {t.label: t for t in probes.torsions}
    assert names(peptide, labels["χ1 VAL 2"].quad) == "N-CA-CB-CG1"
    assert names(peptide, labels["χ1 THR 6"].quad) == "N-CA-CB-OG1"
    assert labels["χ2 PHE 3"].fold == 2 and labels["χ4 LYS 5"].fold == 1


def test_it_does_not_matter_which_of_equal_atoms_is_called_the_first(peptide: Scene) -> None:
    """The edges of a phenyl ring and the hydrogens of a methyl group change places; two that are not equal do not."""
    rng = np.random.default_rng(1)
    frames = (peptide.positions_nm + 0.01 * rng.standard_normal((20, peptide.n_atoms, 3))).astype(np.float32)
    probes = find_probes(peptide, frames)
    before = probes.measure(frames)["torsions"]
    atom = {
        (peptide.residue_names[r], n): i
        for i, (r, n) in enumerate(zip(peptide.residue_of_atom.tolist(), peptide.atom_names, strict=True))
    }

    def swapped(*pairs: tuple[str, str, str]) -> np.ndarray:
        moved = frames.copy()
        for residue, a, b in pairs:
            i, j = atom[residue, a], atom[residue, b]
            moved[:, [i, j]] = moved[:, [j, i]]
        return np.cos(probes.measure(moved)["torsions"] - before).min(axis=0)

    ring = [("PHE", f"{x}1", f"{x}2") for x in ("CD", "CE", "HD", "HE")]
    assert swapped(*ring) == pytest.approx(np.ones(before.shape[1]), abs=1e-6)
    assert swapped(("VAL", "HG11", "HG12")) == pytest.approx(np.ones(before.shape[1]), abs=1e-6)
    assert swapped(("VAL", "CG1", "CG2")).min() < 0.5, "these two are not equal: the centre beside them is chiral"


# ---- known answers -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("bond", "fold"), [(("CB", "CG1"), 3), (("CB", "CG"), 2), (("CE", "NZ"), 3)])
def test_equivalent_positions_are_one(peptide: Scene, bond: tuple[str, str], fold: int) -> None:
    """A methyl by 120°, a phenyl by 180°: the same molecule, the same number. Half of that is another one."""
    found = [t for t in find_torsions(peptide) if {peptide.atom_names[i] for i in t.quad[1:3]} == set(bond)]
    k = next(t for t in found if t.fold == fold)
    probes = find_probes(peptide, peptide.positions_nm[None].astype(np.float32))
    index = [t.quad for t in probes.torsions].index(k.quad)
    i, j = k.quad[1:3]

    def value(degrees: float) -> float:
        frame = rotated(peptide.positions_nm, beyond(peptide, i, j), (i, j), np.radians(degrees))[None].astype(
            np.float32
        )
        return float(probes.measure(frame)["torsions"][0, index])

    start = value(0.0)
    assert np.cos(value(360.0 / fold) - start) == pytest.approx(1.0, abs=1e-5)
    assert np.cos(value(180.0 / fold) - start) == pytest.approx(-1.0, abs=1e-5)
    assert np.cos(value(30.0 / fold) - start) == pytest.approx(np.cos(np.radians(30.0)), abs=1e-4)


def test_small_molecules_have_every_rotatable_torsion() -> None:
    from systems.library.named_scenes import prepare

    kinds = {name: sorted((t.kind, t.fold) for t in find_torsions(prepare(f"smiles:{smiles}")))
             for name, smiles in (("aspirin", "CC(=O)Oc1ccccc1C(=O)O"), ("ethanol", "CCO"), ("benzene", "c1ccccc1"),
                                  ("toluene", "Cc1ccccc1"), ("neopentane", "CC(C)(C)C"))}  # fmt: skip
    assert [k for k, _ in kinds["aspirin"]].count("rotatable") == 3
    assert [k for k, _ in kinds["aspirin"]].count("rotor") == 2, "methyl and hydroxyl"
    assert kinds["ethanol"] == [("rotor", 1), ("rotor", 3)]
    assert kinds["benzene"] == []
    assert kinds["toluene"] == [("rotor", 6)]
    assert kinds["neopentane"] == [("rotor", 3)] * 4


@pytest.mark.parametrize("smiles", ["C1=CCCCC1", "COC(=O)[C@H](c1ccccc1Cl)N1CCc2sccc2C1"])
def test_a_half_chair_is_shown_by_a_torsion_that_its_pucker_turns(smiles: str) -> None:
    from systems.chemistry.geometry import torsion
    from systems.library.named_scenes import prepare

    scene = prepare(f"smiles:{smiles}")
    (ring,) = (t for t in find_torsions(scene) if t.kind == "ring")
    assert abs(np.degrees(torsion(scene.positions_nm[None], np.array([ring.quad]))[0, 0])) > 40.0


def test_rings_that_can_pucker_have_a_torsion(peptide: Scene) -> None:
    (ring,) = (t for t in find_torsions(peptide) if t.kind == "ring")
    assert {peptide.atom_names[i] for i in ring.quad} < {"CA", "CB", "CD", "CG", "N"}, "proline's, not phenyl's"
    assert ring.label.startswith("ring") and "PRO 4" in ring.label
    probes = find_probes(peptide, peptide.positions_nm[None].astype(np.float32))
    mirrored = peptide.positions_nm * [1.0, 1.0, -1.0]
    k = probes.torsions.index(ring)
    one, other = (
        probes.measure(x[None].astype(np.float32))["torsions"][0, k] for x in (peptide.positions_nm, mirrored)
    )
    assert abs(one) > 0.1 and other == pytest.approx(-one, abs=1e-4), "the mirror image puckers the other way"


def test_a_frame_that_is_not_finite_measures_nothing(simulate: Callable[..., Ensemble]) -> None:
    made = simulate(41, 30)
    frames = made.segments[0][:].copy()
    probes = find_probes(made.scene, frames)
    whole = probes.measure(frames)
    frames[7, 3, 1] = np.nan
    frames[9] = np.inf
    broken = probes.measure(frames)
    for family, values in broken.items():
        bad = np.zeros(30, dtype=bool)
        bad[[7, 9]] = True
        if values.dtype == bool:
            assert not values[bad].any()
        elif values.shape[1]:
            expected_nan = np.isnan(values[bad])
            assert expected_nan.all(), family
        assert np.array_equal(values[~bad], whole[family][~bad], equal_nan=values.dtype != bool), family


def test_the_mean_structure_is_free_of_rotation(simulate: Callable[..., Ensemble]) -> None:
    rng = np.random.default_rng(5)
    scene = simulate(42, 30).scene
    template = scene.positions_nm[scene.heavy_idx]
    noisy = template + 0.003 * rng.standard_normal((400, len(template), 3))
    spins = np.linalg.qr(rng.standard_normal((400, 3, 3)))[0]
    spins *= np.sign(np.linalg.det(spins))[:, None, None]
    mean = mean_structure(np.einsum("nij,nkj->nki", spins, noisy) + rng.standard_normal((400, 1, 3)))
    from systems.chemistry.geometry import superpose

    assert superpose(mean, template) == pytest.approx(template, abs=6e-4)


def test_what_is_left_of_a_molecule_keeps_its_torsions(peptide: Scene) -> None:
    from systems.scene import part_of

    heavy = peptide.heavy_idx
    part = part_of(peptide, heavy)
    frames = part.positions_nm[None].astype(np.float32)
    probes = find_probes(part, frames, parent=peptide, kept=heavy)
    expected = [t for t in find_torsions(peptide) if all(peptide.elements[i] != "H" for i in t.quad)]
    assert [t.label for t in probes.torsions] == [t.label for t in expected]
    assert [[part.atom_names[i] for i in t.quad] for t in probes.torsions] == [
        [peptide.atom_names[i] for i in t.quad] for t in expected
    ]
    assert not len(probes.hydrogen_bonds)
    assert replace(part, name="x").n_atoms == len(heavy)
