"""Policies of a user's file: what is refused, and that what they do to arrays is their own affair."""

from pathlib import Path

import numpy as np
import pytest

from experiments.applications.judging.user_policies import CheckedPolicy, load_user_policies, try_out
from experiments.applications.judging.user_success import UserSuccess
from hma_jax.config import ConfigError
from hma_jax.simulator.robots import Robot

ROBOT = Robot("arm", 2, (-1.0,) * 3, (1.0,) * 3, (0.0,) * 3)

FILE = """
import numpy as np
from dataclasses import dataclass
from helper_of_policies import VALUE


@dataclass
class Constant:
    value: float
    dim: int

    def reset(self, episodes=None, *, seeds=None):
        self.seeds = seeds

    def act(self, images):
        return np.full((len(images), self.dim), self.value)


def policies(robot):
    return {"still": Constant(0.0, robot.action_dim), "Onward-2": Constant(VALUE, robot.action_dim)}
"""


def test_policies_of_a_file_are_found_by_name_with_what_lies_beside_it(tmp_path):
    (tmp_path / "helper_of_policies.py").write_text("VALUE = 0.5")
    (tmp_path / "mine.py").write_text(FILE)
    found, success = load_user_policies(tmp_path / "mine.py", ROBOT)
    assert list(found) == ["still", "Onward-2"] and success is None
    try_out(found, success, 2, (8, 8))
    actions = found["Onward-2"].act(np.zeros((2, 8, 8, 3), np.uint8))
    assert actions.dtype == np.float32 and actions.tolist() == [[0.5] * 3] * 2
    assert list(found["still"].policy.seeds) == [0, 1]


def test_success_of_a_file_is_asked_of_frames_beside_the_first_of_their_episodes(tmp_path):
    path = tmp_path / "mine.py"
    text = "def policies(robot): return {'a': A}\nclass A:\n def reset(episodes=None, seeds=None): 0\n def act(images): 0\n"
    path.write_text(text + "def success(images, first): return images.mean((1, 2, 3)) > first.mean((1, 2, 3))\n")
    _, success = load_user_policies(path, ROBOT)
    images = np.arange(600, dtype=np.uint8).reshape(2, 300, 1, 1, 1) * np.ones((1, 1, 4, 4, 3), np.uint8)
    found = success.reached(images, images[:, 10:11])
    assert found.shape == (2, 300) and (found == (images > images[:, 10:11])[..., 0, 0, 0]).all()
    path.write_text(text + "success = 3\n")
    with pytest.raises(ConfigError, match=r"mine.py: has no function success\(images, first\)"):
        load_user_policies(path, ROBOT)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("0.5", r"float64 \[\]"),
        ("[1, 0]", r"int64 \[2\]"),
        ("[0.5, float('nan')]", r"in \[0, 1\]; it returned \[nan\]"),
        ("[0.5, 1.5]", r"in \[0, 1\]; it returned \[1.5\]"),
        ("[[0.5], [0.5, 0.5]]", "it returned something that is not an array"),
    ],
)
def test_success_that_is_no_probability_of_each_image_is_refused(given, said):
    success = UserSuccess(lambda images, first: eval(given), "mine.py")
    with pytest.raises(ConfigError, match=rf"mine.py: success\(images, first\) must return an array \[2\].*{said}"):
        try_out({}, success, 2, (8, 8))


