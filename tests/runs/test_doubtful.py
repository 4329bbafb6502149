"""Faces that stand on their heads, and boxes without a face: all that is written and drawn agrees that fits are bad."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxfit
from jaxfit.cli.track import _drawn
from jaxfit.data.pictures import write_image
from jaxfit.fitting import TrackedFrame
from jaxfit.serving.service import Service

ORANGE, CYAN = (255, 140, 0), (0, 255, 255)


def has(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
    """Whether a picture has many pixels of nearly this colour, as JPEG leaves them."""
    return int((np.abs(picture.astype(int) - colour).max(2) < 60).sum()) > 30


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    cbook = pytest.importorskip("matplotlib.cbook")
    picture = jaxfit.read_image(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))
    return np.repeat(picture.mean(2).astype(np.uint8)[..., None], 3, 2)  # grey: colours are what is drawn


class Boxes:
    """A detector that draws one box, whatever is there."""

    kinds = ("square",)
    colour = False
    rough = False

    def __init__(self, box: np.ndarray):
        self._box = box

    def __call__(self, picture: np.ndarray) -> list[jaxfit.data.Detection]:
        return [jaxfit.data.Detection(self._box, "square")]


def test_all_that_is_written_and_drawn_agrees(portrait: np.ndarray, tmp_path: Path) -> None:
    model = jaxfit.load("face68")
    (face,) = jaxfit.fit(model, [portrait]).landmarks
    low, side = face.min(0), float(np.ptp(face, axis=0).max())
    height, width = portrait.shape[:2]
    box = np.array([*low, side, side])
    boxes = {
        "upright": box,
        "upside-down": np.array([width - box[0] - side, height - box[1] - side, side, side]),
        "nothing": np.array([20.0, 480.0, 90.0, 90.0]),
    }
    pictures = {name: portrait[::-1, ::-1] if name == "upside-down" else portrait for name in boxes}
    photos = tmp_path / "photos"
    photos.mkdir()
    lines = ["image,x,y,width,height"]
    for name, each in boxes.items():
        write_image(photos / f"{name}.png", pictures[name])
        lines.append(",".join([f"{name}.png", *(f"{value:.3f}" for value in each)]))
    (tmp_path / "boxes.csv").write_text("\n".join(lines) + "\n")

    files = [photos / f"{name}.png" for name in boxes]
    fits = jaxfit.fit(model, files, np.round(list(boxes.values()), 3))
    assert fits.fitted.all()
    assert fits.ok.tolist() == [True, False, False]
    assert "2 doubtful" in repr(fits)

    how: dict[str, Any] = {"boxes": tmp_path / "boxes.csv", "formats": ("csv", "jsonl"), "contact_sheet": True}
    report = jaxfit.fit_folder(jaxfit.FolderRun(out=tmp_path / "out", **how), files)
    assert (report.faces, report.doubtful) == (3, 2)
    with (tmp_path / "out" / "landmarks.csv").open() as table:
        assert [row["ok"] for row in csv.DictReader(table)] == ["1", "0", "0"]
    rows = [json.loads(line) for line in (tmp_path / "out" / "faces.jsonl").read_text().splitlines()]
    assert [row["ok"] for row in rows] == fits.ok.tolist()
    drawn = [jaxfit.read_image(tmp_path / "out" / "overlays" / f"{name}.jpg") for name in boxes]
    check_colours(drawn, fits.ok)

    jaxfit.fit_folder(jaxfit.FolderRun(out=tmp_path / "sure", min_confidence=0.5, overlays=False, **how), files)
    for name, faces in {"landmarks": ["upright"], "doubtful": ["nothing", "upside-down"]}.items():
        with (tmp_path / "sure" / f"{name}.csv").open() as table:
            assert sorted(Path(row["image"]).stem for row in csv.DictReader(table)) == faces

    detectors: dict[str, Any] = {name: Boxes(each) for name, each in boxes.items()}
    service = Service({"face68": model}, detectors)
    answers = [service.fit(path.read_bytes(), "face68", path.stem)["faces"] for path in files]
    service.close()
    assert [face["ok"] for (face,) in answers] == fits.ok.tolist()

    def film(row: int) -> np.ndarray:
        one = np.array([1])
        return _drawn(TrackedFrame(row, 0.0, pictures[list(boxes)[row]], fits[row : row + 1], one, one))

    check_colours([film(row) for row in range(3)], fits.ok)


def check_colours(drawn: list[np.ndarray], ok: np.ndarray) -> None:
    """Good fits are drawn in cyan, and no other in anything but orange."""
    assert [has(picture, CYAN) for picture in drawn] == ok.tolist()
    assert [has(picture, ORANGE) for picture in drawn] == (~ok).tolist()


def test_the_page_asks_what_all_ask() -> None:
    page = (Path(jaxfit.__file__).parent / "serving" / "page.html").read_text(encoding="utf-8")
    assert "face.confidence <" not in page  # a rule of its own
    assert page.count("face.ok") >= 5
