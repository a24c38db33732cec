"""The verb `info`: what a file is and where it came from. Files are recognised by what they hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from surrogate.models.architecture import shipped_weights
from surrogate.verbs.options import PathLike
from surrogate.verbs.run.run_record import RUN_NAME, RunResult
from surrogate.verbs.simulate import describe_campaign
from systems.chemistry.validity import INVALID
from systems.errors import InputError, OutOfDomainError, first_line
from systems.files.outside import UNREADABLE, content
from systems.files.schema import parsed
from systems.library.named_scenes import prepare
from systems.trajectory import joined
from systems.trajectory.codec import open_trajectory
from systems.units import format_time_ps

UNSEEN = "a molecule that the weights were not trained on: compare with MD of it before you trust it"


def info(path: PathLike, scene: str | None = None) -> dict[str, Any]:
    """Return what a trajectory, a windows or weights file or the folder of a campaign or a run is and where it came
    from (JSON-able). Shipped weights may be given by name.

    `scene`: anything that a rollout takes; of weights it is then said whether they cover it, and how near what they
    were trained on comes to it. Raises InputError when there is no such file, or `scene` is asked of other files,
    TrajectoryError or WeightsError when it is damaged.
    """
    named = Path(path) if Path(path).exists() else shipped_weights().get(str(path), Path(path))
    if scene is None:
        return describe_file(named) if not named.is_dir() else _run(named) or describe_campaign(named)
    if not named.exists():
        raise InputError(f"{path}: no such file, nor shipped weights of that name ({', '.join(shipped_weights())}).")
    if named.suffix.lower() != ".safetensors":
        raise InputError(f"{path} is no weights file; what covers {scene} can be asked of weights alone.")
    return _coverage(named, scene)


def _run(folder: Path) -> dict[str, Any] | None:
    """Return what the folder of a run, or of runs of many molecules, says of itself; None for another folder."""
    if (folder / RUN_NAME).is_file():
        return RunResult.of(folder)
    path = folder / "results.json"
    if not path.is_file():
        return None
    try:
        found = parsed(content(path))
        lines = {line["name"]: f"failed: {line['failed']}" if line["failed"] else line["headline"] for line in found}
    except UNREADABLE as error:
        raise InputError(f"{path} cannot be read as the record of a run ({first_line(error)}).") from None
    n_done = sum(not line["failed"] for line in found)
    summary = f"{n_done} of {len(found)} molecules evaluated"
    return {"file": str(folder), "type": "runs", "summary": summary, "molecules": lines}


def _coverage(path: Path, scene: str) -> dict[str, Any]:
    from surrogate.models.weights import load_weights
    from surrogate.sampling.domain import match_domain

    weights, prepared = load_weights(path), prepare(scene)
    try:
        match = match_domain(prepared, weights, force=True)
    except OutOfDomainError as error:
        return {"scene": prepared.name, "covered": "no", "reason": str(error)}
    unseen = "never saw this molecule" + (f"; {match.nearness}" if match.nearness else "")
    return {
        "scene": prepared.name,
        "covered": "only with force" if match.deviations else "yes",
        "training": "trained on this molecule" if match.seen else unseen,
        **({"reason": "; ".join(f"{d.what}: {d.reason}" for d in match.deviations)} if match.deviations else {}),
    }


def describe_file(path: Path) -> dict[str, Any]:
    """Return a JSON-able record of a file; `summary` is one line about it. Raises InputError when there is no such
    file, TrajectoryError or WeightsError when it is damaged."""
    from surrogate.data import is_windows

    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    if path.suffix.lower() == ".safetensors":
        return _weights(path)

    return _windows(path) if path.suffix.lower() in (".h5", ".hdf5") and is_windows(path) else _trajectory(path)


def _trajectory(path: Path) -> dict[str, Any]:
    from md_reference.run.run_summary import summary_lines

    with open_trajectory(path) as reader:
        times, flags, scene, record = reader.time_ps, reader.flags, reader.scene, dict(reader.record)
        n_frames, n_atoms = reader.n_frames, reader.n_atoms
    replicas = record.pop(joined.KEY, {}).get("replicas", [])
    lag_ps = float(np.median(np.diff(times))) if n_frames > 1 else None
    span = "" if lag_ps is None else f", {format_time_ps(n_frames * lag_ps)} at {format_time_ps(lag_ps)}"
    cost = record.get("cost") or {}
    wall = f", {cost['wall_s']:.3g} s" if "wall_s" in cost else ""
    asked = f" of {format_time_ps(record['time_ps'])}" if "time_ps" in record else ""
    unfinished = f" (ended before the end{asked})" if record.get("completed") is False else ""
    return {
        "file": str(path),
        "type": record.get("kind", "foreign") + " trajectory",
        "summary": f"{n_frames} frames of {n_atoms} atoms{span}{wall}{unfinished}",
        "details": [
            *(f"replica: {r['file']}, {r['n_frames']} frames" for r in replicas),
            *summary_lines(record.get("summary") or {}),
            *rollout_lines(record),
            *intervention_lines(record),
        ],
        "scene": None if scene is None else scene.name,
        "formula": None if scene is None else scene.formula,
        "topology_hash": None if scene is None else scene.topology_hash,
        "n_frames": n_frames,
        "n_atoms": n_atoms,
        "first_ps": float(times[0]) if n_frames else None,
        "last_ps": float(times[-1]) if n_frames else None,
        "save_every_ps": lag_ps,
        "invalid_frames": None if flags is None else int(np.count_nonzero(flags & INVALID)),
        "size_mb": path.stat().st_size / 1e6,
        "record": record,
    }


def rollout_lines(record: dict[str, Any]) -> list[str]:
    """Return how a rollout's molecule differs from what its weights were trained on, whether its frames follow each
    other, and in which precision its network was evaluated, and why; nothing of other files."""
    lines = [UNSEEN] if record.get("unseen_molecule") else []
    beyond = record.get("out_of_domain") or []
    lines += [f"outside the training domain (`force=True`): {d['what']}: {d['reason']}" for d in beyond]
    if moves := record.get("torsion_moves"):
        lines.append(f"torsions turned by Monte Carlo, {moves} moves a frame: a sample of states, without kinetics")
    reason = record.get("precision_reason")
    return lines if reason is None else [*lines, f"network in {record.get('precision')}: {reason}"]


def intervention_lines(record: dict[str, Any]) -> list[str]:
    """Return what a rollout's guards caught and did; nothing of other files."""
    summary = record.get("interventions")
    if not isinstance(summary, dict):
        return []
    line = f"guard {summary['guard']}: {summary['chunks_caught']} of {summary['chunks']} chunks caught"
    if reasons := sorted(summary.get("reasons", {}).items(), key=lambda r: -r[1]):
        line += ": " + ", ".join(f"{name} ({n} frames)" for name, n in reasons)
    if not summary["frames"]:
        return [line]
    helped = ", ".join(f"{n} {name}" for name, n in summary["frames"].items())
    bias = (f"bias: {why}" for why in summary["bias"])
    return [line, f"frames that are not the surrogate's first draw: {helped}", *bias]


