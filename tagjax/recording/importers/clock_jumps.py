"""Where one of two clocks was set anew: jumps of the lower envelope of the delay between them."""

from __future__ import annotations

import numpy as np
import scipy  # `scipy.ndimage` is imported at its first use: it takes a quarter of a second

_WINDOW = 31  # reads on each side of a boundary that are compared
_MIN_JUMP_S = 0.02
_MAX_DRIFT = 1e-3
_MAX_QUEUE_S = 10.0  # arrivals are held up for so long at most, where only a few are


def continuous_pieces(reader_ns: np.ndarray, arrival_ns: np.ndarray) -> list[np.ndarray]:
    """Rows, in order of arrival, of each piece of a table in which neither clock was set anew.

    Arrivals that were held up and then come at once also raise the delay, but only for a while: these rows stay in one
    piece. Rows of no piece have a wrong time: a few in a row whose delay differs from all around by more than `_MAX_QUEUE_S`.
    """
    delay_ns = arrival_ns - reader_ns
    delay_s = (delay_ns - np.partition(delay_ns, len(delay_ns) // 2)[len(delay_ns) // 2]) * 1e-9
    # A single wrong row is no jump: the median of its neighbours stands in for it.
    usual_s = scipy.ndimage.median_filter(delay_s, 7, mode="mirror")
    cuts, threshold_s = _jumps(np.where(far_too_small(delay_s), usual_s, delay_s))
    pieces = np.split(np.arange(len(delay_s)), cuts)
    levels = [_low(delay_s[rows]) for rows in pieces]
    window = _window(len(delay_s))
    is_long = [2 * len(rows) >= window and not _is_brief(rows, arrival_ns, window) for rows in pieces]
    groups: list[list[int]] = []  # long pieces of one clock
    for piece in np.flatnonzero(is_long):
        since = groups[-1][-1] if groups else piece
        gap_s = abs(int(arrival_ns[pieces[piece][0]]) - int(arrival_ns[pieces[since][-1]])) * 1e-9
        if groups and abs(levels[piece] - levels[since]) <= threshold_s + _MAX_DRIFT * gap_s:
            groups[-1].append(int(piece))
        else:
            groups.append([int(piece)])
    groups = _without_queues(groups, levels, threshold_s)
    if not groups:
        return [np.arange(len(delay_s))]
    for piece in np.flatnonzero(
        ~np.array(is_long)
    ):  # a few reads belong to the clock whose delays are most like theirs
        group = min(groups, key=lambda one: abs(levels[one[0]] - levels[piece]))
        beside = group[0] - 1 <= piece <= group[-1] + 1
        if beside and abs(levels[group[0]] - levels[piece]) <= _MAX_QUEUE_S:
            group.append(int(piece))
    return [np.concatenate([pieces[piece] for piece in sorted(group)]) for group in groups]


def far_too_small(delay_s: np.ndarray) -> np.ndarray:
    """Rows whose delay is far below the median of their neighbours: latency makes delays larger, a wrong time smaller too.

    At an end the median counts the rows inside twice, so that a wrong first row stands out.
    """
    below_s = scipy.ndimage.median_filter(delay_s, 7, mode="mirror") - delay_s
    return below_s > 3 * np.quantile(np.abs(below_s), 0.95) + _MIN_JUMP_S


def _without_queues(groups: list[list[int]], levels: list[float], threshold_s: float) -> list[list[int]]:
    """Groups joined where the delay, after it was larger for a while, is what it was before."""
    joined: list[list[int]] = []
    while groups:
        group, groups = groups[0], groups[1:]
        for number, later in enumerate(groups):
            if levels[later[0]] < levels[group[0]] - threshold_s:
                break
            if abs(levels[later[0]] - levels[group[0]]) <= threshold_s:
                group = group + [piece for one in groups[: number + 1] for piece in one]
                groups = groups[number + 1 :]
                break
        joined.append(group)
    return joined


def _is_brief(rows: np.ndarray, arrival_ns: np.ndarray, window: int) -> bool:
    return len(rows) < 2 * window and int(np.ptp(arrival_ns[rows])) < 10**9


def _window(num_rows: int) -> int:
    return int(np.clip(num_rows // 4, 1, _WINDOW))


def _low(delay_s: np.ndarray) -> float:
    """The smallest delay but for a few, which may be wrong."""
    rank = min(len(delay_s) - 1, len(delay_s) // 10)
    return float(np.partition(delay_s, rank)[rank])


def _jumps(delay_s: np.ndarray) -> tuple[np.ndarray, float]:
    """First rows after a jump of the delay's lower envelope, and the size in seconds that the jumps exceed."""
    num_rows, window = len(delay_s), _window(len(delay_s))
    rank = window // 10
    low = np.partition(np.lib.stride_tricks.sliding_window_view(delay_s, window), rank, axis=1)[:, rank]
    boundary = np.arange(window, num_rows - window + 1)
    rise = low[boundary] - low[boundary - window]
    rise = rise - np.median(rise)  # a clock of another rate is one piece, which is refused as such
    threshold_s = 10 * 1.4826 * float(np.median(np.abs(rise))) + _MIN_JUMP_S
    far = np.flatnonzero(np.abs(rise) > threshold_s)
    cuts = set()
    for run in np.split(far, np.flatnonzero(np.diff(far) > 1) + 1) if len(far) else []:
        inside = boundary[run]
        start, end = inside[0] - window, inside[-1] + window
        before, after = np.median(delay_s[start : inside[0]]), np.median(delay_s[inside[-1] : end])
        # The cut with the least sum of distances: of the rows before it from one level, after it from the other.
        rows = delay_s[start:end]
        cost = np.r_[0.0, np.cumsum(np.abs(rows - before) - np.abs(rows - after))]
        cuts.add(int(start + np.argmin(cost)))
    return np.array(sorted(cuts - {0, num_rows}), int), threshold_s
