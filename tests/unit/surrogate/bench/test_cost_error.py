"""Run time against error: errors of rollouts whose equivalent MD time is known, what it refuses, the whole on tiny
weights."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compare_speed import pose, torsion_path
from typer.testing import CliRunner

from surrogate.bench.cost_error import (
    HeldOut,
    Setting,
    choose_settings,
    compare_frames,
    compare_reference,
    effective_row,
    equivalent_time_row,
    markdown,
    read_reference,
    refuse_trained_on,
    run_cost_error,
    samples_per_second,
    slowest_torsion,
)
from surrogate.cli import main
from surrogate.data import collect_frames
from surrogate.models.architecture import weights_path
from surrogate.models.weights import Weights, load_weights, save_weights
from surrogate.verbs.options import CostErrorConfig, Sweep
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import open_writer

CONDITIONS = {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0, "friction_per_ps": 1.0,
              "hydrogen_mass_da": 3.0}  # fmt: skip
N_FRAMES = 6_000


def toy_frames(scene: Scene, seed: int, n_frames: int = N_FRAMES) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return pose(scene, torsion_path(n_frames, rng), rng)


def write(path: Path, scene: Scene, frames: np.ndarray, **record: Any) -> Path:
    with open_writer(path, scene, {**CONDITIONS, **record}) as writer:
        writer.append(frames, 1.0 + np.arange(len(frames), dtype=np.float64))
    return path


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory, alanine_dipeptide: Scene) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("held")
    first, second = (write(folder / f"held_r{k}.h5", alanine_dipeptide, toy_frames(alanine_dipeptide, k), seed=40 + k)
                     for k in range(2))  # fmt: skip
    return first, second


@pytest.fixture(scope="module")
def reference(held: tuple[Path, Path], alanine_dipeptide: Scene) -> HeldOut:
    return read_reference(alanine_dipeptide, held[:1], held[1:])


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory, small_weights: Weights) -> Weights:
    """The small ones, for the conditions of the toy's files."""
    out = tmp_path_factory.mktemp("cost") / "tiny.safetensors"
    domain = replace(small_weights.domain, conditions=CONDITIONS)
    save_weights(out, small_weights.model, domain, {"sources": [], "from": {"sources": [{"file": "a.h5", "seed": 7}]}})
    return load_weights(out)


def test_a_true_rollout_is_equivalent_to_its_length_and_a_wrong_one_to_little(
    reference: HeldOut, alanine_dipeptide: Scene
) -> None:
    frames = toy_frames(alanine_dipeptide, 9, 3_000).astype(np.float64)
    right, equivalent_time = compare_frames(frames.reshape(3, 1_000, 22, 3), reference)
    assert equivalent_time.equivalent_ps == pytest.approx(3_000, rel=0.4)
    assert right["jsd"]["low"] < right["jsd"]["value"] < right["jsd"]["high"]
    assert right["valid_half_angstrom_%"]["value"] == 100.0
    of_md = compare_reference(reference)
    for key in ("correlation", "relaxation_ps"):
        assert right[key]["value"] == pytest.approx(of_md[key][0]["value"], rel=0.15), key
    assert (
        of_md["replicate_baseline"] == of_md["errors"][-1] < of_md["errors"][0] and of_md["lengths_ps"][-1] == N_FRAMES
    )
    # Negative controls: one state alone; frames in another order; a tenth of the frames torn.
    stuck, equivalent_time = compare_frames(np.repeat(frames[None, :10], 300, axis=1), reference)
    assert stuck["jsd"]["value"] > 3 * right["jsd"]["value"] and equivalent_time.bound == "less than"
    shuffled, _ = compare_frames(np.random.default_rng(0).permutation(frames)[None], reference)
    assert shuffled["jsd"]["value"] == pytest.approx(right["jsd"]["value"], abs=1e-9)
    assert shuffled["relaxation_ps"]["value"] < 0.2 * right["relaxation_ps"]["value"]
    torn = frames.copy()
    torn[::10, 0] += 0.2
    lost, equivalent_time = compare_frames(np.full_like(frames[None], np.nan), reference)
    assert equivalent_time.bound == "less than" and lost["correlation"]["value"] is None
    assert lost["jsd"]["value"] == pytest.approx(math.sqrt(math.log(2)), abs=1e-6)
    broken, _ = compare_frames(torn[None], reference)
    assert broken["valid_half_angstrom_%"]["value"] == pytest.approx(90.0)


