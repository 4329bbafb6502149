"""Landmarks that dlib's shape predictor finds in pictures, as a table that ``jaxfit compare`` reads.

Runs in an environment of its own, without jaxfit: ``pip install dlib-bin==20.0.1.post1
opencv-python-headless==4.12.0.88``; the predictor's file is in the package ``face-recognition-models==0.3.0``.

    python dlib_fits.py pictures.txt dlib.csv shape_predictor_68_face_landmarks.dat
    python dlib_fits.py pictures.txt dlib.csv shape_predictor_68_face_landmarks.dat boxes.csv

With ``boxes.csv`` (``image,x,y,width,height``) it fits in these boxes, which should lie as dlib's own do; without, in
those that its detector finds.
"""

import csv
import json
import resource
import sys
import time
from pathlib import Path

import cv2
import dlib


def main(pictures: str, out: str, predictor: str, boxes: str = "") -> None:
    """``pictures`` has a path a line; ``out`` gets a row a face. What it took is printed as JSON."""
    detect, predict = dlib.get_frontal_face_detector(), dlib.shape_predictor(predictor)
    given: dict[str, list[dlib.rectangle]] = {}
    for row in csv.DictReader(Path(boxes).read_text(encoding="utf-8").splitlines() if boxes else []):
        left, top, width, height = (float(row[name]) for name in ("x", "y", "width", "height"))
        rectangle = dlib.rectangle(*map(round, (left, top, left + width - 1, top + height - 1)))
        given.setdefault(row["image"], []).append(rectangle)
    names = Path(pictures).read_text(encoding="utf-8").splitlines()
    seconds = 0.0
    with open(out, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["image", *(f"{axis}{number}" for number in range(1, 69) for axis in "xy")])
        for name in names:
            picture = cv2.imread(name)
            if picture is None:
                print(f"{name}: cannot be read", file=sys.stderr)
                continue
            rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
            begin = time.perf_counter()
            # Once enlarged, as its documentation does: it finds faces from 40 pixels on.
            found = [predict(rgb, box) for box in (given.get(name, []) if boxes else detect(rgb, 1))]
            seconds += time.perf_counter() - begin
            for face in found:
                writer.writerow([name, *(value for point in face.parts() for value in (point.x, point.y))])
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    took = {"pictures": len(names), "seconds": seconds, "megabytes": memory, "version": dlib.__version__}
    print(json.dumps(took))


if __name__ == "__main__":
    main(*sys.argv[1:])
