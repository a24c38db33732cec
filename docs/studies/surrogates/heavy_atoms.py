"""Hydrogens modelled, placed, or placed about residues: `python docs/studies/surrogates/heavy_atoms.py FOLDER --train
REF... --test REF...`.

Three LaM-SLidE of alanine dipeptide (or another peptide with phi and psi) are trained for the same time: of all atoms,
of heavy atoms whose hydrogens are placed (`hydrogens = "placed"`), and of residues (`entities = "residue"`).
Each draws one chunk from frames of a trajectory that it never saw, beside MD from the same frames (see
`docs/studies/training/lag_errors.py`), and is timed. What is finished in FOLDER is not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.validity import Geometry
from systems.units import parse_wall_s

sys.path.append(str(Path(__file__).parents[1] / "training"))
from lag_errors import Row, evenly_started, hold_against

KINDS: dict[str, dict[str, str]] = {
    "modelled": {},
    "placed": {"hydrogens": "placed"},
    "residue": {"entities": "residue"},
}


def train(references: Sequence[Path], out: Path, kind: str, budget_s: float) -> None:
    """Train one of KINDS; what is there stays, what was interrupted goes on."""
    from surrogate.data.frames import collect_frames
    from surrogate.models.lam_slide.config import LamSlideConfig
    from surrogate.models.lam_slide.trainer import TrainingConfig, is_trained, train_lam_slide

    if is_trained(out):
        return
    settings = TrainingConfig(budget_s=budget_s, time_reversal=True)
    train_lam_slide(collect_frames(list(references)), out, LamSlideConfig.from_dict(dict(KINDS[kind])), settings,
                    resume=True)  # fmt: skip


def run(folder: Path, references: Sequence[Path], tests: Sequence[Path], *, budget_s: float,
        n_starts: int) -> list[tuple[Row, float | None]]:  # fmt: skip
    """Train, draw and measure; return each row with the milliseconds that a frame took, None of MD."""
    from surrogate.data.frames import collect_frames
    from surrogate.data.weights import load_weights
    from surrogate.sampling.chunks import ChunkSampler

    folder.mkdir(parents=True, exist_ok=True)
    test = collect_frames(list(tests))
    rows: list[tuple[Row, float | None]] = []
    for kind in KINDS:
        out = folder / f"{kind}.safetensors"
        train(references, out, kind, budget_s)
        weights = load_weights(out)
        geometry, lag_ps = Geometry.from_dict(weights.domain.geometry), weights.domain.lag_ps
        known = evenly_started(test, weights.model.n_new + 1, 1, n_starts)
        if not rows:
            rows.append((hold_against(test, known[:, 0], known[:, 1:], geometry, lag_ps, "MD"), None))
        sampler, started = ChunkSampler(weights), time.perf_counter()
        frames = np.asarray(sampler.draw(known[:, :1], list(range(n_starts))).frames_nm, dtype=np.float64)
        each_ms = 1e3 * (time.perf_counter() - started) / (frames.shape[0] * frames.shape[1])
        rows.append((hold_against(test, known[:, 0], frames, geometry, lag_ps, kind), each_ms))
    return rows


def table(rows: Sequence[tuple[Row, float | None]]) -> str:
    """Return the rows as Markdown."""
    lines = [
        "| hydrogens | valid | joint φ/ψ JSD | cos ψ one frame later | cos φ one frame later | ms a frame |",
        "|---|---|---|---|---|---|",
    ]
    for r, each_ms in rows:
        lines.append(
            f"| {r.source} | {100 * r.valid:.2f} % | {r.jsd:.3f} | {r.psi:.2f} ± {r.error(r.psi):.2f} "
            f"| {r.phi:.2f} ± {r.error(r.phi):.2f} | {'–' if each_ms is None else f'{each_ms:.2f}'} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse, run, print the table and keep it in FOLDER."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--train", type=Path, nargs="+", required=True, help="references of one peptide")
    parser.add_argument("--test", type=Path, nargs="+", required=True, help="references that training does not see")
    parser.add_argument("--budget", default="12min", help="wall time of each training")
    parser.add_argument("--starts", type=int, default=512, help="frames that each is started from")
    a = parser.parse_args(arguments)
    rows = run(a.folder, a.train, a.test, budget_s=parse_wall_s(a.budget), n_starts=a.starts)
    record: dict[str, Any] = {"budget": a.budget, "rows": [{**asdict(row), "ms_a_frame": ms} for row, ms in rows]}
    (a.folder / "heavy_atoms.json").write_text(json.dumps(record, indent=1))
    (a.folder / "heavy_atoms.md").write_text(table(rows) + "\n")
    sys.stdout.write(table(rows) + "\n")


if __name__ == "__main__":
    main()