def test_equivalent_time_is_turned_into_seconds_and_never_beyond_the_replicate_baseline(
    reference: HeldOut, alanine_dipeptide: Scene
) -> None:
    _, equivalent_time = compare_frames(toy_frames(alanine_dipeptide, 5, 3_000)[None].astype(np.float64), reference)
    row = equivalent_time_row(equivalent_time, spent_s=2.0, md_s_per_ns=8.0)
    assert row["times_faster"] == pytest.approx(1e-3 * equivalent_time.equivalent_ps * 8.0 / 2.0)
    # 2 s are a quarter of a ns of MD.
    assert row["md_of_same_seconds"] == pytest.approx(equivalent_time.error_at(250 / N_FRAMES))
    assert equivalent_time_row(equivalent_time, 2e-4, 8.0)["md_of_same_seconds"] is None
    perfect = replace(
        equivalent_time, equivalent_ps=equivalent_time.lengths_ps[-1], bound="at least", low_ps=None, high_ps=None
    )
    row = equivalent_time_row(perfect, 2.0, 8.0)
    assert row["times_faster"] == pytest.approx(1e-3 * N_FRAMES * 8.0 / 2.0) and row["times_faster_high"] is None
    assert row["equivalent_time"]["words"].startswith("at least")


def test_runs_that_were_trained_on_are_refused(
    tmp_path: Path, held: tuple[Path, Path], weights: Weights, alanine_dipeptide: Scene
) -> None:
    first, second = held
    prints = refuse_trained_on(weights, [first], [second])
    assert len(set(prints)) == 2
    # A part of a run that the weights began from, under another name: its seed tells.
    part = write(tmp_path / "part.h5", alanine_dipeptide, toy_frames(alanine_dipeptide, 3, 500), seed=7)
    with pytest.raises(InputError, match=r"trained on this run \(seed 7, then called a.h5\)"):
        refuse_trained_on(weights, [first], [part])
    # The same frames, whatever the file says of its seed.
    known = replace(weights, provenance={"sources": [{"file": "b.h5", "sha256": prints[1]}]})
    with pytest.raises(InputError, match=r"then called b\.h5"):
        refuse_trained_on(known, [first], [second])
    # The same frames, laid on another file's; and the same run, though the weights know other molecules, too.
    (source,) = collect_frames([second]).sources
    several = replace(weights.domain, further=(weights.domain,))
    for kept, domain in (
        ({"shape_sha256": source["shape_sha256"]}, weights.domain),
        ({"seed": source["seed"], "topology": source["topology"]}, several),
    ):
        known = replace(weights, domain=domain, provenance={"sources": [{"file": "b.h5", **kept}]})
        with pytest.raises(InputError, match=r"then called b\.h5"):
            refuse_trained_on(known, [first], [second])
    other = {"file": "b.h5", "seed": source["seed"], "topology": "another"}
    assert refuse_trained_on(replace(known, provenance={"sources": [other]}), [first], [second])
    copy = write(tmp_path / "copy.h5", alanine_dipeptide, toy_frames(alanine_dipeptide, 0)[1_000:2_000], seed=99)
    with pytest.raises(InputError, match="share motion"):
        refuse_trained_on(weights, [first], [copy])
    hot = [
        write(tmp_path / f"hot{k}.h5", alanine_dipeptide, toy_frames(alanine_dipeptide, k, 200), temperature_k=350.0)
        for k in (5, 6)
    ]
    with pytest.raises(InputError, match=r"has temperature_k 350\.0, .* was trained for 300\.0"):
        refuse_trained_on(weights, hot[:1], hot[1:])


def test_frames_further_apart_than_the_weights_step_are_compared_and_what_differs_is_said(
    held: tuple[Path, Path], weights: Weights
) -> None:
    """References every 10 ps: a multiple of the weights' step is compared, and nothing else."""
    lag_ps = weights.domain.lag_ps
    finer = replace(weights, domain=replace(weights.domain, lag_ps=0.1 * lag_ps))
    assert refuse_trained_on(finer, held[:1], held[1:]) == refuse_trained_on(weights, held[:1], held[1:])
    assert refuse_trained_on(weights, held[:1], held[1:], lag_ps=2 * lag_ps)
    coarser = replace(weights, domain=replace(weights.domain, lag_ps=3 * lag_ps))
    with pytest.raises(InputError, match="apart cannot be compared: steps of"):
        refuse_trained_on(coarser, held[:1], held[1:])
    assert refuse_trained_on(coarser, held[:1], held[1:], lag_ps=3 * lag_ps)
    with pytest.raises(InputError, match="apart cannot be compared: frames of"):
        refuse_trained_on(weights, held[:1], held[1:], lag_ps=1.5 * lag_ps)


