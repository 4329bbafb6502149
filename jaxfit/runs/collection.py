"""Fitting a collection of pictures with Ray Data: Parquet parts, whole or not at all, and a manifest of pictures."""

import hashlib
import json
import logging
import os
import sys
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jaxfit
from jaxfit.data.detectors import DEFAULT_DETECTOR
from jaxfit.data.inputs import require_no_inputs, state_of
from jaxfit.data.locks import held
from jaxfit.data.names import each_once, table_path
from jaxfit.data.outputs import MANIFEST, atomic_write, replace_results, require_own_folder, require_same_settings
from jaxfit.data.threads import cores
from jaxfit.errors import InputError, JaxfitError
from jaxfit.fitting.sources import NO_FACE
from jaxfit.models.files import bundled
from jaxfit.runs.run_folder import file_digests, run_files
from jaxfit.runs.workers import BatchFitter
from jaxfit.types import Progress, silent

_COMMAND = "jaxfit collect"
_STATES = "jaxfit pictures"  # metadata of a part: what its pictures were like
_TRIES = 3  # of a part whose worker dies each time: one of its pictures may be what kills it
# Whatever its name says: unless it is 0, Ray listens on all of a Linux machine's addresses.
_CLUSTER = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"


def fit_collection(
    pictures: Sequence[str | Path],
    out: str | Path,
    fitter: BatchFitter | None = None,
    *,
    workers: int | None = None,
    gpus: float = 0.0,
    part: int = 256,
    progress: Progress = silent,
) -> dict[str, int]:
    """Find and fit the faces in a collection of pictures with workers of Ray Data; needs ``jaxfit[ray]``.

    ``out/parts`` gets Parquet files for ``part`` pictures each, with the columns of ``jaxfit.runs.BatchFitter``, and
    ``out/manifest.parquet`` a row for each picture: ``image``, its ``outcome``, the number of ``faces`` that were
    fitted, and
    the ``part`` that it is in. Each picture is in one part. A part is named after its pictures and written as a whole
    or not at all. When a worker dies, another does its part again. A run that was stopped and is started again fits
    only pictures that are in no part, or have changed since. One run at a time writes to ``out``.

    Ray is started on this machine, where it listens on the loopback device and reports no usage, and ended afterwards;
    unless it runs already, as after ``ray.init("auto")`` on a cluster, whose machines then have to see the pictures,
    the model and ``out`` under the same paths.

    Args:
        pictures: their files.
        out: the folder of the results, made if needed.
        fitter: how to fit; ``BatchFitter()`` by default.
        workers: how many processes; by default as many as there are cores for.
        gpus: how many GPUs, or which share of one, each worker takes.
        part: pictures in each part, which is what a killed worker loses at most.
        progress: called with the stage's name, pictures done and pictures in all.

    Returns:
        How many pictures of the manifest have each outcome: ``fitted``, ``none`` where no face was found, ``problem``,
        and ``missing``, which are in no part because their workers died again and again; they are tried again when the
        run is started once more.

    Raises:
        InputError: Ray is not installed, or imported but not started, ``out`` holds results of other settings or is
            being written by another run, a file that was given would be written over, or an argument is out of range.
        JaxfitError: what stopped a worker, such as a model that does not know the detector's boxes or a full disk.
    """
    fitter = fitter or BatchFitter()
    if part < 1 or (workers is not None and workers < 1) or gpus < 0:
        raise InputError(f"expected at least 1 picture a part, 1 worker and 0 GPUs; got {part}, {workers} and {gpus}")
    _require_ray()
    # Workers do not stand in this folder.
    wanted = list(map(os.path.abspath, each_once(pictures)))
    if str(fitter.model) not in bundled():
        fitter = replace(fitter, model=os.path.abspath(fitter.model))
    out = Path(out).absolute()
    with held(out, _COMMAND):
        return _fit_held(wanted, out, fitter, workers=workers, gpus=gpus, part=part, progress=progress)


