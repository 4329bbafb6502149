"""Fitting a folder: every picture accounted for in every format; stopped and killed runs go on."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from csv_files import labelled_box, read_csv, write_boxes
from jax import numpy as jnp

import jaxfit
from jaxfit.cascade.confidence import Confidence, count_moves
from jaxfit.cascade.starts import Starts
from jaxfit.data.boxes import bounding_square
from jaxfit.data.detectors import Search
from jaxfit.data.detectors.whole import Whole
from jaxfit.data.overlays import draw_head, draw_landmarks
from jaxfit.data.pictures import find_images, read_image, write_image
from jaxfit.data.pts import read_pts
from jaxfit.data.writers import WRITERS
from jaxfit.errors import InputError
from jaxfit.fitting import Fitting
from jaxfit.labels.records import FaceRecord
from jaxfit.models.files import save
from jaxfit.models.model import Model
from jaxfit.runs import FolderReport, FolderRun, fit_folder, folder
from jaxfit.runs.run_folder import RunFolder
from jaxfit.schemes.known import AFLW21

_CHUNK = 4
_BROKEN = (3, 8)  # numbers of the pictures that are none


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory, drawn: Path) -> Path:
    """Boxes of twelve pictures."""
    squares = {f"{number:02}.png": labelled_box(drawn / f"face{number % 4:03}.png") for number in range(12)}
    return write_boxes(tmp_path_factory.mktemp("boxes") / "boxes.csv", squares)


@pytest.fixture(scope="module")
def pictures(drawn: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Twelve pictures, the fourth and the ninth of which are none."""
    folder = tmp_path_factory.mktemp("many")
    paths = [folder / f"{number:02}.png" for number in range(12)]
    for number, path in enumerate(paths):
        path.write_bytes((drawn / f"face{number % 4:03}.png").read_bytes() if number not in _BROKEN else b"no picture")
    return paths


@pytest.fixture(autouse=True, scope="module")
def _small_chunks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folder, "_CHUNK", _CHUNK)
        yield


@pytest.fixture
def run(drawn_model: Path, boxes: Path, tmp_path: Path) -> FolderRun:
    return FolderRun(tmp_path / "out", drawn_model, boxes=boxes)


@pytest.fixture(scope="module")
def whole(
    drawn_model: Path, boxes: Path, pictures: list[Path], tmp_path_factory: pytest.TempPathFactory
) -> tuple[FolderReport, Path]:
    """What a run that writes everything says, and where it has written."""
    pytest.importorskip("pyarrow")
    out = tmp_path_factory.mktemp("whole") / "out"
    everything = FolderRun(out, drawn_model, boxes=boxes, formats=tuple(WRITERS), contact_sheet=True)
    return fit_folder(everything, pictures), out


def test_every_picture_is_accounted_for(whole: tuple[FolderReport, Path], pictures: list[Path]) -> None:
    report, out = whole
    assert (report.pictures, report.resumed, report.faces, report.unused) == (12, 0, 10, ())
    fitted, problems = read_csv(out / "landmarks.csv"), read_csv(out / "problems.csv")
    names = [Path(row["image"]).name for row in fitted]
    assert [Path(row["image"]).name for row in problems] == ["03.png", "08.png"]
    assert sorted([*names, "03.png", "08.png"]) == [path.name for path in pictures]
    assert [tuple(row.values()) for row in problems] == list(report.problems)
    assert {why for _, why in report.problems} == {"not a picture, damaged, or of a format that OpenCV does not read"}


def test_every_format_is_written_and_nothing_else(whole: tuple[FolderReport, Path]) -> None:
    report, out = whole
    assert len(json.loads((out / "keypoints.json").read_text())["annotations"]) == 10
    assert len((out / "faces.jsonl").read_text().splitlines()) == 10
    assert len(list((out / "pts").iterdir())) == len(list((out / "overlays").iterdir())) == 10
    assert read_image(out / "contact-sheet.jpg").std() > 10
    assert {path.name for path in out.iterdir()} == {path.name for path in report.written}
    assert {path.name for path in report.written} == {
        *("landmarks.csv", "problems.csv", "faces.jsonl", "keypoints.json", "landmarks.parquet"),
        *("landmarks.tps", "landmarks.xml"),
        *("contact-sheet.jpg", "pts", "overlays", "manifest.json"),
    }
    assert len(report.written) == 11


