"""The TOML file of a campaign: scenes x temperatures x replicas with the settings of a reference run, checked whole."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from glob import glob
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast

from md_reference.campaign.manifest import file_sha256
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import MDConfig, resolve_settings, to_config
from systems.errors import InputError, SurromdError, nearest
from systems.files.schema import built, fitted
from systems.library.named_scenes import entry as library_entry
from systems.library.named_scenes import find_protocol
from systems.options import Preparation, options_of, read_toml
from systems.units import quantity

T = TypeVar("T")
SCENE_FILES = (".pdb", ".ent", ".cif", ".mmcif", ".gz", ".sdf", ".mol", ".mol2")
_LONGEST_NAME, _MOST_RUNS = 40, 100_000
_SEEDS = 2**31


@dataclass(frozen=True)
class SceneSpec:
    """One scene: its name in the campaign, what `prepare` is given, and the hash of the file that this names."""

    name: str
    source: str
    source_sha256: str
    preparation: dict[str, Any]


@dataclass(frozen=True)
class Run:
    """One replica of one scene at one temperature; `file` is relative to the campaign's folder."""

    name: str
    scene: str
    replica: int
    config: MDConfig
    file: str


@dataclass(frozen=True)
class Campaign:
    """Everything a campaign's file says, with every run spelled out."""

    name: str
    file: Path
    folder: Path
    seed: int
    scenes: tuple[SceneSpec, ...]
    runs: tuple[Run, ...]
    retries: int = 2


@dataclass(frozen=True)
class Settings:
    """What one table says: fields of MDConfig and ForceFieldSpec by name, options of `prepare`, and the axes."""

    values: dict[str, Any]
    preparation: dict[str, Any]
    axes: dict[str, Any]


@dataclass(frozen=True)
class _Head:
    """What a campaign's file says beside what its runs are like."""

    scenes: tuple[str | dict[str, Any], ...]
    name: str = ""
    out: str = ""
    format: Literal["h5", "dcd", "xtc"] = "h5"
    seed: Annotated[int, range(2**63)] = 0
    retries: Annotated[int, range(1000)] = 2


@dataclass(frozen=True)
class _SceneHead:
    """What a scene's table says beside what its runs are like."""

    scene: str
    name: str = ""


def read_campaign(path: str | Path, *, folder: str | Path | None = None) -> Campaign:
    """Return the campaign that a TOML file describes; paths in it are relative to the file's folder. `folder` replaces
    the file's own `out`. Raises InputError, in one line, for unknown keys (with the nearest known), values of the wrong
    kind, scenes named twice, and settings that no run can have."""
    path = Path(path)
    table = read_toml(path)
    try:
        return _campaign(table, path, None if folder is None else Path(folder))
    except (ValueError, InputError) as error:
        said = f"{error}." if isinstance(error, ValueError) else str(error)
        raise InputError(said if str(path) in said else f"{path}: {said}") from error


# What a table says of its runs beside their settings.
_AXES = {"replicas": Annotated[int, range(1, _MOST_RUNS + 1)], "temperatures": tuple[float | str, ...], "protocol": str}
# How a scene is made, and how a run goes, by their keys in a file: what the command line takes.
_PREPARATION = options_of(Preparation) | options_of(WaterBox)
SETTINGS = {each.key: each for kind in (MDConfig, ForceFieldSpec) for each in options_of(kind).values()}


