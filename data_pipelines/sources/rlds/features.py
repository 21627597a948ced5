"""Parses features.json, the schema that tfds writes beside its shards, into the fields of a record.

Owns the formats of that file: the JSON of tfds's `Feature` message, and the `type` and `content` of tfds 4.0 to 4.4.
The kind of a field follows from its content. The Python classes that the file names are not imported, so that a
schema of unknown origin cannot run code.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from data_pipelines.names import quote

MAX_FIELDS = 4096
MAX_DEPTH = 32
MAX_KEY_LENGTH = 512
MAX_NUMBERS = 2**28
"""Largest number of values of one field in one step: 1 GiB of float32."""

NUMBERS = ("bool", "float16", "float32", "float64") + tuple(
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
)
"""Types whose values a record stores as numbers; values of other types are stored as bytes."""

_FORMS = {
    "featuresDict": ("FeaturesDict",),
    "sequence": ("Sequence", "Dataset"),
    "tensor": ("TensorFeature", "Tensor", "Scalar"),
    "image": ("ImageFeature", "Image", "LabeledImage"),
    "video": ("VideoFeature", "Video"),
    "classLabel": ("ClassLabel",),
    "boundingBox": ("BoundingBoxFeature", "BBoxFeature"),
    "audio": ("AudioFeature", "Audio"),
    "text": ("TextFeature", "Text"),
    "translation": ("TranslationFeature", "Translation", "TranslationVariableLanguages"),
}
"""Form of a field: its key in the message, and the last parts of the class names with this form."""

_FORM_OF = {name: form for form, names in _FORMS.items() for name in names}


@dataclass(frozen=True)
class FlatFeature:
    """A field of the schema: an image, or `size` numbers per step (0: text and the like). `encoding`: tfds's name for
    the encoding of numbers that a record stores as bytes, which are not read."""

    image: bool
    size: int
    shape: tuple[int | None, ...] = ()
    dtype: str = "string"
    encoding: str = ""

    @property
    def camera(self) -> bool:
        """Whether it is a colour or grey image; tfds stores depth as images of other types."""
        return self.image and self.dtype == "uint8"


def parse_features(schema: Any) -> dict[str, FlatFeature]:
    """Fields by the flat key under which a record holds them, as `steps/observation/image`.

    Raises ValueError, naming the field, for anything that is not a schema or exceeds this module's limits.
    """
    found: dict[str, FlatFeature] = {}
    for key, feature in _fields(schema, "", 0):
        found[key] = feature
        if len(found) > MAX_FIELDS:
            raise ValueError(f"more than {MAX_FIELDS} fields")
    return found


def _fields(node: Any, key: str, depth: int, listed: bool = False) -> Iterator[tuple[str, FlatFeature]]:
    """The fields below `node`; `listed`: it is inside a list, such as that of an episode's steps."""
    if depth > MAX_DEPTH:
        raise ValueError(f"{_field(key)}: fields are nested more than {MAX_DEPTH} levels deep")
    form, content = _content(node, key)
    if form == "featuresDict":
        children = content if "features" not in content else _mapping(content["features"], key)
        for name, child in children.items():
            if not name or not name.isprintable() or len(key) + len(name) > MAX_KEY_LENGTH:
                raise ValueError(f"{_field(key)}: a field cannot be called {quote(name)}")
            yield from _fields(child, f"{key}/{name}" if key else name, depth + 1, listed)
    elif form == "sequence":
        inner = _fields(content.get("feature"), key, depth + 1, listed=True)
        yield from ((k, _in_lists(feature)) for k, feature in inner) if listed else inner
    elif form == "translation":
        for language in _list(content.get("languages", []), key):
            yield f"{key}/{str(language)[:MAX_KEY_LENGTH]}", FlatFeature(image=False, size=0)
    elif form in ("image", "video"):
        shape = _shape(content, key) or (None, None, 3)
        image = FlatFeature(True, 0, shape[-3:], _dtype(content) or "uint8")
        yield key, _in_lists(image) if listed and form == "video" else image
    elif form == "classLabel":
        yield key, FlatFeature(False, 1, (), "int64")
    elif form == "boundingBox":
        yield key, FlatFeature(False, 4, (4,), "float32")
    elif form in ("tensor", "audio"):
        yield key, _numbers(_shape(content, key), _dtype(content), _encoding(content), key)
    else:  # text, and fields of unknown classes
        yield key, FlatFeature(image=False, size=0)