def test_tables_pts_files_and_overlays_show_the_faces(whole: tuple[FolderReport, Path], drawn: Path) -> None:
    _, out = whole
    for row in read_csv(out / "landmarks.csv"):
        listed = np.array([[float(row[f"{axis}{i}"]) for axis in "xy"] for i in range(1, 6)])
        # .pts files count from 1, the table from 0.
        np.testing.assert_allclose(read_pts(out / "pts" / f"{row['face']}.pts"), listed, atol=2e-3)
        picture = Path(row["image"])
        truth = read_pts(drawn / f"face{int(picture.stem) % 4:03}.pts")
        assert np.linalg.norm(listed - truth, axis=1).mean() < 2
        overlay = read_image(out / "overlays" / f"{picture.stem}.jpg")
        assert np.abs(overlay.astype(int) - read_image(picture)).max() > 60


def test_bad_pictures_do_not_stop_the_others(run: FolderRun, drawn: Path, tmp_path: Path) -> None:
    given = tmp_path / "pictures"
    given.mkdir()
    good = (drawn / "face000.png").read_bytes()
    (given / "good.png").write_bytes(good)
    (given / "cut.png").write_bytes(good[:300])
    (given / "text.jpg").write_text("not a picture")
    (given / "empty.png").write_bytes(b"")
    (given / "missing.png").write_bytes(good)
    write_image(given / "outside.png", np.zeros((40, 40, 3), np.uint8))
    squares = {name: (35, 35, 50, 50) for name in ("good.png", "cut.png", "text.jpg", "empty.png", "elsewhere.png")}
    table = write_boxes(tmp_path / "boxes.csv", {**squares, "outside.png": (300, 300, 9, 9)})
    report = fit_folder(replace(run, boxes=table), sorted(given.iterdir()))
    assert (report.faces, report.unused) == (1, ("elsewhere.png",))
    reasons = {Path(image).name: why for image, why in report.problems}
    for name, words in {
        "cut.png": "truncated",
        "empty.png": "empty",
        "missing.png": "no row with this file name",
        "outside.png": "outside the 40 x 40 picture",
        "text.jpg": "not a picture",
    }.items():
        assert words in reasons.pop(name)
    assert not reasons
    assert not any(str(given) in why for _, why in report.problems)


def test_pictures_of_one_name_have_results_of_different_names(run: FolderRun, drawn: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "same.png").write_bytes((drawn / "face000.png").read_bytes())
    boxes = {"a/same.png": (35, 35, 50, 50), "b/same.png": (37, 33, 52, 52)}
    table, out = write_boxes(tmp_path / "boxes.csv", boxes), Path(run.out)
    pictures = [tmp_path / name for name in boxes]
    assert fit_folder(replace(run, boxes=table), pictures).faces == 2
    rows = read_csv(out / "landmarks.csv")
    found = {Path(row["image"]): [float(row[side]) for side in ("x", "y", "width", "height")] for row in rows}
    assert found == {picture: list(box) for picture, box in zip(pictures, boxes.values(), strict=True)}
    assert {path.name for path in (out / "pts").iterdir()} == {"same_1.pts", "same-2_1.pts"}
    assert {path.name for path in (out / "overlays").iterdir()} == {"same.jpg", "same-2.jpg"}
    # What was written does for boxes: the same faces again.
    again = replace(run, boxes=out / "landmarks.csv", out=tmp_path / "again")
    assert fit_folder(again, pictures).problems == ()
    assert read_csv(tmp_path / "again" / "landmarks.csv") == rows
    # One picture alone does not get the other's box; a name that may mean both is refused.
    alone = fit_folder(replace(run, boxes=write_boxes(table, {"a/same.png": (35, 35, 50, 50)})), pictures[1:])
    assert alone.problems[0].why == "no row with this path in the boxes, only a/same.png"
    assert alone.unused == ("a/same.png",)
    bare = replace(run, boxes=write_boxes(table, {"same.png": (35, 35, 50, 50)}))
    with pytest.raises(InputError, match=rf"'same.png' may mean {pictures[0]} or {pictures[1]}"):
        fit_folder(bare, pictures)
    # Relative to a folder that was given it is one of them.
    assert fit_folder(replace(bare, folders=(tmp_path / "a",)), pictures).faces == 1


