"""The settings of one reference run, as records and checkpoints keep them, and whether two runs have the same."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from md_reference.forces.spec import ForceFieldSpec
from systems.errors import InputError, UnknownNameError, nearest
from systems.files.outside import check_disk
from systems.options import option
from systems.units import format_time_ps, whole_steps

if TYPE_CHECKING:
    from systems.scene import IntArray, Scene

# What `platform` says for replicas in vector registers (`md_reference.simd`); to OpenMM it is none.
SIMD = "simd"
ENSEMBLES = ("nvt", "nve", "npt")


@dataclass(frozen=True)
class Conditions:
    """What acts on a scene, and where it is computed. Temperature in K, friction in 1/ps, time step in ps.

    `ensemble`: 'nvt' (Langevin middle integrator, Zhang 2019), 'npt' (the same with a Monte Carlo barostat at
    `pressure_bar`; scenes with a cell only), or 'nve' (velocity Verlet).
    """

    force: ForceFieldSpec = field(default_factory=ForceFieldSpec)
    temperature_k: float = option("Thermostat temperature.", 300.0)
    friction_per_ps: float = option("Langevin friction coefficient.", 1.0)
    timestep_ps: float = option("Integration time step.", 0.004)
    ensemble: str = option("Ensemble: nvt, nve or npt.", "nvt")
    pressure_bar: float = option("Barostat pressure (npt).", 1.0)
    seed: int = 0
    platform: str = option(
        "OpenMM platform; auto: the fastest, timed here; simd: 16 replicas at once on one core.", "auto"
    )


@dataclass(frozen=True, kw_only=True)
class MDConfig(Conditions):
    """One run under these conditions. Times in ps; 'nve' starts from an equilibration in NVT."""

    time_ps: float = option("Simulated time, such as 10ns.")
    save_every_ps: float = option("Interval between saved frames.", 1.0)
    equilibrate_ps: float = option("Equilibration time before the first saved frame.", 100.0)
    starts: str = option(
        "Where replicas begin: many states, from hot MD, or one structure.", "many", choices=("many", "one")
    )
    keep: str = option("Atoms written from explicit water: solute, all or auto (solute on platform simd).", "auto")
    save_velocities: bool = option("Save velocities (.h5 only).", False)
    save_forces: bool = option("Save forces (.h5 only).", False)

    @property
    def steps_per_frame(self) -> int:
        return whole_steps(self.save_every_ps, self.timestep_ps, "save interval in time steps")

    @property
    def n_frames(self) -> int:
        return whole_steps(self.time_ps, self.save_every_ps, "run length in save intervals")

    def kept_atoms(self, scene: Scene) -> IntArray | None:
        """Return the atoms that are written, ascending, or None for all of them."""
        if scene.cell_nm is None or self.keep == "all" or (self.keep == "auto" and self.platform != SIMD):
            return None
        from md_reference.forces.mixture import solute_of

        solute = solute_of(scene)
        return None if len(solute) in (0, scene.n_atoms) else solute

    @property
    def columns(self) -> tuple[str, ...]:
        """What is stored of each frame beside positions."""
        wanted = {"velocities": self.save_velocities, "forces": self.save_forces}
        return tuple(name for name, asked in wanted.items() if asked)


def settings_of(config: MDConfig) -> dict[str, Any]:
    """Return the settings of a run as one level of names and plain values."""
    flat = asdict(config)
    force = flat.pop("force")
    return {**flat, **force}


def flat_settings(config: MDConfig) -> dict[str, Any]:
    """Return what `settings_of` does but the seed, which belongs to a run's place among others."""
    return {key: value for key, value in settings_of(config).items() if key != "seed"}


def check_same_run(old: dict[str, Any], config: MDConfig, out: Path, *, ignoring: tuple[str, ...] = ()) -> None:
    """Raise InputError unless a record or a checkpoint states the settings of `config`.

    A setting that an older version did not know counts as its default. A run may be resumed to become longer, never
    shorter.
    """
    before = settings_of(MDConfig(time_ps=config.time_ps)) | old
    for key, value in json.loads(json.dumps(settings_of(config))).items():
        if key not in ("time_ps", *ignoring) and before.get(key) != value:
            raise InputError(
                f"{out} was started with {key} = {before.get(key)!r}, not {value!r}; resume with the same settings "
                "or write to another file."
            )
    asked_ps = before["time_ps"]
    if not isinstance(asked_ps, int | float) or config.time_ps < asked_ps:
        length = format_time_ps(asked_ps) if isinstance(asked_ps, int | float) else repr(asked_ps)
        raise InputError(
            f"{out} was started for {length} and cannot become shorter; resume with as much or more, or write to "
            "another file."
        )


def resolved(scene: Scene, config: MDConfig) -> MDConfig:
    """Return the settings with force field, solvent and ensemble resolved for this scene (solvated, where the solvent
    is explicit): the one value that every later stage of a run takes.

    Raises UnknownNameError (with the nearest name), InputError for a constant pressure without a periodic cell, and
    what `forcefield.resolve` raises.
    """
    from md_reference.forces.forcefield import resolve  # the builders of forces are slow to import

    if config.keep not in ("auto", "solute", "all"):
        raise UnknownNameError(f"unknown `keep` {config.keep!r}; known: solute, all, auto.")
    ensemble = config.ensemble.lower()
    if ensemble not in ENSEMBLES:
        raise UnknownNameError(
            f"unknown ensemble {config.ensemble!r}; known: {', '.join(ENSEMBLES)}." + nearest(ensemble, list(ENSEMBLES))
        )
    if ensemble == "npt" and scene.cell_nm is None:
        raise InputError(
            f"ensemble npt needs a volume, and scene {scene.name!r} has no periodic cell; use nvt, or give an explicit "
            "`solvent`."
        )
    return replace(config, force=resolve(scene, config.force), ensemble=ensemble)


def check_run(scene: Scene, config: MDConfig, out: Path) -> MDConfig:
    """Return the settings `resolved` for this scene, before anything is computed.

    Raises UnitError for uneven intervals, InputError for what `out` cannot hold or the scene cannot have.
    """
    _ = config.steps_per_frame
    config = resolved(scene, config)
    kept = config.kept_atoms(scene)
    check_disk(out, config.n_frames, scene.n_atoms if kept is None else len(kept))
    from systems.trajectory.codec import refuse_columns  # which is slow to import

    refuse_columns(out, config.columns)
    return config
