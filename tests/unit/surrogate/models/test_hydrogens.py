"""Hydrogens placed about heavy atoms: places, lengths, angles, sides, turns, and what is refused."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch

from surrogate.data.features.hydrogen_shapes import fit_hydrogens, hydrogen_sites, plan_hydrogens
from surrogate.data.frames import TrainingFrames, quantise
from surrogate.data.parts import part_of_frames
from surrogate.models.hydrogens import N_PHASES, HydrogenPlacer, HydrogenPlan, SiteGroup
from systems.chemistry.geometry import signed_volumes, torsion
from systems.errors import InputError
from systems.files.schema import built
from systems.library.named_scenes import load
from systems.scene import Scene

Array = npt.NDArray[np.float64]


def frames_of(scene: Scene, positions: Array) -> TrainingFrames:
    n = len(positions)
    return TrainingFrames(scene, quantise(positions), np.array([0, n]), 1.0, True, {}, ())


def fitted(scene: Scene, positions: Array) -> HydrogenPlacer:
    frames = frames_of(scene, positions)
    placer = HydrogenPlacer(plan_hydrogens(frames))
    fit_hydrogens(placer, frames)
    return placer


def turned(scene: Scene, bond: tuple[int, int], atoms: list[int], angles: Array) -> Array:
    """Frames of a scene, some of its atoms turned about a bond by `angles` (n,), positive by the IUPAC convention."""
    x = scene.positions_nm
    axis = (x[bond[1]] - x[bond[0]]) / np.linalg.norm(x[bond[1]] - x[bond[0]])
    arms = x[atoms] - x[bond[1]]
    cos, sin = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    moved = arms * cos + np.cross(axis, arms) * sin + axis * (arms @ axis)[:, None] * (1.0 - cos)
    frames = np.repeat(x[None], len(angles), axis=0)
    frames[:, atoms] = x[bond[1]] + moved
    return frames


def shaken(scene: Scene, n: int, size_nm: float, seed: int = 0) -> Array:
    return scene.positions_nm + size_nm * np.random.default_rng(seed).normal(size=(n, scene.n_atoms, 3))


def rotation(seed: int = 1) -> Array:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def tensor(x: Array) -> torch.Tensor:
    return torch.from_numpy(x.astype(np.float32))


def place(placer: HydrogenPlacer, frame: Array, last: Array | None = None) -> Array:
    heavy = list(placer.plan.heavy)
    before = None if last is None else tensor(last)[None]
    return placer(tensor(frame)[None, None, heavy], before)[0, 0].double().numpy()


@pytest.mark.parametrize("name", ["ACE-SER-NME", "ACE-PRO-NME", "ACE-LYS-NME", "toluene", "ethanol"])
def test_hydrogens_return_to_where_they_were(name: str) -> None:
    """Of one structure, held still: methyl, ammonium, hydroxyl, NH, CH, CH2 and aromatic hydrogens, turned as well."""
    # As training frames have it, which are rounded.
    scene = load(name)
    scene = scene.with_positions(frames_of(scene, scene.positions_nm[None]).positions_nm(np.array([0]))[0])
    still = np.repeat(scene.positions_nm[None], 60, axis=0)
    placer = fitted(scene, still)
    placed = place(placer, scene.positions_nm, scene.positions_nm)
    # A rotor's angle is known to five degrees, 0.005 nm at a hydrogen.
    held = [h for site in placer.plan.sites if not site.turns for h in site.hydrogens]
    assert np.abs(placed[held] - scene.positions_nm[held]).max() < 2e-6
    assert np.abs(placed - scene.positions_nm).max() < 0.006
    lengths = [np.linalg.norm(x[h] - x[s.parent]) for s in placer.plan.sites for h in s.hydrogens
               for x in (placed, scene.positions_nm)]  # fmt: skip
    assert np.allclose(lengths[::2], lengths[1::2], rtol=0, atol=1e-6)
    turn, shift = rotation(), np.array([0.3, -0.2, 0.5])
    moved = place(placer, scene.positions_nm @ turn.T + shift, scene.positions_nm @ turn.T + shift)
    assert np.abs(moved - (placed @ turn.T + shift)).max() < 1e-6
    # Negative control: heavy atoms that stay, hydrogens of the turned structure.
    assert np.abs(moved - placed - shift).max() > 0.05


def test_angles_are_those_of_systems_geometry() -> None:
    scene = load("ACE-SER-NME")
    x = shaken(scene, 20, 0.01)
    for group in HydrogenPlacer(hydrogen_sites(scene)).double().groups:
        if not group.turns:
            continue
        opening, about = (angle.numpy() for angle in group.angles(torch.from_numpy(x)))
        for k, (parent, around) in enumerate(zip(group.parent.tolist(), group.around.tolist(), strict=True)):
            for h, hydrogen in enumerate(group.hydrogens[k].tolist()):
                expected = torsion(x, [[around[1], around[0], parent, hydrogen]])[:, 0]
                np.testing.assert_allclose(about[:, k, h], expected, atol=1e-9)
                a, b = x[:, around[0]] - x[:, parent], x[:, hydrogen] - x[:, parent]
                cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
                np.testing.assert_allclose(np.cos(opening[:, k, h]), cosine, atol=1e-9)


def test_handedness_follows_the_heavy_atoms() -> None:
    """The hydrogen of a CH lies mirrored in the mirror image; pro-R and pro-S hydrogens of a CH2 keep their sides."""
    scene = load("ACE-SER-NME")
    placer = fitted(scene, shaken(scene, 200, 0.002))
    named = {name: k for k, (name, r) in enumerate(zip(scene.atom_names, scene.residue_of_atom, strict=True)) if r == 1}
    alpha = [[named[a] for a in ("CA", "N", "C", "HA")]]
    beta = [[named[a] for a in ("CB", "CA", "OG", h)] for h in ("HB2", "HB3")]
    base, placed = scene.positions_nm, place(placer, scene.positions_nm)
    assert (signed_volumes(placed, alpha + beta) * signed_volumes(base, alpha + beta) > 0).all()
    assert signed_volumes(placed, beta).prod() < 0
    mirrored = place(placer, base * np.array([1.0, 1.0, -1.0]))
    assert signed_volumes(mirrored, alpha)[0] * signed_volumes(base, alpha)[0] < 0


def test_places_follow_bent_angles() -> None:
    """What is fitted is no rigid body: hydrogens of a group whose heavy atoms have moved go along, better than those of
    the mean structure would."""
    scene = load("ethanol")
    plan = hydrogen_sites(scene)
    rng = np.random.default_rng(0)
    heavy = list(plan.heavy)
    site = next(s for s in plan.sites if not s.turns)

    def sample(n: int) -> Array:
        x = np.repeat(scene.positions_nm[None], n, axis=0)
        x[:, heavy] += 0.01 * rng.normal(size=(n, len(heavy), 3))
        unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)  # noqa: E731
        a, b = (unit(x[:, k] - x[:, site.parent]) for k in site.around)
        for h, sign in zip(site.hydrogens, (1.0, -1.0), strict=True):
            x[:, h] = x[:, site.parent] + 0.109 * unit(-0.6 * (a + b) + sign * 0.9 * np.cross(a, b))
        return x

    placer = fitted(scene, sample(2000))
    fresh = sample(50)
    placed = placer(tensor(fresh)[None][:, :, heavy])[0].double().numpy()
    held = list(site.hydrogens)
    assert np.abs(placed[:, held] - fresh[:, held]).max() < 1e-3
    assert np.abs(placed[:, held] - fresh[:, held]).max() < 0.2 * np.abs(fresh[:, held] - fresh[:1, held]).max()


def rotor_chain(n: int, seed: int) -> Array:
    """Angles that hop between 60 and -60 degrees, twice as long at the first, and swing about each."""
    rng = np.random.default_rng(seed)
    state, angles = 0, np.empty(n)
    for t in range(n):
        if rng.random() < (0.02 if state == 0 else 0.04):
            state = 1 - state
        angles[t] = (1.0 if state == 0 else -1.0) * np.pi / 3 + 0.15 * rng.normal()
    return angles


def hydroxyl(scene: Scene, angles: Array) -> tuple[Array, list[list[int]]]:
    site = next(s for s in hydrogen_sites(scene).sites if scene.elements[s.parent] == "O")
    quad = [site.around[1], site.around[0], site.parent, site.hydrogens[0]]
    now = torsion(scene.positions_nm, [quad])[0]
    return turned(scene, (site.around[0], site.parent), list(site.hydrogens), angles - now), [quad]


def test_rotors_turn_as_the_reference_does() -> None:
    """Shares and hopping of a hydroxyl whose states live 50 and 25 frames."""
    scene = load("ethanol")
    angles = rotor_chain(40_000, 0)
    positions, quad = hydroxyl(scene, angles)
    np.testing.assert_allclose(torsion(positions[:50], quad)[:, 0], angles[:50], atol=1e-9)
    placer = fitted(scene, positions)
    b, length = 40, 500
    heavy = tensor(scene.positions_nm)[None, None, list(placer.plan.heavy)].expand(b, length, -1, -1)
    noise = torch.randn(b, length, placer.n_noise, generator=torch.Generator().manual_seed(0))
    last = tensor(positions[:: len(positions) // b][:b])
    placed = placer(heavy, last, noise).double().numpy()
    found = torsion(placed.reshape(-1, scene.n_atoms, 3), quad)[:, 0].reshape(b, length)
    assert abs((found > 0).mean() - 2 / 3) < 0.05
    assert abs(np.abs(found).mean() - np.pi / 3) < 0.02
    assert abs(np.abs(found).std() - 0.15) < 0.02
    hops = (np.diff(np.sign(found), axis=1) != 0).mean()
    assert abs(hops - 2 * 0.02 * 0.04 / 0.06) < 0.005
    # The first frame follows the one before: one in fifty, not one in three, is in the other state.
    first = torsion(last.double().numpy(), quad)[:, 0]
    assert (np.sign(found[:, 0]) == np.sign(first)).mean() > 0.85
    # Tables rounded as weights are when they are shipped say the same.
    rounded = deepcopy(placer)
    for group in rounded.groups:
        group.load_state_dict({k: v.half().float() for k, v in group.state_dict().items()})
    half = torsion(rounded(heavy, last, noise).double().numpy().reshape(-1, scene.n_atoms, 3), quad)[:, 0]
    half_hops = (np.diff(np.sign(half.reshape(b, length)), axis=1) != 0).mean()
    assert abs((half > 0).mean() - 2 / 3) < 0.05
    assert abs(half_hops - 2 * 0.02 * 0.04 / 0.06) < 0.005
    # Negative control: every direction as likely as any other.
    for group in placer.groups:
        group.moves.fill_(1.0 / group.n_states)
    blind = torsion(placer(heavy, last, noise).double().numpy().reshape(-1, scene.n_atoms, 3), quad)[:, 0]
    assert abs((blind > 0).mean() - 2 / 3) > 0.1


def test_methyl_hydrogens_share_their_wells() -> None:
    """A reference too short to turn a methyl group says how it would look turned by a third."""
    scene = load("toluene")
    site = next(s for s in hydrogen_sites(scene).sites if s.turns)
    angles = 0.2 * np.random.default_rng(0).normal(size=2000)
    placer = fitted(scene, turned(scene, (site.around[0], site.parent), list(site.hydrogens), angles))
    group = next(g for g in placer.groups if isinstance(g, SiteGroup) and g.turns)
    shares = group.shares[0]
    assert float(shares.sum()) == pytest.approx(1.0, abs=1e-5)
    torch.testing.assert_close(group.moves.sum(-1), torch.ones(1, N_PHASES), atol=1e-5, rtol=0)
    third = N_PHASES // 3
    torch.testing.assert_close(shares, shares.roll(third), atol=1e-6, rtol=0)
    assert float(shares.max()) > 3.0 / N_PHASES, "the wells are wells"
    assert float((shares - shares.roll(third // 2)).abs().max()) > 0.02


def test_swings_have_the_size_of_the_reference() -> None:
    scene = load("ACE-ALA-NME")
    positions = np.repeat(scene.positions_nm[None], 4000, axis=0)
    hydrogens = [i for i, e in enumerate(scene.elements) if e == "H"]
    positions[:, hydrogens] += 0.01 * np.random.default_rng(0).normal(size=(4000, len(hydrogens), 3))
    placer = fitted(scene, positions)
    heavy = tensor(positions[:1])[:, None, list(placer.plan.heavy)].expand(1, 4000, -1, -1)
    noise = torch.randn(1, 4000, placer.n_noise, generator=torch.Generator().manual_seed(0))
    placed = placer(heavy, None, noise)[0].double().numpy()
    for site in placer.plan.sites:
        if site.turns:
            continue
        h = list(site.hydrogens)
        assert placed[:, h].std(0).mean() == pytest.approx(positions[:, h].std(0).mean(), rel=0.05)
        bonds = [np.linalg.norm(x[:, h[0]] - x[:, site.parent], axis=1) for x in (placed, positions)]
        assert bonds[0].mean() == pytest.approx(bonds[1].mean(), abs=5e-4)
        assert bonds[0].std() == pytest.approx(bonds[1].std(), rel=0.06)
    still = placer(heavy)[0].double().numpy()
    assert still.std(0).max() < 1e-6, "without noise nothing swings"


def test_constrained_bonds_have_no_spread() -> None:
    """Rounding to 0.0002 nm spreads a length by 0.00008 nm, which is no motion; 0.001 nm of the reference's is."""
    scene = load("ethanol")
    rng = np.random.default_rng(0)
    turns = np.stack([rotation(seed) for seed in range(2000)])
    frames = np.einsum("tij,nj->tni", turns, scene.positions_nm)
    parents = {h: site.parent for site in hydrogen_sites(scene).sites for h in site.hydrogens}
    first = min(parents)
    arm = frames[:, first] - frames[:, parents[first]]
    frames[:, first] += arm / np.linalg.norm(arm, axis=1, keepdims=True) * 0.001 * rng.normal(size=(2000, 1))
    placer = fitted(scene, frames)
    spread = {
        int(h): float(s)
        for group in placer.groups
        for h, s in zip(group.hydrogens.flatten(), group.length_spread_nm.flatten(), strict=True)
    }
    assert spread.pop(first) == pytest.approx(0.001, rel=0.05)
    assert max(spread.values()) < 2.5e-5


