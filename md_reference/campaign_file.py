"""The TOML file of a campaign: scenes x temperatures x replicas with the settings of a reference run, checked whole."""

from __future__ import annotations

import inspect
import re
import tomllib
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from md_reference.campaign_settings import Settings, read_settings, to_config
from md_reference.protocol import settle_by_name
from md_reference.run_config import MDConfig
from systems.errors import InputError, SurromdError, nearest
from systems.protocols import find_protocol
from systems.units import parse_temperature_k, parse_wall_s

SUFFIXES = ("h5", "dcd")
_SCENE_FILES = (".pdb", ".ent", ".cif", ".mmcif", ".gz", ".sdf", ".mol", ".mol2")
# Batch systems that dask-jobqueue knows; `local` starts the same jobs as processes here, to try a file out.
CLUSTER_KINDS = ("slurm", "pbs", "sge", "lsf", "htcondor", "moab", "oar", "local")
# Folder of the batch system's logs, inside the campaign's.
JOB_LOGS = "jobs"
_LONGEST_NAME = 40
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
class ClusterSpec:
    """What is asked of a batch system, through dask-jobqueue: `jobs` jobs at most, each with `cores` runs at a time.

    `interface`: the network interface on which scheduler and workers talk. `dashboard`: where Dask's status page is to
    be shown (`127.0.0.1:8787`); whoever can reach it sees it. Without it there is none.
    """

    kind: str
    jobs: int = 1
    cores: int = 1
    memory: str = "2GB"
    walltime: str = ""
    queue: str = ""
    account: str = ""
    interface: str = ""
    dashboard: str = ""
    python: str = ""
    directives: tuple[str, ...] = ()
    prologue: tuple[str, ...] = ()


@dataclass(frozen=True)
class Campaign:
    """Everything a campaign's file says, with every run spelled out."""

    name: str
    folder: Path
    seed: int
    scenes: tuple[SceneSpec, ...]
    runs: tuple[Run, ...]
    retries: int = 2
    checkpoint_every_s: float = 20.0
    cluster: ClusterSpec | None = None
    text: str = field(default="", compare=False)


def read_campaign(path: str | Path, *, folder: str | Path | None = None) -> Campaign:
    """Return the campaign that a TOML file describes; paths in it are relative to the file's folder.

    `folder` replaces the file's own `out`. Raises InputError, in one line, for unknown keys (with the nearest known),
    values of the wrong kind, scenes named twice, and settings that no run can have.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        table = tomllib.loads(text)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file.") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as TOML: {error}.") from error
    try:
        return _campaign(table, path, text, None if folder is None else Path(folder))
    except InputError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


_CAMPAIGN_KEYS = ("name", "out", "format", "seed", "retries", "checkpoint_every", "scenes", "cluster")
_SCENE_KEYS = ("scene", "name")
# What a table says of its runs beside their settings.
_AXIS_KEYS = ("replicas", "temperatures", "protocol")


def _campaign(table: dict[str, Any], path: Path, text: str, folder: Path | None) -> Campaign:
    shared = _own_settings(table, _CAMPAIGN_KEYS, "")
    suffix = _text(table, "format", "h5")
    if suffix not in SUFFIXES:
        raise InputError(f"format {suffix!r} is not written; known: {', '.join(SUFFIXES)}.")
    seed = _whole(table, "seed", 0, least=0)
    scenes: list[SceneSpec] = []
    runs: list[Run] = []
    for number, entry in enumerate(_scene_tables(table, path.parent)):
        where = f"scenes[{number}] ({entry.get('scene', '?')})"
        spec = _scene_spec(entry, shared, path.parent, where)
        # Some file systems take A and a for the same.
        if spec.name.lower() in {other.name.lower() for other in scenes}:
            raise InputError(f"two scenes are called {spec.name!r}; give one of them a name of its own (name = ...).")
        scenes.append(spec)
        try:
            runs += _runs_of(spec, shared, _own_settings(entry, _SCENE_KEYS, where), seed, suffix)
        except SurromdError as error:
            raise InputError(f"scene {spec.name!r}: {error}") from error
    name = _text(table, "name", path.stem)
    out = folder if folder is not None else path.parent / _text(table, "out", path.stem)
    return Campaign(
        name=name,
        folder=out,
        seed=seed,
        scenes=tuple(scenes),
        runs=tuple(runs),
        retries=_whole(table, "retries", 2, least=0),
        checkpoint_every_s=parse_wall_s(_text(table, "checkpoint_every", "20s"), "checkpoint_every"),
        cluster=_cluster(table),
        text=text,
    )


def _own_settings(table: dict[str, Any], others: tuple[str, ...], where: str) -> Settings:
    """Return what a table says of runs: axes, preparation and settings, unknown keys refused."""
    return read_settings(
        {key: value for key, value in table.items() if key not in others},
        axes=_AXIS_KEYS,
        preparation=_preparation_defaults(),
        others=others,
        where=where,
    )


def _preparation_defaults() -> dict[str, Any]:
    """The switches of `prepare` and `solvate`, with their defaults: a campaign takes what the command line takes."""
    from md_reference.solvation import solvate
    from systems.prepare import prepare

    return keyword_defaults(prepare) | keyword_defaults(solvate)


def keyword_defaults(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the parameters of a function that have defaults, but its seed."""
    parameters = inspect.signature(function).parameters.values()
    return {p.name: p.default for p in parameters if p.default is not p.empty and p.name != "seed"}


