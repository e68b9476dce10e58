"""The results of a study: one Zarr (v3) store per study, read as an `xarray.Dataset` with names and units.

Layout: every trajectory variable has the axes ``controller, time`` and, where it has one, ``cv`` or ``mv``;
one controller is one Zarr chunk and the only unit that is written. A controller's data land first, its
``complete`` flag next and the record of its files, with their checksums, last: a run that is killed leaves nothing
that looks finished, and what is damaged later is computed again. The store itself appears in one rename. A store
that is damaged otherwise, or answers another question (another ``study_hash``), is set aside under its own name,
never overwritten, and what it or another study holds for an unchanged controller is taken over.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr

from jaxmpc.errors import InputError
from jaxmpc.loop.trajectory import Trajectory
from studies.store import records
from studies.store.records import DamagedError

RESULTS = "results.zarr"
FORMAT = "jaxmpc/results/1"
_UNFINISHED = ".new-results-"

# variable: (field of Trajectory, channel axis, type, value before it is computed, long name, unit)
VARIABLES: dict[str, tuple[str, str | None, str, Any, str, str]] = {
    "measurement": ("cv", "cv", "f8", np.nan, "measured CV at the start of the sample", "cv_unit"),
    "demand": ("mv_demand", "mv", "f8", np.nan, "MV demanded by the controller", "mv_unit"),
    "position": ("mv", "mv", "f8", np.nan, "MV after the actuator", "mv_unit"),
    "move": ("move", "mv", "f8", np.nan, "move of the demand", "mv_unit"),
    "bias": ("bias", "cv", "f8", np.nan, "filtered output bias v(k|k)", "cv_unit"),
    "bias_raw": ("bias_raw", "cv", "f8", np.nan, "measured minus predicted CV", "cv_unit"),
    "quality": ("quality", "cv", "i1", -1, "measurement: 0 good, 1 missing, 2 outside, 3 frozen", "1"),
    "off": ("off", "cv", "i1", -1, "CV switched off after bad measurements", "1"),
    "status": ("status", None, "i1", -1, "status of the solve", "1"),
    "fallback": ("fallback", None, "i1", -1, "MVs held because the solve gave no plan", "1"),
    "objective": ("objective", None, "f8", np.nan, "objective (6.6) of the applied plan", "1"),
    "bound": ("bound", None, "f8", np.nan, "proven lower bound of the objective", "1"),
    "gap": ("gap", None, "f8", np.nan, "relative gap between objective and bound", "1"),
    "nodes": ("nodes", None, "i4", -1, "relaxations solved in a search", "1"),
    "solve_time": ("solve_time", None, "f8", np.nan, "time of one controller step", "s"),
    "finished_by": ("finished_by", None, "i1", -1, "what proved the integer optimum", "1"),
}
PLAN = (
    "plan"  # over controller, time, block and mv; not a number in the blocks that a controller does not have
)
PER_CONTROLLER = (*VARIABLES, PLAN, "wall_time", "complete")  # one Zarr chunk for each controller
FIXED = "fixed"  # the record of the files that belong to no controller; others have the index of theirs


def check_writable(folder: str | Path, field: str = "out") -> Path:
    """Make a folder if it is missing and make sure that files can be written there.

    Raises:
        InputError: naming the folder and the reason.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            field, str(folder), f"a folder that can be written ({error.strerror or error})"
        ) from error
    return folder


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder for one run; a second run on it is refused.

    Raises:
        InputError: if another process holds it.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    with open(folder / ".lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                "out",
                str(folder),
                "a folder that no other run is writing",
                "Wait for that run, or choose another folder",
            ) from None
        yield


