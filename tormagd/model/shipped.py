"""The models that come with the package."""

from importlib import resources
from pathlib import Path

from tormagd.model.model_file import ModelFileError

_MODELS = resources.files(__package__) / "models"
_ENDING = ".safetensors"
LONGEST_SHOWN = 200  # characters of a refused name


def model_path(name_or_path: str, beside: Path) -> Path:
    """The file of a shipped model's name, or a path, relative to `beside`. Raises ModelFileError naming the shipped."""
    shipped = sorted(entry.name.removesuffix(_ENDING) for entry in _MODELS.iterdir() if entry.name.endswith(_ENDING))
    if name_or_path in shipped:
        return Path(str(_MODELS / f"{name_or_path}{_ENDING}"))
    path, allowed = beside / name_or_path, f"allowed is a model file or one of {', '.join(shipped)}"
    try:
        if path.exists():
            return path
    except OSError as error:  # a name that no file can have, or a directory that may not be entered
        raise ModelFileError(f"model {name_or_path[:LONGEST_SHOWN]!r}: {error.strerror}; {allowed}") from error
    raise ModelFileError(f"model {name_or_path[:LONGEST_SHOWN]!r}: {allowed}")
