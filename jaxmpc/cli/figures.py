"""``jaxmpc figures``: the figures of the thesis from stored results."""

from __future__ import annotations

from pathlib import Path

from jaxmpc.cli.options import EXIT_OPTIMAL, EXITS, PLANTS, Options, choice, command, option, switch
from jaxmpc.files import check_folder


@command(
    "figures",
    option("ids", "ID", "numbers of figures (3 to 39) or names, or all", str, nargs="*"),
    option("--out", "DIR", "where figures go", Path("figures-out")),
    option("--results", "DIR", "where the results of studies are", Path("results")),
    switch("--quick", "of the shortened studies"),
    choice("--plant", PLANTS, "drive the FMU or its JAX twin"),
    epilog="Without an ID the figures are listed. All that were drawn are on one HTML page, DIR/index.html. "
    + EXITS,
)
def draw(options: Options) -> int:
    """Draw the figures of the thesis from stored results, running the studies that are missing."""
    from figures.registry import FIGURES

    if not options.ids:
        for id, entry in FIGURES.items():
            print(f"{id:>8}  {entry.title}  ({entry.study or 'no study'})")
        return EXIT_OPTIMAL
    check_folder("--out", options.out)
    from figures.produce import produce, write_gallery

    asked = {"results": options.results, "out": options.out, "quick": options.quick, "plant": options.plant}
    for path in produce(options.ids, **asked):
        print(path)
    print(f"All on one page: {write_gallery(options.ids, **asked)}")
    return EXIT_OPTIMAL