def test_the_policies_of_the_page_are_some(tmp_path):
    page = (Path(__file__).parents[4] / "docs" / "judging.md").read_text()
    (tmp_path / "my_policies.py").write_text(page.split("```python\n")[1].split("```")[0])
    found, success = load_user_policies(tmp_path / "my_policies.py", ROBOT)
    try_out(found, success, 2, (8, 8))
    bright = np.full((1, 8, 8, 3), 255, np.uint8)
    assert {name: policy.act(bright).tolist() for name, policy in found.items()} == {
        "timid": [[0] * 3],
        "bold": [[1] * 3],
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"no such file; policies of your own are a Python file with policies\(robot\)"),
        ("policy = 1", r"has no function policies\(robot\)"),
        ("def policies(robot): return [1]", r"policies\(robot\) must return a dict of policies by name, got list"),
        ("def policies(robot): return {}", "returned an empty dict"),
        ("def policies(robot): return {'a/b': 1}", "'a/b' is used in file names"),
        ("def policies(robot): return {'..': 1}", "'..' is used in file names"),
        ("def policies(robot): return {7: 1}", "7 is used in file names"),
        ("def policies(robot): return {'cloned-60': 1}", "'cloned-60' is the name of a built-in policy"),
        ("def policies(robot): return {'random': 1}", "'random' is the name of a built-in policy"),
        ("def policies(robot): return {'Net': 1, 'net': 1}", "Net, net differ only in upper and lower case"),
        ("def policies(robot): return {'net': 1}", r"policy 'net' is of type int and has no reset\(episodes=None"),
        (
            "class P:\n def reset(self): ...\n def act(self, images): ...\ndef policies(robot): return {'net': P()}",
            r"policy 'net': its reset\(\) cannot be called as reset\(episodes=None, \*, seeds=None\)",
        ),
    ],
)
def test_what_is_no_file_of_policies_is_refused_by_file_function_and_name(tmp_path, text, message):
    path = tmp_path / "mine.py"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=message) as error:
        load_user_policies(path, ROBOT)
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\ndef policies(robot) return {}", "line 2: SyntaxError: expected ':'"),
        ("import no_such_module", "line 1: ModuleNotFoundError: No module named 'no_such_module'"),
        (
            "def policies(robot):\n    return {'a': robot.width}",
            "line 2: AttributeError: 'Robot' object has no attribute",
        ),
        ("def policies(robot):\n    return {1 / 0: 1}\n\n", "line 2: ZeroDivisionError: division by zero"),
    ],
)
def test_what_the_file_raises_is_a_message_that_names_its_line(tmp_path, text, message):
    """It was a traceback, most of it through what runs the file."""
    path = tmp_path / "mine.py"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_user_policies(path, ROBOT)
    assert str(error.value).startswith(f"{path}, {message}") and "docs/judging.md" in str(error.value)


class Gives:
    def __init__(self, actions):
        self.actions = actions

    def reset(self, episodes=None, *, seeds=None): ...

    def act(self, images):
        images[:] = 0
        return self.actions


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((2, 4), np.float32), r"it returned float32 \[2, 4\]"),
        (np.zeros(3, np.float32), r"it returned float32 \[3\]"),
        (np.zeros((2, 3, 3), np.float32), r"or \[2, 2, 3\], the whole chunk .*; it returned float32 \[2, 3, 3\]"),
        (np.zeros((2, 3), int), r"it returned int64 \[2, 3\]"),
        (None, r"it returned object \[\]"),
        ([[0.0], [0.0, 1.0]], "it returned something that is not an array"),
        (np.array([[0, 0, 0], [0, np.nan, 0]]), r"for image 1 is not finite: \[0.0, nan, 0.0\]"),
        (np.full((2, 3), 1e300), "for image 0 is not finite"),
        (np.where(np.arange(12).reshape(2, 2, 3) == 9, np.inf, 0), "for image 1 is not finite"),
    ],
)
@pytest.mark.filterwarnings("ignore:overflow")
def test_actions_that_are_none_are_refused_by_policy_and_shape(actions, message):
    policy = CheckedPolicy(Gives(actions), ROBOT, "mine.py: policy 'net'")
    with pytest.raises(ConfigError, match=message) as error:
        policy.act(np.zeros((2, 8, 8, 3), np.uint8))
    assert "mine.py: policy 'net': act(images) must return float32 [2, 3], an unnormalised action of arm" in str(
        error.value
    )


def test_a_policy_may_give_whole_chunks():
    chunks = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    acted = CheckedPolicy(Gives(chunks), ROBOT, "net").act(np.zeros((2, 8, 8, 3), np.uint8))
    np.testing.assert_array_equal(acted, chunks)


def test_a_policy_that_gives_now_actions_and_now_chunks_is_refused():
    """A rollout's actions are one array: there was a traceback once all of its frames had been made."""
    given, images = Gives(np.zeros((2, 2, 3), np.float32)), np.zeros((2, 8, 8, 3), np.uint8)
    policy = CheckedPolicy(given, ROBOT, "net")
    policy.act(images)
    given.actions = np.zeros((2, 3), np.float32)
    with pytest.raises(ConfigError, match=r"net: .* always chunks; .* \[2, 3\] before, and now \[3\]"):
        policy.act(images)


def test_a_policy_may_write_into_images_and_into_what_it_gave():
    given = Gives(np.ones((2, 3), np.float32))
    policy, images = CheckedPolicy(given, ROBOT, "net"), np.full((2, 8, 8, 3), 9, np.uint8)
    kept = policy.act(images)
    given.actions[:] = 5
    assert (images == 9).all() and (kept == 1).all()


def test_a_policy_of_c_does_not_say_what_it_takes_and_is_taken_all_the_same():
    given = Gives(np.ones((2, 3), np.float32))
    given.act = {}.update
    assert CheckedPolicy(given, ROBOT, "net").policy is given
