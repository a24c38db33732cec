"""Explicit water around a scene: a periodic cell filled from OpenMM's equilibrated box, with ions."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.sparse.csgraph import shortest_path

from md_reference.forces.spec import ForceFieldSpec, WaterBox, cutoff_nm
from systems.chemistry.element_data import atomic_weight_da, covalent_radius_nm
from systems.errors import InputError, PreparationError
from systems.scene import FloatArray, IntArray, Scene

# Cells by the distance between periodic images. The dodecahedron has 71 % of the cube's volume, and 71 % of its height.
_CUBE = np.eye(3)
_DODECAHEDRON = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.5, np.sqrt(0.5)]])
# Direct interactions must end before the next image. What is added to twice the cutoff: two waters share one image
# by their middles (2 x 0.15 nm, `md_reference.simd`), and a barostat may shrink the cell (0.05 nm).
_BEYOND_CUTOFF_NM = 0.35
# Molecules of up to so many atoms are given room to stretch: so far reaches a bond of a zigzag chain, tip to tip.
_FLEXIBLE_ATOMS = 100
_STRETCHED_BOND_NM = 0.126
# How near a water's oxygen may come: to an atom, its covalent radius and this; to another water.
_SHELL_NM = 0.18
_WATER_GAP_NM = 0.24
# At 300 K and 1 bar: waters per nm³, the thermal expansion in 1/K and its growth in 1/K². TIP3P by 400 ps of OpenMM at
# 1 bar (`docs/studies/water/alanine_dipeptide.py`) and Jorgensen and Jenson, J. Comput. Chem. 19, 1179 (1998); OPC by
# Izadi, Anandakrishnan and Onufriev, J. Phys. Chem. Lett. 5, 3863 (2014), with the growth of real water. The partial
# specific volume of small molecules and peptides is 0.75 to 0.85 cm³/g, that of Na+ and Cl- -1.2 and 17.8 cm³/mol.
_BULK = {"tip3p": (32.87, 9.2e-4, 2e-6), "opc": (33.3, 2.7e-4, 9e-6)}
_NM3_PER_DA = 0.8 / 602.214
_NM3_OF_ION = {"Na": -0.0020, "Cl": 0.0296}
_ION_GAP_NM = 0.5
_MOLAR_OF_WATER = 55.4
# Length of OH in nm and angle HOH in degrees.
_WATER_SHAPES = {"tip3p": (0.09572, 104.52), "opc": (0.08724, 103.6)}
_LARGEST = 200_000
_ATTEMPTS = 30


def solvate(scene: Scene, spec: ForceFieldSpec, box: WaterBox, *, seed: int = 0, temperature_k: float = 300.0) -> Scene:
    """Return the scene in a periodic cell of water (`spec.solvent` 'tip3p' or 'opc'), neutral, with Na+ and Cl-.

    Wherever the solute turns, its periodic images stay `box.padding_nm` apart, also where it stretches if it has up to
    100 atoms. The cell is a cube or a rhombic dodecahedron, whichever is smaller, its height at least twice the cutoff
    and 0.35 nm, its volume that of 1 bar at `temperature_k`. The scene's atoms come first, then waters, then ions,
    which waters become drawn with `seed`. Raises PreparationError for a scene that has a cell, another solvent, or a
    cell of too many atoms.
    """
    if not spec.is_explicit:
        raise PreparationError(f"solvent {spec.solvent!r} has no molecules to add; give `solvent='tip3p'` or opc.")
    if scene.cell_nm is not None:
        raise PreparationError(f"scene {scene.name!r} has a periodic cell already; leave `padding_nm` out.")
    low, high = scene.positions_nm.min(axis=0), scene.positions_nm.max(axis=0)
    centre = (low + high) / 2
    apart_nm = _diameter_nm(scene) + box.padding_nm
    least_nm = 2 * cutoff_nm(spec.protein)[0] + _BEYOND_CUTOFF_NM
    cells = (max(apart_nm, least_nm / shape[2, 2]) * shape for shape in (_CUBE, _DODECAHEDRON))
    cell = min(cells, key=np.linalg.det)
    volume_nm3 = float(np.linalg.det(cell))
    if volume_nm3 * 100 > _LARGEST:
        raise PreparationError(
            f"a cell for scene {scene.name!r} with {box.padding_nm:g} nm of padding holds some {volume_nm3 * 100:,.0f} "
            f"atoms (up to {_LARGEST:,}); use less padding or a compact structure."
        )
    solute = scene.positions_nm - centre + cell.sum(axis=0) / 2
    rng = np.random.default_rng(seed)
    (density, expansion, growth), warmer = _BULK[spec.solvent], temperature_k - 300.0
    density *= math.exp(-expansion * warmer - 0.5 * growth * warmer**2)
    solute_nm3 = float(scene.masses_da.sum()) * _NM3_PER_DA
    wanted = math.ceil((volume_nm3 - solute_nm3) * density)
    water = _fill(cell, solute, scene.elements, wanted, rng)
    charge = int(scene.formal_charges.sum())
    pairs = round(len(water) * box.ionic_strength_molar / _MOLAR_OF_WATER)
    kinds = ["Na"] * (pairs + max(0, -charge)) + ["Cl"] * (pairs + max(0, charge))
    chosen = _ion_sites(water[:, 0], solute, cell, len(kinds), rng)
    ions = water[chosen, 0]
    water = np.delete(water, chosen, axis=0)
    # The volume of 1 bar, which some hundred ps with a barostat do not tell as well.
    wanted_nm3 = len(water) / density + solute_nm3 + sum(_NM3_OF_ION[kind] for kind in kinds)
    scale = (wanted_nm3 / volume_nm3) ** (1 / 3)
    cell, ions, middle = cell * scale, ions * scale, cell.sum(axis=0) / 2
    solute += (scale - 1) * middle
    water = _shaped(water + (scale - 1) * water[:, :1], *_WATER_SHAPES[spec.solvent])
    done = f"solvated: {len(water)} {spec.solvent.upper()} waters, {kinds.count('Na')} Na+, {kinds.count('Cl')} Cl-"
    return _assembled(scene, solute, water, kinds, ions, cell, done, seed)


def _diameter_nm(scene: Scene) -> float:
    """Return the diameter of the sphere in which the solute turns, as it is or stretched."""
    centre = (scene.positions_nm.min(axis=0) + scene.positions_nm.max(axis=0)) / 2
    diameter_nm = 2 * float(np.linalg.norm(scene.positions_nm - centre, axis=1).max())
    if scene.n_atoms > _FLEXIBLE_ATOMS:
        return diameter_nm
    bonded = np.zeros((scene.n_atoms, scene.n_atoms))
    bonded[scene.bonds[:, 0], scene.bonds[:, 1]] = 1
    steps = shortest_path(bonded, directed=False, unweighted=True)
    return max(diameter_nm, _STRETCHED_BOND_NM * float(steps[np.isfinite(steps)].max()))


def require_molecules(spec: ForceFieldSpec) -> None:
    """Raise InputError where waters of a file are to be kept in a solvent that is none of molecules."""
    if not spec.is_explicit:
        raise InputError("`keep_water` needs an explicit solvent; give `solvent='tip3p'` or opc, or leave it out.")


def solvate_if_asked(
    scene: Scene, spec: ForceFieldSpec, *, seed: int = 0, temperature_k: float = 300.0, **box: float | None
) -> Scene:
    """Return the scene in water where `spec.solvent` is explicit and it has no cell yet, else as it is. `box`: fields
    of `WaterBox`, None for their defaults. Raises InputError for one that has no effect."""
    given = {name: value for name, value in box.items() if value is not None}
    if spec.is_explicit and scene.cell_nm is None:
        return solvate(scene, spec, WaterBox(**given), seed=seed, temperature_k=temperature_k)
    named, has = " and ".join(f"`{name}`" for name in given), "have" if len(given) > 1 else "has"
    if given and not spec.is_explicit:
        raise InputError(f"{named} {has} no effect without explicit water; give `solvent='tip3p'` or opc.")
    if given:
        raise InputError(f"scene {scene.name!r} has a periodic cell already; leave {named} out.")
    return scene


@cache
def _bulk() -> tuple[FloatArray, FloatArray]:
    """OpenMM's equilibrated TIP3P box: waters `(n, 3, 3)` nm with the oxygen first, and its edges `(3,)` nm."""
    from importlib.resources import files

    from openmm import app

    pdb = app.PDBFile(str(files("openmm.app") / "data" / "tip3p.pdb"))
    edges = np.diag(np.array(pdb.topology.getPeriodicBoxVectors()._value, dtype=np.float64)).copy()
    return np.asarray(pdb.getPositions(asNumpy=True)._value, dtype=np.float64).reshape(-1, 3, 3), edges


