"""Runs that are killed at each of their file operations, that lose power there, or whose disk refuses: what is left.

Each trial ends with `resume`, and is one of: exact (the finished file is that of an undisturbed run), refused (one
line, and nothing changed), lost (anything else). `pytest tests/stress/test_crashes.py --run-slow -s -n 0` prints their
table.
"""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from disk_model import LOSSES, NO_SPACE, Disk, watched
from loop_device import cut, mounted, new_image
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.simulate import MDConfig, simulate
from surrogate.models.weights import Weights
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.errors import StorageError, SurromdError
from systems.library.named_scenes import load
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

MD = MDConfig(time_ps=3.0, save_every_ps=0.2, timestep_ps=0.02, equilibrate_ps=0.2, seed=3, platform="Reference",
              force=ForceFieldSpec("auto", "auto"))  # fmt: skip
Run = Callable[..., Any]
# What is long is done in so many tests: none may take ten minutes.
PARTS = 4


@dataclass
class Kind:
    """A run to be disturbed: the names of its files, and how it is started or gone on with in a folder."""

    names: tuple[str, ...]
    run: Run
    whole: dict[str, Any] = field(default_factory=dict)

    def found(self, folder: Path) -> dict[str, Any]:
        return {name: everything(folder / name) for name in self.names}

    def left_over(self, folder: Path) -> list[str]:
        """Names of what lies beside companions, but for what the disk refused to remove: temporaries, void journals."""
        return sorted(
            p.name
            for p in folder.iterdir()
            if p.suffix not in (".new", ".pdb")
            and ".meta." not in p.name
            and not (p.suffix == ".journal" and not p.stat().st_size)
        )


def everything(path: Path) -> dict[str, Any]:
    """All that a finished file holds, but for times of day and seconds spent."""
    with open_trajectory(path) as reader:
        assert reader.record["completed"] is True
        optional = [values for values in (reader.flags, reader.chunk_idx) if values is not None]
        return {
            "frames": reader.read().tobytes(),
            "columns": [values.tobytes() for values in (reader.time_ps, *optional)],
            "scalars": {name: values.tobytes() for name, values in sorted(reader.scalars.items())},
        }


TABLE: dict[str, Counter[str]] = {}


@pytest.fixture(scope="module", autouse=True)
def table() -> Iterator[None]:
    yield
    if TABLE:
        lines = [f"{'kind':44} {'trials':>7} {'exact':>6} {'refused':>8} {'lost':>5}"]
        for kind, counts in TABLE.items():
            lines.append(f"{kind:44} {counts.total():7} {counts['exact']:6} {counts['refused']:8} {counts['lost']:5}")
        print("\n\n" + "\n".join(lines))  # noqa: T201


@pytest.fixture(scope="module", params=["reference .h5", "reference .dcd", "rollout .h5 and .dcd"])
def kind(request: pytest.FixtureRequest, small_weights: Weights, alanine_dipeptide: Scene,
         tmp_path_factory: pytest.TempPathFactory) -> Kind:  # fmt: skip
    if request.param.startswith("reference"):
        name = "a." + request.param.rpartition(".")[2]
        scene = load("double-well")

        def run(folder: Path, **how: Any) -> None:
            simulate(scene, MD, folder / name, **how)

        found = Kind((name,), run)
    else:
        config = RolloutConfig(time_ps=6.0 * small_weights.model.n_new, solver_steps=1, precision="fp32", seed=6,
                               guard="off")  # fmt: skip

        def roll(folder: Path, **how: Any) -> None:
            outs = [folder / "a.h5", folder / "b.dcd"]
            rollout(alanine_dipeptide, small_weights, outs, config, flush_every_s=0.0, **how)

        found = Kind(("a.h5", "b.dcd"), roll)
    folder = tmp_path_factory.mktemp("whole")
    found.run(folder)
    found.whole = found.found(folder)
    return found


def outcome(kind: Kind, folder: Path) -> str:
    """Go on with what a folder holds and return 'exact', 'refused' or why frames are lost."""
    before = {p: p.read_bytes() for p in folder.iterdir()}
    try:
        kind.run(folder, resume=True)
    except SurromdError as error:
        same = {p: p.read_bytes() for p in folder.iterdir()} == before
        return "refused" if same and "\n" not in str(error) else f"lost: {error}"
    except Exception as error:
        return f"lost: {type(error).__name__}: {error}"
    if kind.found(folder) != kind.whole:
        return "lost: other frames"
    return "exact" if kind.left_over(folder) == sorted(kind.names) else f"lost: left over {kind.left_over(folder)}"


def count(kind: str, found: dict[Any, str]) -> None:
    """Add outcomes to the table; AssertionError with those that are lost."""
    counts = TABLE.setdefault(kind, Counter())
    counts.update(said if said in ("exact", "refused") else "lost" for said in found.values())
    bad = [f"{trial}: {said}" for trial, said in found.items() if said != "exact"]
    assert not bad, f"{kind}: {len(bad)} of {len(found)}\n" + "\n".join(bad[:20])


