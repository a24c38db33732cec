"""The comparison: reference, replicate and candidates in; a frozen value with rows, curves and a verdict out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surrogate.comparison import verdict
from surrogate.comparison.convergence import NOTHING_OPEN, Convergence, Explained, convergence_of, explain
from surrogate.comparison.equivalent_time import EquivalentTime, equivalent_time_charts, equivalent_times, headline
from surrogate.comparison.measure.movie import Movie, make_movie
from surrogate.comparison.measure.slow_motion import longest_correlation
from surrogate.comparison.measure.statistics import block_length, effective_samples, make_blocks
from surrogate.comparison.measure.structure import Backbone, Baseline, Features
from surrogate.comparison.measure.torsions import bond_label
from surrogate.comparison.metrics import METRICS, measure_all
from surrogate.comparison.read.ensemble import Ensemble, alike
from surrogate.comparison.rows.charts import Chart, jsonable
from surrogate.comparison.rows.rows import ComparisonInput, Options, Row, Sample, by_group, make_sample
from surrogate.comparison.rows.torsion_rows import FEW_RESIDUES
from surrogate.comparison.rows.validity_rows import CHECKS, copied_from, unchecked
from systems.chemistry import validity
from systems.chemistry.element_data import covalent_radius_nm
from systems.chemistry.validity import Geometry
from systems.errors import InputError
from systems.scene import Scene
from systems.units import format_time_ps

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Frames whose bonds show whether a topology fits.
_FRAMES_FOR_BONDS = 20
# Longer than so many times the sum of covalent radii no bond is, not even to a metal.
_LONGEST_BOND = 1.4
# Bonds that are none, number and share, of which a reference is refused.
_REFUSED = (3, 0.05)
# Jumps: so many times as long as all but one step in a thousand, and no more of them than this.
_JUMP_TIMES, _USUAL, _MOST_JUMPS = 3.0, 0.999, 20
_MIN_FRAMES = 20
# Holm's correction for so many rows must leave the least p-value of a permutation test below 5 %.
_ROWS_FORESEEN = 60
_MOST_TIMES_AS_LONG = 20


@dataclass(frozen=True)
class Summary:
    """What one trajectory is: where from, how long, how it was made, what it cost. `top` and `stated_lag_ps` are what
    the user said of the files; `total_ps`, `n_frames` are of the whole input; `ns_per_day` and `wall_s` are None where
    its record holds no cost."""

    label: str
    sources: tuple[str, ...]
    top: str | None
    stated_lag_ps: float | None
    n_segments: int
    n_frames: int
    lag_ps: float
    total_ps: float
    settings: dict[str, Any]
    wall_s: float | None
    ns_per_day: float | None
    cost: dict[str, Any]
    length: str = ""


@dataclass(frozen=True)
class Faults:
    """How many of the compared frames carry each validity flag, and when the first invalid one comes."""

    n_frames: int
    counts: dict[str, int]
    n_invalid: int
    first_invalid_ps: float | None


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One candidate against the reference: rows with a word each, what is wrong (worst first), and the verdict.

    `compared_ps` and `n_frames` are the equal length of all three; `block_ps` and `n_blocks` (of the reference) stand
    behind the error bars; `effective_samples` are the independent ones that the equal length holds of the slowest
    motion of any; `speed_ratio` is simulated time per wall second over the reference's; `faults` of (reference,
    candidate, replicate). `equivalent_time_words` is empty where it is not known, frames are broken, or the reference
    depends on where it started. `left_open`: what the reference's start or length leaves open; `in_short`: use it or
    not, for what, why.
    """

    summary: Summary
    status: verdict.Status
    verdict: str
    findings: tuple[str, ...]
    rows: tuple[Row, ...]
    compared_ps: float
    n_frames: int
    block_ps: float
    n_blocks: int
    effective_samples: float
    speed_ratio: float | None
    faults: tuple[Faults, Faults, Faults]
    skipped: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    charts: tuple[Chart, ...]
    equivalent_time: tuple[EquivalentTime, ...] = ()
    equivalent_time_words: str = ""
    left_open: Explained = NOTHING_OPEN
    in_short: tuple[str, str, str] = ("", "", "")

    def row(self, key: str) -> Row:
        """Return the row whose key is, or starts with, `key`. Raises InputError when there is none."""
        for row in self.rows:
            if row.key == key or row.key.startswith(f"{key}:"):
                return row
        raise InputError(f"{self.summary.label}: no metric {key!r}; there are {', '.join(r.key for r in self.rows)}.")


