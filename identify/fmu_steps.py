"""Identification of any FMU by step tests: every input alone, up and down, in full and half size, from a settled point.

A response is the difference of a stepped run and one without the step, at the same times: what the FMU does by itself, a
rest of settling or noise that repeats after a reset, is in both. The model is the mean of up and down; the other tests judge
it (`identify.fmu_verdicts`). Noise that does not repeat is averaged over runs. ``jaxmpc identify FILE.fmu`` calls it.
"""

from __future__ import annotations

import contextlib
import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from identify.fmu import FmuPlant, fmu_digest
from identify.fmu_description import BITS, REALS, TOLD, FmuDescription, Value
from identify.fmu_inputs import WAYS, Moved, actuator_of, error_of, further, moved, repeats, scatter
from identify.fmu_process import TIME_LIMIT, FmuProcess
from identify.fmu_verdicts import NOTHING, Tests, advice_of, back_share, grid_of, judged, movement_of
from identify.names import legal_names
from identify.step_test import SETTLE_SAMPLES
from jaxmpc.check import is_count, is_number
from jaxmpc.errors import InputError, PlantError
from jaxmpc.model.identification import Identification, Record
from jaxmpc.model.step_response import StepResponseModel, make_model

LONGEST = 64  # times as long as a response an FMU may take to settle
STILL = 1e-6  # of all that it has moved: it has settled
GROWING = (
    8.0  # times steeper from one stretch to the next, twice as long one, and ever more: an FMU that runs away
)
REPEATED = 1e-9  # of the largest value: two runs are the same

Told = Callable[[str], None]


def identify_fmu(
    path: str | Path,
    mvs: Mapping[str, tuple[Value | None, float | None]],
    cvs: Sequence[str],
    dt: float,
    samples: int = 250,
    *,
    dvs: Mapping[str, tuple[Value | None, float | None]] | None = None,
    start: Mapping[str, Value] | None = None,
    settle: float | None = None,
    time_limit: float = TIME_LIMIT,
    told: Told | None = None,
) -> Identification:
    """Identify a step-response model of an FMU, and judge it.

    Args:
        path: of the FMU, of FMI 2.0 or 3.0, for co-simulation or model exchange.
        mvs: by the names of its variables, where they stand (their start values if None) and the size of their steps (the
            least that makes sense if None) [their unit].
        cvs: names of its variables.
        dt: sampling interval [s].
        samples: N, the number of coefficients.
        dvs: as `mvs`, of measured disturbances.
        start: start values and parameters by name.
        settle: simulated at the working point before the steps [s]; by default until it stands still.
        time_limit: for one call of the FMU [s].
        told: called with a sentence on what is being done.

    Returns:
        Model, verdicts, and the tests as records; those of half size, which the model has not seen, as left out.

    Raises:
        InputError: for a file, variable, value or step that cannot be, before anything is simulated.
        PlantError: if the FMU fails.
    """
    tests = StepTests(path, mvs, cvs, dt, samples, dvs or {}, start or {}, settle, time_limit, told)
    return tests.identification()


