"""States of torsions of MD under an umbrella potential: which molecules, how frames count, and what weights learn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import peptide_campaign
import peptide_states
import pytest
import torch
from peptide_campaign import light_umbrella
from peptide_energies import trained_with
from peptide_equilibrium import Equilibrium
from peptide_list import held_out_peptides, training_peptides, unseen_peptides, wide_peptides
from peptide_states import (
    DRAWS,
    Md,
    correlations,
    drawn,
    errors,
    gather,
    parted,
    positive_phi_errors,
    read,
    shares,
    teach,
    together,
)

from md_reference.forces.umbrella import Umbrella
from surrogate.models.architecture import weights_path
from surrogate.models.peptides.layout import chain_features
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.weights import load_weights
from systems.errors import InputError
from systems.prepare.peptide import build_peptide


def test_an_umbrella_is_of_molecules_that_no_run_of_the_first_ones_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peptide_states, "read", lambda: [Md("TRP-HIE", np.zeros((2, DRAWS, 7), np.uint8))])
    order = [p for kind, p, number in peptide_campaign.umbrella_order("obc2") if (kind, number) == ("umbrella", 0)]
    names = {p.name for p in order}
    assert "PRO-CYS" in names and "TRP-HIE" not in names and len(names) == len(wide_peptides()) - 184 - 1
    assert not names & {p.name for p in wide_peptides()[:184]}
    assert not {p.residues for p in order} & {p.residues for p in (*unseen_peptides(), *held_out_peptides())}
    pairs = [len(p.residues) == 2 for p in order]
    assert pairs == sorted(pairs) and sum(pairs) > 150 and {p.time_ps for p in order} == {800.0}
    learned, left_out = ({md.name for md in part} for part in parted([Md(n, np.zeros(1)) for n in names]))
    assert len(order) / 10 < len(left_out) < len(order) / 7 and learned | left_out == names and not learned & left_out
    assert not {tuple(name.removeprefix("free-").split("-")) for name in left_out} & {
        p.residues for p in training_peptides()
    }


@pytest.mark.parametrize(("n_torsions", "left_kt"), [(2, 1.5), (9, 3.0)])
def test_of_many_torsions_more_of_the_free_energy_is_left(n_torsions: int, left_kt: float) -> None:
    """So that a fifth of the frames counts, whatever comes together; of few as much is left as is asked for."""
    rng, kt = np.random.default_rng(0), 8.314462618e-3 * 300.0
    grid = np.linspace(-np.pi, np.pi, 20_001)
    likely = np.exp(2.5 * np.cos(2 * grid) + np.cos(grid))
    angles = rng.choice(grid, (40_000, n_torsions), p=likely / likely.sum())
    quads = np.arange(4 * n_torsions).reshape(-1, 4)

    def counting(umbrella: Umbrella) -> float:
        """The share that counts of frames drawn as MD under the potential draws them."""
        u = umbrella.energies_of(angles) / kt
        factors = np.exp(rng.choice(u, 100_000, p=np.exp(-u) / np.exp(-u).sum()))
        return float(factors.sum() ** 2 / len(factors) / (factors**2).sum())

    found, asked = (
        light_umbrella(quads, angles, [1.5] * n_torsions),
        Umbrella.of(quads, angles, [1.5] * n_torsions, 300.0),
    )
    wanted = Umbrella.of(quads, angles, [left_kt] * n_torsions, 300.0)
    assert found == wanted and 0.18 < counting(found) < 0.6
    assert (found == asked) == (counting(asked) > 0.2)


def test_states_are_drawn_as_often_as_they_count_and_tests_are_refused(tmp_path: Path) -> None:
    states = np.array([[2, 0], [0, 1], [1, 1], [0, 1]], dtype=np.uint8)
    found = drawn(states, np.array([3.0, 1.0, 0.0, 4.0]))
    rows, counts = np.unique(found, axis=0, return_counts=True)
    assert rows.tolist() == [[0, 1], [2, 0]] and counts.tolist() == [DRAWS * 5 // 8, DRAWS * 3 // 8]
    np.savez(record := tmp_path / "record.npz", **{"GLN-ILE": np.zeros((2, DRAWS, 7), np.uint8)})
    with pytest.raises(InputError, match=r"tested on GLN-ILE; leave them out"):
        read(record)
    assert read(tmp_path / "none.npz") == []
    kinds = [Md(name, states).kind for name in ("ALA-GLY", "free-ALA-GLY", "ALA-GLY-SER", "free-ALA-GLY-SER-LEU")]
    assert kinds == ["capped pairs", "free pairs", "capped chains", "free chains"]


def test_halves_of_runs_are_kept_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All runs have the same frames; helices count in the second of three, strands in the others."""
    scene, model = build_peptide("ACE-CYS-NME"), cast(PeptideSlide, load_weights(weights_path("peptides")).model)
    chain, frames = chain_features(scene, model.config), Equilibrium.of(model, "ACE-CYS-NME")
    x = chain.code.decode(model._tokens(frames.observed, frames.states, chain)).numpy()
    helix = chain.states(torch.from_numpy(x))[:, 1, 1].numpy() == 1
    both = np.concatenate([np.flatnonzero(helix)[:40], np.flatnonzero(~helix)[:40]])
    energies = np.repeat([-20.0, 20.0], 40)
    md = SimpleNamespace(scene=scene, segments=[x[both]] * 3, differences_kj_mol=[energies, -energies, energies])
    monkeypatch.setattr(peptide_states, "load_ensemble", lambda _: md)
    (place := tmp_path / "umbrella" / "CYS").mkdir(parents=True)
    (place / "run_000.h5").touch()
    monkeypatch.setattr(peptide_states, "LEAST_COUNTED", 119.0)
    gather(tmp_path, model, record := tmp_path / "record.npz")
    (found,) = read(record)
    helices = [float((half[:, 1, 1] == 1).float().mean()) for half in found.laid(chain).split(DRAWS)]
    assert sorted(helices) == pytest.approx([0.0, 1.0], abs=0.01)
    # Half of the 240 frames count. Where that is too few, the name stays.
    monkeypatch.setattr(peptide_states, "LEAST_COUNTED", 121.0)
    gather(tmp_path, model, other := tmp_path / "other.npz")
    assert [md.name for md in read(other)] == ["CYS"] and parted(read(other)) == ([], [])
    with pytest.raises(SystemExit, match="holds no MD under an umbrella potential"):
        gather(tmp_path / "nowhere", model, record)


