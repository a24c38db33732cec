"""What is measured on each frame: torsions, bond lengths, validity flags, shape. One pass over the positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.probes import FAMILIES, Family, Probes, find_probes
from surrogate.comparison.read.ensemble import Ensemble, Flags, InSegments
from systems.chemistry.validity import Geometry
from systems.scene import Scene

IntArray = npt.NDArray[np.int64]
Series = npt.NDArray[np.float32]

_BLOCK_FRAMES = 2048
_BLOCK_VALUES = 20_000_000
_GEOMETRY_FRAMES = 20_000
_PROBE_FRAMES = 2_000
# A thermal bond is 2 pm or more wide; what is narrower than this was held by a constraint.
CONSTRAINED_BELOW_NM = 5e-4


class Residue(NamedTuple):
    """One residue with both backbone torsions: columns of `Features.phi` and `Features.psi`, and its name."""

    phi: int
    psi: int
    label: str


@dataclass(frozen=True, eq=False)
class Backbone:
    """Backbone torsions of a scene: quadruples `(k, 4)`, their labels, and the residues that have both."""

    phi: IntArray
    psi: IntArray
    phi_labels: tuple[str, ...]
    psi_labels: tuple[str, ...]
    residues: tuple[Residue, ...]


@dataclass(frozen=True, eq=False)
class Features(InSegments):
    """Per-frame measurements of one ensemble, one array per segment.

    `phi` `(n, n_phi)` and `psi` `(n, n_psi)` rad, `bonds_nm` `(n, n_bonds)`, `flags` `(n,)`; all NaN-carrying where a
    frame is not finite. `chunk_idx` and `changed` `(n,)` or None; `energy_kj` `(n,)` kJ/mol, NaN where none was
    computed, or None; `moved_nm` `(n,)` how far atoms are, root mean square, from where they were in the frame before
    (NaN for the first), centres of both laid together, or None; `grid_nm` what coordinates were rounded to, 0 for
    nothing. `series` holds the further families `(n, k)` that
    `probes` names (see `surrogate.comparison.measure.probes.Probes`), empty where nothing was asked for.
    """

    label: str
    lag_ps: float
    phi: Sequence[Series]
    psi: Sequence[Series]
    bonds_nm: Sequence[Series]
    flags: Sequence[Flags]
    chunk_idx: Sequence[npt.NDArray[np.int32]] | None
    series: Mapping[Family, Sequence[npt.NDArray[Any]]] = field(default_factory=dict)
    probes: Probes | None = None
    changed: Sequence[npt.NDArray[np.bool_]] | None = None
    energy_kj: Sequence[npt.NDArray[np.float64]] | None = None
    moved_nm: Sequence[Series] | None = None
    grid_nm: float = 0.0

    @property
    def segment_lengths(self) -> list[int]:
        return [len(f) for f in self.flags]

    def frames(self, start: int, stop: int) -> Features:
        """Return frames `start:stop`, counted through the segments in order; segments keep their bounds."""
        spans = []
        offset = 0
        for n in self.segment_lengths:
            spans.append((max(start - offset, 0), max(min(stop - offset, n), 0)))
            offset += n

        def cut(series: Sequence[npt.NDArray[Any]]) -> list[npt.NDArray[Any]]:
            return [s[a:b] for s, (a, b) in zip(series, spans, strict=True) if b > a]

        return replace(
            self,
            phi=cut(self.phi),
            psi=cut(self.psi),
            bonds_nm=cut(self.bonds_nm),
            flags=cut(self.flags),
            chunk_idx=None if self.chunk_idx is None else cut(self.chunk_idx),
            changed=None if self.changed is None else cut(self.changed),
            energy_kj=None if self.energy_kj is None else cut(self.energy_kj),
            moved_nm=None if self.moved_nm is None else cut(self.moved_nm),
            series={family: cut(values) for family, values in self.series.items()},
        )


def backbone(scene: Scene, kept: IntArray | None = None) -> Backbone:
    """Return the backbone torsions of `scene`, found in its bond graph, with labels such as 'ALA 2'.

    With `kept`, the atoms of `scene` that are left, those torsions whose atoms all are, counted among them.
    """
    from systems.chemistry.graph import backbone_torsions

    found = backbone_torsions(scene)
    phi = np.asarray(found["phi"], dtype=np.int64).reshape(-1, 4)
    psi = np.asarray(found["psi"], dtype=np.int64).reshape(-1, 4)
    if kept is not None:
        phi, psi = (rows[np.isin(rows, kept).all(axis=1)] for rows in (phi, psi))

    # phi is C-N-CA-C and psi N-CA-C-N: the residue is that of CA.
    def label(alpha_carbon: int) -> str:
        residue = int(scene.residue_of_atom[alpha_carbon])
        return f"{scene.residue_names[residue]} {scene.residue_ids[residue]}"

    of_carbon = {int(quad[1]): k for k, quad in enumerate(psi)}
    residues = tuple(
        Residue(k, of_carbon[int(quad[2])], label(int(quad[2])))
        for k, quad in enumerate(phi)
        if int(quad[2]) in of_carbon
    )
    labels = tuple(label(int(q[2])) for q in phi), tuple(label(int(q[1])) for q in psi)
    if kept is not None:
        phi, psi = (np.searchsorted(kept, rows) for rows in (phi, psi))
    return Backbone(phi, psi, *labels, residues)


@dataclass(frozen=True, eq=False)
class Baseline:
    """What every frame of a comparison is measured by: torsions of the backbone, what valid frames look like, and what
    else is measured, `probes`, None for nothing."""

    torsions: Backbone
    geometry: Geometry
    probes: Probes | None

    @staticmethod
    def of(
        reference: Ensemble, *, parent: Scene | None = None, kept: IntArray | None = None, probing: bool = True
    ) -> Baseline:
        """Return the baseline that a reference gives: geometry from at most 20,000 of its frames, probes (where
        `probing`) chosen on at most 2,000. `parent`, `kept`: see `backbone` and `find_probes`."""
        from systems.chemistry.validity import geometry_from_frames

        scene = reference.scene
        probes = None
        if probing:
            probes = find_probes(scene, reference.sample(_PROBE_FRAMES), parent=parent, kept=kept)
        geometry = geometry_from_frames(scene, reference.sample(_GEOMETRY_FRAMES))
        return Baseline(backbone(parent or scene, kept), geometry, probes)

    def measure(self, ensemble: Ensemble) -> Features:
        """Measure every frame of `ensemble`, block by block: no more than a block of positions is held at a time."""
        from systems.chemistry.geometry import column_blocks, squared_distance, torsion_angle
        from systems.chemistry.validity import check_frames

        torsions, geometry, probes = self.torsions, self.geometry, self.probes
        bonds = np.asarray(geometry.bond_idx, dtype=np.int64).reshape(-1, 2)
        phi, psi, lengths, flags, moved = [], [], [], [], []
        series: dict[Family, list[npt.NDArray[Any]]] = {family: [] for family in FAMILIES} if probes else {}
        size = max(min(_BLOCK_FRAMES, _BLOCK_VALUES // max(3 * ensemble.scene.n_atoms, 1)), 1)
        for segment in ensemble.segments:
            n = len(segment)
            phi.append(np.empty((n, len(torsions.phi)), dtype=np.float32))
            psi.append(np.empty((n, len(torsions.psi)), dtype=np.float32))
            lengths.append(np.empty((n, len(bonds)), dtype=np.float32))
            flags.append(np.empty(n, dtype=np.uint16))
            moved.append(np.full(n, np.nan, dtype=np.float32))
            before = np.empty((0, ensemble.scene.n_atoms, 3), dtype=np.float32)
            for start in range(0, n, size):
                part = slice(start, min(start + size, n))
                block = segment[part]
                broken = ~np.isfinite(block).all(axis=(1, 2))
                before = _moved(before, block, moved[-1][part])
                with np.errstate(invalid="ignore", over="ignore"):
                    for first, x in column_blocks(block, max(len(bonds), 1)):
                        rows = slice(start + first, start + first + x.shape[2])
                        phi[-1][rows] = torsion_angle(x, torsions.phi).T
                        psi[-1][rows] = torsion_angle(x, torsions.psi).T
                        lengths[-1][rows] = np.sqrt(squared_distance(x, bonds)).T
                    flags[-1][part] = check_frames(block, geometry)
                for column in (phi[-1], psi[-1], lengths[-1]):
                    column[part][broken] = np.nan
                if probes is not None:
                    for family, values in probes.measure(block).items():
                        if start == 0:
                            series[family].append(np.empty((n, values.shape[1]), dtype=values.dtype))
                        series[family][-1][part] = values
        return Features(
            ensemble.label,
            ensemble.lag_ps,
            phi,
            psi,
            lengths,
            flags,
            ensemble.chunk_idx,
            series=series,
            probes=probes,
            changed=ensemble.changed,
            moved_nm=moved,
            grid_nm=ensemble.grid_nm,
        )


def _moved(before: Series, block: Series, out: Series) -> Series:
    """Write how far each frame of `block` is from the one before it, `before` `(0 or 1, n_atoms, 3)` being that of the
    first; return the last frame."""
    frames = np.concatenate([before, block])
    with np.errstate(invalid="ignore", over="ignore"):
        centred = frames - frames.mean(axis=1, keepdims=True)
        step = np.sqrt((np.diff(centred, axis=0) ** 2).sum(axis=2).mean(axis=1))
    out[len(out) - len(step) :] = step
    return np.asarray(frames[-1:])


def bond_label(scene: Scene, i: int, j: int) -> str:
    """Return a bond's name for people: 'C-N (ACE 1 - ALA 2)' or 'CA-HA (ALA 2)'."""
    a, b = int(scene.residue_of_atom[i]), int(scene.residue_of_atom[j])
    where = f"{scene.residue_names[a]} {scene.residue_ids[a]}"
    if a != b:
        where += f" - {scene.residue_names[b]} {scene.residue_ids[b]}"
    return f"{scene.atom_names[i]}-{scene.atom_names[j]} ({where})"


def first_invalid_ps(features: Features, mask: int) -> float | None:
    """Return the earliest time in its segment, ps, at which a frame carries any bit of `mask`; None when none does."""
    times = [int(np.argmax((f & mask) != 0)) * features.lag_ps for f in features.flags if ((f & mask) != 0).any()]
    return min(times) if times else None