def _scene_tables(table: dict[str, Any], base: Path) -> list[dict[str, Any]]:
    """Return one table per scene; a pattern such as `pdb/*.pdb` stands for its files, in order of name."""
    listed = table.get("scenes")
    if not isinstance(listed, list) or not listed:
        raise InputError("name the scenes: scenes = ['alanine-dipeptide', ...], or a [[scenes]] table for each.")
    found: list[dict[str, Any]] = []
    for number, entry in enumerate(listed):
        if isinstance(entry, str):
            entry = {"scene": entry}
        if not isinstance(entry, dict) or not isinstance(entry.get("scene"), str) or not entry["scene"].strip():
            raise InputError(f"scenes[{number}] must be a text or a table with scene = '...'.")
        text = entry["scene"].strip()
        if "*" in text and not _kind(text):
            paths = sorted(base.glob(text)) if not Path(text).is_absolute() else sorted(Path("/").glob(text[1:]))
            if not paths:
                raise InputError(f"scenes[{number}]: no file matches {text}.")
            if "name" in entry:
                raise InputError(f"scenes[{number}]: one name cannot serve the {len(paths)} files of {text}.")
            found += [{**entry, "scene": str(path)} for path in paths]
        else:
            found.append({**entry, "scene": text})
    return found


def _kind(text: str) -> str:
    """`sequence` of `sequence:ACE-ALA-NME`, `smiles` of `smiles:CCO`, else nothing."""
    kind, colon, _ = text.partition(":")
    return kind if colon and kind.lower() in ("sequence", "smiles") else ""


def _scene_spec(entry: dict[str, Any], shared: Settings, base: Path, where: str) -> SceneSpec:
    source, digest = entry["scene"], ""
    if not _kind(source) and (Path(source).suffix.lower() in _SCENE_FILES or "/" in source):
        path = (base / source).resolve()
        if not path.is_file():
            raise InputError(f"{where}: no such file: {path}.")
        source, digest = str(path), sha256(path.read_bytes()).hexdigest()
    elif not _kind(source):
        from systems import library

        library.describe(source)  # an unknown name is refused now, with the nearest
    name = entry.get("name", "")
    if not isinstance(name, str) or (name and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+-]*", name)):
        raise InputError(f"{where}: name = {name!r} must be letters, digits and . _ + - (it names files).")
    own = _own_settings(entry, _SCENE_KEYS, where)
    return SceneSpec(name or _name_of(source), source, digest, {**shared.preparation, **own.preparation})


def _name_of(source: str) -> str:
    """A name for files: a file's stem, a sequence, a SMILES with what files cannot have replaced, and then a hash."""
    kind = _kind(source)
    text = source.partition(":")[2] if kind else Path(source).name.removesuffix(".gz")
    stem = text if kind or "." not in text else text.rsplit(".", 1)[0]
    plain = re.sub(r"[^A-Za-z0-9._+-]+", "_", stem).strip("._-+")[:_LONGEST_NAME]
    if plain == stem and kind.lower() != "smiles":
        return plain
    # SMILES differ in case and in signs that file names cannot have.
    return f"{plain or kind or 'scene'}-{sha256(source.encode()).hexdigest()[:6]}"


