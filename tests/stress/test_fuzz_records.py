"""Records of strangers: every entry of the wrong type or size, missing, or too many; one line, never "a bug"."""

from __future__ import annotations

import copy
import json
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import pytest
from safetensors import safe_open
from safetensors.torch import load_file

from md_reference.campaign.campaign_file import read_campaign
from md_reference.campaign.manifest import campaign_trajectories, read_manifest, write_manifest
from md_reference.campaign.scheduler import check_same_campaign, new_manifest
from md_reference.campaign.worker import PreparedScene, load_prepared
from md_reference.forces.forcefield import ForceFieldSpec, build_system
from md_reference.run.simulate import MDConfig, simulate
from surrogate import api
from surrogate.cli.render import print_pairs
from surrogate.data import TrainingFrames, collect_frames, load_frames
from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.runner import RolloutConfig, rollout
from surrogate.training.loop import tensor_checksum
from surrogate.verbs.info import describe_file
from surrogate.verbs.simulate import describe_campaign
from systems.errors import InputError, SurromdError
from systems.files.whole_file import sealed
from systems.library.named_scenes import load
from systems.scene import Scene
from systems.trajectory.checkpoint import (
    checkpoint_path,
    new_header,
    read_checkpoint,
    supported_checkpoint,
    write_checkpoint,
)
from systems.trajectory.codec import open_trajectory
from systems.trajectory.store import json_text, set_text
from time_limits import time_limit

GONE, MORE = object(), object()
WRONG: tuple[Any, ...] = (GONE, MORE, None, "x", "", "a\0b", "\ud800", "../../x", 0, -1, 3, 2.5, 10**30, 1e308,
                          float("inf"), float("nan"), True, [], {}, [[1]], {"a": 1}, ["x"])  # fmt: skip
