from __future__ import annotations

import hashlib
import itertools
from dataclasses import replace

import grain
import numpy as np
import pytest

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.loading.frames import make_frame_loader
from data_pipelines.registry import get_spec
from data_pipelines.sampling.splits import HeldOut, held_out
from data_pipelines.sources.identity import describe
from data_pipelines.sources.rlds import images
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.location import OpenFiles
from data_pipelines.sources.rlds.writer import encode_jpeg
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import write_lerobot, write_robomimic
from tests.data_pipelines.fakes import REAL_DATA, FakeTokenizer, count_open, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

SPEC = make_spec()


@pytest.fixture(scope="module")
def rlds(tmp_path_factory):
    return write_rlds(tmp_path_factory.mktemp("frames"), SPEC, [5 + i for i in range(20)], shards=3)


def take(datasets, count, batch=8, **options):
    options = {"tau": 3.0, "held_out": HeldOut()} | options
    loader = make_frame_loader(datasets, image_size=8, batch=batch, seed=1, **options)
    return list(itertools.islice(loader, count))


@pytest.mark.parametrize("batch", [1, 6, 8])
def test_frames_are_uint8_squares_of_the_asked_size(batch):
    loader = make_frame_loader(
        [(get_spec("bridge_dataset"), REAL_DATA)], image_size=16, batch=batch, seed=0, tau=3.0, held_out=HeldOut()
    )
    frames = next(loader)
    assert frames.shape == (batch, 16, 16, 3) and frames.dtype == np.uint8 and frames.std() > 10


def test_frames_are_corrected_as_the_entry_says(rlds):
    (plain,), (swapped,) = (
        take([(spec, rlds)], 1) for spec in (SPEC, replace(SPEC, image_corrections=("swap_red_blue",)))
    )
    assert plain.any() and np.array_equal(swapped, plain[..., ::-1])


class Wide(FakeTokenizer):
    """Of images four times as wide as the others', and it keeps what it encodes."""

    image_size = 32

    def __init__(self):
        super().__init__()
        self.seen: list[bytes] = []

    def encode(self, images):
        self.seen += [image.tobytes() for image in images]
        return super().encode(images[:, ::4, ::4])


def test_a_tokenizer_is_trained_on_the_frames_that_it_will_encode(tmp_path):
    """JPEG images of twice its size, which a decoder can shrink by itself: then another filter has made them."""
    rng, spec, tokenizer = np.random.default_rng(0), replace(SPEC, image_corrections=("swap_red_blue",)), Wide()

    def draw(_, features):
        pictures = rng.integers(0, 256, (5, 64, 64, 3), np.uint8)
        features["steps/observation/image"] = [encode_jpeg(picture) for picture in pictures]

    rlds = write_rlds(tmp_path, spec, [5] * 4, change=draw)
    tokenize_dataset(spec, rlds, tokenizer, tmp_path / "store", rate=None)
    frames = next(make_frame_loader([(spec, rlds)], tokenizer.image_size, 16, seed=1, tau=3.0, held_out=HeldOut()))
    assert all(frame.tobytes() in tokenizer.seen for frame in frames)


def test_splits_share_no_episode_and_cover_all_frames(rlds):
    mask = held_out("toy", RldsDataset(rlds).ids, HeldOut())
    seen = {}
    for split in ("train", "val"):
        frames = np.concatenate(take([(SPEC, rlds)], 120, split=split))[:, 0, 0]
        seen[split] = set(map(tuple, frames[:, :2].tolist()))
    assert {e for e, _ in seen["val"]} == set(np.flatnonzero(mask).tolist())
    assert {e for e, _ in seen["train"]} == set(np.flatnonzero(~mask).tolist())
    assert seen["val"] == {(e, t) for e in np.flatnonzero(mask) for t in range(5 + e)}


def test_resuming_at_every_step_continues_exactly(tmp_path, rlds):
    other = make_spec("other")
    for datasets in ([(SPEC, rlds)], [(SPEC, rlds), (other, write_rlds(tmp_path, other, [9] * 6))]):
        straight = take(datasets, 7)
        for start in range(6):
            rest = take(datasets, 2, start_step=start, threads=0)
            assert np.array_equal(rest, straight[start : start + 2])