def results_template(
    *,
    controllers: list[str],
    labels: list[str],
    hashes: list[str],
    time: np.ndarray,
    cv_names: tuple[str, ...],
    mv_names: tuple[str, ...],
    cv_units: tuple[str, ...],
    mv_units: tuple[str, ...],
    blocks: int,
    shared: dict[str, xr.DataArray],
    provenance: dict[str, Any],
    study_hash: str,
) -> xr.Dataset:
    """The results of a study with everything in place but the trajectories.

    Args:
        controllers: names, the coordinate.
        labels: for legends, one per controller.
        hashes: content hash of each controller's inputs.
        time: ``"sample"``, start of each sample [s].
        cv_names: names of the CVs, the coordinate.
        mv_names: names of the MVs, the coordinate.
        cv_units: units of the CVs.
        mv_units: units of the MVs.
        blocks: of the controller that has most.
        shared: variables without a trajectory: setpoints, tuning, model, sweep.
        provenance: JSON-like facts, one attribute each.
        study_hash: hash of everything that the results depend on.

    Returns:
        A data set whose trajectory variables read "not computed" (NaN, -1) and whose ``complete`` is 0.
    """
    text = np.dtypes.StringDType()
    sizes = {"cv": len(cv_names), "mv": len(mv_names)}
    data = dict(shared)
    for name, (_, axis, kind, empty, long_name, unit) in VARIABLES.items():
        dims = ("controller", "time") + ((axis,) if axis else ())
        shape = (len(controllers), len(time)) + ((sizes[axis],) if axis else ())
        data[name] = xr.DataArray(
            np.full(shape, empty, dtype=kind), dims=dims, attrs={"long_name": long_name, "units": unit}
        )
    n = len(controllers)
    data[PLAN] = xr.DataArray(
        np.full((n, len(time), blocks, len(mv_names)), np.nan),
        dims=("controller", "time", "block", "mv"),
        attrs={"long_name": "move planned at this time for every sample of a block", "units": "mv_unit"},
    )
    data["wall_time"] = xr.DataArray(
        np.full(n, np.nan), dims="controller", attrs={"long_name": "time of the whole run", "units": "s"}
    )
    data["complete"] = xr.DataArray(
        np.zeros(n, dtype="i1"),
        dims="controller",
        attrs={"long_name": "1 once every sample of the controller is stored", "units": "1"},
    )
    coords = {
        "controller": ("controller", np.array(controllers, dtype=text), {"long_name": "controller"}),
        "label": ("controller", np.array(labels, dtype=text), {"long_name": "controller and actuator"}),
        "content_hash": (
            "controller",
            np.array(hashes, dtype=text),
            {"long_name": "SHA-256 of the inputs of the run"},
        ),
        "time": ("time", np.asarray(time, dtype=float), {"long_name": "time", "units": "s"}),
        "cv": ("cv", np.array(cv_names, dtype=text), {"long_name": "controlled variable"}),
        "mv": ("mv", np.array(mv_names, dtype=text), {"long_name": "manipulated variable"}),
        "cv_unit": ("cv", np.array(cv_units, dtype=text), {"long_name": "unit of the CV"}),
        "mv_unit": ("mv", np.array(mv_units, dtype=text), {"long_name": "unit of the MV"}),
    }
    attrs = {"format": FORMAT, "study_hash": study_hash}
    attrs |= {key: v if isinstance(v, (str, float)) else json.dumps(v) for key, v in provenance.items()}
    return xr.Dataset(data, coords, attrs)