def test_all_faces_of_a_picture_are_fitted(run: FolderRun, drawn: Path, tmp_path: Path) -> None:
    paths = [drawn / f"face{number:03}.png" for number in (0, 1)]
    one, other = map(read_image, paths)
    write_image(tmp_path / "both.png", np.hstack([one, other]))
    left, right = map(labelled_box, paths)
    right = right + [one.shape[1], 0, 0, 0]
    rows = "".join(f"both.png,{','.join(map(str, square))}\n" for square in (left, right))
    (tmp_path / "boxes.csv").write_text(f"image,x,y,width,height\n{rows}")
    fit_folder(replace(run, boxes=tmp_path / "boxes.csv", formats=("csv", "coco")), [tmp_path / "both.png"])
    faces = read_csv(Path(run.out) / "landmarks.csv")
    assert [row["face"] for row in faces] == ["both_1", "both_2"]
    apart = float(faces[1]["x1"]) - float(faces[0]["x1"])
    assert apart == pytest.approx(right[0] - left[0], abs=0.3 * left[2])
    content = json.loads((Path(run.out) / "keypoints.json").read_text())
    assert [image["width"] for image in content["images"]] == [one.shape[1] + other.shape[1]]


@pytest.mark.parametrize("method", ["alignment3d", "regression3d"])
def test_3d_models_write_heads(
    heads: tuple[FaceRecord, ...], head_models: dict[str, Model], tmp_path: Path, method: str
) -> None:
    save(head_models[method], tmp_path / "heads.safetensors")
    pictures = [face.image for face in heads[:3]]
    squares = [bounding_square(face.landmarks) for face in heads[:3]]
    named = {picture.name: box for picture, box in zip(pictures, squares, strict=True)}
    boxes = write_boxes(tmp_path / "boxes.csv", named | {pictures[1].name: np.array([900, 900, 9, 9])})
    out = tmp_path / "out"
    fit_folder(FolderRun(out, tmp_path / "heads.safetensors", boxes=boxes), pictures)
    images = [read_image(picture) for picture in pictures]
    fits = jaxfit.fit(head_models[method], images, squares)
    assert fits.landmarks_3d is not None
    assert fits.pose is not None
    assert fits.scale is not None
    assert fits.b is not None
    rows, flat = read_csv(out / "heads.csv"), read_csv(out / "landmarks.csv")
    points = [f"{axis}{i}" for i in range(1, 22) for axis in "xyz"]
    modes = [f"b{i}" for i in range(1, fits.b.shape[1] + 1)]
    angles = ["roll", "pitch", "yaw"]
    assert list(rows[0]) == ["image", "face", "ok", *angles, "scale", *points, *modes]
    assert [row["face"] for row in rows] == [row["face"] for row in flat] == [f"{pictures[n].stem}_1" for n in (0, 2)]
    for row, plane, number in zip(rows, flat, (0, 2), strict=True):
        assert row["image"] == plane["image"] == str(pictures[number])
        solid = np.array([float(row[name]) for name in points]).reshape(21, 3)
        np.testing.assert_allclose(solid, fits.landmarks_3d[number], atol=1e-3)
        np.testing.assert_allclose(np.array([float(row[name]) for name in angles]), fits.pose[number], atol=1e-3)
        np.testing.assert_allclose(np.array([float(row[name]) for name in modes]), fits.b[number], atol=1e-3)
        assert float(row["scale"]) == pytest.approx(fits.scale[number], abs=1e-3)
        in_picture = np.array([[float(plane[f"{axis}{i}"]) for axis in "xy"] for i in range(1, 22)])
        np.testing.assert_allclose(in_picture, fits.landmarks[number], atol=1e-3)
        if method == "regression3d":
            np.testing.assert_allclose(solid[:, :2], in_picture, atol=2e-3)
        overlay = read_image(out / "overlays" / f"{pictures[number].stem}.jpg").astype(float)
        in_3d = draw_head(images[number], fits.landmarks_3d[number], fits.pose[number], AFLW21, squares[number])
        in_2d = draw_landmarks(images[number], fits.landmarks[number], AFLW21, squares[number])
        assert np.abs(overlay - in_3d).mean() < 0.8 * np.abs(overlay - in_2d).mean()  # JPEG blurs colours


