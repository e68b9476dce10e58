"""``jaxmpc plan``: one controller step from a file."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

from jaxmpc.cli import options as cli
from jaxmpc.cli.options import Options, choice, option
from jaxmpc.files import check_target, json_by_field, write_atomically

FINISHES = ("auto", "enumeration", "highs", "branch-and-bound")


@cli.command(
    "plan",
    option("case", "CASE.json", "the case file", Path),
    option("--out", "PLAN.json", "where to write (default: standard output)", Path),
    choice("--finish", FINISHES, "how integer moves are decided; each way alone is exact"),
    epilog="Exit status: 0 optimal, 2 bad input (nothing is written), 3 infeasible, 4 time limit reached "
    "with a feasible plan, 1 anything else, such as a plan that is not proven for another reason.",
)
def plan(options: Options) -> int:
    """Solve one controller step from a case file (JSON, engineering units)."""
    if options.out is not None:
        check_target("--out", options.out, [options.case])
    from jaxmpc.controller.case import load_case, plan_to_dict

    case = load_case(options.case)
    from jaxmpc.controller.plan import solve_plan
    from jaxmpc.programs.progress import shown

    given = {field.name: getattr(case, field.name) for field in dataclasses.fields(case)}
    with shown():
        body = plan_to_dict(solve_plan(**given, finish=options.finish))
    text = json_by_field(body, allow_nan=False)
    status, objective = body["status"], body["objective"]
    if options.out is None:
        print(text, end="", flush=True)
    else:
        write_atomically(options.out, text)
    reason = f" ({body['reason']})" if "reason" in body else ""
    if reason or options.out is not None:
        where = "" if options.out is None else f": {options.out}"
        said = f"jaxmpc: {status}{reason}, objective {objective}, gap {body['gap']}{where}"
        print(said, file=sys.stderr)
    limit = cli.EXIT_OTHER if objective is None else cli.EXIT_LIMIT  # None: it came before any feasible plan
    known = {"optimal": cli.EXIT_OPTIMAL, "infeasible": cli.EXIT_INFEASIBLE, "limit": limit}
    return known.get(status, cli.EXIT_OTHER)