@dataclass(frozen=True, eq=False)
class Comparison:
    """Everything a report says, and nothing that needs computing. `movies`: one per evaluation, for the viewer;
    `convergence`: whether reference and replicate together have forgotten where they started."""

    scene_name: str
    formula: str
    n_atoms: int
    temperature_k: float
    lag_ps: float
    reference: Summary
    replicate: Summary | None
    evaluations: tuple[Evaluation, ...]
    notes: tuple[str, ...]
    options: Options
    versions: dict[str, str]
    movies: tuple[Movie, ...] = ()
    convergence: Convergence | None = None

    @property
    def headline(self) -> str:
        """Of every candidate a line: use it or not, for what, and why."""
        return "\n".join(f"{j.summary.label}: {' '.join(j.in_short)}" for j in self.evaluations)

    def _repr_html_(self) -> str:
        """Return the same for a notebook."""
        return "".join(
            f"<p><b>{escape(j.summary.label)}: {escape(j.in_short[0])}</b><br>"
            f"{'<br>'.join(map(escape, j.in_short[1:]))}</p>"
            for j in self.evaluations
        )

    def plot(self) -> Figure:
        """Return a matplotlib figure: free energy over φ and ψ of reference, replicate and each candidate, a row a
        residue; where there is no backbone, its torsions' histograms."""
        from surrogate.comparison.report.figures import overview

        return overview([(j.summary.label, j.charts) for j in self.evaluations], self.temperature_k)

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values of all but the movies; what is not finite becomes None."""
        return {name: jsonable(value) for name, value in vars(self).items() if name != "movies"}


class _Setting(NamedTuple):
    """What all candidates of a comparison have in common; `known`: all MD of the reference's simulation."""

    scene: Scene
    torsions: Backbone
    geometry: Geometry
    reference: Features
    replicate: Features
    options: Options
    temperature_k: float
    summary: Summary
    recipes: dict[int, Any]
    known: tuple[Features, ...]
    convergence: Convergence


