"""The settings of one reference run: what the user gave, else the protocol asked for by name, else the program's
defaults; and whether two runs have the same. Model systems bring settings of their own."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from md_reference.forces.spec import QUANTUM, ForceFieldSpec
from md_reference.forces.umbrella import Umbrella
from systems.errors import InputError, UnknownNameError, nearest
from systems.files.outside import check_disk
from systems.options import option
from systems.units import format_quantity, format_time_ps, stem_of, unit_of, whole_steps

if TYPE_CHECKING:
    from systems.scene import IntArray, Scene


# What `platform` says for replicas in vector registers (`md_reference.simd`); to OpenMM it is none.
SIMD = "simd"


@dataclass(frozen=True)
class Conditions:
    """What acts on a scene, and where it is computed. Temperature in K, friction in 1/ps, time step in ps. `ensemble`:
    'nvt' (Langevin middle integrator, Zhang 2019), 'npt' (the same with a Monte Carlo barostat at `pressure_bar`;
    scenes with a cell only), or 'nve' (velocity Verlet)."""

    force: ForceFieldSpec = field(default_factory=ForceFieldSpec)
    temperature_k: float = option("Thermostat temperature.", 300.0)
    friction_per_ps: float = option("Langevin friction coefficient.", 1.0)
    timestep_ps: float = option("Integration time step.", 0.004)
    ensemble: str = option("Ensemble: nvt, nve or npt.", "nvt")
    pressure_bar: float = option("Barostat pressure (npt).", 1.0)
    seed: int = 0
    platform: str = option("OpenMM platform; auto: by size; simd: 16 replicas at once on one core.", "auto")


@dataclass(frozen=True, kw_only=True)
class MDConfig(Conditions):
    """One run under these conditions. Times in ps; 'nve' starts from an equilibration in NVT. Under an `umbrella`
    frames have its energy beside them, in a column of their trajectory, and are not those of equilibrium."""

    time_ps: float = option("Simulated time, such as 10ns.")
    save_every_ps: float = option("Interval between saved frames.", 1.0)
    equilibrate_ps: float = option(
        "Equilibration of each replica before the first saved frame, beyond the time.", 100.0
    )
    starts: str = option(
        "Initial structures of replicas: many (diverse, from hot MD) or one (the input structure).",
        "many",
        choices=("many", "one"),
    )
    keep: str = option("Atoms to save in explicit water: solute, all or auto (all; solute on platform simd).", "auto")
    save_velocities: bool = option("Save velocities (.h5 only).", False)
    save_forces: bool = option("Save forces (.h5 only).", False)
    umbrella: Umbrella | None = None

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
        return ("velocities",) * self.save_velocities + ("forces",) * self.save_forces


def settings_of(config: MDConfig) -> dict[str, Any]:
    """Return the settings of a run as one level of names and plain values."""
    flat = asdict(config)
    force = flat.pop("force")
    return {**flat, **force}


def check_same_run(old: dict[str, Any], config: MDConfig, out: Path, *, ignoring: tuple[str, ...] = ()) -> None:
    """Raise InputError unless a record or a checkpoint states the settings of `config`. A setting that an older version
    did not know counts as its default. A run may be resumed to become longer, never shorter."""
    before = settings_of(MDConfig(time_ps=config.time_ps)) | old
    for key, value in json.loads(json.dumps(settings_of(config))).items():
        if key not in ("time_ps", *ignoring) and before.get(key) != value:
            raise InputError(
                f"{out} was started with {key} = {before.get(key)!r}, not {value!r}; resume with the same settings "
                "or write to another file."
            )
    asked_ps = before["time_ps"]
    is_time = isinstance(asked_ps, int | float)
    if not is_time or config.time_ps < asked_ps:
        raise InputError(
            f"{out} was started for {format_time_ps(asked_ps) if is_time else repr(asked_ps)} and cannot become "
            "shorter; resume with as much or more, or write to another file."
        )


def resolved(scene: Scene, config: MDConfig) -> MDConfig:
    """Return the settings with force field, solvent and ensemble resolved for this scene (solvated, where the solvent
    is explicit): the one value that every later stage of a run takes. Raises UnknownNameError, InputError for an
    ensemble that the scene or the platform cannot have, and what `forcefield.resolve` raises."""
    from md_reference.forces.forcefield import resolve  # the builders of forces are slow to import

    config = replace(config, ensemble=config.ensemble.lower())
    for what, value, known in (("ensemble", config.ensemble, ("nvt", "nve", "npt")),
                               ("`keep`", config.keep, ("auto", "solute", "all"))):  # fmt: skip
        if value not in known:
            raise UnknownNameError(f"unknown {what} {value!r}; known: {', '.join(known)}.{nearest(value, list(known))}")
    if config.ensemble == "npt" and scene.cell_nm is None:
        raise InputError(
            f"ensemble npt needs a volume, and scene {scene.name!r} has no periodic cell; use nvt, or give an explicit "
            "`solvent`."
        )
    if config.platform == SIMD and (config.ensemble != "nvt" or config.columns):
        raise InputError("platform simd supports only nvt and saves only positions; use another platform.")
    config = replace(config, force=resolve(scene, config.force))
    if config.ensemble == "nve" and config.force.solvent == "opc":
        # OpenMM's CustomIntegrator places virtual sites at the end of a step, after the forces were needed.
        raise InputError(
            "nve is not available with OPC: velocity Verlet does not move its virtual sites in time; use "
            "`solvent='tip3p'`, or nvt."
        )
    return config


def check_run(scene: Scene, config: MDConfig, out: Path) -> MDConfig:
    """Return the settings `resolved` for this scene, before anything is computed. Raises UnitError for uneven
    intervals, InputError for what `out` cannot hold or the scene cannot have."""
    _ = config.steps_per_frame
    config = resolved(scene, config)
    kept = config.kept_atoms(scene)
    check_disk(out, config.n_frames, scene.n_atoms if kept is None else len(kept))
    from systems.trajectory.codec import refuse_columns  # which is slow to import

    refuse_columns(out, config.columns)
    return config


# ---- defaults -------------------------------------------------------------------------------------------------------


# Bonds to hydrogen of natural mass swing in 9 fs; a longer step than this needs them rigid.
LONGEST_FLEXIBLE_STEP_PS = 0.001
# A quantum-mechanical force takes a thousand times as long as a classical one: steps are as long as they may be, with
# hydrogens so heavy and their bonds rigid, and flexible bonds of natural hydrogens, where asked for, get short ones.
LONGEST_QUANTUM_STEP_PS = 0.004
_HYDROGEN_MASS_DA = 3.0
_FLEXIBLE_QUANTUM_STEP_PS = 0.0005
_QUANTUM_EQUILIBRATION_PS = 1.0


def defaults() -> dict[str, Any]:
    """Return the program's own settings: those of MDConfig and ForceFieldSpec but the seed, the forces left open."""
    found: dict[str, Any] = {f.name: f.default for kind in (MDConfig, ForceFieldSpec) for f in fields(kind)
                             if f.default is not MISSING and f.name != "seed"}  # fmt: skip
    return found | {"force_field": "auto", "solvent": "auto"}