class ResultStore:
    """One study's store while it is being written; see the module for what is written when."""

    def __init__(self, path: Path, controllers: list[str], say: Callable[[str], None]):
        """Use `begin`."""
        self.path, self.controllers, self._say = path, controllers, say

    @classmethod
    def begin(
        cls,
        folder: Path,
        controllers: list[str],
        study_hash: str,
        make_template: Callable[[], xr.Dataset],
        say: Callable[[str], None] = print,
        others: Sequence[Path] = (),
    ) -> ResultStore:
        """Open the store of a study, or make it.

        Args:
            folder: of the study; locked by the caller.
            controllers: their names, in the order of the store.
            study_hash: hash of everything that the results depend on.
            make_template: gives the study's `results_template`; called only if there is no such store yet.
            say: receives a line when an older store is set aside, its results are taken over, or results are damaged.
            others: stores of other studies, for a new store to take equal runs from.
        """
        path = folder / RESULTS
        for remains in folder.glob(f"{_UNFINISHED}*"):  # of a run that was killed while it made its store
            shutil.rmtree(remains, ignore_errors=True)
        store = cls(path, controllers, say)
        recorded = (path / _record(FIXED)).exists()  # a store of an older version has no record
        damage = _damage(path, FIXED) if recorded else ""
        known = None if damage else _study_hash(path)
        if recorded and known == study_hash:
            return store
        template = make_template()
        if path.exists():
            kept = _set_aside(path, known)
            damaged = known in (None, study_hash)
            why = f"damaged ({damage or 'unreadable'})" if damaged else "of another definition or code"
            say(f"The results in {path} are {why}; they are kept as {kept.name}.")
        _write_new(path, template)
        store._take_over(template, [other for other in others if other != path], say)
        return store

    def complete(self, controller: str) -> bool:
        """Whether every sample of the controller is stored and undamaged; damage is named."""
        i = self.controllers.index(controller)
        damage = _damage(self.path, i)
        if damage and (self.path / _record(i)).exists():
            self._say(f"{controller}: the results are damaged and are computed again ({damage}).")
        return not damage

    def write(self, controller: str, trajectory: Trajectory, wall_time: float) -> None:
        """Store a finished run: data first, `complete` last.

        Args:
            controller: its name.
            trajectory: of the length of the study.
            wall_time: of the run [s].
        """
        data = {}
        for name, (field, axis, kind, *_) in VARIABLES.items():
            values = np.asarray(getattr(trajectory, field)).astype(kind)[None]
            data[name] = (("controller", "time") + ((axis,) if axis else ()), values)
        if trajectory.plan is not None:
            data[PLAN] = (("controller", "time", "block", "mv"), self._padded(trajectory.plan[None]))
        data["wall_time"] = (("controller",), np.array([wall_time]))
        self._write_region(controller, xr.Dataset(data))

    def _padded(self, plan: np.ndarray) -> np.ndarray:
        """Plans ``"controller time block mv"`` with the blocks of this store."""
        with xr.open_zarr(self.path, consolidated=False, chunks=None) as data:
            blocks = data.sizes["block"]
        plan = plan[:, :, :blocks]  # what was cut off is padding of another store
        missing = blocks - plan.shape[2]
        return np.pad(plan, ((0, 0), (0, 0), (0, missing), (0, 0)), constant_values=np.nan)

    def _write_region(self, controller: str, data: xr.Dataset) -> None:
        i = self.controllers.index(controller)
        region = {"controller": slice(i, i + 1)}
        (self.path / _record(i)).unlink(missing_ok=True)  # an old record never stands beside new data
        data.to_zarr(self.path, region=region, consolidated=False)
        done = xr.Dataset({"complete": (("controller",), np.ones(1, dtype="i1"))})
        done.to_zarr(self.path, region=region, consolidated=False)
        _write_record(self.path, i)

    def _take_over(self, template: xr.Dataset, others: list[Path], say: Callable[[str], None]) -> None:
        """Copy controllers that an earlier store of this folder, or another study, holds with equal content hash."""
        wanted = dict(zip(self.controllers, template.content_hash.values.tolist(), strict=True))
        own = sorted(self.path.parent.glob("results-*.zarr"))
        for older in [*own, *others]:
            name_of = older.name if older in own else f"{older.parent.name}/{older.name}"
            if not wanted:
                return
            try:
                if (older / _record(FIXED)).exists() and (damage := _damage(older, FIXED)):
                    raise ValueError(damage)
                with open_results(older) as data:
                    hashes = data.content_hash.values.tolist()
                    for name, value in list(wanted.items()):
                        if value in hashes and undamaged(older, [hashes.index(value)]):
                            row = data.isel(controller=[hashes.index(value)])
                            fields = {key: row[key].variable for key in [*VARIABLES, "wall_time"]}
                            fields[PLAN] = xr.Variable(row[PLAN].dims, self._padded(row[PLAN].values))
                            self._write_region(name, xr.Dataset(fields).load())
                            del wanted[name]
                            say(f"{name}: taken over from {name_of}.")
            except (InputError, KeyError, ValueError, OSError) as error:
                if older in own:
                    say(f"{name_of} cannot be read, nothing is taken over from it ({error}).")


def consolidate(store: str | Path) -> None:
    """Repeat the metadata of all arrays in that of the root, where `xarray.open_zarr` looks for them.

    They are written once, before the first result, and no result changes them.
    """
    with warnings.catch_warnings():  # that other readers may not know of it, which then read the arrays' own
        warnings.filterwarnings("ignore", "Consolidated metadata", UserWarning)
        zarr.consolidate_metadata(str(store), zarr_format=3)


