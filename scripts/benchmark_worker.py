"""Measure one method in a process of its own, which ``benchmark.py`` starts on the cores that it may use.

It says ``ready``, waits for a line, measures, and ends with a line of JSON; the measures of a process's first result
neither say it nor wait.
"""

import json
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from timing import median_seconds


def main() -> None:
    job = json.loads(sys.argv[1])
    measures: dict[str, Callable[..., Any]] = {
        **{"jaxfit": jaxfit_speed, "sizes": sizes_speed, "dlib": dlib_speed},
        **{"jaxfit first": jaxfit_first, "dlib first": dlib_first},
    }
    print(json.dumps(measures[job.pop("measure")](**job)))


def jaxfit_speed(model: str, faces: str, batches: list[int], repetitions: int) -> dict[str, Any]:
    import jaxfit

    given = np.load(faces)
    begin = time.perf_counter()
    loaded = jaxfit.load(model)
    load = time.perf_counter() - begin
    begin = time.perf_counter()
    jaxfit.warm_up(loaded)
    compiling = time.perf_counter() - begin
    wait_for_the_others()
    latency = median_seconds(partial(jaxfit.fit, loaded, [given["picture"]], given["box"][None]), repetitions)
    peak, speeds = peak_mib(), []
    for batch in sorted(batches):  # as what a process needed most does not shrink again
        rate = crops_a_second(loaded.cascade, given["crops"], batch, repetitions)
        speeds.append({"batch": batch, "faces/s": rate, "peak MiB": peak_mib()})
    paths = given["paths"].tolist()
    seconds = median_seconds(partial(jaxfit.fit, loaded, paths, given["boxes"]), min(3, repetitions))
    return {
        "load s": load,
        "compile s": compiling,
        "latency ms": 1000 * latency,
        "peak MiB": peak,
        "from files/s": len(paths) / seconds,
        "speeds": speeds,
    }


def crops_a_second(cascade: Any, crops: np.ndarray, batch: int, repetitions: int) -> float:
    """Faces a second, in batches of which some are computed at the same time, as `jaxfit.fit` does."""
    from jaxfit.cascade.fit import fit_crops
    from jaxfit.fitting.batches import computed_at_once

    crops, at_once = np.resize(crops, (batch, *crops.shape[1:])), computed_at_once()
    calls = at_once * max(2, 256 // batch)  # enough of them that beginning and end count little
    with ThreadPoolExecutor(at_once) as pool:

        def fit_all() -> None:
            list(pool.map(lambda _: np.asarray(fit_crops(cascade, crops)), range(calls)))

        return calls * batch / median_seconds(fit_all, repetitions)


def sizes_speed(model: str, faces: str, batch: int, repetitions: int) -> dict[str, Any]:
    """Faces a second of cascades with fewer steps, and with fewer landmarks."""
    import jaxfit
    from jaxfit.cascade.model import first_steps
    from jaxfit.shapes.points import PointSpace

    crops, cascade = np.load(faces)["crops"], jaxfit.load(model).cascade
    wait_for_the_others()
    steps = range(1, len(cascade.windows) + 1)
    found = {
        "steps": [(count, crops_a_second(first_steps(cascade, count), crops, batch, repetitions)) for count in steps]
    }
    if isinstance(cascade.space, PointSpace):
        landmarks = len(cascade.space.mean)
        counts = sorted({max(1, round(landmarks * share / 8)) for share in range(1, 9)})
        parts = {count: first_landmarks(cascade, count) for count in counts}
        found["landmarks"] = [(count, crops_a_second(part, crops, batch, repetitions)) for count, part in parts.items()]
    return found


def first_landmarks(cascade: Any, count: int) -> Any:
    """A cascade that is as much work as one of so many landmarks; what it finds is of no use."""
    from jaxfit.shapes.points import PointSpace

    space, directions = PointSpace(cascade.space.mean[:count]), cascade.directions
    weights = [of_step[: count * cascade.descriptor.size] for of_step in cascade.weights]
    if directions is None:
        weights = [of_step[:, : space.size] for of_step in weights]
    else:
        directions = directions[..., : space.size]
    biases = cascade.biases[:, : space.size]
    return replace(cascade, space=space, weights=tuple(weights), biases=biases, directions=directions)


def jaxfit_first(model: str, faces: str, begin: float) -> float:
    """Seconds from ``begin``, when this process was started, to the first face that is fitted."""
    import jaxfit

    given = np.load(faces)
    fits = jaxfit.fit(jaxfit.load(model), [given["picture"]], given["box"][None])
    if not fits.fitted.all():
        raise SystemExit(str(fits.problems))
    return time.time() - begin


def dlib_first(model: str, faces: str, begin: float) -> float:
    """The same of dlib's shape predictor."""
    import dlib

    given = np.load(faces)
    dlib.shape_predictor(model)(given["picture"], dlib.rectangle(*map(int, given["rectangle"])))
    return time.time() - begin


def dlib_speed(model: str, faces: str, batches: list[int], repetitions: int) -> dict[str, Any]:
    import cv2
    import dlib

    given = np.load(faces)
    begin = time.perf_counter()
    predictor = dlib.shape_predictor(model)
    load = time.perf_counter() - begin
    wait_for_the_others()
    rectangle = dlib.rectangle(*map(int, given["rectangle"]))
    latency, peak = median_seconds(partial(predictor, given["picture"], rectangle), repetitions), peak_mib()
    count = max(batches)
    crops = np.resize(given["crops"], (count, *given["crops"].shape[1:]))
    rectangles = [dlib.rectangle(*map(int, sides)) for sides in np.resize(given["rectangles"], (count, 4))]

    def fit_all() -> None:
        for crop, rectangle in zip(crops, rectangles, strict=True):
            predictor(crop, rectangle)

    speeds = [{"batch": None, "faces/s": count / median_seconds(fit_all, repetitions), "peak MiB": peak_mib()}]
    files = list(zip(given["paths"].tolist(), given["in_pictures"], strict=True))

    def fit_files() -> None:
        for path, sides in files:
            predictor(cv2.imread(path, cv2.IMREAD_GRAYSCALE), dlib.rectangle(*map(int, sides)))

    return {
        "load s": load,
        "latency ms": 1000 * latency,
        "peak MiB": peak,
        "from files/s": len(files) / median_seconds(fit_files, min(3, repetitions)),
        "speeds": speeds,
    }


def wait_for_the_others() -> None:
    """Processes that are measured together begin together."""
    print("ready", flush=True)
    sys.stdin.readline()


def peak_mib() -> float:
    """The most memory that this process has held."""
    # Not getrusage's, which on Linux is never less than what the process that started this one has held.
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:")]
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    main()
