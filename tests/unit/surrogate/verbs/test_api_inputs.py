"""What the Python calls take: texts with units for every quantity, paths as such, a single path for one candidate."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import surrogate as sm
from systems.errors import InputError, UnitError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.companion_writer import pdb_text
from systems.units import DIMENSIONS

VERBS: dict[str, tuple[Any, ...]] = {
    "plan": ("alanine-dipeptide",),
    "reference": ("alanine-dipeptide", "out.h5"),
    "rollout": ("alanine-dipeptide", "alanine-dipeptide", "out.h5"),
    "compare": ("ref.h5", "out.dcd"),
    "train": ("ref.h5", "w.safetensors"),
    "demo": ("folder",),
    "Simulation": ("alanine-dipeptide", "alanine-dipeptide"),
}
QUANTITIES = [
    (verb, name)
    for verb in VERBS
    for name in inspect.signature(getattr(sm, verb)).parameters
    if name.endswith(tuple(DIMENSIONS))
]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("verb", "name"), QUANTITIES)
def test_every_quantity_of_every_verb_is_read_with_its_unit(verb: str, name: str) -> None:
    needed = {"time_ps": "1ps"} if verb in ("reference", "rollout") else {}
    with pytest.raises(UnitError, match=f"{name} '1.5 parsec'"):
        getattr(sm, verb)(*VERBS[verb], **needed | {name: "1.5 parsec"})


def test_that_there_are_such_quantities() -> None:
    named = {name for _, name in QUANTITIES}
    assert {"time_ps", "save_every_ps", "lag_ps", "budget_s", "temperature_k", "friction_per_ps", "timestep_ps",
            "hydrogen_mass_da", "equilibrate_ps", "padding_nm", "ionic_strength_molar", "pressure_bar",
            "longest_lag_ps"} <= named  # fmt: skip


def test_a_reference_asked_for_in_texts_is_the_one_asked_for_in_numbers(here: Path) -> None:
    texts = sm.reference("harmonic-oscillator", "a.h5", time_ps="2ps", save_every_ps="100fs", temperature_k="310K",
                         friction_per_ps="2/ps", timestep_ps="10fs", equilibrate_ps="1ps", quiet=True)  # fmt: skip
    numbers = sm.reference("harmonic-oscillator", here / "b.h5", time_ps=2, save_every_ps=0.1, temperature_k=310,
                           friction_per_ps=2.0, timestep_ps=0.01, equilibrate_ps=1.0, quiet=True)  # fmt: skip
    records = []
    for path in (*texts, *numbers):
        with open_trajectory(path) as reader:
            records.append({key: reader.record[key] for key in ("time_ps", "save_every_ps", "temperature_k",
                                                                "friction_per_ps", "timestep_ps")})  # fmt: skip
            assert reader.n_frames == 20
    assert records[0] == records[1]


def _write(path: Path, scene: Scene, seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = scene.positions_nm + rng.normal(0.0, 0.002, (60, scene.n_atoms, 3))
    with open_writer(path, scene, {"temperature_k": 300.0}) as writer:
        writer.append(frames, np.arange(1.0, 61.0))


@pytest.mark.parametrize("as_path", [str, Path])
def test_a_single_path_is_one_candidate_and_no_other_file_is_read(
    here: Path, alanine_dipeptide: Scene, as_path: type
) -> None:
    _write(here / "ref.h5", alanine_dipeptide, 0)
    _write(here / "out.dcd", alanine_dipeptide, 1)
    # "." of out.dcd is the current folder, whose trajectories are others.
    _write(here / "other.h5", alanine_dipeptide, 2)
    result = sm.compare(as_path("ref.h5"), as_path("out.dcd"), labels="mine", dt_ps="1ps")
    assert [evaluation.summary.sources for evaluation in result.evaluations] == [("out.dcd",)]
    assert [evaluation.summary.label for evaluation in result.evaluations] == ["mine"]
    several = sm.compare("ref.h5", ["out.dcd", "other.h5"])
    assert [evaluation.summary.sources for evaluation in several.evaluations] == [("out.dcd",), ("other.h5",)]
    with pytest.raises(InputError, match=r"nothing\.dcd: no such file"):
        sm.compare("ref.h5", "nothing.dcd")


def test_a_scene_may_be_a_path(here: Path, alanine_dipeptide: Scene) -> None:
    (here / "mine.pdb").write_text(pdb_text(alanine_dipeptide))
    assert sm.plan(here / "mine.pdb", platform="Reference")["force_field"] == "ff14SB"


def test_what_is_no_scene_or_trajectory_is_refused_in_a_line(here: Path) -> None:
    for call in (lambda: sm.plan(None), lambda: sm.reference(object(), "a.h5", time_ps=1.0)):
        with pytest.raises(InputError, match="a scene is a file, a name"):
            call()
    with pytest.raises(InputError, match="a trajectory is a file, a folder"):
        sm.compare(object(), object())