def test_rows_do_not_depend_on_each_other() -> None:
    scene = load("ACE-SER-NME")
    placer = fitted(scene, shaken(scene, 300, 0.003))
    x = tensor(shaken(scene, 12, 0.003)).reshape(3, 4, -1, 3)
    noise = torch.randn(3, 4, placer.n_noise, generator=torch.Generator().manual_seed(0))
    heavy = x[:, :, list(placer.plan.heavy)]
    together, alone = placer(heavy, x[:, 0], noise), placer(heavy[1:2], x[1:2, 0], noise[1:2])
    assert torch.equal(together, placer(heavy, x[:, 0], noise))
    torch.testing.assert_close(alone[0], together[1], rtol=0, atol=1e-6)
    assert (together[:, :, list(placer.plan.heavy)] == heavy).all()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(together, placer(heavy, x[:, 0], noise)), "bf16 must not round hydrogens"


def pyramidal() -> tuple[Scene, list[list[int]]]:
    """Dimethylamine, and (N, C, C, H)."""
    from systems.source import prepare

    scene = prepare("smiles:CNC")
    nitrogen = scene.elements.index("N")
    near = sorted(int(j) for bond in scene.bonds.tolist() for j in bond if nitrogen in bond and j != nitrogen)
    carbons = [j for j in near if scene.elements[j] == "C"]
    return scene, [[nitrogen, *carbons, next(j for j in near if scene.elements[j] == "H")]]


