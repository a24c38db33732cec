"""What a training ends with: how far it came, what its weights do in a short guarded rollout, and what would help."""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from systems.errors import SimulationError, SurromdError
from systems.files.whole_file import create_whole
from systems.units import format_time_ps

if TYPE_CHECKING:
    from surrogate.models.potential import Potential
    from surrogate.models.weights import TrainingDomain, Weights
    from systems.scene import Scene

# Frames that pass the guards, in per cent: from the first on the weights can be rolled as they are, from the second on
# with a guard that helps.
USABLE, WITH_HELP = 99.0, 90.0
_REPLICAS, _CHUNKS, _MOLECULES = 4, 6, 6
_TIMED_FORCES = 9
# A validation error that falls by this share over the second half of the last stage has not settled; one this many
# times the error in training is of frames that the network knows by heart.
_STILL_FALLS, _BY_HEART = 0.03, 1.5
_FEW_FRAMES = 20_000
_SEED = 0


@dataclass(frozen=True)
class TrainingVerdict:
    """How a training went. `steps` and `validation` (named as in the curves) by stage; of the rollout the frames, how
    many in per cent pass the guards, and what is wrong with the others, in frames; `stopped`: why it could not go on.

    `word`: 'usable', 'usable with help' (`guard='repair'` or resample) or 'not usable'; `advice`: what would help.
    """

    steps: dict[str, int]
    validation: dict[str, dict[str, float]]
    rolled_ps: float
    n_frames: int
    percent_valid: float
    reasons: dict[str, int]
    stopped: str
    word: str
    advice: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return it for people."""
        done = ", ".join(f"{name} {steps} steps" for name, steps in self.steps.items())
        errors = ", ".join(
            f"{column.removeprefix('validation_')} {value:.3g}"
            for columns in self.validation.values()
            for column, value in columns.items()
        )
        wrong = ", ".join(f"{name} ({n})" for name, n in self.reasons.items())
        found = f"{self.percent_valid:.3g} % of {self.n_frames} frames pass the guards"
        lines = [f"trained: {done}; validation error: {errors}"]
        lines.append(
            f"rolled {format_time_ps(self.rolled_ps)} without help: {found}{f'; the others: {wrong}' if wrong else ''}"
        )
        if self.stopped:
            lines.append(f"the rollout stopped: {self.stopped}")
        if self.word == "usable":
            lines.append("usable; whether populations and time scales are right, `surromd compare` with MD tells")
            return lines
        help_ = "usable with `guard='repair'` or resample alone" if self.word != "not usable" else "not usable as it is"
        return [*lines, f"{help_}; what would help: {'; '.join(self.advice)}"]


def compare_training(path: Path) -> TrainingVerdict:
    """Roll freshly trained weights from the structures they know, and say what they are good for.

    Draws each chunk once, so that the share of frames that pass is the network's own. Raises WeightsError, InputError.
    """
    from surrogate.models.weights import load_weights
    from surrogate.training.loop import read_curves, series

    weights = load_weights(path)
    rolled = _roll(weights)
    curves = path.with_suffix(".csv")
    stages = read_curves(curves) if curves.exists() else {}
    validation: dict[str, dict[str, float]] = {}
    for stage, rows in stages.items():
        columns = [c for c in rows[-1] if c.startswith("validation_")]
        validation[stage] = {c: values[-1] for c in columns if (values := series(rows, c)[1])}
    valid = 100.0 * (1.0 - rolled.n_caught / max(rolled.n_frames, 1))
    word = word_of(valid, rolled.stopped)
    return TrainingVerdict(
        steps={stage: int(rows[-1]["step"]) for stage, rows in stages.items()},
        validation=validation,
        rolled_ps=rolled.time_ps,
        n_frames=rolled.n_frames,
        percent_valid=valid,
        reasons=dict(sorted(rolled.reasons.items(), key=lambda item: -item[1])),
        stopped=rolled.stopped,
        word=word,
        advice=() if word == "usable" else tuple(_advice(weights, stages, rolled)),
    )


def trial_s(model: Potential, scene: Scene) -> float:
    """Return about how many seconds the rollout of `compare_training` takes with a potential of a scene, by timing its
    forces."""
    import torch

    from surrogate.models.propagator import Molecule

    molecule = Molecule.of(scene)
    frames = torch.tensor(scene.positions_nm)[None].expand(_REPLICAS, -1, -1)
    model.eval()
    taken = []
    for _ in range(1 + _TIMED_FORCES):
        began = time.monotonic()
        model.forces(frames, molecule)
        taken.append(time.monotonic() - began)
    # The first prepares the molecule.
    return _CHUNKS * model.n_new * model.steps_per_frame * statistics.median(taken[1:])


def write_verdict(path: Path, verdict: TrainingVerdict) -> Path:
    """Write NAME.verdict.json beside the weights `path` and return it."""
    out = path.with_suffix(".verdict.json")
    text = json.dumps(asdict(verdict), indent=1) + "\n"

    def fill(temporary: Path) -> None:
        temporary.write_text(text, "utf-8")

    create_whole(out, fill)
    return out


def word_of(percent_valid: float, stopped: str = "") -> str:
    """Return a verdict on weights in a word: by how many frames of a rollout are valid, and whether it `stopped`."""
    if stopped or percent_valid < WITH_HELP:
        return "not usable"
    return "usable" if percent_valid >= USABLE else "usable with help"


@dataclass
class _Rolled:
    time_ps: float = 0.0
    n_frames: int = 0
    n_caught: int = 0
    # Bonds more than 20 % off, and how many of them hold a hydrogen.
    stopped: str = ""

    def __post_init__(self) -> None:
        self.reasons: dict[str, int] = {}


def _roll(weights: Weights) -> _Rolled:
    """Roll up to six of the molecules trained on, four replicas of six chunks each."""
    from surrogate.sampling.runner import RolloutConfig, rollout

    members, found = weights.domain.members, _Rolled()
    for domain in members[:: -(-len(members) // _MOLECULES)]:
        time_ps = _CHUNKS * weights.model.n_new * weights.domain.lag_ps
        with tempfile.TemporaryDirectory(prefix="surromd-verdict-") as folder:
            outs = [Path(folder) / f"r{k}.h5" for k in range(_REPLICAS)]
            config = RolloutConfig(time_ps=time_ps, lag_ps=weights.domain.lag_ps if weights.domain.jumps else None,
                                   seed=_SEED)  # fmt: skip
            try:
                rollout(domain.scene, weights, outs, config)
            except SimulationError as error:
                found.stopped = found.stopped or str(error).split(";")[0]
            except SurromdError as error:
                # Such as a structure that the checks of its own reference do not pass.
                found.stopped = found.stopped or str(error)
            for out in outs:
                if out.exists():
                    _count(found, out, domain)
    return found


def _count(found: _Rolled, path: Path, domain: TrainingDomain) -> None:
    import numpy as np

    from surrogate.sampling.chunks import caught
    from systems.chemistry.validity import flag_names
    from systems.trajectory.codec import open_trajectory

    with open_trajectory(path) as reader:
        if not reader.n_frames or reader.flags is None:
            return
        flags = np.asarray(reader.flags).astype(np.uint16)
    found.n_frames += len(flags)
    found.time_ps += len(flags) * domain.lag_ps
    found.n_caught += int(caught(flags).sum())
    for bits in flags[caught(flags)].tolist():
        for name in flag_names(bits):
            found.reasons[name] = found.reasons.get(name, 0) + 1


def _advice(weights: Weights, stages: dict[str, list[dict[str, str]]], rolled: _Rolled) -> list[str]:
    """Return what would help, what is likeliest first."""
    from surrogate.training.loop import series

    found = _nearer_weights(weights)
    n_frames = sum(int(source.get("n_frames", 0)) for source in weights.provenance.get("sources", ()))
    from surrogate.models.potential import Potential

    if isinstance(weights.model, Potential):
        n_frames = 0  # it learned from states, which need be no MD
    rows = list(stages.values())[-1] if stages else []
    column = next((c for c in (rows[-1] if rows else {}) if c.startswith("validation_")), "")
    values = series(rows, column)[1] if column else []
    if len(values) < 4 or values[-1] < (1.0 - _STILL_FALLS) * values[len(values) // 2]:
        found.append("more minutes (`budget_s`): the validation error had not settled")
    trained = series(rows, column.replace("validation_", "train_"))[1] if column else []
    by_heart = bool(values and trained and values[-1] > _BY_HEART * trained[-1])
    if by_heart or 0 < n_frames < _FEW_FRAMES:
        why = f"{n_frames} frames are few"
        if by_heart:
            why = f"the validation error is {values[-1] / trained[-1]:.2g} times that in training"
        found.append(f"more reference MD: {why}")
    return found or ["more minutes (`budget_s`) and more reference MD"]


def _nearer_weights(weights: Weights) -> list[str]:
    """Name shipped weights that know this molecule, or molecules like it, under the same conditions."""
    from surrogate.models.architecture import shipped_weights
    from surrogate.models.weights import read_header
    from surrogate.sampling.domain import find_deviations

    if "from" in weights.provenance:
        return []
    own = weights.domain
    for name, path in shipped_weights().items():
        header = read_header(path)
        domain = header.domain
        same = all(domain.conditions.get(key) == own.conditions.get(key) for key in ("force_field", "solvent"))
        if header.arch != weights.model.arch or not same or domain.lag_ps != own.lag_ps:
            continue
        if not any(find_deviations(member.scene, domain) for member in own.members):
            return [f"to go on from weights that know such molecules (`start_from='{name}'`), or to roll those"]
    return []