def compare(
    reference: Ensemble,
    candidates: Sequence[Ensemble],
    replicate: Ensemble | None = None,
    *,
    options: Options | None = None,
) -> Comparison:
    """Evaluate each candidate against the reference, beside a replicate of equal length.

    All ensembles must hold the atoms of the reference's scene in its order, or some of them, named in
    `Ensemble.kept`: then all are compared on the atoms that they share. Without a replicate the
    reference is cut in two halves, the second serving as the replicate of the first. Each candidate is evaluated by
    itself, at the longest length that it shares with reference and replicate: adding a candidate changes no other's
    numbers. Raises InputError when there is no candidate, atoms differ, or too few frames are left.
    """
    if not candidates:
        raise InputError("Nothing to compare with the reference: give at least one trajectory.")
    options = options or Options()
    whole = reference.scene
    everyone = [reference, *candidates, *([] if replicate is None else [replicate])]
    for ensemble in everyone:
        if ensemble.differences_kj_mol is not None:
            raise InputError(
                f"{ensemble.label} is MD under an umbrella potential: its frames do not count alike; compare other MD."
            )
    thinned, kept = alike(everyone)
    # Torsions and rings are found in the whole molecule; only hydrogens or side chains may be missing.
    stage = whole if kept is None else thinned[0].scene
    for ensemble in thinned:
        if ensemble.scene.elements != stage.elements:
            raise InputError(f"{ensemble.label}: its atoms are not those of {stage.name!r} in the same order.")
    n = len(candidates)
    ref, rolled, rep = thinned[0], thinned[1 : 1 + n], None if replicate is None else thinned[-1]
    for ensemble in (ref,) if rep is None else (ref, rep):
        _topology_note(ensemble, stage, refuse=True)
    baseline = Baseline.of(ref, parent=whole, kept=kept)
    n_angles = len(baseline.torsions.phi) + len(baseline.torsions.psi)
    n_rows = _ROWS_FORESEEN + 8 * min(n_angles, 2 * FEW_RESIDUES)
    options = replace(options, n_permutations=max(options.n_permutations, 50 * n_rows))
    measured = [baseline.measure(e) for e in thinned]
    notes = [note for e in thinned for note in e.notes]
    notes += [note for e in rolled if (note := _topology_note(e, stage, refuse=False))]
    notes += [note for features in measured for note in _jump_notes(features)]
    known = (measured[0],) if rep is None else (measured[0], measured[-1])
    convergence = convergence_of(known, baseline.torsions, seed=options.seed)
    if not convergence.converged:
        remedy = convergence.remedy
        notes.append(f"The reference is {convergence.verdict} {remedy[:1].upper()}{remedy[1:]}.")
    notes += _start_notes(measured[1 : 1 + n], baseline.torsions, options.seed)
    first, second = known[0], known[-1]
    if rep is None:
        half = first.n_frames // 2
        second = replace(first.frames(half, 2 * half), label=f"{first.label} (second half)")
        first = replace(first.frames(0, half), label=f"{first.label} (first half)")
        notes.append(
            f"No replicate was given: the reference is cut in two halves of {first.length_words}; the "
            "candidates are compared with the first, and the second is the replicate."
        )
    temperature_k = reference.record.get("temperature_k")
    if not isinstance(temperature_k, (int, float)):
        temperature_k = 300.0
        notes.append("The reference does not state its temperature; free energies are drawn for 300 K.")
    notes += _other_conditions(reference, everyone[1:])
    summaries = [summary_of(e) for e in everyone]
    setting = _Setting(
        stage, baseline.torsions, baseline.geometry, first, second, options, float(temperature_k), summaries[0], {},
        known, convergence,
    )  # fmt: skip
    own = list(zip(measured[1 : 1 + n], summaries[1 : 1 + n], rolled, strict=True))
    known_turned = any(_is_turned(e) for e in (ref, rep) if e is not None)
    evaluations = tuple(_evaluate(setting, m, summary, known_turned or _is_turned(e)) for m, summary, e in own)
    notes += [f"Validity check left out: {x}." for x in baseline.geometry.excluded]
    return Comparison(
        scene_name=stage.name,
        formula=stage.formula,
        n_atoms=stage.n_atoms,
        temperature_k=float(temperature_k),
        lag_ps=ref.lag_ps,
        reference=summaries[0],
        replicate=None if replicate is None else summaries[-1],
        evaluations=evaluations,
        notes=tuple(dict.fromkeys(notes)),
        options=options,
        versions=_versions(),
        convergence=convergence,
        movies=tuple(
            make_movie(ref, e, measured[0], features, evaluation.n_frames)
            for (features, _, e), evaluation in zip(own, evaluations, strict=True)
        ),
    )


def _start_notes(candidates: Sequence[Features], torsions: Backbone, seed: int) -> list[str]:
    """Return a line on each candidate of several replicas that still depends on where these started."""
    several = [c for c in candidates if len(c.segment_lengths) > 1]
    tested = [(c.label, convergence_of([c], torsions, seed=seed)) for c in several]
    return [f"{label} itself is {found.verdict}" for label, found in tested if found.n_replicas and not found.converged]


def _is_turned(ensemble: Ensemble) -> bool:
    return bool(ensemble.record.get("torsion_moves"))