CAMPAIGN = {
    "name": "c", "out": "folder", "format": "h5", "seed": 3, "retries": 1, "replicas": 2,
    "temperatures": ["300K", 350], "time": "10ps", "save_every": "1ps", "timestep": "2fs", "platform": "Reference",
    "solvent": "vacuum", "hydrogen_mass": "natural", "constrain_hydrogens": True, "ph": 7, "padding_nm": 1.0,
    "scenes": [{"scene": "alanine-dipeptide", "name": "a", "replicas": 1, "keep_water": False}, "ethanol"],
}  # fmt: skip


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where something stands in a record: every key, and of lists the first entry."""
    if path:
        yield path
    inner = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    for key, entry in inner:
        yield from places(entry, (*path, key))


def altered(record: Any, place: tuple[Any, ...], value: Any) -> Any:
    whole = copy.deepcopy(record)
    inner = whole
    for key in place[:-1]:
        inner = inner[key]
    if value is GONE:
        del inner[place[-1]]
    elif value is MORE and isinstance(inner, dict):
        inner[f"{place[-1]}x"] = 1
    elif value is MORE:
        inner.append(inner[0])
    else:
        inner[place[-1]] = value
    return whole


def toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value)


class Kind:
    """A record: where it lies, how it is written there, and everything that reads it."""

    def __init__(self, record: Any, write: Callable[[Any], object], read: Callable[[], object]) -> None:
        self.record, self.write, self.read = record, write, read


def campaign_kind(folder: Path) -> Kind:
    path = folder / "c.toml"

    def write(record: Any) -> None:
        path.write_text("\n".join(f"{json.dumps(key)} = {toml(value)}" for key, value in record.items()))

    return Kind(CAMPAIGN, write, lambda: new_manifest(read_campaign(path)))


def manifest_kind(folder: Path) -> Kind:
    campaign_kind(folder).write(CAMPAIGN)
    campaign = read_campaign(folder / "c.toml")
    write_manifest(folder, new_manifest(campaign))
    path = folder / "manifest.json"
    record = json.loads(path.read_text())
    (folder / record["runs"][0]["file"]).parent.mkdir(parents=True)
    (folder / record["runs"][0]["file"]).write_bytes(b"frames")
    hashes = {record["runs"][0]["file"]: "0" * 64}
    record["runs"] = [record["runs"][0] | {"status": "complete", "sha256": hashes, "programs": {"openmm": "8"}}]
    record["scenes"] = [record["scenes"][0] | {"repairs": ["one"], "force": {"solvent": "vacuum"}}]

    def read() -> None:
        describe_campaign(folder)
        check_same_campaign(read_manifest(folder), new_manifest(campaign), folder)
        campaign_trajectories(folder)

    return Kind(record, lambda altered: path.write_text(json.dumps(altered)), read)


def prepared_kind(folder: Path, scene: Scene) -> Kind:
    path = folder / "a.json"
    prepared = PreparedScene(scene, ForceFieldSpec())
    record = json.loads(json_text({"scene": scene.to_dict(), "force": vars(prepared.force)}, "scene"))

    def read() -> None:
        found = load_prepared(path)
        found.summary()
        build_system(found.scene, found.force)

    return Kind(record, lambda altered: path.write_text(json.dumps(altered)), read)


def windows_kind(folder: Path, frames: TrainingFrames) -> Kind:
    path = folder / "w.h5"
    frames.save(path)
    with h5py.File(path) as file:
        record = json.loads(file.attrs["surromd_windows"])

    def write(altered: Any) -> None:
        with h5py.File(path, "r+") as file:
            file.attrs["surromd_windows"] = json.dumps(altered)

    def read() -> None:
        describe_file(path)
        found = load_frames(path)
        found.window_starts(2, validation=False)
        found.refuse_leaks()

    return Kind(record, write, read)


def weights_kind(folder: Path, weights: Weights) -> Kind:
    from safetensors.torch import save_file

    path, tensors = folder / "w.safetensors", load_file(weights.path)
    with safe_open(weights.path, framework="pt") as handle:
        record = json.loads(handle.metadata()["surromd"])

    def write(altered: Any) -> None:
        text = json.dumps(altered)
        metadata = {"format": "surromd-weights-1", "surromd": text, "sha256": tensor_checksum(text, tensors)}
        save_file(tensors, path, metadata=metadata)

    return Kind(record, write, lambda: (load_weights(path), describe_file(path)))


def checkpoint_kind(folder: Path) -> Kind:
    path = folder / "a.h5.checkpoint"

    def write(altered: Any) -> None:
        write_checkpoint(path, altered, b"") if "files" in altered else path.write_bytes(b"")

    return Kind(new_header(1, overwrite=False), write, lambda: supported_checkpoint(path, [folder / "a.h5"]))


def reference_kind(folder: Path) -> Kind:
    """What a reference's checkpoint says of the run, which is then gone on with."""
    scene, out = load("double-well"), folder / "a.h5"
    config = MDConfig(time_ps=1.0, save_every_ps=0.2, timestep_ps=0.02, equilibrate_ps=0.2, platform="Reference",
                      force=ForceFieldSpec("auto", "auto"))  # fmt: skip

    def stop(done: int, total: int, note: str | None = None) -> None:
        if note is None and done >= 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(scene, config, out, progress=stop)
    header, blob = read_checkpoint(checkpoint_path(out))
    files = {path: path.read_bytes() for path in folder.iterdir()}

    def write(altered: Any) -> None:
        for path, data in files.items():
            path.write_bytes(data)
        write_checkpoint(checkpoint_path(out), {"files": [], **altered}, blob)

    return Kind(header, write, lambda: simulate(scene, config, out, resume=True))


def record_kind(folder: Path, scene: Scene, weights: Weights) -> Kind:
    """What a rollout's file says of itself."""
    path = folder / "a.h5"
    config = RolloutConfig(time_ps=4.0 * weights.model.n_new, solver_steps=1, precision="fp32", guard="off")
    rollout(scene, weights, [path], config)
    with open_trajectory(path) as reader:
        record = dict(reader.record)

    def write(altered: Any) -> None:
        with h5py.File(path, "r+") as file:
            set_text(file["surromd"], "record", sealed(json.dumps(altered)))

    def read() -> None:
        print_pairs(describe_file(path))
        collect_frames([path])

    return Kind(record, write, read)


KINDS = ("campaign file", "manifest", "prepared scene", "windows", "weights", "checkpoint", "reference", "record")


@pytest.fixture
def kind(request: pytest.FixtureRequest, tmp_path: Path) -> Kind:
    made: dict[str, Callable[[], Kind]] = {
        "campaign file": lambda: campaign_kind(tmp_path),
        "manifest": lambda: manifest_kind(tmp_path),
        "prepared scene": lambda: prepared_kind(tmp_path, request.getfixturevalue("alanine_dipeptide")),
        "windows": lambda: windows_kind(tmp_path, request.getfixturevalue("harmonic_frames")),
        "weights": lambda: weights_kind(tmp_path, request.getfixturevalue("small_weights")),
        "checkpoint": lambda: checkpoint_kind(tmp_path),
        "reference": lambda: reference_kind(tmp_path),
        "record": lambda: record_kind(tmp_path, *map(request.getfixturevalue, ("alanine_dipeptide", "small_weights"))),
    }
    return made[request.param]()


