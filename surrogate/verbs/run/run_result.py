"""What `run` returns: the record as a dictionary, its headline, its files, its picture."""

from __future__ import annotations

import json
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogate.verbs.run.run_record import read_run
from systems.files.outside import content
from systems.files.schema import parsed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ANSWER_NAME, REPORT_NAME = "equilibrium.json", "report.html"


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
        """Files of the trajectory that was evaluated: the surrogate's, or half of MD."""
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
        from surrogate.comparison.report.figures import answer_overview

        return answer_overview(self["molecule"], self.answer)

    def _repr_html_(self) -> str:
        """Return the three lines and where the report is, for a notebook."""
        outcome = self["outcome"]
        if outcome is None:
            return f"<p>{escape(self.headline)}</p>"
        first, *rest = outcome["in_short"]
        said = "<br>".join(escape(line) for line in (*rest, outcome["details"]) if line)
        link = escape(str(self.report))
        return f'<p><b>{escape(first)}</b><br>{said}<br><a href="{link}">{link}</a></p>'
