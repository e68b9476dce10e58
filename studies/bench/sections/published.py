"""Published data, whose truth nobody knows: half of them makes a model, which foresees the other half from the inputs alone.

The files are no part of this project: they are downloaded where their authors have put them, kept in the cache, and told by
their numbers; ``--data FOLDER`` names a folder that has them already.
"""

from __future__ import annotations

import gzip
import hashlib
import time
import tomllib
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from identify.logged.regression import predicted
from jaxmpc.errors import InputError
from jaxmpc.files import write_atomically
from jaxmpc.programs.cache import cache_folder
from studies.bench.context import Context
from studies.bench.rows import Row, timed

PATIENCE = 20.0  # s for a download
LARGEST = 10 * 2**20  # bytes of one
SETS = Path(__file__).parents[1] / "published.toml"
Method = Callable[[Float[np.ndarray, " sample"], Float[np.ndarray, "sample input"], int], np.ndarray]


class Published(NamedTuple):
    """A data set, as ``published.toml`` has it; the file may be packed with gzip."""

    name: str
    url: str
    digest: str
    inputs: tuple[int, int]
    outputs: tuple[int, int]
    lags: int


def published(context: Context, methods: dict[str, Method | None]) -> Iterator[Row]:
    """Rows ``identification, DATA: METHOD`` with the mean fit of all CVs; a method that is None is not installed."""
    for data in (Published(**one) for one in tomllib.loads(SETS.read_text())["set"]):
        context.say(f"identification, {data.name}")
        try:
            numbers = load(data, context.data)
        except (OSError, ValueError, InputError) as error:
            why = " ".join(str(error).split())
            yield Row(
                name=f"identification, {data.name}", status="missing", note=f"{why}; --data FOLDER has it"
            )
            continue
        u, half = numbers[:, slice(*data.inputs)], len(numbers) // 2
        outputs = numbers[:, slice(*data.outputs)].T

        def judged(found: list[np.ndarray], data=data, u=u, outputs=outputs, half=half):
            fits = [foreseen(steps, y, u, half) for steps, y in zip(found, outputs, strict=True)]
            note = (
                f"{np.mean(fits):.1f} % of the second half is foreseen from the inputs"
                f"{f', mean of {len(fits)} CVs ({min(fits):.0f} to {max(fits):.0f} %)' if len(fits) > 1 else ''}; "
                f"{half} samples, N {data.lags}"
            )
            return [np.nan] * len(fits), note

        yield from compared(data.name, methods, [(y[:half], u[:half]) for y in outputs], data.lags, judged)


def compared(
    data: str,
    methods: Mapping[str, Method | None],
    logs: Sequence[tuple[Float[np.ndarray, " sample"], Float[np.ndarray, "sample input"]]],
    lags: int,
    judged: Callable[[list[np.ndarray]], tuple[list[float], str]],
) -> Iterator[Row]:
    """A row per method, which makes step responses of every log; `judged` gives their errors and a note."""
    for name, method in methods.items():
        row = f"identification, {data}: {name}"
        if method is None:
            yield Row(name=row, status="missing", note="pip install 'jaxmpc[bench]'")
            continue
        times, found = [], []
        for y, u in logs:
            begin = time.perf_counter()
            found.append(method(y, u, lags))
            times.append(time.perf_counter() - begin)
        errors, note = judged(found)
        yield timed(row, times, errors, solved=None, counts=True, note=note)


def foreseen(
    steps: Float[np.ndarray, "input n"],
    y: Float[np.ndarray, " sample"],
    u: Float[np.ndarray, "sample input"],
    half: int,
) -> float:
    """Fit of the samples from `half` on [%]: 100 (1 - |y - p| / |y - mean of y|), p of step responses and an offset."""
    p = predicted(np.diff(steps, prepend=0.0, axis=1), u - u[:1])[half:]
    y = y[half:] - y[half:].mean()
    return 100 * (1 - float(np.linalg.norm(y - p + p.mean()) / np.linalg.norm(y)))


def load(data: Published, folder: Path | None) -> Float[np.ndarray, "sample column"]:
    """The numbers of a data set, from a folder, from the cache, or from where it is published.

    Raises:
        OSError: if it cannot be had.
        InputError: if its numbers are others than the published ones.
    """
    name = data.url.rpartition("/")[2]
    path = (folder or cache_folder("bench")) / name
    unpacked = path.with_suffix("") if path.suffix == ".gz" else path
    if folder is None and not path.exists():
        with urllib.request.urlopen(data.url, timeout=PATIENCE) as reply:
            content = reply.read(LARGEST)
        values(data, content)
        write_atomically(path, content)
    return values(data, (unpacked if unpacked.exists() else path).read_bytes())


def values(data: Published, content: bytes) -> Float[np.ndarray, "sample column"]:
    """The numbers of a file, whatever parts them.

    Raises:
        InputError: if they are not the published ones.
    """
    text = (gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content).decode("ascii", "replace")
    rows = [line.replace(",", " ").replace(";", " ").split() for line in text.splitlines()]
    numbers = [[float(entry) for entry in row] for row in rows if row and not row[0][0].isalpha()]
    found = np.array(numbers, dtype="<f8")
    digest = hashlib.sha256(found.tobytes()).hexdigest()
    if digest != data.digest:
        raise InputError(data.name, f"numbers with the SHA-256 {digest[:12]}...", f"those of {data.url}")
    return found