def _runs_of(spec: SceneSpec, shared: Settings, own: Settings, seed: int, suffix: str) -> list[Run]:
    shared, protocol = _by_protocol(shared, own)
    given = {**shared.values, **own.values}
    values, _ = settle_by_name("" if _kind(spec.source) else spec.source, given, protocol)
    axes = {**shared.axes, **own.axes}
    # A single temperature of the scene's own outweighs the campaign's list.
    if "temperature_k" in own.values and "temperatures" not in own.axes:
        axes.pop("temperatures", None)
    elif "temperatures" in axes and "temperature_k" in (own if "temperatures" in own.axes else shared).values:
        raise InputError("give temperature or temperatures, not both.")
    replicas = _whole(axes, "replicas", 1, least=1)
    temperatures = _temperatures(axes["temperatures"]) if "temperatures" in axes else [values["temperature_k"]]
    runs = []
    for temperature_k in temperatures:
        asked = {**values, "temperature_k": temperature_k}
        base = to_config(asked, seed=0)
        first = first_seed(seed, spec.name, base.temperature_k)
        for replica in range(replicas):
            label = f"{base.temperature_k:g}K"
            name = f"{spec.name}_{label}_r{replica}"
            config = to_config(asked, seed=(first + replica) % _SEEDS)
            _ = config.n_frames, config.steps_per_frame  # intervals that do not divide are refused here
            runs.append(Run(name, spec.name, replica, config, f"{spec.name}/{label}/{name}.{suffix}"))
    if len({run.name for run in runs}) < len(runs):
        raise InputError("a temperature is listed twice.")
    return runs


def _by_protocol(shared: Settings, own: Settings) -> tuple[Settings, str | None]:
    """Return the protocol that a scene's runs go by, and the campaign's settings without what it outweighs: a protocol
    of the scene's own outweighs what the campaign says, that of the campaign does not."""
    if "protocol" not in own.axes:
        return shared, _text(shared.axes, "protocol", "") or None
    name = _text(own.axes, "protocol", "")
    decided = find_protocol(name).settings
    values = {key: value for key, value in shared.values.items() if key not in decided}
    left_out = ("protocol", "temperatures") if "temperature_k" in decided else ("protocol",)
    return replace(shared, values=values, axes={k: v for k, v in shared.axes.items() if k not in left_out}), name


def first_seed(seed: int, scene: str, temperature_k: float) -> int:
    """Return the seed of replica 0; replica k adds k. It depends on what the run is, never on when it is started."""
    digest = sha256(f"{seed}/{scene}/{temperature_k!r}".encode()).digest()
    return int.from_bytes(digest[:4], "big") % _SEEDS


def _temperatures(listed: Any) -> list[float]:
    if not isinstance(listed, list) or not listed:
        raise InputError("temperatures must be a list, such as ['300K', '350K'].")
    return [parse_temperature_k(str(entry), "temperatures") for entry in listed]


def _text(table: dict[str, Any], key: str, default: str) -> str:
    value = table.get(key, default)
    if not isinstance(value, str) or (key in table and not value):
        raise InputError(f"{key} = {value!r} must be a text.")
    return value


def _whole(table: dict[str, Any], key: str, default: int, *, least: int) -> int:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise InputError(f"{key} = {value!r} must be a whole number, {least} or more.")
    return value


def _cluster(table: dict[str, Any]) -> ClusterSpec | None:
    if "cluster" not in table:
        return None
    given = table["cluster"]
    if not isinstance(given, dict) or "kind" not in given:
        raise InputError("[cluster] needs kind = 'slurm' (or another of dask-jobqueue's).")
    known = {f.name: f for f in fields(ClusterSpec)}
    values: dict[str, Any] = {}
    for key, value in given.items():
        if key not in known:
            raise InputError(f"[cluster] has no key {key!r}.{nearest(key, list(known))}")
        default = known[key].default
        if default is MISSING or isinstance(default, str):
            values[key] = _text(given, key, "")
        elif isinstance(default, int):
            values[key] = _whole(given, key, 1, least=1)
        elif not isinstance(value, list) or not all(isinstance(line, str) for line in value):
            raise InputError(f"[cluster] {key} must be a list of texts.")
        else:
            values[key] = tuple(value)
    if values["kind"] not in CLUSTER_KINDS:
        meant = nearest(values["kind"], list(CLUSTER_KINDS))
        raise InputError(f"[cluster] kind {values['kind']!r} is not one of {', '.join(CLUSTER_KINDS)}.{meant}")
    return ClusterSpec(**values)
