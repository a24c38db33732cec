"""An architecture as a value: its settings, its model, its training, the references it suits; and which there are.

A package offers one by an entry point of the group `surromd.architectures`:

    [project.entry-points."surromd.architectures"]
    my-model = "my_package:MY_MODEL"

with `MY_MODEL = Architecture("my-model", MyConfig.from_dict, MyModel, my_trainer)`.
"""

from __future__ import annotations

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

from systems.errors import InputError, UnknownNameError, first_line, nearest
from systems.files.schema import built

if TYPE_CHECKING:
    from surrogate.data import References, Survey
    from surrogate.models.propagator import Propagator


T = TypeVar("T")


def build(cls: type[T], record: dict[str, Any], prefix: str = "") -> T:
    """Return the settings `cls` of a record. Raises InputError as `systems.files.schema.built` does."""
    try:
        return built(cls, record, prefix)
    except ValueError as error:
        raise InputError(f"settings: {error}.") from error


class ModelConfig:
    """Base of a model's settings, a frozen dataclass: as a record, which weights files keep, and back."""

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)  # type: ignore[call-overload]

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> Self:
        """Raises InputError for an unknown key, naming the nearest."""
        return build(cls, record)


def toml_text(record: dict[str, Any], table: str = "") -> str:
    """Return a record of texts, numbers, booleans, lists of these, and tables as TOML, without values that are None."""
    kept = {key: value for key, value in record.items() if value is not None}
    # JSON's texts, booleans, finite numbers and lists are TOML's.
    lines = [f"{key} = {json.dumps(value)}" for key, value in kept.items() if not isinstance(value, dict)]
    text = "".join(f"{line}\n" for line in lines)
    if table and (lines or not kept):
        text = f"[{table}]\n{text}"
    for key, value in kept.items():
        if isinstance(value, dict):
            text += ("\n" if text else "") + toml_text(value, f"{table}.{key}" if table else key)
    return text


@dataclass(frozen=True)
class Architecture:
    """One kind of surrogate, under the name that weights files and `arch` have for it.

    `config` builds a configuration from a record (InputError for unknown keys), `model` the network from that.
    `trainer` returns its `Trainer`; rollouts do not call it, so that it may import what only training needs.
    `suits` returns a rank and a reason for architectures that are trained on such references without being named (of
    several the one of the highest rank), else None.
    """

    name: str
    config: Callable[[dict[str, Any]], Any]
    model: Callable[[Any], Propagator]
    trainer: Callable[[], Any]
    suits: Callable[[Survey], tuple[int, str] | None] = lambda survey: None


# Settings of trainings that the command line decides.
RESOLVED = frozenset({"budget_s", "steps", "seed", "device"})
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
        tables = {"model": deepcopy(self.model), "training": deepcopy(self.training)}
        for choice in choices:
            *path, last = choice.key.split(".")
            table: dict[str, Any] = tables
            for name in path:
                table = table.setdefault(name, {})
            table[last] = choice.value
        return replace(self, model=tables["model"], training=tables["training"])

    def settings(self, kind: type[T], asked: dict[str, Any] | None = None) -> T:
        """Return the training's settings `kind`: the table `training` and what was `asked` for on the command line
        (`RESOLVED` if None), which the table may not hold as well. Raises InputError for unknown keys."""
        asked = {name: getattr(self, name) for name in RESOLVED} if asked is None else asked
        if twice := sorted(asked.keys() & self.training):
            raise InputError(f"training.{twice[0]} is set on the command line, not in the configuration file.")
        return build(kind, {**self.training, **asked}, "training.")


@dataclass(frozen=True)
class Choice:
    """A setting that was chosen for these references: `key` ('model.longest_ps') in the configuration file, its value,
    and the reason in a few words."""

    key: str
    value: Any
    reason: str

    def line(self) -> str:
        """Return it for people: 'model.longest_ps = 900.0: as far as every reference reaches'."""
        return f"{self.key} = {json.dumps(self.value)}: {self.reason}"


