"""In which order pairs are tried: so that consecutive ones share measurements, which then are prepared once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence

Pair = tuple[str, str]

#: So many times its file takes a measurement that is ready for pairs: surface, textures, maps of the refinement.
_BYTES_PER_FILE_BYTE = 4
#: Most pairs of a block: what a killed worker loses, and what others wait for at the end.
MAX_BLOCK = 16
#: Blocks per worker at least, so that all end at about the same time.
_BLOCKS_PER_SLOT = 4


def kept_in(max_bytes: int, max_number: int, file_bytes: Sequence[int]) -> int:
    """Return how many measurements with files of these sizes a process keeps ready, the one in the making included."""
    mean = sum(file_bytes) / max(1, len(file_bytes))
    # The pattern of their sensor is kept beside them.
    return max(2, min(max_number - 1, int(max_bytes / max(1.0, _BYTES_PER_FILE_BYTE * mean))))


def blocks(
    pairs: Sequence[Pair], slots: int, kept: int, most: int = MAX_BLOCK, there: Iterable[str] = ()
) -> list[list[Pair]]:
    """Return the pairs in blocks of at most `most`, in an order that prepares measurements seldom.

    Parameters
    ----------
    pairs : sequence of (str, str)
        Different ones.
    slots : int
        How many workers there are: each is given neighbouring blocks.
    kept : int
        How many measurements a worker keeps, at least two.
    most : int
        Most pairs of a block.
    there : iterable of str
        Measurements that are kept already, those used last at the end.
    """
    recent = list(there)
    # From what is kept already, or from a rim: those kept may lie anywhere, and many fronts are longer than one.
    starts = [recent, []] if recent else [[]]
    orders = [Walk(pairs, kept, start).go(rule) for start in starts for rule in (most_pairs_first, oldest_first)]
    ordered = min(orders, key=lambda order: preparations(order, kept, recent))
    size = max(1, min(most, len(ordered) // (_BLOCKS_PER_SLOT * slots)))
    return [ordered[i : i + size] for i in range(0, len(ordered), size)]


def preparations(order: Iterable[Pair], kept: int, there: Iterable[str] = ()) -> int:
    """Return how often a process prepares a measurement that keeps so many and has those of `there` already."""
    recent, count = OrderedDict.fromkeys(there), 0
    for pair in order:
        for name in pair:
            count += name not in recent
            recent[name] = None
            recent.move_to_end(name)
            if len(recent) > kept:
                recent.popitem(last=False)
    return count


class Walk:
    """Pairs one after the other, as a process goes through them that forgets what it used longest ago.

    Whenever a measurement is prepared, its pairs with all that are kept follow, so that what is left of the pairs has
    at most one end among those kept. A rule says which measurement is next.
    """

    def __init__(self, pairs: Iterable[Pair], most_kept: int, there: Sequence[str] = ()) -> None:
        self.left: dict[str, dict[str, Pair]] = {}
        for a, b in sorted(pairs):
            self.left.setdefault(a, {})[b] = (a, b)
            self.left.setdefault(b, {})[a] = (a, b)
        self.most_kept = most_kept
        #: The one used longest ago first.
        self.kept: OrderedDict[str, None] = OrderedDict()
        #: Per measurement that is not kept how many of its pairs are with kept ones.
        self.touching: dict[str, int] = {}
        self._ordered: list[Pair] = []
        for name in there:
            if name in self.left:
                self._keep(name)

    def go(self, rule: Callable[[Walk], str]) -> list[Pair]:
        """Return all pairs in their order, by a rule for the next measurement where some touch those kept."""
        for name in list(self.kept):
            self._take_pairs_of(name)
        # Where a part of the pairs begins: at its rim, which has the fewest.
        starts = sorted(self.left, key=lambda name: (len(self.left[name]), name), reverse=True)
        while True:
            while len(self.kept) >= self.most_kept:
                self._forget()
            while starts and not self.left[starts[-1]]:
                starts.pop()
            if not starts:
                return self._ordered
            name = rule(self) if self.touching else self._far_from(self._far_from(starts[-1]))
            self._keep(name)
            self._take_pairs_of(name)

    def best(self, names: Iterable[str]) -> str:
        """Return the one with the most pairs with those kept, the fewest left beyond."""
        return min(names, key=lambda name: (-self.touching[name], len(self.left[name]), name))

    def _far_from(self, start: str) -> str:
        """Return one at the other end of what is connected: from there the front is shorter than from the middle."""
        seen, level = {start}, [start]
        while level:
            last = level
            level = sorted({other for name in level for other in self.left[name]} - seen)
            seen.update(level)
        return min(last, key=lambda name: (len(self.left[name]), name))

    def _keep(self, name: str) -> None:
        self.touching.pop(name, None)
        self.kept[name] = None
        for other in self.left[name]:
            if other not in self.kept:
                self.touching[other] = self.touching.get(other, 0) + 1

    def _forget(self) -> None:
        name, _ = self.kept.popitem(last=False)
        for other in self.left[name]:
            self.touching[other] -= 1
            if not self.touching[other]:
                del self.touching[other]

    def _take_pairs_of(self, name: str) -> None:
        mates = [other for other in self.kept if other in self.left[name]]
        # Those with nothing left first: they are the next to be forgotten.
        mates.sort(key=lambda other: len(self.left[other]) > 1)
        for other in mates:
            pair = self.left[name].pop(other)
            del self.left[other][name]
            self._ordered.append(pair)
            for end in pair:
                self.kept.move_to_end(end)


def most_pairs_first(walk: Walk) -> str:
    """Return the measurement that has the most pairs with those kept: best where few can be kept."""
    return walk.best(walk.touching)


def oldest_first(walk: Walk) -> str:
    """Return a neighbour of the measurement that would be forgotten first.

    The front moves as a whole, like a breadth-first search: where it fits into memory, each is prepared once (Cuthill
    and McKee, Reducing the bandwidth of sparse symmetric matrices, ACM 1969).
    """
    return walk.best(walk.left[next(name for name in walk.kept if walk.left[name])])
