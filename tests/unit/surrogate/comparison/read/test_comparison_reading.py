"""Other people's files: part of the molecule, periodic cells, no times, and trajectories that stay on disk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mdtraj
import numpy as np
import pytest

from surrogate.comparison.comparison import compare
from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.statistics import Blocks
from surrogate.comparison.measure.structure import Baseline, backbone
from surrogate.comparison.read.ensemble import Ensemble, alike, load_ensemble
from surrogate.comparison.read.stored_frames import StoredFrames, bond_tree, make_whole, match_scenes, solute_atoms
from surrogate.comparison.rows.rows import Options
from systems.errors import InputError, OutOfDomainError
from systems.library.named_scenes import prepare
from systems.prepare.peptide import build_peptide
from systems.scene import Scene, part_of
from systems.trajectory.codec import open_writer
from systems.trajectory.companion_writer import pdb_text
from systems.trajectory.foreign_scenes import scene_from_structure

BOX = np.array([[2.4, 0.0, 0.0], [0.7, 2.2, 0.0], [-0.6, 0.5, 2.1]])


@pytest.fixture(scope="module")
def peptide() -> Scene:
    """Valine, phenylalanine and proline between caps: prochiral methyls, a ring that can turn, a ring that puckers."""
    return build_peptide("ACE-VAL-PHE-PRO-NME")


def write(path: Path, scene: Scene, frames: np.ndarray, lag: float = 1.0) -> Path:
    with open_writer(path, scene, {"temperature_k": 300.0}, overwrite=True) as writer:
        writer.append(frames, lag * np.arange(1, len(frames) + 1))
    return path


def shuffled(scene: Scene, seed: int) -> tuple[Scene, np.ndarray]:
    """The scene in another order, under names and residues that say nothing."""
    order = np.random.default_rng(seed).permutation(scene.n_atoms)
    back = np.argsort(order)
    return replace(
        scene,
        atom_names=tuple(f"{scene.elements[k]}{n}" for n, k in enumerate(order)),
        elements=tuple(scene.elements[k] for k in order),
        residue_of_atom=np.zeros(scene.n_atoms, dtype=np.int64),
        residue_names=("UNK",),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=np.sort(back[scene.bonds], axis=1),
        bond_orders=np.zeros(len(scene.bonds)),
        formal_charges=np.zeros(scene.n_atoms, dtype=np.int64),
        masses_da=scene.masses_da[order],
        positions_nm=scene.positions_nm[order],
    ), order


# ---- which atoms are which -----------------------------------------------------------------------------------------


def test_heavy_atoms_in_any_order_are_found_with_their_handedness(peptide: Scene) -> None:
    """Without hydrogens valine's methyls are told apart by geometry alone: a swap would be a wrong chi."""
    heavy = part_of(peptide, peptide.heavy_idx)
    for seed in range(3):
        other, order = shuffled(heavy, seed)
        match = match_scenes(other, peptide)
        assert np.array_equal(match.kept, peptide.heavy_idx)
        found = peptide.heavy_idx[order][match.order]
        equivalent = {peptide.atom_names[i] for i, k in zip(found, match.kept, strict=True) if i != k}
        assert equivalent <= {"CD1", "CD2", "CE1", "CE2"}, "only the two halves of phenyl are the same atom"


def test_the_mirror_image_of_the_heavy_atoms_is_another_molecule(peptide: Scene) -> None:
    heavy = part_of(peptide, peptide.heavy_idx)
    other, _ = shuffled(heavy.with_positions(heavy.positions_nm * [-1.0, 1.0, 1.0]), 0)
    with pytest.raises(OutOfDomainError, match="part of the other"):
        match_scenes(other, peptide)


@pytest.mark.parametrize("names", [("N", "CA", "C", "O"), ("N", "CA", "C"), ("CA",)])
def test_backbones_match_by_names(peptide: Scene, names: tuple[str, ...]) -> None:
    atoms = np.array([i for i, n in enumerate(peptide.atom_names) if n in names and peptide.elements[i] != "H"])
    match = match_scenes(part_of(peptide, atoms), peptide)
    assert np.array_equal(match.kept, atoms) and np.array_equal(match.order, np.arange(len(atoms)))


def test_another_peptide_is_not_a_part(peptide: Scene) -> None:
    other = build_peptide("ACE-VAL-TYR-PRO-NME")
    with pytest.raises(OutOfDomainError, match="part of the other"):
        match_scenes(part_of(other, other.heavy_idx), peptide)
    shorter = build_peptide("ACE-VAL-NME")
    with pytest.raises(OutOfDomainError):
        match_scenes(shorter, peptide)


def test_the_larger_file_is_cut_to_the_reference(peptide: Scene) -> None:
    heavy = part_of(peptide, peptide.heavy_idx)
    match = match_scenes(peptide, heavy)
    assert np.array_equal(match.kept, np.arange(heavy.n_atoms)) and np.array_equal(match.order, peptide.heavy_idx)