class StepTests:
    """The tests of one working point; arguments as of `identify_fmu`, and `ways`, those that are made."""

    def __init__(
        self, path, mvs, cvs, dt, samples, dvs=(), start=(), settle=None, time_limit=TIME_LIMIT,
        told=None, ways=tuple(WAYS),
    ):  # fmt: skip
        if not is_count(samples) or samples < 2:
            raise InputError("--samples", samples, "a whole number of 2 or more")
        if not is_number(dt) or dt <= 0:
            raise InputError("--dt", dt, "a positive sampling interval [s]")
        if settle is not None and not (is_number(settle) and settle >= 0):
            raise InputError("--settle", settle, "a number of seconds, 0 or more")
        for option, given in (("--mv", mvs), ("--cv", cvs)):
            if not given:
                raise InputError(option, "nothing", "one or more variables, which jaxmpc fmu info lists")
        self.path = Path(path)
        self.dt, self.samples, self.given_settle, self._told = float(dt), samples, settle, told
        self.notes: list[str] = []
        self.start, self.ways = dict(start or {}), ways
        given = {**mvs, **dict(dvs or {})}
        twice = set(mvs) & set(dvs or ())
        if twice:
            raise InputError("--dv", min(twice), "a variable that is no MV")
        with FmuProcess(path, time_limit) as fmu:
            self.description: FmuDescription = fmu.description
        if self.description.flaws:
            flaws = " ".join(self.description.flaws[:TOLD])
            self.notes.append(
                f"the description of the FMU breaks its standard, which does no harm here: {flaws}"
            )
        channels = legal_names((*given, *cvs))
        self.renamed = {c: name for name, c in channels.items() if c != name}
        self.inputs: list[Moved] = []
        for name, (value, step) in given.items():
            option = "--mv" if name in mvs else "--dv"
            value = self.start.get(name) if value is None else value
            one, notes = moved(self.description, option, channels[name], name, value, step, self.ways)
            self.inputs.append(one)
            self.notes += notes
        self.count, self.cvs = len(mvs), [channels[name] for name in cvs]
        self.cv_variables = [self.description.variable("--cv", name) for name in cvs]
        self.block = max(samples, SETTLE_SAMPLES)
        self.plant_of = lambda settle: FmuPlant(
            path,
            [one.channel for one in self.inputs],
            self.cvs,
            dt=self.dt,
            variables=self.renamed,
            start=self.start,
            working_point={one.channel: one.variable.nearest(one.rest) for one in self.inputs},
            settle=settle,
            stop_time=(settle + LONGEST * self.block * dt) + (2 * samples + 1) * dt,
            time_limit=time_limit,
            description=self.description,
        )
        self.rest = np.array([one.rest for one in self.inputs])
        self.anew, self.begin = (
            False,
            np.full(len(cvs), np.nan),
        )  # new processes for runs; CVs that all begin with
        substep = self.plant_of(0.0).substep  # checked before anything is simulated
        own = self.description.experiment["step"]
        if own and "CoSimulation" in self.description.kinds and substep > 1.5 * own:
            self.notes.append(
                f"its default experiment has steps of {own:g} s, far more than 1000 in {dt:g} s: they are of {substep:g} s"
            )

    def tell(self, what: str) -> None:
        """Say what is being done."""
        if self._told is not None:
            self._told(what)

    # -------------------------------------------------------------------------------------------------------- the runs

    def identification(self) -> Identification:
        """Make all tests."""
        settle = self.given_settle if self.given_settle is not None else self._settled()
        with self.plant_of(settle) as plant:
            return self._identified(plant, settle)

    def _settled(self) -> float:
        """How long the FMU takes until it stands still at the working point [s]."""
        with self.plant_of(0.0) as plant:
            first = plant.init().cv
            record, length, slopes = [first], self.block, []
            movement = still = np.zeros(len(self.cvs))
            while len(record) < LONGEST * self.block:
                self.tell(f"settling, {len(record) * self.dt:g} s simulated")
                cv = plant.hold(self.rest, length)
                record.extend(cv)
                run = np.array(record)
                movement, noise = movement_of(cv[-self.block :])
                still = STILL * np.ptp(run, axis=0) + REPEATED * np.abs(run).max(axis=0) + 8 * noise
                busy = movement > still
                if not busy.any():
                    return (len(record) - 1) * self.dt if np.ptp(run, axis=0).any() else 0.0
                slopes.append(movement_of(cv)[0] / length)
                if len(slopes) > 2:
                    first, before, last = (slope[busy] for slope in slopes[-3:])
                    if ((last > GROWING * before) & (last * first > before**2)).any():
                        away = self.cvs[np.flatnonzero(busy)[int(np.argmax(last))]]
                        self.notes.append(
                            f"{away} runs away at the working point: the steps are made from the start of the FMU on"
                        )
                        return 0.0
                    if np.allclose(last, before, rtol=0.01, atol=0.0):
                        break  # it will go on like this
                length = len(record) - 1
        for i in np.flatnonzero(movement > still):
            slope = 2 * movement[i] / (self.block * self.dt)
            self.notes.append(
                f"{self.cvs[i]} does not come to rest at the working point: it still moves by about {slope:.3g} per second "
                f"after {(len(record) - 1) * self.dt:g} s. The responses are differences to a run without steps"
            )
        return (len(record) - 1) * self.dt

    def _runs(
        self, plant: FmuPlant, mv: np.ndarray, count: int, back: bool = False
    ) -> Float[np.ndarray, "run sample cv"]:
        """CVs of runs with held MVs from the working point on, the first before they act, and as long `back` there."""
        runs = []
        for _ in range(count):
            if self.anew:
                plant.close()
            begin = plant.init().cv
            if not self.anew and (np.abs(begin - self.begin) > REPEATED * np.abs(self.begin)).any():
                self.anew = True
                self.notes.append(
                    "the reset of the FMU does not reset it: every run is made in a new process"
                )
                plant.close()
                begin = plant.init().cv
            held = [mv, self.rest] if back else [mv]
            runs.append(np.vstack([begin, *(plant.hold(one, self.samples) for one in held)]))
        return np.array(runs)

    def _identified(self, plant: FmuPlant, settle: float) -> Identification:
        self.tell("runs without steps")
        longer = self._there_and_back(plant, self.rest)
        still = np.concatenate([longer[None, : self.samples + 1], self._runs(plant, self.rest, 1)])
        scale = np.abs(still).max(axis=(0, 1))
        apart = np.abs(still[0] - still[1]).max(axis=0)
        noise = np.where(apart > REPEATED * scale, (still[0] - still[1]).std(axis=0) / math.sqrt(2), 0.0)
        self.begin = np.where(noise == 0, still[0, 0], np.nan)
        shape = (len(self.cvs), len(self.inputs), self.samples)
        responses = {way: np.full(shape, np.nan) for way in self.ways}
        errors, changes, left = (np.zeros(shape[:2]) for _ in range(3))
        means: dict[tuple[int, str], np.ndarray] = {}
        most = 2
        for j, one in enumerate(self.inputs):
            self.tell(f"steps of {one.channel}, input {j + 1} of {len(self.inputs)}")
            way, back = self._back(plant, j, one, longer)
            left[:, j] = back_share(back, noise)
            first = {way: back[: self.samples + 1] + longer[: self.samples + 1]}
            counts, noise = self._tested(plant, j, one, still.mean(axis=0), noise, settle, means, first)
            most = max(most, counts)
            errors[:, j] = noise / math.sqrt(counts) * error_of(one)
        if noise.any() and most > 2:
            self.tell("runs without steps, to average the noise")
            still = np.concatenate([still, self._runs(plant, self.rest, most - 2)])
        base = still.mean(axis=0) if noise.any() else still[0]
        for (j, way), mean in means.items():
            one = self.inputs[j]
            change = mean - base
            responses[way][:, j] = (change[1:] / (one.targets[way] - one.rest)).T
            changes[:, j] = np.maximum(changes[:, j], np.abs(change).max(axis=0))
        with np.errstate(all="ignore"):
            pairs = np.stack([responses["up"], responses["down"]])
            mean = np.where(np.isnan(pairs).any(axis=0), np.nansum(pairs, axis=0), pairs.mean(axis=0))
        point = base.mean(axis=0) if noise.any() else base[0]
        facts = self._facts(settle)
        model = self._model(mean, point, facts)
        scale = np.maximum(scale, changes.max(axis=1))
        more = self._further(settle, (changes <= NOTHING * scale[:, None]) & (noise == 0)[:, None], base)
        whole = [v.type in REALS for v in self.cv_variables]
        levels = np.stack([base, *means.values()])
        grid = np.array([0.0 if noise[i] else grid_of(levels[:, :, i]) for i in range(len(self.cvs))])
        seen = Tests(model, responses, errors, changes, scale, more, base, whole, left, grid)
        verdicts, notes = judged(seen)
        notes = (*self.notes, *self._noise_notes(noise, most), *notes)
        silent = np.array([row.verdict == "none" for row in verdicts]).reshape(mean.shape[:2])
        mean[silent] = 0.0
        told = {"settled": not any("not settled" in row.says for row in verdicts)}
        told |= {"verdicts": [list(row) for row in verdicts], "notes": list(notes)}
        model = self._model(mean, point, facts | told)
        return Identification(
            model,
            verdicts,
            notes,
            advice_of(verdicts, model),
            bands=np.repeat(1.96 * errors[:, :, None], self.samples, axis=2) if noise.any() else None,
            alternatives={way: found for way, found in responses.items() if np.isfinite(found).any()},
            records=self._records(means, base, mean),
        )

    def _back(self, plant, j, one: Moved, longer: np.ndarray) -> tuple[str, Float[np.ndarray, "sample cv"]]:
        """The smallest test of an input and its way back: by how much the CVs differ from those without it."""
        way = min(one.targets, key=lambda way: (abs(one.targets[way] - one.rest), list(WAYS).index(way)))
        return way, self._there_and_back(plant, self._stepped(j, one.targets[way])) - longer

    def _there_and_back(self, plant: FmuPlant, mv: np.ndarray) -> Float[np.ndarray, "sample cv"]:
        """CVs of a run with held MVs and as long without; NaN where an FMU does not go that far."""
        try:
            return self._runs(plant, mv, 1, back=True)[0]
        except PlantError:
            plant.close()
            run = self._runs(plant, mv, 1)[0]
            return np.pad(run, ((0, self.samples), (0, 0)), constant_values=np.nan)

    def _tested(self, plant, j, one, base, noise, settle, means, first) -> tuple[int, np.ndarray]:
        """Make the tests of an input; returns how many runs each mean is of, and the noise as the runs show it."""
        runs, count = {}, 1
        for way, target in one.targets.items():
            given = way in first
            runs[way] = first[way][None] if given else self._runs(plant, self._stepped(j, target), 1)
        for _ in range(3 if noise.any() else 0):
            total = {way: own.mean(axis=0) for way, own in runs.items()}
            need = repeats(one, total, base, noise, self.samples, settle / self.dt)
            if need <= 1.1 * count:
                break
            count = need
            for way, target in one.targets.items():
                more = (count if "half" not in way else max(count // 4, 1)) - len(runs[way])
                if more > 0:
                    self.tell(f"{one.channel} {way}: {more} more runs, to average the noise")
                    runs[way] = np.concatenate([runs[way], self._runs(plant, self._stepped(j, target), more)])
            noise = np.where(noise > 0, np.maximum(noise, scatter(runs)), 0.0)
        means.update({(j, way): own.mean(axis=0) for way, own in runs.items()})
        return count, noise

    def _further(self, settle: float, silent: np.ndarray, base: np.ndarray) -> Float[np.ndarray, "cv input"]:
        """Largest change of CVs that an input has not moved, after a much larger step of it; 0 where there is none."""
        found = np.zeros(silent.shape)
        for j in np.flatnonzero(silent.any(axis=0)).tolist():
            target = further(self.inputs[j])
            if target is None:
                continue
            self.tell(f"a larger step of {self.inputs[j].channel}, which has not moved a CV")
            # so far away it may fail, in a process of its own: the tests are what they are
            with contextlib.suppress(PlantError), self.plant_of(settle) as plant:
                change = np.abs(self._runs(plant, self._stepped(j, target), 1)[0] - base).max(axis=0)
                found[:, j] = np.where(silent[:, j], change, 0.0)
        return found

    def _stepped(self, j: int, target: float) -> np.ndarray:
        mv = self.rest.copy()
        mv[j] = target
        return mv

    # ------------------------------------------------------------------------------------------------- what is returned

    def _facts(self, settle: float) -> dict[str, Any]:
        """What the model is identified from."""
        path = self.path.resolve()
        own = {one.variable.name: one.rest for one in self.inputs[self.count :]}
        return {
            "plant": "fmu",
            "plant_hash": self.plant_of(settle).facts()["hash"],
            "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "fmu": str(path),
            "fmu_hash": fmu_digest(path),
            "variables": self.renamed,
            "start": self.start | {n: self.description.variable("", n).nearest(x) for n, x in own.items()},
            "settle": settle,
            "stops": self.description.experiment["stop"] is not None,
            "steps": {
                one.channel: {way: to - one.rest for way, to in one.targets.items()} for one in self.inputs
            },
            "ranges": {
                one.channel: list(one.variable.limits)
                for one in self.inputs[: self.count]
                if all(map(math.isfinite, one.variable.limits))
                and (one.variable.type not in BITS or None not in (one.variable.low, one.variable.high))
            },
            "actuators": {
                one.channel: how for one in self.inputs[: self.count] if (how := actuator_of(one.variable))
            },
        }

    def _model(self, mean: np.ndarray, settled: np.ndarray, facts: dict[str, Any]) -> StepResponseModel:
        units = [one.variable.unit or "1" for one in self.inputs]
        names = [one.channel for one in self.inputs]
        point = dict(zip((*names, *self.cvs), (*self.rest.tolist(), *settled.tolist()), strict=True))
        count = self.count
        return make_model(
            mean[:, :count], self.dt, self.cvs, names[:count],
            cv_units=[v.unit or "1" for v in self.cv_variables], mv_units=units[:count],
            working_point=point, provenance=facts,
            dv_coefficients=mean[:, count:], dv_names=names[count:], dv_units=units[count:],
        )  # fmt: skip

    def _records(self, means: Mapping[tuple[int, str], np.ndarray], base, mean) -> tuple[Record, ...]:
        out, times = [], np.arange(-1, self.samples + 1) * self.dt  # from the sample before the step on
        for (j, way), run in means.items():
            one = self.inputs[j]
            change = one.targets[way] - one.rest
            inputs = np.vstack(
                [self.rest, np.tile(self._stepped(j, one.targets[way]), (self.samples + 1, 1))]
            )
            measured = np.vstack([base[0], run])
            predicted = np.vstack([base[0], base]) + np.pad(change * mean[:, j].T, ((2, 0), (0, 0)))
            unit = f" {one.variable.unit}" if one.variable.unit else ""
            used = np.full(self.samples + 2, "half" not in way)
            out.append(Record(f"{one.channel} {change:+.4g}{unit}", times, inputs, measured, predicted, used))
        return tuple(out)

    def _noise_notes(self, noise: np.ndarray, most: int) -> list[str]:
        return [
            f"{cv} has noise that differs from run to run, of standard deviation {sigma:.3g}: means of up to {most} runs"
            for cv, sigma in zip(self.cvs, noise.tolist(), strict=True)
            if sigma
        ] + [
            f"{name} is called {channel} here: a process file has names of letters, digits and '_'"
            for channel, name in self.renamed.items()
        ]
