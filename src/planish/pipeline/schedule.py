"""In which order pairs are tried: so that consecutive ones share measurements, which then are prepared once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

Pair = tuple[str, str]

#: Prepared measurements that a worker keeps at full resolution.
_KEPT = 3
#: Most pairs of a block: what a killed worker loses, and what others wait for at the end.
MAX_BLOCK = 16
#: Blocks per worker at least, so that all end at about the same time.
_BLOCKS_PER_SLOT = 4


def blocks(pairs: Sequence[Pair], slots: int, most: int = MAX_BLOCK) -> list[list[Pair]]:
    """Return the pairs in blocks of at most `most`, each for one of `slots` workers, one pair after the other."""
    ordered = _walk(pairs)
    size = max(1, min(most, len(ordered) // (_BLOCKS_PER_SLOT * slots)))
    return [ordered[i : i + size] for i in range(0, len(ordered), size)]


def _walk(pairs: Sequence[Pair]) -> list[Pair]:
    """Order pairs: next is one whose measurements have been seen last, both, or else one of them."""
    left: dict[str, dict[str, Pair]] = {}
    for a, b in sorted(pairs):
        left.setdefault(a, {})[b] = (a, b)
        left.setdefault(b, {})[a] = (a, b)
    starts = iter(sorted(left))
    kept: OrderedDict[str, None] = OrderedDict()
    ordered: list[Pair] = []
    start = next(starts, None)
    while start is not None:
        pair = _next_pair(left, list(kept)) or (min(left[start].values()) if left[start] else None)
        if pair is None:
            start = next(starts, None)
            continue
        a, b = pair
        del left[a][b], left[b][a]
        ordered.append(pair)
        for name in pair:
            kept[name] = None
            kept.move_to_end(name)
        while len(kept) > _KEPT:
            kept.popitem(last=False)
    return ordered


def _next_pair(left: dict[str, dict[str, Pair]], kept: Sequence[str]) -> Pair | None:
    """Return a remaining pair of two kept measurements, or of one and another one; None where there is none."""
    for i, name in enumerate(kept):
        for other in kept[i + 1 :]:
            if other in left[name]:
                return left[name][other]
    # The oldest one first: it is the next to be forgotten.
    for name in kept:
        if left[name]:
            return next(iter(left[name].values()))
    return None
