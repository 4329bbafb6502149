"""Files of programs for labelling: what stands in them is read, what cannot be used is said, with file and place."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from exif_files import oriented
from written_labels import write_picture

from jaxfit.errors import DatasetError
from jaxfit.labels.datasets import read_dataset
from jaxfit.schemes.known import AFLW21

HEAD = "<?xml version='1.0' encoding='ISO-8859-1'?>\n<?xml-stylesheet type='text/xsl' href='a.xsl'?>\n"
BOX = "<box top='1' left='2' width='9' height='8'>"


def read(folder: Path, name: str, text: str, pictures: tuple[str, ...] = ("a.png",)):
    for picture in pictures:
        (folder / picture).parent.mkdir(exist_ok=True)
        write_picture(folder / picture)
    path = folder / {"tps": "l.tps", "imglab": "l.xml", "coco": "l.json"}.get(name, "l.csv")
    path.write_text(text, encoding="utf-8")
    return read_dataset(f"{name}:{path}")


def coco(annotations: list[dict], keypoints: Sequence[str] = ("a", "b"), **more: object) -> str:
    usual = {"image_id": 7, "category_id": 3}
    return json.dumps(
        {
            "images": [{"id": 7, "file_name": "a.png"}],
            "annotations": [{"id": n} | usual | each for n, each in enumerate(annotations, 1)],
            "categories": [{"id": 3, "name": "wing", "keypoints": list(keypoints), **more}],
        }
    )


def test_tps_specimens(tmp_path: Path) -> None:
    text = (
        "LM=3\r\n1 2\r\n-1 -1\r\nNA NA\r\nIMAGE=a.png\r\nID=x 1\r\nSCALE=0.25\r\n"
        "LM=3\n4 5\n6 7\n-0.5 8\nCURVES=1\nPOINTS=2\n1 1\n2 2\nIMAGE=C:\\scans\\b.png\nCOMMENT=first\n"
    )
    found = read(tmp_path, "tps", text, ("a.png", "sub/b.png"))
    first, second = found.faces
    np.testing.assert_array_equal(first.landmarks, [[1, 28], [np.nan] * 2, [np.nan] * 2])
    np.testing.assert_array_equal(first.known, [True, False, False])
    np.testing.assert_array_equal(second.landmarks, [[4, 25], [6, 23], [-0.5, 22]])
    assert (first.face, first.scale, second.scale) == ("a", 0.25, None)
    assert second.image == tmp_path / "sub" / "b.png"
    assert [problem.split(": ", 1)[1] for problem in found.problems] == [
        "CURVES of 1 specimens: only landmarks are read",
        "COMMENT of 1 specimens: only landmarks are read",
    ]


GOOD_TPS = "LM=1\n1 2\nIMAGE=a.png\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("LM=0\nIMAGE=a.png\n", "line 1: LM=0: expected landmarks"),
        ("LM=x\nIMAGE=a.png\n", "line 1: expected LM=NUMBER"),
        ("LM3=1\n1 2 3\nIMAGE=a.png\n", "line 1: landmarks in 3D"),
        ("LM=2\n1 2\nIMAGE=a.png\n", "line 1: says LM=2, but lists 1 points"),
        ("LM=1\n1 2 3\nIMAGE=a.png\n", "line 1: expected two numbers 'x y' a point; got 3"),
        ("LM=1\n1,5 2\nIMAGE=a.png\n", "line 1: line 2: expected 'x y'; got '1,5 2'; numbers need points"),
        ("LM=1\n1 inf\nIMAGE=a.png\n", "line 2: expected 'x y'; got '1 inf'"),
        ("LM=1\n1 2\n3 4\nIMAGE=a.png\n", "line 3: expected KEY=VALUE after 1 points"),
        ("LM=1\n1 2\nID=3\n", "line 1: names no picture"),
        ("LM=1\n1 NA\nIMAGE=a.png\n", "line 1: expected both numbers of a point"),
        ("LM=1\nNA NA\nIMAGE=a.png\n", "line 1: has no point"),
        ("LM=2\n1 2\n3 4\nIMAGE=a.png\nLM=1\n1 2\nIMAGE=a.png\n", "has 2 points, most others have 1"),
        (GOOD_TPS + "SCALE=-1\n", "line 1: expected a scale above 0; got -1"),
        (GOOD_TPS + "SCALE=1,5\n", "line 1: expected SCALE=NUMBER; got SCALE=1,5"),
        ("1 2\n", "line 1: expected LM=NUMBER before all else"),
    ],
)
def test_what_a_tps_file_has_beside_specimens_is_said(text: str, problem: str, tmp_path: Path) -> None:
    found = read(tmp_path, "tps", text + GOOD_TPS)
    assert any(problem in each for each in found.problems), found.problems
    assert found.faces[-1].landmarks.tolist() == [[1, 28]]


def test_tps_of_turned_pictures_counts_from_the_bottom_of_what_was_labelled(tmp_path: Path) -> None:
    stored = cv2.imencode(".jpg", np.full((30, 40), 90, np.uint8))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(oriented(stored, 6))  # seen 30 wide and 40 high
    (tmp_path / "l.tps").write_text("LM=1\n4 25\nIMAGE=a.jpg\n")
    seen, of_stored = (read_dataset(f"{name}:{tmp_path / 'l.tps'}") for name in ("tps", "tps@stored"))
    assert seen.faces[0].landmarks.tolist() == [[4, 15]]
    assert "tps@stored" in seen.problems[0]
    assert of_stored.faces[0].landmarks.tolist() == [[30 - 1 - 5, 4]]  # row 5 and column 4 of the stored pixels


def test_imglab_boxes(tmp_path: Path) -> None:
    a, b = (f"<part name='{name}' x='{x}' y='5'/>" for name, x in (("tip", 3), ("root", 4)))
    text = (
        f"{HEAD}<dataset><name>n</name><images><image file='a.png' width='40' height='30'>{BOX}{a}{b}</box>"
        f"{BOX}{b}<label>wing</label></box>{BOX}</box><box top='0' left='0' width='4' height='4' ignore='1'/>"
        "</image></images></dataset>"
    )
    found = read(tmp_path, "imglab", text)
    assert found.scheme.names == ("root", "tip")
    assert [face.face for face in found.faces] == ["a_1", "a_2", "a_3"]
    nan = [np.nan] * 2
    for face, wanted in zip(found.faces, [[[4, 5], [3, 5]], [[4, 5], nan], [nan, nan]], strict=True):
        np.testing.assert_array_equal(face.landmarks, wanted)
        assert face.box is not None
        assert face.box.tolist() == [2, 1, 9, 8]
    assert [problem.split(", ", 1)[1] for problem in found.problems] == ["line 3: the box is marked to be ignored"]


@pytest.mark.parametrize(
    ("names", "wanted"), [(("00", "02", "01"), ()), (("10", "9"), ("9", "10")), (("b", "a"), ("a", "b"))]
)
def test_numbered_parts_come_in_their_order(names: tuple[str, ...], wanted: tuple[str, ...], tmp_path: Path) -> None:
    parts = "".join(f"<part name='{name}' x='{number}' y='5'/>" for number, name in enumerate(names))
    found = read(
        tmp_path, "imglab", f"<dataset><images><image file='a.png'>{BOX}{parts}</box></image></images></dataset>"
    )
    assert found.scheme.names == wanted
    assert found.faces[0].landmarks[:, 0].tolist() == ([0, 2, 1] if len(names) == 3 else [1, 0])


BOMB = (
    "<!DOCTYPE d [<!ENTITY a 'aaaaaaaaaa'>"
    + "".join(f"<!ENTITY a{n} '{'&a;' * 10 if n == 0 else f'&a{n - 1};' * 10}'>" for n in range(12))
    + "]><dataset>&a11;</dataset>"
)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("imglab", BOMB, "line 1: expected no entities"),
        ("imglab", "<!DOCTYPE d [<!ENTITY a SYSTEM 'file:///etc/passwd'>]><dataset>&a;</dataset>", "no entities"),
        ("imglab", "<annotation/>", "line 1: expected imglab's <dataset>; got <annotation>"),
        ("imglab", "<dataset>\n<images>\n", "line 3: expected imglab's XML; no element found"),
        ("imglab", "<dataset>" + "<a>" * 200, "nested too deeply"),
        ("imglab", f"<dataset><image file='a.png'>{BOX}</box></image></dataset>", "expected boxes with parts"),
        ("coco", "[]", "expected COCO keypoints: .* got a list"),
        ("coco", "[" * 100_000, "expected COCO keypoints"),
        ("coco", '{"images": [], "annotations": [1], "categories": []}', "annotations is no list of objects"),
        ("coco", coco([{"category_id": 9}]), "expected annotations of a category with keypoints"),
        ("coco", coco([{}], skeleton=[[1, 5]]), "categories, wing: .* expected points 1 to 2"),
        ("coco", coco([{}], keypoints=["a", "a"]), "different names"),
        ("csv", "", "it is empty"),
        ("csv", "name,x1,y1\na.png,1,2\n", "line 1: expected a column image"),
        ("csv", "id,X1,Y1\na.png,1,2\n", "say ml-morph:"),
        ("csv", "image,x1\na.png,1\n", "x1 without its y"),
        ("csv", "image,x1,y1,x3,y3\na.png,1,2,3,4\n", "numbered one after the other"),
        ("csv", "image,x1,y1,x1\na.png,1,2,3\n", "x1 come twice"),
        ("ml-morph", "id,X1\na.png,1\n", "expected the columns id,X1,Y1"),
        (
            "coco",
            coco([{}], keypoints=["a\n", "b"]),
            "wing: .* names of points that can be printed",
        ),
        ("csv", f"image,{'n' * 101}_x,{'n' * 101}_y\na.png,1,2\n", "l.csv: scheme .* of up to 100 letters"),
        (
            "imglab",
            f"<dataset><image file='a.png'>{BOX}<part name=' a' x='1' y='2'/></box></image></dataset>",
            "l.xml: scheme .* names of points that can be printed",
        ),
    ],
)
def test_files_that_are_no_such_labels(name: str, text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=message):
        read(tmp_path, name, text)


def test_coco_annotations(tmp_path: Path) -> None:
    points = {"keypoints": [1, 2, 2, 3, 4, 1]}
    text = coco(
        [
            points | {"bbox": [1, 2, 5, 6], "scale": 0.5},
            {"keypoints": [0, 0, 0, 3, 4, 2]},
            points | {"iscrowd": 1},
            points | {"image_id": 8},
            points | {"category_id": 4},
            {"keypoints": [1, 2, 2]},
            {"keypoints": [1, 2, 3, 3, 4, 2]},
            {"keypoints": ["1", 2, 2, 3, 4, 2]},
            points | {"bbox": [1, 2]},
            {"keypoints": [0, 0, 0, 0, 0, 0]},
        ],
        skeleton=[[1, 2]],
    )
    found = read(tmp_path, "coco", text)
    assert (found.scheme.names, found.scheme.lines) == (("a", "b"), ((0, 1),))
    first, second = found.faces
    assert (first.visible.tolist(), first.present.tolist(), first.scale) == ([True, False], [True, True], 0.5)
    assert first.box is not None
    assert first.box.tolist() == [0.5, 1.5, 5, 6]  # COCO counts boxes from the first pixel's corner
    np.testing.assert_array_equal(second.landmarks, [[np.nan] * 2, [3, 4]])
    told = [problem.split("annotation ")[1] for problem in found.problems]
    for number, why in {
        3: "is a crowd",
        4: "expected the image_id of an image",
        5: "is of category 4",
        6: "expected 2 keypoints x, y, v; got 3 numbers",
        7: "expected v of keypoints 0, 1 or 2",
        8: "expected keypoints as a list of finite numbers",
        9: "expected a bbox of x, y, width and height",
        10: "has no point that is not missing",
    }.items():
        assert any(each.startswith(f"{number}: {why}") for each in told), told
    assert len(told) == 8


def test_known_schemes_are_known_again(tmp_path: Path) -> None:
    names = [f"aflw21_{number}" for number in range(1, 22)]
    assert read(tmp_path, "coco", coco([{"keypoints": [1, 2, 2] * 21}], names)).scheme == AFLW21


def test_wide_tables(tmp_path: Path) -> None:
    text = (
        "image,tip_x,tip_y,tip_v,root_x,root_y,x,y,width,height,scale,subject,weight\n"
        "a.png,1,2,1,3,4,5,6,7,8,0.1,s1,9\n\na.png,,,,3,4\na.png,1,?,,3,4\na.png,1,2,,3,4,5\n,1,2,,3,4\n"
    )
    found = read(tmp_path, "csv", text)
    assert found.scheme.names == ("tip", "root")
    first, second = found.faces
    assert (first.subject, first.scale, first.visible.tolist()) == ("s1", 0.1, [False, True])
    assert first.box is not None
    assert first.box.tolist() == [5, 6, 7, 8]
    assert (second.box, second.known.tolist(), second.subject) == (None, [False, True], "a")
    assert [problem.split("l.csv")[1] for problem in found.problems] == [
        ": the columns weight are not read",
        ", line 5: tip_y: expected a number, or nothing; got '?'",
        ", line 6: expected all of x, y, width, height, or none; got some",
        ", line 7: expected a picture's path in the column image; got none",
    ]


def test_predictions_of_ml_morph_count_from_the_top(tmp_path: Path) -> None:
    text = "id,box_id,box_top,box_left,box_width,box_height,X0,Y0\na.png,1_2_3_4,1,2,3,4,5,6\n"
    (face,) = read(tmp_path, "ml-morph", text).faces
    assert face.box is not None
    assert (face.box.tolist(), face.landmarks.tolist()) == ([2, 1, 3, 4], [[5, 6]])


def test_a_name_that_may_be_several_pictures(tmp_path: Path) -> None:
    found = read(tmp_path, "csv", "image,x1,y1\nb.png,1,2\na.png,1,2\n", ("a.png", "one/b.png", "two/b.png"))
    assert len(found.faces) == 1
    assert "may be" in found.problems[0]