def _fit_held(
    wanted: Sequence[str],
    out: Path,
    fitter: BatchFitter,
    *,
    workers: int | None,
    gpus: float,
    part: int,
    progress: Progress,
) -> dict[str, int]:
    """What `fit_collection` does, in a folder that no other run writes to."""
    require_own_folder(out, _COMMAND)
    parts = out / "parts"
    parts.mkdir(exist_ok=True)
    written = ["settings.json", "manifest.parquet"]  # and the parts
    require_no_inputs(
        [*(out / name for name in (*written, MANIFEST)), *parts.iterdir()],
        [*wanted, *run_files(fitter.model, fitter.fitting).values()],
    )
    settings = _settings(fitter)
    require_same_settings(out / "settings.json", settings)
    replace_results(out, _COMMAND, written, settings)
    _sweep(parts)
    _drop_changed(parts, wanted)
    known = {account.image for account in _accounts(parts)}
    left = [name for name in wanted if table_path(name) not in known]
    if left:
        done = len(wanted) - len(left)
        progress("fitting pictures", done, len(wanted))
        some = [left[first : first + part] for first in range(0, len(left), part)]
        with closing(_fit_parts(some, fitter, parts, workers, gpus)) as results:
            for fitted, error in results:
                if error:
                    raise JaxfitError(error)
                done += fitted
                progress("fitting pictures", done, len(wanted))
    _sweep(parts)
    return _write_manifest(out / "manifest.parquet", parts, map(table_path, wanted))


def _require_ray() -> None:
    """Check that Ray Data can be used.

    Raises:
        InputError: it is not installed, or was imported without being started.
    """
    if any(find_spec(name) is None for name in ("ray", "pyarrow")):
        raise InputError('collections need Ray, which is not installed: pip install "jaxfit[ray]"')
    # What keeps it to the loopback device is read when it is imported.
    if "ray" in sys.modules and not sys.modules["ray"].is_initialized() and os.environ.get(_CLUSTER) != "0":
        raise InputError("Ray was imported, but not started: call ray.init() first, or do not import it")


def _settings(fitter: BatchFitter) -> dict[str, Any]:
    """What has to be the same for a stopped run to go on."""
    return {
        "jaxfit": jaxfit.__version__,
        "model": str(fitter.model),
        **fitter.fitting.settings(),
        "detector": fitter.fitting.detector or DEFAULT_DETECTOR,
        "refine": fitter.refine,
        "unshift": fitter.unshift,
        "heads": fitter.heads,
        "max_megapixels": fitter.max_megapixels,
        **file_digests(fitter.model, run_files(fitter.model, fitter.fitting)),
    }