def test_the_records_of_a_batch_are_those_that_its_frames_were_read_from(rlds):
    """The fixture's frames say (episode, step); four come from one episode at a time."""
    loader = make_frame_loader([(SPEC, rlds)], image_size=8, batch=8, seed=1, tau=3.0, held_out=HeldOut())
    runs = RldsDataset(rlds).runs
    for step in range(4):
        episodes = next(loader)[::4, 0, 0, 0]
        assert loader.describe(step) == [f"toy: {describe(runs, int(e))}" for e in episodes]


def test_every_frame_of_a_batch_has_its_dataset_and_episode(tmp_path, rlds):
    """Episodes of the second dataset are longer than any of the first, whose frames say (episode, step)."""
    other = make_spec("other")
    loader = make_frame_loader(
        [(SPEC, rlds), (other, write_rlds(tmp_path, other, [200] * 6))], 8, batch=6, seed=1, tau=3.0, held_out=HeldOut()
    )
    seen = set()
    for step in range(40):
        frames, (dataset, episode) = next(loader), loader.episodes(step)
        assert frames[:, 0, 0, 0].tolist() == episode.tolist()
        assert dataset[frames[:, 0, 0, 1] > 24].all()
        seen |= set(dataset.tolist())
    assert seen == {0, 1}


def test_number_of_threads_changes_no_frame(tmp_path, rlds):
    other = make_spec("other")
    datasets = [(SPEC, rlds), (other, write_rlds(tmp_path, other, [9] * 6))]
    alone = take(datasets, 12, threads=0)
    for threads in (1, 3, 9):
        assert np.array_equal(take(datasets, 12, threads=threads), alone)


@pytest.mark.parametrize(("cores", "threads"), [(1, 1), (5, 5), (64, 8)])
def test_as_many_threads_decode_as_there_are_cores_up_to_eight(cores, threads, rlds, monkeypatch):
    """There were two on every machine, which a GPU waited for."""
    asked, make = [], grain.ReadOptions
    monkeypatch.setattr(grain, "ReadOptions", lambda **options: asked.append(options) or make(**options))
    monkeypatch.setattr(images, "usable_cores", lambda: cores)
    take([(SPEC, rlds)], 1)
    assert [options["num_threads"] for options in asked] == [threads]


def test_order_does_not_change_between_releases(tmp_path, rlds):
    """Changing it changes the tokenizer of every study, and resumed training would not continue."""
    other = make_spec("other")
    datasets = [(SPEC, rlds), (other, write_rlds(tmp_path, other, [200] * 5))]
    frames = np.concatenate(take(datasets, 50, start_step=1000))[:, 0, 0, :2]
    assert frames[:8].tolist() == [[4, 146], [4, 127], [4, 181], [4, 92], [8, 1], [8, 8], [8, 0], [8, 12]]
    assert hashlib.sha256(frames.tobytes()).hexdigest()[:16] == "e01ee5299b75b1f5"


def test_files_kept_open_are_bounded_over_all_datasets(tmp_path, monkeypatch):
    specs = [make_spec(name) for name in ("a", "b", "c")]
    datasets = [(spec, write_rlds(tmp_path, spec, [5] * 8, shards=4)) for spec in specs]
    monkeypatch.setattr("data_pipelines.loading.frames.OpenFiles", lambda: OpenFiles(2))
    loader = make_frame_loader(datasets, image_size=8, batch=8, seed=1, threads=0, tau=3.0, held_out=HeldOut())
    after = list(itertools.islice(loader, 60))
    assert count_open(tmp_path) == 2
    monkeypatch.undo()
    assert np.array_equal(after, take(datasets, 60, threads=0))


def test_small_datasets_are_not_drowned(tmp_path, rlds):
    other = make_spec("small")
    directory = write_rlds(tmp_path, other, [200] * 4)
    frames = np.concatenate(take([(SPEC, rlds), (other, directory)], 60))[:, 0, 0]
    share = (frames[:, 0] < 4).mean()  # 2 of 20 episodes: 1 / (1 + 9^(1/3)) = 0.32 of the draws
    assert share > 0.3


