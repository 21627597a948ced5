from __future__ import annotations

import inspect
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.registry import (
    MIXTURES,
    DatasetSpec,
    all_specs,
    find_reader,
    get_mixture,
    get_spec,
    known_groups,
    openx,
    register,
)
from data_pipelines.registry import table as registry_table
from data_pipelines.registry.openx import EPISODES, LONG, OPENX
from data_pipelines.registry.spec import split_camera_key
from data_pipelines.registry.toml_file import load_entries, put_entry, to_toml
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.suite.embodiments import EMBODIMENTS
from hma_jax.config import ConfigError
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from tests.data_pipelines.fakes import REAL_DATA, make_spec, write_rlds


@pytest.fixture
def registered(monkeypatch):
    """Entries registered in a test are gone after it."""
    monkeypatch.setattr(registry_table, "_registered", {})


def test_real_dataset_matches_its_entry():
    spec = get_spec("bridge_dataset")
    RldsDataset(REAL_DATA).check_keys(spec.image_key, spec.action_keys, spec.action_dims)
    assert (spec.stride, spec.action_dim) == (3, 7)


def test_every_embodiment_of_the_suite_is_registered():
    for e in EMBODIMENTS:
        spec = get_spec(e.name)
        assert (spec.hz, spec.action_dim) == (e.hz, 0 if e.video_only else e.action_dim)
        assert (spec.image_key, spec.split, spec.val_split) == ("observation/image", "train+val", "val")
        assert all(key.startswith("action/") for key in spec.action_keys) == (e.dict_actions or e.video_only)


@pytest.mark.parametrize("split", ["train", "val", "val+train"])
def test_a_split_that_is_held_out_must_follow_another(split):
    with pytest.raises(
        ConfigError, match="val_split val is the held-out split, so split must name it after another one"
    ):
        replace(get_spec("bridge_dataset"), split=split, val_split="val")


def test_every_name_is_registered_once():
    names = [spec.name for specs in known_groups().values() for spec in specs]
    assert len(names) == len(set(names)) == len(all_specs()) > 95


# --- the paper's mixture ----------------------------------------------------------------------


def test_mixtures_are_the_release_s_lists():
    sizes = {name: len(set(names)) for name, names in MIXTURES.items()}
    assert sizes.pop("dataset40_published") == 35
    assert sizes == {f"dataset{n}": n for n in (5, 10, 20, 30, 40)} | {"dataset30_vae": 30}
    for small, large in (("dataset5", "dataset10"), ("dataset10", "dataset20"), ("dataset20", "dataset30")):
        assert set(MIXTURES[small]) < set(MIXTURES[large])
    (extra,) = set(MIXTURES["dataset30"]) - set(MIXTURES["dataset40"])  # the release's own inconsistency
    assert extra.startswith("cmu_franka_exploration")
    assert [get_spec(name).name for names in MIXTURES.values() for name in names]


def test_what_is_published_of_the_forty_is_in_their_order_and_downloadable():
    """A study of it adds datasets as one of the forty does, and each is in the public bucket under its name."""
    published, forty = MIXTURES["dataset40_published"], MIXTURES["dataset40"]
    named = [name if name in forty else "imperial_wrist_dataset" for name in published]
    assert named == [name for name in forty if name in named]
    assert {name for name in forty if name not in named} == {
        "metaworld",
        "robomimic",
        "epic_kitchen",
        "ego4d",
        "exoego4d",
    }
    assert {name for name in published if name not in EPISODES} == {"bridge_data_v2"}  # of which tfds gives no count


def test_unknown_mixture_lists_the_known():
    with pytest.raises(ConfigError, match="unknown mixture 'dataset15'; known: dataset5, dataset10"):
        get_mixture("dataset15")


def test_rates_that_the_release_gets_wrong_are_right():
    """Native rates where the release has none or a changed one (reference section 5.4)."""
    native = {
        "bridge_data_v2": 5, "utokyo_xarm_bimanual_converted_externally_to_rlds": 10,
        "berkeley_fanuc_manipulation": 10, "qut_dexterous_manpulation": 30,
        "dlr_sara_grid_clamp_converted_externally_to_rlds": 10, "cmu_stretch": 10, "spoc": 10,
        "io_ai_tech": 30, "dobbe": 3.75, "berkeley_gnm_cory_hall": 5, "plex_robosuite": 20,
        "imperial_wrist_dataset": 10, "language_table": 10, "kuka": 10,
    }  # fmt: skip
    assert {name: get_spec(name).hz for name in native} == native


def test_termination_flags_and_future_actions_are_no_part_of_the_action():
    dims = {"fractal20220817_data": 10, "kuka": 7, "bc_z": 7, "cmu_stretch": 7, "toto": 7, "droid": 9}
    assert {name: get_spec(name).action_dim for name in dims} == dims
    assert not [s.name for s in all_specs() if any("terminate" in key for key in s.action_keys)]


