"""What the command says to a shell: its version, and how a word can go on."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

import surrogate
from command_line import run


def test_version() -> None:
    done = run("--version")
    assert done.exit_code == 0
    assert done.stdout == f"surromd {surrogate.__version__}\n"


def completed(words: str) -> list[str]:
    """Return what bash is told for the last of these words."""
    state = {"_SURROMD_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    done = subprocess.run([sys.executable, "-m", "surrogate.cli.main"], capture_output=True, text=True,
                          env=os.environ | state)  # fmt: skip
    assert not done.stderr
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("surromd roll", ["rollout"]),
        ("surromd rollout alanine-dip", ["alanine-dipeptide"]),
        ("surromd rollout alanine-dipeptide --weights pa", ["paracetamol-gfn2-xtb"]),
        ("surromd rollout alanine-dipeptide --guard re", ["resample", "repair"]),
        ("surromd rollout alanine-dipeptide --save-e", ["--save-every"]),
        ("surromd rollout alanine-dipeptide --solver", []),
    ],
)
def test_a_shell_completes(words: str, said: list[str]) -> None:
    assert completed(words) == said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("rollout", "rollout needs SCENE: Library name"),
        ("rollout ethanol", "rollout needs --out: Output trajectory"),
        ("rollout ethanol -o x.h5", "rollout needs --time: Simulated time"),
        ("reference ethanol -o x.h5", "reference needs --time: Simulated time"),
        ("train ref.h5", "train needs --out: Weights to write"),
        ("windows ref.h5", "windows needs --out: Output file"),
        ("compare ref.h5", "compare needs TRAJ...: Candidate trajectories"),
        ("bench cost-error", "cost-error needs REFERENCE: Held-out reference"),
    ],
)
def test_what_is_missing_is_named(words: str, said: str) -> None:
    done = run(*words.split())
    assert done.exit_code == 2
    assert said in " ".join(done.stderr.replace("│", " ").split())
