"""Fine-tuning a model on labelled faces: pictures to crops, people kept aside, then the whole cascade at once."""

import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from safetensors.numpy import load as parse_tensors

from jaxfit.cascade.greedy import TrainingSet
from jaxfit.cascade.tuning import Progressed, Tuning, finetune_cascade
from jaxfit.data.boxes import bounding_square
from jaxfit.data.pictures import Read, read_grey
from jaxfit.errors import InputError, ModelError
from jaxfit.heads.model import DEFAULT_HEAD_MODEL, load_head_model
from jaxfit.image.disturb import Disturbance
from jaxfit.labels.aligned import align_labels
from jaxfit.labels.lifting import Lifted, fill_labels
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.prepare import cut_labelled, training_set, usable_faces
from jaxfit.models.digests import digest_set, union
from jaxfit.models.files import DAMAGE, read_header, tensors_of, write_tensors
from jaxfit.models.model import SQUARE, Model
from jaxfit.modes import computing
from jaxfit.processes import require_alone
from jaxfit.schemes.scheme import Scheme, mirror_order
from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.types import Progress, silent

_CHECKPOINT = "jaxfit-finetuning"
_FORMAT = 2
_VARIANCE = 0.99  # of the head model that says how faces are turned
_BAND = 15.0  # degrees of yaw within which faces count as alike


@dataclass(frozen=True)
class Finetuned:
    """What fine-tuning gives.

    Attributes:
        model: the model; it has no confidence, as the old one does not know its fits.
        faces: number of faces it learned from, mirrored ones not counted.
        errors: (epochs + 1,) mean distance of the landmarks from the true ones on the people kept aside, in sides of
            the face, before and after each epoch; NaN if nobody was.
        problems: what was left out and why, a sentence each.
    """

    model: Model
    faces: int
    errors: np.ndarray
    problems: tuple[str, ...]


@computing
def finetune(
    model: Model,
    faces: Sequence[FaceRecord],
    *,
    tuning: Tuning = Tuning(),
    validation: float = 0.1,
    mirror: bool = True,
    head_model: str | Path = DEFAULT_HEAD_MODEL,
    checkpoint: str | Path | None = None,
    progress: Progress = silent,
    read: Read = read_grey,
) -> Finetuned:
    """Tune all steps of a trained model together, by stochastic gradients of the error that they leave in the end.

    Faces with missing landmarks teach those that they have. A 3D head model, which must have the model's landmarks,
    says where such a face lies; faces that it does not explain are left out and reported, like unreadable pictures.
    Starts are drawn as in training: turned, too, if the model was made for several initialisations.

    Args:
        model: a trained model.
        faces: labelled faces, with the model's landmarks.
        tuning: how.
        validation: share of the people who are kept aside to choose the best epoch by; with 0 the last one is taken.
        mirror: learn from mirrored pictures too.
        head_model: 3D head model, a bundled one's name or a file, that says where faces with missing landmarks lie, and
            how faces are turned, if they are balanced by that (``tuning.balance``).
        checkpoint: a file that is written after each epoch; if it exists, fine-tuning goes on from there.
        progress: called with a stage's name, what is done and what there is to do.
        read: gets a picture's path and returns it grey, uint8 (H, W); ``GreyPictures()`` remembers them.

    Raises:
        InputError: labels of another number of landmarks, a share out of range, too few faces or people, landmarks
            that cannot be mirrored, fits that run away, a checkpoint of something else, or several processes.
        ModelError: a damaged checkpoint, or no such head model.
    """
    _require_tunable(model, faces, validation, mirror)
    scheme = model.scheme
    placed, problems = _placed(faces, scheme, head_model)
    usable, flat = usable_faces([face for face, _ in placed], scheme)
    problems += flat
    if len(usable) < 2:
        raise InputError(f"expected at least two faces that can be learned from; got {len(usable)}")
    head = load_head_model(head_model).of(scheme, _VARIANCE) if tuning.balance else None
    landmarks = np.stack([face.landmarks for face in usable])
    squares = np.stack([bounding_square(points) for points in landmarks])
    placement = model.placement(SQUARE)
    crops, rows, unread, digests = cut_labelled(usable, squares, placement, model.cascade.frame, read, progress)
    problems += unread
    if len(rows) < 2:
        raise InputError(f"expected at least two readable pictures; got {len(rows)}: {'; '.join(problems[:3])}")
    present = {id(face): known for face, known in placed}
    guessed = ~np.stack([present[id(face)] for face in usable])
    labelled = np.where(guessed[..., None], np.nan, landmarks)
    shares = None if head is None else _even_over_yaws(landmarks[rows], head, tuning.balance)
    aside = _kept_aside([usable[row].subject for row in rows], validation, tuning.seed)

    def some(points: np.ndarray, rows: np.ndarray) -> TrainingSet:
        return training_set(crops, points, squares, rows, scheme if mirror else None)

    def to_learn_from() -> TrainingSet:
        faces = some(landmarks if tuning.guessed else labelled, rows[~aside])
        own = shares if shares is None else shares[~aside]
        others = guessed[rows[~aside]]
        if mirror:
            others = np.concatenate([others, others[:, mirror_order(scheme)]])
            own = own if own is None else np.tile(own, 2)
        return replace(faces, guessed=others, shares=own)

    kept = (
        None
        if checkpoint is None
        else _Checkpoint(Path(checkpoint), _settings(model, tuning, mirror, labelled[rows], aside))
    )
    cascade, errors = finetune_cascade(
        model.cascade,
        to_learn_from(),
        some(labelled, rows[aside]) if aside.any() else None,
        placement.spread,
        tuning,
        turn=model.starts.turn,
        progress=progress,
        keep=kept.write if kept else lambda progressed: None,
        resume=kept.read if kept else lambda begun: begun,
    )
    settings = {"faces": int((~aside).sum()), "validation": validation, "mirror": mirror, **asdict(tuning)}
    training = model.training | {"finetuned": settings}
    return Finetuned(
        replace(
            model,
            cascade=cascade,
            training=training,
            confidence=None,
            learned=union(model.learned, digest_set(digests)),
        ),
        int((~aside).sum()),
        np.asarray(errors),
        tuple(problems),
    )


