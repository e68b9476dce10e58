"""Our solver and others on the same problems: who is asked what, and the rows that come of it."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from studies.bench.context import Context
from studies.bench.judge import Judge, ratio, repeated
from studies.bench.peers import Peer, PeerAnswer
from studies.bench.rows import RIGHT, Row, timed

Plan = np.ndarray | None


class Asked(NamedTuple):
    """What a peer answered."""

    at: np.ndarray  # positions of the problems that it was asked
    seconds: np.ndarray  # "problem", of its own work
    answers: list[PeerAnswer]  # one per problem


class Contest:
    """The problems of one table of solvers, with everybody's times and answers.

    Args:
        context: of the run.
        section: of the rows.
        name: of the problems, which the rows begin with.
        cases: contents of case files.
        peers: that are asked too; ratios are to the first.
        tolerance: that they are asked for.
        polish: applied to their plans before these are judged, so that tolerances do not count.
        in_time: whether a problem that a peer did not finish in time counts as not solved, whatever it had by then.
    """

    def __init__(
        self,
        context: Context,
        section: str,
        name: str,
        cases: Sequence[dict],
        peers: tuple[Peer, ...] = (),
        tolerance: float = 0.0,
        polish: Callable[[dict, Plan], Plan] = lambda case, plan: plan,
        in_time: bool = False,
    ):
        self.context, self.section, self.name, self.peers = context, section, name, peers
        self.tolerance, self.polish, self.in_time = tolerance, polish, in_time
        self.judge = Judge(cases)
        self._ours: dict[str, np.ndarray] = {}
        self._theirs: dict[str, Asked] = {}
        self._without: dict[str, Row] = {}

    def enter(self, way: str, seconds: np.ndarray, plans: Sequence[Plan]) -> None:
        """Take in how one of our ways did on all problems."""
        self._ours[way] = seconds
        self.judge.hear(way, plans)

    def ask_peers(self) -> None:
        """Let every peer that is there solve its share of the problems."""
        for peer in self.peers:
            name = f"{self.name}: {peer.name}"
            row = absent(peer, self.context, self.section, name)
            if row is None:
                self.context.say(name)
                try:
                    self._ask(peer)
                    continue
                except Exception as error:  # a licence that is too small shows only when it is used
                    why = " ".join(str(error).split())
                    row = Row(name=name, section=self.section, status="failed", note=why)
            self._without[peer.name] = row

    def _ask(self, peer: Peer) -> None:
        at = asked(peer, self.context, len(self.judge.cases))
        cases = [self.judge.cases[i] for i in at]
        seconds, answers, plans = ask(peer, self.context, cases, self.tolerance)
        plans = [self.polish(case, plan) for case, plan in zip(cases, plans, strict=True)]
        self.judge.hear(peer.name, plans, at)
        self._theirs[peer.name] = Asked(at, seconds, answers)

    def row(self, way: str, label: str, **more: Any) -> Row:
        """The row of one of our ways; further fields as for `timed`."""
        seconds = self._ours[way]
        name = f"{self.name}: {label}"
        found = self._ratio(np.arange(len(seconds)), seconds)
        return timed(name, self.section, seconds, self.judge.errors(way), **found, **more)

    def _ratio(self, at: np.ndarray, seconds: np.ndarray) -> dict[str, Any]:
        """How many times as fast as the first peer, on the problems that both were given."""
        known = self._theirs.get(self.peers[0].name) if self.peers else None
        if known is None:
            return {}
        times = np.full(len(self.judge.cases), np.nan)
        times[at] = seconds
        common = np.intersect1d(at, known.at)
        return {
            "ratio": ratio(times, known.seconds[np.isin(known.at, common)], common),
            "ratio_to": self.peers[0].name,
            "ratio_is_lower_bound": self.in_time and any(one.status == "limit" for one in known.answers),
        }

    def peer_rows(self) -> Iterator[Row]:
        """A row per peer, of those that could not be asked too."""
        for peer in self.peers:
            yield self._without.get(peer.name) or self._peer_row(peer)

    def _peer_row(self, peer: Peer) -> Row:
        at, seconds, answers = self._theirs[peer.name]
        name, errors = f"{self.name}: {peer.name}", self.judge.errors(peer.name)
        if not self.in_time:
            return timed(name, self.section, seconds, errors, note=peer.timed, **self._ratio(at, seconds))
        finished = np.array([answer.status == "optimal" for answer in answers])
        row = timed(name, self.section, seconds, np.where(finished, errors, np.nan))
        row.counts = row.worst_error is None or row.worst_error <= RIGHT
        row.note = f"{peer.timed}; stopped after {min(peer.hopeless, self.context.size.cut_off):g} s"
        return row


def asked(peer: Peer, context: Context, count: int) -> np.ndarray:
    """Positions of the problems that a peer is asked, evenly spread: all, a few for a slow one, or none."""
    most = min(count, round(peer.limit * context.size.peer_share))
    return np.unique(np.linspace(0, count - 1, most).astype(int))


def absent(peer: Peer, context: Context, section: str, name: str) -> Row | None:
    """The row of a peer that is not installed or left out of this run, None for one that is asked."""
    why = peer.missing()
    if why is not None:
        return Row(name=name, section=section, status="missing", note=why)
    if not len(asked(peer, context, 1_000_000)):
        return Row(name=name, section=section, status="not measured", note="too slow for this size of run")
    return None


def ask(
    peer: Peer, context: Context, cases: Iterable[dict], tolerance: float
) -> tuple[np.ndarray, list[PeerAnswer], list[Plan]]:
    """Let a peer solve problems.

    Returns:
        Seconds ``"problem"``, answers, and plans ``"block mv"`` [MV unit] or None.
    """
    solve = peer.begin(tolerance, min(peer.hopeless, context.size.cut_off))
    seconds, answers, plans = [], [], []
    for case in cases:
        form = peer.build(case)

        def measure(form=form) -> tuple[float, PeerAnswer]:
            answer = solve(form)
            return answer.seconds, answer

        with _silence():
            if peer.keeps and not answers:
                measure()  # sets up what is set up once
            time, answer = repeated(measure)
        seconds.append(time)
        answers.append(answer)
        plans.append(None if answer.z is None else form.moves(answer.z))
    return np.array(seconds), answers, plans


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Drop what solvers print past Python, whatever they were told."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(number) for number in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for number in (1, 2):
            os.dup2(nowhere, number)
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # what C still holds back
        for number, before in zip((1, 2), kept, strict=True):
            os.dup2(before, number)
            os.close(before)
        os.close(nowhere)
