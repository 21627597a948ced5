"""What a visitor of the page records, as MP4 and as RLDS."""

import asyncio
import io
import json
import tempfile
import threading
import zipfile

import numpy as np
import pytest

pytest.importorskip("aiohttp", reason="needs the extra `play`")

from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.writer import encode_jpeg
from experiments.applications.play import recording as recording_module
from experiments.applications.play.recording import Recording
from experiments.applications.play.server import SESSIONS
from hma_jax.simulator.robots import Robot
from tests.experiments.applications.serving import SECONDS, Player, ask, serving, until


def test_a_recording_is_a_video_and_a_dataset(tmp_path):
    async def test(client):
        player = Player(client)
        await player.enter()
        assert (await client.get(f"/recording/{player.token}/mp4")).status == 404
        assert (await ask(player.socket, type="record", on=True))["recording"]
        await player.drive(0.5, 3)
        assert (await ask(player.socket, type="rewind", frames=1))["recorded"] == 3
        await player.drive(0.45, 1)
        assert (await ask(player.socket, type="record", on=False))["recorded"] == 4
        await player.drive(0.5, 1)
        assert (await ask(player.socket, type="rewind", frames=2))["recorded"] == 4, (
            "a finished recording stays as it is"
        )

        video = await (await client.get(f"/recording/{player.token}/mp4")).read()
        import av

        with av.open(io.BytesIO(video)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert len(frames) == 4 and frames[0].shape == (32, 32, 3)

        frame = await ask(player.socket, type="start", robot="pusher", start=0)
        assert (frame["recorded"], frame["recording"]) == (4, False), "it can still be had when another episode begins"
        packed = await (await client.get(f"/recording/{player.token}/rlds")).read()
        zipfile.ZipFile(io.BytesIO(packed)).extractall(tmp_path)
        ((images, actions),) = _episodes(tmp_path / "arm_played" / "1.0.0")
        assert images.shape == (4, 8, 8, 3)
        np.testing.assert_array_equal(actions[:, 0], np.float32([0.5, 0.5, 0.45, 0.0]))

    serving(test)


def test_the_frame_that_fills_a_recording_says_so_and_it_stays_as_it_is(monkeypatch):
    monkeypatch.setattr(recording_module, "MOST_FRAMES", 4)

    async def test(client):
        player = Player(client)
        await player.enter()
        assert not (await ask(player.socket, type="record", on=True))["full"]
        frames = [await ask(player.socket, type="act", action=[0.5] * 7) for _ in range(5)]
        said = [(f["recorded"], f["recording"], f["full"]) for f in frames]
        assert said == [(2, True, False), (3, True, False)] + 3 * [(4, False, True)]
        assert (await ask(player.socket, type="rewind", frames=2))["recorded"] == 4
        assert not (await ask(player.socket, type="record", on=True))["full"], "another one begins"

    serving(test)


def test_a_recording_of_large_frames_is_full_earlier(monkeypatch):
    frame = np.random.default_rng(0).integers(256, size=(64, 64, 3), dtype=np.uint8)
    monkeypatch.setattr(recording_module, "MOST_BYTES", 4 * len(encode_jpeg(frame)))
    recording, full = Recording(Robot("arm", 2, (0.0,), (1.0,), (0.0,))), []
    for _ in range(3):
        recording.add(frame, np.zeros((2, 1)), frame)
        full.append((len(recording), recording.full))
    assert full == [(2, False), (3, False), (4, True)]


@pytest.mark.parametrize(("hz", "said"), [(10.0, 5.0), (5.0, 2.5), (0.0, None)])
def test_a_recording_says_its_rate_where_it_is_known(hz, said):
    recording = Recording(Robot("arm", 2, (0.0,), (1.0,), (0.0,), hz=hz))
    recording.add(np.zeros((8, 8, 3), np.uint8), np.zeros((2, 1)), np.zeros((8, 8, 3), np.uint8))
    metadata = json.loads(zipfile.ZipFile(io.BytesIO(recording.dataset())).read("arm_played/1.0.0/metadata.json"))
    assert metadata.get("hz") == said
    import av

    with av.open(io.BytesIO(recording.video())) as container:
        assert container.streams.video[0].average_rate == (said or 2), "the film is not in the robot's own time"


@pytest.mark.parametrize(("name", "made"), [("lab/arm", "lab_arm"), ("../x", "x"), ('a"\r\nb', "a_b")])
def test_a_robot_s_name_is_made_one_of_a_dataset_and_of_files(name, made, tmp_path, monkeypatch):
    """It was part of a path, also out of the directory of temporary files."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    recording = Recording(Robot(name, 2, (0.0,), (1.0,), (0.0,)))
    recording.add(np.zeros((8, 8, 3), np.uint8), np.zeros((2, 1)), np.zeros((8, 8, 3), np.uint8))
    names = zipfile.ZipFile(io.BytesIO(recording.dataset())).namelist()
    assert names and all(n.startswith(f"{made}_played/1.0.0/") for n in names)

    async def test(client):
        player = Player(client)
        await player.enter()
        client.server.app[SESSIONS].visitors[player.token].session.recording = recording
        for kind, file in (("mp4", f"{made}.mp4"), ("rlds", f"{made}_rlds.zip")):
            answer = await client.get(f"/recording/{player.token}/{kind}")
            assert answer.headers["Content-Disposition"] == f'attachment; filename="{file}"'

    serving(test)


def test_downloads_are_made_one_at_a_time_and_a_visitor_waits_for_two_at_most():
    async def test(client):
        player, go_on, under_way = Player(client), threading.Event(), []
        await player.enter()

        class Slow(Recording):
            def copy(self):
                return self

            def video(self):
                under_way.append(threading.current_thread().name)
                assert go_on.wait(SECONDS) and len(under_way) == 1, "two are made at once"
                return str(under_way.pop()).encode()

        recording = Slow(Robot("arm", 2, (0.0,), (1.0,), (0.0,)))
        recording.add(np.zeros((8, 8, 3), np.uint8), np.zeros((2, 1)), np.zeros((8, 8, 3), np.uint8))
        client.server.app[SESSIONS].visitors[player.token].session.recording = recording
        get = lambda: asyncio.create_task(client.get(f"/recording/{player.token}/mp4"))  # noqa: E731
        for _ in range(2):
            asked = [get() for _ in range(5)]
            await until(lambda: sum(task.done() for task in asked) == 3)
            go_on.set()
            answers = [await task for task in asked]
            assert sorted(answer.status for answer in answers) == [200] * 2 + [429] * 3
            go_on.clear()
        assert {(await a.read()).decode() for a in answers if a.status == 200} == {"downloads_0"}

    serving(test)


def _episodes(directory):
    source = RldsDataset(directory, "train")
    for i in range(len(source)):
        images = np.stack(source.frames(i, "observation/image", lambda steps: list(range(steps))))
        with source.open_episode(i, "observation/image", ["action"]) as episode:
            yield images, np.array(episode.actions)
