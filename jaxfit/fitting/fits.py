"""The one result of fitting: what was found in pictures, which can be indexed, joined, compared and made into rows."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import PurePath
from typing import Any

import numpy as np

from jaxfit.cascade.uncertainty import region_radius
from jaxfit.data.rows import PROBLEM, Row, Rows, columns_of, flat_row, rounded
from jaxfit.errors import InputError
from jaxfit.schemes.openness import openings_of, openness
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import ANGLES

_OK = 0.5  # confidence from which a fit is rather good than not
_OPTIONAL = (
    "landmarks_3d",
    "pose",
    "scale",
    "b",
    "position",
    "rotation_vector",
    "confidence",
    "covariances",
    "visible",
)  # in the order of the columns of tables


@dataclass(frozen=True)
class Problem:
    """Why a picture, or a face in it, has no fit.

    Attributes:
        picture: the number of the picture among those given.
        name: what the picture is called; empty for arrays.
        why: a sentence.
        row: the number of the face among the fits; None: the picture has no face there.
    """

    picture: int
    name: str
    why: str
    row: int | None = None

    def __str__(self) -> str:
        return f"{self.name}: {self.why}" if self.name else self.why


@dataclass(frozen=True, eq=False, repr=False)
class Fits:
    """Fits of N faces in P pictures.

    ``fits[mask]``, ``fits[3]`` and ``fits[2:5]`` are fits of some of the faces, iteration gives one face at a time,
    each as `Fits` of length 1, and `Fits.join` puts several together. Pictures without a face have no row: they stand
    in ``problems``.

    Attributes:
        scheme: what the landmarks mean.
        names: what the P pictures are called: their files; empty for arrays.
        sizes: (P, 2) width and height of the pictures, in pixels; 0 where a picture could not be read.
        pictures: (N,) the number of each face's picture among those given.
        boxes: (N, 4) x, y, width, height of the boxes that the fits started from, in pixels.
        kinds: what drew each box.
        rotations: (N,) how far each face was turned in its picture when its fit began, in degrees, clockwise as seen.
        landmarks: (N, L, 2) float64, x right, y down, in the pixels of each picture; NaN for faces that could not be
            fitted.
        problems: of pictures without a face, and of faces that could not be fitted.
        landmarks_3d: (N, L, 3) the 3D shape in the pixels of each picture: x, y, and the depth away from the viewer,
            0 at the mean face's centroid. None, like all below, for models without 3D.
        pose: (N, 3) roll, pitch and yaw in degrees: clockwise as seen, looking up, nose to the image's left.
        scale: (N,) s of Eq. 15, pixels of the picture per pixel of the canonical face.
        b: (N, M) coefficients of the 3D shape model, ``model.space_3d.model``.
        position: (N, 3) millimetres from the camera to each head's origin, the centroid of its mean landmarks: x right,
            y down, z forward, as OpenCV's ``tvec``; None unless ``jaxfit.place_heads`` placed the heads.
        rotation_vector: (N, 3) radians, the axis times the angle by which each head is turned before the camera, as
            OpenCV's ``rvec``: 0 for a head that looks along the axis into the camera. None likewise.
        confidence: (N,) the probability, in [0, 1], that the fit is a good one, as ``jaxfit.learning.learn_confidence``
            defines it; NaN for faces that could not be fitted, None for models without a confidence.
        covariances: (N, L, 2, 2) of the landmarks' errors in x and y, in squares of the picture's pixels; `inside` says
            which true landmarks lie in the regions that they make. NaN for faces that could not be fitted, None, like
            the next, for models without an uncertainty.
        visible: (N, L) the probability, in [0, 1], that a landmark can be seen: that neither the face itself nor
            anything else hides it.
    """

    scheme: Scheme
    names: tuple[str, ...]
    sizes: np.ndarray
    pictures: np.ndarray
    boxes: np.ndarray
    kinds: tuple[str, ...]
    rotations: np.ndarray
    landmarks: np.ndarray
    problems: tuple[Problem, ...] = ()
    landmarks_3d: np.ndarray | None = None
    pose: np.ndarray | None = None
    scale: np.ndarray | None = None
    b: np.ndarray | None = None
    position: np.ndarray | None = None
    rotation_vector: np.ndarray | None = None
    confidence: np.ndarray | None = None
    covariances: np.ndarray | None = None
    visible: np.ndarray | None = None

    @property
    def fitted(self) -> np.ndarray:
        """(N,) bool: which faces were fitted, well or not."""
        return np.isfinite(self.landmarks).all((1, 2))

    @property
    def ok(self) -> np.ndarray:
        """(N,) bool: which faces were fitted, and rather well than not if the model has a confidence in its fits."""
        return self.fitted if self.confidence is None else self.fitted & (self.confidence >= _OK)

    def inside(self, landmarks: np.ndarray, share: float) -> np.ndarray:
        """(N, L) bool: whether true landmarks (N, L, 2) lie within the regions that hold this share of them, by the
        fits' covariances; False where something is not known.

        Raises:
            InputError: the fits have no covariances, or the share is not between 0 and 1.
        """
        if self.covariances is None or not 0 < share < 1:
            raise InputError(
                f"expected fits with covariances and 0 < share < 1; got a share of {share} and fits "
                f"{'without' if self.covariances is None else 'with'} covariances"
            )
        return mahalanobis(landmarks - self.landmarks, self.covariances) <= region_radius(share)

    @property
    def openness(self) -> dict[str, np.ndarray]:
        """How far the left and the right eye of the picture and the mouth are open, (N,) each, by these names: see
        `jaxfit.schemes.openness`; nothing of schemes without lids and lips."""
        names = [opening.name for opening in openings_of(self.scheme)]
        return dict(zip(names, openness(self.landmarks, self.scheme).T, strict=True))

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns of `to_dicts`."""
        return columns_of(
            self.scheme,
            self._modes,
            self.confidence is not None,
            self.position is not None,
            self.covariances is not None,
        )

    @property
    def _modes(self) -> int | None:
        return None if self.b is None else self.b.shape[1]

    def __len__(self) -> int:
        return len(self.landmarks)

    def __iter__(self) -> Iterator["Fits"]:
        return (self[row] for row in range(len(self)))

    def __getitem__(self, chosen: Any) -> "Fits":
        """Some of the faces: by number, slice, mask (N,) or numbers, in their order. The pictures stay what they are;
        problems are those of the chosen faces."""
        rows = np.arange(len(self))[chosen].reshape(-1)
        of_rows = {problem.row: problem for problem in self.problems if problem.row is not None}
        kept = [replace(of_rows[row], row=place) for place, row in enumerate(rows.tolist()) if row in of_rows]
        return replace(
            self,
            kinds=tuple(self.kinds[row] for row in rows),
            problems=tuple(kept),
            **{name: values[rows] for name, values in self.arrays.items()},
        )

    @property
    def arrays(self) -> dict[str, Any]:
        """All arrays with a row a face, by name; those that a model does not have are left out."""
        names = ("pictures", "boxes", "rotations", "landmarks", *_OPTIONAL)
        return {name: values for name in names if (values := getattr(self, name)) is not None}

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Fits):
            return NotImplemented
        return all(_same(getattr(self, field.name), getattr(other, field.name)) for field in fields(self))

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        parts = [f"{_counted(len(self), 'face')} in {_counted(len(self.names), 'picture')}"]
        parts += [_counted(self.scheme.count, "landmark")]
        parts += ["3D"] * (self.landmarks_3d is not None)
        parts += [] if self.confidence is None else [f"{int((self.fitted & ~self.ok).sum())} doubtful"]
        parts += [_counted(len(self.problems), "problem")] * bool(self.problems)
        return f"<Fits: {', '.join(parts)}>"

    @classmethod
    def join(cls, parts: Sequence["Fits"]) -> "Fits":
        """Fits of several sets of pictures as one; pictures and faces are numbered through.

        Raises:
            InputError: no parts, or fits of different models.
        """
        if not parts:
            raise InputError("expected fits to join; got none")
        models = {
            (part.scheme.name, *((name, values.shape[1:]) for name, values in part.arrays.items())) for part in parts
        }
        if len(models) > 1:
            raise InputError("expected fits of one model to join; got several landmark schemes, or 2D and 3D")
        pictures = np.cumsum([0, *(len(part.names) for part in parts)]).tolist()
        rows = np.cumsum([0, *(len(part) for part in parts)]).tolist()
        problems = [
            replace(
                problem,
                picture=problem.picture + picture,
                row=None if problem.row is None else problem.row + row,
            )
            for part, picture, row in zip(parts, pictures, rows, strict=False)
            for problem in part.problems
        ]
        arrays: dict[str, Any] = {
            name: np.concatenate([part.arrays[name] for part in parts]) for name in parts[0].arrays
        }
        shifts = np.repeat(pictures[:-1], [len(part) for part in parts])
        arrays["pictures"] = arrays["pictures"] + shifts.astype(arrays["pictures"].dtype)
        return replace(
            parts[0],
            names=sum((part.names for part in parts), ()),
            sizes=np.concatenate([part.sizes for part in parts]),
            kinds=sum((part.kinds for part in parts), ()),
            problems=tuple(problems),
            **arrays,
        )

    def rows(self, labels: Sequence[str] | None = None, problems: bool = False) -> Rows:
        """The fitted faces as nested plain values, as ``faces.jsonl`` has them; numbers are rounded to thousandths.

        Args:
            labels: for each picture, what its faces are called after: ``LABEL_1``, ``LABEL_2``; None takes the names of
                the pictures' files, without folders and suffixes.
            problems: also give a row, with a ``problem``, for each face that could not be fitted and for each picture
                without a face.
        """
        return Rows(
            self.scheme,
            self._modes,
            self.confidence is not None,
            lambda: (row for row in self._rows(labels) if problems or PROBLEM not in row),
            self.position is not None,
            self.covariances is not None,
        )

    def to_dicts(self, problems: bool = False) -> list[dict[str, Any]]:
        """The fitted faces as flat dicts with the columns of ``landmarks.csv``, and for 3D models those of
        ``heads.csv`` with ``head_`` before their names: what ``pandas.DataFrame`` and ``polars.DataFrame`` take.

        Args:
            problems: also give a row for each face that could not be fitted and each picture without a face, with a
                column ``problem``, which is empty for all others; numbers that are not known are NaN.
        """
        if not problems:
            return [flat_row(row) for row in self.rows()]
        unknown = dict.fromkeys(self.columns, np.nan)
        return [unknown | flat_row(row) | {PROBLEM: row.get(PROBLEM, "")} for row in self._rows()]

    def _rows(self, labels: Sequence[str] | None = None) -> Iterator[Row]:
        """A row for each face, and for each picture without one; those that were not fitted say why."""
        why = {problem.row: problem.why for problem in self.problems if problem.row is not None}
        faceless = [problem for problem in self.problems if problem.row is None]
        entries: list[tuple[int, int, Any]] = [(int(picture), 0, row) for row, picture in enumerate(self.pictures)]
        entries += [(problem.picture, 1, problem) for problem in faceless]
        found: Counter[int] = Counter()
        ok = self.ok.tolist()
        opened = {name: rounded(values) for name, values in self.openness.items()}
        for picture, _, entry in sorted(entries, key=lambda entry: entry[:2]):
            row: Row = {"image": self.names[picture]}
            if isinstance(entry, Problem):
                yield row | {PROBLEM: entry.why}
                continue
            found[picture] += 1
            label = PurePath(self.names[picture]).stem if labels is None else labels[picture]
            openness = {name: values[entry] for name, values in opened.items()}
            row |= {"face": f"{label}_{found[picture]}"}
            yield row | self._row(entry, picture, ok[entry], openness, why.get(entry))

    def _row(self, row: int, picture: int, ok: bool, openness: dict[str, float], problem: str | None) -> Row:
        width, height = self.sizes[picture].tolist()
        x, y, across, down = rounded(self.boxes[row])
        entry: Row = {
            "size": {"width": width, "height": height},
            "box": {"kind": self.kinds[row], "x": x, "y": y, "width": across, "height": down},
        }
        entry["box"]["rotation"] = rounded(self.rotations[row])
        entry["ok"] = ok
        if problem is not None:
            return entry | {PROBLEM: problem}
        entry["landmarks"] = rounded(self.landmarks[row])
        if openness:
            entry["openness"] = openness
        if self.confidence is not None:
            entry["confidence"] = rounded(self.confidence[row])
        if self.pose is not None and self.scale is not None and self.landmarks_3d is not None and self.b is not None:
            entry["pose"] = dict(zip(ANGLES, rounded(self.pose[row]), strict=True))
            entry["scale"] = rounded(self.scale[row])
            entry["landmarks_3d"] = rounded(self.landmarks_3d[row])
            entry["b"] = rounded(self.b[row])
        if self.position is not None and self.rotation_vector is not None:
            entry["position"] = rounded(self.position[row])
            entry["rotation_vector"] = rounded(self.rotation_vector[row])
        if self.covariances is not None and self.visible is not None:
            (xx, xy), (_, yy) = np.moveaxis(self.covariances[row], 0, -1)
            entry["covariances"] = rounded(np.stack([xx, xy, yy], -1))
            entry["visible"] = rounded(self.visible[row])
        return entry


def mahalanobis(offsets: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """(...) lengths of offsets (..., 2) in standard deviations of covariances (..., 2, 2); NaN where unknown."""
    (xx, xy), (_, yy) = np.moveaxis(covariances, (-2, -1), (0, 1))
    x, y = np.moveaxis(offsets, -1, 0)
    return np.sqrt((yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2))


def _counted(count: int, thing: str) -> str:
    return f"{count} {thing}{'' if count == 1 else 's'}"


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f" == other.dtype.kind)
    return type(one) is type(other) and bool(one == other)