def test_a_nitrogen_that_turns_over_has_two_hands() -> None:
    scene, quad = pyramidal()
    x = np.repeat(scene.positions_nm[None], 3000, axis=0)
    # Nothing but the hydrogen of the nitrogen goes to the other side, a third of the time, 30 frames long.
    rng, side = np.random.default_rng(0), np.empty(3000, dtype=bool)
    now = False
    for t in range(3000):
        now = rng.random() < 1 / 30 if not now else rng.random() > 2 / 30
        side[t] = now
    n, a, b, h = quad[0]
    normal = np.cross(scene.positions_nm[a] - scene.positions_nm[n], scene.positions_nm[b] - scene.positions_nm[n])
    normal /= np.linalg.norm(normal)
    arm = scene.positions_nm[h] - scene.positions_nm[n]
    x[side, h] = scene.positions_nm[n] + arm - 2 * (arm @ normal) * normal
    placer = fitted(scene, x)
    assert [s.hands for s in placer.plan.sites if s.parent == n] == [2]
    heavy = tensor(x[:1])[:, None, list(placer.plan.heavy)].expand(4, 2000, -1, -1)
    noise = torch.randn(4, 2000, placer.n_noise, generator=torch.Generator().manual_seed(0))
    placed = placer(heavy, tensor(x[:4]), noise).double().numpy().reshape(-1, scene.n_atoms, 3)
    volumes = signed_volumes(placed, quad)[:, 0]
    assert np.abs(np.abs(volumes) / np.abs(signed_volumes(scene.positions_nm, quad)) - 1.0).max() < 0.02
    other = (np.sign(volumes) != np.sign(signed_volumes(scene.positions_nm, quad)[0])).mean()
    assert abs(other - side.mean()) < 0.06
    # Negative control: one side alone is one hand.
    assert all(s.hands == 1 for s in plan_hydrogens(frames_of(scene, x[~side])).sites)