def _in_lists(feature: FlatFeature) -> FlatFeature:
    """A field of which each step has a list of variable length. A record stores it under keys other than the field's
    own (tfds calls it ragged), so it cannot be read per step."""
    return FlatFeature(False, 0, (None, *feature.shape), feature.dtype)


def _field(key: str) -> str:
    return f"field {quote(key)}" if key else "its top level"


def _content(node: Any, key: str) -> tuple[str, Mapping[str, Any]]:
    """The form of a field and its description; form "" for an unknown one."""
    node = _mapping(node, key)
    if "type" in node:
        return _old_content(node.get("proto_cls") or node["type"], node.get("content"), key)
    own = node.get("jsonFeature", node.get("json_feature"))
    if own is not None:
        return _old_content(_either(node, "pythonClassName"), _mapping(own, key).get("json"), key)
    present = [form for form in _FORMS if _either(node, form) is not None]
    if len(present) != 1:
        raise ValueError(f"{_field(key)}: it has {len(present)} descriptions, not one")
    return present[0], _mapping(_either(node, present[0]), key)


def _old_content(name: Any, content: Any, key: str) -> tuple[str, Mapping[str, Any]]:
    if not isinstance(name, str):
        raise ValueError(f"{_field(key)}: its class is missing")
    if isinstance(content, str):
        try:
            content = json.loads(content)
        except RecursionError:
            raise ValueError(f"{_field(key)}: its content is nested too deeply") from None
    return _FORM_OF.get(name.rpartition(".")[2], ""), _mapping(content or {}, key)


def _either(node: Mapping[str, Any], name: str) -> Any:
    """A field of a message by either of its two JSON names, camelCase or snake_case."""
    snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in name)
    return node.get(name, node.get(snake))


def _mapping(value: Any, key: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{_field(key)}: {quote(value)} is not a description of a field")
    return value


def _list(value: Any, key: str) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{_field(key)}: {quote(value)} is not a list")
    return value


def _shape(content: Mapping[str, Any], key: str) -> tuple[int | None, ...]:
    """Sizes; None for one that varies between records."""
    shape = content.get("shape") or []
    if isinstance(shape, dict):
        shape = shape.get("dimensions") or []
    sizes: list[int | None] = []
    for size in _list(shape, key):
        if isinstance(size, str) and len(size) <= 12 and size.isascii() and size.removeprefix("-").isdecimal():
            size = int(size)  # the JSON of a message has 64-bit numbers as strings
        if size is not None and (type(size) is not int or not -1 <= size <= MAX_NUMBERS):
            raise ValueError(f"{_field(key)}: {quote(size)} is not a valid size")
        sizes.append(None if size == -1 else size)
    if len(sizes) > 8:
        raise ValueError(f"{_field(key)}: {len(sizes)} dimensions")
    return tuple(sizes)


def _dtype(content: Mapping[str, Any]) -> str:
    dtype = content.get("dtype")
    return dtype[:32] if isinstance(dtype, str) and dtype.isprintable() else ""


def _encoding(content: Mapping[str, Any]) -> str:
    """The encoding of a tensor; "" for numbers that are stored as numbers."""
    encoding = content.get("encoding")
    return encoding[:32] if isinstance(encoding, str) and encoding.isprintable() and encoding.lower() != "none" else ""


def _numbers(shape: tuple[int | None, ...], dtype: str, encoding: str, key: str) -> FlatFeature:
    dtype = {"float": "float32", "double": "float64", "int": "int64"}.get(dtype, dtype)
    if dtype not in NUMBERS or None in shape:
        return FlatFeature(False, 0, shape, dtype if dtype in NUMBERS else "string")
    size = math.prod(shape)
    if size > MAX_NUMBERS:
        raise ValueError(f"{_field(key)}: shape {list(shape)} means {size:,} numbers in one step, which is too many")
    return FlatFeature(False, 0 if encoding else size, shape, dtype, encoding)
