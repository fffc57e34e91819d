"""MuJoCo models from files and texts, their parts by name, and their MJCF for writing it again.

MuJoCo itself writes the numbers of a model with six digits.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TypeAlias
from xml.etree import ElementTree

import numpy as np

from mjx_drax.base.errors import DraxError, cut, shown
from mjx_drax.physics.c_engine.states import quiet
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.motors import Actuators, add_motors

Given: TypeAlias = str | Path | mujoco.MjSpec | mujoco.MjModel
"""As what models are given: a file, MJCF or URDF, the text of one, a spec, or compiled."""

_FOLDER_OF = {"mesh": "meshdir", "hfield": "meshdir", "skin": "meshdir", "texture": "texturedir"}

_FIXES = {
    "'mujocoinclude'": "It is a part that models include: give the model's own file.",
    "Unrecognized XML model type": "Give an MJCF, which begins with <mujoco>, or a URDF.",
    "mass and inertia of moving bodies": "Give that body a <geom> with mass, or an <inertial>.",
    "Error opening file": "Put that file there, or correct the path, meshdir or texturedir.",
}
"""What to do about some of MuJoCo's error messages."""

_PACKAGE = "package://"
"""How names of meshes begin in a URDF for ROS."""

_GIVEN = ("body_", "dof_", "jnt_", "geom_", "tendon_", "actuator_", "eq_", "qpos_spring", "key_")
"""How the names of arrays begin that hold what the MJCF says; names ending in 0 are computed."""

_COUNTS = {
    "joint": "njnt",
    "site": "nsite",
    "body": "nbody",
    "geom": "ngeom",
    "actuator": "nu",
    "sensor": "nsensor",
    "keyframe": "nkey",
}


def load(source: Given, actuators: Actuators | None = None) -> mujoco.MjModel:
    """A model from a file, an XML string, a `mujoco.MjSpec` or a `mujoco.MjModel`.

    Args:
        source: the model.
        actuators: that it gets if it has none, see `motors.add_motors`.

    Raises:
        DraxError: the file is missing, MuJoCo cannot compile it, or it holds NaN.
    """
    compiled = isinstance(source, mujoco.MjModel)
    if actuators is not None and (compiled or is_binary(source)):
        raise DraxError(
            "actuators cannot be added to a model that is compiled: give its MJCF file or XML."
        )
    model = source if compiled else _compiled(source, actuators)
    _require_finite(model)
    return model


def _compiled(source: str | Path | mujoco.MjSpec, actuators: Actuators | None) -> mujoco.MjModel:
    try:
        with quiet():
            if isinstance(source, mujoco.MjSpec):
                return _spec(source.copy(), actuators).compile()  # the user's may change later
            if is_xml(source):
                if actuators is not None:
                    return _spec(source, actuators).compile()
                return mujoco.MjModel.from_xml_string(source)
            if not Path(source).is_file():
                is_folder = source != "" and Path(source).is_dir()
                what = "it is a folder; give a file in it" if is_folder else "check the path"
                raise DraxError(f"there is no model file {shown(str(source))}: {what}.")
            if is_binary(source):
                return mujoco.MjModel.from_binary_path(str(source))
            if actuators is not None or _with_mesh_paths(Path(source)):
                return _spec(source, actuators).compile()
            return mujoco.MjModel.from_xml_path(str(Path(source).absolute()))
    except DraxError:
        raise
    except TypeError as error:
        raise DraxError(
            f"the model is {shown(source)}: give an MJCF file, its XML as a text, a "
            "mujoco.MjSpec or a mujoco.MjModel."
        ) from error
    except (ValueError, OSError, mujoco.FatalError) as error:
        words = " ".join(str(error).split())
        usual = "Compile it again, with this MuJoCo." if is_binary(source) else "Correct the MJCF."
        fix = next((fix for part, fix in _FIXES.items() if part in words), usual)
        raise DraxError(
            f"MuJoCo cannot compile {shown(str(source))}: {cut(words)} {fix}"
        ) from error


def _spec(source: str | Path | mujoco.MjSpec, actuators: Actuators | None) -> mujoco.MjSpec:
    """What MuJoCo compiles, of a file, an XML string or a spec, which gets the actuators."""
    if isinstance(source, mujoco.MjSpec):
        spec = source
    elif is_xml(source):
        spec = mujoco.MjSpec.from_string(source)
    elif (urdf := _with_mesh_paths(Path(source))) is not None:
        spec = mujoco.MjSpec.from_string(urdf)
    else:  # absolute, as in `_compiled`: a model holds paths of models that it attaches
        spec = mujoco.MjSpec.from_file(str(Path(source).absolute()))
    if actuators is not None:
        add_motors(spec, actuators, spec.modelname)
    return spec