def faults_of(kind: Kind, at_most: int) -> tuple[int, int, list[str]]:
    """Return how many alterations were tried, how many were refused, and what ended in any other error."""
    kind.write(kind.record)
    kind.read()
    n, refused, faults = 0, 0, []
    trials = [(place, value) for place in places(kind.record) for value in WRONG]
    stride = max(len(trials) // at_most, 1)
    while math.gcd(stride, len(WRONG)) > 1:
        stride += 1  # one that shares a factor would try the same few values everywhere
    for place, value in trials[::stride]:
        if value is None and isinstance(kind.record.get("temperatures"), list):
            continue  # TOML knows no null
        said = f"{place} = {'gone' if value is GONE else 'more' if value is MORE else value!r}"
        n += 1
        try:
            record = altered(kind.record, place, value)
            kind.write(record)
            with time_limit(20):
                kind.read()
        except SurromdError as error:
            refused += 1
            if not str(error).strip() or "\n" in str(error):
                faults.append(f"{said}: not one line: {error!r}")
        except Exception as error:
            faults.append(f"{said}: {type(error).__name__}: {error}")
    return n, refused, faults


@pytest.mark.parametrize("kind", KINDS, indirect=True)
def test_some_altered_entries(kind: Kind) -> None:
    n, refused, faults = faults_of(kind, at_most=40)
    assert not faults, f"{len(faults)} of {n}\n" + "\n".join(faults)
    assert refused > 0.2 * n


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, indirect=True)
def test_every_altered_entry(kind: Kind) -> None:
    n, refused, faults = faults_of(kind, at_most=10**9)
    print(f"{n} alterations, {refused} refused")  # noqa: T201
    assert not faults, f"{len(faults)} of {n}\n" + "\n".join(faults)
    assert refused > 0.2 * n


def test_names_of_files_hold_no_nul(tmp_path: Path) -> None:
    campaign_kind(tmp_path).write(CAMPAIGN)
    calls: list[Callable[[], object]] = [
        lambda: api.reference("double-well", time_ps="1ps", out=f"{tmp_path}/a\0.h5"),
        lambda: api.compare(tmp_path / "a.h5", [tmp_path / "a.h5"], tmp_path / "a\0.html"),
        lambda: api.windows(tmp_path / "a.h5", tmp_path / "w\0.h5"),
        lambda: api.campaign(tmp_path / "c.toml", out=tmp_path / "w\0"),
        lambda: api.info(tmp_path / "a\0.h5"),
    ]
    for call in calls:
        with pytest.raises(InputError) as caught:
            call()
        assert "\n" not in str(caught.value)


# Where a file is opened by its own library: the door, and who writes, or reads what lies in the package.
DOORS = {
    r"h5py\.File\((?!.*\"w\"\))": ("systems/files/outside.py",),
    r"np\.load(txt)?\(": ("systems/files/outside.py",),
    r"gzip\.(open|decompress)\b": ("systems/chemistry/residues.py", "systems/trajectory/foreign_readers.py"),
    r"json\.loads?\(": ("systems/files/schema.py",),
    # The package's own tables.
    r"tomllib\.loads?\(": ("systems/chemistry/residues.py", "systems/library/named_scenes.py"),
}
# Benches read what they wrote themselves, in a folder of their own.
_OWN = ("surrogate/bench/", "docs/")


@pytest.mark.parametrize("pattern", DOORS)
def test_what_comes_from_outside_has_one_door(pattern: str, repository: Path) -> None:
    found = set()
    for package in ("systems", "md_reference", "surrogate"):
        for path in (repository / package).rglob("*.py"):
            text = path.read_text()
            # A round trip through JSON opens nothing.
            lines = [line for line in text.splitlines() if "json.loads(json.dumps(" not in line]
            name = path.relative_to(repository).as_posix()
            if any(re.search(pattern, line) for line in lines) and not name.startswith(_OWN):
                found.add(name)
    assert found <= set(DOORS[pattern])
