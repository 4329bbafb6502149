"""Pointing'04, from written folders with known faces, and the real one."""

import numpy as np
import pytest
from written_labels import POINTING04_BOX, write_pointing04_face

from jaxfit.errors import DatasetError, InputError
from jaxfit.labels.datasets import convert_dataset, read_dataset
from jaxfit.labels.importers.pointing04 import read_pointing04
from jaxfit.schemes.known import IBUG68, NO_LANDMARKS


def test_a_face(tmp_path):
    write_pointing04_face(tmp_path / "Person01", "person01231+0-15")
    dataset = read_pointing04(tmp_path)
    (face,) = dataset.faces
    np.testing.assert_array_equal(face.box, [192 - 63, 237 - 47.5, 126, 95])
    np.testing.assert_array_equal(face.pose, [np.nan, 0, -15])
    assert face.pose_order == "roll-pitch-yaw"
    assert face.image == tmp_path / "Person01/person01231+0-15.jpg"
    assert (face.subject, face.face) == ("Person01", "person01231+0-15")
    assert (dataset.scheme, dataset.problems) == (NO_LANDMARKS, ())


@pytest.mark.parametrize(("name", "tilt", "pan"), [("-90+0", -90, 0), ("+60-75", 60, -75), ("+0+90", 0, 90)])
def test_names_say_the_pose(tmp_path, name, tilt, pan):
    write_pointing04_face(tmp_path / "Person15", f"person15192{name}")
    (face,) = read_pointing04(tmp_path).faces
    assert face.pose[1:].tolist() == [tilt, pan]
    assert face.subject == "Person15"


def test_a_face_without_landmarks_is_not_complete(tmp_path):
    write_pointing04_face(tmp_path / "Person01", "person01146+0+0")
    (face,) = read_pointing04(tmp_path).faces
    assert face.landmarks.shape == (0, 2)
    assert face.present.shape == face.visible.shape == (0,)
    assert not face.complete


def test_people_come_in_order_and_one_may_be_named(tmp_path):
    for person in ("03", "01", "02"):
        for pose in ("01+0", "00-90"):
            write_pointing04_face(tmp_path / f"Person{person}", f"person{person}1{pose}+0")
    (tmp_path / "Person01" / "Thumbs.db").touch()
    write_pointing04_face(tmp_path / "Front", "person01146+0+0")
    names = [face.face for face in read_pointing04(tmp_path).faces]
    assert names == [f"person{person}1{pose}+0" for person in ("01", "02", "03") for pose in ("00-90", "01+0")]
    assert [face.face for face in read_pointing04(tmp_path / "Person02").faces] == names[2:4]


@pytest.mark.parametrize(
    "box",
    [
        None,
        "",
        "192\n237\n126\n",
        POINTING04_BOX + "1\n",
        "192\n237\nwide\n94\n",
        "192\n237\nnan\n94\n",
        "192\n237\n0\n94\n",
    ],
)
def test_a_face_without_a_readable_box_stays_and_is_reported(tmp_path, box):
    write_pointing04_face(tmp_path / "Person01", "person01100-90+0", box)
    write_pointing04_face(tmp_path / "Person01", "person01146+0+0")
    dataset = read_pointing04(tmp_path)
    assert [face.box is None for face in dataset.faces] == [True, False]
    (problem,) = dataset.problems
    assert "person01100-90+0.txt" in problem
    assert "without a box" in problem


def test_text_files_of_another_kind_are_no_boxes(tmp_path):
    write_pointing04_face(tmp_path / "Person01", "person01146+0+0", box=None)
    for content in (b"person01146+0+0.jpg\n\nHand\n1\n2\n3\n4\n", b"\xff\xfe\x00\xd8"):
        (tmp_path / "Person01" / "person01146+0+0.txt").write_bytes(content)
        dataset = read_pointing04(tmp_path)
        assert dataset.faces[0].box is None
        assert len(dataset.problems) == 1


@pytest.mark.parametrize("stem", ["person01146+0", "person01146+0+0 copy", "person146+0+0", "readme"])
def test_names_without_a_pose_become_problems(tmp_path, stem):
    write_pointing04_face(tmp_path / "Person01", stem)
    with pytest.raises(DatasetError, match=r"first problem: .*expected a name such as"):
        read_pointing04(tmp_path)
    write_pointing04_face(tmp_path / "Person01", "person01146+0+0")
    dataset = read_pointing04(tmp_path)
    assert [face.face for face in dataset.faces] == ["person01146+0+0"]
    (problem,) = dataset.problems
    assert f"{stem}.*: expected a name" in problem


def test_folders_without_pictures(tmp_path):
    with pytest.raises(DatasetError, match="there are none"):
        read_pointing04(tmp_path)


def test_there_are_no_landmarks_to_convert(tmp_path):
    write_pointing04_face(tmp_path / "Person01", "person01146+0+0")
    dataset = read_dataset(f"pointing04:{tmp_path}")
    for scheme in (IBUG68, NO_LANDMARKS):
        with pytest.raises(InputError, match=r"pointing04:.*: its faces have no landmarks"):
            convert_dataset(dataset, scheme)


def test_the_real_dataset(shared_data):
    """Seven people, two series of 93 poses each, and boxes that follow the head."""
    dataset = read_dataset(f"pointing04:{shared_data / 'pointing04'}")
    assert dataset.problems == ()
    assert len(dataset.faces) == 7 * 2 * 93 == len({face.face for face in dataset.faces})
    assert len({face.subject for face in dataset.faces}) == 7
    assert {tuple(face.pose[1:]) for face in dataset.faces} == {
        *((tilt, pan) for tilt in (-60, -30, -15, 0, 15, 30, 60) for pan in range(-90, 91, 15)),
        *((-90.0, 0.0), (90.0, 0.0)),
    }
    # Boxes lie in the picture of 384 x 288 pixels, to the left and higher up as the face turns there.
    boxes, (_, pitch, yaw) = np.array([face.box for face in dataset.faces]), np.array([f.pose for f in dataset.faces]).T
    centres = boxes[:, :2] + boxes[:, 2:] / 2
    assert ((centres > 0) & (centres < [384, 288])).all()
    assert np.corrcoef(yaw, centres[:, 0])[0, 1] < -0.7
    assert np.corrcoef(pitch, centres[:, 1])[0, 1] < -0.7
