"""Closing an integer problem by branch and bound over relaxations, the last resort of `integer`.

A node limits the moves and the positions after them, and branches on a move or a position between two whole values, on a
position in a gap between two allowed ones, and on whether a block moves where a plan breaks the dwell. Which
one is decided by reliability branching (Achterberg, Koch and Martin 2005): what earlier branchings gained tells, and
where too few were seen the children of the best candidates are relaxed. The search follows the better child until
it is pruned, then goes on from the least bound. Every node tightens its limits by what its own prices exclude
(`lower_bound`) and by the hard rows, and is closed by a list where its level set is small.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools

import numpy as np

from jaxmpc.integer.chain import Chain, whole
from jaxmpc.integer.cuts import Cuts
from jaxmpc.integer.feasible import MoveLimits, around, needed, position_limits, satisfied, within
from jaxmpc.integer.host_search import Search, Steps
from jaxmpc.integer.lower_bound import LowerModel, enumerate_below, exclude, radii
from jaxmpc.integer.relaxer import LANES, Relaxations
from jaxmpc.integer.symmetry import in_order, tighten_in_order
from jaxmpc.relaxed.newton import STEPS, WarmStart

HELD = 2**27  # numbers that open nodes may keep, a gigabyte
RELIABLE = 3  # branchings of a variable in a direction from which their gains are believed
TRIED = LANES // 2  # candidates whose children are relaxed before one is chosen
PLUNGE = 0.25  # share of the gap that a child's bound may have used up for the search to follow it
FRACTION = 1e-6  # distance from whole numbers that counts
LISTED = 4_000  # partial assignments of a list at a node
HOPED = 2.0  # logarithm of the share of combinations that a list's bounds are first hoped to leave out
SURVIVORS = 64  # of a list, up to which it is worth to solve them
KEPT = 4096  # sets of free moves whose radii are kept
ROUNDS = 3  # batches of neighbours of an incumbent that are solved
NEWEST = 64  # cuts that candidates are held against


@dataclasses.dataclass(frozen=True)
class _Node:
    """A relaxed node; `limits` may be tighter than those of its `model`, whose center are its moves."""

    bound: float
    limits: MoveLimits
    model: LowerModel
    start: WarmStart

    @property
    def size(self) -> int:
        """Numbers it keeps."""
        prices = (
            self.start.row_price,
            self.start.limit_price,
            self.start.envelope_price,
            self.start.hard_price,
        )
        return self.model.excess.size + sum(np.size(part) for part in prices)


@dataclasses.dataclass
class _Child:
    """What may become a node; `solved` are its relaxation's batch and lane, None where no whole moves are left."""

    limits: MoveLimits
    start: WarmStart
    solved: tuple[Relaxations, int] | None = None


@dataclasses.dataclass(frozen=True)
class _Branching:
    """Two children: entry `row` (a move, or from `count` on a position) at most `cut`, or at least `next`, nothing being
    between them; estimates of their gains.
    """

    row: int
    cut: int
    next: int
    estimate: tuple[float, float]


def branch_and_bound(
    search: Search, root: Relaxations, model: LowerModel, cuts: Cuts, lower, upper, root_bound: float
) -> Steps:
    """Branch and bound; returns the least bound still open.

    `model` is the root's, over the limits the root was solved with; `lower` and `upper` may be tighter.
    """
    tree = _Tree(search, cuts)
    limits = MoveLimits(lower, upper, *position_limits(search.chains))
    tree.keep(_Node(root_bound, limits, model, root.start(0)))
    while True:
        least = search.still_open = tree.least
        if least >= search.cutoff:
            search.discard(least)
            return np.inf
        if tree.held > HELD:
            search.reason = "the open nodes of branch and bound take the memory that they may, a gigabyte"
            return least
        if search.out_of_time():
            return least
        yield from tree.step()


