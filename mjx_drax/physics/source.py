"""Where a model came from, as MJCF that can be written again, with the files it needs.

MuJoCo writes the numbers of a model with six digits.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import numpy as np

from mjx_drax.base.errors import DraxError
from mjx_drax.physics._mujoco import mujoco

_FOLDER_OF = {"mesh": "meshdir", "hfield": "meshdir", "skin": "meshdir", "texture": "texturedir"}


@dataclass(frozen=True)
class Source:
    """MJCF as one text, and the bytes of the meshes, textures and height fields that it names."""

    xml: str
    assets: dict[str, bytes] = field(default_factory=dict)

    @classmethod
    def of(cls, given: str | Path, model: mujoco.MjModel) -> Source:
        """Of a file or an XML string, from which the model was compiled.

        Files that they include become part of the text; others that they name are read, and lose
        their folders.

        Raises:
            DraxError: one of the files is missing or has changed, or MuJoCo cannot read it.
        """
        try:
            if is_xml(given):
                spec, folder = mujoco.MjSpec.from_string(given), Path()
            else:
                spec, folder = mujoco.MjSpec.from_file(str(given)), Path(given).parent
            if binary(spec.compile()) != binary(model):
                raise DraxError("it has changed since the model was loaded.")
            root = ElementTree.fromstring(spec.to_xml())
            assets: dict[str, bytes] = {}
            folders = {kind: folder / getattr(spec, where) for kind, where in _FOLDER_OF.items()}
            for element in (e for e in root.iter() if e.tag in _FOLDER_OF):
                for attribute in [a for a in element.attrib if a.startswith("file")]:
                    path = element.attrib[attribute]
                    content = (folders[element.tag] / path).read_bytes()
                    name = _free_name(PurePosixPath(path).name, content, assets)
                    element.attrib[attribute], assets[name] = name, content
        except (ValueError, OSError) as error:
            what = "the model's XML" if is_xml(given) else str(given)
            raise DraxError(f"{what} cannot be read again: {error}") from error
        source = cls(ElementTree.tostring(root, encoding="unicode"), assets)
        return source.in_folder("")

    def in_folder(self, folder: str) -> Source:
        """The same, looking for its files in a folder, relative to that of the MJCF file."""
        root = ElementTree.fromstring(self.xml)
        for compiler in root.iterfind("./compiler"):
            for name in ("meshdir", "texturedir", "assetdir"):
                compiler.attrib.pop(name, None)
            if folder:
                compiler.attrib["assetdir"] = folder
        return Source(ElementTree.tostring(root, encoding="unicode"), self.assets)

    def compiled(self) -> mujoco.MjModel:
        """The model.

        Raises:
            ValueError: MuJoCo cannot compile it.
        """
        return mujoco.MjModel.from_xml_string(self.xml, dict(self.assets))


def is_xml(given: object) -> bool:
    """Whether a model is given as its XML, not as the path of a file."""
    return isinstance(given, str) and given.lstrip().startswith("<")


def is_binary(given: object) -> bool:
    """Whether a model is given as the path of a file that MuJoCo has compiled, .mjb."""
    return not is_xml(given) and Path(str(given)).suffix.lower() == ".mjb"


def binary(model: mujoco.MjModel) -> bytes:
    """The compiled model, as only the same version of MuJoCo reads it."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def from_binary(content: bytes) -> mujoco.MjModel:
    """The model that `binary` gave.

    Raises:
        ValueError: another version of MuJoCo wrote it.
    """
    return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": content})


def _free_name(name: str, content: bytes, taken: dict[str, bytes]) -> str:
    """The name, with a number before it if another file already has it."""
    candidate, count = name, 1
    while taken.get(candidate, content) != content:
        candidate, count = f"{count}_{name}", count + 1
    return candidate
