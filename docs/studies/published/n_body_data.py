"""Data of the n-body tasks: made by `n_body_generator` in parallel, kept in one file, gone on with."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from n_body_generator import N_BODY, generate_n_body
from particle_sets import SPLITS, ParticleSet, append_systems, create_sets, n_complete

from md_reference.run.machine import available_cores
from systems.interrupts import end_with_parent

if TYPE_CHECKING:
    from surrogate.progress import ProgressFn

# The seeds of a split start here, so that splits of any size below it share none.
SEED_STRIDE = 1_000_000
_BLOCK = 50


def split_seeds(split: str, n: int) -> range:
    """Return the seeds of the first n systems of a split."""
    first = SPLITS.index(split) * SEED_STRIDE
    return range(first, first + n)


def make_systems(name: str, seeds: range) -> ParticleSet:
    """Simulate the n-body systems `name:seed`.

    Types are 1 and 2 for negative and positive charges, else 0. A pair's kind is what GeoTDM's models are told of it:
    the product of charges (1 repelling, 0 attracting), a spring (1) or none (0), 0 for all of gravity.
    """
    made = generate_n_body(name, seeds)
    charged = made.charges_e[:, :, None] * made.charges_e[:, None, :]
    return ParticleSet(
        positions_nm=made.positions_nm,
        velocities_nm_ps=made.velocities_nm_ps,
        types=np.where(made.charges_e == 0, 0, np.where(made.charges_e < 0, 1, 2)).astype(np.int64),
        pairs=((charged > 0) | (made.edges > 0)).astype(np.int64),
        seeds=np.array(seeds, dtype=np.int64),
        lag_ps=float(made.time_ps[1] - made.time_ps[0]),
    )


def make_sets(
    name: str, path: Path, counts: dict[str, int], *, workers: int | None = None, progress: ProgressFn | None = None
) -> None:
    """Fill the file with `counts[split]` systems of each split, block by block; what is there already stays.

    Blocks are simulated side by side by `workers` processes (one per core) and written in the order of their seeds, so
    that a file does not depend on how often it was interrupted. Raises InputError for a file of other data.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    protocol = N_BODY[name]
    create_sets(path, {"name": name, "lag_ps": protocol.save_every_ps, "protocol": asdict(protocol)})
    done = {split: n_complete(path, split) for split in counts}
    todo = [
        (split, split_seeds(split, n)[start : min(start + _BLOCK, n)])
        for split, n in counts.items()
        for start in range(done[split], n, _BLOCK)
    ]
    n_done, total = sum(min(done[s], n) for s, n in counts.items()), sum(counts.values())
    for split, block in _simulated(name, todo, min(workers or available_cores(), len(todo))):
        append_systems(path, split, block)
        n_done += len(block)
        if progress is not None:
            progress(n_done, total)


def _simulated(name: str, todo: list[tuple[str, range]], workers: int) -> Iterator[tuple[str, ParticleSet]]:
    if workers <= 1:
        for split, seeds in todo:
            yield split, make_systems(name, seeds)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker) as pool:
        futures: list[Future[ParticleSet]] = [pool.submit(make_systems, name, seeds) for _, seeds in todo]
        try:
            for (split, _), future in zip(todo, futures, strict=True):
                yield split, future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the parent, which ends its workers
    end_with_parent()