class _Tree:
    """Open nodes of one search, and what its branchings have gained so far."""

    def __init__(self, search: Search, cuts: Cuts):
        self.search, self.cuts = search, cuts
        count = len(search.constants.integer)
        self.rows = np.concatenate([np.eye(count), search.constants.reached])
        self.gains, self.seen = np.zeros((2, 2 * count)), np.zeros((2, 2 * count), dtype=int)
        self.heap: list[tuple[float, int, _Node]] = []
        self.next: _Node | None = None  # the child that is followed
        self.number = itertools.count()
        self.held = 0
        # logarithm of the estimated size up to which a list is tried
        self.list_up_to = np.log(LISTED) + HOPED
        self.polished = np.inf  # value of the incumbent whose neighbours were solved
        self.radii_of: dict[bytes, np.ndarray] = {}

    # ---- open nodes
    @property
    def least(self) -> float:
        """The least bound of an open node."""
        followed = np.inf if self.next is None else self.next.bound
        return min(followed, self.heap[0][0] if self.heap else np.inf)

    def keep(self, node: _Node) -> None:
        """Leave a node open."""
        heapq.heappush(self.heap, (node.bound, next(self.number), node))
        self.held += node.size

    def _take(self) -> _Node | None:
        """The node to go on with, None where all that is left cannot be better than the incumbent."""
        node, self.next = self.next, None
        while node is None and self.heap:
            node = heapq.heappop(self.heap)[2]
            self.held -= node.size
        return node

    # ---- one round
    def step(self) -> Steps:
        """Branch the followed node, and as many of least bound as fill a batch; keeps their children."""
        search, plans, children = self.search, [], []
        while len(children) < LANES and (node := self._take()) is not None:
            search.check_time()
            if node.bound >= search.cutoff:
                search.discard(node.bound)
                continue
            reduced = self._reduced(node)
            if reduced is None:
                continue
            if (yield from self._listed(reduced)):
                continue
            branchings = self._branchings(reduced)
            plan = [(branching, self._children(reduced, branching)) for branching in branchings]
            plans.append((reduced, plan))
            children += [child for _, pair in plan for child in pair]
            if not np.isfinite(search.value):
                break
        yield from self._relaxed(children)
        for node, plan in plans:
            self._chosen(node, plan)
        yield from self._rounded(children)
        yield from self._improved()

    def _relaxed(self, children: list[_Child]) -> Steps:
        """Relax the children whose limits leave anything, in one batch."""
        search = self.search
        if not children:
            return
        together = MoveLimits(*map(np.array, zip(*(child.limits for child in children), strict=True)))
        together, possible = tighten_in_order(search.chains, search.orders, together)
        chosen = np.flatnonzero(possible)
        if not len(chosen):
            return
        lower, upper = together.lower[chosen], together.upper[chosen]
        rows = needed(search.chains, MoveLimits(*(values[chosen] for values in together)))
        # a node that takes more steps is nearly singular, and a batch waits for its slowest; whole moves have to be solved
        most = np.where((lower < upper).any(axis=1), STEPS, np.inf)
        result = yield from search.relax(lower, upper, [children[k].start for k in chosen], rows, most)
        search.nodes += len(chosen)
        for lane, k in enumerate(chosen):
            children[k].limits, children[k].solved = together.lane(int(k)), (result, lane)
            search.offer(result, lane)

    # ---- what a relaxed node proves
    def _radii(self, model: LowerModel) -> np.ndarray:
        """`lower_bound.radii` of moves and positions, with the moves held that the node was solved with fixed."""
        free = model.upper > model.lower
        key = free.tobytes()
        if key not in self.radii_of:
            if len(self.radii_of) > KEPT:
                self.radii_of.clear()
            held = self.search.constants.schur[np.ix_(free, free)]
            self.radii_of[key] = radii(held, self.rows[:, free]) if free.any() else np.zeros(len(self.rows))
        return np.maximum(self.radii_of[key], 1e-300)

    def _reduced(self, node: _Node) -> _Node | None:
        """The node without what its prices exclude, None if that is everything."""
        search, model = self.search, node.model
        if not np.isfinite(search.cutoff):
            return node
        count, cutoff = len(model.center), search.cutoff
        radius = self._radii(model)
        lower, upper = exclude(dataclasses.replace(model, radius=radius[:count]), cutoff)
        left = max(cutoff - model.value, 1e-300)
        room = np.sqrt(2.0 * left * radius[count:])
        position = search.constants.reached @ model.center
        low, high = position - room, position + room
        prices = model.positions
        if prices is not None:
            step = np.abs(prices.price)
            far = np.where(step > 0, left / np.where(step > 0, step, 1.0), np.inf)
            low = np.where(prices.price > 0, np.maximum(low, prices.high - far), low)
            high = np.where(prices.price < 0, np.minimum(high, prices.low + far), high)
        limits = node.limits
        low = np.maximum(limits.low, np.ceil(np.clip(low, -1e15, 1e15) - 1e-9)).astype(int)
        high = np.minimum(limits.high, np.floor(np.clip(high, -1e15, 1e15) + 1e-9)).astype(int)
        search.discard(max(node.bound, cutoff))
        tight = MoveLimits(np.maximum(limits.lower, lower), np.minimum(limits.upper, upper), low, high)
        together = MoveLimits(*(values[None] for values in tight))
        tight, good = tighten_in_order(search.chains, search.orders, together)
        return dataclasses.replace(node, limits=tight.lane(0)) if good[0] else None

    # ---- branching
    def _branchings(self, node: _Node) -> list[_Branching]:
        """The branchings whose children are to be relaxed, the most promising first."""
        limits, model = node.limits, node.model
        count = len(model.center)
        at = self.rows @ model.center
        low, high = np.concatenate([limits.lower, limits.low]), np.concatenate([limits.upper, limits.high])
        cut = np.clip(np.floor(at), low, high - 1).astype(int)
        part, following = at - cut, cut + 1
        rest = 1.0 - part
        for chain in self.search.chains:
            if chain.allowed is not None:  # a gap is left on either side
                rows = count + chain.columns
                cut[rows], following[rows] = chain.down(cut[rows]), chain.up(following[rows])
                part[rows], rest[rows] = at[rows] - cut[rows], following[rows] - at[rows]
        between = (high > low) & (part > FRACTION) & (rest > FRACTION)
        for chain in self.search.chains:
            moves, positions = chain.columns, count + chain.columns
            if chain.allowed is None:
                between[positions[0]] = False  # the first position is the first move
            if between[positions].any() and self._choices(limits, chain) <= self._room(
                limits.lower, limits.upper, chain
            ):
                between[moves[1:]] = False  # a valve's few positions decide its many moves
        radius = self._radii(model)
        clash, further = self._too_close(node, radius)
        if clash.any():  # such a block is at rest or moves
            between |= clash
            cut = np.where(clash, np.where(at > 0, 0, -1), cut)
            following = np.where(clash, cut + 1, following)
            part = np.where(clash, np.maximum(at - cut, 0.0), part)
            rest = np.where(clash, np.maximum(following - at, 0.0), rest)
        rows = np.flatnonzero(between)
        if not len(rows):
            return [self._halved(node)]
        away = np.stack([part, rest])
        gain = np.where(np.isfinite(radius), 0.5 * away**2 / radius, 0.0)
        gain = np.maximum(gain, further)
        moves = rows[rows < count]
        # the least of a side: with prices of chords the center need not be where nothing is left out
        down = np.minimum.accumulate(model.excess, axis=1)
        up = np.minimum.accumulate(model.excess[:, ::-1], axis=1)[:, ::-1]
        gain[0, moves] += down[moves, cut[moves] - model.lower[moves]]
        gain[1, moves] += up[moves, cut[moves] + 1 - model.lower[moves]]
        estimate = gain.copy()
        for kind in (slice(0, count), slice(count, None)):
            total, seen = self.gains[:, kind].sum(axis=1), self.seen[:, kind].sum(axis=1)
            mean = total / np.maximum(seen, 1)
            own = self.gains[:, kind] / np.maximum(self.seen[:, kind], 1)
            known = np.where(self.seen[:, kind] > 0, own, mean[:, None])
            estimate[:, kind] = np.maximum(estimate[:, kind], known * away[:, kind])
        score = self._score(estimate[0], estimate[1], node.bound)
        best = rows[np.argsort(-score[rows], kind="stable")[:TRIED]]
        reliable = self.seen[:, best].min(axis=0) >= RELIABLE
        tried = [row for k, row in enumerate(best) if k == 0 or not reliable[k]]
        return [
            _Branching(int(r), int(cut[r]), int(following[r]), (float(gain[0, r]), float(gain[1, r])))
            for r in tried
        ]

    def _too_close(self, node: _Node, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Entries that are moves within the dwell of others, and by what the others at rest raise the bound of a side."""
        limits, center = node.limits, node.model.center
        count = len(center)
        clash, gain = np.zeros(2 * count, dtype=bool), np.zeros((2, 2 * count))
        for chain in self.search.chains:
            if chain.apart is None:
                continue
            moves = chain.columns
            at, low, high = center[moves], limits.lower[moves], limits.upper[moves]
            moving = np.where(
                at > FRACTION, (low <= 0) & (high > 0), (at < -FRACTION) & (low < 0) & (high >= 0)
            )
            clash[moves] = moving & (moving @ chain.apart)
            own = np.where(np.isfinite(radius[moves]), 0.5 * at**2 / radius[moves], 0.0)
            others = np.where(chain.apart & moving, own, 0.0).max(axis=1)
            gain[np.where(at > 0, 1, 0), moves] = np.where(clash[moves], others, 0.0)
        return clash, gain

    def _score(self, down, up, bound: float):
        """Of a branching by the gains of its children."""
        room = self.search.cutoff - bound
        least = 1e-6 * self.search.reference if np.isfinite(self.search.value) else 1e-12
        return np.maximum(np.minimum(down, room), least) * np.maximum(np.minimum(up, room), least)

    def _halved(self, node: _Node) -> _Branching:
        """All moves are whole, but the relaxation is not exact there: separate the dearest move's value from others."""
        limits, model = node.limits, node.model
        free = np.flatnonzero(limits.upper > limits.lower)
        passing = self._passing(node)
        if passing is not None:
            return passing
        if not len(free):
            return _Branching(0, int(limits.lower[0]), int(limits.lower[0]) + 1, (0.0, 0.0))
        place = np.clip(np.round(model.center[free]), limits.lower[free], limits.upper[free]).astype(int)
        own = model.excess[free, place - model.lower[free]]
        k = int(np.argmax(own + 1e-9 * (limits.upper - limits.lower)[free]))
        row = int(free[k])
        cut = int(min(place[k], limits.upper[row] - 1))
        return _Branching(row, cut, cut + 1, (0.0, 0.0))

    def _passing(self, node: _Node) -> _Branching | None:
        """A branching on the move or the start of a block that passes a position that is not allowed, if there is one."""
        limits, count = node.limits, len(node.model.center)
        for chain in self.search.chains:
            if chain.allowed is None or chain.counts.max() == 1:
                continue
            moves = whole(node.model.center[chain.columns])
            before = np.cumsum(moves * chain.counts) - moves * chain.counts
            for b, column in enumerate(chain.columns):
                if chain.passes(b, before[b], moves[b]):
                    continue
                if limits.lower[column] < limits.upper[column]:
                    cut = int(np.clip(moves[b], limits.lower[column], limits.upper[column] - 1))
                    return _Branching(int(column), cut, cut + 1, (0.0, 0.0))
                row = int(chain.columns[b - 1]) if b else 0
                if b and limits.low[row] < limits.high[row]:
                    cut = int(chain.down(np.clip(before[b], limits.low[row], limits.high[row] - 1)))
                    return _Branching(count + row, cut, int(chain.up(np.asarray(cut + 1))), (0.0, 0.0))
        return None

    def _children(self, node: _Node, branching: _Branching) -> tuple[_Child, _Child]:
        """The children, not relaxed yet: at most the cut, and from the next value on."""
        count = len(node.limits.lower)
        row = branching.row % count
        down, up = (_Child(MoveLimits(*map(np.copy, node.limits)), node.start) for _ in range(2))
        if branching.row < count:
            down.limits.upper[row], up.limits.lower[row] = branching.cut, branching.next
        else:
            down.limits.high[row], up.limits.low[row] = branching.cut, branching.next
        return down, up

    def _chosen(self, node: _Node, plan: list[tuple[_Branching, tuple[_Child, _Child]]]) -> None:
        """Keep the children of the best branching; the others' tell gains, and prune."""
        search = self.search
        kept, best, bound = node.limits, None, node.bound
        for branching, pair in plan:
            bounds = [self._bound(node, branching, side, child) for side, child in enumerate(pair)]
            bound = max(bound, min(bounds))
            score = float(self._score(bounds[0] - node.bound, bounds[1] - node.bound, node.bound))
            if best is None or score > best[0]:
                best = (score, pair, bounds)
            for side, other in enumerate(reversed(self._children(node, branching))):
                if bounds[side] >= search.cutoff:
                    search.discard(bounds[side])
                    kept = _both(kept, other.limits)
        assert best is not None
        if bound >= search.cutoff:
            search.discard(bound)
            return
        nodes = []
        for child, least in zip(best[1], best[2], strict=True):
            if least < search.cutoff:
                own = self._node(node, child, kept, max(bound, least))
                nodes += [] if own is None else [own]
        for own in sorted(nodes, key=lambda own: own.bound):
            least = min(self.least, own.bound)
            near = not np.isfinite(search.value) or own.bound - least <= PLUNGE * (search.cutoff - least)
            if self.next is None and near:
                self.next = own
            else:
                self.keep(own)

    def _bound(self, node: _Node, branching: _Branching, side: int, child: _Child) -> float:
        """The bound of a child, infinite where nothing of it is left; takes down what it gained."""
        search, limits = self.search, child.limits
        if child.solved is None:
            return np.inf
        result, lane = child.solved
        # NaN is not larger
        bound = max(node.model.value + branching.estimate[side], float(result.bound[lane]))
        self._learn(node, branching, side, bound)
        if (limits.lower < limits.upper).any():
            return bound
        if satisfied(search.chains, limits.lower[None], limits.lower, limits.upper)[0]:
            search.settle(limits.lower, bound, float(result.snapped[lane]))
        return np.inf

    def _node(self, parent: _Node, child: _Child, kept: MoveLimits, bound: float) -> _Node | None:
        """The node of a relaxed child within what its siblings have left; None where that is nothing."""
        assert child.solved is not None
        limits = _both(kept, child.limits)
        together = MoveLimits(*(values[None] for values in limits))
        tight, good = tighten_in_order(self.search.chains, self.search.orders, together)
        if not good[0]:
            return None
        (result, lane), model, start = child.solved, parent.model, parent.start
        # a relaxation that did not get to its end may know less than its parent's prices, which hold here, too
        if np.isfinite(result.x[lane]).all() and result.bound[lane] >= parent.model.value:
            model = self.search.lower_model(result, lane, child.limits.lower, child.limits.upper)
            model = model.priced(result.hard[lane][self.search.constants.position], child.limits)
            start = result.start(lane)
        return _Node(bound, tight.lane(0), model, start)

    def _learn(self, node: _Node, branching: _Branching, side: int, bound: float) -> None:
        """Take down what one child gained per step."""
        at = float(self.rows[branching.row] @ node.model.center)
        away = at - branching.cut if side == 0 else branching.next - at
        if away > FRACTION and np.isfinite(bound):
            self.gains[side, branching.row] += max(bound - node.bound, 0.0) / away
            self.seen[side, branching.row] += 1

    # ---- incumbents and lists
    def _rounded(self, children: list[_Child]) -> Steps:
        """Round moves and positions of relaxed lanes, and solve what may be better than the incumbent."""
        search, c = self.search, self.search.constants
        solved = [child.solved for child in children if child.solved is not None]
        if not solved:
            return
        moves = np.array([result.x[lane, c.integer] for result, lane in solved])
        moves = moves[np.isfinite(moves).all(axis=1)]
        moves = np.unique(np.concatenate([np.round(moves), self._walked(moves)]), axis=0).astype(int)
        low, high = (whole(values[c.integer]) for values in search.limits)
        points = search.new(list(moves[satisfied(search.chains, moves, low, high)]))
        yield from self._solve_best(points)

    def _walked(self, moves: np.ndarray) -> np.ndarray:
        """Moves that follow the positions of relaxed ones as closely as whole moves can."""
        result = np.zeros_like(moves)
        for chain in self.search.chains:
            wanted = np.cumsum(moves[:, chain.columns] * chain.counts, axis=1)
            result[:, chain.columns] = _followed(chain, wanted)
        return result

    def _solve_best(self, points: np.ndarray) -> Steps:
        """Solve the best of these points by the cuts, if any may be better than the incumbent; adds cuts."""
        if not len(points):
            return
        bounds = self.cuts.bounds(points, max(len(self.cuts.list) - NEWEST, 0))
        best = np.argsort(bounds, kind="stable")[:2]
        best = best[bounds[best] < self.search.cutoff]
        if len(best):
            yield from self._solve(points[best])

    def _improved(self) -> Steps:
        """Solve the points around a new incumbent that may be better, until none is."""
        search, integer = self.search, self.search.constants.integer
        low, high = (whole(values[integer]) for values in search.limits)
        while search.value < self.polished and not search.out_of_time():
            self.polished = search.value
            assert search.x is not None
            points = search.new(list(around(search.chains, whole(search.x[integer]), low, high)))
            for _ in range(ROUNDS):
                if not len(points):
                    break
                bounds = self.cuts.bounds(points, max(len(self.cuts.list) - NEWEST, 0))
                best = np.argsort(bounds, kind="stable")
                best = best[bounds[best] < search.cutoff]
                if len(best):
                    yield from self._solve(points[best[:LANES]])
                points = points[best[LANES:]]
                if search.value < self.polished:
                    break

    def _solve(self, points: np.ndarray, bounds: np.ndarray | None = None) -> Steps:
        """Solve whole moves, each for a cut and perhaps an incumbent."""
        yield from self.cuts.solve(self.search, points, bounds)
        self.search.nodes += len(points)

    def _listed(self, node: _Node) -> Steps:
        """Close a node by listing what its level set leaves; returns whether that was done."""
        search, limits, model = self.search, node.limits, node.model
        if not np.isfinite(search.value) or self._log_size(node) > self.list_up_to:
            return False
        chains = within(search.chains, limits)
        found = enumerate_below(
            model, chains, limits.lower, limits.upper, search.cutoff, LISTED, check_time=search.check_time
        )
        if found is None:
            self.list_up_to -= 1.0
            return False
        points, bounds, _ = found
        if len(points):
            keep = satisfied(chains, points, limits.lower, limits.upper)
            keep &= in_order(chains, search.orders, points)
            keep &= np.array([p.tobytes() not in search.seen for p in points], dtype=bool)
            points, bounds = points[keep], bounds[keep]
        first = max(len(self.cuts.list) - NEWEST, 0)
        while True:
            if len(points):
                bounds = np.maximum(bounds, self.cuts.bounds(points, first))
            alive = bounds < search.cutoff
            if not alive.all():
                search.discard(float(bounds[~alive].min()))
            points, bounds = points[alive], bounds[alive]
            if not len(points):
                search.discard(search.cutoff)
                self.list_up_to += 0.1
                return True
            if len(points) > SURVIVORS or search.out_of_time():
                self.list_up_to -= 0.5
                return False
            first = len(self.cuts.list)
            best = np.argsort(bounds, kind="stable")
            chosen, rest = best[:LANES], best[LANES:]
            yield from self._solve(points[chosen], bounds[chosen])
            points, bounds = points[rest], bounds[rest]

    def _log_size(self, node: _Node) -> float:
        """Logarithm of the whole moves in the node's level set, estimated by its box."""
        limits = node.limits
        by_moves = [self._room(limits.lower, limits.upper, chain) for chain in self.search.chains]
        by_positions = [self._choices(limits, chain) for chain in self.search.chains]
        return sum(map(min, by_moves, by_positions))

    def _choices(self, limits: MoveLimits, chain: Chain) -> float:
        """Logarithm of the combinations of one MV's allowed positions within limits."""
        if chain.allowed is None:
            return self._room(limits.low, limits.high, chain)
        low, high = limits.low[chain.columns], limits.high[chain.columns]
        count = np.searchsorted(chain.allowed, high, side="right") - np.searchsorted(chain.allowed, low)
        return float(np.log(np.maximum(count, 1)).sum())

    @staticmethod
    def _room(low: np.ndarray, high: np.ndarray, chain: Chain) -> float:
        """Logarithm of the combinations of one MV's moves or positions within limits."""
        return float(np.log(high[chain.columns] - low[chain.columns] + 1.0).sum())


def _followed(chain: Chain, wanted: np.ndarray) -> np.ndarray:
    """Whole moves of a chain along wanted positions ``"lane block"``: to the nearest allowed, with the rests of a dwell."""
    moves = np.zeros(wanted.shape)
    position = np.zeros(len(wanted), dtype=int)
    for b, count in enumerate(chain.counts):
        there = np.clip(wanted[:, b], -1e15, 1e15)
        if chain.allowed is not None:
            below, above = chain.down(np.floor(there)), chain.up(np.ceil(there))
            there = np.where(there - below <= above - there, below, above)
        move = np.round((there - position) / count)
        move = np.where(chain.passes(b, position, move), move, 0)
        if chain.apart is not None:
            move = np.where((moves[:, :b] != 0) @ chain.apart[b, :b], 0, move)
        moves[:, b] = move
        position = position + (move * count).astype(int)
    return moves


def _both(one: MoveLimits, other: MoveLimits) -> MoveLimits:
    """What lies within both limits."""
    return MoveLimits(
        np.maximum(one.lower, other.lower),
        np.minimum(one.upper, other.upper),
        np.maximum(one.low, other.low),
        np.minimum(one.high, other.high),
    )
