"""ICT-FaceKit, a published head model of identities and expressions: reading it, and heads drawn from it."""

import struct
import zipfile
import zlib
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from jaxfit.errors import DatasetError, InputError
from jaxfit.heads.mesh_points import MeshPoints, read_mesh_points

FACEKIT_SOURCE = "ICT-FaceKit, (c) 2020 USC Institute for Creative Technologies, MIT licence"

# ICT-FaceKit's x to the subject's left, which is the picture's right; y up and z to the viewer turn over.
_AXES = np.array([1, -1, -1], np.float32)

# What reading may raise whatever the bytes; a single array (.npy) is not to be used with "with".
_DAMAGE = (
    *(OSError, EOFError, LookupError, ValueError, TypeError, NotImplementedError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)


@dataclass(frozen=True)
class FaceKit:
    """A head and how it varies: generic + Σ aᵢ identityᵢ + Σ wₖ expressionₖ with a ~ N(0, 1) and w in [0, 1].

    Lengths are centimetres; x right, y down, z away from the viewer, who sees the head from the front.

    Attributes:
        generic: (V, 3) the vertices of the mean head, without expression.
        identity: (I, V, 3) offsets of the vertices, for one standard deviation each.
        expression: (E, V, 3) offsets of the vertices at full expression.
        expression_names: (E,) names after the muscles' action; ``_L`` and ``_R`` are the subject's left and right.
        quads: (F, 4) vertices of each face of the mesh; a last one that is -1 or repeats another makes a triangle.
    """

    generic: np.ndarray
    identity: np.ndarray
    expression: np.ndarray
    expression_names: tuple[str, ...]
    quads: np.ndarray


def read_facekit(path: str | Path) -> FaceKit:
    """ICT-FaceKit in one ``.npz`` file: the arrays of :class:`FaceKit`, but y up and z to the viewer as ICT-FaceKit's.

    Raises:
        DatasetError: the file is missing or damaged, or an array is missing or of the wrong shape.
    """
    names = ("generic", "identity", "expression", "expression_names", "quads")
    try:
        # NumPy leaves a damaged file that it opens itself open.
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            generic, identity, expression, expression_names, quads = (file[name] for name in names)
    except _DAMAGE as error:
        raise DatasetError(f"{path}: expected an .npz file of ICT-FaceKit with {', '.join(names)}; {error}") from error
    count = len(generic) if generic.ndim else 0
    expected = {
        "generic": (generic, (count, 3)),
        "identity": (identity, (len(identity) if identity.ndim else 0, count, 3)),
        "expression": (expression, (expression_names.size, count, 3)),
    }
    for name, (array, shape) in expected.items():
        if array.shape != shape or not array.size or array.dtype.kind != "f" or not np.isfinite(array).all():
            raise DatasetError(f"{path}: expected {name} {shape} of finite numbers; got {array.shape} {array.dtype}")
    if expression_names.dtype.kind != "U" or expression_names.ndim != 1:
        raise DatasetError(f"{path}: expected expression_names, a list of words; got {expression_names.dtype}")
    if quads.ndim != 2 or quads.shape[1:] != (4,) or quads.dtype.kind != "i" or not (quads >= -1).all():
        raise DatasetError(f"{path}: expected quads (F, 4) of vertices; got {quads.shape} {quads.dtype}")
    if quads.size and quads.max() >= count:
        raise DatasetError(f"{path}: quads name vertex {quads.max()}, but there are only {count}")
    return FaceKit(
        generic=generic.astype(np.float32) * _AXES,
        identity=identity.astype(np.float32) * _AXES,
        expression=expression.astype(np.float32) * _AXES,
        expression_names=tuple(map(str, expression_names)),
        quads=quads,
    )


def facekit_points() -> dict[str, MeshPoints]:
    """The landmarks of 21-, 29- and 68-point faces on ICT-FaceKit's mesh, by the name of their scheme."""
    with resources.as_file(resources.files("jaxfit.heads") / "facekit_points.json") as path:
        return read_mesh_points(path)


# What a region of the face may do, and how often it does; else it rests. A region does one thing at a time: no mouth
# smiles and frowns at once. What it does is a group of expressions of the same strength; a name without its side stands
# for both, one perhaps weaker; eyes move together. ``mouthClose`` is not among them: it corrects a jaw that opens
# behind closed lips.
_REGIONS: tuple[dict[tuple[str, ...], float], ...] = (
    {
        ("browInnerUp", "browOuterUp"): 0.15,
        ("browDown",): 0.15,
        ("browInnerUp",): 0.1,
        ("browOuterUp",): 0.05,
    },
    {("eyeBlink",): 0.15, ("eyeSquint",): 0.15, ("eyeWide",): 0.1},
    {
        ("eyeLookDown_L", "eyeLookDown_R"): 0.15,
        ("eyeLookUp_L", "eyeLookUp_R"): 0.1,
        ("eyeLookOut_L", "eyeLookIn_R"): 0.1,
        ("eyeLookIn_L", "eyeLookOut_R"): 0.1,
    },
    {("jawOpen",): 0.4, ("jawForward",): 0.05, ("jawLeft",): 0.04, ("jawRight",): 0.04},
    {
        ("mouthSmile",): 0.15,
        ("mouthSmile", "cheekSquint"): 0.1,
        ("mouthSmile", "mouthDimple"): 0.05,
        ("mouthFrown",): 0.06,
        ("mouthFunnel",): 0.06,
        ("mouthPucker",): 0.05,
        ("mouthStretch",): 0.05,
        ("mouthUpperUp",): 0.04,
        ("mouthLowerDown",): 0.06,
        ("mouthUpperUp", "mouthLowerDown"): 0.04,
        ("mouthPress",): 0.05,
        ("mouthRollLower", "mouthRollUpper"): 0.03,
        ("mouthShrugLower", "mouthShrugUpper"): 0.03,
        ("mouthLeft",): 0.02,
        ("mouthRight",): 0.02,
    },
    {("noseSneer",): 0.08, ("cheekPuff",): 0.04},
)
# Full strength is more than people show: the jaw and the smiles of two people of FaceWarehouse went about so far.
_STRONGEST = {"jawOpen": 0.6, "mouthSmile": 0.5, "mouthDimple": 0.5}
_FAINTEST = 0.2  # of the strongest; the rest would not be seen
_ONE_SIDED = 0.3  # how often one side does it more weakly


def sample_heads(
    facekit: FaceKit, points: MeshPoints, people: int = 150, expressions: int = 20, seed: int = 0
) -> np.ndarray:
    """Landmarks (people · expressions, L, 3), in cm, of random people; each first without expression, then with others.

    People are drawn from the model's normal distribution. Expressions are such as photographs show: each region of the
    face (brows, lids, gaze, jaw, mouth, cheeks and nose) does one thing or rests, both sides mostly alike.

    Raises:
        InputError: ``people`` or ``expressions`` is less than 1, or the points name vertices that the heads lack.
        DatasetError: the model lacks an expression.
    """
    if people < 1 or expressions < 1:
        raise InputError(f"expected at least one person and one expression; got {people} and {expressions}")
    rng = np.random.default_rng(seed)
    coefficients = rng.normal(size=(people, len(facekit.identity)))
    weights = np.zeros((people, expressions, len(facekit.expression)))
    columns = {name: column for column, name in enumerate(facekit.expression_names)}
    for person in weights:
        for face in person[1:]:
            for name, weight in _random_expression(rng, columns).items():
                face[columns[name]] = weight
    identities = points.at(facekit.generic) + np.tensordot(coefficients, points.at(facekit.identity), 1)
    heads = identities[:, None] + np.tensordot(weights, points.at(facekit.expression), 1)
    return heads.reshape(people * expressions, len(points), 3)


def _random_expression(rng: np.random.Generator, known: dict[str, int]) -> dict[str, float]:
    """Weights in (0, 1] of the expressions that are active."""
    weights = {}
    for region in _REGIONS:
        actions, shares = list(region), np.array(list(region.values()))
        chosen = int(np.searchsorted(shares.cumsum(), rng.uniform(), side="right"))
        if chosen == len(actions):
            continue
        strength, sides = rng.uniform(_FAINTEST, 1), np.ones(2)
        if rng.uniform() < _ONE_SIDED:
            sides[rng.integers(2)] = rng.uniform(_FAINTEST, 1)
        for name in actions[chosen]:
            weight = strength * _STRONGEST.get(name, 1.0)
            if name in known:
                weights[name] = weight
            elif f"{name}_L" in known and f"{name}_R" in known:
                weights[f"{name}_L"], weights[f"{name}_R"] = weight * sides
            else:
                raise DatasetError(f"expected a head model with the expression {name}; it has {', '.join(known)}")
    return weights