def _require_tunable(model: Model, faces: Sequence[FaceRecord], validation: float, mirror: bool) -> None:
    """Check, before the work, what `finetune` asks for.

    Raises:
        InputError: several processes, labels of another number of landmarks, a share out of range, or landmarks that
            cannot be mirrored.
    """
    require_alone("fine-tuning")
    scheme = model.scheme
    if other := next((face for face in faces if len(face.landmarks) != scheme.count), None):
        raise InputError(f"expected labels of {scheme.count} landmarks, as the model's; {other.image} has others")
    if not 0 <= validation < 1:
        raise InputError(f"expected a share of people to keep aside, 0 <= validation < 1; got {validation}")
    if mirror:
        mirror_order(scheme)


def retuned(model: Model, like: Model, faces: Sequence[FaceRecord], **how: Any) -> Model:
    """A model that was trained like another, fine-tuned as that one was, if it was.

    Args:
        model: the model.
        like: the other.
        faces: as in `finetune`, like all else that can be given.

    Raises:
        InputError: as `finetune` does, or if the other does not say how it was fine-tuned.
    """
    if (settings := like.training.get("finetuned")) is None:
        return model
    try:
        # What models do not mention was not known when they were made.
        known = {option.name: settings[option.name] for option in fields(Tuning) if option.name in settings}
        tuning = Tuning(**known | {"disturbance": Disturbance(**settings["disturbance"])})
        how_tuned = {"tuning": tuning, "validation": settings["validation"], "mirror": settings["mirror"]}
    except (LookupError, TypeError) as error:
        raise InputError(
            f"expected a model that says how it was fine-tuned, as jaxfit.finetune makes ({error})"
        ) from None
    return finetune(model, faces, **how_tuned, **how).model


