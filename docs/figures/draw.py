"""Draw the figures of README and manual: `python docs/figures/draw.py [DEMO_FOLDER]`.

`effective_samples.svg`, `n_body_causes.svg` and `peptides_water.svg` are made of the tables of their names in
docs/results/tables;
`overlay.png` of the trajectories that `surromd demo` left in DEMO_FOLDER, and left as it is without one.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

HERE = Path(__file__).resolve().parent
TABLE = HERE.parent / "results" / "tables" / "effective_samples.json"
CAUSES = TABLE.with_name("n_body_causes.json")
KT_KJ_PER_MOL = 2.494
COLOURS = {"peptides": "#d62728", "alanine-dipeptide": "#1f77b4"}
# of the best polynomial on the 200 held-out trajectories of the study (docs/studies/published/n_body_causes.py)
POLYNOMIAL_ADE = 0.503


def numbers(cell: str) -> list[float]:
    """Return the numbers in a cell: '0.167 [0.153, 0.186]' -> [0.167, 0.153, 0.186]."""
    return [float(n) for n in re.findall(r"\d+(?:\.\d+)?", cell)]


def pareto_front(points: list[tuple[float, float]]) -> list[int]:
    """Return the places of points (effective samples a second, distance) that no other point beats in both."""
    front: list[int] = []
    for k in sorted(range(len(points)), key=lambda k: (-points[k][0], points[k][1])):
        if not front or points[k][1] < points[front[-1]][1]:
            front.append(k)
    return front


def draw_effective(table: dict[str, Any], out: Path) -> None:
    """Draw distance to the reference against effective samples a second, of the surrogates' settings and of MD, and the
    front: what nothing beats in both."""
    rows = [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]
    points = [(numbers(row["effective samples/s"])[0], numbers(row["distance"])[0]) for row in rows]
    figure, axes = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
    front = np.array([points[k] for k in pareto_front(points)])
    axes.plot(*front.T, color="grey", lw=0.8, zorder=0, label="front")
    labelled = set()
    for row, (rate, y) in zip(rows, points, strict=True):
        whose, _, setting = row["what"].partition(", ")
        colour = COLOURS.get(whose, "black")
        ends = numbers(row["distance"])[1:]
        error = [[y - ends[0]], [ends[1] - y]] if ends else None
        label = None if whose in labelled else whose if whose in COLOURS else "MD"
        labelled |= {whose} if whose in COLOURS else {"OpenMM", "MD by SIMD replicas"}
        marker = "o" if whose in COLOURS else "s"
        axes.errorbar(rate, y, error, color=colour, marker=marker, capsize=2, lw=1, ms=5, ls="", label=label)
        name = setting if whose in COLOURS else row["what"].removeprefix("MD by ")
        below = name.startswith(("fitted", "gaussian", "angular 2"))
        where = {"xytext": (3, -4) if below else (-3, 4), "ha": "right" if below else "left"}
        where |= {"va": "top" if below else "bottom", "rotation": 60}
        at = (ends[0] if below else ends[1]) if ends else y
        axes.annotate(name, (rate, at), color=colour, fontsize=7.5, textcoords="offset points", **where)
    axes.set(
        xscale="log",
        xlabel="effective samples of cos ψ a processor second (one core)",
        ylabel="Jensen-Shannon distance of φ/ψ maps",
        ylim=(0, 0.52),
    )
    axes.margins(x=0.2)  # room for what is written beside the first and last points
    axes.legend(frameon=False, fontsize=8, loc="lower left")
    figure.savefig(out, metadata={"Date": None})
    plt.close(figure)


def draw_n_body(table: dict[str, Any], out: Path) -> None:
    """Draw the error of samples on held-out charged particles against steps, of lines that differ in one thing: above
    those of large batches, below those of small ones."""
    figure, both = plt.subplots(2, 1, figsize=(7.6, 6.8), sharex=True, sharey=True, layout="constrained")
    colours, few = plt.get_cmap("tab20"), "16 windows, "
    for axes, start, batch in zip(both, ("", few), (64, 16), strict=True):
        curves = {name: c for name, c in table["curves"].items() if name.startswith(few) == bool(start)}
        for k, (name, curve) in enumerate(curves.items()):
            steps, ades = np.array([point[:2] for point in curve]).T
            style = "-" if "particles: " in name else "--"
            axes.plot(steps, ades, style, marker=".", lw=1, color=colours(k), label=name.removeprefix(start))
        axes.axhline(POLYNOMIAL_ADE, color="black", lw=0.8, ls=":", label="the polynomial alone")
        axes.set(xlabel=f"steps of {batch} windows", ylabel="ADE of samples", ylim=(0, 0.9))
        axes.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(out, metadata={"Date": None})
    plt.close(figure)


def draw_water(rates: dict[str, Any], populations: dict[str, Any], out: Path) -> None:
    """Draw how often psi crosses over MD's, and how far torsions are from MD's, against the MD in water that each way
    of training learned from; grey: MD's own standard error."""
    figure, both = plt.subplots(1, 2, figsize=(7.6, 3.6), layout="constrained", sharex=True)
    rows = {(row[0].replace("`", ""), row[1]): (numbers(row[-1]), float(other[2]))
            for row, other in zip(rates["rows"], populations["rows"], strict=True)}  # fmt: skip
    _, low, high = rows.pop((rates["rows"][0][0], ""))[0]
    both[0].axhspan(low, high, color="0.9")
    implicit = rows.pop((rates["rows"][1][0], ""))
    least = min(float(ns) for _, ns in rows if float(ns))
    for axes, value, label in ((both[0], implicit[0][0], "MD in OBC2"), (both[1], implicit[1], None)):
        axes.axhline(1.0, color="black", lw=0.8, zorder=0)
        axes.axhline(value, color="black", lw=0.8, ls=":", label=label, zorder=0)
    ticks: set[float] = set()
    for k, name in enumerate(dict.fromkeys(name for name, _ in rows)):
        some = sorted((float(ns) or least / 4, *found) for (what, ns), found in rows.items() if what == name)
        x = np.array([ns for ns, *_ in some]) * 1.03 ** (k - 2)
        y = np.array([found for _, found, _ in some])
        style = {"marker": "o", "ms": 4, "lw": 1, "color": f"C{k}"}
        both[0].errorbar(x, y[:, 0], [y[:, 0] - y[:, 1], y[:, 2] - y[:, 0]], capsize=2, label=name, **style)
        both[1].plot(x, [apart for *_, apart in some], **style)
        if len(some) > 1:
            ticks |= {float(ns) for what, ns in rows if what == name}
    both[0].set(ylabel="ψ crossings over MD's", yscale="log", yticks=(0.5, 1, 2, 4, 8), yticklabels=(0.5, 1, 2, 4, 8))
    both[0].minorticks_off()
    both[1].set(ylabel="distance of torsions over MD's", ylim=(0.9, None))
    for axes in both:
        axes.set(xscale="log", xlabel="MD of monomers in water, ns", xticks=[least / 4, *sorted(ticks)],
                 xticklabels=["0", *(f"{t:g}" for t in sorted(ticks))])  # fmt: skip
        axes.minorticks_off()
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.savefig(out, metadata={"Date": None})
    plt.close(figure)


