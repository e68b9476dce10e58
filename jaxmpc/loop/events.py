"""What changes in a controller while a loop runs: tuning fields, CVs and MVs that are switched off and on (thesis 7.2.4).

Nothing is compiled for it: programs see weights and limits as arrays. `staged` checks all events before a run starts and
makes of them the stages that compiled and host loops go through. `loop.simulate` is the only caller.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxmpc.check import among
from jaxmpc.controller.batch import Batch
from jaxmpc.controller.core import without
from jaxmpc.errors import InputError
from jaxmpc.loop.interventions import checked_sample
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning, by_name, make_tuning


@dataclasses.dataclass(frozen=True)
class Event:
    """What changes in a controller at some time, and stays so until a later event changes it again.

    Attributes:
        time: the first sample at or after it is the first that is decided with the changes [s].
        tuning: new values by field of `Tuning`. Those of a mapping by name, such as ``{"deadzone": {"level": 2.0}}``, leave
            the other CVs or MVs as they are; a vector or a number is for all of them. None takes a limit away.
        cv_off: names of CVs that have neither weights nor limits from now on.
        cv_on: names of CVs that get back what the tuning says.
        mv_off: names of MVs that are held from now on, as in manual.
        mv_on: names of MVs that the controller moves again.
    """

    time: float
    tuning: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    cv_off: Sequence[str] = ()
    cv_on: Sequence[str] = ()
    mv_off: Sequence[str] = ()
    mv_on: Sequence[str] = ()


class Stage(NamedTuple):
    """What holds for one controller from a sample on."""

    first: int  # sample
    tuning: Tuning
    manual: Bool[np.ndarray, " mv"]  # MVs that are held


def stages_of(
    structure: Structure, tuning: Tuning, events: Sequence[Event], samples: int, path: str = "events"
) -> list[Stage]:
    """The stages of a run of so many samples, the first from its start.

    Raises:
        InputError: naming the event and the field, for times outside the run or before the event before, unknown names, and
            tunings that do not hold together.
    """
    fields, off = by_name(structure, tuning), {"cv": set(), "mv": set()}
    names = {"cv": structure.cv_names, "mv": structure.mv_names}
    flags = lambda kind: np.array([name in off[kind] for name in names[kind]])  # noqa: E731
    stages, now = [Stage(0, tuning, flags("mv"))], tuning
    for i, event in enumerate(events):
        at = f"{path}[{i}]"
        if not isinstance(event, Event):
            raise InputError(at, type(event).__name__, "an Event")
        first = checked_sample(f"{at}.time", event.time, structure, samples)
        if first < stages[-1].first:
            raise InputError(f"{at}.time", event.time, "a time not before that of the event before [s]")
        if not isinstance(event.tuning, Mapping):
            raise InputError(f"{at}.tuning", event.tuning, "a mapping from field to its new values")
        for field, new in event.tuning.items():
            part = isinstance(new, Mapping) and isinstance(fields.get(field), dict)
            fields[field] = {**fields[field], **new} if part else new
        if event.tuning:
            tuning = make_tuning(structure, path=f"{at}.tuning", **fields)
            fields = by_name(structure, tuning)
        for kind, known in names.items():
            goes, comes = (
                _names(f"{at}.{kind}_{way}", getattr(event, f"{kind}_{way}"), known) for way in ("off", "on")
            )
            if goes & comes:
                raise InputError(
                    f"{at}.{kind}_on", sorted(goes & comes)[0], f"a {kind.upper()} that is not in {kind}_off"
                )
            off[kind] = (off[kind] | goes) - comes
        if (
            event.tuning or event.cv_off or event.cv_on
        ):  # where it does not change, nothing is made of it again
            now = without(tuning, flags("cv")) if off["cv"] else tuning
        stage = Stage(first, now, flags("mv"))
        stages = [*(s for s in stages if s.first < first), stage]
    return stages


def _names(path: str, given: Any, known: tuple[str, ...]) -> set[str]:
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise InputError(path, given, f"a list of names among {', '.join(known)}")
    for name in given:
        among(path, name, known, "names among")
    return set(given)


def staged(
    controllers: Any, events: Sequence[Any], count: int, samples: int
) -> tuple[Any, list[list[Stage]]]:
    """Controllers that are ready for events, and their stages, one list per controller.

    Args:
        controllers: a `Batch`, or what steps like one; with a single one and events per lane, it becomes one per lane.
        events: for all lanes, or one list per lane.
        count: number of lanes.

    Raises:
        InputError: as `stages_of`.
    """
    own = has_lanes(events)
    if own and isinstance(controllers, Batch) and controllers.count == 1:
        controllers = controllers.repeated(count)
    known, stages = {}, []
    for k, tuning in enumerate(controllers.scenarios.tunings):
        given, path = (events[k], f"events[{k}]") if own else (events, "events")
        key = id(tuning), id(given)
        if key not in known:
            known[key] = stages_of(controllers.structure, tuning, given, samples, path)
        stages.append(known[key])
    later = [stage.tuning for each in known.values() for stage in each]
    ready = controllers.scenarios.ready_for(later, own=own)
    return controllers.of(ready.with_tunings([each[0].tuning for each in stages])), stages


def has_lanes(events: Sequence[Any]) -> bool:
    """Whether there is one list of events per lane."""
    return any(isinstance(entry, (list, tuple)) for entry in events)


class Course:
    """Controllers that go through their stages.

    Args:
        controllers: in their first stages.
        stages: of every lane; none where there are no events.

    Attributes:
        controllers: as they are now.
        manual: ``"lane mv"``, MVs that are held now.
    """

    def __init__(self, controllers: Any, stages: Sequence[Sequence[Stage]]):
        self.controllers, self._coming = controllers, _together(stages)
        self.manual = np.zeros((controllers.count, controllers.structure.mv_count), dtype=bool)
        self._tunings: list[Tuning] = []
        self.enter(0)

    @property
    def next(self) -> float:
        """The sample at which a stage of any lane begins; infinite where none does any more."""
        return self._coming[0][0] if self._coming else np.inf

    def enter(self, sample: int) -> bool:
        """Go on as the stages say that begin at this sample; whether the controllers are others then."""
        if sample != self.next:
            return False
        now = self._coming.pop(0)[1]
        tunings, before = [stage.tuning for stage in now], self._tunings
        self._tunings, self.manual = tunings, np.array([stage.manual for stage in now])
        if not before or all(a is b for a, b in zip(tunings, before, strict=True)):
            return False
        self.controllers = self.controllers.of(self.controllers.scenarios.with_tunings(tunings))
        return True


def _together(lanes: Sequence[Sequence[Stage]]) -> list[tuple[int, list[Stage]]]:
    """Where the stage of any of these lanes begins, and the stage that each is then in."""
    firsts = sorted({stage.first for stages in lanes for stage in stages})
    at = lambda stages, first: [stage for stage in stages if stage.first <= first][-1]  # noqa: E731
    return [(first, [at(stages, first) for stages in lanes]) for first in firsts]