def test_water_and_ions_are_left_out(alanine_dipeptide: Scene) -> None:
    scene = _with_water(alanine_dipeptide, 3)
    assert np.array_equal(solute_atoms(scene), np.arange(22))
    assert match_scenes(scene, alanine_dipeptide).order.tolist() == list(range(22))
    water = part_of(scene, np.arange(22, 25))
    assert len(solute_atoms(water)) == 3, "water alone is the molecule"


def _with_water(scene: Scene, n_waters: int) -> Scene:
    rng = np.random.default_rng(1)
    shape = np.array([[0, 0, 0], [0.096, 0, 0], [-0.024, 0.093, 0]])
    places = rng.uniform(-1, 1, (n_waters, 1, 3)) + scene.positions_nm.mean(0)
    n, r = scene.n_atoms, len(scene.residue_names)
    first = n + 3 * np.arange(n_waters)
    return replace(
        scene,
        atom_names=(*scene.atom_names, *("O", "H1", "H2") * n_waters, "NA"),
        elements=(*scene.elements, *("O", "H", "H") * n_waters, "Na"),
        residue_of_atom=np.concatenate([scene.residue_of_atom, r + np.arange(3 * n_waters) // 3, [r + n_waters]]),
        residue_names=(*scene.residue_names, *("HOH",) * n_waters, "NA"),
        residue_ids=(*scene.residue_ids, *(str(100 + k) for k in range(n_waters + 1))),
        chain_of_residue=(*scene.chain_of_residue, *("W",) * (n_waters + 1)),
        bonds=np.concatenate([scene.bonds, *(np.stack([first, first + k], axis=1) for k in (1, 2))]),
        bond_orders=np.concatenate([scene.bond_orders, np.ones(2 * n_waters)]),
        formal_charges=np.concatenate([scene.formal_charges, np.zeros(3 * n_waters, dtype=np.int64), [1]]),
        masses_da=np.concatenate([scene.masses_da, np.tile([16.0, 1.0, 1.0], n_waters), [23.0]]),
        positions_nm=np.concatenate([scene.positions_nm, (places + shape).reshape(-1, 3), [[1.0, 1.0, 1.0]]]),
    )


# ---- periodic cells ------------------------------------------------------------------------------------------------


def test_molecules_are_made_whole_in_any_cell(simulate: Callable[..., Ensemble], alanine_dipeptide: Scene) -> None:
    frames = simulate(31, 40).segments[0][:] + np.linspace(0, 5, 40, dtype=np.float32)[:, None, None]
    cells = np.repeat(BOX[None], 40, axis=0)
    inverse = np.linalg.inv(BOX)
    wrapped = ((frames @ inverse) % 1.0 @ BOX).astype(np.float32)
    bonds = alanine_dipeptide.bonds
    assert (np.linalg.norm(wrapped[:, bonds[:, 0]] - wrapped[:, bonds[:, 1]], axis=-1) > 0.5).any(), "really broken"
    whole = make_whole(wrapped, cells, bond_tree(alanine_dipeptide))
    inner = [x[:, :, None] - x[:, None, :] for x in (whole, frames)]
    assert inner[0] == pytest.approx(inner[1], abs=2e-6)


def test_two_molecules_come_side_by_side(alanine_dipeptide: Scene) -> None:
    scene = _with_water(alanine_dipeptide, 1)
    apart = scene.positions_nm[None].copy()
    apart[:, 22:25] += 3 * BOX[1] - 2 * BOX[2]
    whole = make_whole(apart.astype(np.float32), BOX[None], bond_tree(scene))
    middle = whole[0, 22:25].mean(0) - whole[0, :22].mean(0)
    images = middle + np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]) @ BOX
    assert np.linalg.norm(middle) < np.linalg.norm(images, axis=1).min() + 1e-5


def test_a_periodic_file_is_read_whole(tmp_path: Path, simulate: Callable[..., Ensemble]) -> None:
    mdtraj = pytest.importorskip("mdtraj")
    made = simulate(32, 30)
    frames = made.segments[0][:]
    topology = made.scene.to_mdtraj_topology()
    wrapped = ((frames @ np.linalg.inv(BOX)) % 1.0 @ BOX).astype(np.float32)
    trajectory = mdtraj.Trajectory(wrapped, topology, time=np.arange(30.0))
    trajectory.unitcell_vectors = np.repeat(BOX[None], 30, axis=0)
    trajectory.save_trr(str(tmp_path / "p.trr"))
    read = load_ensemble([tmp_path / "p.trr"], template=made.scene)
    assert any("periodic; molecules are made whole" in note for note in read.notes)
    baseline = Baseline.of(made, probing=False)
    for name in ("phi", "psi", "bonds_nm"):
        one, other = (getattr(baseline.measure(e), name)[0] for e in (read, made))
        assert one == pytest.approx(other, abs=2e-4), name
    # MDTraj's own unwrapping puts the atoms in the same places.
    trajectory._unitcell_lengths = trajectory.unitcell_lengths.astype(np.float32)
    trajectory._unitcell_angles = trajectory.unitcell_angles.astype(np.float32)
    trajectory.make_molecules_whole(inplace=True)
    inner = [x[:, :1] - x for x in (trajectory.xyz, read.segments[0][:])]
    assert inner[0] == pytest.approx(inner[1], abs=1e-5)