def test_wrong_settings_stop_before_anything_is_written(run: FolderRun, pictures: list[Path], tmp_path: Path) -> None:
    wrong: dict[str, dict[str, Any]] = {
        "only models of the method alignment3d": {"refine": True},
        "give that file too": {"boxes": None, "box_kind": "whole"},
        "detector that finds them; got both": {"fitting": Fitting("whole")},
        "how faces are looked for .*; got both": {"fitting": Fitting(search=Search(smallest=30.0))},
        "min confidence: expected a number from 0 to 1.* got 7": {"min_confidence": 7.0},
        "min confidence: expected a number from 0 to 1.* got nan": {"min_confidence": float("nan")},
        "boxes of the kinds square": {"box_kind": "nobody"},
        "expected formats among csv, pts, .*; got 'xml'": {"formats": ("csv", "xml")},
        "detector among": {"boxes": None, "fitting": Fitting("nose")},
        "the name of a detector": {"boxes": None, "fitting": Fitting(Whole())},
    }
    for words, settings in wrong.items():
        with pytest.raises(InputError, match=words):
            fit_folder(replace(run, **settings), pictures)
    assert not Path(run.out).exists()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="expected a folder to write to"):
        fit_folder(replace(run, out=tmp_path / "file"), pictures)


class _Stopped(Exception):
    """Where a run is stopped in these tests."""


def _fit_until(run: FolderRun, pictures: list[Path], chunk: int) -> None:
    """Stop a run when it wants to keep the chunk of this number."""
    put = RunFolder.put

    def stop(self: Any, number: int, rows: Any) -> None:
        if number == chunk:
            raise _Stopped
        put(self, number, rows)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFolder, "put", stop)
        with pytest.raises(_Stopped):
            fit_folder(run, pictures)


def _assert_same_results(out: Path, whole: Path) -> None:
    """All that a run of the usual formats writes is what a run that was not stopped has written, byte for byte."""
    files = [path.relative_to(out) for path in out.rglob("*") if path.is_file() and path.name != "manifest.json"]
    assert {path.parts[0] for path in files} == {"landmarks.csv", "problems.csv", "pts", "overlays"}
    for file in files:
        assert (out / file).read_bytes() == (whole / file).read_bytes(), file


def test_a_stopped_run_goes_on_where_it_was(
    run: FolderRun, pictures: list[Path], whole: tuple[FolderReport, Path], tmp_path: Path
) -> None:
    out = Path(run.out)
    _fit_until(run, pictures, 2)
    assert not (out / "landmarks.csv").exists()
    other = write_boxes(tmp_path / "other.csv", {pictures[0].name: (35, 35, 50, 50)})
    # A run of other pictures, or with other settings, must not go on from there.
    for changed in ({"overlays": False}, {"fitting": Fitting(starts=Starts(3))}, {"boxes": other}):
        with pytest.raises(InputError, match=r"holds results of other settings \(.*overwrite \(--overwrite\) to begin"):
            fit_folder(replace(run, **changed), pictures)
    with pytest.raises(InputError, match="pictures: 12 there, 11 here"):
        fit_folder(run, pictures[1:])
    calls: list[tuple[str, int, int]] = []
    report = fit_folder(run, pictures, progress=lambda *call: calls.append(call))
    assert (report.pictures, report.resumed, report.faces) == (12, 8, 10)
    assert report.problems == whole[0].problems
    # Of all pictures, those that were done before among them.
    counts = [(done, total) for stage, done, total in calls if stage == "fitting"]
    assert (counts[0], counts[-1]) == ((8, 12), (12, 12))
    _assert_same_results(out, whole[1])
    # A run that is finished is done anew.
    assert fit_folder(replace(run, overlays=False), pictures).resumed == 0


