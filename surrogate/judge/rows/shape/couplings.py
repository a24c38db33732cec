"""³J(HN,HA) couplings from phi, ready to lay beside experiment."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.structure import Backbone
from surrogate.judge.rows.block_means import Means, block_means, mean_row, shift_row
from surrogate.judge.rows.charts import Chart, bar_chart
from surrogate.judge.rows.metrics import are_many
from surrogate.judge.rows.rows import Metric, Row, Trio
from systems.scene import Scene

Skipped = tuple[str, str]

TOLERANCE_HZ = 0.4


class Karplus(NamedTuple):
    """J = a cos²θ + b cos θ + c in Hz, θ the H-N-CA-H torsion, `offset_deg` away from phi for an L residue."""

    a: float
    b: float
    c: float
    offset_deg: float
    source: str


# Rigid, with the motion in the trajectory itself: right for averages over MD frames.
KARPLUS = Karplus(8.40, -1.36, 0.33, -60.0, "Vögeli, Ying, Grishaev and Bax, J. Am. Chem. Soc. 129, 9377 (2007)")


class Site(NamedTuple):
    """One coupling: its column of phi, its residue's name, and the offsets of its alpha hydrogens from phi, degrees."""

    phi: int
    label: str
    offsets_deg: tuple[float, ...]


def find_sites(scene: Scene, torsions: Backbone) -> list[Site]:
    """Return the residues with one hydrogen on N and at least one on CA; glycine has two couplings, which are averaged.

    An L residue has its alpha hydrogen at phi - 60°, a D residue at phi + 60°, glycine at both. Counted in the scene
    that `torsions` was found in; hydrogens must be part of it.
    """
    from systems.chemistry.geometry import signed_volumes
    from systems.chemistry.graph import bonded_graph

    graph = bonded_graph(scene)
    sites = []
    for k, (_, nitrogen, alpha, carbonyl) in enumerate(torsions.phi.tolist()):
        on_nitrogen = [j for j in graph[nitrogen] if scene.elements[j] == "H"]
        hydrogens = [j for j in graph[alpha] if scene.elements[j] == "H"]
        side = [j for j in graph[alpha] if j not in (nitrogen, carbonyl) and scene.elements[j] != "H"]
        if len(on_nitrogen) != 1 or not hydrogens:
            continue
        offsets: tuple[float, ...] = (KARPLUS.offset_deg, -KARPLUS.offset_deg)
        if side:
            quad = [[alpha, nitrogen, carbonyl, side[0]]]
            is_l = float(signed_volumes(scene.positions_nm, quad)[0]) > 0
            offsets = (KARPLUS.offset_deg if is_l else -KARPLUS.offset_deg,)
        sites.append(Site(k, torsions.phi_labels[k], offsets))
    return sites


def coupling_hz(phi_rad: npt.NDArray[Any], offsets_deg: tuple[float, ...] = (KARPLUS.offset_deg,)) -> npt.NDArray[Any]:
    """Return ³J(HN,HA) in Hz of each phi (rad), averaged over the alpha hydrogens at `offsets_deg` from phi.

    Source: Karplus, J. Chem. Phys. 30, 11 (1959); parameters of `KARPLUS`.
    """
    total = np.zeros_like(np.asarray(phi_rad, dtype=np.float64))
    for offset in offsets_deg:
        cosine = np.cos(phi_rad + np.radians(offset))
        total = total + KARPLUS.a * cosine**2 + KARPLUS.b * cosine + KARPLUS.c
    return np.asarray(total / len(offsets_deg))


def coupling_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[Skipped]]:
    """Return the row of every ³J(HN,HA), in Hz, and a chart of them with 95 % intervals."""
    sites = find_sites(trio.scene, trio.torsions)
    if not sites:
        return [], [], [("³J(HN,HA) couplings", "no residue has phi and hydrogens on both N and CA")]
    means = []
    for sample in trio.samples:
        hertz = [
            np.stack([coupling_hz(phi[:, site.phi], site.offsets_deg) for site in sites], axis=1)
            for phi in sample.features.phi
        ]
        means.append(block_means(sample, hertz))
    if are_many(trio):
        return [_largest_shift(trio, sites, means)], [], []
    rows = [
        mean_row(
            trio,
            Metric(f"coupling:{site.label}", "populations", f"³J(HN,HA), {site.label}", "Hz", TOLERANCE_HZ),
            means,
            k,
            lambda c, r, label=site.label: f"³J(HN,HA) of {label} is {c:.2f} Hz instead of {r:.2f} Hz",  # type: ignore[misc]
        )
        for k, site in enumerate(sites)
    ]
    return rows, [_chart(sites, means)], []


def _largest_shift(trio: Trio, sites: list[Site], means: list[Means]) -> Row:
    return shift_row(
        trio,
        Metric("coupling_shift", "populations", "Largest shift of a ³J(HN,HA)", "Hz", TOLERANCE_HZ, resolution=0.02),
        means,
        [site.label for site in sites],
        lambda label, c, r: f"³J(HN,HA) of {label} is {c:.2f} Hz instead of {r:.2f} Hz",
    )


def _chart(sites: list[Site], means: list[Means]) -> Chart:
    caption = (
        f"J = {KARPLUS.a:g} cos²(φ - 60°) - {-KARPLUS.b:g} cos(φ - 60°) + {KARPLUS.c:g} Hz, averaged over "
        f"frames ({KARPLUS.source}); φ + 60° for D residues, both for glycine."
    )
    names = [site.label for site in sites]
    return bar_chart("experiment", "³J(HN,HA)", caption, "³J / Hz", names, [m.estimates() for m in means])
