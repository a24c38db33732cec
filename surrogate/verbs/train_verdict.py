"""What a training ends with: how far it came, what its weights do in a short guarded rollout, and what would help."""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from systems.errors import SurromdError
from systems.files.whole_file import create_whole
from systems.units import format_time_ps

if TYPE_CHECKING:
    from surrogate.models.potential import Potential
    from surrogate.models.weights import Weights
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
        last = [each for columns in self.validation.values() for each in columns.items()]
        errors = ", ".join(f"{column.removeprefix('validation_')} {value:.3g}" for column, value in last)
        wrong = "; the others: " * bool(self.reasons) + ", ".join(f"{name} ({n})" for name, n in self.reasons.items())
        found = f"{self.percent_valid:.3g} % of {self.n_frames} frames pass the guards{wrong}"
        lines = [
            f"trained: {done}; validation error: {errors}",
            f"rolled {format_time_ps(self.rolled_ps)} without help: {found}",
        ]
        if self.stopped:
            lines.append(f"the rollout stopped: {self.stopped}")
        if self.word == "usable":
            return [*lines, "usable; whether populations and time scales are right, `surromd compare` with MD shows"]
        help_ = "usable with `guard='repair'` or resample alone" if self.word != "not usable" else "not usable as it is"
        return [*lines, f"{help_}; what would help: {'; '.join(self.advice)}"]


def compare_training(path: Path) -> TrainingVerdict:
    """Roll freshly trained weights from the structures they know, and say what they are good for. Draws each chunk
    once, so that the share of frames that pass is the network's own. Raises WeightsError, InputError."""
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
        reasons=dict(rolled.reasons.most_common()),
        stopped=rolled.stopped,
        word=word,
        advice=() if word == "usable" else tuple(_advice(weights, stages)),
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
    create_whole(out, json.dumps(asdict(verdict), indent=1) + "\n")
    return out


def word_of(percent_valid: float, stopped: str = "") -> str:
    """Return a verdict on weights in a word: by how many frames of a rollout are valid, and whether it `stopped`."""
    if stopped or percent_valid < WITH_HELP:
        return "not usable"
    return "usable" if percent_valid >= USABLE else "usable with help"


@dataclass
class _Rolled:
    """Frames that were rolled, how many of them the guards caught and why, and what stopped the rollout."""

    time_ps: float = 0.0
    n_frames: int = 0
    n_caught: int = 0
    stopped: str = ""
    reasons: Counter[str] = field(default_factory=Counter)


def _roll(weights: Weights) -> _Rolled:
    """Roll up to six of the molecules trained on, four replicas of six chunks each."""
    from surrogate.sampling.chunks import caught
    from surrogate.sampling.runner import RolloutConfig, rollout
    from systems.chemistry.validity import flag_names
    from systems.trajectory.codec import open_trajectory

    members, found = weights.domain.members, _Rolled()
    for domain in members[:: -(-len(members) // _MOLECULES)]:
        time_ps = _CHUNKS * weights.model.n_new * weights.domain.lag_ps
        lag_ps = weights.domain.lag_ps if weights.domain.jumps else None
        with tempfile.TemporaryDirectory(prefix="surromd-verdict-") as folder:
            outs = [Path(folder) / f"r{k}.h5" for k in range(_REPLICAS)]
            try:
                rollout(domain.scene, weights, outs, RolloutConfig(time_ps=time_ps, lag_ps=lag_ps, seed=_SEED))
            except SurromdError as error:  # also a structure that the checks of its own reference do not pass
                found.stopped = found.stopped or str(error).split(";")[0]
            for out in filter(Path.exists, outs):
                with open_trajectory(out) as reader:
                    flags = np.zeros(0, np.uint16) if reader.flags is None else np.asarray(reader.flags, np.uint16)
                wrong = flags[caught(flags)]
                found.n_frames += len(flags)
                found.time_ps += len(flags) * domain.lag_ps
                found.n_caught += len(wrong)
                found.reasons.update(name for bits in wrong.tolist() for name in flag_names(bits))
    return found


def _advice(weights: Weights, stages: dict[str, list[dict[str, str]]]) -> list[str]:
    """Return what would help, what is likeliest first."""
    from surrogate.models.potential import Potential
    from surrogate.training.loop import series

    found = _nearer_weights(weights)
    # A potential learned from states, which need be no MD.
    sources = [] if isinstance(weights.model, Potential) else weights.provenance.get("sources", ())
    n_frames = sum(int(source.get("n_frames", 0)) for source in sources)
    rows = list(stages.values())[-1] if stages else []
    column = next((c for c in (rows[-1] if rows else {}) if c.startswith("validation_")), "")
    values, trained = (
        series(rows, column.replace("validation_", kind))[1] if column else [] for kind in ("validation_", "train_")
    )
    if len(values) < 4 or values[-1] < (1.0 - _STILL_FALLS) * values[len(values) // 2]:
        found.append("more minutes (`budget_s`): the validation error had not settled")
    if values and trained and values[-1] > _BY_HEART * trained[-1]:
        times = values[-1] / trained[-1]
        found.append(f"more reference MD: the validation error is {times:.2g} times that in training")
    elif 0 < n_frames < _FEW_FRAMES:
        found.append(f"more reference MD: {n_frames} frames are few")
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
        same = same and header.arch == weights.model.arch and domain.lag_ps == own.lag_ps
        if same and not any(find_deviations(member.scene, domain) for member in own.members):
            return [f"to go on from weights that know such molecules (`start_from='{name}'`), or to roll those"]
    return []