def test_settings_are_combinations_of_what_is_asked(weights: Weights) -> None:
    usual = choose_settings(weights, Sweep())
    assert Setting("fitted", 4) in usual and len(set(usual)) == len(usual)
    assert not any(s.solver == "dopri5" for s in usual)
    sweep = Sweep(solvers=["dopri5"], steps=[2], precisions=["fp32"], batches=[1, 4])
    assert [s.label for s in choose_settings(weights, sweep)] == [
        "dopri5 2, fp32, batch 1",
        "dopri5 2, fp32, batch 4",
    ]
    with pytest.raises(InputError, match="knows no solver 'rk4'"):
        choose_settings(weights, Sweep(solvers=["rk4"]))


def test_a_whole_benchmark_is_written_and_gone_on_with(
    tmp_path: Path, held: tuple[Path, Path], weights: Weights
) -> None:
    config = CostErrorConfig(time_ps=900.0, discarded_ps=7.0, rounds=2, slice_ps=0.1)
    told: list[str] = []

    def run(*settings: Setting) -> dict[str, Any]:
        return run_cost_error([(weights, settings)], held[:1], held[1:], tmp_path, config, report=told.append)

    one = Setting("fitted", 2, "fp32")
    first = run(one)
    assert told == ["reading the references", "OpenMM", f"tiny: {one.label}"]
    (row,) = first["rows"]
    assert row["ns"] >= 0.9 and row["evaluations"] == 2.0 and row["bf16"] is False
    assert row["cpu_s_per_ns"]["least"] <= row["cpu_s_per_ns"]["mean"] <= row["cpu_s_per_ns"]["greatest"]
    assert row["spent_s"] == pytest.approx(row["ns"] * row["cpu_s_per_ns"]["mean"])
    assert row["effective_per_s"] == pytest.approx(
        1e3
        / row["cpu_s_per_ns"]["mean"]
        / (2 * max(row["slow_relaxation_ps"]["value"], first["md"]["slowest"]["tau_ps"]))
    )
    labels = ["OpenMM, 4 fs"] + ["MD by SIMD replicas, 4 fs"] * (shutil.which("g++") is not None)
    assert [cost["label"] for cost in first["md"]["cost"]] == labels
    # Gone on with: what is there is kept, word for word.
    told.clear()
    again = run(one, Setting("euler", 2, "fp32"))
    assert told == ["reading the references", "tiny: euler 2, fp32"] and again["rows"][:1] == first["rows"]
    assert json.loads((tmp_path / "cost_error.json").read_text()) == json.loads(json.dumps(again))
    text = (tmp_path / "cost_error.md").read_text()
    assert text == markdown(again) and "| fitted 2, fp32 |" in text and "4 fs" in text and "x MD |" in text
    with pytest.raises(InputError, match="other references, times or rounds"):
        run_cost_error([(weights, [one])], held[1:], held[:1], tmp_path, config)


def test_weights_that_know_lags_are_held_against_frames_as_far_apart(
    tmp_path: Path, reference: HeldOut, held: tuple[Path, Path], weights: Weights, alanine_dipeptide: Scene
) -> None:
    runs = [
        write(
            tmp_path / f"h{k}.h5", alanine_dipeptide, toy_frames(alanine_dipeptide, k), seed=50 + k, timestep_ps=0.004
        )
        for k in range(2)
    ]
    peptides = load_weights(weights_path("peptides"))
    chosen, told = [(peptides, [Setting("gaussian", 2, "fp32")])], Setting("gaussian", 2, "fp32").label
    config = CostErrorConfig(time_ps=900.0, discarded_ps=7.0, rounds=2, slice_ps=0.1, lag_ps=10.0)
    lines: list[str] = []
    found = run_cost_error(chosen, runs[:1], runs[1:], tmp_path / "a", config, report=lines.append)
    assert lines[-1] == f"peptides: {told}"
    (row,) = found["rows"]
    assert row["ns"] >= 5.0, "a chunk of 32 replicas has 16 frames 10 ps apart"
    of_neighbours = compare_reference(reference)["correlation"][0]["value"]
    assert found["md"]["correlation"][0]["value"] < of_neighbours - 0.1, "cos psi 10 ps later, not 1 ps"
    with pytest.raises(InputError, match="lags of 1 ps to 1 ns"):
        run_cost_error(chosen, runs[:1], runs[1:], tmp_path / "b", replace(config, lag_ps=5000.0))
    # Others roll as they do, and every tenth of their frames is compared.
    chosen = [(weights, [Setting("fitted", 2, "fp32")])]
    (row,) = run_cost_error(chosen, held[:1], held[1:], tmp_path / "c", config)["rows"]
    assert row["jsd"]["value"] > 0 and row["ns"] < 2.0