def test_what_cannot_be_placed_is_refused_in_one_line() -> None:
    scene = load("ethanol")
    without_oxygen = [k for k, bond in enumerate(scene.bonds.tolist()) if 2 not in bond or 8 in bond]
    with pytest.raises(InputError, match="fewer than three heavy atoms"):
        hydrogen_sites(replace(scene, bonds=scene.bonds[without_oxygen], bond_orders=scene.bond_orders[without_oxygen]))
    bridged = replace(scene, bonds=np.vstack([scene.bonds, [[1, 8]]]), bond_orders=np.append(scene.bond_orders, 1.0))
    with pytest.raises(InputError, match=r"H6 of .* does not hang on one heavy atom"):
        hydrogen_sites(bridged)


def test_a_plan_survives_a_weights_file() -> None:
    from dataclasses import asdict
    from json import dumps, loads

    plan = hydrogen_sites(load("ACE-SER-NME"))
    assert built(HydrogenPlan, loads(dumps(asdict(plan)))) == plan


def test_frames_of_heavy_atoms_are_a_view() -> None:
    scene = load("ethanol")
    frames = frames_of(scene, shaken(scene, 10, 0.01))
    heavy = part_of_frames(frames, [0, 1, 2])
    idx = np.array([[1, 2], [5, 3]])
    assert heavy.scene.atom_names == ("C1", "C2", "O1")
    assert np.array_equal(heavy.positions_nm(idx), frames.positions_nm(idx)[:, :, :3])
    assert heavy.coordinates is frames.coordinates


