"""Error bars: blocks of correlated frames, bootstrap over blocks, permutation tests, effective sample size.

Everything resampled here is a sum over blocks (histogram counts, lagged products), so one draw is one row of a matrix
product and no frame is touched twice.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
AnyFloat = npt.NDArray[np.floating[Any]]
# One array per stretch of unbroken time, frames first.
Segments = Sequence[npt.NDArray[Any]]

MIN_BLOCKS = 4
MAX_BLOCKS = 100
BLOCK_IN_CORRELATION_TIMES = 10
ENOUGH_AS_FAR = 100
# Beyond this an interval of a logarithm says that nothing is known, and its ends overflow.
_WIDEST_LOG = 20.0


class Piece(NamedTuple):
    """Frames `start:stop` of one segment, belonging to block `block`."""

    segment: int
    start: int
    stop: int
    block: int


class Blocks(NamedTuple):
    """A division of all segments into blocks that are close to independent."""

    pieces: tuple[Piece, ...]
    n_blocks: int
    n_frames_each: int

    @staticmethod
    def whole(segment_lengths: Sequence[int]) -> Blocks:
        """Return one block per segment."""
        pieces = tuple(Piece(i, 0, n, i) for i, n in enumerate(segment_lengths))
        return Blocks(pieces, len(pieces), max(segment_lengths, default=0))


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval, standard error, that of its logarithm (NaN when it is not positive), and the
    number of blocks behind it."""

    value: float
    low: float = math.nan
    high: float = math.nan
    error: float = math.nan
    log_error: float = math.nan
    n_blocks: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able numbers; what is not finite becomes None."""
        return {k: (v if math.isfinite(v) else None) for k, v in vars(self).items()}


def block_length(n_frames: int, correlation_frames: float) -> int:
    """Return the block length in frames: ten correlation times, but at least 4 and at most 100 blocks in all."""
    wanted = BLOCK_IN_CORRELATION_TIMES * correlation_frames if math.isfinite(correlation_frames) else n_frames
    shortest, longest = n_frames / MAX_BLOCKS, n_frames / MIN_BLOCKS
    return max(1, int(min(max(wanted, shortest), longest)))


def make_blocks(segment_lengths: Sequence[int], n_frames_each: int) -> Blocks:
    """Divide segments into blocks of about `n_frames_each` frames: a long segment is cut evenly, segments shorter than
    a block are gathered whole. No piece crosses a segment."""
    pieces: list[Piece] = []
    block, gathered = 0, 0
    for segment, n in enumerate(segment_lengths):
        n_cuts = round(n / n_frames_each)
        if n_cuts >= 2:
            if gathered:
                block, gathered = block + 1, 0
            edges = np.linspace(0, n, n_cuts + 1).astype(int).tolist()
            for start, stop in itertools.pairwise(edges):
                pieces.append(Piece(segment, start, stop, block))
                block += 1
        elif n > 0:
            pieces.append(Piece(segment, 0, n, block))
            gathered += n
            if gathered >= 0.75 * n_frames_each:
                block, gathered = block + 1, 0
    return Blocks(tuple(pieces), pieces[-1].block + 1 if pieces else 0, n_frames_each)


def bootstrap_weights(n_blocks: int, n_draws: int, rng: np.random.Generator) -> FloatArray:
    """Return how often each block is drawn, `(n_draws, n_blocks)`: the block bootstrap as multinomial counts."""
    return rng.multinomial(n_blocks, np.full(n_blocks, 1.0 / n_blocks), size=n_draws).astype(np.float64)


def widening(n_blocks: int) -> float:
    """Return the factor from the spread of bootstrap draws to the standard error.

    sqrt(B / (B - 1)) for drawing from B blocks, and 1 / sqrt(1 - 1/10) for blocks of ten correlation times: the mean
    over a block of length b has the variance (2 tau / b) (1 - tau / b), of which only the first factor falls off as one
    over the length. Source: Flyvbjerg and Petersen, J. Chem. Phys. 91, 461 (1989).
    """
    return math.sqrt(n_blocks / (n_blocks - 1) / (1.0 - 1.0 / BLOCK_IN_CORRELATION_TIMES)) if n_blocks > 1 else math.nan


def estimate(value: float, draws: npt.ArrayLike, n_blocks: int, *, log: bool = False) -> Estimate:
    """Return `value` with its 95 % interval from bootstrap `draws` `(n_draws,)`.

    The draws are centred on the value (resampling biases every histogram distance upward), and their spread is widened
    by Student's t over the normal quantile and by `widening`, because B blocks are few and remember each other. With
    `log` the interval is made for the logarithm, for quantities that are positive and skewed (times, ratios).
    """
    from scipy.special import stdtrit

    array = np.asarray(draws, dtype=np.float64)
    array = array[np.isfinite(array)]
    if not math.isfinite(value) or len(array) < 2 or n_blocks < 2:
        return Estimate(value, n_blocks=n_blocks)
    widen = widening(n_blocks)
    t_over_normal = float(stdtrit(n_blocks - 1, 0.975)) / 1.959964
    log_error = float(np.log(array).std() * widen) if value > 0 and (array > 0).all() else math.nan
    error = float(array.std() * widen)
    if log and math.isfinite(log_error):
        logs = np.log(array)
        low, high = np.quantile(logs, [0.025, 0.975]) - logs.mean()
        half = min(widen * t_over_normal * max(-low, high), _WIDEST_LOG)
        bounds = value * math.exp(-half), value * math.exp(half)
    else:
        low, high = np.quantile(array, [0.025, 0.975]) - array.mean()
        bounds = value + widen * t_over_normal * low, value + widen * t_over_normal * high
    return Estimate(value, float(bounds[0]), float(bounds[1]), error, log_error, n_blocks)


def mean_estimate(value: float, draws: FloatArray, n_blocks: int) -> Estimate:
    """Return `value` with its standard error alone: enough for a test, where there are too many for intervals."""
    return Estimate(value, error=float(draws.std()) * widening(n_blocks), n_blocks=n_blocks)


def difference_p(a: Estimate, b: Estimate, *, log: bool = False) -> float:
    """Return the two-sided p-value of a = b: Student's t of the difference over the combined standard error.

    The error is that of two unequal variances (Welch, Biometrika 34, 28, 1947) or, where it is larger, that of one
    variance for all blocks: of few blocks one in many has far too small a spread by chance. With `log` the logarithms
    are compared. Two numbers without any spread give 1 when equal and 0 when not; NaN when one of them is not finite.
    """
    from scipy.special import stdtr

    if log and a.value > 0 and b.value > 0 and math.isfinite(a.log_error) and math.isfinite(b.log_error):
        gap, errors = abs(math.log(a.value / b.value)), (a.log_error, b.log_error)
    else:
        gap, errors = abs(a.value - b.value), (a.error, b.error)
    if not (math.isfinite(gap) and math.isfinite(sum(errors))):
        return math.nan
    if max(errors) == 0.0:
        return 1.0 if gap == 0.0 else 0.0
    combined, freedom = _combined(errors, (a.n_blocks, b.n_blocks))
    return float(2.0 * stdtr(freedom, -gap / combined))


def _combined(errors: tuple[float, float], n_blocks: tuple[int, int]) -> tuple[float, float]:
    """Return the standard error of a difference and its degrees of freedom; see `difference_p`."""
    each = [max(n - 1, 1) for n in n_blocks]
    unequal = math.hypot(*errors)
    of_block = [error**2 * (free + 1) for error, free in zip(errors, each, strict=True)]
    common = sum(v * free for v, free in zip(of_block, each, strict=True)) / sum(each)
    equal = math.sqrt(common * sum(1.0 / (free + 1) for free in each))
    if equal > unequal * (1.0 + 1e-9):
        return equal, float(sum(each))
    shares = [(error / unequal) ** 2 for error in errors]
    return unequal, 1.0 / sum(share**2 / free for share, free in zip(shares, each, strict=True))


def pooled(a: Estimate, b: Estimate, *, log: bool = False) -> Estimate:
    """Return the mean of two measurements of one thing, weighted by their blocks (geometric with `log`).

    Its error is the combined standard error, or half their difference where that is larger: two pieces of one reference
    that disagree by more than their error bars show that the bars are too short.
    """
    n_blocks = a.n_blocks + b.n_blocks
    share = a.n_blocks / n_blocks if n_blocks else 0.5
    apart = math.sqrt(share * (1.0 - share))
    if log and a.value > 0 and b.value > 0:
        value = math.exp(share * math.log(a.value) + (1.0 - share) * math.log(b.value))
        combined = math.hypot(share * a.log_error, (1.0 - share) * b.log_error)
        log_error = max(combined, apart * abs(math.log(a.value / b.value))) if math.isfinite(combined) else math.nan
        return Estimate(value, error=value * log_error, log_error=log_error, n_blocks=n_blocks)
    combined = math.hypot(share * a.error, (1.0 - share) * b.error)
    error = max(combined, apart * abs(a.value - b.value)) if math.isfinite(combined) else math.nan
    return Estimate(share * a.value + (1.0 - share) * b.value, error=error, n_blocks=n_blocks)


def excess_p(n_candidate: int, n_others: int, share: float) -> float:
    """Return the probability that at least `n_candidate` of all faults fall to a trajectory with `share` of all frames.

    Exact binomial test, one-sided, conditional on the number of faults (Przyborowski and Wilenski, Biometrika 31, 313,
    1940); frames count as independent.
    """
    from scipy.special import bdtrc

    return float(bdtrc(n_candidate - 1, n_candidate + n_others, share)) if n_candidate > 0 else 1.0


def permutation_p(
    counts_a: FloatArray,
    counts_b: FloatArray,
    distance: Callable[[FloatArray, FloatArray], FloatArray],
    rng: np.random.Generator,
    n_permutations: int = 1000,
    strata: IntArray | None = None,
) -> float:
    """Return the p-value of "both sets of blocks come from one distribution" under the statistic `distance`.

    `counts_a` and `counts_b` are histograms per block, `(n_blocks_a | n_blocks_b, n_bins)`. Blocks are dealt at random
    to two sides; the p-value is the share of deals at least as far apart as the data. Dealing stops early once
    `ENOUGH_AS_FAR` deals were as far (Besag and Clifford, Biometrika 78, 301, 1991), as p is then known well enough.
    Blocks must be longer than the correlation time for the blocks to be exchangeable. With `strata` `(n_blocks_a +
    n_blocks_b,)` only blocks of one stratum are exchanged: each side keeps as many of each kind as it has.
    """
    pooled = np.concatenate([counts_a, counts_b])
    n_a, n = len(counts_a), len(pooled)
    groups = [np.arange(n)] if strata is None else [np.flatnonzero(strata == k) for k in np.unique(strata)]
    observed = float(distance(counts_a.sum(0)[None], counts_b.sum(0)[None])[0])
    total = pooled.sum(0)
    n_as_far, done = 0, 0
    largest = max(1, min(n_permutations, int(2e6 // max(pooled.shape[1], 1))))
    batch = min(largest, 2 * ENOUGH_AS_FAR)
    while done < n_permutations:
        size = min(batch, n_permutations - done)
        side = np.zeros((size, n))
        for members in groups:
            n_left = int((members < n_a).sum())
            if 0 < n_left < len(members):
                dealt = np.argpartition(rng.random((size, len(members))), n_left, axis=1)[:, :n_left]
                np.put_along_axis(side, members[dealt], 1.0, axis=1)
            else:
                side[:, members] = float(n_left > 0)
        left = side @ pooled
        as_far = n_as_far + (distance(left, total - left) >= observed * (1 - 1e-12)).cumsum()
        if as_far[-1] >= ENOUGH_AS_FAR:
            return float(ENOUGH_AS_FAR / (done + int(np.argmax(as_far >= ENOUGH_AS_FAR)) + 1))
        n_as_far, done, batch = int(as_far[-1]), done + size, min(largest, 4 * batch)
    return (n_as_far + 1) / (n_permutations + 1)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number (Holm, Scand. J. Statist. 6, 65, 1979); NaN stays NaN, uncounted."""
    finite = [i for i, p in enumerate(p_values) if math.isfinite(p)]
    adjusted = [math.nan] * len(p_values)
    running = 0.0
    for rank, i in enumerate(sorted(finite, key=lambda i: p_values[i])):
        running = max(running, min(1.0, (len(finite) - rank) * p_values[i]))
        adjusted[i] = running
    return adjusted


def effective_samples(n_frames: int, correlation_frames: float) -> float:
    """Return the number of independent samples, n / (2 tau), tau the integrated autocorrelation time in frames."""
    if not correlation_frames > 0:
        return math.nan
    return n_frames / max(2.0 * correlation_frames, 1.0)
