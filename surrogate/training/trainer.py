"""The interface between the verb `train` and an architecture: choices for the references, settings, the training."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from surrogate.data.references import References
from surrogate.data.weights import read_header
from surrogate.models.settings import build
from systems.errors import InputError

T = TypeVar("T")
# (stage, share of all that is to be done) -> None
AdvanceFn = Callable[[str, float], None]


@dataclass(frozen=True)
class TrainingRequest:
    """A request for a training. Times in s and ps; `device` is torch's name.

    `start_from`: weights to go on from. `longest_lag_ps`: every spacing of frames up to this one is to be learned.
    `model`, `training`: the tables of the configuration file, as far as they are filled in.
    """

    arch: str
    out: Path
    budget_s: float | None = None
    steps: int | None = None
    start_from: Path | None = None
    longest_lag_ps: float | None = None
    seed: int = 0
    device: str = "cpu"
    resume: bool = False
    model: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)

    def with_choices(self, choices: tuple[Choice, ...]) -> TrainingRequest:
        """Return the request with what was chosen in its tables."""
        tables = {"model": _copied(self.model), "training": _copied(self.training)}
        for choice in choices:
            *path, last = choice.key.split(".")
            table: dict[str, Any] = tables
            for name in path:
                table = table.setdefault(name, {})
            table[last] = choice.value
        return replace(self, model=tables["model"], training=tables["training"])

    def settings(self, kind: type[T], asked: dict[str, Any]) -> T:
        """Return the training's settings `kind`: the table `training` and what was `asked` for on the command line,
        which the table may not hold as well. Raises InputError for unknown keys."""
        if twice := sorted(asked.keys() & self.training):
            raise InputError(f"training.{twice[0]} is set on the command line, not in the configuration file.")
        return build(kind, {**self.training, **asked}, "training.")


@dataclass(frozen=True)
class Choice:
    """A setting that was chosen for these references: `key` ('model.graph') in the configuration file, its value, and
    the reason in a few words."""

    key: str
    value: Any
    reason: str

    def line(self) -> str:
        """Return it for people: 'model.graph = true: 28 molecules, atoms known by their bonds'."""
        shown = str(self.value).lower() if isinstance(self.value, bool) else self.value
        return f"{self.key} = {shown}: {self.reason}"


@dataclass(frozen=True)
class Settings:
    """The configuration of a model and of its training, as they will be used: frozen dataclasses.

    `settled`: names of those of the training that the command line decides (budget, seed, ...), and of those of the
    model that training finds; neither belongs into a configuration file.
    """

    model: Any
    training: Any
    settled: frozenset[str] = frozenset()

    def tables(self) -> dict[str, dict[str, Any]]:
        """Return the tables of the configuration file that gives these settings; what is None is left out."""
        found = {}
        for name, value in (("model", self.model), ("training", self.training)):
            if value is not None:
                record = value.to_dict() if name == "model" else {f.name: getattr(value, f.name) for f in fields(value)}
                found[name] = {key: v for key, v in record.items() if key not in self.settled}
        return found


@dataclass(frozen=True)
class Prepared:
    """A training whose references have been read and found fit: `start(advance)` does it and returns the weights."""

    scene: str
    start: Callable[[AdvanceFn], Path]


class Trainer(ABC):
    """Trains one architecture. `choose` and `settings` say how, `prepare` reads the frames."""

    # Fitted in one go: takes neither a budget nor settings.
    fitted: ClassVar[bool] = False
    # Knows how to go on from weights (`start_from`), and how to learn several spacings of frames (`longest_lag_ps`).
    goes_on: ClassVar[bool] = False
    learns_lags: ClassVar[bool] = False

    def check(self, request: TrainingRequest) -> None:
        """Raise InputError for what was asked for and means nothing here; no reference has been read yet."""
        if self.fitted:
            given = {"`budget_s`": request.budget_s, "`steps`": request.steps,
                     "`config`": request.model or request.training or None}  # fmt: skip
            _refuse(request.arch, [k for k, v in given.items() if v is not None], "is fitted in one go")
        elif request.budget_s is None and request.steps is None:
            raise InputError("say how long to train: `budget_s='30min'` or `steps=10000`.")
        unknown = []
        if request.start_from is not None and not self.goes_on:
            unknown.append("`start_from`")
        if request.longest_lag_ps is not None and not self.learns_lags:
            unknown.append("`longest_lag_ps`")
        _refuse(request.arch, unknown, "does not know it")
        if request.start_from is not None:
            if request.longest_lag_ps is not None:
                raise InputError("`start_from` takes the configuration of its weights; leave `longest_lag_ps` out.")
            if request.model:
                raise InputError("`start_from` takes the configuration of its weights; leave [model] of `config` out.")
            found = read_header(request.start_from).arch
            if found != request.arch:
                raise InputError(f"{request.start_from} holds {found}, not {request.arch}.")

    def choose(self, references: References, request: TrainingRequest) -> tuple[Choice, ...]:
        """Return the settings that suit the references where they differ from the defaults; those that the request
        has already stay as they are."""
        return ()

    @abstractmethod
    def settings(self, request: TrainingRequest) -> Settings:
        """Return all settings. Raises InputError for unknown keys and values that do not go together."""

    @abstractmethod
    def prepare(self, references: References, request: TrainingRequest) -> Prepared:
        """Read the frames. Raises InputError where they do not suit the settings."""


def _refuse(arch: str, options: list[str], why: str) -> None:
    if options:
        raise InputError(f"{', '.join(options)}: {arch} {why}; leave it out.")


def _copied(table: dict[str, Any]) -> dict[str, Any]:
    return {key: _copied(value) if isinstance(value, dict) else value for key, value in table.items()}
