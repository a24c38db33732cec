"""What is said beside the numbers: cautions, equal length, what the scene lacks, and what looks like files mixed up."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from surrogate.comparison import verdict
from surrogate.comparison.measure.probes import Family
from surrogate.comparison.measure.slow_motion import rarely_crossed
from surrogate.comparison.measure.statistics import Estimate, effective_samples
from surrogate.comparison.measure.structure import Features, bond_label
from surrogate.comparison.rows.rows import ComparisonInput, Measured, Options, Row
from surrogate.comparison.rows.validity_rows import applicable_checks
from systems.chemistry import validity
from systems.errors import InputError
from systems.scene import Scene
from systems.units import format_time_ps

LEAST_SAMPLES = 20
# Fewer, and error bars of what follows the slow motion are themselves not known.
LEAST_FOR_TESTS = 5
# What is known of the reference, however short the candidate is.
LEAST_FOR_EQUIVALENT_TIME = 10
_MENTIONED = 3
Frames = npt.NDArray[np.float32]

# Longer than so many times the sum of covalent radii no bond is, not even to a metal.
_LONGEST_BOND = 1.4
_REFUSED = (3, 0.05)
_KEY_COLUMNS = 6
_GRID = 1e-3
_NAMED_SHARE = 0.01
_MOSTLY = 0.5
_JUMP_TIMES = 3.0
_USUAL = 0.999
_MOST_JUMPS = 20


def trimming(inputs: ComparisonInput, reference: Features, candidate: Features, replicate: Features) -> list[str]:
    """Return which trajectories are longer than the equal length at which distances are taken."""
    longer = [f for f in (reference, candidate, replicate) if f.total_ps > inputs.compared_ps]
    return [
        f"{f.label}: the first {f.frames(0, round(inputs.compared_ps / f.lag_ps)).length_words} of {f.length_words} "
        "are used for the distances, at equal length; all of it for the tests."
        for f in longer
    ]


def cautions(inputs: ComparisonInput, correlation: float, start: str = "") -> verdict.Cautions:
    """Return which slow motions are not sampled, in words. `correlation`: the slowest of any trajectory, frames;
    `start`: what of the reference still depends on where it started."""
    short = lost = ""
    lag_ps = inputs.reference.features.lag_ps
    samples = effective_samples(round(inputs.compared_ps / lag_ps), correlation)
    if samples < LEAST_SAMPLES:
        short = (
            f"the slowest motion is remembered for {format_time_ps(correlation * lag_ps, 2)}, which "
            f"makes {samples:.2g} independent samples, too few to compare with ({LEAST_SAMPLES} are needed)"
        )
    apart = rarely_crossed((inputs.reference.features, inputs.replicate.features), inputs.candidate.features)
    if apart:
        named = ", ".join(apart[:_MENTIONED]) + (f" and {len(apart) - _MENTIONED} more" if apart[_MENTIONED:] else "")
        lost = (
            f"it lies in another state of {named} than the reference, and hardly any run passes from one to the other"
        )
    copied, _ = copied_from(inputs)
    return verdict.Cautions(short, lost, copied, start)


def unlike(rows: Sequence[Row], options: Options) -> list[str]:
    """Return a warning where the replicate itself differs from the reference."""
    metrics_off = verdict.replicate_differs(rows, options)
    if not metrics_off:
        return []
    return [
        f"The replicate itself differs from the reference ({'; '.join(metrics_off)}): the two are not samples of one "
        "simulation, or too short; trust no verdict on these metrics."
    ]


def skipped(inputs: ComparisonInput) -> list[tuple[str, str]]:
    """Return the checks and torsions that the scene has nothing for, with the reason."""
    skipped = []
    probes = inputs.reference.features.probes
    whole = probes is None or probes.whole
    none = "the scene has none" if whole else "atoms that it needs are not in all files: not checked"
    done = {check.mask for check in applicable_checks(inputs.geometry)}
    for flag, what, why in (
        (validity.BOND_HALF_ANGSTROM, "Bond lengths", "the scene has no bonds"),
        (validity.CLASH, "Clashes", "no two atoms are more than three bonds apart"),
        (validity.CHIRALITY, "Stereocentres", none),
        (validity.OMEGA, "Peptide and double bonds", none),
        (validity.RING, "Planar rings", none),
    ):
        if flag not in done:
            skipped.append((what, why))
    if not len(inputs.torsions.phi) and not len(inputs.torsions.psi):
        skipped.append(("Torsion distributions, basins, autocorrelation", "the scene has no φ or ψ torsion"))
    elif not inputs.torsions.residues:
        skipped.append(("Joint φ/ψ maps", "no residue has both torsions"))
    return skipped


def refuse_wrong_topology(label: str, scene: Scene, frames: Frames) -> None:
    """Raise InputError where frames of a reference have bonds that are none: its topology does not fit them."""
    long, words = bonds_that_are_none(scene, frames)
    if long >= _REFUSED[0] and long >= _REFUSED[1] * len(scene.bonds):
        raise InputError(
            f"{label}: {words}. The topology does not fit the coordinates, whose atoms are in another order; "
            "name the one that belongs to them with `top`."
        )


def bonds_that_are_none(scene: Scene, frames: Frames) -> tuple[int, str]:
    """Return how many bonds are longer, in the median of frames `(n, n_atoms, 3)` nm, than any bond between such
    elements is, and say so."""
    from systems.chemistry.element_data import covalent_radius_nm

    if scene.interactions is not None or not len(scene.bonds) or not len(frames):
        return 0, ""
    i, j = scene.bonds.T
    length = np.median(np.linalg.norm(frames[:, i] - frames[:, j], axis=-1), axis=0)
    try:
        radii = np.array([covalent_radius_nm(e) for e in scene.elements])
    except KeyError:  # virtual sites have no size
        return 0, ""
    long = np.flatnonzero(length > _LONGEST_BOND * (radii[i] + radii[j]))
    if not len(long):
        return 0, ""
    worst = int(long[np.argmax(length[long])])
    name = bond_label(scene, int(i[worst]), int(j[worst]))
    return len(long), (f"{len(long)} of {len(length)} bonds are no bonds, such as {name} of {10 * length[worst]:.2g} Å")


def frame_keys(features: Features) -> npt.NDArray[np.void] | None:
    """Return a number per frame `(n,)` that copies share, whatever was rotated, shifted or converted in between: a few
    angles on a grid of 0.06°; None where there are fewer than three. NaN frames are no copies of each other."""
    chosen_families: tuple[Family, ...] = ("angles", "torsions")
    families = [features.series[f] for f in chosen_families if f in features.series]
    columns = [np.concatenate(list(v)) for v in (features.phi, features.psi, *families)]
    every = np.concatenate(columns, axis=1)
    if every.shape[1] < 3:
        return None
    chosen = np.unique(np.linspace(0, every.shape[1] - 1, _KEY_COLUMNS).astype(int))
    grid = np.round(every[:, chosen].astype(np.float64) / _GRID)
    broken = ~np.isfinite(grid).all(axis=1)
    grid[broken] = 1e9 + np.arange(int(broken.sum()))[:, None]
    keys = np.ascontiguousarray(grid.astype(np.int64))
    return keys.view(np.dtype((np.void, keys.dtype.itemsize * keys.shape[1])))[:, 0]


def repeated_share(keys: npt.NDArray[np.void]) -> float:
    """Return the share of frames that are copies of an earlier one."""
    return 1.0 - len(np.unique(keys)) / len(keys)


def shared_share(keys: npt.NDArray[np.void], others: npt.NDArray[np.void]) -> float:
    """Return the share of frames that are among the others."""
    return float(np.isin(keys, others).mean())


def copy_rows(inputs: ComparisonInput) -> Measured:
    """Return the row of frames that are copies of others of the same trajectory, where any has one in a hundred."""
    name = "Frames that are copies of others"
    keys = [frame_keys(s.features) for s in inputs.samples]
    if any(k is None for k in keys):
        return Measured(skipped=[(name, "fewer than three angles tell frames apart")])
    shares = [repeated_share(k) for k in keys if k is not None]
    if max(shares) < _NAMED_SHARE:
        return Measured(skipped=[(name, "there are none")])
    percent = [Estimate(100.0 * x, n_blocks=s.blocks.n_blocks) for x, s in zip(shares, inputs.samples, strict=True)]
    still = shares[1] > 1.0 - 1.5 / inputs.candidate.features.n_frames
    of_reference = max(shares[0], shares[2])
    row = Row(
        key="copies",
        group="validity",
        metric=name,
        unit="%",
        form="observable",
        reference=percent[0],
        candidate=Estimate(math.nan) if still else percent[1],
        replicate=percent[2],
        ratio=None,
        p_value=0.0 if shares[1] - of_reference >= _NAMED_SHARE else 1.0,
        p_replicate=0.0 if abs(shares[2] - shares[0]) >= _NAMED_SHARE else 1.0,
        tolerance=100.0 * _NAMED_SHARE,
        tolerance_text=f"+ {100 * _NAMED_SHARE:g} %",
        statement="every frame is the same: it does not move"
        if still
        else f"{100 * shares[1]:.3g} % of frames are copies of other frames",
    )
    return Measured([row])


def copied_from(inputs: ComparisonInput) -> tuple[str, list[str]]:
    """Return why there is nothing to evaluate, where most of the candidate's frames are the reference's own; and notes
    on frames that any two of the three have in common."""
    ref, cand, rep = (frame_keys(s.features) for s in inputs.samples)
    if ref is None or cand is None or rep is None:
        return "", []
    verdict, notes = "", []
    label = inputs.candidate.features.label
    for source, keys in (("reference", ref), ("replicate", rep)):
        share = shared_share(cand, keys)
        if share >= _MOSTLY:
            verdict = (
                verdict or f"{100 * share:.3g} % of its frames are frames of the {source}, so that nothing is compared"
            )
        elif share >= _NAMED_SHARE:
            notes.append(f"{label}: {100 * share:.3g} % of its frames are frames of the {source}.")
    share = shared_share(rep, ref)
    if share >= _NAMED_SHARE:
        notes.append(
            f"{100 * share:.3g} % of the replicate's frames are the reference's: the two are not independent, and the "
            "replicate baseline is too low."
        )
    return verdict, notes


def jump_notes(features: Features) -> list[str]:
    """Return where a trajectory jumps: steps of the whole molecule three times as long as one in a thousand is."""
    if features.moved_nm is None:
        return []
    steps = np.concatenate([m[np.isfinite(m)] for m in features.moved_nm])
    if len(steps) < 1 / (1 - _USUAL):
        return []
    limit = _JUMP_TIMES * float(np.quantile(steps, _USUAL))
    places = [(k, int(f)) for k, m in enumerate(features.moved_nm) for f in np.flatnonzero(np.nan_to_num(m) > limit)]
    if not 0 < len(places) <= _MOST_JUMPS:
        return []
    segment, frame = places[0]
    where = format_time_ps(frame * features.lag_ps) + (f" of segment {segment + 1}" if segment else "")
    times = "once" if len(places) == 1 else f"{len(places)} times"
    return [
        f"{features.label}: the molecule jumps {times} from one frame to the next (first at {where}): were files "
        "joined there? Give them as replicas, or with their times."
    ]


def jumps(everyone: Sequence[Features]) -> list[str]:
    """Return the notes on jumps of all trajectories."""
    return [note for features in everyone for note in jump_notes(features)]
