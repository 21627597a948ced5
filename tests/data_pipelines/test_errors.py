"""What messages about damaged data say to whom."""

from __future__ import annotations

import pytest

from data_pipelines.errors import CorruptRecordError, without_advice
from data_pipelines.sources import robomimic, video
from data_pipelines.sources.human import detections

ADVISED = [
    f"u4.mp4: no readable video (moov atom not found). {video.ADVICE}",
    f"toy.hdf5: data/demo_1/actions cannot be read (truncated; at byte 9). {robomimic.ADVICE}",
    f"P01_01.pkl: record 3 is no detection message (wrong wire type). {detections.ADVICE}",
    str(CorruptRecordError("toy-train.tfrecord-00000-of-00001", 0, "the checksum is wrong")),
    "toy, episode 3 (a.tfrecord, byte 0): 'action' is not finite at step 7: [nan]. Repair the episode, or read with "
    "corrupt='skip'.",
    "toy, episode 3 (a.parquet) cannot be decoded: no image. Repair it, or read with corrupt='skip'.",
    "toy, episode 3 (a.parquet) has 9 rows, but the meta folder says 8. Fetch the dataset again, or leave the episode "
    "out with corrupt='skip'.",
    "toy, episode 3 (a.tfrecord, byte 0): it has no frames in 'image'; leave it out with corrupt='skip'",
    "toy.hdf5: data/demo_1: the camera has 3 frames; leave it out with corrupt='skip'.",
    "arm/meta: total_episodes is 3. Download the meta folder again, or leave them out with --set store.corrupt=skip "
    "(`hma data convert`: --skip-damaged), or write 2 there.",
]
"""As the readers of every format say it."""

OTHERS = [
    "fewer than 4 frames in a row with both hands in them",
    "/data/toy: the shard is missing. Download it again, or check the path.",
    "toy/0: 'action' is not finite at step 1: [0.0, nan].",
]


@pytest.mark.parametrize("message", ADVISED)
def test_advice_to_leave_damage_out_is_taken_off_and_the_rest_is_a_sentence(message):
    rest = without_advice(message)
    assert rest.endswith(".") and message.startswith(rest[:-1]) and message[len(rest) - 1] in ".;"
    assert "skip" not in rest and "leave" not in rest and "Fetch" not in rest and "Repair" not in rest


@pytest.mark.parametrize("message", OTHERS)
def test_messages_that_do_not_advise_it_stay_as_they_are(message):
    assert without_advice(message) == message