def test_the_bench_tells_right_hydrogens_from_wrong_ones() -> None:
    from placed_hydrogens import lines, measure_hydrogens

    scene = load("ethanol")

    def frames(seed: int, hinge: float = 0.0) -> TrainingFrames:
        positions = hydroxyl(scene, rotor_chain(3000, seed) + hinge)[0]
        heavy_too = 0.003 * np.random.default_rng(seed).normal(size=(3000, scene.n_atoms, 3))
        return frames_of(scene, positions + heavy_too)

    found = measure_hydrogens(frames(0), frames(1), n_frames=2560, seed=0)
    other = measure_hydrogens(frames(0), frames(1, hinge=2.0), n_frames=2560, seed=0)
    hydroxyls = [next(r for r in f["rotors"] if "O1" in r["atoms"]) for f in (found, other)]
    assert hydroxyls[0]["jsd"] < 0.03 < 0.3 < hydroxyls[1]["jsd"]
    assert hydroxyls[0]["memory_placed"][0] == pytest.approx(hydroxyls[0]["memory_md"][0], abs=0.03)
    assert found["held_hydrogens"][0]["rmsd_nm"] == pytest.approx(0.0095, abs=0.002)
    assert all(abs(r["md"][0] - r["placed"][0]) < 0.5 for r in found["angles"])
    assert lines(found)[0].startswith("ethanol: hydrogens of 2560 held-out frames")
    with pytest.raises(InputError, match="too few"):
        measure_hydrogens(frames(0), frames(1), n_frames=500, seed=0)
