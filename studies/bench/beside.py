"""Our solver and others on the same problems: who is asked what, and the rows that come of it."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from studies.bench import forms
from studies.bench.context import Context
from studies.bench.judge import Judge, repeated
from studies.bench.peers import Peer, PeerAnswer, piqp
from studies.bench.rows import RIGHT, Row, timed

Plan = np.ndarray | None


class Heard(NamedTuple):
    """How one of our ways or a peer did."""

    at: np.ndarray  # positions of the problems that it was given
    seconds: np.ndarray  # "problem", of its own work
    answers: list[PeerAnswer]  # of a peer, one per problem


@dataclasses.dataclass
class Contest:
    """The problems of one table of solvers, with everybody's times and answers."""

    context: Context
    name: str  # of the problems, which the rows begin with
    cases: Sequence[dict]  # contents of case files
    peers: tuple[Peer, ...] = ()  # that are asked too; ratios are to the first
    tolerance: float = 0.0  # that they are asked for
    # applied to their plans before these are judged, so that tolerances do not count
    polish: Callable[[dict, Plan], Plan] = lambda case, plan: plan
    in_time: bool = (
        False  # whether a problem that a peer did not finish in time is not solved, whatever it had by then
    )
    optima: Sequence[float | None] = ()  # of the problems where they are certified

    def __post_init__(self):
        self.judge = Judge(self.cases, self.optima)
        self._heard: dict[str, Heard] = {}
        self._without: dict[str, Row] = {}

    def enter(self, who: str, seconds: np.ndarray, plans: Sequence[Plan], at=None, answers=()) -> None:
        """Take in how one of our ways did on all problems, or a peer on those at some positions."""
        at = np.arange(len(seconds)) if at is None else at
        self._heard[who] = Heard(at, seconds, list(answers))
        self.judge.hear(who, plans, at)

    def ask_peers(self) -> None:
        """Let every peer that is there solve its share of the problems: evenly spread, a few for a slow one."""
        for peer in self.peers:
            name = f"{self.name}: {peer.name}"
            most = min(len(self.cases), round(peer.limit * self.context.size.peer_share))
            why = peer.missing()
            if why is not None:
                self._without[peer.name] = Row(name=name, status="missing", note=why)
            elif not most:
                note = "too slow for this size of run"
                self._without[peer.name] = Row(name=name, status="not measured", note=note)
            else:
                self.context.say(name)
                try:
                    self._ask(peer, np.unique(np.linspace(0, len(self.cases) - 1, most).astype(int)))
                except Exception as error:  # a licence that is too small shows only when it is used
                    note = " ".join(str(error).split())
                    self._without[peer.name] = Row(name=name, status="failed", note=note)

    def _ask(self, peer: Peer, at: np.ndarray) -> None:
        cases = [self.cases[i] for i in at]
        seconds, answers, plans = ask(peer, self.context, cases, self.tolerance)
        plans = [self.polish(case, plan) for case, plan in zip(cases, plans, strict=True)]
        self.enter(peer.name, seconds, plans, at, answers)

    def row(self, way: str, label: str, **more: Any) -> Row:
        """The row of one of our ways; further fields as for `timed`."""
        seconds, found = self._heard[way].seconds, self._ratio(way)
        return timed(f"{self.name}: {label}", seconds, self.judge.errors(way), **found, **more)

    def _ratio(self, who: str) -> dict[str, Any]:
        """How many times as fast as the first peer, by the medians of the problems that both were given."""
        known = self._heard.get(self.peers[0].name) if self.peers else None
        if known is None:
            return {}
        own = self._heard[who]
        _, ours, theirs = np.intersect1d(own.at, known.at, return_indices=True)
        return {
            "ratio": float(np.median(known.seconds[theirs]) / np.median(own.seconds[ours]))
            if len(ours)
            else None,
            "ratio_to": self.peers[0].name,
            "ratio_is_lower_bound": self.in_time and any(one.status == "limit" for one in known.answers),
        }

    def solved(self) -> dict[str, list[float]]:
        """Seconds ``"problem"`` of everybody who was given all problems; infinite without a right solution."""
        whole = {who: heard for who, heard in self._heard.items() if len(heard.at) == len(self.cases)}
        right = lambda who: self._errors(who) <= RIGHT  # noqa: E731
        return {who: np.where(right(who), heard.seconds, np.inf).tolist() for who, heard in whole.items()}

    def _errors(self, who: str) -> np.ndarray:
        """Error of every plan; NaN for none, and where `in_time` counts for one that a peer did not prove."""
        errors, answers = self.judge.errors(who), self._heard[who].answers
        proven = [answer.status == "optimal" for answer in answers] if self.in_time and answers else True
        return np.where(proven, errors, np.nan)

    def peer_rows(self) -> Iterator[Row]:
        """A row per peer, of those that could not be asked too."""
        for peer in self.peers:
            yield self._without.get(peer.name) or self._peer_row(peer)

    def _peer_row(self, peer: Peer) -> Row:
        name, seconds, errors = (
            f"{self.name}: {peer.name}",
            self._heard[peer.name].seconds,
            self._errors(peer.name),
        )
        if not self.in_time:
            return timed(name, seconds, errors, note=peer.timed, **self._ratio(peer.name))
        row = timed(name, seconds, errors)
        row.counts = row.worst_error is None or row.worst_error <= RIGHT
        row.note = f"{peer.timed}; stopped after {min(peer.hopeless, self.context.size.cut_off):g} s"
        return row


def ask(
    peer: Peer, context: Context, cases: Iterable[dict], tolerance: float
) -> tuple[np.ndarray, list[PeerAnswer], list[Plan]]:
    """Seconds ``"problem"`` of a peer on some cases, its answers, and its plans ``"block mv"`` [MV unit] or None."""
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


def polished(case: dict, plan: Plan) -> Plan:
    """A peer's plan with its integer moves made whole and the others solved again, so that tolerances do not count."""
    if plan is None:
        return None
    form = forms.lifted(case)
    whole = np.round(plan[:, form.integer] / form.units[form.integer]).ravel()
    form.low[form.integers] = form.high[form.integers] = whole
    answer = piqp(1e-10, 10.0)(form)
    if answer.z is None:
        return plan
    moves = form.moves(answer.z)
    moves[:, form.integer] = whole.reshape(len(moves), -1) * form.units[form.integer]
    return moves


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
