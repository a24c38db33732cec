"""Residues as entities: their layout, their empty places, and each loss of peptides against a value made by hand."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from surrogate.data.features.residue_layout import residue_layout
from surrogate.models.lam_slide.codes.autoencoder import reconstruction_losses
from surrogate.models.lam_slide.codes.residue_autoencoder import ResidueAutoencoder
from surrogate.models.lam_slide.codes.residue_code import (
    N_SLOTS,
    RESIDUE_TYPES,
    ResidueAtoms,
    ResidueLayout,
    frame_errors,
    local_coordinates,
    torsion_errors,
    torsion_vectors,
)
from surrogate.models.lam_slide.config import AutoencoderConfig
from surrogate.models.lam_slide.losses import random_rotations
from systems.chemistry.geometry import torsion
from systems.errors import InputError
from systems.files.schema import built
from systems.library.named_scenes import load
from systems.scene import Scene
from systems.selection import part_of


def heavy(name: str) -> Scene:
    scene = load(name)
    return part_of(scene, scene.heavy_idx)


def positions(name: str, n: int = 2, size: float = 0.1) -> tuple[Scene, torch.Tensor, torch.Tensor]:
    """A scene, and frames `(n, n_atoms, 3)` of it and of something near it, in units of 0.2 nm."""
    scene = heavy(name)
    generator = torch.Generator().manual_seed(0)
    base = torch.from_numpy(scene.positions_nm / 0.2)
    x, y = (base + size * torch.randn(n, *base.shape, generator=generator, dtype=torch.float64) for _ in range(2))
    return scene, x, y


def test_capped_residues_are_laid_out_by_their_names() -> None:
    scene = heavy("ACE-LYS-NME")
    layout = residue_layout(scene)
    named = lambda rows: [tuple(scene.atom_names[i] for i in row if i >= 0) for row in rows]  # noqa: E731
    assert [RESIDUE_TYPES[k] for k in layout.types] == ["ACE", "LYS", "NME"]
    assert named(layout.slots) == [
        ("CH3", "C", "O"), ("N", "CA", "C", "O", "CB", "CG", "CD", "CE", "NZ"), ("N", "C"),
    ]  # fmt: skip
    assert all(len(row) == N_SLOTS for row in layout.slots)
    assert sorted(i for row in layout.slots for i in row if i >= 0) == list(range(scene.n_atoms))
    assert named(layout.frames) == [("CH3", "C", "O"), ("N", "CA", "C"), ("C", "N", "C")]
    assert named(layout.torsions) == [
        ("CH3", "C", "N", "CA"), ("C", "N", "CA", "C"), ("N", "CA", "C", "N"), ("CA", "C", "N", "C"),
        ("N", "CA", "CB", "CG"), ("CA", "CB", "CG", "CD"), ("CB", "CG", "CD", "CE"), ("CG", "CD", "CE", "NZ"),
    ]  # fmt: skip
    # Peptide bonds are trans, and are found so.
    omega = [k for k, row in enumerate(named(layout.torsions)) if row[0] in ("CH3", "CA") and row[2] == "N"]
    assert (np.abs(torsion(scene.positions_nm, [layout.torsions[k] for k in omega])) > 2.6).all()
    assert built(ResidueLayout, json.loads(json.dumps(asdict(layout)))) == layout


def test_every_library_peptide_has_a_layout() -> None:
    from systems.library.named_scenes import names

    for name in [n for n in names() if n.startswith("ACE-")]:
        layout = residue_layout(heavy(name))
        assert len(layout.types) == 3
        assert len(layout.frames) == 3
    chignolin = residue_layout(heavy("chignolin"))
    assert len(chignolin.types) == len(chignolin.frames) == 10
    last = heavy("chignolin").atom_names[chignolin.slots[-1][-1]]
    assert last == "OXT", "the terminal oxygen has the last place"


def test_what_is_no_peptide_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match=r"MOL 1 of ethanol is none of the twenty"):
        residue_layout(heavy("ethanol"))
    scene = heavy("ACE-ALA-NME")
    other = tuple("CX" if name == "CB" else name for name in scene.atom_names)
    with pytest.raises(InputError, match="atom CX has no place"):
        residue_layout(replace(scene, atom_names=other))
    beta = scene.atom_names.index("CB")
    with pytest.raises(InputError, match="lacks CB"):
        residue_layout(part_of(scene, np.array([k for k in range(scene.n_atoms) if k != beta])))


def test_empty_places_never_count() -> None:
    scene, x, y = positions("ACE-TRP-NME")
    layout = residue_layout(scene)
    atoms = ResidueAtoms(layout)
    packed = atoms.to_residues(x)
    assert packed.shape == (2, 3, 3 * N_SLOTS)
    assert torch.equal(atoms.to_atoms(packed), x)
    empty = torch.tensor([[i < 0 for i in row for _ in range(3)] for row in layout.slots])
    assert int(empty.sum()) == 3 * (3 * N_SLOTS - scene.n_atoms)
    assert (packed[:, empty] == 0).all()
    # What a decoder puts there changes nothing and gets no gradient; a place that is taken does both.
    for places, matters in ((empty, False), (~empty, True)):
        decoded = atoms.to_residues(y).clone().requires_grad_()
        other = torch.where(places, decoded + 5.0, decoded)
        losses = [
            torch.stack([
                (atoms.to_atoms(given) - x).square().mean(),
                frame_errors(x, atoms.to_atoms(given), atoms.frames, 5.0).mean(),
                torsion_errors(x, atoms.to_atoms(given), atoms.torsions).mean(),
            ])
            for given in (decoded, other)
        ]  # fmt: skip
        assert (losses[0] != losses[1]).any().item() == matters
        losses[0].sum().backward()
        assert decoded.grad is not None
        assert (decoded.grad[:, places].abs().max() > 0).item() == matters


FRAME = torch.tensor([[0, 1, 2]])
# N, CA, C along y, at the origin and along x, and an atom above the plane.
SQUARE = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def test_frames_see_atoms_by_hand() -> None:
    torch.testing.assert_close(local_coordinates(SQUARE, FRAME)[0], SQUARE, atol=1e-9, rtol=0)
    turn = random_rotations(1, torch.Generator().manual_seed(0))[0].double()
    moved = SQUARE @ turn.T + torch.tensor([3.0, -1.0, 2.0])
    torch.testing.assert_close(local_coordinates(moved, FRAME)[0], SQUARE, atol=1e-6, rtol=0)
    # A longer bond leaves the axes as they are: N and C give directions.
    longer = SQUARE.clone()
    longer[2] = torch.tensor([2.5, 0.0, 0.0])
    torch.testing.assert_close(local_coordinates(longer, FRAME)[0, 3], SQUARE[3], atol=1e-9, rtol=0)


def test_frame_errors_by_hand() -> None:
    decoded = SQUARE.clone()
    decoded[3, 2] += 0.3
    errors = frame_errors(SQUARE, decoded, FRAME, 5.0)
    torch.testing.assert_close(errors, torch.tensor([[0.0, 0.0, 0.0, 0.3]], dtype=torch.float64), atol=2e-5, rtol=0)
    assert float(errors.mean()) == pytest.approx(0.075, abs=2e-5)
    # A mirror image has all distances right and this atom on the other side: 2 off, or what the clamp leaves of it.
    mirrored = SQUARE * torch.tensor([1.0, 1.0, -1.0])
    assert float(frame_errors(SQUARE, mirrored, FRAME, 5.0)[0, 3]) == pytest.approx(2.0, abs=1e-6)
    assert float(frame_errors(SQUARE, mirrored, FRAME, 1.5)[0, 3]) == pytest.approx(1.5, abs=1e-6)
    # N turned by a right angle about the bond CA-C: seen from the frame, what was up is then to the side.
    turned = SQUARE.clone()
    turned[0] = torch.tensor([0.0, 0.0, 1.0])
    assert float(frame_errors(SQUARE, turned, FRAME, 5.0)[0, 3]) == pytest.approx(math.sqrt(2.0), abs=1e-6)


def bent(degrees: float) -> torch.Tensor:
    """Four atoms with a torsion of so many degrees by hand: positive is clockwise, seen along the middle bond."""
    angle = math.radians(degrees)
    return torch.tensor([[1.0, 0, 0], [0, 0, 0], [0, 0, 1], [math.cos(angle), math.sin(angle), 1]], dtype=torch.float64)


def test_torsion_vectors_have_unit_norm_and_the_sign_of_systems_geometry() -> None:
    row = torch.tensor([[0, 1, 2, 3]])
    for degrees in (-150.0, -60.0, 10.0, 90.0):
        angle = math.radians(degrees)
        assert float(torsion(bent(degrees).numpy(), row.numpy())[0]) == pytest.approx(angle, abs=1e-9)
        expected = torch.tensor([[math.cos(angle), math.sin(angle)]], dtype=torch.float64)
        torch.testing.assert_close(torsion_vectors(bent(degrees), row), expected, atol=1e-6, rtol=0)
        assert float(torsion_vectors(0.2 * bent(degrees), row).norm()) == pytest.approx(1.0, abs=1e-5)


def test_torsion_errors_by_hand() -> None:
    row = torch.tensor([[0, 1, 2, 3]])
    error = lambda a, b: float(torsion_errors(bent(a), bent(b), row))  # noqa: E731
    assert error(60.0, -60.0) == pytest.approx(3.0, abs=1e-5)
    assert error(0.0, 90.0) == pytest.approx(2.0, abs=1e-5)
    assert error(10.0, -170.0) == pytest.approx(4.0, abs=1e-5)
    # Across the cut at 180 degrees: near, not far.
    assert error(179.0, -179.0) == pytest.approx(2.0 - 2.0 * math.cos(math.radians(2.0)), abs=1e-5)
    # In degrees or without the square, a degree would be 1 or 0.017.
    assert error(0.0, 1.0) == pytest.approx(math.radians(1.0) ** 2, rel=1e-3)


def test_position_and_distance_losses_by_hand() -> None:
    """Equations 13 and 14 of two atoms 3 apart, of which one is decoded 4 to the side: 16 / 2, and (5 - 3)^2 twice of
    four pairs."""
    x = torch.tensor([[[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]])
    decoded = torch.tensor([[[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]]])
    position, distance = reconstruction_losses(x, decoded)
    assert float(position) == pytest.approx(8.0, abs=1e-5)
    assert float(distance) == pytest.approx(2.0, abs=1e-4)


def test_the_autoencoder_clamps_at_a_nanometre() -> None:
    """One atom of four off by 0.06 nm, 0.3 in units of 0.2 nm, in one frame; and off by a metre, 5 of them."""
    layout = ResidueLayout(4, (0,), ((0, 1, 2, 3, *[-1] * 10),), ((0, 1, 2),), ())
    autoencoder = ResidueAutoencoder(AutoencoderConfig(width=32, head_dim=8), layout, 0.2)
    for shift, loss in ((0.3, 0.075), (5e9, 1.25)):
        decoded = SQUARE.clone()
        decoded[3, 2] += shift
        assert float(autoencoder.frame_loss(SQUARE[None], decoded[None])) == pytest.approx(loss, abs=2e-5)
    assert float(autoencoder.torsion_loss(SQUARE[None], decoded[None])) == 0.0, "no torsion, no loss"
    bent_layout = ResidueLayout(4, (0,), ((0, 1, 2, 3, *[-1] * 10),), (), ((0, 1, 2, 3),))
    turning = ResidueAutoencoder(AutoencoderConfig(width=32, head_dim=8), bent_layout, 0.2)
    assert float(turning.frame_loss(SQUARE[None], decoded[None])) == 0.0
    assert float(turning.torsion_loss(bent(0.0)[None], bent(90.0)[None])) == pytest.approx(2.0, abs=1e-5)


def test_frame_and_torsion_losses_do_not_see_the_pose() -> None:
    scene, x, y = positions("ACE-LYS-NME")
    atoms = ResidueAtoms(residue_layout(scene))
    turns = random_rotations(4, torch.Generator().manual_seed(0)).double()
    shift = torch.tensor([1.0, -2.0, 0.5])
    moved = [torch.einsum("bij,bnj->bni", turns[k : k + 2], given) + shift for k, given in ((0, x), (2, y))]
    for errors, rows in ((lambda a, b: frame_errors(a, b, atoms.frames, 5.0), "frames"),
                         (lambda a, b: torsion_errors(a, b, atoms.torsions), "torsions")):  # fmt: skip
        assert len(getattr(atoms, rows)) > 2
        torch.testing.assert_close(errors(*moved), errors(x, y), atol=2e-5, rtol=0)
        assert float(errors(x, y).mean()) > 0.01
        assert float(errors(x, x).mean()) < 2e-5
    # Negative controls: positions do see it, and a mirror image is another molecule.
    assert float((moved[0] - moved[1]).square().mean()) > 10 * float((x - y).square().mean())
    mirror = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    assert float(frame_errors(x, x * mirror, atoms.frames, 5.0).mean()) > 0.3
    assert float(torsion_errors(x, x * mirror, atoms.torsions).mean()) > 0.3