def dihedrals(paths: list[Path]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return φ and ψ (n_frames,) in degrees of all frames of trajectories of one peptide with one residue of each, and
    the time (ns) that they cover."""
    from systems.chemistry.geometry import torsion
    from systems.chemistry.graph import backbone_torsions
    from systems.trajectory.codec import open_trajectory

    frames, quads, ps = [], {}, 0.0
    for path in paths:
        trajectory = open_trajectory(path)
        quads = backbone_torsions(trajectory.scene)
        frames.append(trajectory.read())
        ps += float(trajectory.time_ps[-1])
    positions = np.concatenate(frames)
    phi, psi = (np.degrees(torsion(positions, quads[name])[:, 0]) for name in ("phi", "psi"))
    return phi, psi, 1e-3 * ps


def draw_overlay(demo: Path, out: Path) -> None:
    """Draw φ/ψ free energies of the demo's reference and surrogate side by side, and one laid over the other."""
    edges = np.linspace(-180, 180, 49)
    centres = 0.5 * (edges[1:] + edges[:-1])
    maps = {}
    for title, pattern in (("OpenMM", "reference_r*.h5"), ("surrogate", "surrogate_r*.h5")):
        phi, psi, ns = dihedrals(sorted(p for p in demo.glob(pattern) if not p.name.endswith(".meta.h5")))
        counts = np.histogram2d(phi, psi, bins=(edges, edges))[0].T
        with np.errstate(divide="ignore"):
            energy = -KT_KJ_PER_MOL * np.log(counts / counts.max())
        maps[f"{title}, {ns:.0f} ns"] = np.where(counts > 0, energy, np.nan)
    figure, panels = plt.subplots(1, 3, figsize=(9.2, 3.2), sharex=True, sharey=True, layout="constrained")
    for panel, (title, energy) in zip(panels, maps.items(), strict=False):
        image = panel.pcolormesh(edges, edges, energy, cmap="viridis", vmin=0, vmax=15, rasterized=True)
        panel.set_title(title, fontsize=10)
    figure.colorbar(image, ax=panels[1], label="kJ/mol", shrink=0.85)
    levels = [2.5, 5.0, 10.0]
    for energy, colour, style in zip(maps.values(), ("black", "#d62728"), ("-", "--"), strict=True):
        filled = np.where(np.isnan(energy), 20.0, energy)
        panels[2].contour(centres, centres, filled, levels, colors=colour, linestyles=style, linewidths=1)
    panels[2].plot([], [], "k-", label="OpenMM")
    panels[2].plot([], [], "--", color="#d62728", label="surrogate")
    panels[2].legend(frameon=False, fontsize=8, loc="lower right")
    panels[2].set_title("2.5, 5 and 10 kJ/mol", fontsize=10)
    panels[0].set_ylabel("ψ (°)")
    for panel in panels:
        panel.set(xlabel="φ (°)", xlim=(-180, 180), ylim=(-180, 180), aspect="equal")
        panel.set_xticks([-120, 0, 120])
        panel.set_yticks([-120, 0, 120])
    figure.savefig(out, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    draw_effective(json.loads(TABLE.read_text(encoding="utf-8")), HERE / "effective_samples.svg")
    draw_n_body(json.loads(CAUSES.read_text(encoding="utf-8")), HERE / "n_body_causes.svg")
    water = [json.loads(TABLE.with_name(name).read_text(encoding="utf-8"))
             for name in ("peptides_water.json", "peptides_water_helices.json")]  # fmt: skip
    draw_water(*water, HERE / "peptides_water.svg")
    if len(sys.argv) > 1:
        draw_overlay(Path(sys.argv[1]), HERE / "overlay.png")
