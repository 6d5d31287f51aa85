"""`tormagctl scene`: which scenes there are, and what one of them asks for."""

import msgspec

from tormagd.config import ConfigError
from tormagd.ctl.outcome import Outcome, usage_error
from tormagd.scenes.scene import load_scene, shipped_scenes


def list_scenes() -> Outcome:
    """The shipped scenes with their descriptions."""
    scenes = [load_scene(name) for name in shipped_scenes()]
    width = max(len(scene.name) for scene in scenes)
    return Outcome(
        {"scenes": [{"name": scene.name, "description": scene.description} for scene in scenes]},
        "\n".join(f"{scene.name:<{width}}  {scene.description}" for scene in scenes),
    )


def show_scene(name: str) -> Outcome:
    """Everything one scene states, defaults included. Raises CommandError (USAGE) for an unknown or faulty one."""
    try:
        tables = msgspec.to_builtins(load_scene(name))
    except ConfigError as error:
        raise usage_error(str(error), "tormagctl scene list shows the shipped ones") from error
    lines = [_line(key, value) for key, value in tables.items() if not isinstance(value, dict)]
    for title, table in tables.items():
        if isinstance(table, dict):
            lines += ["", f"[{title}]", *(_line(key, value) for key, value in table.items())]
    return Outcome(tables, "\n".join(lines))


def _line(key: str, value: object) -> str:
    # a number or a text reads the same in JSON and TOML
    return f"{key} = {msgspec.json.encode(value).decode()}"
