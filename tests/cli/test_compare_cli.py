"""`surromd compare` for scripts and for files of other programs: exit codes, a topology for each file."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from surrogate import api
from surrogate.cli.main import app
from surrogate.verbs.compare import compare
from systems.errors import InputError, SurromdError

RUNNER = CliRunner()


@pytest.fixture(scope="module")
def files(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """300 frames of three runs, as XTC, NetCDF and DCD."""
    import mdtraj

    folder, made = shared_data / "alanine-dipeptide", tmp_path_factory.mktemp("formats")
    out = []
    for k, suffix in ((1, "xtc"), (2, "nc"), (3, "dcd")):
        frames = mdtraj.load(str(folder / f"trajectory-{k}.dcd"), top=str(folder / "ala2.pdb"))[:300]
        out.append(made / f"run{k}.{suffix}")
        frames.save(str(out[-1]))
    return out


@pytest.mark.parametrize(
    ("status", "fail_on", "code"),
    [
        ("different", "different", 1),
        ("broken", "different", 1),
        ("broken", "broken", 1),
        ("different", "broken", 0),
        ("undecided", "different", 0),
        ("broken", None, 0),
    ],
)
def test_scripts_can_fail_on_a_verdict(
    monkeypatch: pytest.MonkeyPatch, status: str, fail_on: str | None, code: int
) -> None:
    evaluated = SimpleNamespace(evaluations=[SimpleNamespace(status="close"), SimpleNamespace(status=status)], notes=())
    monkeypatch.setattr(api, "compare", lambda *args, **kwargs: evaluated)
    extra = [] if fail_on is None else ["--fail-on", fail_on]
    assert RUNNER.invoke(app, ["compare", "a.h5", "b.h5", "c.h5", "--quiet", *extra]).exit_code == code


def test_an_unknown_verdict_is_bad_usage() -> None:
    assert RUNNER.invoke(app, ["compare", "a.h5", "b.h5", "--fail-on", "ugly"]).exit_code == 2


def test_each_file_has_its_topology_and_time(
    files: list[Path], shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    top = shared_data / "alanine-dipeptide" / "ala2.pdb"
    found = compare(files[0], [files[1]], replicate=files[2], top=[top, None, top], dt_ps=["2ps", "2ps", 2.0])
    assert found.lag_ps == 2.0 and found.evaluations[0].n_frames == 300
    assert found.reference.top == str(top) and found.evaluations[0].summary.top is None
    with pytest.raises(InputError, match="2 values of top for 3 trajectories"):
        compare(files[0], [files[1]], replicate=files[2], top=[top, top], dt_ps=1.0)
    # Through the command: '-' where a file needs none.
    seen: dict[str, object] = {}
    monkeypatch.setattr(
        api, "compare", lambda *args, **kwargs: seen.update(kwargs) or SimpleNamespace(evaluations=[], notes=())
    )
    arguments = ["compare", "a.xtc", "b.h5", "--top", "a.pdb", "--top", "-", "--dt", "1ps", "--dt", "-", "--quiet"]
    assert RUNNER.invoke(app, arguments).exit_code == 0
    options = vars(seen["options"])
    assert (options["top"], options["dt_ps"]) == (["a.pdb", None], [1.0, None])


def test_what_cannot_be_read_says_what_is_missing(files: list[Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"run1.xtc holds no topology; give one with .top="):
        compare(files[0], [files[1]], dt_ps=1.0)
    ase = tmp_path / "run.traj"
    ase.write_bytes(b"- of Ulm")
    with pytest.raises(SurromdError, match=r"run.traj .* by ase"):
        compare(ase, [files[1]], dt_ps=1.0)
