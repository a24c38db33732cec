"""Several replicas: names, failures told apart, what is finished stays."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from md_reference.run.replicas import simulate_replicas
from md_reference.run.simulate import MDConfig, checkpoint_path
from systems.errors import SimulationError, TrajectoryError
from systems.files.whole_file import replica_paths
from systems.scene import Scene
from systems.trajectory.checkpoint import read_checkpoint
from systems.trajectory.codec import open_trajectory, open_writer

SHORT = MDConfig(time_ps=0.8, save_every_ps=0.2, equilibrate_ps=0.4, platform="Reference")


def test_names_of_replicas() -> None:
    assert replica_paths(Path("a/b.h5"), 1) == [Path("a/b.h5")]
    assert replica_paths(Path("a/b.dcd"), 2) == [Path("a/b_r0.dcd"), Path("a/b_r1.dcd")]


def test_a_failed_replica_is_named_and_the_others_are_kept(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    outs = [tmp_path / "a.h5", tmp_path / "missing" / "b.h5"]
    told: list[tuple[Any, ...]] = []
    with pytest.raises(SimulationError, match=r"1 of 2 replicas failed; replica 1: .*missing") as caught:
        simulate_replicas(alanine_dipeptide, SHORT, outs, progress=lambda *done: told.append(done))
    assert "\n" not in str(caught.value)
    with open_trajectory(outs[0]) as reader:
        assert reader.record["completed"] is True
        assert reader.record["seed"] == 0
        assert reader.n_frames == 4
    assert told[-1][1] == 8


def test_a_failure_is_told_at_once_and_may_end_the_others(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    outs = [tmp_path / "missing" / "a.h5", tmp_path / "b.h5"]

    def heard(said: str | SimulationError) -> None:
        if isinstance(said, SimulationError):
            raise said

    with pytest.raises(SimulationError, match=r"1 of 2 replicas failed; replica 0: .*missing"):
        simulate_replicas(alanine_dipeptide, SHORT, outs, announce=heard, workers=1)
    assert not outs[1].exists(), "it was waiting"


def test_replicas_resume_and_keep_what_is_complete(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    outs = [tmp_path / "a.h5", tmp_path / "b.h5"]
    simulate_replicas(alanine_dipeptide, SHORT, outs[:1])
    before = outs[0].read_bytes()
    assert simulate_replicas(alanine_dipeptide, SHORT, outs, resume=True) == outs
    assert outs[0].read_bytes() == before
    with open_trajectory(outs[1]) as reader:
        assert reader.record["seed"] == 1
    with pytest.raises(SimulationError, match=r"replica 0: .*temperature_k"):
        simulate_replicas(alanine_dipeptide, replace(SHORT, temperature_k=310.0), outs, resume=True)


# ---- the end of the parent -----------------------------------------------------------------------------------------


def test_a_script_that_starts_replicas_while_it_is_imported(tmp_path: Path, repository: Path) -> None:
    begun = (
        "from pathlib import Path\nfrom md_reference.forces.spec import ForceFieldSpec\n"
        "from md_reference.run.replicas import simulate_replicas\n"
        "from md_reference.run.simulate import MDConfig\nfrom systems.library.named_scenes import load\n"
        "config = MDConfig(time_ps=2.0, timestep_ps=0.02, equilibrate_ps=0.2, platform='Reference',\n"
        "                  force=ForceFieldSpec('auto', 'auto'))\n"
        f"outs = [Path({str(tmp_path)!r}) / name for name in ('0.h5', '1.h5')]\n"
    )
    call = "simulate_replicas(load('double-well'), config, outs)\n"
    for guard, said in (("", ["put what starts them below `if __name__ == '__main__':`"]),
                        ("if __name__ == '__main__':\n    ", [])):  # fmt: skip
        (tmp_path / "script.py").write_text(begun + guard + call)
        run = subprocess.run([sys.executable, str(tmp_path / "script.py")], capture_output=True, text=True, check=False,
                             env=os.environ | {"PYTHONPATH": str(repository)})  # fmt: skip
        assert (run.returncode == 0) == (not said), run.stderr
        assert run.stderr.count("Traceback") == len(said)
        assert all(part in run.stderr for part in said)


@contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[None]:
    """A failed assertion must not wait for a run of days."""
    try:
        yield
    finally:
        process.kill()


PARENT = """
import sys
sys.path.insert(0, {repository!r})
from pathlib import Path
from md_reference.run.replicas import simulate_replicas
from md_reference.run.simulate import MDConfig
from systems.library.named_scenes import load

