"""One optimisation loop for every stage: budget in time or steps, warm-up and cosine, EMA, exact resume, curves."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from surrogate.training import devices
from systems.errors import InputError, SimulationError, first_line
from systems.files.schema import parsed
from systems.files.whole_file import create_whole
from systems.interrupts import stop_if_asked

# Muon: momentum of matrices, made orthogonal before it is a step (Jordan et al., kellerjordan.github.io/posts/muon).
# Potentials learn more by it in the same time (docs/studies/quantum/optimisers.py). torch has one of its own from 2.9
# on, matrix by matrix; this one takes matrices of one shape together, since those of a small network cost little but
# calls.

MOMENTUM = 0.95
# Of the quintic iteration that brings singular values near one.
_A, _B, _C = 3.4445, -4.7750, 2.0315
_ITERATIONS = 5


def orthogonalised(matrices: Tensor) -> Tensor:
    """Matrices `(k, n, m)` -> of each about U V^T of its singular value decomposition U S V^T: singular values come out
    near one, the smallest of them below."""
    x = matrices / (matrices.norm(dim=(1, 2), keepdim=True) + 1e-12)
    tall = x.shape[1] > x.shape[2]
    if tall:
        x = x.mT
    for _ in range(_ITERATIONS):
        a = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(a, a, a, beta=_B, alpha=_C), x, beta=_A)
    return x.mT if tall else x


class Muon(torch.optim.Optimizer):
    """Steps of `lr` times the orthogonalised momentum of each matrix, times the root of rows over columns where there
    are more rows; `weight_decay` as AdamW's."""

    def __init__(self, params: Iterable[nn.Parameter], lr: float, weight_decay: float = 0.0) -> None:
        super().__init__(params, {"lr": lr, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Take a step; there is no closure."""
        assert closure is None
        for group in self.param_groups:
            alike: dict[Any, list[nn.Parameter]] = defaultdict(list)
            for p in group["params"]:
                if p.grad is not None:
                    alike[p.shape].append(p)
            for shape, matrices in alike.items():
                grads = [p.grad for p in matrices if p.grad is not None]
                momenta = [self.state[p].setdefault("momentum", torch.zeros_like(p)) for p in matrices]
                torch._foreach_lerp_(momenta, grads, 1.0 - MOMENTUM)
                way = orthogonalised(torch.stack(torch._foreach_lerp(grads, momenta, MOMENTUM)))
                weights: list[Tensor] = list(matrices)
                torch._foreach_mul_(weights, 1.0 - group["lr"] * group["weight_decay"])
                longer = max(1.0, shape[0] / shape[1]) ** 0.5
                torch._foreach_add_(weights, list(way.unbind()), alpha=-group["lr"] * longer)


# The curves of a training: a CSV that the loop writes, and NAME.svg beside it.


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Append a row to a CSV; columns that it does not have yet are added, empty in the rows before."""
    columns: list[str] = []
    rows: list[dict[str, Any]] = []
    if path.exists():
        with path.open(newline="") as handle:
            reader = csv.DictReader(handle)
            columns, rows = list(reader.fieldnames or ()), list(reader)
    columns += [k for k in row if k not in columns]
    rows.append({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})

    def fill(temporary: Path) -> None:
        with temporary.open("w", newline="") as handle:
            writer = csv.DictWriter(handle, columns, restval="")
            writer.writeheader()
            writer.writerows(rows)

    create_whole(path, fill)


def read_curves(path: Path) -> dict[str, list[dict[str, str]]]:
    """Return the rows of a training's CSV by stage, in the order of the training."""
    stages: dict[str, list[dict[str, str]]] = {}
    with path.open(newline="") as handle:
        for row in csv.DictReader(handle):
            stages.setdefault(row["stage"], []).append(row)
    return stages


def series(rows: list[dict[str, str]], column: str) -> tuple[list[float], list[float]]:
    """Return the steps and values of one column, where it has any."""
    kept = [row for row in rows if row.get(column)]
    return [float(row["step"]) for row in kept], [float(row[column]) for row in kept]


def plot_curves(path: Path) -> Path:
    """Draw one panel per stage, errors in training (broken) and validation (full) over steps; return the .svg."""
    from matplotlib.figure import Figure

    stages = read_curves(path)
    figure = Figure(figsize=(5.5 * max(1, len(stages)), 4.0), layout="constrained")
    for panel, (stage, rows) in zip(figure.subplots(1, len(stages), squeeze=False)[0], stages.items(), strict=True):
        for column in [c for c in rows[0] if c.startswith(("train_", "validation_"))]:
            steps, values = series(rows, column)
            if steps and min(values) > 0.0:
                held = column.startswith("validation_")
                panel.plot(steps, values, "-" if held else "--", marker=".", label=column.replace("_", " "))
        panel.set(title=stage, xlabel="step", ylabel="error or gradient norm", yscale="log")
        if panel.has_data():
            panel.legend(fontsize="x-small")
    out = path.with_suffix(".svg")
    create_whole(out, lambda temporary: figure.savefig(temporary, format="svg"))
    return out


# Files of tensors: safetensors with a record (JSON) and a checksum of both, so that what the disk or a copy has changed
# is noticed when they are read.


def tensor_checksum(text: str, tensors: Mapping[str, torch.Tensor]) -> str:
    """Return the SHA-256 of a file's record and of its tensors with their names, types and shapes, in hexadecimal."""
    found = hashlib.sha256(text.encode())
    for name, tensor in sorted(tensors.items()):
        found.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        found.update(tensor.contiguous().numpy().tobytes())
    return found.hexdigest()


def save_tensors(path: Path, kind: str, record: dict[str, Any], tensors: Mapping[str, Tensor], **more: str) -> None:
    """Write tensors with their record, in the metadata under the name `kind`, whole or not at all."""
    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    text = json.dumps(record)
    metadata = {**more, kind: text, "sha256": tensor_checksum(text, kept)}
    create_whole(path, lambda temporary: save_file(kept, temporary, metadata=metadata))


def load_tensors(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return record and tensors as they were saved. Raises InputError for a file that is damaged or another's."""
    try:
        with safe_open(path, framework="pt") as handle:
            metadata = handle.metadata()
            tensors = {key: handle.get_tensor(key) for key in handle.keys()}  # noqa: SIM118
        record = parsed(metadata[kind])
        whole = metadata.keys() == {kind, "sha256"} and metadata["sha256"] == tensor_checksum(metadata[kind], tensors)
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} cannot be read ({first_line(error)}); train again without `resume`.") from error
    if not whole:
        raise InputError(
            f"{path} is damaged: it is not what was written (checksum); restore it from a whole copy, or train again "
            "without `resume`."
        )
    return record, tensors


# One optimisation loop for every stage: budget in time or steps, warm-up and cosine, EMA, clipping, exact resume.

# Matrices with fewer rows or columns are no business of Muon's.
LEAST_MATRIX = 8
# Steps of a GPU between two looks at whether numbers are finite.
GPU_STEPS = 20

# generator of a batch's random numbers -> loss, and its parts by name
LossFn = Callable[[torch.Generator], tuple[Tensor, dict[str, Tensor]]]
# (stage, share of the budget done, latest metrics) -> None
ProgressFn = Callable[[str, float, dict[str, float]], None]


@dataclass(frozen=True)
class StageConfig:
    """One stage's optimisation. Ends at `budget_s` of training time (summed over resumes) or at `steps`, whichever is
    first; the learning rate follows the share of that budget which is spent. `matrix_rate`: that of linear layers'
    matrices, by Muon; all by AdamW if None. `bf16`: where it is faster."""

    name: str
    batch: int
    learning_rate: float
    budget_s: float | None = None
    steps: int | None = None
    warmup_steps: int = 200
    weight_decay: float = 0.01
    matrix_rate: float | None = None
    clip_norm: float = 1.0
    ema_decay: float = 0.999
    seed: int = 0
    bf16: bool = True
    validate_every_s: float = 60.0

    def __post_init__(self) -> None:
        if self.budget_s is None and self.steps is None:
            raise InputError(f"training stage {self.name!r} needs a `budget_s` or a number of steps.")

    def part(self, share: float) -> StageConfig:
        """Return this stage with a share of its budget, and of its steps."""
        return replace(
            self, budget_s=None if self.budget_s is None else share * self.budget_s,
            steps=None if self.steps is None else max(1, round(share * self.steps)),
        )  # fmt: skip

    def share_done(self, step: int, spent_s: float) -> float:
        shares = [0.0]
        if self.steps is not None:
            shares.append(step / self.steps)
        if self.budget_s is not None:
            shares.append(spent_s / self.budget_s)
        return min(1.0, max(shares))


def learning_rate_factor(step: int, share: float, warmup_steps: int) -> float:
    """Linear warm-up times a cosine from one to one hundredth over the budget."""
    return min(1.0, (step + 1) / warmup_steps) * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * share)))