def open_results(path: str | Path) -> xr.Dataset:
    """Open the results of a study, read lazily.

    Args:
        path: the folder of a study, or its ``.zarr`` store.

    Returns:
        A data set with the coordinates controller, time [s], cv and mv; JSON facts on where the numbers come
        from in its attributes (`provenance` decodes one). Rows of controllers with ``complete`` 0 are empty.

    Raises:
        InputError: if there are no results or they cannot be read.
    """
    path = Path(path)
    store = path if path.suffix == ".zarr" else path / RESULTS
    if not store.exists():
        raise InputError("results", str(path), f"a study folder with {RESULTS}", "Run the study first")
    try:
        data = xr.open_zarr(store, consolidated=False, chunks=None, zarr_format=3)
        # Plain strings select and print better than the stored type.
        plain = {
            n: (v.dims, v.values.astype(object), v.attrs)
            for n, v in data.variables.items()
            if v.dtype.kind in "OT"
        }
        data = data.assign_coords({name: plain[name] for name in plain if name in data.coords})
        data = data.assign({name: plain[name] for name in plain if name not in data.coords})
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            "results", str(store), f"a readable store ({error})", "Remove it and run the study again"
        ) from error
    if data.attrs.get("format") != FORMAT:
        raise InputError("results.format", data.attrs.get("format"), FORMAT)
    return data


def provenance(data: xr.Dataset, key: str) -> Any:
    """A JSON fact from the attributes of a result, decoded; `None` if it is not there."""
    value = data.attrs.get(key)
    try:
        return json.loads(value) if isinstance(value, str) else value
    except json.JSONDecodeError:
        return value


def undamaged(path: Path, controllers: Iterable[int]) -> bool:
    """Whether controllers of a store are finished and the files of the store are what was written.

    Args:
        path: of the store.
        controllers: their indices.
    """
    return not any(_damage(path, of) for of in (FIXED, *controllers))


def _record(of: int | str) -> str:
    """Path of a record in the store: where Zarr looks for no array."""
    return f"complete/files.{of}.json"


def _owner(name: str) -> str:
    """Which record a file of the store belongs to."""
    array, _, rest = name.partition("/c/")
    return rest.partition("/")[0] if rest and array in PER_CONTROLLER else FIXED


def _write_record(path: Path, of: int | str) -> None:
    names = (file.relative_to(path).as_posix() for file in sorted(path.rglob("*")) if file.is_file())
    files = {
        name: records.mark((path / name).read_bytes())
        for name in names
        if _owner(name) == str(of) and not name.startswith("complete/files.")
    }
    records.write_checked(path / _record(of), {"format": records.FORMAT, "files": files})


def _damage(path: Path, of: int | str) -> str:
    """What is wrong with the files of a controller, or with those that belong to none; empty if nothing is."""
    try:
        record = records.read_checked(path / _record(of))
    except DamagedError as error:
        return f"{_record(of)} {error}"
    if record is None:
        return f"{_record(of)} is missing"
    wrong = records.changed(path, record["files"], deep=True)
    return ", ".join(f"{name} {why}" for name, why in list(wrong.items())[:3])


def _study_hash(path: Path) -> str | None:
    try:
        with open_results(path) as data:
            return data.attrs.get("study_hash")
    except InputError:
        return None


def _set_aside(path: Path, study_hash: str | None) -> Path:
    """Rename a store so that it keeps its content under a name that says which study it is."""
    stem = f"results-{(study_hash or 'unreadable')[:10]}"
    target = path.with_name(f"{stem}.zarr")
    count = 1
    while target.exists():
        count += 1
        target = path.with_name(f"{stem}-{count}.zarr")
    os.rename(path, target)
    return target


def _write_new(path: Path, template: xr.Dataset) -> None:
    """Write the store beside its place and rename it, so that it is there whole or not at all."""
    encoding = {}
    for name in PER_CONTROLLER:
        encoding[name] = {"chunks": (1, *template[name].shape[1:])}
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=_UNFINISHED))
    try:
        template.to_zarr(temporary / RESULTS, zarr_format=3, consolidated=False, encoding=encoding)
        consolidate(temporary / RESULTS)
        _write_record(temporary / RESULTS, FIXED)
        os.rename(temporary / RESULTS, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