def test_weights_whose_atoms_stand_in_another_order_are_measured_beside_others(
    tmp_path: Path, weights: Weights, alanine_dipeptide: Scene
) -> None:
    runs = [
        write(
            tmp_path / f"h{k}.h5", alanine_dipeptide, toy_frames(alanine_dipeptide, k), seed=50 + k, timestep_ps=0.004
        )
        for k in range(2)
    ]
    tiny = tmp_path / "tiny.safetensors"
    domain = replace(weights.domain, conditions={**CONDITIONS, "timestep_ps": 0.004})
    save_weights(tiny, weights.model, domain, weights.provenance)
    config = CostErrorConfig(time_ps=900.0, discarded_ps=7.0, rounds=2, slice_ps=0.1, lag_ps=10.0)
    chosen = [(load_weights(weights_path("peptides")), [Setting("gaussian", 2, "fp32")]),
              (load_weights(tiny), [Setting("fitted", 2, "fp32")])]  # fmt: skip
    beside = run_cost_error(chosen, runs[:1], runs[1:], tmp_path / "both", config)["rows"]
    for row, one in zip(beside, chosen, strict=True):
        alone = run_cost_error([one], runs[:1], runs[1:], tmp_path / one[0].path.stem, config)["rows"][0]
        for key in ("jsd", "correlation"):
            assert row[key] == alone[key], "as if nothing else had been measured"


def test_the_verb_says_in_one_line_what_it_cannot_use(
    tmp_path: Path, held: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for arguments, said in (
        (["-w", "alanine-dipeptyde"], "Did you mean 'alanine-dipeptide'"),
        (["-w", "alanine-dipeptide", "--solver", "rk4"], "knows no solver 'rk4'"),
    ):
        result = CliRunner().invoke(main.app, ["bench", "cost-error", *map(str, held), *arguments, "-o", "x"])
        assert result.exit_code == 1 and said in result.stderr, result.output
        assert len(result.stderr.strip().splitlines()) == 1
        assert not list(tmp_path.iterdir())


# ---- effective samples ---------------------------------------------------------------------------------------------


def test_forgetting_too_fast_earns_nothing_and_too_slowly_costs() -> None:
    right = samples_per_second(2.0, 25.0, 25.0)
    assert right == pytest.approx(1e3 / 2.0 / 50.0)
    assert samples_per_second(2.0, 5.0, 25.0) == right
    assert samples_per_second(2.0, 50.0, 25.0) == pytest.approx(right / 2)
    assert samples_per_second(2.0, None, 25.0) is None and samples_per_second(2.0, float("nan"), 25.0) is None
    md = {"slowest": {"tau_ps": 25.0}, "cost": [
        {"way": way, "cpu_s_per_ns": {"mean": cost}} for way, cost in (("openmm", 8.0), ("simd", 0.5))
    ]}  # fmt: skip
    row: dict[str, Any] = {"cpu_s_per_ns": {"mean": 2.0}, "slow_relaxation_ps": {"value": 20.0}}
    assert effective_row(row, md)["effective_over_md"] == pytest.approx(4.0), "of OpenMM"
    assert effective_row(row, md | {"slowest": None}) == {}


def test_the_slowest_torsion_is_one_whose_time_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    taus = [4.0, 25.0, 900.0]

    class Value:
        def __init__(self, value: float) -> None:
            self.value = value

    class Fake:
        class features:
            total_ps = 10_000.0

    names = [("ψ", ""), ("", "χ of 3"), ("φ", "")]
    monkeypatch.setattr("surrogate.bench.cost_error.turning", lambda f: [(s, label, []) for s, label in names])
    monkeypatch.setattr("surrogate.bench.cost_error.relaxation_of", lambda sample, k: (Value(0.0), Value(taus[k])))
    found = slowest_torsion([Fake(), Fake()])  # type: ignore[list-item]
    assert found is not None and found["name"] == "cos χ of 3" and found["samples"] == pytest.approx(20_000 / 50)
    assert slowest_torsion([Fake()] * 40)["name"] == "cos φ", "with 222 of it at hand"  # type: ignore[list-item,index]
    taus[:] = [np.nan, 0.0, 900.0]
    assert slowest_torsion([Fake()]) is None  # type: ignore[list-item]