def _fill(
    cell: FloatArray, solute: FloatArray, elements: tuple[str, ...], wanted: int, rng: np.random.Generator
) -> FloatArray:
    """Return up to `wanted` waters `(n, 3, 3)` nm in the cell, none too near the solute or another water's image: the
    gaps that colliding waters leave at the walls are filled from the same bulk laid elsewhere, as often as it takes."""
    from scipy.spatial import cKDTree

    reach = np.array([covalent_radius_nm(e) for e in elements]) + _SHELL_NM
    water = np.empty((0, 3, 3))
    for attempt in range(_ATTEMPTS):
        fresh = _laid(cell, np.zeros(3) if attempt == 0 else rng.random(3))
        keep = np.ones(len(fresh), dtype=bool)
        for row in cKDTree(fresh[:, 0]).query_ball_point(solute, reach):
            keep[row] = False
        if len(water):
            tree = cKDTree(_images(water[:, 0], cell)[0])
            keep &= tree.query(fresh[:, 0])[0] >= _WATER_GAP_NM
        fresh = fresh[keep]
        images, of = _images(fresh[:, 0], cell)
        alive = np.ones(len(fresh), dtype=bool)
        for i, row in enumerate(cKDTree(images).query_ball_point(fresh[:, 0], _WATER_GAP_NM)):
            alive[i] = not any(alive[of[k]] for k in row if of[k] < i)
        water = np.concatenate([water, fresh[alive][: wanted - len(water)]])
        if len(water) == wanted:
            break
    return water