def resolve_settings(
    scene: Scene | str, given: Mapping[str, Any], protocol: str | None = None
) -> tuple[dict[str, Any], str]:
    """Return all settings of a run of a scene, or of what has this name, and a line about what its protocol decided,
    empty where nothing.

    `given` holds what the user asked for, by the names of MDConfig and ForceFieldSpec; `protocol` names a paper's. Its
    solvent goes with its force field and is left out when the user names another one; its flexible bonds are left out
    above a time step of 1 fs. Quantum forces have flexible bonds and natural hydrogens up to that step (at 0.5 fs if
    only these are asked for). Raises UnknownNameError, and InputError for a model system, whose settings are its own.
    """
    name = scene if isinstance(scene, str) else str(scene.provenance.get("library_name") or "")
    decisive, said_as = _decisive(name, protocol)
    if "force_field" in given:
        decisive.pop("solvent", None)
    own = defaults()
    if given.get("force_field") == QUANTUM:
        own |= _of_quantum(scene, decisive | dict(given))
        decisive.pop("equilibrate_ps", None)
    settings = own | decisive | dict(given)
    if settings["timestep_ps"] > LONGEST_FLEXIBLE_STEP_PS and "constrain_hydrogens" not in given:
        settings["constrain_hydrogens"] = True
    decided = {key: settings[key] for key in decisive if key not in given and settings[key] != own[key]}
    if not decided:
        return settings, ""
    what, source = said_as
    return settings, f"{what}: {', '.join(_say(key, value) for key, value in decided.items())} ({source})"


