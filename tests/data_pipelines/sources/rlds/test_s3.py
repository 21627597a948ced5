"""Datasets in S3, by moto's server on this machine: slow, failing, and gone for a while."""

from __future__ import annotations

import numpy as np
import pytest

from data_pipelines.errors import UnreachableError
from data_pipelines.inspection.inspect import inspect_dataset
from data_pipelines.sources.rlds import location
from data_pipelines.sources.rlds.dataset import RldsDataset
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset
from tests.files import contents

pytest.importorskip("moto")
s3fs = pytest.importorskip("s3fs")
pytest.importorskip("upath")

SPEC = make_spec(hz=4)
URL = "s3://bucket/data/toy"


@pytest.fixture(scope="module")
def server():
    from tests.stress.s3_server import serve

    with serve() as running:
        yield running


@pytest.fixture
def store(server, tmp_path, monkeypatch):
    """The server with a dataset at URL; the local copy's version directory."""
    for name, value in (server.environment | {"AWS_MAX_ATTEMPTS": "1"}).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("HMA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(location, "RETRY_WAITS", (0.01, 0.05, 0.1, 0.2))
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)  # ours are what is tested
    s3fs.S3FileSystem.clear_instance_cache()
    local = write_rlds(tmp_path, SPEC, [5, 6, 7, 8, 9, 10, 11, 12], shards=4)
    fs = s3fs.S3FileSystem()
    if not fs.exists("bucket"):
        fs.mkdir("bucket")
    fs.put(str(local), "bucket/data/toy/1.0.0", recursive=True)
    yield local
    server.tell()
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.mark.parametrize("failing", [0.0, 0.1])
def test_slow_and_failing_store_gives_the_same_index_episodes_and_facts(store, server, failing):
    server.tell(latency=0.005, failing=failing)
    here, there = RldsDataset(store), RldsDataset(URL)
    assert there.fingerprint() == here.fingerprint() and len(there) == 8
    for i in (7, 0):
        a, b = (d.episode(i, SPEC.image_key, SPEC.action_keys) for d in (here, there))
        assert np.array_equal(a.images, b.images) and np.array_equal(a.actions, b.actions)
    facts, expected = (inspect_dataset(where).facts for where in (URL, str(store)))
    assert facts.directory == f"{URL}/1.0.0" and facts.steps == expected.steps
    assert repr(facts.actions) == repr(expected.actions)  # some of their figures are NaN


def test_index_of_a_remote_dataset_is_kept(store, server):
    RldsDataset(URL)
    server.tell()
    RldsDataset(URL)
    assert server.tell() < 10  # the metadata and a listing, no shard


def test_failing_store_gives_the_same_tokens(store, server, tmp_path):
    tokenize_dataset(SPEC, store, FakeTokenizer(), tmp_path / "a")
    server.tell(failing=0.05)
    tokenize_dataset(SPEC, URL, FakeTokenizer(), tmp_path / "b")
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_tokenising_goes_on_after_the_store_was_gone(store, server, tmp_path, monkeypatch):
    """It stops in the middle, which costs no episode, also under the policy that leaves damage out."""
    tokenize_dataset(SPEC, store, FakeTokenizer(), tmp_path / "a", part_size=1)

    monkeypatch.setattr(location, "RETRY_WAITS", (0.01,))

    class Failing(FakeTokenizer):
        calls = 0

        def encode(self, images):
            self.calls += 1
            server.tell(failing=float(self.calls >= 3))
            return super().encode(images)

    with pytest.raises(UnreachableError, match="s3://bucket.* run the same command again"):
        tokenize_dataset(SPEC, URL, Failing(), tmp_path / "b", corrupt="skip", part_size=1, batch=8)
    server.tell()
    s3fs.S3FileSystem.clear_instance_cache()
    manifest = tokenize_dataset(SPEC, URL, FakeTokenizer(), tmp_path / "b", corrupt="skip", part_size=1)
    assert manifest.skipped_count == 0
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_inspect_command_takes_a_url(store, tmp_path, capsys):
    from experiments.cli.main import main

    main(["data", "inspect", URL, "--hz", "4", "--out", str(tmp_path / "seen")])
    assert f"{URL}/1.0.0" in capsys.readouterr().out and (tmp_path / "seen" / "contact_sheet.png").exists()


def test_dataset_that_is_not_there_is_named(store):
    from data_pipelines.errors import DataError

    with pytest.raises(DataError, match="s3://bucket/data/other: no such directory"):
        RldsDataset("s3://bucket/data/other")