def _laid(cell: FloatArray, offset: FloatArray) -> FloatArray:
    """Return the waters `(n, 3, 3)` nm that lie in the cell, of bulk boxes moved by a fraction of a box."""
    bulk, edges = _bulk()
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) @ cell
    repeats = np.ceil(corners.max(axis=0) / edges).astype(int) + 1
    shifts = np.array([[i, j, k] for i in range(repeats[0]) for j in range(repeats[1]) for k in range(repeats[2])])
    water = (bulk[None] + (shifts * edges)[:, None, None]).reshape(-1, 3, 3)
    water = water - bulk[:, 0].min(axis=0) - offset * edges
    fractions = water[:, 0] @ np.linalg.inv(cell)
    return water[((fractions >= 0) & (fractions < 1)).all(axis=1)]


def _images(points: FloatArray, cell: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return points `(n, 3)` of the cell with their images near its walls, and which point each is."""
    margin = 2 * _WATER_GAP_NM / np.diag(cell)
    fractions = points @ np.linalg.inv(cell)
    found, of = [points], [np.arange(len(points))]
    for shift in np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]):
        moved = fractions + shift
        near = ((moved > -margin) & (moved < 1 + margin)).all(axis=1) & bool(shift.any())
        found.append(points[near] + shift @ cell)
        of.append(np.flatnonzero(near))
    return np.concatenate(found), np.concatenate(of)


def _ion_sites(oxygens: FloatArray, solute: FloatArray, cell: FloatArray, n: int, rng: np.random.Generator) -> IntArray:
    """Return which waters become ions, `(n,)`: apart from the solute and from each other while there is room."""
    if n > len(oxygens) // 4:
        raise PreparationError(
            f"{n} ions in {len(oxygens)} waters; use more padding or a lower `ionic_strength_molar`."
        )
    order = rng.permutation(len(oxygens))
    gap = np.array([np.linalg.norm(_nearest(solute - x, cell), axis=1).min() for x in oxygens])
    chosen: list[int] = []
    for wanted in (_ION_GAP_NM, _ION_GAP_NM / 2, 0.0):
        for i in order.tolist():
            if len(chosen) == n:
                break
            apart = i not in chosen and gap[i] >= wanted
            if apart and chosen:
                apart = float(np.linalg.norm(_nearest(oxygens[chosen] - oxygens[i], cell), axis=1).min()) >= wanted
            if apart:
                chosen.append(i)
    return np.array(chosen, dtype=np.int64)


def _nearest(vectors: FloatArray, cell: FloatArray) -> FloatArray:
    """Return difference vectors `(n, 3)` reduced by whole cell vectors, as OpenMM does for reduced cells."""
    out = vectors.copy()
    for k in (2, 1, 0):
        out -= np.round(out[:, k : k + 1] / cell[k, k]) * cell[k]
    return out


def _shaped(water: FloatArray, oh_nm: float, hoh_degrees: float) -> FloatArray:
    """Return the waters with the lengths and the angle of a model, each in its own plane and direction."""
    oxygen = water[:, 0]
    first, second = water[:, 1] - oxygen, water[:, 2] - oxygen
    along = first / np.linalg.norm(first, axis=1)[:, None] + second / np.linalg.norm(second, axis=1)[:, None]
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = first - (first * along).sum(axis=1)[:, None] * along
    across /= np.linalg.norm(across, axis=1)[:, None]
    half = np.radians(hoh_degrees) / 2
    height, width = oh_nm * np.cos(half), oh_nm * np.sin(half)
    return np.stack(
        [oxygen, oxygen + height * along + width * across, oxygen + height * along - width * across], axis=1
    )


def _assembled(
    scene: Scene, solute: FloatArray, water: FloatArray, ion_elements: list[str], ions: FloatArray, cell: FloatArray,
    done: str, seed: int,
) -> Scene:  # fmt: skip
    """Return the scene with waters and ions after its own atoms, each a residue of its own, in a chain for either."""
    n, n_water = scene.n_atoms, len(water)
    oxygens = n + 3 * np.arange(n_water)
    bonds = np.stack([np.stack([oxygens, oxygens + k], axis=1) for k in (1, 2)], axis=1).reshape(-1, 2)
    elements = (*(("O", "H", "H") * n_water), *ion_elements)
    symbols = [e.upper() for e in ion_elements]
    residues = np.concatenate([np.repeat(np.arange(n_water), 3), n_water + np.arange(len(ions))])
    charges = [*[0] * (3 * n_water), *(1 if e == "Na" else -1 for e in ion_elements)]
    free = [c for c in "WXYZVUTSRQPONMLKJIHGFEDCBA" if c not in scene.chain_of_residue] or ["W1", "W2"]
    water_chain, ion_chain = (free * 2)[:2]
    provenance: dict[str, Any] = dict(scene.provenance)
    provenance["repairs"] = [*provenance.get("repairs", []), done]
    provenance["solvation"] = {"n_solute_atoms": n, "seed": seed}
    return replace(
        scene,
        atom_names=(*scene.atom_names, *(("O", "H1", "H2") * n_water), *symbols),
        elements=scene.elements + elements,
        residue_of_atom=np.concatenate([scene.residue_of_atom, len(scene.residue_names) + residues]),
        residue_names=(*scene.residue_names, *(("HOH",) * n_water), *symbols),
        residue_ids=(*scene.residue_ids, *map(str, [*range(1, n_water + 1), *range(1, len(ions) + 1)])),
        chain_of_residue=(*scene.chain_of_residue, *((water_chain,) * n_water), *((ion_chain,) * len(ions))),
        bonds=np.concatenate([scene.bonds, bonds]),
        bond_orders=np.concatenate([scene.bond_orders, np.ones(len(bonds))]),
        formal_charges=np.concatenate([scene.formal_charges, np.array(charges, dtype=np.int64)]),
        masses_da=np.concatenate([scene.masses_da, [atomic_weight_da(e) for e in elements]]),
        positions_nm=np.concatenate([solute, water.reshape(-1, 3), ions.reshape(-1, 3)]),
        provenance=provenance,
        cell_nm=cell,
    )
