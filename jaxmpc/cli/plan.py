"""``jaxmpc plan``: one controller step from a file."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from jaxmpc.cli import options as cli
from jaxmpc.cli.options import Options, choice, option
from jaxmpc.files import check_target, write_atomically

FINISHES = ("auto", "enumeration", "highs", "branch-and-bound")


@cli.command(
    "plan",
    option("case", "CASE.json", "the case file", Path),
    option("--out", "PLAN.json", "where to write (default: standard output)", Path),
    choice("--finish", FINISHES, "how integer moves are decided; each way alone is exact"),
    epilog="Exit status: 0 optimal, 2 bad input (nothing is written), 3 infeasible, 4 time limit reached "
    "with a feasible plan, 1 anything else.",
)
def plan(options: Options) -> int:
    """Solve one controller step from a case file (JSON, engineering units)."""
    if options.out is not None:
        check_target("--out", options.out, [options.case])
    from jaxmpc.controller.case import load_case, plan_to_dict

    case = load_case(options.case)
    from jaxmpc.controller.plan import solve_plan

    solved = solve_plan(
        case.model,
        case.structure,
        case.tuning,
        mv_now=case.mv_now,
        last_move=case.last_move,
        free_response=case.free_response,
        setpoint=case.setpoint,
        previous_moves=case.previous_moves,
        time_limit=case.time_limit,
        gap=case.gap,
        finish=options.finish,
    )
    body = plan_to_dict(solved)
    fields = (f" {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in body.items())
    text = "{\n" + ",\n".join(fields) + "\n}\n"  # one field per line
    status, objective = body["status"], body["objective"]
    if options.out is None:
        print(text, end="", flush=True)
    else:
        write_atomically(options.out, text)
        said = f"jaxmpc: {status}, objective {objective}, gap {body['gap']}: {options.out}"
        print(said, file=sys.stderr)
    if status == "limit" and objective is None:
        return cli.EXIT_OTHER  # the limit came before any feasible plan
    known = {"optimal": cli.EXIT_OPTIMAL, "infeasible": cli.EXIT_INFEASIBLE, "limit": cli.EXIT_LIMIT}
    return known.get(status, cli.EXIT_OTHER)