class Ema:
    """Exponential moving average of parameters, decay warmed up as min(decay, (1 + n) / (10 + n))."""

    def __init__(self, module: nn.Module, decay: float) -> None:
        self.decay = decay
        self.shadow = {name: p.detach().clone() for name, p in module.named_parameters()}

    @torch.no_grad()
    def update(self, module: nn.Module, step: int) -> None:
        decay = min(self.decay, (1 + step) / (10 + step))
        parameters = dict(module.named_parameters())
        torch._foreach_lerp_(list(self.shadow.values()), [parameters[k].detach() for k in self.shadow], 1.0 - decay)

    @contextmanager
    def swapped(self, module: nn.Module) -> Iterator[None]:
        """Put the averaged parameters into the module while the block runs, and its own back afterwards."""
        parameters = dict(module.named_parameters())
        kept = {name: p.detach().clone() for name, p in parameters.items()}
        self.copy_to(module)
        try:
            yield
        finally:
            with torch.no_grad():
                for name, p in parameters.items():
                    p.copy_(kept[name])

    @torch.no_grad()
    def copy_to(self, module: nn.Module) -> None:
        for name, p in module.named_parameters():
            p.copy_(self.shadow[name])


class Stage(NamedTuple):
    """One stage of a training: the `module` that it trains, and how.

    `loss(generator)` draws its own batch from the generator, so that a resumed run draws what an uninterrupted one
    would have. `saves`: weights are written at each validation, not after the last stage alone.
    """

    module: nn.Module
    config: StageConfig
    loss: LossFn
    validate: Callable[[], dict[str, float]]
    saves: bool = True