def test_a_run_owns_its_folder(run: FolderRun, pictures: list[Path], tmp_path: Path) -> None:
    """What a run before wrote goes, what others wrote stays, and what no manifest lists is refused."""
    out = Path(run.out)
    first = replace(run, formats=("csv", "pts", "jsonl"), contact_sheet=True)
    fit_folder(first, pictures[:3])
    (out / "heads.csv").write_text("of a 3D model")
    manifest = json.loads((out / "manifest.json").read_text())
    assert (manifest["command"], manifest["jaxfit"]) == ("jaxfit fit", jaxfit.__version__)
    assert manifest["when"].startswith("20")
    there = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert {*manifest["files"], "manifest.json", "heads.csv"} == there
    manifest["files"] += ["heads.csv", "../kept.csv", str(tmp_path / "kept.csv")]
    (out / "manifest.json").write_text(json.dumps(manifest))
    for kept in (tmp_path / "kept.csv", out / "pts" / "mine.pts", out / "notes.txt"):
        kept.write_text("mine")
    said = fit_folder(replace(run, formats=("csv",), overlays=False), pictures[1:2]).replaced
    assert f"replaced what `jaxfit fit` wrote to {out} at " in said
    assert "overlays: yes there, no here; pictures: 3 there, 1 here" in said
    assert fit_folder(replace(run, formats=("csv",), overlays=False), pictures[1:2]).replaced == ""
    there = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert there == {"landmarks.csv", "problems.csv", "manifest.json", "pts/mine.pts", "notes.txt"}
    assert (tmp_path / "kept.csv").exists()
    for account, words in (
        (manifest | {"command": "jaxfit track"}, "holds results of `jaxfit track`.*overwrite"),
        ([], "expected the manifest"),
        (None, r"holds landmarks.csv, which no manifest.json lists.*overwrite"),
    ):
        if account is None:
            (out / "manifest.json").unlink()
        else:
            (out / "manifest.json").write_text(json.dumps(account))
        with pytest.raises(InputError, match=words):
            fit_folder(run, pictures[:1])
        assert not (out / ".unfinished").exists()
    (out / "heads.csv").write_text("of a 3D model")
    (out / "manifest.json").write_text("damaged")
    fit_folder(replace(run, overwrite=True), pictures[:1])
    assert not (out / "heads.csv").exists()


