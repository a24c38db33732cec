"""surromd's command line inside the test's own process, and settings that train in a second."""

from __future__ import annotations

from typer.testing import CliRunner, Result

# A LaM-SLidE for `train --config`.
SMALL_LAM_SLIDE = """
[model.autoencoder]
latent_dim = 12
width = 32
head_dim = 8
[model.approximator]
chunk_frames = 4
width = 32
n_layers = 1
n_heads = 2
auxiliary_frames = 2
"""

# A quick solver for `rollout --config`.
TWO_SOLVER_STEPS = """
[sampling]
solver_steps = 2
"""


def run(*arguments: str) -> Result:
    """Return what `surromd ARGUMENTS` printed and its exit status."""
    from surrogate.cli.main import app

    return CliRunner().invoke(app, list(arguments))


def refused(result: Result, *, code: int = 1) -> str:
    """Return the message of a refusal, after checking that it is one line on stderr and nothing else."""
    assert result.exit_code == code, result.output
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("error: ")
    assert "Traceback" not in result.stderr
    return lines[0]
