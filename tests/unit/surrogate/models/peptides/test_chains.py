"""Peptides in internal coordinates: the code is exact, shared between sequences, and cannot make a wrong molecule."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch

from surrogate.models.peptides.chains import (
    FREE_ENDS,
    MOST_TORSIONS,
    RIGID,
    STIFF,
    TURNING,
    ChainCode,
    ChainLayout,
    ChainScale,
    internal_coordinates,
)
from surrogate.models.peptides.layout import (
    chain_layout,
    chain_scale,
    resolved,
    stated_torsions,
    unknown_coordinates,
)
from systems.chemistry.validity import INVALID, check_frames, geometry_from_frames
from systems.errors import InputError
from systems.prepare.molecule import scene_from_smiles
from systems.prepare.peptide import build_peptide
from systems.scene import Scene

SEQUENCES = ("ACE-PRO-TRP-NME", "ACE-LEU-SER-NME", "LYS-ASP")


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {name: build_peptide(name) for name in SEQUENCES}


def shaken(scene: Scene, n: int = 64, size_nm: float = 0.003) -> npt.NDArray[np.float32]:
    rng = np.random.default_rng(0)
    return (scene.positions_nm + size_nm * rng.normal(size=(n, scene.n_atoms, 3))).astype(np.float32)


@pytest.fixture(scope="module")
def scale(scenes: dict[str, Scene]) -> ChainScale:
    return chain_scale((chain_layout(s), shaken(s)) for s in scenes.values())


def code_of(scene: Scene, scale: ChainScale) -> ChainCode:
    return ChainCode(resolved(chain_layout(scene), scale), scale)


def distances(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    i, j = np.triu_indices(x.shape[1], 1)
    return np.linalg.norm(x[:, i] - x[:, j], axis=-1)


@pytest.mark.parametrize("name", SEQUENCES)
def test_frames_come_back_as_they_were_but_for_their_pose(
    name: str, scenes: dict[str, Scene], scale: ChainScale
) -> None:
    x = shaken(scenes[name])
    code = code_of(scenes[name], scale)
    tokens = code.encode(torch.from_numpy(x))
    back = code.decode(tokens).double().numpy()
    assert np.abs(distances(back) - distances(x.astype(np.float64))).max() < 5e-6
    # Distances do not tell a mirror image; tokens do.
    again = code.encode(torch.from_numpy(back))
    assert float((again - tokens).abs().max()) < 2e-3
    mirrored = code.encode(torch.from_numpy(x * np.array([1, 1, -1], dtype=np.float32)))
    assert float((mirrored - tokens).abs().max()) > 10


def test_numbers_are_of_order_one_and_empty_places_stay_empty(scenes: dict[str, Scene], scale: ChainScale) -> None:
    code = code_of(scenes["ACE-LEU-SER-NME"], scale)
    tokens = code.encode(torch.from_numpy(shaken(scenes["ACE-LEU-SER-NME"])))
    assert 0.3 < float(tokens[..., code.filled].square().mean()) < 3
    assert not tokens[..., ~code.filled].any()


def test_whatever_the_stiff_numbers_are_the_molecule_is_the_right_one(
    scenes: dict[str, Scene], scale: ChainScale
) -> None:
    """Drawn independently: bonds, handedness and planes hold; wild numbers are seen to be wrong (the control)."""
    scene = scenes["ACE-LEU-SER-NME"]
    x = shaken(scene)
    code = code_of(scene, scale)
    tokens = code.encode(torch.from_numpy(x))
    stiff = torch.zeros(code.n_residues * code.n_slots, dtype=torch.bool)
    stiff[code.stiff_at] = True
    drawn = torch.randn(tokens.flatten(1).shape, generator=torch.Generator().manual_seed(1))
    geometry = geometry_from_frames(scene, x.astype(np.float64))

    def invalid(size: float) -> float:
        mixed = torch.where(stiff, size * drawn, tokens.flatten(1)).unflatten(1, tokens.shape[1:])
        flags = check_frames(code.decode(mixed).double().numpy(), geometry)
        return float(((flags & INVALID) > 0).mean())

    assert invalid(1.0) < 0.05
    assert invalid(20.0) > 0.9


def test_residues_of_one_type_share_their_coordinates_wherever_they_stand() -> None:
    layouts = {n: chain_layout(build_peptide(n)) for n in ("ACE-LEU-SER-NME", "ACE-SER-LEU-NME")}

    def of(layout: ChainLayout, name: str) -> set[tuple[str, int]]:
        residue = layout.types.index(name)
        return {(k, t) for k, r, t in zip(layout.keys, layout.residue_of, layout.motions, strict=True) if r == residue}

    first, second = layouts.values()
    for name in ("LEU", "SER", "NME", "ACE"):
        assert of(first, name) == of(second, name)
    assert len(of(first, "LEU")) == 3 * 19  # each atom its three; N is the one before's, the next N its own


def test_free_ends_are_the_same_in_all_residues_and_their_numbers_no_others(scenes: dict[str, Scene]) -> None:
    """What a chain's ends are is learned from a few residues that bear them, for all; the rotor of the ammonium has
    states, but no phi. Lysine's side chain leaves its ammonium no place."""
    free, capped = build_peptide("ALA-LEU-GLY"), build_peptide("ACE-ALA-LEU-GLY-NME")
    scale = chain_scale((chain_layout(s), shaken(s)) for s in (free, capped))
    ends = {key: slot for key, slot in scale.slots.items() if key.split()[0] in FREE_ENDS}
    others = {slot for key, slot in scale.slots.items() if key not in ends}
    assert len(ends) > 10
    assert min(ends.values()) > max(others)
    assert len(set(ends.values())) == len(ends)
    # Other residues at both ends, and one end beside a cap.
    for sequence, borne in (("LEU-ALA", FREE_ENDS), ("ACE-GLY-LEU", FREE_ENDS[1:]), ("LYS-ALA", FREE_ENDS[1:])):
        layout = chain_layout(build_peptide(sequence))
        assert {key.split()[0] for key in layout.keys} & set(FREE_ENDS) == set(borne)
        assert not [key for key in unknown_coordinates(layout, scale) if key.split()[0] in FREE_ENDS]
    stated = stated_torsions(free, chain_layout(free))
    rotor = [q for q, r, k in zip(stated.quads.tolist(), stated.residue, stated.slot, strict=True)
             if (int(r), int(k)) == (0, MOST_TORSIONS - 1)]  # fmt: skip
    assert [free.atom_names[i] for i in rotor[0]] == ["H", "N", "CA", "C"]
    assert not [r for r, k in zip(stated.residue.tolist(), stated.slot.tolist(), strict=True) if (r, k) == (0, 0)]


