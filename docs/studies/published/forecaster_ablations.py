"""PAINET's forecaster and what is left of it without its parts, by the protocol of EGNO and HEGNN on MD17's molecules.

    python docs/studies/published/forecaster_ablations.py windows FOLDER [--molecules aspirin ethanol]
    python docs/studies/published/forecaster_ablations.py train FOLDER -o RESULTS.json --tasks s2t --methods painet egnn
    python docs/studies/published/forecaster_ablations.py table RESULTS.json... -o TABLE.json --machine "one H100"

500 windows to train on, heavy atoms alone, positions and velocities of one state, 1.5 ps ahead: the last frame (state
to state, s2s: its mean square error is F-MSE) or eight equally spaced (state to trajectory, s2t: A-MSE over all), per
coordinate in Å^2. Data are our own: `windows` runs 48 trajectories of 10 ps a molecule with GAFF2 in vacuum at constant
energy from 500 K, without angular momentum; 24 are trained on, 12 stop the training, 12 test. All seeds of a method
train at once, as one batch of networks, until the validation error has not fallen for `--patience` steps; the weights
tested are those of its lowest point. What RESULTS.json holds is not done again.

Methods: `painet`; `egnn`, its decoder alone, wider, with as many parameters; then PAINET's own table of ablations:
`fixed` (Phi and Psi not learned), `none` (no attention, the decoder's width unchanged), `local` (attention along bonds
and to second neighbours), `mlp` (a network of each atom's state for the decoder), `recurrent` (each frame decoded from
the frame before).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Generator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap
from torch.nn import functional as F

from surrogate.models.painet import model as painet
from surrogate.models.painet.model import EnergyAttention, Painet, PainetConfig, Structure, dense_mean
from surrogate.models.propagator import Molecule

MOLECULES = (
    "aspirin", "benzene", "ethanol", "malonaldehyde", "naphthalene", "salicylic-acid", "toluene", "uracil",
)  # fmt: skip
METHODS = ("painet", "egnn", "fixed", "none", "local", "mlp", "recurrent")
# Of the trajectories: steps of 0.5 fs, frames three to an eighth of the horizon.
STEP_PS, STEPS_A_FRAME, FRAMES_AN_EIGHTH, FRAMES, SETTLE_PS = 0.0005, 125, 3, 160, 3.0
RUNS = 48
PARTS = {"train": (slice(0, 24), 500), "validation": (slice(24, 36), 500), "test": (slice(36, 48), 1000)}
TEMPERATURE_K = 500.0
# Trainings that have begun go on for so long after `--within`.
GRACE_S = 20.0


def make_windows(name: str, out: Path) -> None:
    """Write a molecule's trajectories: `frames` (runs, frames, heavy atoms, 6) of positions nm and velocities nm/ps."""
    import openmm
    from openmm import unit

    from md_reference.forces.gaff import entry
    from systems.library import named_scenes
    from systems.scene import ATOMIC_NUMBERS

    scene = named_scenes.load(name)
    system = entry(scene).system(scene)
    masses = np.array([system.getParticleMass(k).value_in_unit(unit.dalton) for k in range(scene.n_atoms)])
    heavy = np.array([element != "H" for element in scene.elements])
    integrator = openmm.CompoundIntegrator()
    integrator.addIntegrator(openmm.LangevinMiddleIntegrator(TEMPERATURE_K, 2.0, STEP_PS))
    integrator.addIntegrator(openmm.VerletIntegrator(STEP_PS))
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform("Reference"))
    context.setPositions(scene.positions_nm)
    found = []

    def state() -> tuple[Any, Any]:
        now = context.getState(positions=True, velocities=True)
        return now.getPositions(asNumpy=True)._value, now.getVelocities(asNumpy=True)._value

    for run in range(RUNS):
        integrator.setCurrentIntegrator(0)
        context.setVelocitiesToTemperature(TEMPERATURE_K, run)
        integrator.step(round(SETTLE_PS / STEP_PS))
        x, v = state()
        x = x - masses @ x / masses.sum()
        v = v - masses @ v / masses.sum()
        spin = (masses[:, None] * np.cross(x, v)).sum(0)
        moments = np.eye(3) * (masses @ (x**2).sum(1)) - np.einsum("n,ni,nj->ij", masses, x, x)
        context.setPositions(x)
        context.setVelocities(v - np.cross(np.linalg.solve(moments, spin), x))
        integrator.setCurrentIntegrator(1)
        frames = []
        for _ in range(FRAMES):
            frames.append(np.concatenate(state(), axis=1)[heavy])
            integrator.step(STEPS_A_FRAME)
        found.append(frames)
    place = np.cumsum(heavy) - 1
    bonds = np.array([place[pair] for pair in scene.bonds if heavy[pair].all()])
    numbers = np.array([ATOMIC_NUMBERS[e] for e in scene.elements])[heavy]
    np.savez_compressed(out, frames=np.array(found, np.float32), bonds=bonds, numbers=numbers, masses=masses[heavy])


