"""The process that stored results are of, from what is stored with them; its files need not be there any more."""

from __future__ import annotations

from typing import Any

import xarray as xr

from jaxmpc.files import from_strict_json
from jaxmpc.process.file import DEFAULT_PROCESS, load_process, process_of
from jaxmpc.process.process import Process
from studies.store.reading import provenance


def process_in(data: xr.Dataset) -> Process:
    """The process of the results of a comparison or a sweep."""
    body: Any = provenance(data, "process")
    return (
        process_of(from_strict_json(body), files=False)
        if isinstance(body, dict)
        else load_process(DEFAULT_PROCESS)
    )