# ---- files without times -------------------------------------------------------------------------------------------


def test_a_file_without_times_needs_the_lag(tmp_path: Path, simulate: Callable[..., Ensemble]) -> None:
    mdtraj = pytest.importorskip("mdtraj")
    made = simulate(33, 30)
    frames = mdtraj.Trajectory(made.segments[0][:], made.scene.to_mdtraj_topology(), time=2.0 * np.arange(30))
    for name in ("a.dcd", "a.pdb"):
        frames.save(str(tmp_path / name))
        with pytest.raises(InputError, match=r"no usable times; state the time between frames with `dt_ps"):
            load_ensemble([tmp_path / name], template=made.scene)
        assert load_ensemble([tmp_path / name], template=made.scene, lag_ps=2.0).lag_ps == 2.0


# ---- trajectories larger than memory -------------------------------------------------------------------------------


def test_frames_left_on_disk_measure_the_same(tmp_path: Path, simulate: Callable[..., Ensemble]) -> None:
    made = simulate(34, 3000)
    frames = made.segments[0][:]
    path = tmp_path / "a.h5"
    with open_writer(path, made.scene, {}) as writer:
        writer.append(frames, np.concatenate([np.arange(1000.0), 5000.0 + np.arange(2000)]))
    held, left = (load_ensemble([path], in_memory_bytes=n) for n in (10**9, 0))
    assert isinstance(left.segments[0], StoredFrames) and not isinstance(held.segments[0], StoredFrames)
    assert left.segment_lengths == held.segment_lengths == [1000, 2000]
    both = load_ensemble([path, path], in_memory_bytes=frames.nbytes + 10)
    kinds = [isinstance(x, StoredFrames) for x in both.segments]
    assert kinds == [False, False, True, True], "the limit is that of all files together"
    for one, other in zip(left.segments, held.segments, strict=True):
        assert np.array_equal(one[:], other)
        assert np.array_equal(one[7:900:13], other[7:900:13])
    thinned = [e.strided(3).segments[1] for e in (left, held)]
    assert isinstance(thinned[0], StoredFrames) and np.array_equal(thinned[0][:], thinned[1])
    atoms = np.array([1, 4, 8])
    small = [e.restricted(atoms, part_of(made.scene, atoms)).segments[1] for e in (left, held)]
    assert isinstance(small[0], StoredFrames) and np.array_equal(small[0][5:500], small[1][5:500])
    baseline = Baseline.of(left)
    features = [baseline.measure(e) for e in (left, held)]
    for name in ("phi", "psi", "bonds_nm", "flags"):
        for one, other in zip(*(getattr(f, name) for f in features), strict=True):
            assert np.array_equal(one, other)
    for family in features[0].series:
        for one, other in zip(*(f.series[family] for f in features), strict=True):
            assert np.array_equal(one, other, equal_nan=one.dtype != bool), family


def test_stored_frames_take_slices_only(tmp_path: Path, simulate: Callable[..., Ensemble]) -> None:
    made = simulate(35, 20)
    stored = load_ensemble([write(tmp_path / "a.h5", made.scene, made.segments[0][:])], in_memory_bytes=0).segments[0]
    for bad in (3, slice(None, None, -1), (slice(None), 2)):
        with pytest.raises(TypeError, match="slices"):
            stored[bad]  # type: ignore[index]


# ---- the whole way -------------------------------------------------------------------------------------------------


