"""Named structures and tunings: the thesis's table 1 and the variants it is compared with.

A preset is plain data by name (what a study file would say); `structure` and `tuning` turn it into the
checked types of `jaxmpc`. The weights of table 1 are used as printed, in engineering units, except the choke
move weight. The thesis applies 1000 to the *scaled* integer move, where one unit is a step of 2 %; that is
250 per (%)^2, and a fair comparison charges every controller the same, so ``thesis`` uses 250 for all.
"""

from __future__ import annotations

import copy
from typing import Any, Literal

from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning, make_tuning
from jaxmpc.process.well.equations import CV_NAMES, CV_UNITS, MV_NAMES, MV_UNITS
from studies.definition.refusing import require

CHOKE, LIFT = MV_NAMES
GAS, OIL = CV_NAMES

SAMPLING_INTERVAL = 10.0  # s
CHOKE_STEP = 2.0  # %, one move of the step choke
CHOKE_MOVE_WEIGHT = 250.0  # 1/(%)^2: 1000 per (2 % step)^2

Fields = dict[str, Any]

_THESIS: Fields = {
    "cv_weight": {GAS: 1e-4, OIL: 0.1},
    "move_weight": {CHOKE: CHOKE_MOVE_WEIGHT, LIFT: 0.2},
    "soft_quadratic": {GAS: 1e-4, OIL: 0.1},
    "soft_linear": {GAS: 1e-4, OIL: 0.1},
    "deadzone": {GAS: 1000.0, OIL: 5.0},
    "cv_low": {GAS: 0.0, OIL: 0.0},
    "cv_high": {GAS: 20_000.0, OIL: 400.0},
    "slack_weight": {GAS: 1000.0, OIL: 1000.0},
    "mv_low": {CHOKE: 0.0, LIFT: 0.0},
    "mv_high": {CHOKE: 100.0, LIFT: 10_000.0},
    "move_low": {CHOKE: -CHOKE_STEP, LIFT: -200.0},
    "move_high": {CHOKE: CHOKE_STEP, LIFT: 200.0},
    "mean_move_limit": {CHOKE: 0.55, LIFT: None},
    "bias_cutoff": 1 / 20,
    # what no sensor of this well measures, noise and the restart of a full tubing (95,000 m3/h of gas) included
    "measurement_low": {GAS: -5000.0, OIL: -100.0},
    "measurement_high": {GAS: 200_000.0, OIL: 2000.0},
}


_PLAIN: Fields = _THESIS | {name: {GAS: 0.0, OIL: 0.0} for name in ("soft_quadratic", "soft_linear")}

TUNINGS: dict[str, Fields] = {
    # Table 1, choke moves charged 250 per (%)^2 for every controller.
    "thesis": _THESIS,
    # Table 1 with its 1000 taken per (%)^2, as the thesis's continuous controllers did.
    "thesis-literal": _THESIS | {"move_weight": {CHOKE: 1000.0, LIFT: 0.2}},
    # A quarter of the weight (1000 / 16): shows what the well does when the choke moves too readily.
    "thesis-light": _THESIS | {"move_weight": {CHOKE: 62.5, LIFT: 0.2}},
    # Without Soft MPC, as hard everywhere as the soft controller is far outside its deadzone (figure 13).
    "no-soft": _PLAIN | {"cv_weight": {GAS: 2e-4, OIL: 0.2}},
    # Without Soft MPC, the extra penalty simply left out.
    "no-soft-plain": _PLAIN,
}


def structure(blocking: Literal["moves", "inputs", "none"] = "moves", *, integer: bool = False) -> Structure:
    """Structure of the thesis: Hp = 250, Hu = 200, dt = 10 s, the 16 blocks of (6.3).

    Args:
        blocking: meaning of a block, or ``none`` for 200 single moves.
        integer: whether the choke moves in steps of 2 %.
    """
    known = blocking in ("moves", "inputs", "none")
    require(known, "structure.blocking", blocking, "'moves', 'inputs' or 'none'")
    shape: dict[str, Any] = {"blocks": ()} if blocking == "none" else {"blocking": blocking}
    return Structure(
        cv_names=CV_NAMES,
        mv_names=MV_NAMES,
        dt=SAMPLING_INTERVAL,
        integer_step=(CHOKE_STEP, None) if integer else (),
        cv_units=CV_UNITS,
        mv_units=MV_UNITS,
        **shape,
    )


def tuning_fields(preset: str = "thesis", changes: Fields | None = None) -> Fields:
    """A preset by name, with some fields replaced; unknown names are refused by `make_tuning`.

    Raises:
        InputError: for an unknown preset.
    """
    require(preset in TUNINGS, "tuning", preset, f"one of the presets {', '.join(TUNINGS)}")
    return {**copy.deepcopy(TUNINGS[preset]), **(changes or {})}


def tuning(structure: Structure, preset: str = "thesis", changes: Fields | None = None) -> Tuning:
    """Tuning preset for a structure; an integer choke gets the oscillation rows (6.16).

    Args:
        structure: gives names, sizes, and which MVs are integer.
        preset: a key of `TUNINGS`.
        changes: fields of `Tuning` that replace those of the preset.
    """
    fields = tuning_fields(preset, changes)
    fields.setdefault("oscillation_rows", {structure.mv_names[i]: True for i in structure.integer_mvs})
    return make_tuning(structure, **fields)
