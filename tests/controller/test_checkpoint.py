"""A controller that was saved and loaded goes on as if it had not been stopped, and copies work like what they are of."""

import copy
import json
import pickle
import subprocess
import sys

import jax
import numpy as np
import pytest

from jaxmpc.controller.checkpoint import load_controller, save_controller
from jaxmpc.errors import InputError
from tests.five_controllers import KINDS, START, Process, closed, controller_of, stepped


@pytest.fixture(scope="module")
def running(well_like_model, small_structure, thesis_fields):
    """A controller of every kind that has made some steps on a process with a model error, and its state."""
    known = {}

    def get(kind):
        if kind not in known:
            controller = controller_of(
                kind, well_like_model, small_structure, thesis_fields, bias_decay=[70.0, np.inf]
            )
            seen = lambda k, cv: np.array([cv[0] + 1 / 3, np.nan if k == 2 else cv[1] * 1.01])  # noqa: E731
            states, _ = closed(controller, Process(well_like_model), 4, seen=seen)
            known[kind] = controller, states[-1]
        return known[kind]

    return get


def further(controller, state, samples=3):
    """Everything that some more steps leave behind, but for the time that they took."""
    left = []
    for k in range(samples):
        state, info = stepped(controller, state, START[0] + [100.0 * k, 1 / 7])
        left += jax.tree.leaves((state, info.move, info.moves, info.objective, info.bound, info.nodes))
    return [np.asarray(leaf) for leaf in left]


def assert_same(ours, theirs):
    assert len(ours) == len(theirs)
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(mine, other)
        assert mine.dtype == other.dtype


@pytest.mark.parametrize("kind", KINDS)
def test_a_loaded_controller_goes_on_to_the_last_bit(running, tmp_path, kind):
    controller, state = running(kind)
    path = save_controller(controller, tmp_path / "controller.json", state)
    again, restored = load_controller(path)
    assert type(again) is type(controller)
    assert_same(jax.tree.leaves(restored), [np.asarray(leaf) for leaf in jax.tree.leaves(state)])
    assert_same(further(again, restored), further(controller, state))
    # and so does what is saved again
    assert save_controller(again, tmp_path / "again.json", restored).read_text() == path.read_text()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
def test_a_copy_steps_like_the_original(running, kind, copied):
    controller, state = running(kind)
    again, restored = copied((controller, state))
    assert_same(further(again, restored, 1), further(controller, state, 1))


RESTART = """
import sys
import numpy as np
from jaxmpc import load_controller
controller, state = load_controller(sys.argv[1])
state, info = controller.step(state, np.array([11000.0, 185.0 + 1 / 7]), np.array([12500.0, 205.0]))
print([float(v).hex() for v in np.concatenate([state.mv, state.bias, info.move, [info.objective]])])
"""


def test_another_process_goes_on_to_the_last_bit(running, tmp_path):
    controller, state = running("mixed-integer")
    path = save_controller(controller, tmp_path / "controller.json", state)
    done = subprocess.run(
        [sys.executable, "-c", RESTART, str(path)], capture_output=True, text=True, timeout=300, check=True
    )
    state, info = controller.step(state, np.array([11000.0, 185.0 + 1 / 7]), np.array([12500.0, 205.0]))
    numbers = np.concatenate([state.mv, state.bias, info.move, [info.objective]])
    assert done.stdout.strip() == str([float(v).hex() for v in numbers])


def test_a_controller_without_a_state_comes_back_without_one(running, tmp_path):
    controller, _ = running("continuous")
    again, state = load_controller(save_controller(controller, tmp_path / "fresh.json"))
    assert state is None
    assert again.structure == controller.structure


def changed(body, *path_and_value):
    *path, last, value = path_and_value
    place = body
    for key in path:
        place = place[key]
    if value is None:
        del place[last]
    else:
        place[last] = value
    return body


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (("format", "jaxmpc/controller/9"), r"controller\.format"),
        (("kind", "fuzzy"), r"controller\.kind"),
        (("tuning", None), r"controller\.tuning"),
        (("tuning", "cv_weight", [-1.0, 1.0]), r"controller\.tuning\.cv_weight"),
        (("structure", "dt", -1), r"structure\.dt"),
        (("options", "gap", 2.0), "gap"),
        (("state", "future", [[0.0], [0.0]]), r"controller\.state\.future"),
        (("state", "warm.x", None), r"controller\.state\.warm\.x"),
        (("state", "warm.box_price", [1.0]), r"controller\.state\.warm\.box_price"),
        (("state", "mv", ["many", 1.0]), r"controller\.state\.mv"),
    ],
)
def test_a_file_that_is_not_right_is_refused_by_the_name_of_the_field(running, tmp_path, change, field):
    controller, state = running("mixed-integer")
    path = save_controller(controller, tmp_path / "controller.json", state)
    path.write_text(json.dumps(changed(json.loads(path.read_text()), *change)))
    with pytest.raises(InputError, match=field):
        load_controller(path)


@pytest.mark.parametrize("content", ["", "[]", "{", "null", '{"format": 1}'])
def test_a_file_of_something_else_is_refused(tmp_path, content):
    path = tmp_path / "controller.json"
    path.write_text(content)
    with pytest.raises(InputError, match="controller"):
        load_controller(path)