@dataclass(frozen=True, eq=False)
class Windows:
    """States `x`, `v` (n, n_atoms, 3) and `future` (n, n_new, n_atoms, 3), nm and nm/ps."""

    x: Tensor
    v: Tensor
    future: Tensor

    @staticmethod
    def of(frames: np.ndarray, part: str, eighths: list[int], device: str) -> Windows:
        runs, n = PARTS[part]
        frames = frames[runs]
        starts = frames.shape[1] - 8 * FRAMES_AN_EIGHTH
        picked = np.linspace(0, len(frames) * starts - 1, n).astype(int)
        run, at = picked // starts, picked % starts
        later = at[:, None] + FRAMES_AN_EIGHTH * np.array(eighths)
        arrays = frames[run, at, :, :3], frames[run, at, :, 3:], frames[run[:, None], later, :, :3]
        return Windows(*(torch.from_numpy(a).to(device) for a in arrays))


class LocalAttention(EnergyAttention):
    """The same along the edges of the decoder alone."""

    def __init__(self, config: PainetConfig, near: Tensor) -> None:
        super().__init__(config, painet.N_TYPES)
        self.near = nn.Buffer(near)

    def forward(self, h: Tensor, carried: Tensor, types: Tensor, groups: Any, *, dense: bool) -> Any:
        q, k, v = self.qkv(h).unflatten(-1, (3, self.n_heads, -1)).permute(2, 0, 3, 1, 4)
        q, k = F.normalize(q, dim=-1), F.normalize(k, dim=-1)
        phi, psi = (m[:, types][:, :, types] * self.near for m in self.type_matrices())
        mean = dense_mean(q, k, v, phi, psi)
        return (1.0 - self.step) * h + self.step * self.out(mean.transpose(1, 2).flatten(-2)), carried, q


class PlainDecoder(nn.Module):
    """A network of each atom's embedding and state for the decoder: neither a graph nor equivariant."""

    def __init__(self, width: int) -> None:
        super().__init__()
        layers = [layer for _ in range(3) for layer in (nn.Linear(width, width), nn.SiLU())]
        self.network = nn.Sequential(nn.Linear(width + 6, width), nn.SiLU(), *layers, nn.Linear(width, 6))

    def forward(self, h: Tensor, x: Tensor, v: Tensor, graph: Any, reach: Tensor) -> tuple[Tensor, Tensor]:
        of_x, of_v = self.network(torch.cat([h, x, v], dim=-1)).split(3, dim=-1)
        return x + reach[0] * of_x, v + reach[1] * of_v


class Recurrent(Painet):
    """Each frame decoded from the frame before."""

    def decoded(self, x: Tensor, v: Tensor, structure: Structure) -> tuple[Tensor, Tensor]:
        elements = structure.molecule.elements
        h, found = self.embed(x, v, elements), []
        for t, step in enumerate(self.steps):
            h = step(h, h[..., :0], elements, structure.groups, dense=True)[0]
            x, v = self.decoder(h + self.embed_frame[t], x, v, structure.graph, self.reach / self.n_new**0.5)
            found.append((x, v))
        return tuple(torch.stack(part, dim=1) for part in zip(*found, strict=True))  # type: ignore[return-value]


