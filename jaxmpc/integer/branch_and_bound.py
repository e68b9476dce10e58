"""Closing an integer problem by best-first branch and bound over relaxations, the last resort of `integer`.

Every node tightens its limits by what its own prices exclude (`levelset`) and by the hard rows.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools

import numpy as np

from jaxmpc.integer.feasible import UndecidedError, propagate, satisfied
from jaxmpc.integer.host_search import GROUP, Search, Steps
from jaxmpc.integer.lower_bound import LowerModel, exclude
from jaxmpc.integer.relaxer import Relaxations

HELD = 2**27  # prices of whole moves that open nodes may keep, a gigabyte
MANY, BATCH = 64, 64  # nodes from which whole batches are solved, and their size


def branch_and_bound(
    search: Search, root: Relaxations, model: LowerModel, lower, upper, root_bound: float
) -> Steps:
    """Best-first branch and bound, a batch of nodes at a time; returns the least bound still open.

    `model` is the root's, over the limits the root was solved with; `lower` and `upper` may be tighter.
    """
    c = search.constants
    counter = itertools.count()
    heap = [(root_bound, next(counter), lower, upper, model, root.x[0, c.integer], root.start(0))]
    while heap:
        if heap[0][0] >= search.cutoff:
            search.discard(heap[0][0])
            return np.inf
        if search.out_of_time() or len(heap) * heap[0][4].excess.size > HELD:
            return heap[0][0]
        children = []
        width = GROUP if search.nodes < MANY or len(lower) > MANY else BATCH
        while heap and len(children) < width - 1:
            bound, _, low, high, model, center, start = heapq.heappop(heap)
            if bound >= search.cutoff:
                search.discard(bound)
                continue
            children += [(*child, start) for child in _split(bound, low, high, model, center)]
        if not children:
            continue
        low, high = np.array([ch[1] for ch in children]), np.array([ch[2] for ch in children])
        low, high, possible = propagate(search.chains, low, high)
        bounds = np.array([ch[0] for ch in children])
        low, high, bounds = low[possible], high[possible], bounds[possible]
        starts = [child[3] for child, keep in zip(children, possible, strict=True) if keep]
        if not len(low):
            continue
        result = yield from search.relax(low, high, starts)
        search.nodes += len(low)
        leaf = (low == high).all(axis=1)
        candidates = []
        for i in range(len(low)):
            bounds[i] = max(bounds[i], float(result.bound[i]))
            if leaf[i]:
                if satisfied(search.chains, low[i : i + 1], low[i], high[i])[0]:
                    search.seen.add(low[i].tobytes())
                    search.offer(result, i)
                    search.discard(float(min(bounds[i], result.snapped[i])))
            elif bounds[i] < search.cutoff:
                search.offer(result, i)
                with contextlib.suppress(UndecidedError):
                    candidates.append(search.rounded(result.x[i, c.integer], low[i], high[i]))
        points = search.new(candidates)[:GROUP]
        if len(points):
            yield from search.evaluate(points)
        for i in map(int, np.flatnonzero(~leaf)):
            if bounds[i] >= search.cutoff:
                search.discard(float(bounds[i]))
                continue
            model = search.lower_model(result, i, low[i], high[i])
            tight_low, tight_high = exclude(model, search.cutoff)
            search.discard(max(float(bounds[i]), search.cutoff))
            tight_low, tight_high, good = propagate(search.chains, tight_low[None], tight_high[None])
            if good[0]:
                entry = (
                    float(bounds[i]),
                    next(counter),
                    tight_low[0],
                    tight_high[0],
                    model,
                    result.x[i, c.integer],
                    result.start(i),
                )
                heapq.heappush(heap, entry)
    return np.inf


def _split(bound: float, low, high, model: LowerModel, center) -> list[tuple]:
    """Two children of a node, on the move whose better side costs most by the node's own prices."""
    free = np.flatnonzero(high > low)
    if not len(free):
        return [(bound, low, high)]
    best, choice = -1.0, (free[0], low[free[0]])
    for i in free:
        values = np.arange(low[i], high[i] + 1)
        away = values - center[i]
        curve = 0.5 * away**2 / model.radius[i] if np.isfinite(model.radius[i]) else np.zeros(len(values))
        cost = model.excess[i, values - model.lower[i]] + curve
        cut = int(np.clip(np.floor(center[i] + 1e-9), low[i], high[i] - 1))
        if (
            abs(center[i] - np.round(center[i])) < 1e-6
        ):  # whole already: separate the cheapest value from the rest
            cut = int(np.clip(np.round(center[i]), low[i], high[i] - 1))
        down, up = cost[values <= cut].min(), cost[values > cut].min()
        score = min(down, up) * (1.0 + 1e-3) + 1e-3 * max(down, up)
        if score > best:
            best, choice = score, (i, cut)
    i, cut = choice
    left, right = high.copy(), low.copy()
    left[i], right[i] = cut, cut + 1
    values = np.arange(low[i], high[i] + 1)
    cost = model.value + model.excess[i, values - model.lower[i]]
    return [
        (max(bound, cost[values <= cut].min()), low, left),
        (max(bound, cost[values > cut].min()), right, high),
    ]
