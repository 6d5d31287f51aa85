"""Scenes: the shipped ones give a working core, contradictions and misfits are refused."""

from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from tormagd.config import Config, ConfigError
from tormagd.control.core import build_core
from tormagd.scenes.scene import Scene, load_scene, scene_path, shipped_scenes

BASE = {
    "name": '"bench"',
    "description": '"A scene of the tests."',
    "force.least_N": "0.0",
    "force.most_N": "2.0",
    "force.resolution_N": "0.1",
    "force.tolerance_rms_N": "0.05",
    "insert.name": '"MRE-50-40"',
    "insert.model": '"torque_mre_50_40"',
}
Write = Callable[..., str]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes the base scene with some keys changed, dropped (None) or added."""

    def write_toml(**changes: str | None) -> str:
        keys = BASE | {key.replace("__", "."): value for key, value in changes.items()}
        path = tmp_path / "scene.toml"
        path.write_text("\n".join(f"{key} = {value}" for key, value in keys.items() if value is not None))
        return str(path)

    return write_toml


def refusal(name_or_path: str) -> str:
    """What the refused scene is told."""
    with pytest.raises(ConfigError) as caught:
        load_scene(name_or_path)
    return str(caught.value)


def test_two_scenes_are_shipped() -> None:
    assert set(shipped_scenes()) >= {"coronary", "pulse"}


@pytest.mark.parametrize("name", shipped_scenes())
def test_a_shipped_scene_gives_a_core_that_can_render_it(name: str) -> None:
    core = build_core(Config(scene=name))
    assert core.scene == load_scene(name)
    assert core.scene.name == name
    assert core.scene.description.endswith(".")
    portrait = core.planner.portrait
    assert portrait.least_N < core.scene.force.most_N
    # a scene may like less than the device's least force, but nothing above its greatest
    assert portrait.most_N >= core.scene.force.most_N
    assert core.margins.phase_margin_deg >= 45.0
    assert core.margins.gain_margin_dB >= 6.0


def test_a_scene_file_is_named_by_its_path(write) -> None:
    path = write()
    assert scene_path(path) == Path(path)
    assert load_scene(path).name == "bench"
    assert build_core(Config(scene=path)).scene.name == "bench"


def test_a_scene_survives_its_own_listing() -> None:
    scene = load_scene("pulse")
    assert msgspec.convert(msgspec.to_builtins(scene), Scene) == scene


def test_an_unknown_name_lists_the_shipped_ones() -> None:
    refused = refusal("coronery")
    assert "scene = 'coronery'" in refused
    assert all(name in refused for name in shipped_scenes())


def test_a_name_that_no_file_can_have_is_refused(write) -> None:
    assert "File name too long" in refusal("x" * 300)
    with pytest.raises(ConfigError, match="File name too long"):
        build_core(Config(scene=write(insert__model=f'"{"x" * 300}"')))


@pytest.mark.parametrize(
    ("low", "low_value", "high", "high_value"),
    [
        ("force__least_N", "2.0", "force__most_N", "2.0"),
        ("force__least_N", "3.0", "force__most_N", "2.0"),
        ("force__release_N_s", "30.0", "force__most_release_N_s", "20.0"),
        ("insert__gap_closed_mm", "95.0", "insert__gap_open_mm", "45.0"),
        ("insert__gap_closed_mm", "60.0", "insert__gap_open_mm", "60.0"),
        ("insert__inner_radius_mm", "11.0", "insert__outer_radius_mm", "4.0"),
    ],
)
def test_contradictions_are_refused(write, low: str, low_value: str, high: str, high_value: str) -> None:
    refused = refusal(write(**{low: low_value, high: high_value}))
    assert f"{low.replace('__', '.')} = {float(low_value):g}" in refused
    assert f"under {high.replace('__', '.')} = {float(high_value):g}" in refused


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("force__most_N", "-1.0", ("$.force.most_N", "-1.0", "> 0.0")),
        ("force__most_N", "nan", ("force.most_N", "nan", "finite")),
        ("force__most_N", '"2"', ("$.force.most_N", "'2'", "`float`")),
        ("force__most_N", None, ("most_N", "missing")),
        ("force__strength", "1.0", ("strength", "unknown field")),
        ("insert__model", None, ("model", "missing")),
        ("solver__step_mT", "0.0", ("$.solver.step_mT", "0.0", "> 0.0")),
        ("solver__neighbours", "1.5", ("$.solver.neighbours", "1.5", "`int`")),
        ("bandwidth__inference_hz", "50", ("$.bandwidth.inference_hz", "50", ">= 83")),
    ],
)
def test_a_refusal_names_file_key_value_and_what_is_allowed(
    write, key: str, value: str | None, words: tuple[str, ...]
) -> None:
    path = write(**{key: value})
    refused = refusal(path)
    assert all(word in refused for word in (path, *words))


@pytest.mark.parametrize(
    ("key", "value", "word"),
    [
        ("insert__name", '"MRE-99-99"', "MRE-99-99"),
        ("insert__name", '"MRE-60-40"', "MRE-60-40"),
        ("insert__model", '"no_such_model"', "no_such_model"),
        ("bandwidth__control_hz", "2000", "rates.control_hz = 1000: allowed is at least 2000"),
        ("bandwidth__inference_hz", "500", "rates.inference_hz = 250: allowed is at least 500"),
        ("force__most_release_N_s", "3.0", r"allowed is at least 6.20: position.gap_speed_mm_s opens the gap by 38"),
    ],
)
def test_a_scene_that_does_not_fit_model_or_rates_gives_no_core(write, key: str, value: str, word: str) -> None:
    with pytest.raises(ConfigError, match=word):
        build_core(Config(scene=write(**{key: value})))


def test_a_model_stands_beside_its_scene(write, tmp_path: Path) -> None:
    (tmp_path / "mine.safetensors").write_bytes(b"not a model")
    with pytest.raises(ConfigError, match=r"mine\.safetensors"):
        build_core(Config(scene=write(insert__model='"mine.safetensors"')))