def _placed(
    faces: Sequence[FaceRecord], scheme: Scheme, head_model: str | Path
) -> tuple[list[tuple[FaceRecord, np.ndarray]], list[str]]:
    """Faces with all landmarks, guessed by a 3D head model where they are not known, and (L,) bool: which are labelled.

    Also how many were left out, as it does not explain them, and why.
    """
    known = [bool(np.isfinite(face.landmarks).all()) for face in faces]
    unknown = [face for face, whole in zip(faces, known, strict=True) if not whole]
    filled = fill_labels(unknown, scheme, load_head_model(head_model)) if unknown else Lifted((), ())
    found = {(face.image, face.face): face.landmarks for face in filled.faces}
    placed, all_of_them = [], np.ones(scheme.count, bool)
    for face, whole in zip(faces, known, strict=True):
        landmarks = face.landmarks if whole else found.get((face.image, face.face))
        if landmarks is not None:
            placed.append((replace(face, landmarks=landmarks, present=all_of_them), face.known))
    return placed, list(filled.problems)


def _even_over_yaws(landmarks: np.ndarray, head: ActiveShapeModel, balance: float) -> np.ndarray:
    """(N,) how often faces (N, L, 2) are drawn, so that bands of yaw come more evenly."""
    bands = np.abs(align_labels(head, landmarks).pose[:, 2]) // _BAND
    _, band, counts = np.unique(np.nan_to_num(bands), return_inverse=True, return_counts=True)
    return counts[band] ** -balance


def _kept_aside(subjects: Sequence[str], share: float, seed: int) -> np.ndarray:
    """(N,) bool: faces of this share of the people, drawn at random, at least one person if the share is above 0."""
    names = sorted(set(subjects))
    if share and len(names) < 2:
        raise InputError("expected two people or more, to keep some aside; got one (or take validation 0)")
    count = min(len(names) - 1, int(np.ceil(share * len(names))))
    chosen = {names[n] for n in np.random.default_rng(seed).permutation(len(names))[:count]}
    return np.array([name in chosen for name in subjects], bool)


def _settings(model: Model, tuning: Tuning, mirror: bool, landmarks: np.ndarray, aside: np.ndarray) -> dict[str, Any]:
    """What must be the same for fine-tuning to go on: JSON values."""
    weights = b"".join(tensor.tobytes() for _, tensor in sorted(tensors_of(model).items()))
    faces = landmarks.tobytes() + aside.tobytes()
    return {"tuning": asdict(tuning), "mirror": mirror, "model": zlib.crc32(weights), "faces": zlib.crc32(faces)}


@dataclass(frozen=True)
class _Checkpoint:
    """A file with all that fine-tuning needs to go on.

    Attributes:
        path: the file.
        settings: what it is a checkpoint of; JSON values.
    """

    path: Path
    settings: dict[str, Any]

    def write(self, progressed: Progressed) -> None:
        """Replace the file, atomically."""
        arrays = {str(number): np.asarray(leaf) for number, leaf in enumerate(jax.tree.leaves(progressed))}
        write_tensors(self.path, arrays, _CHECKPOINT, {"format": _FORMAT, **self.settings})

    def read(self, begun: Progressed) -> Progressed:
        """What the file holds; what fine-tuning begins with, if there is none.

        Raises:
            InputError: it is a checkpoint of something else.
            ModelError: it is damaged.
        """
        if not self.path.exists():
            return begun
        data = self.path.read_bytes()
        try:
            header = read_header(data, _CHECKPOINT, _FORMAT, "fine-tuning checkpoint", "finetune")
            arrays = parse_tensors(data)
            leaves, structure = jax.tree.flatten(begun)
            read = [jnp.asarray(arrays[str(number)]) for number in range(len(leaves))]
            # The last, the errors, are as many as there were epochs.
            if any(new.shape != np.shape(old) for new, old in zip(read[:-1], leaves[:-1], strict=True)):
                raise ModelError("its arrays have other shapes")
        except DAMAGE as error:
            raise ModelError(f"{self.path}: not a checkpoint, or damaged ({error}); delete it to begin again") from None
        if {key: header[key] for key in self.settings} != self.settings:
            raise InputError(
                f"{self.path}: a checkpoint of other faces, settings or another model; delete it, or "
                "go on as it was begun"
            )
        return jax.tree.unflatten(structure, read)
