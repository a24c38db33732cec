"""Secondary structure: a helix that was built is one, an extended chain is none; real structures are read as MDTraj
reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from surrogate.comparison.comparison import compare
from surrogate.comparison.measure.structure import COIL, HELIX, STRAND, find_chains, secondary_structure
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.rows import Options
from systems.scene import Scene

ALPHA_DEG = {"phi": -60.0, "psi": -45.0}


def read(scene: Scene, frames_nm: npt.NDArray[Any]) -> npt.NDArray[np.int8]:
    return secondary_structure(np.asarray(frames_nm), scene, find_chains(scene))


def coiled(scene: Scene) -> npt.NDArray[np.float64]:
    """Return `scene` with every phi and psi turned to those of an alpha helix, `(n_atoms, 3)` nm."""
    from networkx import node_connected_component
    from scipy.spatial.transform import Rotation

    from systems.chemistry.geometry import torsion
    from systems.chemistry.graph import backbone_torsions, bonded_graph

    x, graph = np.array(scene.positions_nm, dtype=np.float64), bonded_graph(scene).copy()
    for name, quads in ((k, v) for k, v in backbone_torsions(scene).items() if k in ALPHA_DEG):
        for quad in quads:
            _, start, end, _ = (int(i) for i in quad)
            graph.remove_edge(start, end)
            beyond = sorted(node_connected_component(graph, end))
            graph.add_edge(start, end)
            turn = np.radians(ALPHA_DEG[name]) - float(torsion(x[None], quad[None])[0, 0])
            axis = (x[end] - x[start]) / np.linalg.norm(x[end] - x[start])
            x[beyond] = Rotation.from_rotvec(axis * turn).apply(x[beyond] - x[end]) + x[end]
    return x


@pytest.fixture(scope="module")
def peptide() -> Scene:
    from systems.library.named_scenes import prepare

    return prepare("sequence:ACE-" + "ALA-" * 8 + "NME")


def test_a_helix_is_one_and_an_extended_chain_is_none(peptide: Scene) -> None:
    frames = np.stack([coiled(peptide), peptide.positions_nm, np.full((peptide.n_atoms, 3), np.nan)])
    found = read(peptide, frames)
    assert found.shape == (3, 8)
    assert (found[0, 1:-1] == HELIX).sum() >= 5
    assert not found[1:].any(), "neither the extended chain nor what is not finite is anything but coil"


def test_a_candidate_that_unfolds_is_named_residue_by_residue(peptide: Scene) -> None:
    """Half of the candidate's frames extended: the row says so, and the charts say where, with error bars."""
    rng = np.random.default_rng(0)
    helix, extended = coiled(peptide), np.asarray(peptide.positions_nm, dtype=np.float64)

    def run(share: float) -> Ensemble:
        folded = rng.random(400) >= share
        frames = np.where(folded[:, None, None], helix, extended) + rng.normal(0, 0.003, (400, *helix.shape))
        return Ensemble("run", [frames.astype(np.float32)], 1.0, peptide, record={"temperature_k": 300.0})

    fair, wrong = compare(run(0.0), [run(0.0), run(0.5)], run(0.0), options=Options(peptide_recipe=False)).evaluations
    assert fair.row("secondary:helix").verdict == "agrees"
    assert wrong.row("secondary:helix").verdict == "differs"
    assert "residues in helix (DSSP)" in wrong.row("secondary:helix").statement
    charts = {c.title: c for c in wrong.charts if c.section == "structure"}
    assert "Residues in strand" not in charts and dict(wrong.skipped)["Residues in strand"]
    lines = {line.role: line for line in charts["Residues in helix"].lines}
    low, high = lines["candidate"].low, lines["candidate"].high
    assert low[4] < 50.0 < high[4] and lines["reference"].y[4] > 95.0, "the fifth alanine"


def test_four_residues_have_none() -> None:
    from systems.library.named_scenes import prepare

    scene = prepare("sequence:ACE-ALA-ALA-ALA-ALA-NME")
    assert read(scene, scene.positions_nm[None]).shape == (1, 0)


@pytest.mark.parametrize("name", ["modelling__cstein__1CRN.pdb", "modelling__ZuckermanLab__1l2y.pdb"])
def test_real_structures_are_read_as_mdtraj_reads_them(shared_data: Path, name: str) -> None:
    import mdtraj

    path = shared_data / "structures" / name
    loaded = mdtraj.load(str(path))
    letters = mdtraj.compute_dssp(loaded)[0]
    from systems.library.named_scenes import prepare

    scene = prepare(path)
    found = read(scene, scene.positions_nm[None])[0]
    want = np.array([{"H": HELIX, "E": STRAND}.get(x, COIL) for x in letters if x != "NA"])
    np.testing.assert_array_equal(found, want)
    assert (found == HELIX).sum() > 5
