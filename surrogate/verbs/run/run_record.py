"""The record of a run, run.json: what was asked for, measured, decided and done, and what came of it; and what `run`
returns: the record as a dictionary with its headline, its files, its picture."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from surrogate.verbs.run.decision import Decision
from surrogate.verbs.run.rates import Rates
from systems.errors import InputError
from systems.files.outside import content
from systems.files.schema import built, parsed
from systems.files.whole_file import create_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RUN_NAME, ANSWER_NAME, REPORT_NAME = "run.json", "equilibrium.json", "report.html"
ENERGIES_NAME = "energies.csv"
FORMAT = 4
# What may change from one sitting to the next.
_FREE = frozenset({"quiet", "resume", "overwrite", "dry_run", "workers", "scheduler"})

Status = Literal["done", "out of time", "failed"]


@dataclass(frozen=True)
class StageEntry:
    """A stage that has ended: how, after how many seconds of wall time, and what there is to say of it."""

    name: str
    status: Status
    wall_s: float
    note: str = ""


@dataclass(frozen=True)
class Outcome:
    """What came of a run. `in_short`: use MD's answer or not, for what, why, `headline`: the same in one line;
    `details`: how much MD the surrogate is equivalent to, and what would tell more; `on_surrogate`: what MD's answer
    says of the surrogate, `converged`: whether the answer passed its tests; `held_out_ps` of MD it was compared with,
    `rolled_ps` that was evaluated, replicas together; `equivalent_time` in words, `speed_up` over as much wall time of
    the fastest MD here as a lower bound, None where it cannot be told."""

    headline: str
    status: str
    verdict: str
    held_out_ps: float
    rolled_ps: float
    equivalent_time: str = ""
    speed_up: float | None = None
    on_surrogate: str = ""
    converged: bool = False
    notes: tuple[str, ...] = ()
    in_short: tuple[str, str, str] = ("", "", "")
    details: str = ""


@dataclass(frozen=True)
class RunRecord:
    """A run on its way or done. `settings`: what was asked for, in our units; `spent_s` of its budget, `spent_in` each
    stage; `trajectory`, `umbrella`, `held_out`: files, relative to the folder; `weights`: a file there, or the name of
    shipped ones; `simd_failed`: the number of SIMD replicas when MD by them failed, else 0."""

    scene: str
    molecule: str
    formula: str
    topology_hash: str
    settings: dict[str, Any]
    programs: dict[str, str] = field(default_factory=dict)
    started: str = ""
    spent_s: float = 0.0
    spent_in: dict[str, float] = field(default_factory=dict)
    rates: Rates | None = None
    decision: Decision | None = None
    stages: tuple[StageEntry, ...] = ()
    trajectory: tuple[str, ...] = ()
    umbrella: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()
    weights: str = ""
    simd_failed: int = 0
    outcome: Outcome | None = None

    def ended(self, name: str) -> StageEntry | None:
        """Return how a stage ended, None where it has not."""
        return next((entry for entry in self.stages if entry.name == name), None)

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values."""
        return {"format": FORMAT, **asdict(self)}

    def check_same(self, settings: dict[str, Any], topology_hash: str, folder: Path) -> None:
        """Raise InputError unless a run of these settings, of this budget or a longer one, may go on with this one."""
        if self.topology_hash != topology_hash:
            raise InputError(f"{folder} is a run of another molecule ({self.scene}); name another folder.")
        shorter = settings["budget_s"] < self.settings["budget_s"]
        for key in sorted((settings.keys() | self.settings.keys()) - (set() if shorter else {"budget_s"})):
            was, now = self.settings.get(key), settings.get(key)
            if was != now:
                raise InputError(
                    f"{folder} was started with {key} = {was!r}, not {now!r}; go on with the same settings, or name "
                    "another folder."
                )


def settings_of_run(options: Any) -> dict[str, Any]:
    """Return the options that make a run what it is, JSON-able."""
    values = {key: value for key, value in asdict(options).items() if key not in _FREE}
    plain: dict[str, Any] = json.loads(json.dumps(values, default=str))
    return plain


def write_run(folder: Path, record: RunRecord) -> None:
    """Write run.json into the folder, whole or not at all. Raises StorageError."""
    create_whole(folder / RUN_NAME, json.dumps(record.to_dict(), indent=1) + "\n")


def read_run(folder: Path) -> RunRecord:
    """Return the record of a run's folder. Raises InputError when there is none or it cannot be read."""
    path = folder / RUN_NAME
    try:
        found = dict(parsed(content(path)))
        if found.pop("format", None) != FORMAT:
            raise InputError(f"{path} was written by another version of surromd (its format is not {FORMAT}).")
        return built(RunRecord, found)
    except FileNotFoundError:
        raise InputError(f"{folder} holds no {RUN_NAME}: there is no run to go on with.") from None
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path} cannot be read as the record of a run ({error}).") from error


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
        return [self.folder / file for file in self["umbrella"] or (*own, *self["held_out"])]

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
