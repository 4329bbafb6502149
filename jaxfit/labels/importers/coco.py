"""COCO's keypoints: pictures, annotations and categories in one JSON file."""

import json
from collections import Counter
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.errors import DatasetError, InputError
from jaxfit.labels.importers.annotations import Annotation, annotation_text, dataset_of, given_scale
from jaxfit.labels.records import Dataset
from jaxfit.schemes.known import SCHEMES
from jaxfit.schemes.own import numbered
from jaxfit.schemes.scheme import Scheme

_KIND = "COCO keypoints: a JSON object with the lists images, annotations and categories"


def read_coco(file: str | Path) -> Dataset:
    """The annotations with keypoints of a COCO file; ``file_name`` is the picture's path from the file's folder.

    Keypoints of v = 0 are missing, of 1 hidden. Of several categories with keypoints the one of most annotations
    counts; the others' annotations, crowds, and annotations without any keypoint or box become problems. Lines are the
    category's skeleton.

    Raises:
        DatasetError: the file is missing, no COCO file, nothing in it can be used, or no picture exists.
    """
    file = Path(file)
    scheme, found, problems = coco_annotations(file)
    return dataset_of(f"coco:{file}", file, found, problems, scheme=scheme)


def coco_annotations(file: Path) -> tuple[Scheme, list[Annotation], list[str]]:
    """What the keypoints of a COCO file mean, its annotations, and the problems of those that cannot be used, wherever
    their pictures are.

    Raises:
        DatasetError: the file is missing, or no COCO file with keypoints.
    """
    try:
        content = json.loads(annotation_text(file, _KIND))
        images, annotations, categories = (_objects(content, key) for key in ("images", "annotations", "categories"))
    except (ValueError, RecursionError, TypeError) as error:
        raise DatasetError(f"{file}: expected {_KIND}; {error}") from None
    names = {image.get("id"): image.get("file_name") for image in images if _is_key(image.get("id"))}
    keypoints = {
        category["id"]: category
        for category in categories
        if _is_key(category.get("id")) and isinstance(category.get("keypoints"), list) and category["keypoints"]
    }
    used = Counter(
        each["category_id"]
        for each in annotations
        if _is_key(each.get("category_id")) and each["category_id"] in keypoints
    )
    if not used:
        raise DatasetError(f"{file}: expected annotations of a category with keypoints; found none")
    chosen = used.most_common(1)[0][0]
    try:
        scheme = _scheme(keypoints[chosen])
    except (InputError, ValueError, TypeError) as error:
        name = keypoints[chosen].get("name", chosen)
        raise DatasetError(
            f"{file}, categories, {name}: expected names of keypoints, and a skeleton of pairs; {error}"
        ) from None
    found: list[Annotation] = []
    problems: list[str] = []
    for place, each in enumerate(annotations, 1):
        where = f"{file}, annotation {each.get('id', place)}"
        try:
            found.append(_annotation(each, where, names, chosen, scheme.count, problems))
        except DatasetError as error:
            problems.append(f"{where}: {error}")
    return scheme, found, problems


def _objects(content: Any, key: str) -> list[dict[str, Any]]:
    if not isinstance(content, dict):
        raise TypeError(f"got a {type(content).__name__}")
    listed = content.get(key)
    if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed):
        raise TypeError(f"{key} is no list of objects")
    return listed


def _is_key(value: object) -> bool:
    return isinstance(value, int | str)


def _scheme(category: dict[str, Any]) -> Scheme:
    names = category["keypoints"]
    if not all(isinstance(name, str) and name for name in names):
        raise TypeError(f"got keypoints {names[:3]}")
    count, of_known = len(names), names[0].removesuffix("_1")
    if of_known in SCHEMES and names == [f"{of_known}_{number}" for number in range(1, SCHEMES[of_known].count + 1)]:
        return SCHEMES[of_known]
    ends = [name.rpartition("_") for name in names]
    only_numbers = len({prefix for prefix, _, _ in ends}) == 1 and numbered([number for _, _, number in ends])
    lines = tuple((int(start) - 1, int(end) - 1) for start, end in category.get("skeleton") or ())
    return Scheme(f"points{count}", count, lines=lines, names=() if only_numbers else tuple(names))


def _annotation(
    each: dict[str, Any], where: str, names: dict[Any, Any], chosen: Any, count: int, problems: list[str]
) -> Annotation:
    image = names.get(each["image_id"]) if _is_key(each.get("image_id")) else None
    if not (isinstance(image, str) and image):
        raise DatasetError(f"expected the image_id of an image with a file_name; got {each.get('image_id')!r}")
    if each.get("category_id") != chosen:
        raise DatasetError(f"is of category {each.get('category_id')!r}; those of {chosen!r} are read")
    if each.get("iscrowd"):
        raise DatasetError("is a crowd (iscrowd), which cannot be learned from")
    points = _numbers(each.get("keypoints", []), "keypoints")
    if len(points) != 3 * count:
        raise DatasetError(f"expected {count} keypoints x, y, v; got {len(points)} numbers")
    landmarks, state = np.split(points.reshape(count, 3), [2], axis=1)
    if not np.isin(state, (0, 1, 2)).all():
        raise DatasetError("expected v of keypoints 0, 1 or 2; got another")
    landmarks = np.where(state > 0, landmarks, np.nan)
    box = None
    if each.get("bbox") is not None:
        box = _numbers(each["bbox"], "bbox")
        if len(box) != 4 or (box[2:] < 0).any():
            raise DatasetError(f"expected a bbox of x, y, width and height; got {each['bbox']!r}")
        box = np.array([*(box[:2] - 0.5), *box[2:]]) if (box[2:] > 0).all() else None  # from the first pixel's corner
    scale = each.get("scale")
    if scale is not None:
        scale = given_scale(float(_numbers([scale], "scale")[0]), where, problems)
    subject = each.get("subject")
    return Annotation(
        where,
        image,
        landmarks,
        face=str(each.get("face", "")),
        visible=state[:, 0] == 2,
        box=box,
        scale=scale,
        subject=subject if isinstance(subject, str) else "",
    )


def _numbers(values: Any, key: str) -> np.ndarray:
    good = isinstance(values, list) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in chain(values)
    )
    try:
        numbers = np.array(values if good else None, np.float64)
        if numbers.ndim == 1 and np.isfinite(numbers).all():
            return numbers
    except (TypeError, ValueError, OverflowError):
        pass
    raise DatasetError(f"expected {key} as a list of finite numbers; got {str(values)[:80]}")
