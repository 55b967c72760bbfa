"""The JSON schema of objects.json: what is written fits it, and what it refuses is refused by the reader."""

import copy
import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from objslam.core.bodies.tag_pose import TagPose
from objslam.core.object_map import Life, MapObject, ObjectMap, SeenFrom
from objslam.errors import OutputError
from objslam.io.objects_json import dump_objects, parse_objects

SCHEMA = json.loads((Path(__file__).resolve().parents[2] / "docs" / "objects.schema.json").read_text("utf-8"))
PLAIN = MapObject(0, "cup", np.array([1.0, 2.0, 0.5]), np.eye(3) * 1e-4, "ok", 9, 8, 40.0, 0.3, 0.0, 1.0)
LIFE = Life("moved", 0.9, 3, 2, 120, 40, 86_400.0, np.array([0.0, 1.0, 0.5]))
TURNS = np.array([[0.0, 0.6, 0.0, 0.8], [0.0, 0.0, 1.0, 0.0]])
TAG = TagPose(TURNS[0], np.diag([0.01, 0.02, 0.001]), 0.16, 0.002, TURNS[1], 0.25)
FULL = replace(
    PLAIN,
    id=1,
    extent=(0.1, 0.2),
    labels={"cup": 1.0},
    existence=0.9,
    seen_from=SeenFrom(0.5, 3.0, np.eye(3)),
    life=LIFE,
    tag=TAG,
    features=np.array([0.6, -0.8, 0.0], dtype=np.float32),
)
LOST = replace(
    PLAIN, id=2, status="unresolved", covariance=None, position=np.full(3, np.nan), ray=(np.zeros(3), np.eye(3)[0])
)
GONE = replace(FULL, id=3, life=replace(LIFE, state="gone", moved_from=None))
MAP = ObjectMap((PLAIN, FULL, LOST), "site", (GONE,), np.diag([0.1, 0.1, 0.0, 1e-3, 1e-3, 1 / 3, 1e-4]))


def test_the_schema_is_one():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize("objects", [ObjectMap(()), MAP], ids=["empty", "full"])
def test_what_is_written_fits_the_schema_and_is_read_back(objects):
    text = dump_objects(objects)
    jsonschema.validate(json.loads(text), SCHEMA)
    back = parse_objects(json.loads(text))
    assert dump_objects(back) == text
    np.testing.assert_array_equal(back.shared_covariance, objects.shared_covariance)
    for one, other in zip((*objects, *objects.gone), (*back, *back.gone), strict=True):
        assert (one.seen_from is None) == (other.seen_from is None)
        assert (one.life is None) == (other.life is None)
        assert (one.tag is None) == (other.tag is None)
        assert (one.features is None) == (other.features is None)
        if one.features is not None:
            np.testing.assert_array_equal(other.features, one.features, strict=True)
        if one.tag is not None and other.tag is not None:
            np.testing.assert_array_equal(other.tag.rotation, one.tag.rotation)
            np.testing.assert_array_equal(other.tag.other, one.tag.other)
            assert (other.tag.size, other.tag.size_sigma, other.tag.other_probability) == (0.16, 0.002, 0.25)


def test_format_1_is_read():
    old = json.loads(dump_objects(ObjectMap((PLAIN,)))) | {"format": "objslam.objects/1"}
    jsonschema.validate(old, SCHEMA)
    (read,) = parse_objects(old)
    assert read.life is None
    assert read.seen_from is None


WRONG = [
    (("format",), "objslam.objects/3"),
    (("gone",), {}),
    (("shared_covariance",), [[1.0] * 6] * 7),
    (("shared_covariance",), [[None] * 7] * 7),
    (("objects", 1, "position"), [1.0, 2.0]),
    (("objects", 1, "status"), "gone"),
    (("objects", 1, "label"), ""),
    (("objects", 1, "covariance"), [[1.0]]),
    (("objects", 1, "seen_from"), [1.0, 2.0]),
    (("objects", 1, "seen_from", "near"), -1.0),
    (("objects", 1, "seen_from", "sides"), [[1.0, 0.0]]),
    (("objects", 1, "tag"), [1.0]),
    (("objects", 1, "tag", "rotation_xyzw"), [0.0, 0.0, 1.0]),
    (("objects", 1, "tag", "rotation_covariance"), [[1.0]]),
    (("objects", 1, "tag", "size"), 0.0),
    (("objects", 1, "tag", "size_sigma"), -1.0),
    (("objects", 1, "tag", "other_rotation_xyzw"), "up"),
    (("objects", 1, "tag", "other_probability"), 2.0),
    (("objects", 1, "life"), "long"),
    (("objects", 1, "life", "state"), "dead"),
    (("objects", 1, "life", "probability"), 1.5),
    (("objects", 1, "life", "sessions_seen"), -1),
    (("objects", 1, "life", "looks"), 0.5),
    (("objects", 1, "life", "moved_from"), [0.0]),
    (("gone", 0, "rays"), "many"),
    (("objects", 1, "features"), []),
    (("objects", 1, "features"), [2.0, 0.0]),
    (("objects", 1, "features"), ["a"]),
    (("objects", 1, "features"), 1.0),
]


@pytest.mark.parametrize(("path", "value"), WRONG, ids=lambda x: str(x)[:40])
def test_what_the_schema_refuses_the_reader_refuses(path, value):
    data = copy.deepcopy(json.loads(dump_objects(MAP)))
    at = data
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(data, SCHEMA)
    with pytest.raises(OutputError):
        parse_objects(data)
