"""Results of face and body detectors as fields of a sample; the detectors themselves are not imported."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from camtorch.augment.sample import Sample
from camtorch.values.arguments import as_known_size, shown


def from_mediapipe(result: Any, image_size: Sequence[int]) -> Sample:
    """Return the faces of a result of MediaPipe's face mesh.

    For a mirror: `landmarks="mediapipe478"`, or `"mediapipe468"` of `FaceMesh(refine_landmarks=False)`. MediaPipe's x
    is 0 at the left edge of the image and 1 at the right one, so a pixel is x W - 0.5. Its depths z are left out.

    Args:
        result: A result of `FaceLandmarker`, or of `mp.solutions.face_mesh` or `holistic`.
        image_size: (height, width) of the image that was searched.

    Returns:
        `keypoints` (F, K, 2), and `boxes` (F, 4) around them, of F faces. Without a face: (0, 478, 2) and (0, 4).

    Raises:
        TypeError: If it is the result of something else, such as of MediaPipe's face detector or hands.

    Example:
        >>> from types import SimpleNamespace
        >>> nobody = SimpleNamespace(face_landmarks=[])  # or landmarker.detect(mp_image)
        >>> {name: tuple(value.shape) for name, value in ct.data.from_mediapipe(nobody, (480, 640)).items()}
        {'keypoints': (0, 478, 2), 'boxes': (0, 4)}
    """
    height, width = as_known_size(image_size, "from_mediapipe")
    known = [name for name in ("multi_face_landmarks", "face_landmarks") if hasattr(result, name)]
    if not known:
        wanted = "one of FaceLandmarker or of mp.solutions.face_mesh, with face_landmarks or multi_face_landmarks"
        raise TypeError(f"from_mediapipe: result must be {wanted}; got {shown(result)}")
    faces = getattr(result, known[0]) or []
    faces = [faces] if hasattr(faces, "landmark") else faces  # holistic has one
    rows = [[(p.x * width - 0.5, p.y * height - 0.5) for p in getattr(face, "landmark", face)] for face in faces]
    keypoints = _stacked(rows, 478, 2)
    return {"keypoints": keypoints, "boxes": torch.cat((keypoints.amin(1), keypoints.amax(1)), -1)}


def from_insightface(faces: Any) -> Sample:
    """Return the faces that InsightFace's `FaceAnalysis.get` found.

    The landmarks are the 106 of `landmark_2d_106` if all faces have them, else the 68 of `landmark_3d_68`, else the
    five of `kps`. For a mirror: `landmarks="insightface106"`, `"ibug68"`, or the pairs `[(0, 1), (3, 4)]`. The 106 and
    68 count from the middle of the first pixel; boxes and `kps` count from the edge of the image, so half a pixel is
    taken off.

    Args:
        faces: The list, or one face of it.

    Returns:
        `keypoints` (F, K, 2) and `boxes` (F, 4) of F faces. Without a face: (0, 0, 2) and (0, 4).

    Raises:
        TypeError: If it is something else.
    """
    found = _listed(faces, "bbox", "from_insightface", "faces", "FaceAnalysis.get")
    sample: Sample = {"boxes": _stacked([face.bbox for face in found], 4) - 0.5}
    for name, shift in (("landmark_2d_106", 0.0), ("landmark_3d_68", 0.0), ("kps", 0.5)):
        points = [getattr(face, name, None) for face in found]
        if all(p is not None for p in points):
            return {"keypoints": _stacked(points, 0, 2) - shift, **sample}
    return sample


def from_ultralytics(results: Any) -> Sample:
    """Return the people or faces that an Ultralytics model found in one image.

    To mirror the keypoints of a person, pass `landmarks="coco17"` to `HorizontalFlip`. Ultralytics counts from the edge
    of the image, so half a pixel is subtracted. All tensors are on the CPU.

    Args:
        results: The `Results` of one image, or the list of one that `model(image)` returns.

    Returns:
        `boxes` (F, 4), and of a pose model `keypoints` (F, K, 2) and `keypoints_valid` (F, K), True if the confidence
        is at least 0.5.

    Raises:
        TypeError: If it is something else. ValueError: If there are several images.
    """
    found = _listed(results, "boxes", "from_ultralytics", "results", "an Ultralytics model with boxes")
    if len(found) != 1:
        way = "[ct.data.from_ultralytics(one) for one in results] takes each"
        raise ValueError(f"from_ultralytics: results must be of one image; got {len(found)}. {way}")
    boxes = _tensor(found[0].boxes.xyxy).reshape(-1, 4) - 0.5
    keypoints = getattr(found[0], "keypoints", None)
    if keypoints is None:
        return {"boxes": boxes}
    sample: Sample = {"keypoints": _tensor(keypoints.xy)[: len(boxes)] - 0.5, "boxes": boxes}
    if getattr(keypoints, "conf", None) is not None:
        sample["keypoints_valid"] = _tensor(keypoints.conf)[: len(boxes)] >= 0.5
    return sample


def from_dlib(shapes: Any) -> Sample:
    """Return the faces of dlib's `shape_predictor`.

    To mirror its 68 landmarks, pass `landmarks="ibug68"` to `HorizontalFlip`. dlib counts from the middle of the first
    pixel, as camtorch does.

    Args:
        shapes: A list of `full_object_detection`, or one.

    Returns:
        `keypoints` (F, K, 2), and `boxes` (F, 4), the rectangles that the predictor was given, of F faces. Without a
        face: (0, 0, 2) and (0, 4).

    Raises:
        TypeError: If it is something else, such as dlib's rectangles alone.
    """
    found = _listed(shapes, "part", "from_dlib", "shapes", "dlib's shape_predictor")
    points = [[(s.part(i).x, s.part(i).y) for i in range(s.num_parts)] for s in found]
    boxes = [(r.left(), r.top(), r.right(), r.bottom()) for r in (s.rect for s in found)]
    return {"keypoints": _stacked(points, 0, 2), "boxes": _stacked(boxes, 4)}


def _listed(value: Any, attribute: str, owner: str, name: str, source: str) -> list[Any]:
    """Return the items of a list, or the only one, all of which have the attribute."""
    try:
        items = [value] if getattr(value, attribute, None) is not None else list(value)
    except TypeError:
        items = [value]
    for item in items:
        if getattr(item, attribute, None) is None:
            raise TypeError(f"{owner}: {name} must come from {source}, with {attribute}; got {shown(item)}")
    return items


def _stacked(items: list[Any], *shape: int) -> Tensor:
    """Return float32 (F, *shape) on the CPU, the first two coordinates of points; without items (0, *shape)."""
    tensors = [_tensor(item)[..., : shape[-1]] for item in items]
    return torch.stack(tensors) if items else torch.zeros(0, *shape)


def _tensor(values: Any) -> Tensor:
    """Return a copy as float32 on the CPU; what inference mode made becomes a plain tensor."""
    return torch.as_tensor(values, dtype=torch.float32, device="cpu").detach().clone()