@dataclass(frozen=True)
class Settings:
    """The configuration of a model and of its training, as they will be used: frozen dataclasses. `resolved`: names of
    what the command line decides (budget, seed, ...) and training finds, which no configuration file holds."""

    model: Any
    training: Any
    resolved: frozenset[str] = frozenset()

    def tables(self) -> dict[str, dict[str, Any]]:
        """Return the tables of the configuration file that gives these settings; what is None is left out."""
        both = {name: asdict(value) for name, value in vars(self).items() if name != "resolved" and value is not None}
        return {name: {k: v for k, v in table.items() if k not in self.resolved} for name, table in both.items()}


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
        asked = {
            "`budget_s`": request.budget_s is not None and self.fitted,
            "`steps`": request.steps is not None and self.fitted,
            "`config`": bool(request.model or request.training) and self.fitted,
            "`start_from`": request.start_from is not None and not self.goes_on,
            "`longest_lag_ps`": request.longest_lag_ps is not None and not self.learns_lags,
        }
        if meaningless := [name for name, is_given in asked.items() if is_given]:
            raise InputError(f"{request.arch} takes no {', '.join(meaningless)}; leave it out.")
        if not self.fitted and request.budget_s is None and request.steps is None:
            raise InputError("say how long to train: `budget_s='30min'` or `steps=10000`.")
        if request.start_from is not None and (request.longest_lag_ps is not None or request.model):
            which = "[model] of `config`" if request.model else "`longest_lag_ps`"
            raise InputError(f"`start_from` takes the configuration of its weights; leave {which} out.")

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


GROUP = "surromd.architectures"
# Those of this package, as entry points name them; loaded when they are used.
_OURS = {
    "lam-slide": "surrogate.models.lam_slide.trainer:LAM_SLIDE",
    "lam-slide-peptides": "surrogate.models.peptides.trainer:PEPTIDES",
    "painet": "surrogate.models.painet.model:PAINET",
    "painet-potential": "surrogate.models.painet.potential_trainer:PAINET_POTENTIAL",
    "egnn": "surrogate.models.painet.model:EGNN",
    "frozen": "surrogate.models.baselines:FROZEN",
    "resampling": "surrogate.models.baselines:RESAMPLING",
    "normal-modes": "surrogate.models.baselines:NORMAL_MODES",
}


def names() -> list[str]:
    """Return the names of all installed architectures; none is imported."""
    return sorted(_found())


@cache
def architecture(name: str) -> Architecture:
    """Return the architecture of this name. Raises UnknownNameError, naming the nearest, and InputError where its
    package cannot be imported or offers something else under that name."""
    found = _found().get(name)
    if found is None:
        raise UnknownNameError(f"unknown architecture {name!r}; known: {', '.join(names())}.{nearest(name, names())}")
    try:
        loaded = found.load()
    except (ImportError, AttributeError) as error:
        raise InputError(f"architecture {name!r} ({found.value}) cannot be loaded: {first_line(error)}.") from error
    if not isinstance(loaded, Architecture) or loaded.name != name:
        raise InputError(f"architecture {name!r}: {found.value} is no Architecture of this name; correct its package.")
    return loaded


@cache
def _found() -> dict[str, EntryPoint]:
    """Return the entry points by name. Raises InputError where two packages offer different ones under one name."""
    found = {name: EntryPoint(name, value, GROUP) for name, value in _OURS.items()}
    for point in entry_points(group=GROUP):
        if point.dist is not None and point.dist.name == "surromd":
            continue  # left by the installation of an earlier version
        known = found.setdefault(point.name, point)
        if known.value != point.value:
            raise InputError(
                f"two installed packages offer the architecture {point.name!r} ({known.value} and {point.value}); "
                "uninstall one."
            )
    return found


_FOLDER = Path(__file__).parents[1] / "pretrained"


def shipped_weights() -> dict[str, Path]:
    """Return the files of the weights that are shipped, by name."""
    return {p.stem: p for p in sorted(_FOLDER.glob("*.safetensors"))}


def weights_path(weights: str | os.PathLike[str]) -> Path:
    """Return the file of shipped weights by name, or the path itself. Raises UnknownNameError, naming the nearest, or
    InputError where there is no such file."""
    path = Path(weights)
    if path.suffix == ".safetensors" or path.exists():
        if not path.is_file():
            raise InputError(f"{path}: no such weights file.")
        return path
    shipped = shipped_weights()
    if str(weights) not in shipped:
        raise UnknownNameError(
            f"no weights are called {str(weights)!r}; shipped: {', '.join(shipped) or 'none'}."
            f"{nearest(str(weights), list(shipped))} A trained file is named by its path (.safetensors)."
        )
    return shipped[str(weights)]
