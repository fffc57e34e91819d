"""The MJCF models that the tasks use, written for this project."""

from pathlib import Path


def path(name: str) -> Path:
    """The file of a model, by its name without .xml."""
    return Path(__file__).with_name(f"{name}.xml")