class Decoded(nn.Module):
    """Positions `(b, n_new, n, 3)` nm as decoded. The centre is predicted with the rest: that of heavy atoms moves as
    hydrogens recoil, not at its velocity."""

    def __init__(self, model: Painet) -> None:
        super().__init__()
        self.model = model

    def forward(self, x: Tensor, v: Tensor, structure: Structure) -> Tensor:
        (x, centre), scale = structure.centred(x), self.model.config.length_scale_nm
        found, _ = self.model.decoded(x / scale, v / self.model.velocity_scale_nm_ps, structure)
        return found * scale + centre[:, None]


def n_parameters(model: Painet) -> int:
    """Return how many there are, but those of elements that do not occur."""
    return sum(p.numel() for name, p in model.named_parameters() if not name.endswith(("type.weight", "phi", "psi")))


def build(method: str, config: PainetConfig, structure: Structure) -> Painet:
    if method == "recurrent":
        return Recurrent(config)
    if method == "none":
        return Painet(replace(config, attention="none"))
    model = Painet(config)
    if method == "egnn":
        target, wide = n_parameters(model), replace(config, attention="none")
        while n_parameters(model := Painet(wide)) < target:
            wide = replace(wide, width=wide.width + 2)
    elif method == "fixed":
        for step in model.steps:
            step.e_phi.requires_grad_(False)
            step.e_psi.requires_grad_(False)
    elif method == "local":
        n, graph = structure.molecule.n_atoms, structure.graph
        near = torch.eye(n)
        near[graph.receiver.cpu(), graph.sender.cpu()] = 1.0
        model.steps = nn.ModuleList(LocalAttention(config, near) for _ in model.steps)
    elif method == "mlp":
        model.decoder = PlainDecoder(config.width)  # type: ignore[assignment]
    return model