def test_weights_learn_states_at_endless_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peptide_states, "_RATE", 1e-2)
    some = wide_peptides()[:2]
    monkeypatch.setattr(peptide_states, "wide_peptides", lambda: some)
    start = load_weights(weights_path("peptides"))
    with pytest.raises(InputError, match="0 molecules to learn and 0 left out"):
        teach(tmp_path / "nothing.safetensors", start, 1, [])
    monkeypatch.setattr(peptide_states, "parted", lambda some: (list(some), list(some)))
    start = replace(start, domain=replace(start.domain, sequences=("ACE-GLY-NME",)))
    begun = cast(PeptideSlide, start.model)
    frames = Equilibrium.of(begun, some[0].sequence, 1, 128)
    assert some[0].name == "ALA"
    chain, rng = frames.chain, np.random.default_rng(0)
    wanted = np.zeros((2, DRAWS, len(chain.stated.slot)), np.uint8)
    for k, slot in enumerate(chain.stated.slot.tolist()):
        if slot == 1:  # psi is in helices nine times of ten
            wanted[..., k] = rng.random((2, DRAWS)) < 0.9
        elif slot > 1:
            wanted[..., k] = rng.integers(0, 3, (2, DRAWS))
    md = Md("ALA", wanted)
    taught = load_weights(teach(tmp_path / "taught.safetensors", start, 60, [md]))
    assert taught.domain.sequences == ("ACE-GLY-NME", "ACE-ALA-NME") and taught.provenance["umbrella_states"] == 1
    model = cast(PeptideSlide, taught.model)
    before, after = (errors(m, [(md, frames)])["off"] for m in (begun, model))
    assert before > 20.0 and after < 8.0
    both = [m.state_dict() for m in (begun, model)]
    assert {k.split(".")[0] for k in both[0] if not torch.equal(both[0][k], both[1][k])} == {"jumps"}
    assert shares(md.laid(chain), chain)[0, 1] == pytest.approx(0.9, abs=0.02)


def test_psi_two_apart_that_turn_together_and_a_positive_phi_that_is_too_rare_are_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(peptide_states, "_SIGNED_FRAMES", 500)
    start = load_weights(weights_path("peptides"))
    model, rng = cast(PeptideSlide, start.model), np.random.default_rng(0)
    chain = chain_features(build_peptide("ACE-ALA-SER-LEU-NME"), model.config)
    places = zip(chain.stated.residue.tolist(), chain.stated.slot.tolist(), strict=True)
    at = {place: k for k, place in enumerate(places)}
    states = np.zeros((2, DRAWS, len(at)), np.uint8)
    states[..., at[1, 1]] = rng.random((2, DRAWS)) < 0.5
    # Of three psi the third is as the first, nine times of ten; frames with a phi > 0 do not count.
    states[..., at[3, 1]] = states[..., at[1, 1]] ^ (rng.random((2, DRAWS)) < 0.1)
    states[0, :, at[2, 0]] = 1
    states[0, :, at[3, 1]] = states[0, :, at[1, 1]]
    states[..., at[2, 1]] = rng.random((2, DRAWS)) < 0.5
    md = Md("ALA-SER-LEU", states)
    found = together(md.laid(chain), chain)
    assert found[2] == pytest.approx([0.8], abs=0.04) and found[1] == pytest.approx([0.0, 0.0], abs=0.06)
    of_two = correlations(model, [(md, Equilibrium.of(model, md.sequence, n_frames=100))])[2]
    assert of_two[1] == pytest.approx(found[2][0]) and abs(of_two[0]) < 0.3
    energies = {"SER": trained_with(start.provenance)["SER"]}
    usual = positive_phi_errors(model, energies)
    with torch.no_grad():
        model.jumps.of_change[0, 2 + model.config.types.index("SER"), 0, 0, 1] -= 2.0
    rarer = {time: mean - usual[time][0] for time, (mean, _) in positive_phi_errors(model, energies).items()}
    assert rarer == pytest.approx(dict.fromkeys(usual, 2.0), abs=0.6)