def _evaluate(setting: _Setting, candidate: Features, summary: Summary, turned: bool) -> Evaluation:
    """Evaluate one candidate; `summary`: what its file says of it. `turned`: torsions were, by Monte Carlo, here or in
    the reference, so that no kinetics are compared."""
    inputs, correlation, own = _equal_terms(setting, candidate)
    reference, replicate, options = setting.reference, setting.replicate, setting.options
    metrics = [m for m in METRICS if not (turned and m.kind == "kinetics")]
    found_rows, charts, skipped = measure_all(metrics, inputs)
    if turned:
        skipped = [*skipped, ("Kinetics", "torsions were turned by Monte Carlo moves")]
    n_compared = round(inputs.compared_ps / inputs.lag_ps)
    left_open = explain(setting.known, candidate, setting.torsions, setting.convergence, seed=options.seed)
    if effective_samples(n_compared, correlation) < verdict.LEAST_FOR_TESTS or left_open.why:
        found_rows = verdict.untested(found_rows, start=bool(left_open.why))
    rows = verdict.evaluated_rows(by_group([*found_rows, *(x.row() for x in left_open.excess)]))
    found = verdict.findings(rows)
    slowest = max(correlation, own)
    cautions = verdict.cautions_of(inputs, slowest, left_open.in_words(setting.convergence))
    status = verdict.status(rows, cautions)
    # A reference that may be elsewhere than MD ends gives no equivalent MD time.
    times = () if left_open.why else equivalent_times(reference, candidate, replicate, setting.torsions, options.seed)
    times = tuple(each for each in times if not (turned and each.kind == "kinetics"))
    known = effective_samples(min(reference.n_frames, replicate.n_frames), correlation)
    words = ""
    if status != "broken" and not (cautions.apart or cautions.copied) and known >= verdict.LEAST_FOR_EQUIVALENT_TIME:
        words = headline(
            times, lambda w: cost_ratio(w.equivalent_ps, w.share, summary, setting.summary), summary.total_ps
        )
    shortest = min((s.features for s in inputs.samples), key=lambda f: f.total_ps)
    said = verdict.sentence(rows, found, shortest.length_words, cautions)
    faults = [_faults_of(s, setting.geometry) for s in inputs.samples]
    blocks, md_speed = inputs.reference.blocks, setting.summary.ns_per_day
    return Evaluation(
        summary=summary,
        status=status,
        verdict=f"{said} {words}".rstrip(),
        findings=found,
        rows=rows,
        compared_ps=inputs.compared_ps,
        n_frames=min(s.features.n_frames for s in inputs.samples),
        block_ps=blocks.n_frames_each * inputs.lag_ps,
        n_blocks=blocks.n_blocks,
        effective_samples=effective_samples(n_compared, slowest),
        speed_ratio=None if summary.ns_per_day is None or md_speed is None else summary.ns_per_day / md_speed,
        faults=(faults[0], faults[1], faults[2]),
        skipped=tuple(skipped),
        notes=(
            *_trimming(inputs, reference, candidate, replicate),
            *(["Equivalent MD time is withheld: it takes a converged reference."] if left_open.why else []),
            *verdict.unlike(rows),
            *copied_from(inputs)[1],
        ),
        charts=(*equivalent_time_charts(times), *charts),
        equivalent_time=times,
        equivalent_time_words=words,
        left_open=left_open,
        in_short=verdict.in_short(rows, status, found, cautions, words),
    )


def _equal_terms(setting: _Setting, candidate: Features) -> tuple[ComparisonInput, float, float]:
    """Divide all three into blocks of one length, of which the first of each are as long as the shortest of the three,
    and keep at most `_MOST_TIMES_AS_LONG` times that length; return them, and in frames the slowest time of the
    reference and that of the candidate."""
    reference, replicate, torsions = setting.reference, setting.replicate, setting.torsions
    n = min(reference.n_frames, candidate.n_frames, replicate.n_frames)
    if n < _MIN_FRAMES:
        raise InputError(
            f"{candidate.label}: only {n} frames can be compared at equal length; at least {_MIN_FRAMES} are needed "
            "(without a replicate the reference counts half)."
        )
    cut = [f.frames(0, min(f.n_frames, _MOST_TIMES_AS_LONG * n)) for f in (reference, candidate, replicate)]
    # A candidate that never leaves a state must not make the reference's own motion look slow, hence two times.
    slowest = longest_correlation(cut[0], cut[2])
    own = longest_correlation(cut[1])
    each = block_length(n, max(slowest, own))
    options = setting.options
    samples = [make_sample(f, make_blocks(f.segment_lengths, each), options, stream, n) for stream, f in enumerate(cut)]
    inputs = ComparisonInput(
        setting.scene, torsions, setting.geometry, samples[0], samples[1], samples[2], options, setting.temperature_k,
        setting.recipes,
    )  # fmt: skip
    return inputs, slowest, own


def _trimming(inputs: ComparisonInput, *trajectories: Features) -> list[str]:
    """Return which trajectories are longer than the equal length at which distances are taken."""
    return [
        f"{f.label}: the first {f.frames(0, round(inputs.compared_ps / f.lag_ps)).length_words} of {f.length_words} "
        f"are used for the distances, at equal length; {_tested(f, s)} for the tests."
        for f, s in zip(trajectories, inputs.samples, strict=True)
        if f.total_ps > inputs.compared_ps
    ]


def _tested(whole: Features, sample: Sample) -> str:
    n = sample.features.n_frames
    return "all of it" if n == whole.n_frames else f"the first {sample.features.length_words}"