def test_other_pictures_of_the_same_names_are_other_settings(
    run: FolderRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digests = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        digests.append(run.settings([Path("001.png")])["pictures' names"])
    assert digests[0] != digests[1]


def test_overwriting_an_unfinished_run(run: FolderRun, pictures: list[Path]) -> None:
    _fit_until(replace(run, overlays=False), pictures[:4], 0)
    with pytest.raises(InputError, match="overlays: no there, yes here"):
        fit_folder(run, pictures[:4])
    assert fit_folder(replace(run, overwrite=True), pictures[:4]).faces == 3


_DIES = f"""
import os, signal, sys
from jaxfit.runs import FolderRun, fit_folder, folder
from jaxfit.runs.run_folder import RunFolder

folder._CHUNK = {_CHUNK}
put = RunFolder.put

def rows_and_death(rows):
    yield rows[0]
    os.kill(os.getpid(), signal.SIGKILL)

RunFolder.put = lambda self, number, rows: put(self, number, rows_and_death(rows) if number == 1 else rows)
out, model, boxes, *pictures = sys.argv[1:]
fit_folder(FolderRun(out, model, boxes=boxes), pictures)
"""


@pytest.mark.skipif(os.name != "posix", reason="kills a process")
def test_a_run_that_is_killed_while_it_writes_leaves_whole_chunks(
    run: FolderRun, pictures: list[Path], whole: tuple[FolderReport, Path]
) -> None:
    arguments = [run.out, run.model, run.boxes, *pictures]
    killed = subprocess.run([sys.executable, "-c", _DIES, *map(str, arguments)], check=False)
    assert killed.returncode == -signal.SIGKILL
    out = Path(run.out)
    assert [path.name.partition("-")[0] for path in (out / ".unfinished").glob("[!.]*.jsonl")] == ["0000000"]
    assert list((out / ".unfinished").glob(".*"))  # of the chunk that was being written
    assert fit_folder(run, pictures).resumed == _CHUNK
    _assert_same_results(out, whole[1])
    assert not (out / ".unfinished").exists()


def test_results_within_the_pictures_folder_are_no_pictures(run: FolderRun, drawn: Path, tmp_path: Path) -> None:
    """A picture that links to nothing is a problem, and not left out."""
    given = tmp_path / "pictures"
    given.mkdir()
    (given / "00.png").write_bytes((drawn / "face000.png").read_bytes())
    (given / "lost.png").symlink_to(given / "nowhere.png")
    inside = replace(run, out=given / "results", contact_sheet=True)
    for _ in range(2):
        report = fit_folder(inside, find_images([given], recursive=True))
        assert (report.pictures, report.faces) == (2, 1)
        assert [Path(image).name for image, _ in report.problems] == ["lost.png"]


def test_nothing_that_was_given_is_written_over(run: FolderRun, drawn: Path, tmp_path: Path) -> None:
    """Pictures in a folder called like one of results, in --out itself or behind a link; boxes called like a table."""
    given = tmp_path / "photos" / "overlays"
    given.mkdir(parents=True)
    picture, good = given / "a.jpg", (drawn / "face000.png").read_bytes()
    picture.write_bytes(good)
    (tmp_path / "linked").symlink_to(tmp_path / "photos", target_is_directory=True)
    boxes = write_boxes(tmp_path / "photos" / "problems.csv", {"a.jpg": (35, 35, 50, 50)})
    for out in (tmp_path / "photos", tmp_path / "linked"):
        there = replace(run, out=out, overwrite=True)  # results, and not what was given
        with pytest.raises(InputError, match=r"a\.jpg was given as input"):
            fit_folder(there, [picture])
        with pytest.raises(InputError, match=r"problems\.csv was given as input"):
            fit_folder(replace(there, boxes=boxes, overlays=False), [picture])
    assert picture.read_bytes() == good
    assert sorted(path.name for path in (tmp_path / "photos").rglob("*")) == ["a.jpg", "overlays", "problems.csv"]


def test_only_what_a_run_wrote_is_left_out(run: FolderRun, drawn: Path, tmp_path: Path) -> None:
    """Pictures in the folder of results are pictures, but for the overlays of a run that finished, or was stopped."""
    out = tmp_path / "photos"
    out.mkdir()
    for number in range(8):
        (out / f"{number:02}.png").write_bytes((drawn / f"face{number % 4:03}.png").read_bytes())
    inside = replace(run, out=out)
    _fit_until(inside, find_images([out]), 1)
    for resumed in (_CHUNK, 0):
        assert (out / "overlays" / "00.jpg").is_file()
        report = fit_folder(inside, find_images([out], recursive=True))
        assert (report.pictures, report.faces, report.resumed) == (8, 8, resumed)
        assert {path.parent.name for path in report.left_out} == {"overlays"}
    assert len(report.left_out) == 8
    # What others put beside the results is theirs, whenever they did.
    (out / "overlays" / "mine.png").write_bytes((drawn / "face000.png").read_bytes())
    assert fit_folder(replace(inside, overlays=False), find_images([out])).pictures == 8
    assert [path.name for path in (out / "overlays").iterdir()] == ["mine.png"]


def test_inputs_that_have_changed_are_noticed(run: FolderRun, drawn: Path, tmp_path: Path) -> None:
    pictures = [tmp_path / f"{number:02}.png" for number in range(8)]
    for path in pictures:
        path.write_bytes((drawn / "face000.png").read_bytes())
    _fit_until(run, pictures, 1)
    pictures[2].write_bytes(b"no picture any more")
    report = fit_folder(run, pictures)
    assert (report.resumed, report.faces) == (0, 7)
    assert [Path(image).name for image, _ in report.problems] == ["02.png"]
    detector = tmp_path / "detector.onnx"
    detector.write_bytes(b"one")
    of_file = replace(run, boxes=None, fitting=Fitting(f"yunet:{detector}"))
    before = of_file.settings(pictures)
    detector.write_bytes(b"another")
    assert before != of_file.settings(pictures)


def test_a_detector_finds_the_faces_where_there_are_no_boxes(run: FolderRun, drawn: Path) -> None:
    report = fit_folder(replace(run, model="fast68", boxes=None, fitting=Fitting("whole")), [drawn / "face000.png"])
    assert report.faces == 1
    assert [row["box"] for row in read_csv(Path(run.out) / "landmarks.csv")] == ["whole"]


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are not any bytes elsewhere")
def test_no_name_of_a_picture_spoils_a_run(run: FolderRun, drawn: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    good, odd = (drawn / "face000.png").read_bytes(), tmp_path / "odd"
    long = b"l" * 251 + b".png"
    names = (
        b"\xe9t\xe9.png",
        long,
        b"l" * 250 + b"!.png",
        b"=1+1.png",
        b"-rf.png",
        b"new\nline.png",
        b"c:\\..\\up.png",
    )
    odd.mkdir()
    for name in (*names, b"\xff.png"):
        Path(os.fsdecode(os.path.join(os.fsencode(odd), name))).write_bytes(b"" if name == b"\xff.png" else good)
    out = Path(run.out)
    (out / "pts" / "_-rf_1.pts").mkdir(parents=True)  # what cannot be written is a problem of its picture alone
    (out / "overlays" / "new_line.jpg").mkdir(parents=True)
    whole = replace(run, boxes=None, fitting=Fitting("whole"), formats=tuple(WRITERS), model="fast68")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(odd)
        report = fit_folder(whole, find_images(["."]))
        assert report.faces == len(names)
        rows, problems = read_csv(out / "landmarks.csv"), read_csv(out / "problems.csv")
        assert {row["image"] for row in rows} == {
            *(r"\xe9t\xe9.png", os.fsdecode(long), "l" * 250 + "!.png", "./=1+1.png", "./-rf.png"),
            *(r"new\x0aline.png", r"c:\\..\\up.png"),
        }
        assert {row["image"]: row["problem"].split(":")[0] for row in problems} == {
            r"\xff.png": "the file is empty",
            "./-rf.png": f"cannot write {out / 'pts' / '_-rf_1.pts'}",
            r"new\x0aline.png": f"cannot write {out / 'overlays' / 'new_line.jpg'}",
        }
        # All tables say the same, in valid UTF-8, and do for boxes.
        for table in ("landmarks.csv", "problems.csv", "faces.jsonl", "keypoints.json"):
            (out / table).read_text(encoding="utf-8")
        lines = (out / "faces.jsonl").read_text(encoding="utf-8").splitlines()
        assert [json.loads(line)["image"] for line in lines] == [row["image"] for row in rows]
        for file in os.listdir(out / "pts"):
            assert re.fullmatch(r"[\w.!=+-]+", file, re.ASCII), file
        again = replace(whole, boxes=out / "landmarks.csv", fitting=Fitting(), out=tmp_path / "again", formats=("csv",))
        assert fit_folder(again, find_images(["."])).unused == ()
    assert {row["image"] for row in read_csv(tmp_path / "again" / "landmarks.csv")} == {row["image"] for row in rows}


def test_doubtful_faces_stand_apart_if_so_wished(
    drawn_model: Path, boxes: Path, pictures: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="has no confidence; leave it out"):
        fit_folder(FolderRun(tmp_path / "none", drawn_model, boxes=boxes, min_confidence=0.5), pictures)
    stream = folder.stream

    def with_confidence(*given: Any) -> Iterator[jaxfit.Fits]:
        """The first face of each chunk is doubtful."""
        for fits in stream(*given):
            yield replace(fits, confidence=np.where(np.cumsum(fits.fitted) == 1, 0.2, 0.9))

    monkeypatch.setattr(folder, "stream", with_confidence)
    monkeypatch.setattr(folder, "load", lambda path: replace(jaxfit.load(path), confidence=_confidence()))
    everything = fit_folder(FolderRun(tmp_path / "all", drawn_model, boxes=boxes), pictures)
    assert (everything.faces, everything.doubtful) == (10, 3)
    rows = read_csv(tmp_path / "all" / "landmarks.csv")
    some = fit_folder(FolderRun(tmp_path / "some", drawn_model, boxes=boxes, min_confidence=0.5), pictures)
    assert (some.faces, some.set_apart, everything.set_apart) == (10, 3, 0)
    sure, doubtful = (read_csv(tmp_path / "some" / name) for name in ("landmarks.csv", "doubtful.csv"))
    assert sure == [row for row in rows if row["ok"] == "1"]
    assert doubtful == [row for row in rows if row["ok"] == "0"]
    assert len(doubtful) == 3
    assert len(list((tmp_path / "some" / "pts").iterdir())) == 7


def _confidence() -> Confidence:
    """Of the drawn model: five points seen by SIFT, two steps."""
    sizes = [(5 * 128, 3), (count_moves(2), 3), (3,), (3,), ()]
    return Confidence(*(jnp.zeros(size, jnp.float32) for size in sizes))
