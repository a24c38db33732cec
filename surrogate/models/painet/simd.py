"""PAINET's potential by SIMD: copies of a molecule side by side, one in each element of a vector register.

`simd.cpp` computes energies and their mean's gradient as `EnergyNetwork` and torch do, in single precision, and moves
the copies by it with the bath and rigid bonds of md_reference.simd. It is compiled at first use, in seconds.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from md_reference import simd as engine
from surrogate.models.painet.energy import (
    LEAST_NM,
    N_SHELLS,
    SIZES,
    WALL,
    EdgeWeights,
    EnergyNetwork,
    Look,
    PotentialConfig,
    Topology,
    radial_grid,
)
from surrogate.models.painet.model import EnergyAttention
from surrogate.models.potential import TOLERANCE, Bath
from systems.files.native import CompilerError, compiled_program

_SOURCE = Path(__file__).with_name("simd.cpp")
# Copies at once: a whole register of them, and where no more are asked for; what arrays are aligned to, bytes. Where a
# number of each copy takes two registers, compilers keep most of them in memory, and it takes several times as long.
_WIDTH = {"AVX512": 16, "AVX2": 8}.get(torch.backends.cpu.get_cpu_capability(), 4)
_FEW, _ALIGNED = 4, 64


class _Linear(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("weight", "turned", "bias")]


class _Step(ctypes.Structure):
    _fields_ = [
        *((name, _Linear) for name in ("send", "first", "second", "third", "qkv", "out")),
        *((name, ctypes.c_void_p) for name in ("phi", "psi")),
    ]


class _Bath(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int32) for name in ("n_atoms", "n_bonds")),
        *((name, ctypes.c_void_p) for name in ("atoms", "bonds", "lengths")),
        *((name, ctypes.c_double) for name in ("timestep", "keep", "noise", "tolerance")),
    ]


class SimdPotential:
    """Frames `(rows, n_atoms, 3)` nm of one molecule -> the members' energies `(rows, n_members)` in kJ/mol and the
    gradient `(rows, n_atoms, 3)` of their mean, by the network's weights as they are now, times `unit` and from `zero`,
    both in kJ/mol."""

    def __init__(self, network: EnergyNetwork, topology: Topology, made: EdgeWeights, unit: float, zero: float) -> None:
        config, n = network.config, topology.molecule.n_atoms
        self.config, self.n_atoms, self.unit, self.zero = config, n, unit, zero
        self._work: dict[tuple[int, int], npt.NDArray[Any]] = {}
        # The program reads these arrays in place.
        self._kept: list[npt.NDArray[Any]] = []
        types = topology.molecule.elements
        steps = []
        looks, attentions = cast(Iterable[Look], network.looks), cast(Iterable[EnergyAttention], network.steps)
        for look, attention in zip(looks, attentions, strict=True):
            phi, psi = (m[:, types][:, :, types] for m in attention.type_matrices())
            dense = (look.update[0], look.update[2], look.update[4], attention.qkv, attention.out)
            linear = [self._linear(layer) for layer in (look.send, *dense)]
            linear[1] = self._linear(look.update[0], look.once())
            steps.append(_Step(*linear, self._array(phi), self._array(psi)))
        edges, shell = made.edges, made.edges.shell
        begin, spacing = radial_grid(config.n_radial, config.cutoff_nm, made.of_atom)
        per_cutoff2 = torch.where(shell == N_SHELLS - 1, config.cutoff_nm**-2, 0.0)
        pairs = (begin[shell], 1.0 / spacing[shell], per_cutoff2, 1.0 / made.nearest_nm[:, 0].clamp(min=LEAST_NM),
                 1.0 / made.farthest_nm[:, 0])  # fmt: skip
        seen = torch.cat(made.looks, dim=-1)
        of_pair = 0.5 * made.table.unflatten(0, (n, n))
        tables = of_pair + of_pair.transpose(0, 1)
        tables = torch.cat([tables, tables.mean(-1, keepdim=True)], dim=-1)
        last = cast(nn.Linear, network.site[2])
        members = torch.cat([last.weight, last.bias[:, None], network.latent.T / n**2], dim=-1)
        assert edges.dense

        class Network(ctypes.Structure):
            _fields_ = [
                ("n", ctypes.c_int64), ("steps", _Step * config.n_steps), ("site", _Linear),
                *((name, ctypes.c_void_p) for name in ("members", "of_atom", "edges", "tables", "pairs")),
                ("eta", ctypes.c_float), ("wall", ctypes.c_float),
            ]  # fmt: skip

        read_out = torch.cat([members, members.mean(0, keepdim=True)])
        arrays = (read_out, made.of_atom, seen, tables, torch.stack(pairs, dim=-1))
        places = (self._array(array) for array in arrays)
        self._network = Network(
            n, (_Step * config.n_steps)(*steps), self._linear(network.site[0]), *places, config.step, WALL
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> SimdPotential:
        return self  # pointers into arrays that never change

    @torch.no_grad()
    def __call__(self, positions_nm: Tensor) -> tuple[Tensor, Tensor]:
        rows, width = len(positions_nm), _width_for(len(positions_nm))
        x = _laid(positions_nm.double(), width)
        energy = torch.empty(len(x), self.config.n_members, width)
        gradient = torch.empty(len(x), self.n_atoms, 3, width)

        def compute(block: int, program: ctypes.CDLL, work: int) -> None:
            places = (x[block].data_ptr(), energy[block].data_ptr(), gradient[block].data_ptr(), work)
            program.evaluate(ctypes.byref(self._network), *map(ctypes.c_void_p, places))

        self._each_block(len(x), width, compute)
        members = energy.transpose(1, 2).flatten(0, 1)[:rows].double()
        return self.zero + self.unit * members, self.unit * _back(gradient, rows).double()

    @torch.no_grad()
    def langevin(self, x: Tensor, v: Tensor, draw: Tensor, bath: Bath) -> tuple[Tensor, Tensor]:
        """Return positions nm and velocities nm/ps `(rows, n_atoms, 3)` after the steps that `draw` (rows, n_atoms,
        n_steps, 3) holds normal numbers for."""
        rows, width, n_steps = len(x), _width_for(len(x)), draw.shape[2]
        at, moving = _laid(x.double(), width), _laid(v.double(), width)
        drawn = _laid((bath.lost[..., None] * draw).transpose(1, 2).float(), width)
        # What the bath gives is drawn: no thermal speeds.
        atoms = torch.cat([1.0 / bath.masses, torch.zeros_like(bath.masses)], dim=-1)
        if (rigid := bath.rigid) is None:
            bonds, lengths = torch.zeros(0, 2, dtype=torch.int32), atoms
        else:
            bonds = torch.stack([rigid.first, rigid.second], dim=-1).to(torch.int32)
            lengths = rigid.length2.sqrt()
        places = (array.data_ptr() for array in (atoms, bonds, lengths))
        settings = _Bath(self.n_atoms, len(bonds), *places, bath.timestep_ps, bath.kept, 1.0, TOLERANCE)

        def compute(block: int, program: ctypes.CDLL, work: int) -> None:
            of_block = [ctypes.c_void_p(array[block].data_ptr()) for array in (at, moving, drawn)]
            program.langevin(ctypes.byref(self._network), ctypes.byref(settings), ctypes.c_double(self.unit), *of_block,
                             ctypes.c_int64(n_steps), ctypes.c_void_p(work))  # fmt: skip

        self._each_block(len(at), width, compute)
        return _back(at, rows), _back(moving, rows)

    def _each_block(self, n_blocks: int, width: int, compute: Callable[[int, ctypes.CDLL, int], None]) -> None:
        """Call `compute(block, program, room to work in)` for each block of copies, on as many cores as torch takes."""
        program, n_threads = _program(self.config, width), min(torch.get_num_threads(), n_blocks)

        def some(thread: int) -> None:
            if (work := self._work.get((width, thread))) is None:
                work = _aligned(int(program.work_floats(ctypes.c_int64(self.n_atoms))))
                self._work[width, thread] = work
            for block in range(thread, n_blocks, n_threads):
                compute(block, program, work.ctypes.data)

        if n_threads == 1:
            some(0)
        else:
            list(_pool(n_threads).map(some, range(n_threads)))

    def _array(self, values: Tensor) -> int:
        self._kept.append(np.ascontiguousarray(values.detach().numpy(), dtype=np.float32))
        return self._kept[-1].ctypes.data

    def _linear(self, layer: Any, weight: Tensor | None = None) -> _Linear:
        if layer is None:
            return _Linear()
        weight = layer.weight if weight is None else weight
        return _Linear(self._array(weight), self._array(weight.T), self._array(layer.bias))


def simd_potential_of(network: EnergyNetwork, topology: Topology, made: EdgeWeights, rows: int, unit: float = 1.0,
                      zero: float = 0.0) -> SimdPotential | None:  # fmt: skip
    """Return the potential by SIMD, compiled for so many frames; None where it does not run so: not in single precision
    on this processor, for so many atoms that pairs change from frame to frame, or without a C++ compiler."""
    if made.of_atom.dtype != torch.float32 or made.of_atom.device.type != "cpu" or not made.edges.dense:
        return None
    try:
        _program(network.config, _width_for(rows))
    except (CompilerError, OSError):
        return None
    return SimdPotential(network, topology, made, unit, zero)


def _width_for(rows: int) -> int:
    return _WIDTH if rows > _FEW else _FEW


def _laid(values: Tensor, width: int) -> Tensor:
    """`values` (rows, ..) -> (blocks, .., width), a copy, which the program moves in place; places that have no row
    hold the last."""
    n_blocks = -(-len(values) // width)
    if n_blocks * width > len(values):
        values = values[torch.arange(n_blocks * width).clamp(max=len(values) - 1)]
    # One whole block that comes `_back` from here lies as it is wanted: `contiguous` would not copy it.
    return values.unflatten(0, (n_blocks, width)).movedim(1, -1).clone(memory_format=torch.contiguous_format)


def _back(laid: Tensor, rows: int) -> Tensor:
    return laid.movedim(-1, 1).flatten(0, 1)[:rows]


@lru_cache(maxsize=8)
def _program(config: PotentialConfig, width: int) -> ctypes.CDLL:
    sizes = {name.upper(): getattr(config, name) for name in SIZES}
    program = compiled_program(_SOURCE, {"W": width, **sizes}, Path(engine.__path__[0]))
    program.work_floats.restype = ctypes.c_int64
    return program


@lru_cache(maxsize=1)
def _pool(n_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(n_threads, "simd")


def _aligned(n_floats: int) -> npt.NDArray[Any]:
    """Return an array that begins where a register may be loaded from."""
    raw = np.empty(4 * n_floats + _ALIGNED, dtype=np.uint8)
    begin = -raw.ctypes.data % _ALIGNED
    return raw[begin : begin + 4 * n_floats].view(np.float32)