def recorded(kind: Kind, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Disk:
    folder.mkdir()
    with watched(folder, monkeypatch) as disk:
        kind.run(folder)
    assert kind.found(folder) == kind.whole
    return disk


def crashes(kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int,
            first: int = 0) -> tuple[int, dict[Any, str]]:  # fmt: skip
    disk = recorded(kind, tmp_path / "run", monkeypatch)
    found = {}
    for n in range(first, len(disk.operations) + 1, every):
        disk.put(tmp_path / f"{n}", disk.after(n))
        found[n, disk.operations[n - 1][:2] if n else ""] = outcome(kind, tmp_path / f"{n}")
    return len(disk.operations), found


def name_of(kind: Kind) -> str:
    return "rollout" if len(kind.names) > 1 else f"reference {Path(kind.names[0]).suffix}"


def power_failures(kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int,
                   first: int = 0) -> dict[Any, str]:  # fmt: skip
    disk = recorded(kind, tmp_path / "run", monkeypatch)
    found = {}
    for n in range(first, len(disk.operations) + 1, every):
        for how, (data, names) in LOSSES.items():
            folder = tmp_path / f"{n} {how}"
            disk.put(folder, disk.after(n, data, names, seed=n))
            found[n, how, disk.operations[n - 1][:2] if n else ""] = outcome(kind, folder)
    return found


def faults(kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, every: int,
           first: int = 0) -> dict[Any, str]:  # fmt: skip
    """Have each operation fail in turn, once, or from then on all that need space; then go on with the disk mended."""
    found: dict[Any, str] = {}
    (tmp_path / "count").mkdir()
    calls: list[str] = []
    with watched(tmp_path / "count", monkeypatch, lambda number, what: calls.append(what) or 0):
        kind.run(tmp_path / "count")
    for n in range(1 + first, len(calls) + 1, every):
        folder = tmp_path / f"{code} {n}"
        folder.mkdir()
        seen: list[str] = []

        def fault(number: int, what: str, n: int = n, seen: list[str] = seen) -> int:
            seen.append(what)
            fails = number >= n and what in NO_SPACE[1] if code == errno.ENOSPC else number == n
            return code if fails else 0

        said = ""
        with watched(folder, monkeypatch, fault):
            try:
                kind.run(folder)
            except StorageError as error:
                said = "not one line" if "\n" in str(error) else ""
            except Exception as error:
                said = f"lost: {type(error).__name__}: {error}"
        found[n, seen[n - 1] if len(seen) >= n else ""] = said or outcome(kind, folder)
    return found


def test_killed_at_some_operations(kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    n_operations, found = crashes(kind, tmp_path, monkeypatch, every=17 if len(kind.names) == 1 else 71)
    assert n_operations > 60
    count(f"{name_of(kind)}: killed at an operation", found)


def test_power_lost_at_some_operations(kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count(
        f"{name_of(kind)}: power lost at an operation",
        power_failures(kind, tmp_path, monkeypatch, every=61 * len(kind.names)),
    )


@pytest.mark.parametrize("code", [errno.EIO, errno.ENOSPC])
def test_some_operations_that_fail(kind: Kind, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count(f"{name_of(kind)}: {errno.errorcode[code]}", faults(kind, tmp_path, monkeypatch, code, every=41))


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_killed_at_every_operation(kind: Kind, part: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, found = crashes(kind, tmp_path, monkeypatch, PARTS, part)
    count(f"{name_of(kind)}: killed at an operation", found)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_power_lost_at_each_operation(kind: Kind, part: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count(f"{name_of(kind)}: power lost at an operation", power_failures(kind, tmp_path, monkeypatch, PARTS, part))


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("code", [errno.EIO, errno.ENOSPC])
def test_every_operation_that_fails(kind: Kind, code: int, part: int, tmp_path: Path,
                                    monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    count(f"{name_of(kind)}: {errno.errorcode[code]}", faults(kind, tmp_path, monkeypatch, code, PARTS, part))


@pytest.mark.slow
def test_power_cut_of_a_real_file_system(kind: Kind, tmp_path: Path) -> None:
    """An ext4 in a file, copied while the run is stopped at a moment: what the kernel had not yet written is gone."""
    image = tmp_path / "disk.img"
    if not new_image(image, 48):
        pytest.skip("no mkfs.ext4")
    cuts = []
    with mounted(image) as folder:
        if folder is None:
            pytest.skip("loop devices may not be mounted here")
        (folder / "run").mkdir()
        run = multiprocessing.get_context("fork").Process(target=kind.run, args=(folder / "run",))
        run.start()
        rng = np.random.default_rng(0)
        while run.is_alive() and len(cuts) < 40:
            time.sleep(float(rng.uniform(0.0, 0.02)))
            with suppress(ProcessLookupError):
                os.kill(run.pid or 0, signal.SIGSTOP)
                cuts.append(tmp_path / f"{len(cuts)}.img")
                cut(image, cuts[-1])
                os.kill(run.pid or 0, signal.SIGCONT)
        run.join()
        assert run.exitcode == 0
    found = {}
    for copy in cuts:
        with mounted(copy) as folder:
            assert folder is not None
            if (folder / "run").is_dir():
                found[copy.stem] = outcome(kind, folder / "run")
        copy.unlink()
    count(f"{name_of(kind)}: power cut, ext4 on a loop device", found)
    assert len(found) > 3


def test_the_model_of_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that is renamed before it is forced out may be empty after a power failure; a kill does not touch it."""
    folder = tmp_path / "disk"
    folder.mkdir()
    with watched(folder, monkeypatch) as disk:
        descriptor = os.open(folder / "a.new", os.O_WRONLY | os.O_CREAT)
        os.pwrite(descriptor, b"x" * 2000, 0)
        os.close(descriptor)
        os.replace(folder / "a.new", folder / "a")
    n = len(disk.operations)
    assert disk.after(n) == {"a": b"x" * 2000}
    assert disk.after(n, *LOSSES["neither"]) == {}
    assert disk.after(n, *LOSSES["names alone"]) == {"a": b""}
    assert disk.after(n, *LOSSES["bytes alone"]) == {}
    assert np.unique([len(disk.after(n, 0.5, 1.0, seed)["a"]) for seed in range(9)]).size > 1