def _with_mesh_paths(path: Path) -> str | None:
    """A URDF whose meshes are named by their packages, with the files' paths; None of other files.

    ROS knows where packages are. Here a package is a folder of that name above the URDF, or beside
    one that is above it. Meshes that are only seen may be missing: MuJoCo leaves them out.

    Raises:
        DraxError: a file is not there.
    """
    text = path.read_bytes()
    if _PACKAGE.encode() not in text:
        return None
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:  # MuJoCo says what is wrong
        return None
    if root.tag != "robot":
        return None
    above = path.absolute().parents
    seen = {mesh for visual in root.iter("visual") for mesh in visual.iter("mesh")}
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if name.startswith(_PACKAGE):
            places = [folder / name[len(_PACKAGE) :] for folder in above]
            missing = "in a folder above it: put the URDF into its package, or correct the name"
        else:
            places = [above[0] / name.removeprefix("file://"), above[0] / Path(name).name]
            missing = "there: put that file there, or correct the name"
        found = next((place for place in places if place.is_file()), None)
        if found is None and mesh in seen:
            continue
        if found is None:
            raise DraxError(
                f"the URDF {shown(str(path))} names the mesh {shown(name)}, which is not {missing}."
            )
        mesh.set("filename", str(found))
    extension = root.find("mujoco")
    if extension is None:
        extension = ElementTree.SubElement(root, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(extension, "compiler")
    compiler.set("strippath", "false")
    return ElementTree.tostring(root, encoding="unicode")


def _require_finite(model: mujoco.MjModel) -> None:
    """Complain about NaN and infinite numbers in a model; MuJoCo itself only warns of them."""
    if not (np.isfinite(model.opt.timestep) and model.opt.timestep > 0):
        raise DraxError(
            f"the timestep of {model_name(model)} is {model.opt.timestep} s: give a positive one, "
            '<option timestep="0.01"/>.'
        )
    options = {f"opt.{name}": getattr(model.opt, name) for name in dir(model.opt)}
    given = [name for name in dir(model) if name.startswith(_GIVEN) and not name.endswith("0")]
    for name, value in {**options, **{name: getattr(model, name) for name in given}}.items():
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            # The ranges of a model may be infinite, its options not
            wrong = value[~np.isfinite(value) if name in options else np.isnan(value)]
            if wrong.size:
                raise DraxError(
                    f"{name} of {model_name(model)} holds {wrong[0]}: give finite numbers in the "
                    "MJCF."
                )


def model_name(model: mujoco.MjModel) -> str:
    """What the model calls itself."""
    return model.names[: model.names.index(b"\0")].decode() or "model"


def index(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Number of an element of a model: a joint, site, body, geom, actuator, sensor or keyframe.

    Raises:
        DraxError: there is none of that name; lists those that there are.
    """
    element = getattr(model, "key" if kind == "keyframe" else kind)
    names = [element(i).name for i in range(getattr(model, _COUNTS[kind]))]
    if not isinstance(name, str) or not name or name not in names:
        known = ", ".join(repr(n) for n in names if n) or "no named one; add one"
        raise DraxError(f"{model_name(model)} has no {kind} {shown(name)}: there is {known}.")
    return names.index(name)


def is_xml(given: object) -> bool:
    """Whether a model is given as its XML, not as the path of a file."""
    return isinstance(given, str) and given.lstrip().startswith("<")


def is_binary(given: object) -> bool:
    """Whether a model is given as the path of a file that MuJoCo has compiled, .mjb."""
    return not is_xml(given) and Path(str(given)).suffix.lower() == ".mjb"


def origin_of(
    given: Given, model: mujoco.MjModel, actuators: Actuators | None = None
) -> str | Path | Source | None:
    """The MJCF that a model is given as: its XML, or its file's absolute path; or None.

    Where it gets actuators: its MJCF with them.
    """
    if isinstance(given, mujoco.MjModel | mujoco.MjSpec) or is_binary(given):
        return None
    if actuators is not None:
        return Source.of(given, model, actuators)
    return given if is_xml(given) else Path(given).absolute()


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


@dataclass(frozen=True)
class Source:
    """MJCF as one text, and the bytes of the meshes, textures and height fields that it names."""

    xml: str
    assets: dict[str, bytes] = field(default_factory=dict)

    @classmethod
    def of(
        cls, given: str | Path, model: mujoco.MjModel, actuators: Actuators | None = None
    ) -> Source:
        """Of a file or an XML string, from which the model was compiled, with these actuators.

        Files that they include become part of the text; others that they name are read, and lose
        their folders.

        Raises:
            DraxError: one of the files is missing or has changed, or MuJoCo cannot read it.
        """
        try:
            spec = _spec(given, actuators)
            folders = [Path()] if is_xml(given) else _folders(Path(given))
            if binary(spec.compile()) != binary(model):
                raise DraxError("it has changed since the model was loaded.")
            root = ElementTree.fromstring(spec.to_xml())
            assets: dict[str, bytes] = {}
            kinds = {"mesh": spec.meshes, "texture": spec.textures}
            own = {(tag, each.name): each.compiler for tag in kinds for each in kinds[tag]}
            for element in (e for e in root.iter() if e.tag in _FOLDER_OF):
                compiler = own.get((element.tag, element.get("name", "")), spec)
                inside = getattr(compiler, _FOLDER_OF[element.tag])
                for attribute in [a for a in element.attrib if a.startswith("file")]:
                    path = element.attrib[attribute]
                    content = _content([folder / inside / path for folder in folders])
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


def _folders(path: Path) -> list[Path]:
    """Where a file of MJCF lies, and models that it attaches, also by files that it includes.

    What an included file names lies where it would if it stood in the whole one.
    """
    found = [path.parent]
    try:
        elements = list(ElementTree.parse(path).getroot().iter())
    except ElementTree.ParseError:  # MuJoCo is less strict
        return found
    for element in elements:
        other = path.parent / element.get("file", "")
        if element.tag in ("model", "include") and other.is_file():
            own, *attached = _folders(other)
            found += [own, *attached] if element.tag == "model" else attached
    return list(dict.fromkeys(found))


def _content(places: list[Path]) -> bytes:
    """What a file holds that lies in one of several places.

    Raises:
        OSError: there is none, or other files of that name have another content.
    """
    found = {place.read_bytes() for place in places if place.is_file()} or {places[0].read_bytes()}
    if len(found) > 1:
        raise OSError(f"files {places[0].name!r} of several of its models differ: rename one")
    return found.pop()


def _free_name(name: str, content: bytes, taken: dict[str, bytes]) -> str:
    """The name, with a number before it if another file already has it."""
    candidate, count = name, 1
    while taken.get(candidate, content) != content:
        candidate, count = f"{count}_{name}", count + 1
    return candidate