def test_a_heavy_atom_candidate_is_evaluated_on_what_it_has(tmp_path: Path, simulate: Callable[..., Ensemble]) -> None:
    reference, candidate, replicate = (simulate(seed, 1500) for seed in (1, 2, 3))
    scene = reference.scene
    heavy = scene.heavy_idx
    path = write(tmp_path / "heavy.h5", part_of(scene, heavy), candidate.segments[0][:, heavy])
    part = load_ensemble([path], template=scene)
    assert part.kept is not None and np.array_equal(part.kept, heavy)
    everyone, kept = alike([reference, part, replicate])
    assert kept is not None and {e.scene.n_atoms for e in everyone} == {10}
    quick = Options(n_bootstrap=50, n_permutations=50, peptide_recipe=False)
    comparison = compare(reference, [part], replicate, options=quick)
    assert comparison.n_atoms == 10 and any("10 atoms that all trajectories hold" in n for n in comparison.notes)
    found = comparison.evaluations[0]
    baseline = Baseline.of(reference, probing=False)
    assert baseline.torsions.phi_labels == backbone(scene, heavy).phi_labels
    counts = [distributions.block_counts_joint([x[:, 0] for x in f.phi], [x[:, 0] for x in f.psi],
              distributions.RAMACHANDRAN_BINS, Blocks.whole([1500])).sum(0)
              for f in (baseline.measure(e) for e in (reference, candidate))]  # fmt: skip
    expected = float(distributions.distance(*counts))
    assert found.row("joint_jsd").candidate.value == pytest.approx(expected, abs=1e-6)
    wrong = part.segments[0][:] * np.array([-1.0, 1.0, 1.0], dtype=np.float32)
    mirrored = compare(reference, [replace(part, segments=[wrong])], replicate, options=quick).evaluations[0]
    assert mirrored.status in ("broken", "different"), "a mirror image is found without hydrogens, too"


def test_what_a_file_does_not_state_is_asked_for_and_said(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    """LAMMPS text states neither times nor a unit of length: no comparison without a lag, and none without a line."""
    mdtraj = pytest.importorskip("mdtraj")
    frames = np.repeat(alanine_dipeptide.positions_nm[None], 12, axis=0)
    made = mdtraj.Trajectory(frames, alanine_dipeptide.to_mdtraj_topology(), time=0.5 * np.arange(12))
    made.unitcell_vectors = np.repeat(3.0 * np.eye(3)[None], 12, axis=0)
    made[0].save_pdb(str(tmp_path / "top.pdb"))
    top = tmp_path / "top.pdb"
    for suffix in ("lammpstrj", "xtc"):
        made.save(str(tmp_path / f"a.{suffix}"))
    with pytest.raises(InputError, match="state the time between frames"):
        load_ensemble([tmp_path / "a.lammpstrj"], template=alanine_dipeptide, top=top)
    said = load_ensemble([tmp_path / "a.lammpstrj"], template=alanine_dipeptide, top=top, lag_ps=0.5)
    assert any("states no unit of length; Å is taken" in note for note in said.notes)
    stated = load_ensemble([tmp_path / "a.xtc"], template=alanine_dipeptide, top=top)
    assert stated.lag_ps == 0.5 and not any("unit of length" in note for note in stated.notes)


def _xtc_and_topology(
    folder: Path, scene: Scene, order: np.ndarray, *, copies: int = 1
) -> tuple[Path, Path, np.ndarray]:
    """Write ten frames of copies of a scene, atoms in this order, and their PDB file; return both and the frames."""
    lines = [line for line in pdb_text(scene).splitlines() if line.startswith("ATOM")]
    top, path = folder / "x.pdb", folder / "x.xtc"
    x = scene.positions_nm + 0.002 * np.random.default_rng(0).normal(size=(10, scene.n_atoms, 3))
    shifted = np.concatenate([x[:, order] + 3.0 * k for k in range(copies)], axis=1)
    text = [f"{lines[i][:30]}{''.join(f'{10 * c:8.3f}' for c in scene.positions_nm[i] + 3.0 * k)}{lines[i][54:]}"
            for k in range(copies) for i in order]  # fmt: skip
    top.write_text("\n".join([*text, "END", ""]))
    with mdtraj.formats.XTCTrajectoryFile(str(path), "w") as file:
        file.write(shifted.astype(np.float32), time=np.arange(1.0, 11.0, dtype=np.float32))
    return path, top, x


def test_a_topology_with_its_atoms_shuffled_is_matched_by_its_bonds(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    order = np.random.default_rng(0).permutation(22)
    path, top, x = _xtc_and_topology(tmp_path, alanine_dipeptide, order)
    ensemble = load_ensemble([path], template=alanine_dipeptide, top=top)
    heavy = [i for i, e in enumerate(alanine_dipeptide.elements) if e != "H"]
    assert ensemble.segments[0][:, heavy] == pytest.approx(x[:, heavy], abs=2e-3)
    assert any("reordered" in note for note in ensemble.notes)
    whole = scene_from_structure(top, name="shuffled")
    assert len(whole.bonds) == 21 and not whole.bond_orders.any()
    other = prepare("smiles:CCCCCC(N)=O")
    with pytest.raises(OutOfDomainError):  # control: it is no wildcard
        load_ensemble([path], template=other, top=top)


def test_copies_under_one_number_are_no_pieces(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    _, top, _ = _xtc_and_topology(tmp_path, alanine_dipeptide, np.arange(22), copies=2)
    whole = scene_from_structure(top, name="two")
    assert whole.n_atoms == 44 and whole.bond_orders.any()
