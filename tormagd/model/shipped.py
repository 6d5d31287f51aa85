"""The models that come with the package."""

from importlib import resources
from pathlib import Path

from tormagd.named_file import named, shipped

AUTO = "auto"
"The shipped model of the insert that is fitted: one of its own, or that of all inserts of its matrix."
_FOLDER, _ENDING = resources.files(__package__) / "models", ".safetensors"


def model_path(name_or_path: str, beside: Path, insert: str = "") -> Path:
    """The file of a shipped model's name, or a path, relative to `beside`; of AUTO, that of the `insert`. Raises
    ConfigError naming the shipped."""
    if name_or_path == AUTO:
        own = f"torque_{insert.lower().replace('-', '_')}"
        name_or_path = own if own in shipped(_FOLDER, _ENDING) else own.rpartition("_")[0]
    return named("insert.model", name_or_path, _FOLDER, _ENDING, beside)
