"""What an experiment runs: a configuration, read from a TOML file and checked before any work."""

import json
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.cascade.starts import Starts
from jaxfit.data.inputs import read_regular
from jaxfit.descriptors import DESCRIPTORS, descriptor_like
from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.errors import InputError
from jaxfit.experiments.names import check_names
from jaxfit.experiments.thesis.numbers import THESIS_DATASETS
from jaxfit.labels.datasets import parse_spec, scheme_values
from jaxfit.learning.methods import METHODS, Options, default_descriptor
from jaxfit.schemes.normalisers import NORMALISERS

_MOST_BYTES = 100_000  # of a configuration: reading one of megabytes may take hours
_PLAIN = ("augmentations", "initialisations", "folds", "repetitions", "timed_faces", "normaliser", "seed")
# Options of training that an experiment sets itself, or does not need, as it measures no boxes of detectors.
_NOT_OPTIONS = {"augmentations", "starts", "detectors", "seed"}
_OPTIONS = set(Options().flat()) - _NOT_OPTIONS


@dataclass(frozen=True)
class DatasetPlan:
    """Faces that methods are cross-validated on.

    Attributes:
        name: of the dataset, in tables.
        data: what it is made of, ``FORMAT:PATH`` as on the command line; paths are relative to the current folder.
        scheme: convert all labels to this landmark scheme; None leaves them as they are.
        thesis: put the thesis's numbers of ``"AFLW"`` or ``"LFPW"`` beside this dataset's; None for neither.
    """

    name: str
    data: tuple[str, ...]
    scheme: str | dict[str, Any] | None = None
    thesis: str | None = None


@dataclass(frozen=True)
class MethodPlan:
    """A method that is compared.

    Attributes:
        name: in tables.
        method: one of ``jaxfit.learning.methods.METHODS``.
        options: of training; the tasks of the experiment set the augmentations.
    """

    name: str
    method: str
    options: Options

    @property
    def in_3d(self) -> bool:
        """Whether errors are measured in 3D."""
        return METHODS[self.method].in_3d


@dataclass(frozen=True)
class PosePlan:
    """What a test of the pose that 3D methods find is made with.

    Attributes:
        train: what they learn from, all of it, ``FORMAT:PATH``.
        test: datasets with labelled poses, from which nothing is learned.
        scheme: convert the labels of ``train`` to this landmark scheme.
    """

    train: tuple[str, ...]
    test: tuple[str, ...]
    scheme: str | dict[str, Any] | None = None


@dataclass(frozen=True)
class Config:
    """An experiment.

    Attributes:
        datasets: what methods are cross-validated on; may be empty where only pose is tested.
        methods: what is compared.
        augmentations: starts drawn for each face in training, the columns of the grid.
        initialisations: starts of a fit.
        chosen_steps: how many steps the models have that are compared, timed and looked at.
        chosen_augmentations: the augmentations of these models, one of ``augmentations``.
        folds: of the cross-validation, split by subject.
        repetitions: how often the faces that are timed are fitted.
        timed_faces: how many faces are timed.
        normaliser: what errors are divided by.
        seed: of folds, boxes and starts.
        pose: the test of pose; None for no such test.
    """

    datasets: tuple[DatasetPlan, ...]
    methods: tuple[MethodPlan, ...]
    chosen_steps: int
    augmentations: tuple[int, ...] = (1, 5, 10, 15, 20, 25)
    initialisations: tuple[int, ...] = (1, 3, 5, 7, 9, 11)
    chosen_augmentations: int = 15
    folds: int = 10
    repetitions: int = 32
    timed_faces: int = 64
    normaliser: str = "outer"
    seed: int = 0
    pose: PosePlan | None = None

    def __post_init__(self) -> None:
        if not self.methods or not (self.datasets or self.pose):
            raise InputError("expected one method or more, [methods.NAME], and a dataset, [datasets.NAME], or [pose]")
        if self.chosen_augmentations not in self.augmentations or not 1 <= self.chosen_steps <= self.steps:
            raise InputError(
                f"[chosen]: expected augmentations among {list(self.augmentations)} and steps from 1 to {self.steps} "
                f"(one window a step); got {self.chosen_augmentations} and {self.chosen_steps}"
            )
        for plan in self.methods:
            if (count := len(plan.options.greedy.windows)) != self.steps:
                raise InputError(
                    f"[methods.{plan.name}] windows: expected as many, one a step, for all methods; got {count}, "
                    f"and {self.steps} for {self.methods[0].name}"
                )
        least = {"augmentations": 1, "folds": 2, "repetitions": 1, "timed_faces": 1, "seed": 0}
        for key, limit in least.items():
            value = getattr(self, key)
            if np.min(value) < limit:
                raise InputError(f"{key}: expected {limit} or more; got {value}")
        if any(count < 1 or count == 2 for count in self.initialisations):
            raise InputError(f"initialisations: expected one, or three or more, each; got {list(self.initialisations)}")
        for key in ("augmentations", "initialisations"):
            if len(set(counts := getattr(self, key))) < len(counts):
                raise InputError(f"{key}: expected each once; got {list(counts)}")
        check_names([plan.name for plan in self.datasets], "[datasets]")
        check_names([plan.name for plan in self.methods], "[methods]")
        pairs = [f"{dataset.name}-{plan.name}" for dataset in self.datasets for plan in self.methods]
        check_names(pairs, "datasets and methods, joined by '-'")
        if self.normaliser not in NORMALISERS:
            raise InputError(f"normaliser: expected one of {', '.join(NORMALISERS)}; got {self.normaliser!r}")
        if self.pose and not any(plan.in_3d for plan in self.methods):
            raise InputError("[pose]: expected a 3D method among the methods; there is none")

    @property
    def steps(self) -> int:
        """How many steps the cascades have: the rows of the grid."""
        return len(self.methods[0].options.greedy.windows)

    @property
    def names_thesis(self) -> bool:
        """Whether a dataset is compared with one of the thesis."""
        return any(dataset.thesis is not None for dataset in self.datasets)

    def method(self, name: str) -> MethodPlan:
        """The method of a name."""
        return next(plan for plan in self.methods if plan.name == name)

    def as_json(self) -> dict[str, Any]:
        """The configuration as JSON values, of which `config_from` makes the same one."""
        plans = {plan.name: _without(asdict(plan), {"name"}) for plan in self.datasets}
        pose = {} if self.pose is None else {"pose": _without(asdict(self.pose), set())}
        methods = {
            plan.name: {"method": plan.method, **_without(plan.options.flat(), _NOT_OPTIONS)} for plan in self.methods
        }
        for values in methods.values():
            if frame := values.get("frame"):
                values["frame"] = vars(frame)
            if descriptor := values.get("descriptor"):
                kind = next(kind for kind, known in DESCRIPTORS.items() if type(descriptor) is known)
                values["descriptor"] = {"kind": kind, **vars(descriptor)}
        chosen = {"augmentations": self.chosen_augmentations, "steps": self.chosen_steps}
        values = {key: getattr(self, key) for key in _PLAIN} | {"chosen": chosen, "datasets": plans, "methods": methods}
        return json.loads(json.dumps({**values, **pose}))


