"""The model of a process as a table of transfer functions: ``transfer_functions`` under ``[model]`` of a process file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import msgspec

from jaxmpc.check import is_number
from jaxmpc.errors import InputError, near
from jaxmpc.model.transfer_function import TransferFunction

LONGEST = 20_000  # samples of a response


class TransferFunctionSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One entry: the response of a CV to an MV or a measured disturbance; see `TransferFunction`."""

    cv: str
    gain: float  # [CV unit per MV or disturbance unit]
    mv: str = ""
    dv: str = ""
    time_constants: tuple[Annotated[float, msgspec.Meta(gt=0)], ...] = ()  # [s]
    dead_time: Annotated[float, msgspec.Meta(ge=0)] = 0.0  # [s]
    lead: float = 0.0  # [s]

    @property
    def of(self) -> str:
        """The MV or disturbance."""
        return self.dv or self.mv

    @property
    def function(self) -> TransferFunction:
        """From it to the CV."""
        return TransferFunction(self.gain, self.time_constants, self.dead_time, self.lead)


EXPECTED = {  # numbers that are finite
    "gain": "a finite number [CV unit per MV or disturbance unit]",
    "dead_time": "a finite number of 0 or more [s]",
    "lead": "a finite number [s]",
}


def responses_of(
    sections: Sequence[TransferFunctionSection], names: Mapping[str, Sequence[str]]
) -> tuple[TransferFunctionSection, ...]:
    """A table of transfer functions, checked.

    Args:
        names: of CVs, MVs and disturbances that the model may have: ``cv``, ``mv`` and ``dv``.

    Raises:
        InputError: with the path of the entry, for names that are not there, a pair twice, and numbers that cannot be.
    """
    seen: set[tuple[str, str]] = set()
    for i, section in enumerate(sections):
        path = f"model.transfer_functions[{i}]"
        if bool(section.mv) == bool(section.dv):
            raise InputError(f"{path}.mv", section.mv, "an MV, or in dv a measured disturbance; one of both")
        for key in ("cv", "dv" if section.dv else "mv"):
            name, known = getattr(section, key), names[key]
            if name not in known:
                expected = f"one of {', '.join(known)}" if known else "nothing: there is no [[disturbance]]"
                raise InputError(f"{path}.{key}", name, expected, near(name, known))
        for key, expected in EXPECTED.items():
            if not is_number(getattr(section, key)):
                raise InputError(f"{path}.{key}", getattr(section, key), expected)
        if section.lead and not section.time_constants:
            raise InputError(f"{path}.lead", section.lead, "0 where there is no time constant [s]")
        if (section.cv, section.of) in seen:
            raise InputError(path, f"{section.of} on {section.cv}", "each pair once")
        seen.add((section.cv, section.of))
    return tuple(sections)