if __name__ == "__main__":
    config = MDConfig(time_ps=4e6, save_every_ps=0.2, equilibrate_ps=0.4, platform="Reference")
    try:
        simulate_replicas(load("alanine-dipeptide"), config, [Path(p) for p in {outs!r}], workers=2)
    except KeyboardInterrupt:
        sys.exit(130)
"""


def being_written(path: Path, scene: Scene) -> bool:
    """True while some process holds the file, which has frames, open for writing."""
    try:
        if not path.exists() or frames_in(path) == 0:  # its writer is not disturbed before it has begun
            return False
    except TrajectoryError:  # read in the middle of an append; a file left so would fail the test by its deadline
        return True
    try:
        open_writer(path, scene, {}, append=True).close()
    except TrajectoryError as error:
        return "another process" in str(error)
    return False


def frames_in(path: Path) -> int:
    with open_trajectory(path) as reader:
        return reader.n_frames


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_ctrl_c_while_replicas_start_is_quiet(tmp_path: Path, repository: Path) -> None:
    outs = [str(tmp_path / "a.h5"), str(tmp_path / "b.h5")]
    (tmp_path / "parent.py").write_text(PARENT.format(repository=str(repository), outs=outs))
    command = [sys.executable, str(tmp_path / "parent.py")]
    with (
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as parent,
        ended(parent),
    ):
        children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
        deadline = time.monotonic() + 300
        while not any(b"spawn_main" in _command(child) for child in children.read_text().split()):
            assert parent.poll() is None and time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(0.1)  # Python has begun to import
        os.killpg(parent.pid, signal.SIGINT)
        _, said = parent.communicate(timeout=60)
    assert parent.returncode == 130 and "Traceback" not in said


def _command(process: str) -> bytes:
    with suppress(OSError):
        return Path(f"/proc/{process}/cmdline").read_bytes()
    return b""


@pytest.mark.skipif(os.name != "posix", reason="sends SIGKILL")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM], ids=["kill -9", "SIGTERM"])
def test_replicas_end_with_their_parent_and_can_be_resumed(
    alanine_dipeptide: Scene, tmp_path: Path, repository: Path, number: signal.Signals
) -> None:
    outs = [tmp_path / "a.h5", tmp_path / "b.h5"]
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(repository=str(repository), outs=[str(out) for out in outs]))
    with (
        subprocess.Popen([sys.executable, str(script)], stderr=subprocess.PIPE, text=True) as parent,
        ended(parent),
    ):
        deadline = time.monotonic() + 300
        while not all(being_written(out, alanine_dipeptide) for out in outs):  # also shows that the question can be yes
            assert parent.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        parent.send_signal(number)
        parent.wait(timeout=30)
        assert parent.returncode == (-signal.SIGKILL if number == signal.SIGKILL else 130)
        deadline = time.monotonic() + 10
        while any(being_written(out, alanine_dipeptide) for out in outs):
            assert time.monotonic() < deadline, "an orphan goes on writing"
            time.sleep(0.05)
        assert "Traceback" not in (parent.stderr.read() if parent.stderr else "")
    for out in outs:
        n_frames = frames_in(out)
        assert checkpoint_path(out).exists()
        # Stopped between two frames, with a checkpoint at the last one: nothing is lost on the way to a longer run.
        assert read_checkpoint(checkpoint_path(out))[0]["files"][0]["n_frames"] == n_frames