def test_open_x_entries_say_how_many_episodes_there_are():
    """But bridge_data_v2, which tfds gives no count of."""
    unknown = {s.name for s in OPENX if not s.episodes}
    assert unknown == {"bridge_data_v2"}
    assert set(EPISODES) <= {s.name for s in all_specs()}
    language_table = get_spec("language_table")
    assert (language_table.episodes, language_table.mean_steps) == (442_226, 15.9)
    assert (get_spec("bridge_dataset").episodes, get_spec("bridge_dataset").median_steps) == (25, 10)


def test_every_importable_dataset_of_the_catalogue_has_an_entry_or_a_reason():
    from tensorflow_datasets.robotics.rtx import rtx

    text = inspect.getsource(rtx)
    published = set(re.findall(r"return '([a-z0-9_]+)/\d+\.\d+\.\d+'", text))
    assert len(published) > 60
    left_out = {"tidybot", "vima_converted_externally_to_rlds", "robo_ai_u_r5e"}
    assert published - {s.name for s in all_specs()} == left_out
    for name in left_out:
        assert name.removesuffix(LONG) in inspect.getdoc(openx)


def test_what_an_entry_says_to_people_does_not_change_the_data():
    spec = get_spec("droid_sample")
    assert replace(spec, episodes=9, median_steps=1, mean_steps=2, note="x").facts() == spec.facts()
    assert replace(spec, angles=(3,)).facts() != spec.facts()


def test_constant_action_dimensions_are_safe_to_normalise():
    """Planar robots, flags that never rise: std 0 and rounding noise give exactly 0, not infinity."""
    table = EmbodimentTable((Embodiment("flat", 3, 2, mean=(1.0, 0.1, -2.0), std=(0.5, 0.0, 1e-8)),))
    raw = np.tile(np.float32([2.0, 0.1 + 1e-7, -2.0 + 1e-6]), (1, 4, 2))
    normal = np.asarray(table.scale().normalise(raw, np.array([0])))
    assert np.allclose(normal, np.tile([2.0, 0.0, 0.0], 2), atol=1e-6)
    assert not normal[..., [1, 2]].any()
    assert np.allclose(table.scale().unnormalise(normal, np.array([0])), raw, atol=1e-5)


# --- entries ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "hz, stride",
    [(0.5, 1), (1, 1), (2, 1), (2.8, 1), (2.9, 2), (3, 2), (4, 2), (5, 3), (9, 5), (10, 5), (13, 7), (15, 8), (20, 10),
     (25, 13), (30, 15), (45, 23)],
)  # fmt: skip
def test_stride_brings_the_rate_next_to_2_hz_in_ratio(hz, stride):
    """5 Hz had stride 2 (2.5 Hz), 9, 13, 25 and 45 Hz 4, 6, 12 and 22: Python rounds halves to even."""
    assert DatasetSpec("x", "observation/image", ("action",), (1,), hz).stride == stride
    other = min((abs(math.log(hz / s / 2)), s) for s in range(1, 50))
    assert other[1] == stride


@pytest.mark.parametrize("rate, stride", [(None, 1), (2.0, 15), (4.0, 8), (10.0, 3), (30.0, 1), (60.0, 1)])
def test_stride_at_another_rate(rate, stride):
    spec = DatasetSpec("x", "observation/image", ("action",), (1,), 30)
    assert spec.stride_at(rate) == stride
    assert replace(spec, rate=10.0).stride_at(rate) == 3, "an entry's own rate goes before the study's"


def test_impossible_rates_are_refused():
    spec = DatasetSpec("x", "observation/image", ("action",), (1,), 30)
    with pytest.raises(
        ConfigError, match="dataset 'x': rate, the frame rate in Hz, must be positive and finite, got 0"
    ):
        replace(spec, rate=0.0)
    with pytest.raises(ConfigError, match="the frame rate must be positive"):
        spec.stride_at(-1.0)


def test_an_entry_of_ones_own_may_have_its_own_rate(tmp_path):
    entry = replace(DatasetSpec("x", "observation/image", ("action",), (1,), 30), rate=30.0)
    (tmp_path / "own.toml").write_text(to_toml(entry))
    (read,) = load_entries(tmp_path / "own.toml")
    assert read == entry and read.stride_at(2.0) == 1


def test_several_cameras_in_an_entry_are_refused_with_what_to_do(tmp_path):
    """It said "expected str", of what other programs take."""
    entry = to_toml(DatasetSpec("x", "observation/a", ("action",), (1,), 30))
    (tmp_path / "own.toml").write_text(entry.replace('"observation/a"', '["observation/a", "observation/b"]'))
    with pytest.raises(ConfigError, match=r"own.toml: x: image_key = \[.*\] lists cameras, .* name one of them. docs/"):
        load_entries(tmp_path / "own.toml")


