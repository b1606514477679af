"""The YAML and JSON that calibration files are written in, read without trusting them."""

from __future__ import annotations

import json
import re
from typing import Any

from camtorch.io import CameraFileError

_LARGEST_FILE = 1 << 24


def read_mapping(path) -> dict[str, Any]:
    """The keys of a YAML or JSON file. Values are text, lists and mappings: numbers stay text until someone asks.

    Raises:
        CameraFileError: no YAML or JSON, a key twice, tags other than `!!opencv-matrix`, no mapping, over 16 MiB.
        OSError: the file cannot be opened. ImportError: YAML without PyYAML.
    """
    with open(path, "rb") as file:
        content = file.read(_LARGEST_FILE + 1)
    if len(content) > _LARGEST_FILE:
        raise CameraFileError(path, "size", f"more than {_LARGEST_FILE >> 20} MiB")
    try:
        text = content.decode("utf-8-sig")
        if text.lstrip().startswith("<"):
            raise CameraFileError(path, "line 1", "XML cannot be read yet; cv2.FileStorage also writes .yml and .json")
        keys = (_from_json if text.lstrip().startswith("{") else _from_yaml)(path, text)
    except UnicodeDecodeError as error:
        raise CameraFileError(path, f"byte {error.start}", "not text") from None
    except RecursionError:
        raise CameraFileError(path, "content", "nested too deeply") from None
    if not isinstance(keys, dict):
        raise CameraFileError(path, "content", "not keys and values")
    return keys


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = dict(pairs)
    if len(keys) < len(pairs):
        names = [key for key, _ in pairs]
        raise ValueError(f"the key {max(names, key=names.count)!r:.60} stands there twice")
    return keys


def _from_json(path, text: str):
    try:
        return json.loads(text, object_pairs_hook=_unique, parse_int=str, parse_float=str, parse_constant=str)
    except json.JSONDecodeError as error:
        raise CameraFileError(path, f"line {error.lineno}", error.msg) from None
    except ValueError as error:
        raise CameraFileError(path, "content", error) from None


def _from_yaml(path, text: str):
    try:
        import yaml
    except ImportError:
        raise ImportError("reading YAML camera files needs PyYAML: pip install 'camtorch[cli]'") from None

    class Loader(yaml.SafeLoader):
        def mapping(self, node):
            if not isinstance(node, yaml.MappingNode):  # the tag says so, the value does not
                raise yaml.constructor.ConstructorError(None, None, "expected keys and values", node.start_mark)
            try:
                return _unique([(self.construct_scalar(key), self.construct_object(v, True)) for key, v in node.value])
            except ValueError as error:
                raise yaml.constructor.ConstructorError(None, None, str(error), node.start_mark) from None

        def sequence(self, node):
            return self.construct_sequence(node, deep=True)

    tag = "tag:yaml.org,2002:"
    Loader.yaml_implicit_resolvers = {}  # so that plain words and numbers are text
    Loader.yaml_constructors = {
        None: Loader.construct_undefined,
        f"{tag}str": Loader.construct_scalar,
        f"{tag}seq": Loader.sequence,
        f"{tag}map": Loader.mapping,
        f"{tag}opencv-matrix": Loader.mapping,
    }
    try:
        # "%YAML:1.0", as OpenCV writes it, is not YAML
        return yaml.load(re.sub(r"\A%YAML[^\n]*", "", text), Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "not YAML"
        raise CameraFileError(path, f"line {mark.line + 1}" if mark else "content", reason) from None