def train(path: Path, method: str, task: str, given: argparse.Namespace) -> Generator[None, None, dict[str, Any]]:
    """Train all seeds of a method on a molecule; return their errors on the test windows. Yields whenever a GPU has
    work to do, so that another training can add to it."""
    began, device = time.monotonic(), given.device
    with np.load(path) as data:
        frames, bonds, numbers, masses = (data[name] for name in ("frames", "bonds", "numbers", "masses"))
    molecule = Molecule(*map(torch.from_numpy, (numbers, masses.astype(np.float32), bonds))).to(device)
    eighths = [8] if task == "s2s" else list(range(1, 9))
    parts = {part: Windows.of(frames, part, eighths, device) for part in PARTS}
    learned = parts["train"]
    lag_ps = STEP_PS * STEPS_A_FRAME * FRAMES_AN_EIGHTH * eighths[0]
    config = PainetConfig(n_new=len(eighths), width=given.width, attention="dense", lag_ps=lag_ps)
    structure = Painet(replace(config, attention="none")).structure(molecule)
    moved_nm = float((learned.future - learned.x[:, None]).square().mean().sqrt())
    speed = float(learned.v.square().mean().sqrt())
    models = []
    for seed in range(given.seeds):
        torch.manual_seed(seed)
        models.append(build(method, config, structure).to(device))
        models[-1].set_scales(speed, moved_nm, speed)
    base, decoder = models[0], Decoded(models[0])
    stacked, _ = stack_module_state(models)  # type: ignore[arg-type]
    trained = {name for name, p in base.named_parameters() if p.requires_grad}
    fixed = {name: t.detach() for name, t in stacked.items() if name not in trained}
    weights = {name: t.detach().requires_grad_(True) for name, t in stacked.items() if name in trained}

    def predicted(weights: dict[str, Tensor], fixed: dict[str, Tensor], x: Tensor, v: Tensor) -> Tensor:
        return functional_call(decoder, {f"model.{k}": t for k, t in (weights | fixed).items()}, (x, v, structure))

    def of_seeds(x: Tensor, v: Tensor, *, apart: bool) -> Tensor:
        return vmap(predicted, in_dims=(0, 0, *(0 if apart else None,) * 2))(weights, fixed, x, v)

    def errors(windows: Windows) -> Tensor:
        """Mean square error by seed, Å^2 per coordinate."""
        sums = torch.zeros(given.seeds, device=device)
        with torch.no_grad():
            for x, v, future in zip(*(t.split(500) for t in (windows.x, windows.v, windows.future)), strict=True):
                wrong = of_seeds(x, v, apart=False) - future
                sums += 100.0 * wrong.square().mean((2, 3, 4)).sum(1)
        return sums / len(windows.x)

    def learning(x: Tensor, v: Tensor) -> Tensor:
        return of_seeds(x, v, apart=True)

    forward = torch.compile(learning, fullgraph=True, dynamic=False) if device == "cuda" else learning
    rows = torch.zeros(given.seeds, given.batch, dtype=torch.int64, device=device)
    adam = torch.optim.Adam(weights.values(), lr=given.rate, capturable=device == "cuda")

    def step() -> None:
        adam.zero_grad(set_to_none=True)
        wrong = forward(learned.x[rows], learned.v[rows]) - learned.future[rows]
        (wrong.square().mean((1, 2, 3, 4)).sum() / moved_nm**2).backward()
        # The decoder's last update of embeddings and its velocities are of no use here.
        for gradient in (p.grad for p in weights.values() if p.grad is not None):
            norm = gradient.flatten(1).norm(dim=1).clamp(min=1.0)
            gradient /= norm.view(-1, *[1] * (gradient.dim() - 1))
        adam.step()

    go, stream = step, torch.cuda.Stream() if device == "cuda" else None
    if stream is not None:
        torch.cuda.synchronize()
        with torch.cuda.stream(stream):
            for _ in range(3):
                step()
        torch.cuda.synchronize()
        adam.zero_grad(set_to_none=True)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream):
            step()
        go = graph.replay
    generator = torch.Generator(device).manual_seed(0)
    best, best_at, done = torch.full((given.seeds,), torch.inf, device=device), 0, 0
    kept = {name: t.detach().clone() for name, t in weights.items()}
    curve = []
    while done < given.steps and done - best_at < given.patience and time.monotonic() < given.ends:
        with torch.cuda.stream(stream):
            for _ in range(given.every):
                rows.random_(len(learned.x), generator=generator)
                go()
        yield
        done += given.every
        with torch.cuda.stream(stream):
            now = errors(parts["validation"])
            better = now < best
            if bool((now < 0.999 * best).any()):
                best_at = done
            best = torch.where(better, now, best)
            for name, t in weights.items():
                kept[name][better] = t.detach()[better]
            curve.append([done, float(now.mean())])
    with torch.no_grad():
        for name, t in weights.items():
            t.copy_(kept[name])
    found, test = errors(parts["test"]), parts["test"]
    frozen = 100.0 * float((test.future - test.x[:, None]).square().mean())
    return {
        "molecule": path.stem, "method": method, "task": task, "error": found.tolist(), "frozen": frozen,
        "ended": done - best_at >= given.patience, "train_error": errors(learned).tolist(),
        "parameters": n_parameters(base), "steps": done, "best_step": best_at,
        "seconds": round(time.monotonic() - began, 1), "curve": curve[:: max(1, len(curve) // 40)],
    }  # fmt: skip


def run_train(given: argparse.Namespace) -> None:
    painet.MESSAGE_NUMBERS = 10**12  # all rows at once
    torch.set_float32_matmul_precision("high")
    if given.device == "cpu":
        torch.set_num_threads(1)
    rows = json.loads(given.out.read_text()) if given.out.exists() else []
    there = {(r["task"], r["method"], r["molecule"]) for r in rows}
    todo = [key for key in product(given.tasks, given.methods, given.molecules) if key not in there]
    todo = [key for key in todo if key[:2] != ("s2s", "recurrent")]  # which is PAINET
    ends, given.ends = (time.monotonic() + seconds for seconds in (given.within, given.within + GRACE_S))
    active: list[Generator[None, None, dict[str, Any]]] = []
    while active or (todo and time.monotonic() < ends):
        while todo and len(active) < given.at_once and time.monotonic() < ends:
            task, method, name = todo.pop(0)
            active.append(train(given.folder / f"{name}.npz", method, task, given))
        for one in list(active):
            try:
                next(one)
            except StopIteration as ended:
                active.remove(one)
                rows.append(row := ended.value)
                given.out.write_text(json.dumps(rows))
                error = 100 * np.array(row["error"])
                sys.stdout.write(f"{row['task']} {row['method']} {row['molecule']}: {error.mean():.3f} ± "
                                 f"{error.std(ddof=1):.3f} e-2 Å^2, frozen {100 * row['frozen']:.3f}, trained on "
                                 f"{100 * np.mean(row['train_error']):.3f}, {row['parameters']} parameters, "
                                 f"{row['best_step']} of {row['steps']} steps, {row['seconds']} s\n")  # fmt: skip
                sys.stdout.flush()


def percent(errors: list[float]) -> str:
    """Return mean and standard deviation over seeds, 1e-2 Å^2."""
    found = 100.0 * np.array(errors)
    return f"{found.mean():.3g} ± {found.std(ddof=1):.2g}"


def ratio(of: dict[str, dict[str, Any]]) -> str:
    """Return PAINET's mean error over EGNN's and its standard error over seeds."""
    both = [of[method] for method in ("painet", "egnn") if method in of]
    if len(both) < 2:
        return ""
    found = [np.array(row["error"]) for row in both]
    value = found[0].mean() / found[1].mean()
    parts = [x.std(ddof=1) / x.mean() / len(x) ** 0.5 for x in found]
    return f"{value:.2f} ± {value * np.hypot(*parts):.2f}" + " *" * (not all(row["ended"] for row in both))


def run_table(given: argparse.Namespace) -> None:
    """Write the table of all methods on the molecules and tasks of some results; the first of a training counts."""
    by: dict[tuple[str, str, str], dict[str, Any]] = {}
    for path in given.results:
        for row in json.loads(path.read_text()):
            by.setdefault((row["task"], row["molecule"], row["method"]), row)
    methods = [method for method in METHODS if any(key[2] == method for key in by)]
    rows = []
    for task, name in dict.fromkeys(key[:2] for key in sorted(by, reverse=True)):
        of = {method: by[task, name, method] for method in METHODS if (task, name, method) in by}
        cells = [percent(of[m]["error"]) + ("" if of[m]["ended"] else " *") if m in of else "" for m in methods]
        rows.append([task, name, f"{100.0 * next(iter(of.values()))['frozen']:.3g}", *cells, ratio(of)])
    table = {
        "command": "python docs/studies/published/forecaster_ablations.py table RESULTS.json...",
        "machine": given.machine,
        "note": "Mean square error on test windows, 1e-2 Å^2 per coordinate, mean ± standard deviation over seeds "
                "(ratio: ± standard error). *: time was up before the validation error had not fallen for 2,000 steps.",
        "columns": ["task", "molecule", "frozen", *methods, "painet / egnn"],
        "rows": rows,
    }  # fmt: skip
    given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True)
    windows, training, tabling = (verbs.add_parser(name) for name in ("windows", "train", "table"))
    for part in (windows, training):
        part.add_argument("folder", type=Path)
        part.add_argument("--molecules", nargs="+", default=MOLECULES, choices=MOLECULES)
    training.add_argument("-o", "--out", type=Path, required=True)
    training.add_argument("--tasks", nargs="+", default=["s2s", "s2t"], choices=("s2s", "s2t"))
    training.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    training.add_argument("--seeds", type=int, default=5)
    training.add_argument("--width", type=int, default=64)
    training.add_argument("--batch", type=int, default=100)
    training.add_argument("--rate", type=float, default=5e-4)
    training.add_argument("--steps", type=int, default=20_000)
    training.add_argument("--patience", type=int, default=2_000)
    training.add_argument("--every", type=int, default=100)
    training.add_argument("--within", type=float, default=float("inf"), help="seconds, after which no training begins")
    training.add_argument("--device", default="cpu")
    training.add_argument("--at-once", type=int, default=1, help="trainings side by side, on a GPU")
    training.set_defaults(run=run_train)

    def run_windows(given: argparse.Namespace) -> None:
        given.folder.mkdir(parents=True, exist_ok=True)
        for name in given.molecules:
            if not (out := given.folder / f"{name}.npz").exists():
                make_windows(name, out)

    windows.set_defaults(run=run_windows)
    tabling.add_argument("results", type=Path, nargs="+")
    tabling.add_argument("-o", "--out", type=Path, required=True)
    tabling.add_argument("--machine", required=True, help="where the results were made")
    tabling.set_defaults(run=run_table)
    given = parser.parse_args()
    given.run(given)


if __name__ == "__main__":
    main()