def test_the_layout_of_actions_is_that_of_keys_and_their_order_alone():
    spec = DatasetSpec("x", "observation/image", ("action/a", "action/b"), (2, 2), 30)
    same = replace(spec, name="y", hz=10, image_key="observation/other", note="words", video_targets=False, rate=5.0)
    assert same.action_layout() == spec.action_layout()
    swapped = replace(spec, action_keys=("action/b", "action/a"))
    cut = replace(spec, action_dims=(1, 3))
    assert len({s.action_layout() for s in (spec, swapped, cut)}) == 3


def test_part_of_a_field_is_read_as_the_action(tmp_path):
    directory = write_rlds(tmp_path, make_spec("toy", (5,)), [4, 4])
    dataset = RldsDataset(directory)
    whole = dataset.episode(1, "observation/image", ("action",)).actions
    parts = dataset.episode(1, "observation/image", ("action[1:3]", "action[:1]", "action[4:]")).actions
    assert np.array_equal(parts, whole[:, [1, 2, 0, 4]])
    dataset.check_keys("observation/image", ("action[1:3]", "action[4:]"), (2, 1))
    with pytest.raises(ConfigError, match=r"'action\[3:9\]' has 2 values"):
        dataset.check_keys("observation/image", ("action[3:9]",), (6,))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hz": 0}, "hz, the native rate, must be positive"),
        ({"action_dims": (7, 1)}, "same length"),
        ({"action_keys": ("action[:6]",)}, r"'action\[:6\]' uses 6 values, but action_dims says 7"),
        ({"action_dims": (0,)}, "at least 1"),
        ({"joins": ("y", "/data/z")}, "joins has '/data/z', .* Write the names that `hma data inspect` prints"),
        ({"joins": ("y", "y")}, "joins names a dataset twice"),
    ],
)
def test_entry_that_cannot_be_right_is_refused(change, message):
    good = DatasetSpec("x", "observation/image", ("action[:7]",), (7,), 10)
    with pytest.raises(ConfigError, match=f"dataset 'x': .*{message}"):
        replace(good, **change)


def test_a_dataset_is_read_by_the_entry_that_joins_it(registered):
    one = DatasetSpec("one", "observation/image", ("action",), (7,), 10)
    arm = replace(one, name="arm", joins=("one", "two"))
    assert arm.action_layout() == one.action_layout() and arm.facts().joins == arm.joins
    register([one])
    assert find_reader("one") == one and find_reader("two") is None
    register([arm, replace(one, name="two", joins=("two", "three"))])
    assert find_reader("one") == arm and find_reader("three").name == "two"
    with pytest.raises(ConfigError, match="two is in `joins` of arm and two; a dataset can be part of one other"):
        find_reader("two")
    with pytest.raises(ConfigError, match="arm is the name of a dataset by its own files, .* joins one, two. Add arm"):
        find_reader("arm")


def test_unknown_name_suggests_the_closest():
    with pytest.raises(ConfigError, match="unknown dataset 'bridge_datset'; did you mean bridge_dataset"):
        get_spec("bridge_datset")
    with pytest.raises(ConfigError, match="known: bridge_dataset.*hma data list"):
        get_spec("zzzzz")


def test_images_are_corrected_as_the_entry_says():
    spec = get_spec("bridge_dataset")
    images = np.arange(2 * 3 * 4 * 3, dtype=np.uint8).reshape(2, 3, 4, 3)
    assert spec.correct(images) is images
    turned = replace(spec, image_corrections=("rotate_180",)).correct(images)
    assert np.array_equal(turned, images[:, ::-1, ::-1]) and turned.flags.c_contiguous
    swapped = replace(spec, image_corrections=("swap_red_blue",)).correct(images)
    assert np.array_equal(swapped, images[..., [2, 1, 0]])
    both = replace(spec, image_corrections=("rotate_180", "swap_red_blue"))
    assert np.array_equal(both.correct(images[0]), images[0, ::-1, ::-1, ::-1])
    assert both.action_layout() == spec.action_layout() and both.facts() != spec.facts()
    assert spec.camera_key == spec.image_key != both.camera_key
    for one in (spec, both, replace(both, image_key="observation/left camera")):
        assert split_camera_key(one.camera_key) == (one.image_key, one.image_corrections)


@pytest.mark.parametrize("wrong", [("flip",), ("swap_red_blue", "rotate_180"), ("rotate_180", "rotate_180")])
def test_corrections_that_there_are_not_are_refused(wrong):
    with pytest.raises(ConfigError, match="image_corrections may list rotate_180, swap_red_blue"):
        replace(get_spec("bridge_dataset"), image_corrections=wrong)


# --- entries outside the project --------------------------------------------------------------


