"""How faces are found and fitted: the settings, whatever the model, and what the stream makes of them for a model."""

from dataclasses import dataclass, field
from typing import Any

from jaxfit.cascade.starts import Starts
from jaxfit.data.detectors import DEFAULT_DETECTOR, DETECTORS, Detector, Search, detector_named
from jaxfit.data.detectors.whole import KIND as WHOLE
from jaxfit.data.pictures import Read
from jaxfit.errors import InputError
from jaxfit.models.model import Model


@dataclass(frozen=True)
class Pipeline:
    """How pictures are fitted with a model; usually made by `Fitting`.

    Attributes:
        model: from ``jaxfit.load``.
        detector: finds the faces of pictures that come without boxes; None where all have them.
        starts: of each face.
        passes: how often the cascade is run, each time from where the pass before found the face.
        read: makes an array of a picture's file, or of its bytes; None turns pictures upright as their EXIF data say,
            and reads colours only if the detector looks at them.

    Raises:
        InputError: no passes, or a detector whose boxes the model does not know.
    """

    model: Model
    detector: Detector | None = None
    starts: Starts = field(default_factory=Starts)
    passes: int = 1
    read: Read | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.model, Model):
            raise InputError(f"expected a model, as jaxfit.load gives it; got {self.model!r:.60}")
        if self.passes < 1:
            raise InputError(f"expected at least one pass of the cascade; got {self.passes}")
        for kind in () if self.detector is None else self.detector.kinds:
            self.model.placement(kind)


def require_fitting(fitting: Any) -> None:
    """Check that it is a `Fitting`: a detector's name alone would be missed only when the work has begun.

    Raises:
        InputError: it is none.
    """
    if not isinstance(fitting, Fitting):
        raise InputError(f"expected jaxfit.Fitting(detector=...), how faces are found and fitted; got {fitting!r:.60}")


def usual_detector(model: Model) -> str:
    """What finds the objects of a model unless a detector is named: the default detector of faces; of models that do
    not
    know its boxes but those of whole pictures, nothing: the picture is the object."""
    known = model.known_placements
    no_face = not {*DETECTORS[DEFAULT_DETECTOR].kinds} & known.keys()
    return WHOLE if no_face and WHOLE in known else DEFAULT_DETECTOR


@dataclass(frozen=True)
class Fitting:
    """How faces are found and fitted, with any model: the settings of folder runs, workers and commands.

    Attributes:
        detector: what finds the faces of pictures without boxes: its name, as in ``jaxfit.detect_faces``, or a detector
            of your own; None is the usual one for the model: yunet, or whole.
        search: how it looks for them, if it comes by name.
        starts: of each face.
        passes: how often the cascade is run, each time from where the pass before found the face; None: twice from the
            boxes of rough detectors, and once from all others.
    """

    detector: str | Detector | None = None
    search: Search = field(default_factory=Search)
    starts: Starts = field(default_factory=Starts)
    passes: int | None = None

    def finder(self, model: Model | None = None) -> Detector:
        """The detector; if none is named, the one that is usual for the model.

        Raises:
            InputError: as ``jaxfit.data.detector_named``.
        """
        usual = None if model is None else usual_detector(model)
        return detector_named(self.detector or usual, self.search)

    def passes_from(self, rough: bool) -> int:
        """How often the cascade is run from boxes that are ``rough`` or not, as `Detector` says."""
        if self.passes is not None:
            return self.passes
        return 2 if rough else 1

    def pipeline(self, model: Model, read: Read | None = None) -> Pipeline:
        """The pipeline for pictures in which a detector finds the faces.

        Raises:
            InputError: there is no such detector, the model does not know its boxes, or there are no passes.
        """
        finder = self.finder(model)
        return Pipeline(model, finder, self.starts, self.passes_from(finder.rough), read)

    def pipeline_in_boxes(self, model: Model, rough: bool = False, read: Read | None = None) -> Pipeline:
        """The pipeline for pictures that come with boxes, which are ``rough`` or not.

        Raises:
            InputError: there are settings of how faces are found, or no passes.
        """
        self.require_given_boxes()
        return Pipeline(model, None, self.starts, self.passes_from(rough), read)

    def require_given_boxes(self) -> None:
        """Check that no setting says how faces are found, because boxes are given.

        Raises:
            InputError: one does.
        """
        if self.detector is not None:
            raise InputError("expected boxes or a detector that finds them; got both")
        if self.search != Search():
            raise InputError(
                "expected boxes, or how faces are looked for (smallest, score, any rotation); got both: leave out one"
            )

    def settings(self) -> dict[str, Any]:
        """The settings as JSON values, called like the command's options, for runs that go on only with the same.

        Raises:
            InputError: the detector does not come by name.
        """
        if not isinstance(self.detector, str | None):
            raise InputError(
                "expected the name of a detector, as runs that go on later and workers need it; jaxfit.fit and "
                "jaxfit.track take a detector of your own"
            )
        starts = {"starts": self.starts.count, "rotations": [self.starts.low, self.starts.high]}
        values = {"detector": self.detector, **vars(self.search), **starts}
        return values if self.passes is None else values | {"passes": self.passes}
