from typing import get_args

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from objslam.config import Loss, Settings, dump_settings, load_settings
from objslam.errors import ConfigError, ObjslamError

positive = st.floats(1e-6, 1e6)


@st.composite
def some_settings(draw):
    return Settings.model_validate(
        {
            "mode": draw(st.sampled_from(["fixed", "joint"])),
            "seed": draw(st.integers(0, 2**31)),
            "poses": {"max_gap": draw(positive)},
            "rays": {"pixel_sigma": draw(positive), "border": draw(st.floats(-100, 100))},
            "depth": {"use": draw(st.booleans()), "sigma": draw(positive)},
            "odometry": {"x_per_m": draw(st.floats(0, 10)), "floor_yaw": draw(positive)},
            "triangulation": {
                "device": draw(st.sampled_from(["auto", "cpu", "cuda"])),
                "hypotheses": draw(st.integers(1, 9999)),
            },
            "joint": {"loss": draw(st.sampled_from(get_args(Loss))), "grow_step": draw(st.integers(2, 500))},
        }
    )


def write(tmp_path, text):
    file = tmp_path / "settings.yaml"
    file.write_text(text, encoding="utf-8")
    return file


BOMB = "a: &a [x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    "text",
    [
        "mode: !!timestamp x",
        "seed: !!int ''",
        "seed: !!int _",
        "seed: !!float ''",
        "seed: !!bool x",
        "mode: !!binary 'é'",
        "mode: 2026-13-01",
        "? [a, {b: c}]\n: 1",
        "[" * 5000,
        "&a [*a]",
        "mode: &a [*a]",
        BOMB,
        "1: 2",
        "detector: [names]",
        "x" * (1 << 21),
    ],
)
def test_a_text_that_yaml_cannot_construct_is_told(tmp_path, text):
    with pytest.raises(ConfigError) as told:
        load_settings(write(tmp_path, text))
    assert len(str(told.value)) < 5000


@given(some_settings())
def test_what_is_dumped_is_read_back(tmp_path_factory, settings):
    file = write(tmp_path_factory.mktemp("config"), dump_settings(settings))
    assert load_settings(file) == settings


@given(some_settings())
def test_overrides_reach_every_setting(settings):
    data = settings.model_dump(mode="json")
    flat = [(k, v) for k, v in data.items() if not isinstance(v, dict)]
    flat += [(f"{section}.{k}", v) for section, part in data.items() if isinstance(part, dict) for k, v in part.items()]
    assert (
        load_settings(overrides=tuple(f"{key}={yaml.safe_dump(value).split(chr(10))[0]}" for key, value in flat)) == settings
    )


def test_every_setting_has_a_default_and_every_section_is_dumped():
    assert load_settings() == Settings()
    assert set(yaml.safe_load(dump_settings(Settings()))) == set(Settings.model_fields)


def test_the_later_is_the_stronger(tmp_path):
    file = write(tmp_path, "mode: joint\njoint: {loss: cauchy, grow_step: 40}\nrays:\n  pixel_sigma: 2\n")
    settings = load_settings(file, ("joint.loss=gnc", "joint.loss=huber", "poses.max_gap=1e-1"))
    assert settings.mode == "joint"
    assert settings.joint.loss == "huber"
    assert settings.joint.grow_step == 40
    assert settings.rays.pixel_sigma == 2.0
    assert settings.poses.max_gap == 0.1
    assert settings.depth == Settings().depth


def test_an_empty_file_changes_nothing(tmp_path):
    assert load_settings(write(tmp_path, "# nothing\n")) == Settings()


def test_settings_are_frozen():
    with pytest.raises(ValueError, match="frozen"):
        Settings().mode = "joint"


WRONG_FILES = {
    "joint: {los: l1}": "there is no setting joint.los",
    "speed: 3": "there is no setting speed",
    "mode: both": "mode: input should be 'auto', 'fixed' or 'joint', got 'both'",
    "poses: {max_gap: -1}": "poses.max_gap: input should be greater than 0, got -1",
    "poses: {max_gap: .inf}": "poses.max_gap: input should be a finite number",
    "rays: {border: .nan}": "rays.border: input should be a finite number",
    "seed: -1": "seed: input should be greater than or equal to 0, got -1",
    "seed: 1.5": "seed: input should be a valid integer",
    "depth: 3": "depth: input should be a valid dictionary",
    "- 1\n- 2": "the settings must be a mapping",
    "just words": "the settings must be a mapping",
    "mode: fixed\nrays: {pixel_sigma: 3": r"settings\.yaml:\d: not YAML",
    "mode: !!python/object/apply:os.system [true]": r"settings\.yaml:1: not YAML: could not determine a constructor",
    "seed: 2020-13-45": "not YAML: month must be in",
    "\tmode: fixed": r"settings\.yaml:1: not YAML",
    "1: 2": "settings.yaml",
}


@pytest.mark.parametrize("text", WRONG_FILES)
def test_a_wrong_file_is_named_with_what_is_wrong(tmp_path, text):
    with pytest.raises(ConfigError, match=WRONG_FILES[text]) as caught:
        load_settings(write(tmp_path, text))
    assert str(tmp_path / "settings.yaml") in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / "latin.yaml").write_bytes(b"mode: \xff\xfe")
    for file in (tmp_path / "absent.yaml", tmp_path, tmp_path / "latin.yaml"):
        with pytest.raises(ConfigError, match="cannot read the settings") as caught:
            load_settings(file)
        assert str(file) in str(caught.value)


WRONG_OVERRIDES = {
    "joint.loss": "is not key=value",
    "=3": "is not key=value",
    "joint.loss=l3": "joint.loss: input should be 'l1', 'huber', 'cauchy' or 'gnc', got 'l3'",
    "joint.los=l1": "there is no setting joint.los",
    "mode.x=1": "mode",
    "rays=[1": "not YAML",
    "seed=2020-13-45": "not YAML",
    "rays.pixel_sigma=": "rays.pixel_sigma: input should be a valid number, got None",
}


@pytest.mark.parametrize("text", WRONG_OVERRIDES)
def test_a_wrong_override_is_named_with_what_is_wrong(text):
    with pytest.raises(ConfigError, match=WRONG_OVERRIDES[text]) as caught:
        load_settings(overrides=("seed=1", text))
    assert text in str(caught.value)


def test_an_override_below_a_plain_value_of_the_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="mode has no keys below it"):
        load_settings(write(tmp_path, "mode: joint"), ("mode.x=1",))


def test_errors_say_where_what_and_what_to_do():
    error = ObjslamError("no pose", where="log.txt:3", hint="check the stamps")
    assert str(error) == "log.txt:3: no pose (check the stamps)"
    assert str(ObjslamError("no pose")) == "no pose"
    assert error.exit_code == 1


def test_a_mistyped_setting_is_guessed():
    with pytest.raises(ConfigError, match=r"rays\.pixel_sgima \(did you mean rays\.pixel_sigma\?\)"):
        load_settings(None, ("rays.pixel_sgima=2",))
    with pytest.raises(ConfigError, match=r"no setting nonsense \(`objslam"):
        load_settings(None, ("nonsense=2",))


def test_a_file_of_settings_that_is_too_long_is_not_cut(tmp_path):
    """Bytes count, not letters: the last line was lost behind a comment of two-byte letters."""
    file = tmp_path / "long.yaml"
    file.write_text("# " + "é" * 600_000 + "\nseed: 5\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"long.yaml.*longer than 1,048,576 bytes"):
        load_settings(file, ())