def test_damaged_episode_is_an_error_or_replaced(tmp_path):
    def spoil(episode, features):
        if episode == 3:
            features["steps/observation/image"] = [b"broken"] * 9

    rlds = write_rlds(tmp_path, SPEC, [9] * 6, change=spoil)
    assert not held_out("toy", RldsDataset(rlds).ids, HeldOut())[3]
    with pytest.raises(EpisodeError, match="episode 3"):
        take([(SPEC, rlds)], 20)
    seen = np.concatenate(take([(SPEC, rlds)], 20, corrupt="skip"))[:, 0, 0, 0]
    assert 3 not in seen and len(set(seen.tolist())) == 4


def test_a_damaged_episode_is_one_loss_however_many_of_its_frames_are_drawn(tmp_path):
    def spoil(episode, features):
        if episode == 3:
            features["steps/observation/image"] = [b"broken"] * 9

    rlds = write_rlds(tmp_path, SPEC, [9] * 6, change=spoil)
    take([(SPEC, rlds)], 20, corrupt="skip", max_skipped=1)


@pytest.mark.parametrize("kind", ["lerobot", "robomimic"])
def test_an_episode_without_a_step_is_damaged(tmp_path, kind):
    if kind == "lerobot":
        spec, place = replace(SPEC, image_key="observation/top"), write_lerobot(tmp_path / "toy", "v2.1")
        path = place / "meta" / "episodes.jsonl"
        path.write_text(path.read_text().replace('"length": 9', '"length": 0'))
    else:
        spec = make_spec("robomimic_lift", (7,))
        spec, place = replace(spec, image_key="observation/agentview"), tmp_path / "x.hdf5"
        write_robomimic(place, lengths=(5, 7), change=lambda file: empty(file["data/demo_10"]))
    options = {"held_out": HeldOut(0.0, 0, 0)}
    with pytest.raises(EpisodeError, match="(episode 1|demo_10).*(with no|without) steps"):
        take([(spec, place)], 4, **options)
    assert len(take([(spec, place)], 4, corrupt="skip", max_skipped=1, **options)) == 4


def empty(demonstration) -> None:
    """Its arrays without a row."""
    names: list[str] = []
    demonstration.visit(names.append)
    for name in [n for n in names if hasattr(demonstration[n], "dtype")]:
        nothing = demonstration[name][:0]
        del demonstration[name]
        demonstration[name] = nothing


def test_held_out_episodes_that_were_all_skipped_are_told_as_such(tmp_path):
    """As where a small part of a large dataset was fetched: the present ones are not too few, but held in."""
    directory = write_rlds(tmp_path, SPEC, [6] * 60, shards=60)
    held = np.flatnonzero(held_out(SPEC.name, RldsDataset(directory).ids, HeldOut()))
    for number in held:
        next(directory.glob(f"*-{number:05d}-of-00060")).unlink()
    with pytest.raises(
        DataError, match="all 3 held-out episodes of its 60 were skipped; val_fraction=0.05, min_val=2 and"
    ):
        make_frame_loader([(SPEC, directory)], 8, 4, 0, split="val", corrupt="skip", tau=3.0, held_out=HeldOut())


def test_wrong_arguments_are_one_clear_message(rlds):
    with pytest.raises(ConfigError, match="no dataset was given"):
        make_frame_loader([], 8, 8, 0, tau=3.0, held_out=HeldOut())
    with pytest.raises(ConfigError, match="images there"):
        make_frame_loader([(get_spec("bridge_dataset"), rlds)], 8, 8, 0, tau=3.0, held_out=HeldOut())
    with pytest.raises(ConfigError, match="but 4 were expected"):
        make_frame_loader([(make_spec("toy", (4,)), rlds)], 8, 8, 0, tau=3.0, held_out=HeldOut())
    with pytest.raises(ConfigError, match="split must be"):
        make_frame_loader([(SPEC, rlds)], 8, 8, 0, split="test", tau=3.0, held_out=HeldOut())
