"""What every section of the benchmark is given: size of the run, recordings, peers, and where to say what it does."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

from identify.step_test import identify_step_response
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.well.plant import WellPlant
from studies.bench.instances import MODES, Mode, Recordings
from studies.bench.peers import Peer
from studies.thesis.well import WELL


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    modes: tuple[Mode, ...] = MODES  # blocking modes
    run: int | None = None  # samples of a recorded run, None for the whole reference
    relaxed: int = 130  # problems per blocking mode
    exact: int = 130
    lanes: int = 512  # distinct problems of a batch; larger batches repeat them
    batches: tuple[int, ...] = (1, 8, 64, 512, 4096)  # batch sizes; 512 has the floor
    peer_share: float = 1.0  # of the problems a slow peer is asked; one that would be asked none is left out
    cut_off: float = 15.0  # most seconds that one solve of a peer may take
    foreign: tuple[
        str, ...
    ] = ()  # processes of which the first shipped instances are solved; all of all if none
    variants: int = 256  # continuous closed loops advanced together
    variant_samples: int = 900
    together: int = 64  # mixed-integer closed loops advanced together
    together_samples: int = 1200
    together_reference: str = "thesis"
    growth: tuple[tuple[str, tuple[int, ...]], ...] = (  # sizes, of the horizon [samples]
        ("horizon", (60, 125, 250, 500)),
        ("blocks", (4, 8, 16, 32)),
        ("CVs", (1, 2, 4, 8)),
        ("MVs", (1, 2, 4, 8)),
    )
    startup_modes: tuple[Mode, ...] = MODES  # blocking modes whose first call is measured
    sweep_chunks: int = 2  # of the sweep whose overhead is measured
    sweep_samples: int = 600
    sweep_stored: int = 10_000  # scenarios of the store that is opened
    sweep_scanned: int = 1000  # chunks of the store that is resumed
    sweep_memory: tuple[int, int] = (8, 80)  # chunks of the two sweeps whose memory is compared
    identified: int = 10  # logs of each kind that models are identified from


FULL = Size()
QUICK = Size(
    run=300,
    relaxed=12,
    exact=12,
    lanes=32,
    batches=(1, 512),
    peer_share=0.12,
    cut_off=5.0,
    foreign=("woodberry", "vinante", "quadtank"),
    variant_samples=300,
    together_samples=120,
    together_reference="quick",
    growth=(("horizon", (60,)), ("blocks", (4,)), ("CVs", (4,)), ("MVs", (4,))),
    startup_modes=("moves",),
    sweep_chunks=1,
    sweep_samples=120,
    sweep_stored=640,
    sweep_scanned=50,
    sweep_memory=(2, 6),
    identified=2,
)


@dataclasses.dataclass
class Context:
    """Shared by the sections of one call."""

    size: Size  # how much is measured
    quick: bool  # whether the reference is the short one
    say: Callable[[str], None]  # receives a line of progress
    qp_peers: tuple[Peer, ...]
    miqp_peers: tuple[Peer, ...]
    data: Path | None = None  # folder with published data; they are downloaded without
    # for figures, filled by the sections
    series: dict[str, dict[str, list[float]]] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def model(self) -> StepResponseModel:
        """Identified from the JAX well."""
        return identify_step_response(WellPlant())

    @functools.cached_property
    def recordings(self) -> Recordings:
        """The closed loops that the problems come from."""
        reference = WELL.reference("quick") if self.quick else WELL.reference("thesis")
        return Recordings(self.model, reference, self.size.run, self.say)