def _campaign(table: dict[str, Any], path: Path, folder: Path | None) -> Campaign:
    if not table.get("scenes"):
        raise InputError("name the scenes: scenes = ['alanine-dipeptide', ...], or a [[scenes]] table for each.")
    head, shared = _read(_Head, table, "")
    scenes: list[SceneSpec] = []
    runs: list[Run] = []
    for number, entry in enumerate(_scene_tables(head, path.parent)):
        where = f"scenes[{number}] ({entry['scene']}): "
        own_head, own = _read(_SceneHead, entry, where)
        spec = _scene_spec(own_head, {**shared.preparation, **own.preparation}, path.parent, where)
        # Some file systems take A and a for the same.
        if spec.name.lower() in {other.name.lower() for other in scenes}:
            raise InputError(f"two scenes are called {spec.name!r}; give one of them a name of its own (name = ...).")
        scenes.append(spec)
        try:
            runs += _runs_of(spec, shared, own, head)
        except SurromdError as error:
            raise InputError(f"scene {spec.name!r}: {error}") from error
    if len(runs) > _MOST_RUNS:
        raise InputError(f"{len(runs)} runs are too many, {_MOST_RUNS} at most; write several campaigns.")
    return Campaign(
        name=head.name or path.stem,
        folder=path.parent / (head.out or path.stem) if folder is None else Path(fitted(str(folder), str, "out")),
        seed=head.seed,
        scenes=tuple(scenes),
        runs=tuple(runs),
        retries=head.retries,
        file=path,
    )


def _read(kind: type[T], table: dict[str, Any], where: str) -> tuple[T, Settings]:
    """Return what a table says of itself and of its runs: axes, preparation and settings, unknown keys refused."""
    own = {f.name for f in fields(cast(Any, kind))}
    settings = read_settings({key: value for key, value in table.items() if key not in own}, others=own, where=where)
    return built(kind, {key: value for key, value in table.items() if key in own}, where), settings


def read_settings(table: dict[str, Any], *, others: Iterable[str] = (), where: str = "") -> Settings:
    """Return a table's settings, in our units. Raises InputError for a key that is unknown (with the nearest; `others`
    are keys the caller has read), and InputError or ValueError for values of the wrong kind."""
    found = Settings({}, {}, {})
    for key, value in table.items():
        if key in _AXES:
            found.axes[key] = fitted(value, _AXES[key], f"{where}{key}")
        elif key in _PREPARATION:
            found.preparation[key] = _PREPARATION[key].value(value, f"{where}{key}")
        elif key in SETTINGS:
            found.values[SETTINGS[key].name] = SETTINGS[key].written(value, f"{where}{key}")
        else:
            meant = nearest(key, [*SETTINGS, *_PREPARATION, *_AXES, *others])
            raise InputError(f"{where}unknown key {key!r}.{meant}")
    return found


def _scene_tables(head: _Head, base: Path) -> list[dict[str, Any]]:
    """Return one table per scene; a pattern such as `pdb/*.pdb` stands for its files, in order of name."""
    found: list[dict[str, Any]] = []
    for number, listed in enumerate(head.scenes):
        entry = {"scene": listed} if isinstance(listed, str) else listed
        text = fitted(entry.get("scene"), str, f"scenes[{number}].scene").strip()
        paths = [text]
        if "*" in text and not _kind(text):
            paths = sorted(glob(text, root_dir=base, recursive=True))
            if not paths:
                raise InputError(f"scenes[{number}]: no file matches {text}.")
            if "name" in entry:
                raise InputError(f"scenes[{number}]: one name cannot serve the {len(paths)} files of {text}.")
        found += [{**entry, "scene": path} for path in paths]
    return found


def _kind(text: str) -> str:
    """`sequence` of `sequence:ACE-ALA-NME`, `smiles` of `smiles:CCO`, else nothing."""
    kind, colon, _ = text.partition(":")
    return kind if colon and kind.lower() in ("sequence", "smiles") else ""


def _scene_spec(head: _SceneHead, preparation: dict[str, Any], base: Path, where: str) -> SceneSpec:
    source, digest = head.scene, ""
    if _kind(source):
        pass
    elif Path(source).suffix.lower() in SCENE_FILES or "/" in source:
        path = (base / source).resolve()
        if not path.is_file():
            raise InputError(f"{where}no such file: {path}.")
        source, digest = str(path), file_sha256(path)
    else:
        library_entry(source)  # an unknown name is refused now, with the nearest
    if head.name and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,99}", head.name):
        raise InputError(f"{where}name = {head.name!r} must be letters, digits and . _ + - (it names files).")
    return SceneSpec(head.name or name_of(source), source, digest, preparation)