def to_config(values: Mapping[str, Any], *, seed: int) -> MDConfig:
    """Return a run of these settings, by the names of MDConfig and ForceFieldSpec; forces left open are resolved
    for its scene later. Raises InputError where its length is not given, and what the fields refuse."""
    if "time_ps" not in values:
        raise InputError("time is missing; write, for example, time = '10ns'.")
    of_forces = {f.name for f in fields(ForceFieldSpec)}
    force = {"force_field": "auto", "solvent": "auto"} | {k: v for k, v in values.items() if k in of_forces}
    own = {key: value for key, value in values.items() if key not in of_forces}
    return MDConfig(**own, seed=seed, force=ForceFieldSpec(**force))


def _longest_step_ps(scene: Scene | str) -> float:
    """Return the longest time step at quantum level with rigid bonds to hydrogen."""
    from systems.chemistry.graph import STIFF_STEP_PS, has_stiff_bond  # loads NumPy, for which help need not wait

    return STIFF_STEP_PS if not isinstance(scene, str) and has_stiff_bond(scene) else LONGEST_QUANTUM_STEP_PS


def _of_quantum(scene: Scene | str, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the defaults at quantum level beside what is asked for. Raises InputError for too long a step."""
    is_flexible = asked.get("constrain_hydrogens") is False or asked.get("hydrogen_mass_da", _HYDROGEN_MASS_DA) is None
    longest_ps = _longest_step_ps(scene)
    step_ps = asked.get("timestep_ps", _FLEXIBLE_QUANTUM_STEP_PS if is_flexible else longest_ps)
    if step_ps > longest_ps:
        from systems.chemistry.graph import STIFF_BOND

        what = STIFF_BOND if longest_ps < LONGEST_QUANTUM_STEP_PS else QUANTUM
        use = format_time_ps(longest_ps).replace(" ", "")
        raise InputError(f"{format_time_ps(step_ps)} is too long for {what}; use `timestep_ps='{use}'` or less.")
    is_long = step_ps > LONGEST_FLEXIBLE_STEP_PS
    heavy = {"hydrogen_mass_da": _HYDROGEN_MASS_DA if is_long else None, "constrain_hydrogens": is_long}
    return {"timestep_ps": step_ps, "equilibrate_ps": _QUANTUM_EQUILIBRATION_PS, **heavy}


def _decisive(name: str, protocol: str | None) -> tuple[dict[str, Any], tuple[str, str]]:
    """Return the settings that come before the program's defaults, and how they and their source are called."""
    from systems.library import named_scenes  # loads NumPy, for which help need not wait

    own = dict(named_scenes.entry(name).own_settings) if named_scenes.knows(name) else {}
    if protocol is None:
        return own, ("by the system's own settings", named_scenes.entry(name).source if own else "")
    if own:
        raise InputError(f"{name} defines its own potential and settings; leave `protocol` out.")
    found = named_scenes.find_protocol(protocol)
    return dict(found.settings), (f"by protocol {found.name}", found.source)


def _say(key: str, value: Any) -> str:
    text = "natural" if value is None else format_quantity(key, value) if unit_of(key) else str(value)
    return f"{stem_of(key).replace('_', ' ')} {text}"