def test_torsions_are_told_by_cosine_and_sine_and_rings_are_not(scenes: dict[str, Scene]) -> None:
    layout = chain_layout(scenes["ACE-PRO-TRP-NME"])
    turning = {key for key, motion in zip(layout.keys, layout.motions, strict=True) if motion == TURNING}
    assert "TRP dihedral C CA N C-1" in turning and "TRP dihedral N+1 C CA N" in turning
    assert "PRO dihedral CA N C-1 CA-1" in turning  # omega, cis or trans
    assert "PRO dihedral CG CD CB N" in turning  # the pucker, out of the plane of its neighbours
    assert not any(key.startswith(("PRO dihedral C CA", "PRO dihedral CB", "TRP dihedral CZ2")) for key in turning)


def test_rings_are_closed_by_a_bond_whatever_the_numbers_are(scenes: dict[str, Scene], scale: ChainScale) -> None:
    """Every bond is one of the numbers: drawn at random, none varies more than its own deviation says
    (0.012 nm where angles alone place the atom that closes a ring)."""
    scene = scenes["ACE-PRO-TRP-NME"]
    code = code_of(scene, scale)
    assert sum(code.layout.closing) == 3  # proline's and both of tryptophan's
    tokens = code.encode(torch.from_numpy(shaken(scene)))
    drawn = tokens + 0.5 * torch.randn(tokens.shape, generator=torch.Generator().manual_seed(1))
    x = code.decode(torch.where(code.filled, drawn, 0.0)).numpy()
    bonds = np.linalg.norm(np.diff(x[:, scene.bonds], axis=2)[:, :, 0], axis=-1)
    lengths = {key: dev for key, dev in scale.deviation.items() if key.split()[1] == "length"}
    assert bonds.std(0).max() < 2.0 * max(lengths.values()), "a closing bond that were no number would vary more"


def test_what_a_reference_holds_rigid_is_a_constant() -> None:
    scene = build_peptide("ACE-ALA-NME")
    x = shaken(scene)
    for i, j in scene.bonds:
        hydrogen, heavy = (i, j) if scene.elements[i] == "H" else (j, i)
        if scene.elements[hydrogen] == "H":
            bond = x[:, hydrogen] - x[:, heavy]
            x[:, hydrogen] = x[:, heavy] + 0.1 * bond / np.linalg.norm(bond, axis=-1, keepdims=True)
    scale = chain_scale([(chain_layout(scene), x)])
    layout = resolved(chain_layout(scene), scale)
    assert {RIGID, STIFF, TURNING} == set(layout.motions)
    rigid = [key for key, motion in zip(layout.keys, layout.motions, strict=True) if motion == RIGID]
    assert len(rigid) == 12 and all(" length H" in key or " H" in key.split("length")[1] for key in rigid)
    code = ChainCode(layout, scale)
    assert torch.isfinite(code.encode(torch.from_numpy(x))).all()


def test_what_no_data_tell_of_is_refused(scale: ChainScale) -> None:
    with pytest.raises(InputError, match=r"occur in no training molecule.*GLY"):
        resolved(chain_layout(build_peptide("ACE-GLY-NME")), scale)
    with pytest.raises(InputError, match="no single peptide chain"):
        chain_layout(scene_from_smiles("CCO"))


def test_hydrogens_are_named_by_where_they_stand() -> None:
    """Exchanged names of CH2, of an amide's NH2 and of a methyl's hydrogens change no number and no key but a methyl's
    torsion; with the names as they are, dihedrals of CH2 would turn by 120 degrees."""
    scene = build_peptide("ACE-ASN-ALA-NME")
    at = {(int(r), name): i for i, (r, name) in enumerate(zip(scene.residue_of_atom, scene.atom_names, strict=True))}
    names = list(scene.atom_names)
    for residue, one, other in ((1, "HB2", "HB3"), (1, "HD21", "HD22"), (2, "HB1", "HB2")):
        i, j = at[residue, one], at[residue, other]
        names[i], names[j] = names[j], names[i]
    found, swapped = chain_layout(scene), chain_layout(replace(scene, atom_names=tuple(names)))
    assert (found.keys, found.motions, found.residue_of) == (swapped.keys, swapped.motions, swapped.residue_of)
    x = torch.tensor(scene.positions_nm)[None].double()
    values = [internal_coordinates(x, one)[0] for one in (found, swapped)]
    apart = torch.abs(torch.atan2((values[0] - values[1]).sin(), (values[0] - values[1]).cos()))
    moved = [found.keys[k] for k in torch.nonzero(apart > 0.2)[:, 0].tolist()]
    assert moved == ["ALA dihedral HB1 CB CA N"]
    assert names != list(scene.atom_names)