def name_of(source: str) -> str:
    """A name for files: a file's stem, a sequence, a SMILES with what files cannot have replaced, and then a hash."""
    kind = _kind(source)
    text = source.partition(":")[2] if kind else Path(source).name.removesuffix(".gz")
    return file_name_of(text if kind or "." not in text else text.rsplit(".", 1)[0], source, kind)


def file_name_of(name: str, source: str = "", kind: str = "") -> str:
    """A name that files can have, of one that need not be: where they differ with a hash of `source`, else of it."""
    plain = re.sub(r"[^A-Za-z0-9._+-]+", "_", name).strip("._-+")[:_LONGEST_NAME]
    # SMILES differ in case and in signs that file names cannot have.
    if plain == name and kind.lower() != "smiles":
        return name
    return f"{plain or kind or 'scene'}-{sha256((source or name).encode()).hexdigest()[:6]}"


def _runs_of(spec: SceneSpec, shared: Settings, own: Settings, head: _Head) -> list[Run]:
    shared, protocol = _by_protocol(shared, own)
    # Nobody trains on the water of a hundred runs.
    given = {"keep": "solute", **shared.values, **own.values}
    values, _ = resolve_settings("" if _kind(spec.source) else spec.source, given, protocol)
    axes = {**shared.axes, **own.axes}
    # A single temperature of the scene's own outweighs the campaign's list.
    if "temperature_k" in own.values and "temperatures" not in own.axes:
        axes.pop("temperatures", None)
    elif "temperatures" in axes and "temperature_k" in (own if "temperatures" in own.axes else shared).values:
        raise InputError("give temperature or temperatures, not both.")
    replicas, temperatures = axes.get("replicas", 1), [values["temperature_k"]]
    if "temperatures" in axes:
        temperatures = [quantity("temperature_k", str(entry), "temperatures") for entry in axes["temperatures"]]
    if not 0 < replicas * len(temperatures) <= _MOST_RUNS:
        raise InputError(f"{replicas} x {len(temperatures)} temperatures: from 1 to {_MOST_RUNS} runs are made.")
    runs = []
    for temperature_k in temperatures:
        asked = {**values, "temperature_k": temperature_k}
        base = to_config(asked, seed=0)
        first = first_seed(head.seed, spec.name, base.temperature_k)
        for replica in range(replicas):
            label = f"{base.temperature_k:g}K"
            name = f"{spec.name}_{label}_r{replica}"
            config = to_config(asked, seed=(first + replica) % _SEEDS)
            _ = config.n_frames, config.steps_per_frame  # intervals that do not divide are refused here
            runs.append(Run(name, spec.name, replica, config, f"{spec.name}/{label}/{name}.{head.format}"))
    if len({run.name for run in runs}) < len(runs):
        raise InputError("a temperature is listed twice.")
    return runs


def _by_protocol(shared: Settings, own: Settings) -> tuple[Settings, str | None]:
    """Return the protocol that a scene's runs go by, and the campaign's settings without what it outweighs: a protocol
    of the scene's own outweighs what the campaign says, that of the campaign does not."""
    name = own.axes.get("protocol")
    if name is None:
        return shared, shared.axes.get("protocol")
    decided = find_protocol(name).settings
    values = {key: value for key, value in shared.values.items() if key not in decided}
    axes = {key: value for key, value in shared.axes.items() if key != "protocol"}
    if "temperature_k" in decided:
        axes.pop("temperatures", None)
    return replace(shared, values=values, axes=axes), name


def first_seed(seed: int, scene: str, temperature_k: float) -> int:
    """Return the seed of replica 0; replica k adds k. It depends on what the run is, never on when it is started."""
    digest = sha256(f"{seed}/{scene}/{temperature_k!r}".encode()).digest()
    return int.from_bytes(digest[:4], "big") % _SEEDS