def test_entry_survives_its_toml_file(tmp_path):
    rare = DatasetSpec("rare", "observation/\U0001f916", ("action\u00e9",), (7,), 10)
    upside_down = replace(rare, image_corrections=("rotate_180",))
    joined = replace(rare, joins=("rare", "unique"))
    for spec in (*all_specs(), rare, upside_down, joined):
        (tmp_path / "one.toml").write_text(to_toml(spec), encoding="utf-8")
        assert load_entries(tmp_path / "one.toml") == (spec,)


def test_registered_entry_is_found_and_takes_the_place_of_a_known_one(registered):
    register([DatasetSpec("mine", "observation/image", ("action",), (7,), 10)])
    assert get_spec("mine").hz == 10
    register([replace(get_spec("droid"), hz=7.5)])
    assert get_spec("droid").hz == 7.5
    assert len({s.name for s in all_specs()}) == len(all_specs())
    assert {s for specs in known_groups().values() for s in specs} == set(all_specs())  # what is listed is what is used


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[robot", "not a TOML file"),
        ("hz = 3", "hz = 3 is not in a table"),
        ('[robot]\nimage_key = "i"\naction_keys = []\naction_dims = []\n', "robot: missing field.* hz"),
        ('[robot]\nimage = "i"\n', "unknown field.* image; known"),
        ('[robot]\nname = "arm"\nimage_key = "i"\n', "robot: remove name = 'arm'"),
        ('[robot]\nimage_key = "i"\naction_keys = []\naction_dims = []\nhz = 1\njoins = "a"\n', "robot.joins"),
        ('[robot]\nimage_key = "i"\naction_keys = []\naction_dims = []\nhz = -1\n', "hz, the native rate"),
        (
            '[robot]\nimage_key = "i"\naction_keys = ["action"]\naction_dims = [2]\nhz = 1\nangles = [1]\n',
            'robot: angles needs angle_form too; add angle_form = "sine_cosine"',
        ),
    ],
)
def test_toml_file_with_a_mistake_is_named(text, message, tmp_path):
    (tmp_path / "my.toml").write_text(text)
    with pytest.raises(ConfigError, match=rf"my.toml: .*{message}"):
        load_entries(tmp_path / "my.toml")


ENTRIES = """# of our lab
["a.rm"]  # the left one
image_key = "i"
action_keys = [
  "action",
]
action_dims = [3]
hz = 4.0

# asked in May
[bot]
image_key = "i"
action_keys = []
action_dims = []
hz = 5
"""


@pytest.mark.parametrize("name", ["a.rm", "bot", "new"])
def test_an_entry_is_put_into_a_file_and_nothing_else_changes(name, tmp_path):
    spec = make_spec(name, (2,), hz=9)
    text = put_entry(ENTRIES, spec, "my.toml")
    (tmp_path / "my.toml").write_text(text)
    assert dict.fromkeys(("a.rm", "bot", name)) == dict.fromkeys(e.name for e in load_entries(tmp_path / "my.toml"))
    assert spec in load_entries(tmp_path / "my.toml") and "# of our lab\n" in text and "\n\n# asked in May\n" in text
    assert ('["a.rm"]  # the left one' in text) == (name != "a.rm") and put_entry(text, spec, "my.toml") == text
    assert put_entry("", spec, "my.toml") == to_toml(spec)
    with pytest.raises(ConfigError, match="my.toml: the entry of x cannot be added to this file"):
        put_entry('x = {image_key = "i", action_keys = [], action_dims = [], hz = 1}', make_spec("x"), "my.toml")


def test_missing_toml_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match="absent.toml: the registry file cannot be read"):
        load_entries(tmp_path / "absent.toml")


@pytest.mark.parametrize(("hz", "stride"), [(5, 2), (3, 1), (15, 7), (12.5, 5), (10, 3), (30, 1)])
def test_the_rate_that_is_advised_gives_the_stride_of_the_model(hz, stride):
    """The official release floors a ratio of rates that is rounded here: 5 Hz are stride 2 there and 3 here."""
    spec = make_spec("toy", hz=hz)
    robot = Embodiment("toy", 3, stride, (0.0,) * 3, (1.0,) * 3)
    with pytest.raises(ConfigError, match=f"trained with frames at stride {stride}, but here the stride is") as refused:
        spec.check_compatible(robot, rate=2.0)
    rate = re.search(r"`rate = ([0-9.]+)` into the entry of toy", str(refused.value))[1]
    assert f"To train at stride {spec.stride}, add it as a new robot with `hma adapt --everything`" in str(
        refused.value
    )
    replace(spec, rate=float(rate)).check_compatible(robot, rate=2.0)
    with pytest.raises(ConfigError, match=r"trained with 2 action values, .* has 3: action \(3\)"):
        spec.check_compatible(Embodiment("toy", 2, stride, (0.0,) * 2, (1.0,) * 2), rate=2.0)
