"""The models that come with the package."""

from importlib import resources
from pathlib import Path

from tormagd.named_file import named


def model_path(name_or_path: str, beside: Path) -> Path:
    """The file of a shipped model's name, or a path, relative to `beside`. Raises ConfigError naming the shipped."""
    return named("insert.model", name_or_path, resources.files(__package__) / "models", ".safetensors", beside)
