"""What `run` returns: the record as a dictionary, its headline, its files, its picture."""

from __future__ import annotations

import json
import math
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.verbs.run.run_record import read_run
from systems.files.outside import content
from systems.files.schema import parsed
from systems.units import GAS_CONSTANT_KJ_MOL_K

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from surrogate.judge.md_answer import Answer
    from surrogate.judge.report.figures import Figure as Picture

ANSWER_NAME, REPORT_NAME = "equilibrium.json", "report.html"
_DRAWN = 6


class RunResult(dict[str, Any]):
    """The record of a run, as `run.json` holds it, and what can be done with it.

    `result["outcome"]`, `result["decision"]` and the rest are the record's entries; a notebook shows the three lines.
    """

    @classmethod
    def of(cls, folder: Path) -> RunResult:
        """Return the result of a run's folder, done or not. Raises InputError when there is none."""
        record = read_run(folder)
        done = record.outcome.headline if record.outcome else f"not done; {len(record.stages)} stages have ended"
        plain: dict[str, Any] = json.loads(json.dumps(record.to_dict()))
        return cls({"file": str(folder), "type": "run", "summary": done} | plain)

    @property
    def folder(self) -> Path:
        return Path(self["file"])

    @property
    def headline(self) -> str:
        """Use MD's answer or not, for what, and why."""
        return str(self["summary"])

    @property
    def trajectory(self) -> list[Path]:
        """Files of the trajectory that was judged: the surrogate's, or half of MD."""
        return [self.folder / file for file in self["trajectory"]]

    @property
    def md(self) -> list[Path]:
        """Files of all MD that the answer is of; `sm.frame_weights` gives the weights of their frames."""
        own = self["trajectory"] if (self["decision"] or {}).get("way") == "md" else []
        return [self.folder / file for file in (*own, *self["held_out"])]

    @property
    def report(self) -> Path:
        return self.folder / REPORT_NAME

    @property
    def answer(self) -> dict[str, Any]:
        """States, free energies, maps and timescales by MD (`equilibrium.json`); empty where MD tells none."""
        path = self.folder / ANSWER_NAME
        return dict(parsed(content(path))) if path.is_file() else {}

    def plot(self) -> Figure:
        """Return a matplotlib figure of the populations of all states by MD, with their errors, beside the
        surrogate's, and of the first residues' free energies over φ and ψ."""
        from matplotlib.figure import Figure

        answer = self.answer
        maps = list(answer.get("maps_kj_mol", {}).items())[:_DRAWN]
        states = [s for s in answer.get("states", []) if not s["missing"]]
        figure = Figure(figsize=(4.0 * (1 + len(maps)), max(3.5, 0.22 * len(states))), layout="constrained")
        bars, *others = figure.subplots(1, 1 + len(maps), squeeze=False)[0]
        rows = np.arange(len(states))
        bars.barh(rows, [s["share"] for s in states], xerr=[s["error"] for s in states], color="0.75", label="MD")
        rolled = [(k, s["surrogate"], s["surrogate_error"] or 0.0) for k, s in enumerate(states)
                  if s["surrogate"] is not None]  # fmt: skip
        if rolled:
            at, share, error = zip(*rolled, strict=True)
            bars.errorbar(share, at, xerr=error, fmt="o", color="C1", label="surrogate")
        bars.set_yticks(rows, [f"{s['torsion']} {s['state']}" for s in states], fontsize=7)
        bars.set_xlabel("population")
        bars.set_title(self["molecule"], fontsize=9)
        if states:
            bars.invert_yaxis()
            bars.legend(fontsize=8)
        for axes, (label, energy) in zip(others, maps, strict=True):
            values = np.array([[math.nan if x is None else x for x in row] for row in energy])
            image = axes.imshow(
                values.T, origin="lower", extent=(-180, 180, -180, 180), vmin=0, vmax=20, cmap="viridis_r"
            )
            axes.set(xlabel="φ / °", ylabel="ψ / °", title=f"{label}, kJ/mol")
            figure.colorbar(image, ax=axes, shrink=0.7)
        return figure

    def _repr_html_(self) -> str:
        """Return the three lines and where the report is, for a notebook."""
        outcome = self["outcome"]
        if outcome is None:
            return f"<p>{escape(self.headline)}</p>"
        first, *rest = outcome["in_short"]
        said = "<br>".join(escape(line) for line in (*rest, outcome["details"]) if line)
        link = escape(str(self.report))
        return f'<p><b>{escape(first)}</b><br>{said}<br><a href="{link}">{link}</a></p>'


def weighted_maps(answer: Answer, temperature_k: float) -> list[Picture]:
    """Return the report's pictures of MD's answer: the free energy of each of the first residues over φ and ψ."""
    from surrogate.judge.report import figures

    rt_kj = GAS_CONSTANT_KJ_MOL_K * temperature_k
    return [
        figures.Figure(
            figures.ramachandran(f"By MD's weights, {label}", np.exp(-energy / rt_kj), temperature_k),
            f"{label}: free energy by MD's answer, all its frames weighted",
        )
        for label, energy in list(answer.maps.items())[:_DRAWN]
    ]
