"""Hand detections as EPIC-KITCHENS-100 publishes them: for each video a pickled list of protobuf messages.

Owns reading that file without trusting it: a pickle is a program, and this reader refuses to look up any name for it,
so it can make only lists and bytes. The message is the published `types.proto` (epic-kitchens-100-hand-object-bboxes),
of which only hands are declared.
"""

from __future__ import annotations

import functools
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from data_pipelines.sources.convertible import UnitError

ADVICE = "Download the file again, or leave it out with --skip-damaged."
LEFT, RIGHT = 0, 1


class _Refusing(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> NoReturn:
        raise pickle.UnpicklingError(f"it needs {module}.{name}, which a list of bytes does not")


def read_hands(path: Path, min_score: float) -> np.ndarray:
    """float64 [N, 4]: centres of the best left and right hand of frames 1..N, NaN where there is none.

    A hand counts if its score is at least `min_score`. Raises UnitError, naming the record, for anything other than N
    messages in the order of their frames.
    """
    rows = []
    for record, message in enumerate(_messages(path)):
        if message.frame_number != record + 1:
            raise UnitError(
                f"{path}: record {record} is for frame {message.frame_number}, not {record + 1}: frames are missing "
                f"or out of order. {ADVICE}"
            )
        row = np.full(4, np.nan)
        best = {LEFT: min_score, RIGHT: min_score}
        for hand in message.hands:
            if hand.side in best and hand.score >= best[hand.side]:
                best[hand.side] = hand.score
                box = hand.bbox
                row[2 * hand.side :][:2] = (box.left + box.right) / 2, (box.top + box.bottom) / 2
        rows.append(row)
    return np.reshape(rows, (-1, 4))


def _messages(path: Path) -> Iterator[Any]:
    from google.protobuf.message import DecodeError

    try:
        with open(path, "rb") as file:
            records = _Refusing(file).load()
    except OSError as error:
        raise UnitError(f"{path}: the detections cannot be read ({error.strerror}). {ADVICE}") from error
    except (pickle.UnpicklingError, EOFError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise UnitError(f"{path}: not a pickled list of bytes ({error}); it was not run. {ADVICE}") from error
    if not isinstance(records, list) or not all(isinstance(r, bytes) for r in records):
        raise UnitError(f"{path}: the pickle contains something other than a list of bytes. {ADVICE}")
    message = _detections()
    for number, record in enumerate(records):
        try:
            yield message.FromString(record)
        except DecodeError as error:
            raise UnitError(f"{path}: record {number} is not a detection message ({error}). {ADVICE}") from error


@functools.cache
def _detections() -> Any:
    """The message class `Detections`; other fields of the schema are skipped as unknown."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="hand_detections.proto", package="hands", syntax="proto3")

    def declare(name: str, *fields: tuple[str, int, int, str]) -> None:
        message = file.message_type.add(name=name)
        for field, number, kind, of in fields:
            entry = message.field.add(name=field, number=number, type=kind, label=kinds.LABEL_OPTIONAL)
            if of:
                entry.type_name = f".hands.{of}"
                entry.label = kinds.LABEL_REPEATED if field.endswith("s") else kinds.LABEL_OPTIONAL

    sides = ("left", "top", "right", "bottom")
    declare("Box", *((side, number, kinds.TYPE_FLOAT, "") for number, side in enumerate(sides, 1)))
    declare(
        "Hand",
        ("bbox", 1, kinds.TYPE_MESSAGE, "Box"),
        ("score", 2, kinds.TYPE_FLOAT, ""),
        ("side", 5, kinds.TYPE_INT32, ""),
    )
    declare(
        "Detections",
        ("frame_number", 2, kinds.TYPE_INT32, ""),
        ("hands", 3, kinds.TYPE_MESSAGE, "Hand"),
    )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("hands.Detections"))