def _windows(path: Path) -> dict[str, Any]:
    from surrogate.data import load_frames

    frames = load_frames(path)
    return {
        "file": str(path),
        "type": "windows",
        "summary": f"{frames.n_frames} frames of {frames.scene.name}, {format_time_ps(frames.total_ps)} at "
        f"{format_time_ps(frames.lag_ps)}, from {len(frames.sources)} trajectories",
        "scene": frames.scene.name,
        "formula": frames.scene.formula,
        "n_frames": frames.n_frames,
        "n_atoms": frames.scene.n_atoms,
        "save_every_ps": frames.lag_ps,
        "canonical": frames.canonical,
        "conditions": frames.conditions,
        "sources": [source["file"] for source in frames.sources],
        "size_mb": path.stat().st_size / 1e6,
    }


def _weights(path: Path) -> dict[str, Any]:
    from surrogate.models.weights import load_weights
    from surrogate.sampling.domain import domain_under

    weights = load_weights(path)
    domain = weights.domain
    each = {str(s): domain_under(domain, {"solvent": s}, path.name).describe() for s in domain.solvents}
    n_parameters = sum(p.numel() for p in weights.model.parameters())
    return {
        "file": str(path),
        "type": "weights",
        "summary": f"{n_parameters / 1e6:.2f} M parameters for {domain.describe()}",
        "arch": weights.model.arch,
        "hash": weights.hash,
        "parameters": n_parameters,
        "scene": domain.scene.name,
        "formula": domain.scene.formula,
        "molecules": list(domain.names),
        "covers_unseen_molecules": domain.transferable,
        **({"solvents": each} if len(each) > 1 else {}),
        "lag_ps": domain.lag_ps,
        "longest_lag_ps": domain.longest_lag_ps,
        "conditions": domain.conditions,
        "config": weights.model.config.to_dict(),
        "provenance": weights.provenance,
        "size_mb": path.stat().st_size / 1e6,
    }
