"""Rollouts with OpenMM beside them: the coupling; and parts of a molecule written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scripted_model import (
    CONDITIONS,
    roll,
    weights_of,
)
from surrogate.models.weights import TrainingDomain
from surrogate.sampling.chunks import ChunkSampler, Guard
from surrogate.sampling.coupling import Coupling
from surrogate.sampling.runner import RolloutConfig
from systems.errors import InputError, UnknownNameError
from systems.scene import Scene


def test_md_depends_on_start_and_seed_alone(domain: TrainingDomain, md: np.ndarray) -> None:
    coupling = Coupling(weights_of(domain))
    first = coupling.simulate(md[0], 5, seed=1)
    coupling.simulate(md[9], 3, seed=5)
    again = coupling.simulate(md[0], 5, seed=1)
    assert np.array_equal(first.frames_nm, again.frames_nm)
    assert np.abs(coupling.simulate(md[0], 5, seed=2).frames_nm - first.frames_nm).max() > 0.01
    # Velocities belong to the last frame in its pose: a short step along them is what MD does next.
    longer = coupling.simulate(md[0], 5, seed=1)
    kinetic = 0.5 * (domain.scene.masses_da[:, None] * longer.velocities_nm_ps**2).sum()
    assert 20.0 < kinetic < 110.0, "kJ/mol; 51 degrees of freedom have 64 at 300 K, half of it right after relaxing"
    assert np.abs(domain.scene.masses_da @ longer.velocities_nm_ps).max() < 1e-6
    coupling.close()


def test_help_has_flexible_bonds_where_the_reference_had(domain: TrainingDomain, md: np.ndarray) -> None:
    flexible = {**CONDITIONS, "timestep_ps": 0.0005, "hydrogen_mass_da": None, "constrain_hydrogens": False}
    spread = []
    for conditions in (CONDITIONS, flexible):
        coupling = Coupling(weights_of(replace(domain, conditions=conditions)))
        frames = coupling.simulate(md[0], 8, seed=1).frames_nm
        coupling.close()
        to_hydrogen = [pair for pair in domain.scene.bonds.tolist() if "H" in (domain.scene.elements[k] for k in pair)]
        spread.append(max(float(np.linalg.norm(frames[:, i] - frames[:, j], axis=-1).std()) for i, j in to_hydrogen))
    assert spread[0] < 1e-5 < 1e-3 < spread[1]


def test_weights_that_name_no_force_field_cannot_be_coupled(
    tmp_path: Path, scene: Scene, domain: TrainingDomain
) -> None:
    wet = {**CONDITIONS, "solvent": "tip3p"}
    unknown = {**CONDITIONS, "force_field": "ff00"}
    for conditions, said in (({}, "their force_field"), (unknown, "ff00"), (wet, "a rollout has no water")):
        weights = weights_of(replace(domain, conditions=conditions))
        with pytest.raises(InputError, match=f"cannot be coupled to OpenMM.*{said}"):
            roll(tmp_path / "a.h5", scene, weights, "repair")
        assert list(tmp_path.iterdir()) == [], "refused before anything is written"


def test_some_atoms_are_written_and_all_are_computed(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    whole = roll(tmp_path / "all.h5", scene, weights_of(domain), "flag")
    heavy = roll(tmp_path / "heavy.h5", scene, weights_of(domain), "flag", atoms="heavy")
    assert np.array_equal(heavy.frames, whole.frames[:, scene.heavy_idx])
    assert heavy.scene is not None and "H" not in heavy.scene.elements and len(heavy.scene.bonds) == 9
    backbone = roll(
        tmp_path / "b.dcd", scene, weights_of(domain), "flag", select="resname ALA and (name CA or name HA)"
    )
    assert backbone.scene is not None and backbone.scene.atom_names == ("CA", "HA")
    np.testing.assert_allclose(backbone.frames, whole.frames[:, [8, 9]], rtol=0, atol=1e-6)
    assert backbone.record["selection"]["of_atoms"] == 22
    for wrong, said in (("name CA and (", "cannot be read"), ("name XX", "means no atom")):
        with pytest.raises(InputError, match=said):
            roll(tmp_path / "c.h5", scene, weights_of(domain), "flag", select=wrong)
    with pytest.raises(InputError, match="no atom"):
        roll(tmp_path / "c.h5", scene, weights_of(domain), "flag", select="element H", atoms="heavy")
    assert not (tmp_path / "c.h5").exists()


def test_far_from_the_origin_nothing_is_lost(tmp_path: Path, scene: Scene, domain: TrainingDomain) -> None:
    """A million nm away float32 resolves 0.06 nm: frames are written about the molecule, and the record says so."""
    near = roll(tmp_path / "near.h5", scene, weights_of(domain), "flag")
    far = roll(tmp_path / "far.h5", scene.with_positions(scene.positions_nm + 1e6), weights_of(domain), "flag")
    centre = scene.positions_nm.mean(axis=0)
    np.testing.assert_allclose(far.frames, near.frames - centre, rtol=0, atol=2e-6)
    np.testing.assert_allclose(far.record["moved_nm"], -(centre + 1e6))
    assert "moved_nm" not in near.record
    sampler = ChunkSampler(weights_of(domain), precision="fp32")
    drawn = [sampler.draw((x := scene.positions_nm + d)[None, None], [5]).frames_nm[0] - d for d in (0.0, 10.0, 1e6)]
    assert drawn[0].dtype == np.float64 and x.dtype == np.float64
    np.testing.assert_allclose(drawn[1], drawn[0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(drawn[2], drawn[0], rtol=0, atol=1e-6)


def test_settings_that_cannot_be_are_refused(domain: TrainingDomain) -> None:
    for wrong, error, said in (
        ({"guard": "repare"}, UnknownNameError, "Did you mean 'repair'"),
        ({"atoms": "none"}, InputError, "all or heavy"),
        ({"energy_every": -1}, InputError, "at least 0"),
        ({"solver_steps": 0}, InputError, "at least 1"),
        ({"temperature_k": 0.0}, InputError, "greater than 0"),
        ({"timestep_ps": float("nan")}, InputError, "greater than 0"),
    ):
        with pytest.raises(error, match=said):
            RolloutConfig(time_ps=1.0, **wrong)  # type: ignore[arg-type]
    assert Guard(domain).unchecked == ()
    assert Guard(replace(domain, limits=None)).unchecked == (
        "angles, flat centres, jumps, stillness and drift: the weights carry no limits",
    )


@pytest.mark.parametrize(
    ("name", "match"),
    [("energy_every", "`energy_every` is for learned potentials"), ("torsion_moves", "leave `torsion_moves` out")],
)
def test_energies_are_for_learned_potentials_alone(
    tmp_path: Path, scene: Scene, domain: TrainingDomain, name: str, match: str
) -> None:
    with pytest.raises(InputError, match=match):
        roll(tmp_path / "a.h5", scene, weights_of(domain), "flag", **{name: 3})
