"""A model-exchange FMU in time: CVode integrates its states, and its time, state and step events are handled.

`identify.fmu_worker` steps it with this as it steps one for co-simulation: inputs hold from one communication point to the
next. A change of inputs is an event, as the standard wants it for discrete ones and parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from fmpy.sundials import (
    NV_DATA_S,
    CVodeReInit,
    CVodeSetMaxNumSteps,
    CVodeSolver,
    CVodeSVtolerances,
    SUNContext_PushErrHandler,
)
from fmpy.sundials.libraries import sundials_core

TOLERANCE = 1e-9  # relative; small steps of an input change large states by little
ABSOLUTE = 1e-12  # of the size of a state: its nominal value, or what it has reached if that is less
MAX_STEPS = 1_000_000  # of the solver between two points; the time limit of a call ends it before
FEW_STEPS = 20_000  # likewise, while tolerances follow small states: some of them may be rounding
RESIZED = 10.0  # factor of a tolerance from which on another is worth it to begin anew
CLOSE, ROUNDING = 1e-9, 1e-14  # of the largest step, of a time: two times that are one


class _Solver(CVodeSolver):
    """CVode that tells a failure of the FMU inside its callbacks, which ctypes would only print."""

    failure: Exception | None = None

    def __init__(self, **options: Any):
        super().__init__(**options)
        self.absolute = self.npabstol.copy()  # of nominal values
        sundials_core.SUNContext_ClearErrHandlers(self.sunctx)  # what it prints is in the error, too
        SUNContext_PushErrHandler(self.sunctx, self.ehfun_, None)

    def states(self, get: Callable[..., Any] | None = None) -> np.ndarray:
        """The states that the FMU has now, or their derivatives by its function for them; a view that ends with the next."""
        if not self.discrete:
            (get or self.get_x)(self.px, self.nx)
        return np.ctypeslib.as_array(self.px, (self.nx,))

    def tolerate(self, time: float, sizes: np.ndarray | None) -> None:
        """Begin anew with tolerances for states of these sizes, if they need others; without, by their nominal values."""
        absolute = self.absolute.copy()
        if sizes is not None:
            absolute = np.where(sizes > 0, np.minimum(ABSOLUTE * sizes, absolute), absolute)
            if (np.abs(np.log(absolute / self.npabstol)) < math.log(RESIZED)).all():
                return
        self.npabstol[:] = absolute
        CVodeSVtolerances(self.cvode_mem, TOLERANCE, self.abstol)
        CVodeSetMaxNumSteps(self.cvode_mem, MAX_STEPS if sizes is None else FEW_STEPS)
        CVodeReInit(self.cvode_mem, time, self.x)

    def reset(self, time: float) -> None:
        """Begin anew from the states that the FMU has now, with the same tolerances."""
        self.states()
        CVodeReInit(self.cvode_mem, time, self.x)

    def f(self, t: float, y: Any, ydot: Any, user_data: Any) -> int:
        """Derivatives; asks for a smaller step where they are no numbers."""
        try:
            super().f(t, y, ydot, user_data)
        except Exception as error:
            self.failure = error
            return -1
        rates = np.ctypeslib.as_array(NV_DATA_S(ydot), (self.nx,))
        if np.isfinite(rates).all():
            self.failure = None
            return 0
        k = int(np.flatnonzero(~np.isfinite(rates))[0])
        self.failure = ArithmeticError(f"the derivative of state {k + 1} is {rates[k]:g} at t = {t:.10g} s")
        return 1

    def g(self, t: float, y: Any, gout: Any, user_data: Any) -> int:
        """Event indicators."""
        try:
            return super().g(t, y, gout, user_data)
        except Exception as error:
            self.failure = error
            return -1


class _Held:
    """Inputs that hold while CVode steps."""

    def apply(self, time: float) -> None:
        """Nothing to do."""


class Exchange:
    """The run of a model-exchange FMU from the end of its initialisation on.

    Args:
        fmu: of FMPy, which has left its initialisation mode.
        described: FMPy's reading of its description.
        begin: time at which it begins [s].
    """

    def __init__(self, fmu: Any, described: Any, begin: float = 0.0):
        self._fmu, self._described = fmu, described
        self._fmi3 = described.fmiVersion.startswith("3")
        self._time, self._next_event = begin, math.inf
        self._sizes: np.ndarray | None = np.zeros(
            0
        )  # of the states; None where tolerances do not follow them
        self._solver: _Solver | None = None
        self._update()

    def change(self, setting: Callable[[], None]) -> None:
        """Set variables in an event."""
        self._fmu.enterEventMode()
        setting()
        self._update()

    def step(self, end: float, largest: float) -> None:
        """Go to a time [s] in solver steps of at most `largest` [s]."""
        if self._solver is None:
            self._solver = self._new_solver(largest)
        self._follow_sizes(self._solver, largest)
        close = self._close = CLOSE * largest + ROUNDING * abs(end)
        while True:
            if self._next_event <= self._time + close:
                self._event(max(self._next_event, self._time))
                continue
            if self._time >= end - close:
                self._time = max(self._time, end)  # what is left is rounding
                return
            aim = min(end, self._next_event)
            crossed = self._integrate(self._solver, aim)
            stepped, ends = False, False
            if self._described.modelExchange.needsCompletedIntegratorStep:
                stepped, ends = self._fmu.completedIntegratorStep()
            _check(ends)
            if crossed or stepped or self._time >= self._next_event:
                self._event(self._time)

    def _integrate(self, solver: _Solver, aim: float) -> bool:
        """Up to a time or the next state event; returns whether it is one."""
        before = solver.states().copy()
        try:
            crossed, _, reached = solver.step(self._time, aim)
        except Exception as error:
            if self._sizes is not None and solver.failure is None:
                self._sizes = (
                    None  # some small state was rounding: from here again, as its nominal value says
                )
                solver.states()[:] = before
                solver.set_x(solver.px, solver.nx)
                self._fmu.setTime(self._time)
                solver.tolerate(self._time, None)
                return self._integrate(solver, aim)
            if solver.failure is not None:
                raise solver.failure from None
            raise RuntimeError(f"CVode cannot integrate it after t = {self._time:.10g} s ({error})") from None
        self._time = aim if abs(reached - aim) <= self._close else reached
        self._fmu.setTime(self._time)
        return crossed

    def _follow_sizes(self, solver: _Solver, largest: float) -> None:
        """Tolerances for states that are far smaller than the nominal value that they declare, or do not declare."""
        if self._sizes is None or solver.discrete:
            return
        x = np.abs(solver.states())
        self._sizes = np.maximum(self._sizes, x) if len(self._sizes) else x
        resting = self._sizes == 0.0
        if resting.any():  # how far they will go
            rates = np.abs(solver.states(solver.get_dx))
            self._sizes[resting] = np.nan_to_num(rates[resting] * largest, posinf=0.0)
            solver.states()
        solver.tolerate(self._time, self._sizes)

    def _event(self, time: float) -> None:
        self._time = time
        self._fmu.setTime(time)
        self._fmu.enterEventMode()
        self._update()

    def _update(self) -> None:
        """Iterate the discrete states, go on in continuous time, and let the solver begin there."""
        update = self._fmu.updateDiscreteStates if self._fmi3 else self._fmu.newDiscreteStates
        again = True
        while again:
            again, ends, _, _, planned, when = update()
            _check(ends)
            self._next_event = when if planned else math.inf
        if self._next_event <= self._time:
            self._next_event = math.inf  # of an event that has just been handled
        self._fmu.enterContinuousTimeMode()
        if self._solver is not None:
            self._solver.reset(self._time)

    def _new_solver(self, largest: float) -> _Solver:
        fmu, described = self._fmu, self._described
        states = fmu.getNumberOfContinuousStates() if self._fmi3 else described.numberOfContinuousStates
        indicators = fmu.getNumberOfEventIndicators() if self._fmi3 else described.numberOfEventIndicators
        return _Solver(
            nx=states or 0,
            nz=indicators or 0,
            get_x=fmu.getContinuousStates,
            set_x=fmu.setContinuousStates,
            get_dx=fmu.getContinuousStateDerivatives if self._fmi3 else fmu.getDerivatives,
            get_z=fmu.getEventIndicators,
            get_nominals=self._scales,
            set_time=fmu.setTime,
            input=_Held(),
            startTime=self._time,
            maxStep=largest,
            relativeTolerance=TOLERANCE,
            maxNumSteps=MAX_STEPS,
        )

    def _scales(self, scales: Any, count: int) -> None:
        """Nominal values, so small that the absolute tolerance made of them is that of small states too."""
        self._fmu.getNominalsOfContinuousStates(scales, count)
        nominals = np.ctypeslib.as_array(scales, (count,))
        nominals[:] = ABSOLUTE / TOLERANCE * np.where(nominals == 0.0, 1.0, np.abs(nominals))


def _check(ends: Any) -> None:
    if ends:
        raise RuntimeError("it asks for the end of the simulation")
