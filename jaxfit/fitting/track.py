"""Faces through videos: the landmarks of one frame start the fit of the next, and people keep their numbers."""

import math
import warnings
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np

from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.detectors import DEFAULT_DETECTOR, Detection, Detector, Search, detector_named
from jaxfit.data.detectors.detector import holds, overlap
from jaxfit.data.pictures import Images, Pixels, require_several, to_eight_bits, to_grey
from jaxfit.data.videos import DEFAULT_FRAME_RATE, Video, VideoFrame
from jaxfit.errors import ImageError, InputError
from jaxfit.fitting.fit import fit
from jaxfit.fitting.fits import Fits
from jaxfit.fitting.one_euro import OneEuro, Smoothed
from jaxfit.fitting.place import Placing, place_heads, placed_heads
from jaxfit.models.model import SQUARE, Model
from jaxfit.modes import computing
from jaxfit.shapes.pose_order import wrapped_degrees
from jaxfit.shapes.procrustes import align_similarity
from jaxfit.types import Landmarks, Scalar

# Confidence that makes a face, and that keeps it; so many frames in a row it may fall below that.
_BORN, _KEPT, _WEAK_FRAMES = 0.5, 0.3, 3
# Where models have no confidence: a face that the detector misses so many times in a row, or more often than it had
# found it before, is none.
_MISSED_DETECTIONS = 4
_SEARCH_EVERY = 3  # frames, while nobody is in view or somebody was lost
_GROWTH = 1.5  # factor by which a face's square grows or shrinks at most, from frame to frame or while lost
_STEP = 0.5  # sides that it moves at most, from frame to frame
_INSIDE = 0.5  # share of the landmarks that must lie in the picture
_SAME = 0.4  # overlap of squares from which two fits are of one face
_FOUND_AGAIN = 2.0  # seconds for which a lost face keeps its number,
_NEAR = 1.0  # sides of the face within which it may come back
_CUT_SIDE = 32  # pixels of the small copy of a frame,
_CUT = 30.0  # and their mean change, in grey levels, from which there is a cut between two frames
_SHAPE_FRAMES = 30  # from whose mean a person's shape is known
_RADIAN = 57.3  # degrees; a turn of the head by so much moves its points by about its size


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame and its faces.

    Attributes:
        number: of the frame, from 0.
        seconds: since the first frame.
        picture: the frame, as it came: from files and cameras uint8 (H, W, 3) RGB.
        faces: the N faces, smoothed if asked for; their boxes are the squares around the landmarks.
        ids: (N,) whose they are, in rising order; an id is never used again for somebody else.
        ages: (N,) frames since each person was first found, 1 in the first.
        problem: why the frame could not be used; empty if it could.
    """

    number: int
    seconds: float
    picture: Pixels
    faces: Fits
    ids: np.ndarray
    ages: np.ndarray
    problem: str = ""


def track(
    model: Model,
    frames: str | Path | int | Video | Images,
    *,
    detector: str | Detector = DEFAULT_DETECTOR,
    search: Search = Search(),
    redetect_every: int = 10,
    smoothing: OneEuro | None = None,
    frame_rate: float = DEFAULT_FRAME_RATE,
    placing: Placing | None = None,
) -> Iterator[TrackedFrame]:
    """Follow faces through a video, frame by frame, and keep track of who is who.

    A frame that cannot be used has no faces and a ``problem``, and does not stop the others. If a file was cut short,
    the part that is there is tracked, and then a warning comes.

    Args:
        model: from ``jaxfit.load``.
        frames: a video file, the number of a camera, a `jaxfit.Video`, or frames, in a list or a generator: arrays or
            PIL images as in ``jaxfit.fit``.
        detector: as in `Tracker`, like the three below.
        search: how faces are looked for.
        redetect_every: in frames.
        smoothing: ``jaxfit.OneEuro()``, or None.
        frame_rate: frames a second, if they come as arrays; files and cameras know the time.
        placing: as in `Tracker`.

    Raises:
        InputError: as `Tracker`, the video cannot be opened, or the frame rate is not positive.
    """
    if not frame_rate > 0:
        raise InputError(f"expected a frame rate above 0 a second; got {frame_rate}")
    if not isinstance(frames, str | Path | int | Video):
        require_several(frames)
    finder = detector_named(detector, search)
    tracker = Tracker(model, finder, redetect_every=redetect_every, smoothing=smoothing, placing=placing)
    # Not in the generator: what is wrong is said at once, not when the first frame is asked for.
    opened = Video(frames) if isinstance(frames, str | Path | int) else frames
    return _tracked(tracker, opened, owned=opened is not frames, frame_rate=frame_rate)


def _tracked(tracker: "Tracker", frames: Video | Images, owned: bool, frame_rate: float) -> Iterator[TrackedFrame]:
    with ExitStack() as stack:
        numbered: Iterable[VideoFrame]
        if isinstance(frames, Video):
            numbered = frames
            if owned:
                stack.enter_context(frames)
        else:
            numbered = (VideoFrame(number, number / frame_rate, frame) for number, frame in enumerate(frames))
        for frame in numbered:
            try:
                yield replace(tracker.update(frame.picture, frame.seconds), number=frame.number)
            except ImageError as error:
                yield replace(tracker.without_faces(*frame), problem=f"frame {frame.number}: {error}")
        if isinstance(frames, Video) and owned and frames.problem:
            warnings.warn(frames.problem, stacklevel=2)


class _Face(NamedTuple):
    """A face in a frame: whose it is, for how many frames, and its fit, alone."""

    id: int
    age: int
    fits: Fits


class _Square(NamedTuple):
    """Where a face was: a square (4,), how far the face was turned, in degrees, and when."""

    box: np.ndarray
    rotation: float
    seconds: float


@dataclass(eq=False)
class _Track:
    """A person in view.

    Attributes:
        id: never used again.
        born: number of the frame in which it was first found.
        last: where it was when it was last seen well.
        before: and before that.
        weak: frames in a row without confidence.
        found: how often the detector found it.
        missed: runs in a row, since, that did not.
        smoothed: of the 2D landmarks, the 3D ones and the pose, by name.
        shape: the head's coefficients, of 3D models: the mean of what some first frames say.
        shapes: how many frames.
    """

    id: int
    born: int
    last: _Square
    before: _Square | None = None
    weak: int = 0
    found: int = 1
    missed: int = 0
    smoothed: dict[str, Smoothed] = field(default_factory=dict)
    shape: np.ndarray | None = None
    shapes: int = 0

    def expected(self, seconds: float) -> np.ndarray:
        """The square (4,) where it should be, if it goes on moving as it did."""
        if self.before is None:
            return self.last.box
        share = min(1.0, (seconds - self.last.seconds) / (self.last.seconds - self.before.seconds))
        move = box_centre(self.last.box) - box_centre(self.before.box)
        return self.last.box + np.concatenate([share * move, [0, 0]])


class Tracker:
    """Several people through a video, frame by frame.

    The faces of a frame are fitted together, from where they were in the frame before. The detector looks for new faces
    when nobody is in view, when somebody was lost, and every few frames. A face is lost when its fit diverges, jumps,
    leaves the picture or gets a low confidence; one that comes back to its place within two seconds gets its number
    back. After a
    cut, everybody gets a new number.

    Args:
        model: from ``jaxfit.load``.
        detector: as in ``jaxfit.detect_faces``.
        search: how faces are looked for, by detectors that come by name.
        redetect_every: frames from one look for new faces to the next.
        smoothing: of the landmarks and the pose that come out, or None; it has no part in the fits.
        placing: the camera that heads are placed before, as by ``jaxfit.place_heads``, with a model that finds heads;
            None does not place them. The shape of a person's head is the mean of what the first 30 frames say, and
            then stays the same.

    Raises:
        InputError: there is no such detector, the model does not know how faces lie in its boxes,
            ``redetect_every`` is not positive, or the model's heads cannot be placed.
    """

    def __init__(
        self,
        model: Model,
        detector: str | Detector = DEFAULT_DETECTOR,
        *,
        search: Search = Search(),
        redetect_every: int = 10,
        smoothing: OneEuro | None = None,
        placing: Placing | None = None,
    ):
        if redetect_every < 1:
            raise InputError(f"expected redetect_every of 1 frame or more; got {redetect_every}")
        self.model = model
        if placing is not None:
            placing.unit(model)
        self.smoothing = smoothing
        self.placing = placing
        self.redetect_every = redetect_every
        self._detect = detector_named(detector, search)
        for kind in self._detect.kinds:
            model.placement(kind)
        self._tracks: list[_Track] = []  # oldest first
        self._lost: list[_Track] = []  # not longer ago than they may come back
        self._people = 0
        self._frames = 0
        self._searched = -redetect_every  # frame in which the detector looked last
        self._seconds: float | None = None
        self._small: np.ndarray | None = None

    @property
    def people(self) -> int:
        """How many people there have been so far: the ids are 1, 2, … ``people``."""
        return self._people

    def without_faces(self, number: int, seconds: float, picture: Pixels) -> TrackedFrame:
        """A frame in which nobody is seen."""
        nobody = np.empty(0, int)
        return TrackedFrame(number, seconds, picture, fit(self.model, [], []), nobody, nobody)

    def update(self, frame: Pixels, seconds: float | None = None) -> TrackedFrame:
        """The next frame and its faces.

        Args:
            frame: an array or a PIL image as in ``jaxfit.fit``.
            seconds: when it was taken; None is a thirtieth of a second after the frame before.

        Raises:
            ImageError: it is no such picture; the tracker then is as it was.
            InputError: it was not taken after the frame before.
        """
        picture = to_eight_bits(frame)
        seconds = self._time(seconds)
        number, self._frames, self._seconds = self._frames, self._frames + 1, seconds
        if self._cut(picture):
            self._tracks, self._lost, self._searched = [], [], number - self.redetect_every
        faces = self._follow(picture, number, seconds)
        self._lost = [track for track in self._lost if seconds - track.last.seconds <= _FOUND_AGAIN]
        searching = bool(self._lost) or not self._tracks
        if number - self._searched >= (min(_SEARCH_EVERY, self.redetect_every) if searching else self.redetect_every):
            self._searched = number
            faces += self._detect_new(picture, number, seconds)
        faces.sort(key=lambda face: face.id)
        empty = self.without_faces(number, seconds, frame)
        if not faces:
            return empty
        height, width = picture.shape[:2]
        return replace(
            empty,
            faces=replace(
                Fits.join([face.fits for face in faces]),
                names=("",),
                sizes=np.array([[width, height]]),
                pictures=np.zeros(len(faces), int),
            ),
            ids=np.array([face.id for face in faces]),
            ages=np.array([face.age for face in faces]),
        )

    def _time(self, seconds: float | None) -> float:
        if seconds is None:
            return 0.0 if self._seconds is None else self._seconds + 1 / DEFAULT_FRAME_RATE
        if self._seconds is not None and not seconds > self._seconds:
            raise InputError(f"expected a frame taken after {self._seconds} s; got one of {seconds} s")
        return float(seconds)

    def _cut(self, picture: np.ndarray) -> bool:
        """Whether the film was cut before this frame; changes of the light alone are no cuts."""
        small = cv2.resize(to_grey(picture), (_CUT_SIDE, _CUT_SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
        small -= small.mean()
        before, self._small = self._small, small
        return before is not None and float(np.abs(small - before).mean()) > _CUT

    def _follow(self, picture: np.ndarray, number: int, seconds: float) -> list[_Face]:
        """The faces known from the frame before."""
        tracks, self._tracks = self._tracks, []
        starts = [track.expected(seconds) for track in tracks]
        turns = [track.last.rotation for track in tracks]
        fits = fit(self.model, [picture] * len(tracks), starts, rotations=turns)
        faces = []
        for row, (track, start) in enumerate(zip(tracks, starts, strict=True)):
            square = _square_around(fits, row, picture)
            if square is None or not _within_reach(square, start, _STEP):
                self._lost.append(track)
                continue
            if self._taken(square):
                continue  # by somebody who is known for longer
            confidence = _confidence(fits, row)
            if confidence is None and track.missed >= min(track.found + 1, _MISSED_DETECTIONS):
                self._lost.append(track)
                continue
            if confidence is not None and confidence < _KEPT:
                track.weak += 1
                (self._lost if track.weak > _WEAK_FRAMES else self._tracks).append(track)
                continue
            self._tracks.append(track)
            faces.append(self._face(track, fits[row], square, number, seconds))
        return faces

    def _detect_new(self, picture: np.ndarray, number: int, seconds: float) -> list[_Face]:
        """The faces that the detector finds and nobody knew of."""
        found = [(face, self._square_of(face)) for face in self._detect(picture)]
        for track in self._tracks:
            again = any(_one_face(track.last.box, square) for _, square in found)
            track.found, track.missed = (track.found + 1, 0) if again else (track.found, track.missed + 1)
        new = [(face, sq) for face, sq in found if not any(_one_face(track.last.box, sq) for track in self._tracks)]
        found_boxes, kinds = [face.box for face, _ in new], [face.kind for face, _ in new]
        turns = [face.rotation for face, _ in new]
        fits = fit(self.model, [picture] * len(new), found_boxes, kind=kinds, rotations=turns)
        faces = []
        for row, (_, start) in enumerate(new):
            square, confidence = _square_around(fits, row, picture), _confidence(fits, row)
            sure = confidence is None or confidence >= _BORN
            if square is None or not sure or not _within_reach(square, start, _STEP) or self._taken(square):
                continue
            track = self._again(square, number, seconds)
            self._tracks = sorted([*self._tracks, track], key=lambda track: track.id)
            faces.append(self._face(track, fits[row], square, number, seconds))
        return faces

    def _again(self, square: np.ndarray, number: int, seconds: float) -> _Track:
        """The lost track that was where a face is now, begun again; or the track of somebody new."""
        near = [track for track in self._lost if _within_reach(square, track.last.box, _NEAR)]
        if near:
            track = max(near, key=lambda track: overlap(track.last.box, square))
            self._lost.remove(track)
            again = _Track(track.id, track.born, _Square(square, 0.0, seconds))
            again.shape, again.shapes = track.shape, track.shapes
            return again
        self._people += 1
        return _Track(self._people, number, _Square(square, 0.0, seconds))

    def _taken(self, square: np.ndarray) -> bool:
        """Whether somebody is known to be there."""
        return any(overlap(track.last.box, square) > _SAME for track in self._tracks)

    def _square_of(self, face: Detection) -> np.ndarray:
        """The square (4,) around the landmarks that are to be expected of a detected face."""
        centre, size = self.model.placement(face.kind).face_in(face.box, math.radians(face.rotation))
        in_squares = self.model.placement(SQUARE)
        side = size / np.exp(in_squares.log_scale)
        return np.array([*(centre - np.array(in_squares.shift) * side - side / 2), side, side])

    def _face(self, track: _Track, fits: Fits, square: np.ndarray, number: int, seconds: float) -> _Face:
        """A face that was found in this frame, which its track goes on from."""
        if seconds > track.last.seconds:
            track.before = track.last
        track.last, track.weak = _Square(square, upright_rotation(self.model, fits.landmarks[0]), seconds), 0
        smoothed: dict[str, Any] = {}
        if self.smoothing is not None:
            for name, size in {"landmarks": square[2], "landmarks_3d": square[2], "pose": _RADIAN}.items():
                if name in fits.arrays:
                    values = fits.arrays[name][0]
                    smoothed[name] = _smoothed(self.smoothing, track, name, values, seconds, size)[None]
        fits = self._placed(track, replace(fits, **smoothed))
        boxed = replace(fits, boxes=bounding_square(fits.landmarks[0])[None], kinds=(SQUARE,))
        return _Face(track.id, number - track.born + 1, boxed)

    def _placed(self, track: _Track, fits: Fits) -> Fits:
        """The fit of a face before the camera, if there is one, in the shape that its track knows until now."""
        if self.placing is None:
            return fits
        if track.shapes < _SHAPE_FRAMES:
            (found,) = placed_heads(self.model, fits, self.placing.camera).b
            if np.isfinite(found).all():
                track.shapes += 1
                track.shape = found if track.shape is None else track.shape + (found - track.shape) / track.shapes
        return place_heads(self.model, fits, self.placing, track.shape)


@computing
def upright_rotation(model: Model, landmarks: np.ndarray) -> float:
    """How far a face with these landmarks (L, 2) is turned in the picture, in degrees, clockwise as seen."""
    return math.degrees(float(_rotation(model.mean_face, landmarks)))


@jax.jit
def _rotation(mean: Landmarks, landmarks: Landmarks) -> Scalar:
    return align_similarity(landmarks - landmarks.mean(0), mean).rotation


def _smoothed(how: OneEuro, track: _Track, name: str, values: np.ndarray, seconds: float, size: float) -> np.ndarray:
    """What comes out of a track's filter of this name for new values."""
    before = track.smoothed.get(name)
    if before is None:
        now = how.start(values, seconds)
    else:
        if name == "pose":  # angles: the shorter way round
            values = before.measured + wrapped_degrees(values - before.measured)
        now = how.follow(before, values, seconds, size)
    track.smoothed[name] = now
    return wrapped_degrees(now.points) if name == "pose" else now.points


def _confidence(fits: Fits, row: int) -> float | None:
    return None if fits.confidence is None else float(fits.confidence[row])


def _square_around(fits: Fits, row: int, picture: np.ndarray) -> np.ndarray | None:
    """The square (4,) around a face's landmarks; None if it was not fitted, or lies outside the picture."""
    landmarks = fits.landmarks[row]
    if not np.isfinite(landmarks).all():
        return None
    height, width = picture.shape[:2]
    inside = ((landmarks >= 0) & (landmarks < [width, height])).all(1)
    return bounding_square(landmarks) if inside.mean() >= _INSIDE else None


def _within_reach(square: np.ndarray, other: np.ndarray, sides: float) -> bool:
    """Whether squares (4,) may be of one face that moved by at most some sides and grew or shrank a little."""
    side = max(square[2], other[2])
    moved = np.linalg.norm(box_centre(square) - box_centre(other))
    return bool(moved <= sides * side and side <= _GROWTH * min(square[2], other[2]))


def _one_face(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether a fit and a detection, squares (4,), are of the same face."""
    return overlap(one, other) > _SAME or holds(one, box_centre(other)) or holds(other, box_centre(one))