class StagePlace(NamedTuple):
    """Where a stage runs and writes: its resume `state` (.safetensors), the `log` of its curves (.csv), the device.
    `resume`: go on from the state, where there is one."""

    state: Path
    log: Path
    device: torch.device
    resume: bool = False


def run_stage(stage: Stage, place: StagePlace, *, progress: ProgressFn | None = None,
              on_save: Callable[[float], None] | None = None) -> float:  # fmt: skip
    """Train a stage's module in place and leave it holding its EMA weights; return the seconds of training spent.

    Each validation logs a CSV row, saves the resume state and calls `on_save(spent_s)` with EMA weights in. Raises
    SimulationError when the loss stops being finite; the last saved state stays.
    """
    devices.keep_freed_memory()
    module, config, device = stage.module, stage.config, place.device
    bf16 = config.bf16 and devices.bf16_pays(device.type)
    parameters = [p for p in module.parameters() if p.requires_grad]
    optimisers = optimisers_of(module, config)
    rates = [[group["lr"] for group in optimiser.param_groups] for optimiser in optimisers]
    ema = Ema(module, config.ema_decay)
    generator = torch.Generator().manual_seed(config.seed)
    step, spent_s = 0, 0.0
    if place.resume and place.state.exists():
        step, spent_s = load_state(place.state, module, ema, optimisers, generator, config)
    last = time.monotonic()
    next_validation = spent_s + config.validate_every_s
    sums: dict[str, Tensor] = {}
    n_summed = 0
    while (share := config.share_done(step, spent_s)) < 1.0:
        stop_if_asked()
        factor = learning_rate_factor(step, share, config.warmup_steps)
        for optimiser, full in zip(optimisers, rates, strict=True):
            for group, rate in zip(optimiser.param_groups, full, strict=True):
                group["lr"] = rate * factor
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=bf16):
            loss, terms = stage.loss(generator)
        module.zero_grad(set_to_none=True)
        # Not to the positions of which forces are the gradient.
        loss.backward(inputs=parameters)
        now = time.monotonic()
        spent_s, last = spent_s + now - last, now
        norm = nn.utils.clip_grad_norm_(module.parameters(), config.clip_norm)
        ended = config.share_done(step + 1, spent_s) >= 1.0
        validates = spent_s >= next_validation or ended
        # A GPU is asked now and then, but before anything is saved: each question waits for it.
        if (device.type == "cpu" or validates or step % GPU_STEPS == 0) and not torch.isfinite(norm):
            raise SimulationError(
                f"training stage {config.name!r}: loss or gradient is not finite at step {step}; lower the learning "
                f"rate (now {config.learning_rate:g}). The last good state is {place.state}."
            )
        for optimiser in optimisers:
            optimiser.step()
        ema.update(module, step)
        for key, value in {**terms, "gradient_norm": norm.detach()}.items():
            sums[key] = sums.get(key, torch.zeros_like(value, dtype=torch.float32)) + value.float()
        n_summed += 1
        step += 1
        if validates:
            next_validation = spent_s + config.validate_every_s
            with ema.swapped(module):
                metrics = {f"train_{k}": float(v) / n_summed for k, v in sums.items()} | stage.validate()
                if on_save is not None:
                    on_save(spent_s)
            sums, n_summed = {}, 0
            append_row(place.log, {"stage": config.name, "step": step, "spent_s": round(spent_s, 1),
                                  "learning_rate": config.learning_rate * factor, **metrics})  # fmt: skip
            save_state(place.state, module, ema, optimisers, generator, step, spent_s, config)
            if progress is not None:
                progress(config.name, config.share_done(step, spent_s), metrics)
            # Validation is not training: it is left out of the budget.
            last = time.monotonic()
        elif progress is not None and step % 10 == 0:
            progress(config.name, config.share_done(step, spent_s), {})
    ema.copy_to(module)
    return spent_s


