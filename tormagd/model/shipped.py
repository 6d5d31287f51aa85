"""The models that come with the package."""

from importlib import resources
from pathlib import Path

from tormagd.named_file import named, shipped

AUTO = "auto"
"A scene gets the model of its insert, or else of its matrix."
_FOLDER, _ENDING = resources.files(__package__) / "models", ".safetensors"


def model_path(name_or_path: str, beside: Path, insert: str = "") -> Path:
    """Return the path of a shipped model by its name, else of a file relative to `beside`."""
    if name_or_path == AUTO:
        own = f"torque_{insert.lower().replace('-', '_')}"
        name_or_path = own if own in shipped(_FOLDER, _ENDING) else own.rpartition("_")[0]
    return named("insert.model", name_or_path, _FOLDER, _ENDING, beside)
