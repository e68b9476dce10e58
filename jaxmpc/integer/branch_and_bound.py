"""Closing an integer problem by branch and bound over relaxations, the last resort of `integer`.

A node limits the moves and the positions after them (`nodes`) and parts at one of them (`branching`). The search follows the
better child until it is pruned, then goes on from the least bound. Every node tightens its limits by what its own prices
exclude (`lower_bound`), by the hard rows and by the order of equal actuators (`symmetry`), and is closed by a list where its
level set is small.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools

import numpy as np

from jaxmpc.integer.branching import Branchings, children_of
from jaxmpc.integer.cuts import Cuts
from jaxmpc.integer.feasible import MoveLimits, needed, position_limits, satisfied, within
from jaxmpc.integer.host_search import Search, Steps
from jaxmpc.integer.incumbents import NEWEST, Incumbents
from jaxmpc.integer.lower_bound import LowerModel, enumerate_below, exclude
from jaxmpc.integer.nodes import Branching, Child, Node, both, log_size
from jaxmpc.integer.relaxer import LANES, Relaxations
from jaxmpc.integer.symmetry import in_order, tighten_in_order
from jaxmpc.relaxed.newton import STEPS

HELD = 2**27  # numbers that open nodes may keep, a gigabyte
PLUNGE = 0.25  # share of the gap that a child's bound may have used up for the search to follow it
LISTED = 4_000  # partial assignments of a list at a node
HOPED = 2.0  # logarithm of the share of combinations that a list's bounds are first hoped to leave out
SURVIVORS = 64  # of a list, up to which it is worth to solve them


def branch_and_bound(
    search: Search, root: Relaxations, model: LowerModel, cuts: Cuts, lower, upper, root_bound: float
) -> Steps:
    """Branch and bound; returns the least bound still open.

    `model` is the root's, over the limits the root was solved with; `lower` and `upper` may be tighter.
    """
    tree = _Tree(search, cuts)
    limits = MoveLimits(lower, upper, *position_limits(search.chains))
    tree.keep(Node(root_bound, limits, model, root.start(0)))
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
    """Open nodes of one search."""

    def __init__(self, search: Search, cuts: Cuts):
        self.search, self.cuts = search, cuts
        self.branchings, self.incumbents = Branchings(search), Incumbents(search, cuts)
        self.heap: list[tuple[float, int, Node]] = []
        self.next: Node | None = None  # the child that is followed
        self.number = itertools.count()
        self.held = 0
        # logarithm of the estimated size up to which a list is tried
        self.list_up_to = np.log(LISTED) + HOPED

    # ---- open nodes
    @property
    def least(self) -> float:
        """The least bound of an open node."""
        followed = np.inf if self.next is None else self.next.bound
        return min(followed, self.heap[0][0] if self.heap else np.inf)

    def keep(self, node: Node) -> None:
        """Leave a node open."""
        heapq.heappush(self.heap, (node.bound, next(self.number), node))
        self.held += node.size

    def _take(self) -> Node | None:
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
            branchings = self.branchings.of(reduced)
            plan = [(branching, children_of(reduced, branching)) for branching in branchings]
            plans.append((reduced, plan))
            children += [child for _, pair in plan for child in pair]
            if not np.isfinite(search.value):
                break
        yield from self._relaxed(children)
        for node, plan in plans:
            self._chosen(node, plan)
        yield from self.incumbents.rounded(children)
        yield from self.incumbents.improved()

    def _relaxed(self, children: list[Child]) -> Steps:
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
    def _reduced(self, node: Node) -> Node | None:
        """The node without what its prices exclude, None if that is everything."""
        search, model = self.search, node.model
        if not np.isfinite(search.cutoff):
            return node
        count, cutoff = len(model.center), search.cutoff
        radius = self.branchings.radii(model)
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

    def _chosen(self, node: Node, plan: list[tuple[Branching, tuple[Child, Child]]]) -> None:
        """Keep the children of the best branching; the others' tell gains, and prune."""
        search = self.search
        kept, best, bound = node.limits, None, node.bound
        for branching, pair in plan:
            bounds = [self._bound(node, branching, side, child) for side, child in enumerate(pair)]
            bound = max(bound, min(bounds))
            score = float(self.branchings.score(bounds[0] - node.bound, bounds[1] - node.bound, node.bound))
            if best is None or score > best[0]:
                best = (score, pair, bounds)
            for side, other in enumerate(reversed(children_of(node, branching))):
                if bounds[side] >= search.cutoff:
                    search.discard(bounds[side])
                    kept = both(kept, other.limits)
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

    def _bound(self, node: Node, branching: Branching, side: int, child: Child) -> float:
        """The bound of a child, infinite where nothing of it is left; takes down what it gained."""
        search, limits = self.search, child.limits
        if child.solved is None:
            return np.inf
        result, lane = child.solved
        # NaN is not larger
        bound = max(node.model.value + branching.estimate[side], float(result.bound[lane]))
        self.branchings.learn(node, branching, side, bound)
        if (limits.lower < limits.upper).any():
            return bound
        if satisfied(search.chains, limits.lower[None], limits.lower, limits.upper)[0]:
            search.settle(limits.lower, bound, float(result.snapped[lane]))
        return np.inf

    def _node(self, parent: Node, child: Child, kept: MoveLimits, bound: float) -> Node | None:
        """The node of a relaxed child within what its siblings have left; None where that is nothing."""
        assert child.solved is not None
        limits = both(kept, child.limits)
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
        return Node(bound, tight.lane(0), model, start)

    # ---- incumbents and lists

    def _listed(self, node: Node) -> Steps:
        """Close a node by listing what its level set leaves; returns whether that was done."""
        search, limits, model = self.search, node.limits, node.model
        if not np.isfinite(search.value) or log_size(search.chains, node.limits) > self.list_up_to:
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
            yield from self.incumbents.solve(points[chosen], bounds[chosen])
            points, bounds = points[rest], bounds[rest]
