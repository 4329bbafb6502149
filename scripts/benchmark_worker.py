"""Measure one method in a process of its own, which ``benchmark.py`` starts on the cores that it may use.

It says ``ready``, waits for a line, measures, and ends with a line of JSON. Nothing is taken from a cache of compiled
code.
"""

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np


def main() -> None:
    job = json.loads(sys.argv[1])
    measure = {"jaxfit": jaxfit_speed, "dlib": dlib_speed}[job.pop("measure")]
    print(json.dumps(measure(**job)))


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
        crops = np.resize(given["crops"], (batch, *given["crops"].shape[1:]))
        seconds = median_seconds(lambda crops=crops: np.asarray(jaxfit.fit_crops(loaded.cascade, crops)), repetitions)
        speeds.append({"batch": batch, "faces/s": batch / seconds, "peak MiB": peak_mib()})
    return {"load s": load, "compile s": compiling, "latency ms": 1000 * latency, "peak MiB": peak, "speeds": speeds}


def dlib_speed(model: str, faces: str, batches: list[int], repetitions: int) -> dict[str, Any]:
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
    return {"load s": load, "latency ms": 1000 * latency, "peak MiB": peak, "speeds": speeds}


def wait_for_the_others() -> None:
    """Processes that are measured together begin together."""
    print("ready", flush=True)
    sys.stdin.readline()


def median_seconds(work: Callable[[], Any], repetitions: int) -> float:
    work()
    times = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def peak_mib() -> float:
    """The most memory that this process has held."""
    # Not getrusage's, which on Linux is never less than what the process that started this one has held.
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:")]
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    main()