def _fit_parts(
    parts: Sequence[Sequence[str]], fitter: BatchFitter, folder: Path, workers: int | None, gpus: float
) -> Generator[tuple[int, str], None, None]:
    """Have workers make the parts; of each, in any order, the number of its pictures, and what stopped it."""
    with _ray((workers or max(1, cores() // fitter.cores)) * fitter.cores) as ray:
        logging.getLogger("ray.data").setLevel(logging.ERROR)
        there = int(ray.cluster_resources().get("CPU", 1)) // fitter.cores
        context = ray.data.DataContext.get_current().copy()
        context.enable_progress_bars = False
        rows = [{"pictures": list(map(os.fsencode, part))} for part in parts]  # names need not be text
        with ray.data.DataContext.current(context):
            results = ray.data.from_items(rows, override_num_blocks=len(rows)).map(
                _PartFitter,
                fn_constructor_args=(fitter, folder),
                # One part at a time, so that a picture that kills its worker does not cost others their tries.
                compute=ray.data.ActorPoolStrategy(
                    size=min(len(parts), workers or max(1, there)), max_tasks_in_flight_per_actor=1
                ),
                num_cpus=fitter.cores,
                num_gpus=gpus,
            )
            for row in results.iter_rows():
                yield row["pictures"], row["error"]


@contextmanager
def _ray(cpus: int) -> Iterator[Any]:
    """Ray, started here for a number of cores if it does not run yet."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault(_CLUSTER, "0")
    import ray
    import ray.data

    if ray.is_initialized():
        yield ray
        return
    ray.init("local", num_cpus=cpus, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    try:
        yield ray
    finally:
        ray.shutdown()


class _PartFitter:
    """What a worker does: fits the pictures of a part and writes it."""

    def __init__(self, fitter: BatchFitter, folder: Path):
        self._fitter, self._folder = fitter, folder

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        names = list(map(bytes, row["pictures"]))
        digest = hashlib.sha256(b"\0".join(names)).hexdigest()[:32]
        part = self._folder / f"{digest}.parquet"
        try:
            with (self._folder / f".{digest}.tries").open("ab") as tries:
                tries.write(b".")
                if tries.tell() > _TRIES:
                    return {"pictures": 0, "error": ""}
            if not part.exists():  # else its worker died after it had written it
                _write_part(part, self._fitter, list(map(os.fsdecode, names)))
        except (JaxfitError, OSError) as error:
            return {"pictures": 0, "error": str(error)}
        return {"pictures": len(names), "error": ""}


def _write_part(path: Path, fitter: BatchFitter, pictures: Sequence[str]) -> None:
    """Fit the pictures of a part and write it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    states = {picture: state_of([picture]) for picture in pictures}  # before they are read: they may change
    table = pa.table(fitter({"image": pictures})).replace_schema_metadata({_STATES: json.dumps(states)})
    with atomic_write(path) as file:
        pq.write_table(table, file)


def _drop_changed(parts: Path, wanted: Sequence[str]) -> None:
    """Take the rows of pictures that have changed since out of their parts, so that they are fitted anew."""
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    pictures = {*wanted}
    for path in parts.glob("[!.]*.parquet"):
        with pq.ParquetFile(path) as file:
            states = json.loads((file.schema_arrow.metadata or {}).get(_STATES.encode(), "{}"))
            changed = [name for name, state in states.items() if name in pictures and state_of([name]) != state]
            if not changed:
                continue
            table = file.read()
        kept = table.filter(pc.invert(pc.is_in(table["image"], pa.array(list(map(table_path, changed))))))
        if not kept.num_rows:
            path.unlink()
            continue
        left = {name: state for name, state in states.items() if name not in {*changed}}
        with atomic_write(path) as target:
            pq.write_table(kept.replace_schema_metadata({_STATES: json.dumps(left)}), target)


def _sweep(parts: Path) -> None:
    """Remove what workers that were killed left behind."""
    for path in parts.glob(".*"):
        path.unlink()


class _Account(NamedTuple):
    """The outcome of a picture: a row of the manifest."""

    image: str
    outcome: str
    faces: int
    part: str


def _accounts(folder: Path) -> Iterator[_Account]:
    """The outcomes of the pictures that are in parts."""
    import pyarrow.parquet as pq

    for path in sorted(folder.glob("[!.]*.parquet")):
        problems: dict[str, list[str]] = {}
        table = pq.ParquetFile(path).read(["image", "problem"])
        for image, problem in zip(*(column.to_pylist() for column in table.columns), strict=True):
            problems.setdefault(image, []).append(problem)
        for image, why in problems.items():
            faces = why.count("")
            outcome = "fitted" if faces else "none" if why == [NO_FACE] else "problem"
            yield _Account(image, outcome, faces, path.name)


def _write_manifest(path: Path, parts: Path, wanted: Iterable[str]) -> dict[str, int]:
    """Write the manifest; returns how many pictures have each outcome."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    accounts = list(_accounts(parts))
    known = {account.image for account in accounts}
    accounts += [_Account(image, "missing", 0, "") for image in wanted if image not in known]
    accounts.sort()
    columns = zip(*accounts, strict=True) if accounts else [()] * len(_Account._fields)
    types = (pa.string(), pa.string(), pa.int32(), pa.string())
    arrays = [pa.array(column, type_) for column, type_ in zip(columns, types, strict=True)]
    with atomic_write(path) as file:
        pq.write_table(pa.table(dict(zip(_Account._fields, arrays, strict=True))), file)
    outcomes = Counter(account.outcome for account in accounts)
    return {outcome: outcomes[outcome] for outcome in ("fitted", "none", "problem", "missing")}
