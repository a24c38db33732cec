"""The comparison: reference, replicate and candidates in; a frozen value with rows, curves and a verdict out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surrogate.comparison import input_notes, verdict
from surrogate.comparison.convergence import NOTHING_OPEN, Convergence, Explained, convergence_of, explain
from surrogate.comparison.equivalent_time import EquivalentTime, equivalent_time_charts, headline
from surrogate.comparison.equivalent_time_measures import equivalent_times
from surrogate.comparison.input_notes import bonds_that_are_none, copied_from, jumps, refuse_wrong_topology
from surrogate.comparison.measure.movie import Movie, make_movie
from surrogate.comparison.measure.slow_motion import longest_correlation
from surrogate.comparison.measure.statistics import block_length, effective_samples, make_blocks
from surrogate.comparison.measure.structure import Backbone, Baseline, Features, first_invalid_ps
from surrogate.comparison.metrics import METRICS, measure_all
from surrogate.comparison.read.ensemble import Ensemble, alike
from surrogate.comparison.rows.charts import Chart, jsonable
from surrogate.comparison.rows.rows import ComparisonInput, Options, Row, Sample, by_group, make_sample
from surrogate.comparison.rows.torsion_rows import FEW_RESIDUES
from surrogate.comparison.rows.validity_rows import (
    EnergyFn,
    applicable_checks,
    measure_energies,
    places_in_chunk,
)
from surrogate.comparison.verdict import in_short
from systems.chemistry import validity
from systems.chemistry.validity import Geometry
from systems.errors import InputError
from systems.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Frames whose bonds tell whether a topology fits.
_FRAMES_FOR_BONDS = 20
_MIN_FRAMES = 20
# Holm's correction for so many rows must leave the least p-value of a permutation test below 5 %.
_ROWS_FORESEEN = 60
_MOST_TIMES_AS_LONG = 20


@dataclass(frozen=True)
class Summary:
    """What one trajectory is: where from, how long, how it was made, what it cost.

    `top` and `stated_lag_ps` are what the user said of the files; `total_ps`, `n_frames` are of the whole input;
    `length` says it as what it is ('32 replicas of 3.8 ns'); `ns_per_day` and `wall_s` are None where its record holds
    no cost.
    """

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
    """How many of the compared frames carry each validity flag, when the first invalid one comes, and how many chunks
    they were made in."""

    label: str
    n_frames: int
    counts: dict[str, int]
    n_invalid: int
    first_invalid_ps: float | None
    n_chunks: int = 0


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One candidate against the reference: rows with a word each, what is wrong (worst first), and the verdict.

    `compared_ps` and `n_frames` are the equal length of all three; `block_ps` and `n_blocks` (of the reference) stand
    behind the error bars; `correlation_ps` is the integrated autocorrelation time of the slowest motion in reference
    and replicate; `effective_samples` are the independent ones that the equal length holds of the slowest motion of any
    of the three; `speed_ratio` is simulated time per wall second over the reference's.
    `worth` says by each measure how much MD the whole candidate is worth, and `equivalent_time_words` says it in a
    sentence (empty where it cannot be told, or frames are broken, or the reference still depends on where it started).
    `left_open`: what the reference's start or length leaves open; `in_short`: use it or not, for what, why.
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
    correlation_ps: float
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
        from html import escape

        return "".join(
            f"<p><b>{escape(j.summary.label)}: {escape(j.in_short[0])}</b><br>"
            f"{'<br>'.join(map(escape, j.in_short[1:]))}</p>"
            for j in self.evaluations
        )

    def plot(self) -> Figure:
        """Return a matplotlib figure: free energy over φ and ψ of reference, replicate and each candidate, a row a
        residue; where there is no backbone, its torsions' histograms."""
        from surrogate.comparison.report.overview import overview

        return overview([(j.summary.label, j.charts) for j in self.evaluations], self.temperature_k)

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values of all but the movies; what is not finite becomes None."""
        return {name: jsonable(value) for name, value in vars(self).items() if name != "movies"}


def compare(
    reference: Ensemble,
    candidates: Sequence[Ensemble],
    replicate: Ensemble | None = None,
    scene: Scene | None = None,
    *,
    options: Options | None = None,
    energy_fn: EnergyFn | None = None,
) -> Comparison:
    """Evaluate each candidate against the reference, beside a replicate of equal length.

    All ensembles must hold the atoms of `scene` (the reference's by default) in its order, or some of them, named in
    `Ensemble.kept`: then all are compared on the atoms that they share. Without a replicate the
    reference is cut in two halves, the second serving as the replicate of the first. Each candidate is evaluated by
    itself, at the longest length that it shares with reference and replicate: adding a candidate changes no other's
    numbers. `energy_fn(positions_nm)` gives the potential energy in kJ/mol of one frame of the reference's atoms; every
    k-th frame is then evaluated by it, where no atoms are missing. Raises InputError when there is no candidate, atoms
    differ, or too few frames are left.
    """
    if not candidates:
        raise InputError("Nothing to compare with the reference: give at least one trajectory.")
    chosen = options or Options()
    stage = scene or reference.scene
    everyone = [reference, *candidates, *([] if replicate is None else [replicate])]
    thinned, kept = alike(everyone)
    # Torsions and rings are found in the whole molecule; only hydrogens or side chains may be missing.
    whole, stage = stage, stage if kept is None else thinned[0].scene
    for ensemble in thinned:
        if ensemble.scene.elements != stage.elements:
            raise InputError(f"{ensemble.label}: its atoms are not those of {stage.name!r} in the same order.")
    replicate_baseline = None if replicate is None else thinned[-1]
    for ensemble in thinned[:1] if replicate_baseline is None else (thinned[0], replicate_baseline):
        refuse_wrong_topology(ensemble.label, stage, ensemble.sample(_FRAMES_FOR_BONDS))
    baseline = Baseline.of(thinned[0], parent=whole, kept=kept)
    measured = [baseline.measure(e) for e in thinned]
    if energy_fn is not None and kept is None:
        measured = [
            replace(m, energy_kj=measure_energies(e, energy_fn)) for m, e in zip(measured, thinned, strict=True)
        ]
    notes = [note for e in thinned for note in e.notes]
    for rolled in thinned[1 : 1 + len(candidates)]:
        long, said = bonds_that_are_none(stage, rolled.sample(_FRAMES_FOR_BONDS))
        notes += [f"{rolled.label}: {said}; does its topology fit its coordinates?"] if long else []
    notes += jumps(measured)
    ref = measured[0]
    known = (ref,) if replicate is None else (ref, measured[-1])
    convergence = convergence_of(known, baseline.torsions, seed=chosen.seed)
    if not convergence.converged:
        remedy = convergence.remedy
        notes.append(f"The reference is {convergence.verdict} {remedy[:1].upper()}{remedy[1:]}.")
    if replicate is None:
        half = ref.n_frames // 2
        other = replace(ref.frames(half, 2 * half), label=f"{ref.label} (second half)")
        ref = replace(ref.frames(0, half), label=f"{ref.label} (first half)")
        notes.append(
            f"No replicate was given: the reference is cut in two halves of {ref.length_words}; the "
            "candidates are compared with the first, and the second is the replicate."
        )
    else:
        other = measured[-1]
    temperature = reference.record.get("temperature_k")
    if not isinstance(temperature, (int, float)):
        temperature = 300.0
        notes.append("The reference does not state its temperature; free energies are drawn for 300 K.")
    summaries = [summary_of(e) for e in everyone]
    setting = _Setting(
        stage,
        baseline.torsions,
        baseline.geometry,
        ref,
        other,
        chosen,
        float(temperature),
        summaries[0],
        {},
        known,
        convergence,
    )
    evaluations = tuple(
        _comparison(setting, features, summary, (thinned[0], rolled, replicate_baseline))
        for features, summary, rolled in zip(
            measured[1:], summaries[1:], thinned[1 : 1 + len(candidates)], strict=False
        )
    )
    notes += [f"Validity check left out: {x}." for x in baseline.geometry.excluded]
    return Comparison(
        scene_name=stage.name,
        formula=stage.formula,
        n_atoms=stage.n_atoms,
        temperature_k=float(temperature),
        lag_ps=thinned[0].lag_ps,
        reference=summaries[0],
        replicate=None if replicate is None else summaries[-1],
        evaluations=evaluations,
        notes=tuple(dict.fromkeys(notes)),
        options=chosen,
        versions=_versions(),
        convergence=convergence,
        movies=tuple(
            make_movie(thinned[0], rolled, measured[0], features, evaluation.n_frames)
            for rolled, features, evaluation in zip(thinned[1:], measured[1:], evaluations, strict=False)
        ),
    )


class _Setting(NamedTuple):
    """What all candidates of a comparison have in common."""

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


def _comparison(
    setting: _Setting, candidate: Features, summary: Summary, trajectories: tuple[Ensemble, Ensemble, Ensemble | None]
) -> Evaluation:
    """Evaluate one candidate; `summary`: what its file says of it; `trajectories`: see `ComparisonInput`."""
    inputs, correlation, own = _equal_terms(setting, candidate)
    inputs = replace(inputs, trajectories=trajectories)
    reference, replicate, options = setting.reference, setting.replicate, setting.options
    found_rows, charts, skipped = measure_all(METRICS, inputs)
    n_compared = round(inputs.compared_ps / inputs.reference.features.lag_ps)
    samples = effective_samples(n_compared, correlation)
    every = list(found_rows)
    left_open = explain(setting.known, candidate, setting.torsions, setting.convergence, seed=options.seed)
    if samples < input_notes.LEAST_FOR_TESTS or left_open.why:
        every = verdict.untested(every, start=bool(left_open.why))
    every = by_group([*every, *(x.row() for x in left_open.excess)])
    evaluated = verdict.evaluated_rows(every, options)
    found = verdict.findings(evaluated)
    ref = inputs.reference
    cautions = input_notes.cautions(inputs, max(correlation, own), left_open.in_words(setting.convergence))
    kind = verdict.status(evaluated, cautions)
    # By a reference that may be elsewhere than MD ends, nothing is worth a length of MD.
    equivalent_time = (
        () if left_open.why else equivalent_times(reference, candidate, replicate, setting.torsions, options)
    )
    words = ""
    shortest = min((s.features for s in inputs.samples), key=lambda f: f.total_ps)
    known = effective_samples(min(reference.n_frames, replicate.n_frames), correlation)
    if (
        equivalent_time
        and kind != "broken"
        and not (cautions.apart or cautions.copied)
        and known >= input_notes.LEAST_FOR_EQUIVALENT_TIME
    ):
        words = _equivalent_time_words(equivalent_time, summary, setting.summary)
    return Evaluation(
        summary=summary,
        status=kind,
        verdict=" ".join(
            [verdict.sentence(evaluated, found, shortest.length_words, cautions), *([words] if words else [])]
        ),
        findings=found,
        rows=evaluated,
        compared_ps=inputs.compared_ps,
        n_frames=min(s.features.n_frames for s in inputs.samples),
        block_ps=ref.blocks.n_frames_each * ref.features.lag_ps,
        n_blocks=ref.blocks.n_blocks,
        correlation_ps=correlation * ref.features.lag_ps,
        effective_samples=effective_samples(n_compared, max(correlation, own)),
        speed_ratio=speed_ratio(summary, setting.summary),
        faults=(
            faults_of(inputs.reference, setting.geometry),
            faults_of(inputs.candidate, setting.geometry),
            faults_of(inputs.replicate, setting.geometry),
        ),
        skipped=(*input_notes.skipped(inputs), *skipped),
        notes=tuple(
            input_notes.trimming(inputs, reference, candidate, replicate)
            + (["Equivalent MD time is withheld: it takes a converged reference."] * bool(left_open.why))
            + input_notes.unlike(evaluated, options)
            + copied_from(inputs)[1]
        ),
        charts=(*equivalent_time_charts(equivalent_time), *charts),
        equivalent_time=equivalent_time,
        equivalent_time_words=words,
        left_open=left_open,
        in_short=in_short(evaluated, kind, found, cautions, words),
    )


def _equal_terms(setting: _Setting, candidate: Features) -> tuple[ComparisonInput, float, float]:
    """Divide all three into blocks of one length, of which the first of each are as long as the shortest of the three;
    return them, and in frames the slowest time of the reference and that of the candidate.

    All of a longer reference takes part in the tests, up to `_MOST_TIMES_AS_LONG` times the candidate's length.
    """
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
    n_rows = _ROWS_FORESEEN + 8 * min(len(torsions.phi) + len(torsions.psi), 2 * FEW_RESIDUES)
    options = replace(setting.options, n_permutations=max(setting.options.n_permutations, 50 * n_rows))
    ref, rolled, other = (
        make_sample(f, make_blocks(f.segment_lengths, each), options, stream, n) for stream, f in enumerate(cut)
    )
    inputs = ComparisonInput(
        setting.scene, torsions, setting.geometry, ref, rolled, other, options, setting.temperature_k, setting.recipes
    )
    return inputs, slowest, own


def _equivalent_time_words(found: Sequence[EquivalentTime], summary: Summary, reference: Summary) -> str:
    return headline(found, lambda w: cost_ratio(w.equivalent_ps, w.share, summary, reference), summary.total_ps)


def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    found = {}
    for package in ("surromd", "numpy", "scipy", "deeptime"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def faults_of(sample: Sample, geometry: Geometry) -> Faults:
    """Count the flags of the frames of one sample, of those checks that the geometry has something for."""
    features = sample.features
    flags = np.concatenate(list(features.flags))
    counts = {validity.flag_names(c.mask)[0]: int(((flags & c.mask) != 0).sum()) for c in applicable_checks(geometry)}
    return Faults(
        features.label,
        len(flags),
        counts,
        int(((flags & validity.INVALID) != 0).sum()),
        first_invalid_ps(features, validity.INVALID),
        int((places_in_chunk(features) == 0).sum()),
    )


def summary_of(ensemble: Ensemble) -> Summary:
    """Return what `ensemble` says of itself; simulated time and wall seconds are those of the whole input."""
    record = ensemble.record
    cost = record.get("cost") if isinstance(record.get("cost"), dict) else {}
    assert isinstance(cost, dict)
    wall = cost.get("wall_s")
    wall_s = float(wall) if isinstance(wall, (int, float)) and wall > 0 else None
    settings = {k: v for k, v in record.items() if k != "cost" and isinstance(v, (str, int, float, bool))}
    return Summary(
        label=ensemble.label,
        sources=ensemble.sources,
        top=ensemble.top,
        stated_lag_ps=ensemble.stated_lag_ps,
        n_segments=len(ensemble.segments),
        n_frames=ensemble.n_frames,
        lag_ps=ensemble.lag_ps,
        total_ps=ensemble.total_ps,
        settings=settings,
        wall_s=wall_s,
        ns_per_day=None if wall_s is None else ensemble.total_ps * 1e-3 * 86_400.0 / wall_s,
        cost=dict(cost),
        length=ensemble.length_words,
    )


def speed_ratio(candidate: Summary, reference: Summary) -> float | None:
    """Return simulated time per wall second over the reference's; None when one of the two holds no cost."""
    if candidate.ns_per_day is None or reference.ns_per_day is None:
        return None
    return candidate.ns_per_day / reference.ns_per_day


def cost_ratio(equivalent_ps: float, share: float, candidate: Summary, reference: Summary) -> float | None:
    """Return the wall time of `equivalent_ps` of the reference's MD over that of a share of the candidate, or None."""
    if candidate.wall_s is None or reference.wall_s is None:
        return None
    return equivalent_ps / reference.total_ps * reference.wall_s / (share * candidate.wall_s)
