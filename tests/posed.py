"""Relaxed problems of the library for tests: posed in one compiled call that all structures of a size share."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import numpy as np

from jaxmpc.controller.case import make_case
from jaxmpc.problem.condense import CondensedQp, condense, matrices_of
from jaxmpc.problem.instance import QpInstance, make_instance
from jaxmpc.problem.layout import Layout, Size, layout_of
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.relaxed.solve import solve_relaxed
from tests.oracles.kkt import dense_rows

solve_one = jax.jit(lambda qp, instance: solve_relaxed(qp, instance, instance.lower, instance.upper))


class Posed(NamedTuple):
    """A relaxed problem, and the dense hard rows that a judge needs."""

    layout: Layout
    size: Size
    qp: CondensedQp
    rows: np.ndarray
    instance: QpInstance


@functools.partial(jax.jit, static_argnames=("size", "envelope", "has_limits", "summed"))
def condensed(layout, size, tuning, coefficients, *, envelope=1, has_limits=True, summed=True) -> CondensedQp:
    """The constant part of a problem; coefficients up to ``size.future``."""
    matrices = matrices_of(layout, size, coefficients, summed=summed)
    return condense(layout, size, tuning, matrices, envelope=envelope, has_limits=has_limits)


instance_of = jax.jit(make_instance, static_argnames="size")


def over(values, samples: int) -> np.ndarray:
    """Values along the last axis, the last one repeated up to so many samples."""
    values = np.asarray(values)
    return values[..., np.minimum(np.arange(samples), values.shape[-1] - 1)]


def pose(
    structure: Structure,
    tuning: Tuning,
    coefficients,
    *,
    free_response,
    setpoint,
    mv_now,
    last_move=None,
    past_moves=None,
    recover: bool = False,
    size: Size | None = None,
    envelope: int = 1,
    has_limits: bool = True,
    summed: bool = True,
) -> Posed:
    """A problem of one sample; arguments as in `make_instance`, of any number of samples, in arrays of a size."""
    size = size or Size.of(structure, np.shape(coefficients)[-1])
    layout, none = layout_of(structure, size), np.zeros(size.mvs)
    past = np.zeros((size.past, size.mvs))
    if past_moves is not None:
        past[size.past - len(past_moves) :] = past_moves
    options = dict(envelope=envelope, has_limits=has_limits, summed=summed)
    qp = condensed(layout, size, tuning, over(coefficients, size.future), **options)
    instance = instance_of(
        layout,
        size,
        tuning,
        qp,
        free_response=over(np.transpose(free_response), size.future).T,
        setpoint=over(np.transpose(setpoint), size.future).T,
        mv_now=np.asarray(mv_now, dtype=float),
        last_move=none if last_move is None else np.asarray(last_move, dtype=float),
        past_moves=past,
        recover=recover,
    )
    return Posed(layout, size, qp, dense_rows(structure, size), instance)


def pose_case(body: dict, **options) -> Posed:
    """The problem of a case file's content; options as in `pose`."""
    case = make_case(body)
    step = {key: getattr(case, key) for key in ("free_response", "setpoint", "mv_now", "last_move")}
    return pose(case.structure, case.tuning, case.model.coefficients, **step, **options)
