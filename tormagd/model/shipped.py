"""The models that come with the package."""

from importlib import resources
from pathlib import Path

from tormagd.named_file import named, shipped

AUTO = "auto"
"In a scene, the shipped model for its insert: the insert's own, or that of all inserts of its matrix."
_FOLDER, _ENDING = resources.files(__package__) / "models", ".safetensors"


def model_path(name_or_path: str, beside: Path, insert: str = "") -> Path:
    """Return the path of a model file: a shipped one by its name, else a path relative to `beside`; a shipped name goes
    first."""
    if name_or_path == AUTO:
        own = f"torque_{insert.lower().replace('-', '_')}"
        name_or_path = own if own in shipped(_FOLDER, _ENDING) else own.rpartition("_")[0]
    return named("insert.model", name_or_path, _FOLDER, _ENDING, beside)