def read_config(path: str | Path) -> Config:
    """The configuration in a TOML file.

    Raises:
        InputError: it cannot be read, or something in it is unknown, missing or out of range.
    """
    path = Path(path)
    try:
        values = tomllib.loads(read_regular(path, _MOST_BYTES).decode("utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a configuration in TOML") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not TOML: {error}") from None
    try:
        return config_from(values)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: its tables are nested too deeply") from None


def config_from(values: Mapping[str, Any]) -> Config:
    """The configuration of values, as they stand in a TOML file.

    Raises:
        InputError: something is unknown, missing or out of range.
    """
    values = dict(values)
    _require_known("", values, {*_PLAIN, "chosen", "training", "datasets", "methods", "pose"})
    chosen = _table(values, "chosen")
    _require_known("[chosen]", chosen, {"augmentations", "steps"})
    top = {key: _like(getattr(Config, key), key, values[key]) for key in _PLAIN if key in values}
    usual = Options(detectors=False).but(seed=max(0, top.get("seed", Config.seed)))
    training, methods, datasets = (_table(values, key) for key in ("training", "methods", "datasets"))
    _options("[training]", usual, default_descriptor("sdm", Starts()), training)  # so that a mistake is reported there
    plans = tuple(_method(name, {**training, **_table(methods, name, "methods.")}, usual) for name in methods)
    steps = len(plans[0].options.greedy.windows) if plans else 0
    return Config(
        datasets=tuple(_dataset(name, _table(datasets, name, "datasets.")) for name in datasets),
        methods=plans,
        **top,
        **{f"chosen_{key}": _like(0, f"[chosen] {key}", value) for key, value in {"steps": steps, **chosen}.items()},
        pose=_pose(_table(values, "pose")) if "pose" in values else None,
    )


def _dataset(name: str, values: Mapping[str, Any]) -> DatasetPlan:
    where = f"[datasets.{name}]"
    _require_known(where, values, {"data", "scheme", "thesis"})
    plan = DatasetPlan(name, _specs(where, values, "data"), _scheme(where, values), values.get("thesis"))
    if plan.thesis not in (None, *THESIS_DATASETS):
        raise InputError(f"{where} thesis: expected one of {', '.join(THESIS_DATASETS)}; got {plan.thesis!r}")
    return plan


def _method(name: str, values: Mapping[str, Any], usual: Options) -> MethodPlan:
    where = f"[methods.{name}]"
    values = dict(values)
    _require_known(where, values, {"method", *_OPTIONS})
    method = values.pop("method", name)
    if method not in METHODS:
        raise InputError(f"{where}: expected method = one of {', '.join(METHODS)}; got {method!r}")
    return MethodPlan(name, method, _options(where, usual, default_descriptor(method, Starts()), values))


def _pose(values: Mapping[str, Any]) -> PosePlan:
    _require_known("[pose]", values, {"train", "test", "scheme"})
    plan = PosePlan(_specs("[pose]", values, "train"), _specs("[pose]", values, "test"), _scheme("[pose]", values))
    formats = [parse_spec(spec)[0] for spec in plan.test]
    if len(set(formats)) < len(formats):
        raise InputError(f"[pose] test: expected datasets of different formats, which name them; got {list(plan.test)}")
    return plan


def _options(where: str, usual: Options, descriptor: Descriptor, values: Mapping[str, Any]) -> Options:
    """The usual options and descriptor, changed as a table about training says."""
    _require_known(where, values, _OPTIONS)
    plain = {key: value for key, value in values.items() if key not in ("descriptor", "frame")}
    # The usual rank, None, does not show that others are whole numbers.
    defaults = usual.flat() | {"rank": 0}
    changed = {key: _like(defaults[key], f"{where} {key}", value) for key, value in plain.items()}
    if "descriptor" in values:
        changed["descriptor"] = descriptor = _descriptor(where, descriptor, _table(values, "descriptor", f"{where} "))
    if "frame" in values:
        changed["frame"] = _part(where, "frame", descriptor.frame, _table(values, "frame", f"{where} "))
    return _checked(where, usual.but, changed)


def _descriptor(where: str, usual: Descriptor, table: Mapping[str, Any]) -> Descriptor:
    """The usual descriptor, or one of another ``kind``, changed as a table says."""
    try:
        descriptor = descriptor_like(usual, table["kind"]) if "kind" in table else usual
    except InputError as error:
        raise InputError(f"{where} descriptor.kind: {error}") from None
    return _part(where, "descriptor", descriptor, _without(table, {"kind"}))


def _part(where: str, key: str, part: Any, table: Mapping[str, Any]) -> Any:
    """A part of the options, changed as the table of a key says."""
    _require_known(f"{where} {key}", table, {each.name for each in fields(part)})
    return _checked(
        where, partial(replace, part), {k: _like(getattr(part, k), f"{where} {key}.{k}", v) for k, v in table.items()}
    )


def _checked(where: str, changing: Callable[..., Any], changed: Mapping[str, Any]) -> Any:
    """A dataclass with some fields changed.

    Raises:
        InputError: it refuses the values.
    """
    try:
        return changing(**changed)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _like(default: Any, where: str, value: Any) -> Any:
    """The value, which must be of the same kind as the default."""
    if isinstance(default, tuple) and isinstance(value, list) and value:
        return tuple(_like(default[0], where, each) for each in value)
    if isinstance(value, int) and not isinstance(value, bool) and (default is None or isinstance(default, float)):
        return float(value)
    kind = float if default is None else type(default)
    if type(value) is not kind:
        example = list(default) if isinstance(default, tuple) else default
        expected = "a number" if default is None else f"something like {example}"
        raise InputError(f"{where}: expected {expected}; got {value!r}")
    return value


def _table(values: Mapping[str, Any], key: str, within: str = "") -> dict[str, Any]:
    """The table of a name; empty if there is none. ``within`` stands before the name in messages."""
    table = values.get(key, {})
    if not isinstance(table, dict):
        raise InputError(f"expected a table, [{within}{key}]; got {key} = {table!r}")
    return table


def _specs(where: str, values: Mapping[str, Any], key: str) -> tuple[str, ...]:
    specs = values.get(key)
    if not (isinstance(specs, list) and specs and all(isinstance(spec, str) for spec in specs)):
        raise InputError(f'{where} {key}: expected a list of "FORMAT:PATH"; got {specs!r}')
    try:
        for spec in specs:
            parse_spec(spec)
    except InputError as error:
        raise InputError(f"{where} {key}: {error}") from None
    return tuple(specs)


def _scheme(where: str, values: Mapping[str, Any]) -> str | dict[str, Any] | None:
    if "scheme" not in values:
        return None
    try:
        given = values["scheme"]
        return scheme_values(given if isinstance(given, dict) else str(given))
    except InputError as error:
        raise InputError(f"{where} scheme: {error}") from None


def _without(values: Mapping[str, Any], left_out: set[str]) -> dict[str, Any]:
    """Values by name, without those that are left out or None."""
    return {key: value for key, value in values.items() if key not in left_out and value is not None}


def _require_known(where: str, values: Mapping[str, Any], known: Iterable[str]) -> None:
    """Check that a table has no other keys than these.

    Raises:
        InputError: it has another.
    """
    for key in values:
        if key not in known:
            raise InputError(f"{where} unknown key {key!r}; expected some of {', '.join(sorted(known))}".strip())
