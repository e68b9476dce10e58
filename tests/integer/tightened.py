"""Small problems with whole moves, relaxed as they are and tightened by chords, for tests."""

import itertools

import jax
import numpy as np

from jaxmpc import status
from jaxmpc.integer.feasible import MoveLimits, position_limits, satisfied, tighten
from jaxmpc.integer.host_search import Search
from jaxmpc.integer.scheduling import run
from jaxmpc.integer.tables import Constants
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from tests.integer.test_integer import answered, one, relaxer_of
from tests.posed import pose

STEPS = {"on/off": 1, "stepped": 3, "two on/off": 1}  # largest position, and move
SIZE = Size(cvs=2, mvs=2, blocks=8, horizon=32, future=32, windows=0, past=32)


class Tightened:
    """A small random problem, its relaxation and the tightened one, and all its whole plans.

    Args:
        kind: of `STEPS`.
        seed: of what is random.
        changes: tuning fields, or `response`, `free_response`, `setpoint` and `mv_now`, in place of random ones.
    """

    def __init__(self, kind: str, seed: int, **changes):
        rng = np.random.default_rng(seed)
        most = STEPS[kind]
        blocks = {"on/off": (1,) * 6, "stepped": (1, 2, 1), "two on/off": (1, 1, 1)}[kind]
        structure = Structure(
            cv_names=("a", "b"),
            mv_names=("u", "v"),
            dt=30.0,
            prediction_horizon=24,
            control_horizon=sum(blocks),
            blocks=blocks,
            integer_step=(1.0, 1.0 if kind == "two on/off" else None),
        )
        response = np.cumsum(rng.normal(size=(2, 2, 30)) * np.exp(-np.arange(30) / 3.0), axis=2)
        fields = dict(
            cv_weight=[1.0, 0.5],
            move_weight=[(0.0, 0.01, 0.3)[seed % 3], 1.0],
            mv_low=[0.0, 0.0 if kind == "two on/off" else -2.0],
            mv_high=[float(most), 1.0 if kind == "two on/off" else 2.0],
            cv_high=[2.0, 1.5],
            cv_low=[-2.0, -1.5],
            slack_weight=[5.0, 5.0],
            soft_quadratic=[0.3, 0.0],
            soft_linear=[0.2, 0.2],
            deadzone=[0.5, 0.5],
        )
        fields |= {key: value for key, value in changes.items() if key in fields}
        free = np.cumsum(rng.normal(size=(32, 2)) * 0.3, axis=0)
        self.posed = pose(
            structure,
            make_tuning(structure, **fields),
            changes.get("response", response),
            free_response=changes.get("free_response", free),
            setpoint=np.tile(changes.get("setpoint", rng.normal(size=2) * most), (32, 1)),
            mv_now=[changes.get("mv_now", float(rng.integers(0, most + 1))), 0.0],
            size=SIZE,
            envelope=3,
        )
        self.instance = jax.tree.map(np.asarray, self.posed.instance)
        self.constants = Constants(structure, SIZE, jax.tree.map(np.asarray, self.posed.qp))
        self.plain = relaxer_of(self.constants)
        self.tight = self.plain.with_chords(0)
        self.plain_root, root = (self.root_of(relaxer) for relaxer in (self.plain, self.tight))
        self.search = Search(self.constants, self.instance, root, 1e-6, None)
        own = self.constants.integer
        self.low, self.high = (np.round(limits[own]).astype(int) for limits in self.search.limits)
        points = np.array(
            list(itertools.product(*(range(a, b + 1) for a, b in zip(self.low, self.high, strict=True))))
        )
        self.points = points[satisfied(self.search.chains, points, self.low, self.high)]

    def root_of(self, relaxer):
        return relaxer.solve_roots(one(self.instance), relaxer.cold(one(self.instance)))

    @property
    def values(self):
        """Of all whole plans, by the plain problem."""
        search = Search(self.constants, self.instance, self.plain_root, 1e-6, None)
        result = answered(self.constants, self.instance, search, search.relax(self.points, self.points))
        assert (result.status == status.OPTIMAL).all()
        return result.objective

    def relaxed(self, *arguments):
        """Tightened relaxations within these limits, as a search asks for them."""
        steps = self.search.relax(*arguments)
        return run(self.tight, one(self.instance), [(0, self.search, steps)])[0]

    def narrowed(self, rng):
        """Limits of moves and positions as a tree has them: between two whole plans, tightened by the hard rows."""
        pair = self.points[rng.integers(len(self.points), size=2)]
        reached = np.round(pair @ self.constants.reached.T).astype(int)
        low, high = position_limits(self.search.chains)
        some = rng.random(len(low)) < 0.5
        moves = rng.random(len(low)) < 0.5
        limits = MoveLimits(
            np.where(moves, pair.min(axis=0), self.low),
            np.where(moves, pair.max(axis=0), self.high),
            np.where(some, reached.min(axis=0), low),
            np.where(some, reached.max(axis=0), high),
        )
        tight, possible = tighten(self.search.chains, MoveLimits(*(values[None] for values in limits)))
        assert possible[0]
        return tight
