"""Landmarks that MediaPipe's face mesh finds in pictures, as a table that ``jaxfit compare`` reads.

Runs in an environment of its own, without jaxfit: ``pip install mediapipe==0.10.21``.

    python mediapipe_fits.py pictures.txt mediapipe.csv
"""

import csv
import json
import resource
import sys
import time
from pathlib import Path

import cv2
import mediapipe
import numpy as np

FACES = 10  # at most in a picture


def main(pictures: str, out: str) -> None:
    """``pictures`` has a path a line; ``out`` gets a row a face. What it took is printed as JSON."""
    mesh = mediapipe.solutions.face_mesh.FaceMesh(static_image_mode=True, max_num_faces=FACES, refine_landmarks=True)
    names = Path(pictures).read_text(encoding="utf-8").splitlines()
    seconds = 0.0
    with open(out, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["image", *(f"{axis}{number}" for number in range(1, 479) for axis in "xy")])
        for name in names:
            picture = cv2.imread(name)
            if picture is None:
                print(f"{name}: cannot be read", file=sys.stderr)
                continue
            begin = time.perf_counter()
            found = mesh.process(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)).multi_face_landmarks or []
            seconds += time.perf_counter() - begin
            height, width = picture.shape[:2]
            for face in found:
                # Shares of the sides, counted from the first pixel's corner; tables count pixels from its centre.
                points = np.array([[point.x * width - 0.5, point.y * height - 0.5] for point in face.landmark])
                writer.writerow([name, *(f"{value:.3f}" for value in points.ravel())])
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    took = {"pictures": len(names), "seconds": seconds, "megabytes": memory, "version": mediapipe.__version__}
    print(json.dumps(took))


if __name__ == "__main__":
    main(*sys.argv[1:])