def train_stages(
    stages: Iterable[Stage], out: Path, write: Callable[[list[float]], None], *, device: torch.device,
    resume: bool = False, progress: ProgressFn | None = None,
) -> None:  # fmt: skip
    """Train stage after stage and write the weights `out`; beside them stand a CSV of the curves and, until all is
    done, the state of each stage (NAME.STAGE.train.safetensors), from which `resume` goes on.

    The next stage is asked for when one has ended: a generator may prepare it from what that has learned, and do what
    is left to do after the last. `write(spent_s)` writes the weights, given the seconds of training of each stage so
    far. Raises SimulationError when a loss stops being finite.
    """
    log, spent_s = out.with_suffix(".csv"), list[float]()
    own = re.compile(re.escape(out.stem) + r"\.[^.]+\.train\.safetensors")

    def forget(*more: Path) -> None:
        for path in (*more, *(path for path in out.parent.iterdir() if own.fullmatch(path.name))):
            path.unlink(missing_ok=True)

    if not resume:
        forget(log)
    for stage in stages:
        place = StagePlace(out.with_name(f"{out.stem}.{stage.config.name}.train.safetensors"), log, device, resume)
        on_save = (lambda now_s: write([*spent_s, now_s])) if stage.saves else None
        spent_s.append(run_stage(stage, place, progress=progress, on_save=on_save))
    write(spent_s)
    forget()


def optimisers_of(module: nn.Module, config: StageConfig) -> list[torch.optim.Optimizer]:
    """Return AdamW and, with `matrix_rate`, Muon, which share a module's parameters."""
    matrices: list[nn.Parameter] = []
    if config.matrix_rate is not None:
        layers = [layer for layer in module.modules() if isinstance(layer, nn.Linear)]
        own = [p for layer in layers for p in layer.parameters(recurse=False) if p.requires_grad]
        matrices = [p for p in own if p.ndim == 2 and min(p.shape) >= LEAST_MATRIX]
    taken = {id(p) for p in matrices}
    others = [p for p in module.parameters() if p.requires_grad and id(p) not in taken]
    decay, plain = [p for p in others if p.ndim >= 2], [p for p in others if p.ndim < 2]
    adam = torch.optim.AdamW(
        [{"params": decay, "weight_decay": config.weight_decay}, {"params": plain, "weight_decay": 0.0}],
        lr=config.learning_rate,
        betas=(0.9, 0.99),
        fused=any(p.is_cuda for p in others) or None,
    )
    if config.matrix_rate is None or not matrices:
        return [adam]
    return [adam, Muon(matrices, config.matrix_rate, config.weight_decay)]


def save_state(path: Path, module: nn.Module, ema: Ema, optimisers: list[torch.optim.Optimizer],
               generator: torch.Generator, step: int, spent_s: float, config: StageConfig) -> None:  # fmt: skip
    """Write the training state whole or not at all."""
    tensors = {f"model.{k}": v for k, v in module.state_dict().items()}
    tensors |= {f"ema.{k}": v for k, v in ema.shadow.items()}
    for number, optimiser in enumerate(optimisers):
        for index, state in optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser{number or ''}.{index}.{k}": v for k, v in state.items()}
    tensors["generator"] = generator.get_state()
    save_tensors(path, "surromd_training", {"step": step, "spent_s": spent_s, **_of_run(config)}, tensors)


def _of_run(config: StageConfig) -> dict[str, Any]:
    """Return what a state has in common with the run that may go on from it."""
    return {"stage": config.name, "seed": config.seed, "batch": config.batch, "matrix_rate": config.matrix_rate}


def load_state(path: Path, module: nn.Module, ema: Ema, optimisers: list[torch.optim.Optimizer],
               generator: torch.Generator, config: StageConfig) -> tuple[int, float]:  # fmt: skip
    """Put a saved state back; return (step, spent_s). Raises InputError when it is damaged or of another run."""
    record, tensors = load_tensors(path, "surromd_training")
    for key, expected in _of_run(config).items():
        if (found := record.get(key)) != expected:
            raise InputError(
                f"training state {path} has {key} {found!r}, this run {expected!r}; remove it to train anew."
            )
    sub = lambda prefix: {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}  # noqa: E731
    try:
        module.load_state_dict(sub("model."))
    except RuntimeError as error:
        raise InputError(f"training state {path} is of another configuration: {first_line(error)}") from error
    for name, tensor in sub("ema.").items():
        ema.shadow[name].copy_(tensor)
    for number, optimiser in enumerate(optimisers):
        state: dict[int, dict[str, Tensor]] = {}
        for key, tensor in sub(f"optimiser{number or ''}.").items():
            index, name = key.split(".", 1)
            state.setdefault(int(index), {})[name] = tensor
        optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    generator.set_state(tensors["generator"])
    return record["step"], record["spent_s"]
