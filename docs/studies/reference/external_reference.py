"""Our reference MD against other people's: `python docs/studies/reference/external_reference.py --data DIR --out DIR`.

Runs alanine dipeptide as the published trajectories of msmbuilder (msmb_data, CC-BY) were run: ff99SB-ILDN with the
radii of `amber99_obc.xml`, 300 K, Langevin at 91/ps, 2 fs, bonds to hydrogen rigid, natural masses (at high friction
the kinetics depend on them), frames 1 ps apart, 10 ns each. Then compares the occupancies of the psi basins and the
relaxation time of cos psi, trajectory by trajectory: the spread between trajectories is the error bar. Runs that are
complete are kept, interrupted ones are resumed. Twenty runs: the ten first made differed in the occupancies by 2.85
combined standard errors, so ten more were decided on before they were made; both comparisons are printed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import InputError
from systems.units import parse_time_ps

SCENE = "alanine-dipeptide"
FIRST_SEED, N_FIRST, N_RUNS = 200, 10, 20
RUN_PS = 10_000.0
AGREES_BELOW = 2.0
_N_BINS = 72

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Mean:
    """Mean over trajectories, its standard error, and the values `(n_trajectories,)` behind it."""

    mean: float
    error: float
    values: tuple[float, ...]


@dataclass(frozen=True)
class Difference:
    """Ours less theirs, in units of the combined standard error; `agrees` below two of them."""

    quantity: str
    unit: str
    ours: Mean
    theirs: Mean
    difference: float
    combined_errors: float
    agrees: bool


def basin_boundaries(psi_rad: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the psi at which alphaR begins and ends, rad: the minima of the histogram between its two highest maxima.

    72 bins of all trajectories, smoothed by a Gaussian of 10 degrees around the circle; the maxima are at least 60
    degrees apart. Everything outside is beta. Raises InputError when psi has no two basins.
    """
    counts, edges = np.histogram(np.concatenate(list(psi_rad)), bins=_N_BINS, range=(-math.pi, math.pi))
    offsets = (np.arange(_N_BINS) + _N_BINS // 2) % _N_BINS - _N_BINS // 2
    kernel = np.exp(-0.5 * (offsets / 2.0) ** 2)
    smooth = np.fft.irfft(np.fft.rfft(counts / counts.sum()) * np.fft.rfft(kernel / kernel.sum()), _N_BINS)
    centres = 0.5 * (edges[1:] + edges[:-1])
    peaks = np.flatnonzero((smooth > np.roll(smooth, 1)) & (smooth >= np.roll(smooth, -1)))
    peaks = peaks[np.argsort(-smooth[peaks])]
    apart = [p for p in peaks[1:] if abs((p - peaks[0] + _N_BINS // 2) % _N_BINS - _N_BINS // 2) >= _N_BINS // 6]
    if not apart or smooth[apart[0]] < 0.02 * smooth[peaks[0]]:
        raise InputError("psi has only one basin in these trajectories; their occupancies cannot be compared.")
    # alphaR is the one whose maximum is nearer to -30 degrees, beta the one near 150.
    alpha, beta = sorted((peaks[0], apart[0]), key=lambda p: -math.cos(centres[p] - math.radians(-30.0)))
    down = [(alpha - k) % _N_BINS for k in range((alpha - beta) % _N_BINS)]
    up = [(alpha + k) % _N_BINS for k in range((beta - alpha) % _N_BINS)]
    low, high = (min(arc, key=lambda k: smooth[k]) for arc in (down, up))
    return float(centres[low]), float(centres[high])


def summarise(psi_rad: Sequence[FloatArray], lag_ps: float, alpha: tuple[float, float]) -> dict[str, Mean]:
    """Return occupancies of beta and alphaR, the mean psi in each (degrees) and the relaxation time of cos psi (ps).

    Each is a mean over trajectories. The mean psi within a basin settles within picoseconds: it compares the force
    fields far more sharply than the occupancies, of which 10 ns hold some twenty independent samples. The relaxation
    time is the integrated autocorrelation time up to the first zero crossing (comparison.kinetics), of each trajectory
    about its own mean.
    """
    from surrogate.comparison.measure.kinetics import zero_crossing

    in_alpha = [(psi - alpha[0]) % (2 * np.pi) < (alpha[1] - alpha[0]) % (2 * np.pi) for psi in psi_rad]
    inside = [float(np.mean(x)) for x in in_alpha]
    times = [zero_crossing([np.cos(psi)])[1] * lag_ps for psi in psi_rad]
    return {
        "beta": _mean([1.0 - x for x in inside]),
        "alphaR": _mean(inside),
        "psi in beta": _mean([_circular_mean_deg(p[~x]) for p, x in zip(psi_rad, in_alpha, strict=True)]),
        "psi in alphaR": _mean([_circular_mean_deg(p[x]) for p, x in zip(psi_rad, in_alpha, strict=True)]),
        "relaxation": _mean(times),
    }


def _circular_mean_deg(angles_rad: FloatArray) -> float:
    return float(np.degrees(np.angle(np.exp(1j * angles_rad).mean()))) if len(angles_rad) else math.nan


def _mean(values: Sequence[float]) -> Mean:
    error = float(np.std(values, ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.nan
    return Mean(float(np.mean(values)), error, tuple(values))


def difference(quantity: str, unit: str, ours: Mean, theirs: Mean) -> Difference:
    """Return how far two means lie apart; without an error bar nothing agrees."""
    gap = ours.mean - theirs.mean
    combined = gap / math.hypot(ours.error, theirs.error)
    return Difference(quantity, unit, ours, theirs, gap, combined, abs(combined) < AGREES_BELOW)


def read_psi(paths: Sequence[Path], *, top: Path | None = None) -> list[FloatArray]:
    """Return psi of each trajectory, `(n_frames,)` rad, atoms matched to the library's by the bond graph."""
    from surrogate.comparison.measure.structure import backbone
    from surrogate.comparison.read.ensemble import load_ensemble
    from systems.chemistry.geometry import torsion
    from systems.library.named_scenes import load

    scene = load(SCENE)
    quad = backbone(scene).psi[:1]
    series = []
    for path in paths:
        # A DCD holds no time to rely on; both sets are saved every 1 ps.
        (segment,) = load_ensemble([path], template=scene, top=top, lag_ps=1.0).segments
        series.append(np.asarray(torsion(segment, quad)[:, 0], dtype=np.float64))
    return series


def run_ours(out_dir: Path, *, n_runs: int, time_ps: float, workers: int | None, quiet: bool = False) -> None:
    """Make the runs that are missing: seeds 200, 201, ..., one process each, `workers` at a time."""
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.replicas import simulate_replicas
    from md_reference.run.simulate import MDConfig
    from surrogate.progress import progress_bar
    from systems.library.named_scenes import load

    config = MDConfig(
        time_ps=time_ps,
        save_every_ps=1.0,
        temperature_k=300.0,
        friction_per_ps=91.0,
        timestep_ps=0.002,
        seed=FIRST_SEED,
        force=ForceFieldSpec("ff99SB-ILDN", "amber99-obc", hydrogen_mass_da=None),
    )
    out_dir.mkdir(parents=True, exist_ok=True)
    with progress_bar(f"OpenMM {SCENE} x {n_runs}", quiet=quiet, ps_per_frame=1.0) as progress:
        simulate_replicas(load(SCENE), config, _paths(out_dir, n_runs), resume=True, progress=progress, workers=workers)


def _paths(out_dir: Path, n_runs: int) -> list[Path]:
    return [out_dir / f"seed{FIRST_SEED + k}.h5" for k in range(n_runs)]


def complete_runs(out_dir: Path, *, n_runs: int, time_ps: float) -> list[Path]:
    """Return the runs in `out_dir` that are there in full."""
    from systems.trajectory.codec import open_trajectory

    found = []
    for path in _paths(out_dir, n_runs):
        if path.exists():
            with open_trajectory(path) as reader:
                if reader.record.get("completed") and reader.n_frames == round(time_ps):
                    found.append(path)
    return found


def compare_with_published(
    data_dir: Path, out_dir: Path, *, n_runs: int = N_RUNS, time_ps: float = RUN_PS
) -> dict[str, Any]:
    """Compare the complete runs of `out_dir` with the DCDs of `data_dir`; return and write `comparison_N.json`.

    The file is named after the number of runs asked for. Raises InputError when either side has fewer than two
    trajectories, so that there is no error bar.
    """
    published = sorted(data_dir.glob("trajectory-*.dcd"))
    runs = complete_runs(out_dir, n_runs=n_runs, time_ps=time_ps)
    for folder, paths in ((data_dir, published), (out_dir, runs)):
        if len(paths) < 2:
            raise InputError(f"{folder}: {len(paths)} complete trajectories; an error bar needs at least two.")
    theirs, ours = read_psi(published, top=data_dir / "ala2.pdb"), read_psi(runs)
    alpha = basin_boundaries(theirs)
    a, b = summarise(ours, 1.0, alpha), summarise(theirs, 1.0, alpha)
    units = {"beta": "", "alphaR": "", "psi in beta": "deg", "psi in alphaR": "deg", "relaxation": "ps"}
    result = {
        "settings": "ff99SB-ILDN, amber99_obc, 300 K, 91/ps, 2 fs, natural masses, 1 ps per frame",
        "alphaR_deg": [math.degrees(x) for x in alpha],
        "ours": [p.name for p in runs],
        "theirs": [p.name for p in published],
        "n_frames_ours": [len(x) for x in ours],
        "n_frames_theirs": [len(x) for x in theirs],
        "differences": [asdict(difference(key, unit, a[key], b[key])) for key, unit in units.items()],
    }
    text = json.dumps(result, indent=2)
    (out_dir / f"comparison_{n_runs}.json").write_text(text + "\n")
    return dict(json.loads(text))


def table(result: dict[str, Any]) -> str:
    """Return the comparison as aligned lines."""
    low, high = result["alphaR_deg"]
    lines = [
        f"{len(result['ours'])} runs of ours against {len(result['theirs'])} published; alphaR: psi from {low:.1f} to "
        f"{high:.1f} degrees, beta: the rest (minima of the published histogram)",
        f"{'':<16} {'ours':>18} {'published':>18} {'difference':>11} {'in s.e.':>8}",
    ]
    for row in result["differences"]:
        digits = 1 if row["unit"] else 3
        ours, theirs = (f"{row[k]['mean']:.{digits}f} +- {row[k]['error']:.{digits}f}" for k in ("ours", "theirs"))
        word = "agrees" if row["agrees"] else "DIFFERS"
        lines.append(
            f"{row['quantity']:<16} {ours:>18} {theirs:>18} {row['difference']:>11.{digits}f} "
            f"{row['combined_errors']:>8.2f} {word:<8} {row['unit']}".rstrip()
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with trajectory-*.dcd and ala2.pdb")
    parser.add_argument("--out", type=Path, required=True, help="folder for the runs and the comparisons")
    parser.add_argument("--runs", type=int, default=N_RUNS)
    parser.add_argument("--time", default="10ns", help="of each run")
    parser.add_argument("--workers", type=int, default=None, help="processes at a time; default: the cores")
    parser.add_argument("--compare-only", action="store_true", help="run nothing, compare what is complete")
    options = parser.parse_args()
    time_ps = parse_time_ps(options.time)
    if not options.compare_only:
        run_ours(options.out, n_runs=options.runs, time_ps=time_ps, workers=options.workers)
    for n_runs in sorted({min(N_FIRST, options.runs), options.runs}):
        result = compare_with_published(options.data, options.out, n_runs=n_runs, time_ps=time_ps)
        sys.stdout.write(table(result) + "\n")


if __name__ == "__main__":
    main()
