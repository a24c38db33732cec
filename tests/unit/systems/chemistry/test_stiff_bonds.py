"""Bonds whose vibration sets the longest time step."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from md_reference.run.config import resolve_settings
from surrogate.models.architecture import shipped_weights
from surrogate.models.weights import load_weights
from surrogate.sampling.domain import in_step
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.chemistry.graph import has_stiff_bond
from systems.errors import InputError
from systems.library.named_scenes import prepare

QUANTUM = {"force_field": "gfn2-xtb"}


STIFF = [
    "CC#N",
    "CC#CC",
    "CCN=C=O",
    "O=C=O",
    "CC=O",
    "C=NC",
    "CC=C",
    "CC=CC",
    "C1=CCCCC1",
    "c1ccoc1",
    "c1cscn1",
    "O=C1CCN1",
    "CN1C(=O)c2ccccc2C1=O",
]
SOFT = [
    "CC(C)=O",
    "CN=O",
    "Cc1cnc[nH]1",
    "CC=C(C)C",
    "c1ccccc1",
    "c1cc[nH]c1",
    "c1ccsc1",
    "O=C1CCCN1",
    "O=C1CC(=O)NC(=O)N1",
    "c1cnccn1",
    "OC=1C=CC=CC=1",
]


@pytest.mark.parametrize("smiles", [*STIFF, *SOFT])
def test_stiff_bonds_are_found_with_and_without_orders(smiles: str) -> None:
    scene, has = prepare(f"smiles:{smiles}"), smiles in STIFF
    assert has_stiff_bond(scene) is has
    if smiles != "O=C=O":  # RDKit builds it too long
        assert has_stiff_bond(replace(scene, bond_orders=np.zeros(len(scene.bonds)))) is has


def test_quantum_md_of_a_stiff_bond_takes_half_the_step() -> None:
    nitrile, ketone = prepare("smiles:CC#N"), prepare("smiles:CC(C)=O")
    assert resolve_settings(nitrile, QUANTUM)[0]["timestep_ps"] == 0.002
    assert resolve_settings(ketone, QUANTUM)[0]["timestep_ps"] == 0.004
    with pytest.raises(
        InputError, match=r"4 fs is too long for a bond this stiff \(.*\); use `timestep_ps='2fs'` or less"
    ):
        resolve_settings(nitrile, QUANTUM | {"timestep_ps": 0.004})
    assert resolve_settings(nitrile, QUANTUM | {"hydrogen_mass_da": None})[0]["timestep_ps"] == 0.0005


def test_a_potential_takes_the_step_of_the_molecule(tmp_path: Path) -> None:
    weights = load_weights(shipped_weights()["paracetamol-gfn2-xtb"])
    shorter = in_step(weights, prepare("smiles:CC#N"))
    assert shorter.model.config.timestep_ps == shorter.domain.conditions["timestep_ps"] == 0.002
    assert in_step(weights, prepare("smiles:CC(C)=O")) is weights
    peptides = load_weights(shipped_weights()["peptides"])
    assert in_step(peptides, prepare("smiles:CC#N")) is peptides
    asked = RolloutConfig(time_ps=1.0, timestep_ps=0.004)
    with pytest.raises(
        InputError, match=r"4 fs is too long for a bond this stiff \(.*\); use `timestep_ps='2fs'` or less"
    ):
        rollout(prepare("smiles:CC#N"), weights, [tmp_path / "a.h5"], asked)
