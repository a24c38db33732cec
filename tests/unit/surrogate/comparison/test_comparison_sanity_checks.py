"""Files that were mixed up: each case must be named, and a fair trajectory must not be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.comparison.comparison import Evaluation, compare
from surrogate.comparison.measure.statistics import Estimate
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble, time_axis
from surrogate.comparison.report.report import interval, number
from surrogate.comparison.rows.rows import Options
from systems.errors import InputError
from systems.scene import Scene

OPTIONS = Options(peptide_recipe=False)


def like(run: Ensemble, frames: np.ndarray, label: str) -> Ensemble:
    return replace(run, segments=[np.ascontiguousarray(frames)], label=label)


def with_other_hydrogens(scene: Scene) -> list[int]:
    """Return an order of atoms in which the hydrogens of each methyl group are turned on by one."""
    groups: dict[int, list[int]] = {}
    for pair in scene.bonds.tolist():
        for carbon, other in (pair, pair[::-1]):
            if (scene.elements[carbon], scene.elements[other]) == ("C", "H"):
                groups.setdefault(carbon, []).append(other)
    order = list(range(scene.n_atoms))
    for hydrogens in (g for g in groups.values() if len(g) == 3):
        for old, new in zip(hydrogens, hydrogens[1:] + hydrogens[:1], strict=True):
            order[old] = new
    return order


@pytest.fixture(scope="module")
def evaluated(shared_data: Path) -> dict[str, tuple[Evaluation, tuple[str, ...]]]:
    """Each candidate under its label; the notes are those of all."""
    folder = shared_data / "alanine-dipeptide"
    a, b, c, d = (
        load_ensemble([folder / f"trajectory-{k}.dcd"], top=folder / "ala2.pdb", lag_ps=1.0) for k in (1, 2, 3, 4)
    )
    x, y = np.array(b.segments[0]), np.array(d.segments[0])
    candidates = [
        replace(b, label="fair"),
        replace(a, label="itself"),
        like(b, np.tile(x[:1000], (10, 1, 1)), "tiled"),
        like(b, np.repeat(x[:1], len(x), axis=0), "constant"),
        like(b, np.concatenate([x[:4000], y[4000:]]), "joined"),
        like(b, np.concatenate([x[:7000], np.array(a.segments[0])[7000:]]), "shared"),
        like(a, np.array(a.segments[0])[:, with_other_hydrogens(a.scene)], "relabelled"),
    ]
    found = compare(a, candidates, c, options=OPTIONS)
    return {j.summary.label: (j, (*j.notes, *found.notes)) for j in found.evaluations}


def test_a_fair_trajectory_is_suspected_of_nothing(evaluated: dict[str, tuple[Evaluation, tuple[str, ...]]]) -> None:
    fair, notes = evaluated["fair"]
    assert fair.status in ("indistinguishable", "undecided"), fair.verdict
    assert dict(fair.skipped)["Frames that are copies of others"] == "fewer than one frame in a hundred is one"
    assert not any(note.startswith("fair") and ("jumps" in note or "frames of the" in note) for note in notes)


def test_the_reference_as_its_own_candidate_is_not_evaluated(
    evaluated: dict[str, tuple[Evaluation, tuple[str, ...]]],
) -> None:
    for label in ("itself", "relabelled"):
        found, _ = evaluated[label]
        assert found.status == "undecided" and not found.equivalent_time_words
        assert "100 % of its frames are frames of the reference" in found.verdict, label
        assert "0 times a replicate" not in found.verdict


def test_copies_are_counted(evaluated: dict[str, tuple[Evaluation, tuple[str, ...]]]) -> None:
    tiled, _ = evaluated["tiled"]
    assert tiled.row("copies").verdict == "differs" and tiled.status == "different"
    assert tiled.row("copies").candidate.value == pytest.approx(90.0)
    assert "90 % of frames are copies" in tiled.verdict
    constant, _ = evaluated["constant"]
    assert constant.status == "broken" and constant.verdict.startswith("Broken: every frame is the same")
    assert "nan" not in constant.verdict and not any("nan" in f for f in constant.findings), constant.findings
    _, notes = evaluated["shared"]
    assert any(n.startswith("shared: 30 % of its frames are frames of the reference") for n in notes), notes


def test_a_joint_between_files_is_found(evaluated: dict[str, tuple[Evaluation, tuple[str, ...]]]) -> None:
    _, notes = evaluated["joined"]
    assert any(n.startswith("joined: the molecule jumps once") and "first at 4 ns" in n for n in notes), notes


def test_a_topology_that_does_not_fit_is_refused(simulate: Callable[..., Ensemble]) -> None:
    three = [simulate(k, 200) for k in (51, 52, 53)]
    order = np.random.default_rng(0).permutation(three[0].scene.n_atoms)
    mixed = [replace(e, segments=[e.segments[0][:, order]]) for e in three]
    with pytest.raises(InputError, match=r"bonds are too long to be bonds, e.g. .*The topology does not fit"):
        compare(mixed[0], [mixed[1]], mixed[2], options=OPTIONS)
    with pytest.raises(InputError, match="does not fit"):
        compare(three[0], [three[1]], mixed[2], options=OPTIONS)
    found = compare(three[0], [mixed[1]], three[2], options=OPTIONS)
    assert found.evaluations[0].status == "broken"
    assert any("does its topology fit its coordinates" in n for n in found.notes)
    assert not any("topology fit" in n for n in compare(three[0], [three[1]], three[2], options=OPTIONS).notes)


def test_a_check_that_could_not_be_made_is_not_zero(
    simulate: Callable[..., Ensemble], alanine_dipeptide: Scene
) -> None:
    """Without the atoms beside it a stereocentre cannot be told: no count, and the reason says why."""
    from systems.scene import part_of

    three = [simulate(k, 200) for k in (51, 52, 53)]
    backbone = np.array([i for i, n in enumerate(alanine_dipeptide.atom_names) if n in ("N", "CA", "C", "O", "CH3")])
    bare = three[1].restricted(backbone, part_of(alanine_dipeptide, backbone))
    whole = compare(three[0], [three[1]], three[2], options=OPTIONS).evaluations[0]
    part = compare(three[0], [bare], three[2], options=OPTIONS).evaluations[0]
    assert whole.faults[1].counts["stereocentre inverted"] == 0
    assert "stereocentre inverted" not in part.faults[1].counts
    assert "none among" in dict(part.skipped)["Stereocentres"]


def test_a_mirror_image_without_its_hydrogens_is_seen(
    simulate: Callable[..., Ensemble], alanine_dipeptide: Scene
) -> None:
    """Three neighbours of a centre tell its handedness; negative control: the fair run has none inverted."""
    from systems.scene import part_of

    three = [simulate(k, 200) for k in (51, 52, 53)]
    heavy = alanine_dipeptide.heavy_idx
    bare = three[1].restricted(heavy, part_of(alanine_dipeptide, heavy))
    mirrored = replace(bare, segments=[bare.segments[0] * np.array([-1, 1, 1], dtype=np.float32)], label="mirror")
    fair, wrong = compare(three[0], [bare, mirrored], three[2], options=OPTIONS).evaluations
    assert fair.faults[1].counts["stereocentre inverted"] == 0
    assert wrong.faults[1].counts["stereocentre inverted"] == 200 and wrong.status == "broken"


def test_a_replicate_that_differs_is_not_the_candidates_fault(simulate: Callable[..., Ensemble]) -> None:
    a, b, c = (simulate(k, 6_000) for k in (61, 62, 63))
    warm = c.segments[0] + np.random.default_rng(5).normal(0, 0.0015, c.segments[0].shape)
    hot = like(c, warm.astype(np.float32), "hot replicate")
    found = compare(a, [b, hot], hot, options=OPTIONS).evaluations
    assert found[0].status in ("indistinguishable", "undecided"), found[0].verdict
    assert any(n.startswith("The replicate itself differs") for n in found[0].notes)
    assert found[1].row("bond_width").verdict == "differs", "negative control"


def test_frames_that_are_not_finite_are_no_copies_of_each_other(simulate: Callable[..., Ensemble]) -> None:
    three = [simulate(k, 400) for k in (61, 62, 63)]
    for run in three[:2]:
        run.segments[0][-40:] = np.nan
    found = compare(three[0], [three[1]], three[2], options=OPTIONS).evaluations[0]
    assert not any("frames of the reference" in n for n in found.notes), found.notes


def test_times_that_no_program_meant_are_not_believed() -> None:
    for step in (4.9e-5, 0.04888821):
        with pytest.raises(InputError, match=r"told nothing .*`dt_ps='1ps"):
            time_axis("x.dcd", np.arange(20) * step, 20, None)
    assert time_axis("x.dcd", np.arange(20) * 5e-4, 20, None)[0] == pytest.approx(5e-4)
    assert time_axis("x.dcd", np.arange(20) * 4.9e-5, 20, 1.0)[0] == 1.0


def test_numbers_keep_the_digits_that_say_something() -> None:
    tiny = Estimate(3.2e-6, 2.9e-6, 3.5e-6, 1.5e-7)
    assert (number(tiny), interval(tiny)) == ("3.2e-06", "[2.9e-06, 3.5e-06]")
    alike = Estimate(9.9, 9.51234, 10.31234, 0.2)
    assert interval(alike) == "[9.51, 10.31]"
    assert number(Estimate(0.0, 0.0, 0.0, 0.01)) == "0.000"


NUMBERED = [((0, 1, 2), ("1", "2", "3")), ((0, 5, 6), ("0", "5", "6")), ((7, 8, 9), ("7", "8", "9"))]


@pytest.mark.parametrize(("numbers", "expected"), NUMBERED)
def test_residues_that_were_never_numbered_count_from_one(numbers: tuple[int, ...], expected: tuple[str, ...]) -> None:
    import mdtraj

    from systems.trajectory.foreign_scenes import scene_from_mdtraj_topology

    topology = mdtraj.Topology()
    chain = topology.add_chain()
    for n in numbers:
        topology.add_atom("O", mdtraj.element.oxygen, topology.add_residue("SER", chain, resSeq=n))
    assert scene_from_mdtraj_topology(topology, np.zeros((3, 3))).residue_ids == expected
