"""Where one of two clocks was set anew: jumps of the lower envelope of the delay between them."""

from __future__ import annotations

import numpy as np

_WINDOW = 31  # reads on each side of a boundary that are compared
_MIN_JUMP_S = 0.02
_MAX_DRIFT = 1e-3


def continuous_pieces(reader_ns: np.ndarray, arrival_ns: np.ndarray) -> list[np.ndarray]:
    """Rows, in order of arrival, of each piece of a table in which neither clock was set anew; every row is in one piece.

    Arrivals that were held up and then come at once also raise the delay, but only for a while, and the reader's times
    go on: these rows stay in one piece.
    """
    delay_ns = arrival_ns - reader_ns
    delay_s = (delay_ns - np.partition(delay_ns, len(delay_ns) // 2)[len(delay_ns) // 2]) * 1e-9
    cuts, threshold_s = _jumps(delay_s)
    pieces = np.split(np.arange(len(delay_s)), cuts)
    return _without_short(_without_queues(pieces, reader_ns, arrival_ns, delay_s, threshold_s), reader_ns)


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


def _without_queues(
    pieces: list[np.ndarray], reader_ns: np.ndarray, arrival_ns: np.ndarray, delay_s: np.ndarray, threshold_s: float
) -> list[np.ndarray]:
    """Pieces joined where the delay, after it was larger for a while, is what it was before."""
    levels = [_low(delay_s[rows]) for rows in pieces]
    joined: list[np.ndarray] = []
    first = 0
    while first < len(pieces):
        last = first
        for piece in range(first + 1, len(pieces)):
            start = pieces[piece][0]
            if reader_ns[start] - reader_ns[start - 1] < -threshold_s * 1e9:
                break  # the reader's clock was set back
            gap_s = abs(int(arrival_ns[start]) - int(arrival_ns[pieces[first][-1]])) * 1e-9
            if abs(levels[piece] - levels[first]) <= threshold_s + _MAX_DRIFT * gap_s:
                last = piece
            elif levels[piece] < levels[first]:
                break
        joined.append(np.concatenate(pieces[first : last + 1]))
        first = last + 1
    return joined


def _without_short(pieces: list[np.ndarray], reader_ns: np.ndarray) -> list[np.ndarray]:
    """Pieces without those that are too short for a clock of their own: these rows go to the piece before, or after."""
    window = _window(sum(map(len, pieces)))

    def is_short(rows: np.ndarray) -> bool:
        return 2 * len(rows) < window or (len(rows) < 2 * window and int(np.ptp(reader_ns[rows])) < 10**9)

    kept: list[list[np.ndarray]] = [[]]
    for rows in pieces:
        if kept[-1] and not is_short(rows) and not all(map(is_short, kept[-1])):
            kept.append([])
        kept[-1].append(rows)
    return [np.concatenate(group) for group in kept]
