"""What was given is never written over, under whatever name it comes, and is known again only while it is the same."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from jaxfit.data.boxes import read_boxes
from jaxfit.data.inputs import require_no_inputs, same_files, state_of
from jaxfit.data.pts import read_pts
from jaxfit.errors import InputError, JaxfitError
from jaxfit.heads.mesh_points import read_mesh_points
from jaxfit.labels.importers.lfpw import read_lfpw


def _itself(folder: Path) -> tuple[Path, Path]:
    return folder / "a.jpg", folder / "a.jpg"


def _through_dots(folder: Path) -> tuple[Path, Path]:
    return folder / "a.jpg", folder / "sub" / ".." / "a.jpg"


def _through_a_linked_folder(folder: Path) -> tuple[Path, Path]:
    (folder / "linked").symlink_to(folder, target_is_directory=True)
    return folder / "a.jpg", folder / "linked" / "a.jpg"


def _given_through_a_linked_folder(folder: Path) -> tuple[Path, Path]:
    return _through_a_linked_folder(folder)[::-1]


def _a_link_that_was_given(folder: Path) -> tuple[Path, Path]:
    (folder / "link.jpg").symlink_to(folder / "a.jpg")
    return folder / "link.jpg", folder / "link.jpg"


def _another_name_of_the_same_file(folder: Path) -> tuple[Path, Path]:
    os.link(folder / "a.jpg", folder / "b.jpg")
    return folder / "a.jpg", folder / "b.jpg"


@pytest.mark.parametrize(
    "paths",
    [
        _itself,
        _through_dots,
        _through_a_linked_folder,
        _given_through_a_linked_folder,
        _a_link_that_was_given,
        _another_name_of_the_same_file,
    ],
)
def test_what_was_given_is_not_written_over(
    tmp_path: Path, paths: Callable[[Path], tuple[Path, Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.jpg").write_bytes(b"mine")
    given, output = paths(tmp_path)
    monkeypatch.chdir(tmp_path)
    for name in (output, output.relative_to(tmp_path)):
        with pytest.raises(InputError, match=r"was given as input.*would be written over; use another --out"):
            require_no_inputs([tmp_path / "other.jpg", name], [given])


def test_other_files_may_be_written_over(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / name).touch()
    # What is renamed over a link replaces the link, and not the file that it leads to.
    (tmp_path / "link.jpg").symlink_to(tmp_path / "a.jpg")
    require_no_inputs(
        [tmp_path / "b.jpg", tmp_path / "link.jpg", tmp_path / "new.jpg"],
        [tmp_path / "a.jpg", tmp_path / "gone.jpg", tmp_path / "new.jpg", "a\0b"],
    )


def test_same_files(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a", "b", "c")]
    for path in paths:
        path.touch()
    (tmp_path / "link").symlink_to(paths[0])
    assert list(same_files([*paths, tmp_path / "gone"], [tmp_path / "link", paths[2], tmp_path / "nowhere"])) == [
        paths[0],
        paths[2],
    ]
    assert not same_files([tmp_path / "gone"], [tmp_path / "gone"])


def test_states_change_with_files(tmp_path: Path) -> None:
    path = tmp_path / "a"
    states = [state_of([path]), state_of(["a\0b"])]
    for content, time in ((b"a", 1), (b"b", 2), (b"ab", 2)):
        path.write_bytes(content)
        os.utime(path, ns=(time, time))
        states.append(state_of([path]))
        assert state_of([path]) == states[-1]
    assert len(set(states)) == len(states)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes with names")
@pytest.mark.parametrize("read", [read_pts, read_boxes, read_lfpw, read_mesh_points])
def test_labels_and_boxes_are_regular_files(read: Callable[[Path], object], tmp_path: Path) -> None:
    """Who reads a pipe waits for ever, or takes what is in it, which nobody can read again."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(JaxfitError, match="a device or pipe, and not a regular file"):
        read(tmp_path / "pipe")
