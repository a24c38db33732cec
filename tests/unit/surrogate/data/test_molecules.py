"""Frames of several molecules for one training: split by system, laid in standard poses, mixtures refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.data import FrameSets, References, collect_frames, in_standard_pose
from systems.errors import InputError
from systems.prepare.molecule import scene_from_smiles
from systems.scene import Scene
from systems.trajectory.codec import open_writer

Write = Callable[..., Path]


@pytest.fixture(scope="module")
def write(tmp_path_factory: pytest.TempPathFactory) -> Write:
    """Write a trajectory of correlated Gaussian motion about a molecule's structure."""
    folder = tmp_path_factory.mktemp("references")

    def one(
        scene: Scene, name: str, *, n: int = 240, seed: int = 0, lag_ps: float = 1.0, kelvin: float = 300.0
    ) -> Path:
        rng, path = np.random.default_rng(seed), folder / f"{name}.h5"
        if path.exists():
            return path
        noise = rng.normal(size=(n, scene.n_atoms, 3))
        for t in range(1, n):
            noise[t] = 0.8 * noise[t - 1] + 0.6 * noise[t]
        record = {"temperature_k": kelvin, "force_field": name.split("-")[0], "solvent": "vacuum"}
        with open_writer(path, scene, record) as writer:
            writer.append(scene.positions_nm + 0.004 * noise, np.arange(1, n + 1) * lag_ps)
        return path

    return one


def smiles(text: str) -> Scene:
    return scene_from_smiles(text)


def test_a_held_out_system_that_is_trained_on_in_another_order_is_refused(write: Write) -> None:
    scene = smiles("CCO")
    order = np.r_[2, 1, 0, 3 : scene.n_atoms]
    other = replace(scene, elements=tuple(scene.elements[i] for i in order), positions_nm=scene.positions_nm[order],
                    masses_da=scene.masses_da[order], bonds=np.sort(np.argsort(order)[scene.bonds]))  # fmt: skip
    plain, turned = write(scene, "ethanol"), write(other, "ethanol-turned", seed=3)
    with pytest.raises(InputError, match="both trained on and held out"):
        References((plain,), (turned,)).sets()
    with pytest.raises(InputError, match="one molecule in two atom orders"):
        References((plain, turned)).sets()
    # The same order is a second trajectory of the molecule, held out for validation.
    again = write(scene, "ethanol-again", seed=4)
    sets = References((plain,), (again,)).sets()
    assert len(sets.trained) == 1 and sets.trained[0].split.held == (1,)
    with pytest.raises(InputError, match="held out for validation and trained on"):
        References((plain,), (plain,)).sets()
    windows = [path.with_name(f"windows-{path.name}") for path in (plain, again)]
    for path, one in zip(windows, (plain, again), strict=True):
        collect_frames([one]).save(path)
    with pytest.raises(InputError, match="comes in several files, windows among them"):
        References(tuple(windows)).sets()
    with pytest.raises(InputError, match="a windows file keeps its own split"):
        References((windows[0],), (again,)).sets()


def test_a_file_has_a_digest_that_does_not_hang_on_those_beside_it(write: Write) -> None:
    scene = smiles("CCO")
    first, second = (
        write(scene, "ethanol"),
        write(scene.with_positions(scene.positions_nm[:, [1, 2, 0]]), "ethanol-turned-over", seed=5),
    )
    alone, beside = collect_frames([second]).sources[0], collect_frames([first, second]).sources
    assert alone["sha256"] != beside[1]["sha256"] and alone["shape_sha256"] == beside[1]["shape_sha256"]
    assert beside[0]["shape_sha256"] != beside[1]["shape_sha256"]


def test_mixtures_that_no_model_can_learn_are_refused(write: Write) -> None:
    ethanol = write(smiles("CCO"), "ethanol")
    with pytest.raises(InputError, match="every 2 ps"):
        References((ethanol, write(smiles("CCC"), "propane-2ps", lag_ps=2.0))).sets()
    with pytest.raises(InputError, match="350"):
        References((ethanol, write(smiles("CCC"), "propane-hot", kelvin=350.0))).sets()


def test_the_standard_pose_follows_the_molecule(write: Write) -> None:
    for text in ("CCCO", "C[C@H](N)C(=O)O"):
        scene = smiles(text)
        q, r = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
        turn = q * np.sign(np.diag(r))
        turn *= np.sign(np.linalg.det(turn))
        base, moved = in_standard_pose(scene), in_standard_pose(scene.with_positions(scene.positions_nm @ turn.T - 1.0))
        np.testing.assert_allclose(moved.positions_nm, base.positions_nm, rtol=0, atol=1e-9)
        assert np.abs(base.positions_nm - scene.positions_nm).max() > 0.02
        mirrored = in_standard_pose(scene.with_positions(scene.positions_nm * [1, 1, -1]))
        assert np.abs(mirrored.positions_nm - base.positions_nm).max() > 0.02, "a mirror image is another shape"
    path = write(smiles("CCCO"), "propanol")
    posed, plain = References((path,)).sets().trained[0], collect_frames([path])
    idx = np.arange(5)
    assert np.abs(posed.positions_nm(idx).mean(0) - posed.scene.positions_nm).max() < 0.02
    apart = lambda x: np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)  # noqa: E731
    np.testing.assert_allclose(apart(posed.positions_nm(idx)), apart(plain.positions_nm(idx)), rtol=0, atol=1e-6)
    assert isinstance(FrameSets((posed,)).names, str)