def _other_conditions(reference: Ensemble, others: Sequence[Ensemble]) -> list[str]:
    """Return which trajectories were made under other conditions than the reference, where both say so."""
    said = []
    for other in others:
        for key, name in (
            ("force_field", "force field"),
            ("solvent", "solvent"),
            ("temperature_k", "temperature in K"),
        ):
            own, ref = other.record.get(key), reference.record.get(key)
            if own is not None and ref is not None and own != ref:
                said.append(f"{other.label} was made at another {name} than the reference: {own}, not {ref}.")
    return said


def _topology_note(ensemble: Ensemble, scene: Scene, *, refuse: bool) -> str:
    """Return which bonds are longer, in the median of some frames, than any bond between such elements is; empty where
    none is. Raises InputError, where asked to `refuse`, for so many that the topology cannot fit."""
    frames = ensemble.sample(_FRAMES_FOR_BONDS)
    if scene.interactions is not None or not len(scene.bonds) or not len(frames):
        return ""
    i, j = scene.bonds.T
    length = np.median(np.linalg.norm(frames[:, i] - frames[:, j], axis=-1), axis=0)
    try:
        radii = np.array([covalent_radius_nm(e) for e in scene.elements])
    except KeyError:  # virtual sites have no size
        return ""
    long = np.flatnonzero(length > _LONGEST_BOND * (radii[i] + radii[j]))
    if not len(long):
        return ""
    worst = int(long[np.argmax(length[long])])
    name = bond_label(scene, int(i[worst]), int(j[worst]))
    such_as = f"{name} at {10 * length[worst]:.2g} Å"
    said = f"{ensemble.label}: {len(long)} of {len(length)} bonds are too long to be bonds, e.g. {such_as}"
    if refuse and len(long) >= max(_REFUSED[0], _REFUSED[1] * len(length)):
        raise InputError(
            f"{said}. The topology does not fit the coordinates, whose atoms are in another order; name the one that "
            "belongs to them with `top`."
        )
    return f"{said}; does its topology fit its coordinates?"


def _jump_notes(features: Features) -> list[str]:
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


def _versions() -> dict[str, str]:
    found = {}
    for package in ("surromd", "numpy", "scipy", "deeptime"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def _faults_of(sample: Sample, geometry: Geometry) -> Faults:
    """Count the flags of the frames of one sample, of those checks that the geometry has something for; the first
    invalid frame by its time in its segment."""
    features, nothing = sample.features, unchecked(geometry)
    flags = np.concatenate(list(features.flags))
    masks = [check.mask for check in CHECKS if check.mask not in nothing]
    counts = {validity.flag_names(mask)[0]: int(((flags & mask) != 0).sum()) for mask in masks}
    invalid = [(f & validity.INVALID) != 0 for f in features.flags]
    first_ps = min((int(np.argmax(f)) * features.lag_ps for f in invalid if f.any()), default=None)
    return Faults(len(flags), counts, sum(int(f.sum()) for f in invalid), first_ps)


def summary_of(ensemble: Ensemble) -> Summary:
    """Return what `ensemble` says of itself; simulated time and wall seconds are those of the whole input."""
    record = ensemble.record
    cost = record.get("cost")
    cost = dict(cost) if isinstance(cost, dict) else {}
    wall = cost.get("wall_s")
    wall_s = float(wall) if isinstance(wall, (int, float)) and wall > 0 else None
    return Summary(
        label=ensemble.label,
        sources=ensemble.sources,
        top=ensemble.top,
        stated_lag_ps=ensemble.stated_lag_ps,
        n_segments=len(ensemble.segments),
        n_frames=ensemble.n_frames,
        lag_ps=ensemble.lag_ps,
        total_ps=ensemble.total_ps,
        settings={k: v for k, v in record.items() if k != "cost" and isinstance(v, (str, int, float, bool))},
        wall_s=wall_s,
        ns_per_day=None if wall_s is None else ensemble.total_ps * 1e-3 * 86_400.0 / wall_s,
        cost=cost,
        length=ensemble.length_words,
    )


def cost_ratio(equivalent_ps: float, share: float, candidate: Summary, reference: Summary) -> float | None:
    """Return the wall time of `equivalent_ps` of the reference's MD over that of a share of the candidate, or None."""
    if candidate.wall_s is None or reference.wall_s is None:
        return None
    return equivalent_ps / reference.total_ps * reference.wall_s / (share * candidate.wall_s)
