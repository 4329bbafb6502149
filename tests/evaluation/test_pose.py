"""Pose errors go the shorter way round; summaries, grids and comparisons against NumPy and SciPy."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="arg-type,list-item,operator"

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from jaxfit.errors import InputError
from jaxfit.evaluation.pose import (
    POSE_COLUMNS,
    YAW_MIDDLES,
    compare_pose,
    grid_centres,
    means_by_yaw,
    medians_by_yaw,
    pose_errors,
    pose_grid,
    pose_grid_table,
    pose_intervals,
    pose_report,
    pose_rows,
    summarise_pose,
)
from jaxfit.evaluation.statistics import bootstrap_ci
from jaxfit.evaluation.tables import comparison_row, markdown_table, text_table
from jaxfit.shapes.camera import ANGLES
from jaxfit.shapes.pose_order import in_order

UNKNOWN, LOST = np.nan, (np.nan, np.nan, np.nan)
ROLL, PITCH, YAW = range(3)

# Four faces in quarter degrees, so that sums are exact; roll is known of the first alone and the third is not found.
FITTED = np.array([(5.0, 10.25, -20.0), (0.0, -3.0, 61.0), LOST, (1.0, 2.0, 175.0)])
TRUTH = np.array([(7.0, 10.0, -30.0), (UNKNOWN, 0.0, 60.0), (UNKNOWN, 15.0, 0.0), (UNKNOWN, 15.0, -175.0)])


def random_poses(seed: int, faces: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """Fitted and true poses; a tenth of the faces is not found, and a tenth of the true angles is unknown."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-80, 80, (faces, 3))
    fitted = 0.7 * truth + rng.normal(2, 12, truth.shape)
    fitted[rng.random(faces) < 0.1] = np.nan
    truth[rng.random(truth.shape) < 0.1] = np.nan
    return fitted, truth


def discrete_poses(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Fitted and true poses as in Pointing'04: tilts and pans are discrete, roll is unknown."""
    rng = np.random.default_rng(seed)
    series = [(UNKNOWN, tilt, pan) for tilt in (-60, -30, -15, 0, 15, 30, 60) for pan in range(-90, 91, 15)]
    truth = np.array(4 * [*series, (UNKNOWN, -90, 0), (UNKNOWN, 90, 0)], dtype=float)
    fitted = np.nan_to_num(truth) * (1.0, 0.6, 0.5) + rng.normal(0, 8, truth.shape)
    fitted[rng.random(len(truth)) < 0.05] = np.nan
    return fitted, truth


def axis_turns(axis: int, degrees: np.ndarray) -> np.ndarray:
    """Rotation matrices (N, 3, 3) about an axis of the picture."""
    return Rotation.from_rotvec(np.radians(degrees)[:, None] * np.eye(3)[axis]).as_matrix()


def test_poses_in_another_order_are_the_same_rotations() -> None:
    rng = np.random.default_rng(7)
    poses = rng.uniform([-170, -80, -85], [170, 80, 85], (60, 3))
    found = in_order(poses, ["roll-yaw-pitch"] * 60)
    # Eq. 15 rolls the head first, then pitches, then turns it; y is down, so that looking up turns against x.
    of_poses, of_found = (
        {"roll": axis_turns(2, p[:, 0]), "pitch": axis_turns(0, -p[:, 1]), "yaw": axis_turns(1, p[:, 2])}
        for p in (poses, found)
    )
    eq15 = of_poses["yaw"] @ of_poses["pitch"] @ of_poses["roll"]
    np.testing.assert_allclose(of_found["pitch"] @ of_found["yaw"] @ of_found["roll"], eq15, atol=1e-9)
    assert np.abs(found - poses).max() > 5
    assert (np.abs(found[:, YAW]) <= 90).all()


def test_small_and_single_angles_are_alike_in_all_orders() -> None:
    single = np.array([(40.0, 0.0, 0.0), (0.0, -50.0, 0.0), (0.0, 0.0, 80.0), (-30.0, 20.0, 0.0), (0.0, 0.0, 0.0)])
    # Without yaw, pitch follows roll in both.
    np.testing.assert_allclose(in_order(single, ["roll-yaw-pitch"] * 5), single, atol=1e-9)
    small = np.random.default_rng(8).uniform(-3, 3, (20, 3))
    np.testing.assert_allclose(in_order(small, ["roll-yaw-pitch"] * 20), small, atol=0.2)


def test_heads_turned_beyond_the_profile_are_not_upside_down() -> None:
    beyond = np.array([(0.0, 0.0, 95.0), (0.0, 0.0, -120.0)])
    found = in_order(beyond, ["roll-yaw-pitch"] * 2)
    np.testing.assert_allclose(found, beyond, atol=1e-6)
    # Yaw alone is wrong, by as much as it is.
    np.testing.assert_allclose(pose_errors(found[:1], np.array([(0.0, 0.0, 83.0)])), [(0, 0, 12)], atol=1e-6)


def test_each_face_has_its_order() -> None:
    poses = np.array([(10.0, 20.0, 30.0), LOST, (10.0, 20.0, 30.0), (1.0, UNKNOWN, 3.0), (400.0, 20.0, 30.0)])
    before = poses.copy()
    found = in_order(poses, ["roll-pitch-yaw", *["roll-yaw-pitch"] * 3, "roll-pitch-yaw"])
    np.testing.assert_array_equal(found[[0, 1, 3, 4]], poses[[0, 1, 3, 4]])
    np.testing.assert_allclose(found[2], in_order(poses[:1], ["roll-yaw-pitch"])[0])
    assert np.abs(found[2] - poses[2]).max() > 1
    np.testing.assert_array_equal(poses, before)
    assert in_order(np.empty((0, 3)), []).shape == (0, 3)
    with pytest.raises(InputError, match=r"\(faces, 3\)"):
        in_order(np.zeros((4, 2)), ["roll-yaw-pitch"] * 4)


def test_errors_by_hand() -> None:
    np.testing.assert_array_equal(
        pose_errors(FITTED, TRUTH),
        [(-2.0, 0.25, 10.0), (np.nan, -3.0, 1.0), (np.nan, np.inf, np.inf), (np.nan, -13.0, -10.0)],
    )


def test_a_row_that_is_not_finite_throughout_is_not_found() -> None:
    partly = np.array([(1.0, np.nan, 3.0), (np.inf, 0.0, 0.0)])
    assert np.isinf(pose_errors(partly, np.zeros((2, 3)))).all()


quarters = st.integers(-4000, 4000).map(lambda quarter: quarter / 4)


@given(fitted=quarters, true=quarters, turns=st.integers(-3, 3))
def test_errors_go_the_shorter_way_round(fitted: float, true: float, turns: int) -> None:
    error = pose_errors(np.full((1, 3), fitted), np.full((1, 3), true))
    assert -180 <= error[0, 0] < 180
    assert (error[0, 0] - (fitted - true)) % 360 == 0
    np.testing.assert_array_equal(pose_errors(np.full((1, 3), fitted + 360 * turns), np.full((1, 3), true)), error)
    np.testing.assert_array_equal(pose_errors(np.full((1, 3), fitted), np.full((1, 3), true + 360 * turns)), error)


def test_the_size_of_an_error_is_the_angle_between_rotations() -> None:
    rng = np.random.default_rng(0)
    fitted, truth = rng.uniform(-400, 400, (2, 50, 3))
    between = [
        (Rotation.from_euler("z", a, degrees=True).inv() * Rotation.from_euler("z", b, degrees=True)).magnitude()
        for a, b in zip(truth.flat, fitted.flat, strict=True)
    ]
    np.testing.assert_allclose(np.abs(pose_errors(fitted, truth)).ravel(), np.degrees(between), atol=1e-9)


@pytest.mark.parametrize(
    ("fitted", "truth", "message"),
    [
        (np.zeros((4, 2)), np.zeros((4, 3)), r"\(faces, 3\); got \(4, 2\)"),
        (np.zeros((4, 3)), np.zeros(3), r"\(faces, 3\); got \(3,\)"),
        (np.zeros((4, 3)), np.zeros((1, 3)), "same faces; got 4 and 1 poses"),
    ],
)
def test_wrong_shapes(fitted: np.ndarray, truth: np.ndarray, message: str) -> None:
    for function in (pose_errors, summarise_pose, pose_report, pose_rows):
        with pytest.raises(InputError, match=message):
            function(fitted, truth)


@pytest.mark.parametrize("seed", range(3))
def test_summaries_agree_with_numpy_and_scipy(seed: int) -> None:
    fitted, truth = random_poses(seed)
    found = np.isfinite(fitted[:, 0])
    for column, (angle, summary) in enumerate(summarise_pose(fitted, truth).items()):
        assert angle == ANGLES[column]
        known = np.isfinite(truth[:, column])
        assert (summary.faces, summary.undetected) == (known.sum(), (known & ~found).sum())
        assert summary.undetected > 0
        a, b = fitted[known & found, column], truth[known & found, column]
        low, high = stats.t.interval(0.95, df=a.size - 1, scale=stats.sem(np.abs(a - b)))
        worst = np.append(np.abs(a - b), np.full(summary.undetected, 1e9))
        assert summary.mae == pytest.approx(np.abs(a - b).mean())
        assert summary.ci95 == pytest.approx((high - low) / 2)
        assert summary.median == pytest.approx(np.median(worst))
        assert summary.bias == pytest.approx(a.mean() - b.mean())
        assert summary.spearman == pytest.approx(stats.spearmanr(a, b).statistic)
        assert summary.spearman == pytest.approx(np.corrcoef(a.argsort().argsort(), b.argsort().argsort())[0, 1])


def test_summaries_keep_to_whole_turns_and_ignore_the_order_of_faces() -> None:
    fitted, truth = random_poses(3)
    rng = np.random.default_rng(4)
    order = rng.permutation(len(truth))
    turned = fitted + 360.0 * rng.integers(-2, 3, fitted.shape), truth + 360.0 * rng.integers(-2, 3, truth.shape)
    report = pose_report(fitted, truth)
    for same in (pose_report(fitted[order], truth[order]), pose_report(*turned)):
        for key, part in report.items():
            assert (same[key]["faces"], same[key]["undetected"]) == (part["faces"], part["undetected"])
            for angle in ANGLES:
                assert same[key][angle] == pytest.approx(part[angle])


def test_half_the_faces_lost_leaves_no_median() -> None:
    yaw = summarise_pose(np.array([(0.0, 0.0, 4.0), LOST, LOST]), np.zeros((3, 3)))["yaw"]
    assert (yaw.faces, yaw.undetected, yaw.mae, yaw.median, yaw.bias) == (3, 2, 4.0, math.inf, 4.0)


def test_what_few_or_equal_faces_leave_undefined_is_nan() -> None:
    poses = np.array([(1.0, 2.0, 3.0), (1.0, 4.0, 9.0)])
    assert math.isnan(summarise_pose(poses, poses)["yaw"].spearman)
    constant, varied = np.full((4, 3), 10.1), np.arange(12.0).reshape(4, 3)
    for fitted, truth in ((constant, varied), (varied, constant)):
        assert math.isnan(summarise_pose(fitted, truth)["pitch"].spearman)
    assert summarise_pose(varied, varied)["pitch"].spearman == pytest.approx(1.0)
    for nothing in (np.empty((0, 3)), np.full((2, 3), np.nan)):
        summary = summarise_pose(nothing, nothing)["roll"]
        assert (summary.faces, summary.undetected) == (0, 0)
        assert np.isnan([summary.mae, summary.ci95, summary.median, summary.bias, summary.spearman]).all()


def test_report() -> None:
    report = json.loads(json.dumps(pose_report(FITTED, TRUTH), allow_nan=False))
    nothing = {"mae": None, "ci95": None, "median": None, "bias": None, "spearman": None}
    assert report["all"] == {
        "faces": 4,
        "undetected": 1,
        "roll": {**nothing, "mae": 2.0, "median": 2.0, "bias": -2.0},
        "pitch": {
            "mae": pytest.approx((0.25 + 3 + 13) / 3),
            "ci95": pytest.approx(stats.t.ppf(0.975, 2) * np.std([0.25, 3, 13], ddof=1) / np.sqrt(3)),
            "median": 8.0,  # of 0.25, 3, 13 and the face that was not found
            "bias": pytest.approx((0.25 - 3 - 13) / 3),
            "spearman": pytest.approx(stats.spearmanr([10.25, -3, 2], [10, 0, 15]).statistic),
        },
        "yaw": {
            "mae": 7.0,
            "ci95": pytest.approx(stats.t.ppf(0.975, 2) * np.std([10, 1, 10], ddof=1) / np.sqrt(3)),
            "median": 10.0,
            "bias": pytest.approx(1 / 3),
            "spearman": pytest.approx(-0.5),  # of -20, 61, 175 and -30, 60, -175
        },
    }
    # The first face, and the third, which was not found.
    assert report["yaw_within_45"] == {
        "faces": 2,
        "undetected": 1,
        "roll": report["all"]["roll"],
        "pitch": {**nothing, "mae": 0.25, "bias": 0.25},
        "yaw": {**nothing, "mae": 10.0, "bias": 10.0},
    }


def test_the_range_of_yaw() -> None:
    yaws = np.array([-45.5, -45.0, 0.0, 45.0, 45.25, 320.0, UNKNOWN])
    truth = np.stack([np.full(7, UNKNOWN), np.zeros(7), yaws], axis=1)
    report = pose_report(np.zeros((7, 3)), truth)
    assert [report[key]["faces"] for key in ("all", "yaw_within_45")] == [7, 4]
    unknown = np.full((1, 3), UNKNOWN)
    assert pose_report(np.zeros((8, 3)), np.concatenate([truth, unknown])) == report


def test_rows_say_what_summaries_say() -> None:
    fitted, truth = random_poses(5)
    rows = pose_rows(fitted, truth)
    assert [(row["range"], row["angle"]) for row in rows] == [
        (within, angle) for within in ("all", "|yaw| ≤ 45°") for angle in ANGLES
    ]
    frontal = np.abs(truth[:, YAW]) <= 45
    summaries = [*summarise_pose(fitted, truth).values(), *summarise_pose(fitted[frontal], truth[frontal]).values()]
    for row, of in zip(rows, summaries, strict=True):
        assert list(row) == list(POSE_COLUMNS)
        numbers = [of.faces, of.undetected, of.mae, of.ci95, of.median, of.bias, of.spearman]
        assert list(row.values())[2:] == numbers


def test_tables_of_rows() -> None:
    # Roll is known nowhere.
    rows = pose_rows(FITTED, TRUTH * (UNKNOWN, 1, 1))
    assert text_table(rows, POSE_COLUMNS).splitlines() == [
        "range        angle  faces  no fit    MAE  ± 95 %  median    bias  Spearman",
        "-----------  -----  -----  ------  -----  ------  ------  ------  --------",
        "all          pitch      4       1   5.42   16.67    8.00   -5.25     0.500",
        "all          yaw        4       1   7.00   12.91   10.00   +0.33    -0.500",
        "|yaw| ≤ 45°  pitch      2       1   0.25       -     inf   +0.25         -",
        "|yaw| ≤ 45°  yaw        2       1  10.00       -     inf  +10.00         -",
    ]
    assert "| \\|yaw\\| ≤ 45° | pitch | 2 | 1 | 0.25 | - | inf |" in markdown_table(rows, POSE_COLUMNS)


def test_comparisons_are_of_absolute_errors() -> None:
    fitted, truth = random_poses(6)
    a, b = pose_errors(fitted, truth), pose_errors(truth, truth - 15)
    rows = compare_pose(a, b)
    for column, (angle, row) in enumerate(zip(ANGLES, rows, strict=True)):
        sizes = [np.abs(errors[:, column]) for errors in (a, b)]
        assert row == {"angle": angle, **comparison_row(*sizes)}
    # Only the size of an error counts, and unknown angles say nothing.
    assert compare_pose(-a, b) == rows
    assert [row["angle"] for row in compare_pose(a * (UNKNOWN, 1, 1), b)] == ["pitch", "yaw"]
    with pytest.raises(InputError, match=r"pose errors.*\(80,\)"):
        compare_pose(a, b[:, 0])


def test_many_pictures_of_few_people_are_few() -> None:
    rng = np.random.default_rng(9)
    people = np.repeat([f"person {number}" for number in range(7)], 40)
    truth = np.stack([np.full(280, UNKNOWN), np.tile(np.linspace(-80, 80, 40), 7), np.zeros(280)], 1)
    habits = np.repeat(rng.normal(0, 5, (7, 3)), 40, axis=0)
    fitted = np.nan_to_num(truth) + habits + rng.normal(0, 1, truth.shape)
    for row, of_faces in zip(pose_rows(fitted, truth, people), pose_rows(fitted, truth), strict=True):
        assert row["± 95 %"] > 3 * of_faces["± 95 %"]
        assert {**row, "± 95 %": 0} == {**of_faces, "± 95 %": 0}
    # Two methods that differ by people's habits alone.
    errors, baseline = (pose_errors(fits, truth) for fits in (fitted, np.nan_to_num(truth) + np.roll(habits, 40, 0)))
    for row, of_faces in zip(compare_pose(errors, baseline, people), compare_pose(errors, baseline), strict=True):
        assert row["signed-rank p"] > 0.05
        assert row["rank-sum p"] == of_faces["rank-sum p"]


def test_centres_of_grids() -> None:
    assert grid_centres(discrete_poses(0)[1]) == (None, None)
    pitches, yaws = grid_centres(random_poses(0)[1])
    assert pitches is not None
    assert len(pitches) * len(yaws) < 60


def test_discrete_poses_are_the_grid() -> None:
    fitted, truth = discrete_poses(0)
    errors = pose_errors(fitted, truth)[:, YAW]
    grid = pose_grid(errors, truth)
    np.testing.assert_array_equal(grid.pitches, [-90, -60, -30, -15, 0, 15, 30, 60, 90])
    np.testing.assert_array_equal(grid.yaws, range(-90, 91, 15))
    for (row, column), mean in np.ndenumerate(grid.mean):
        of_cell = errors[(truth[:, PITCH] == grid.pitches[row]) & (truth[:, YAW] == grid.yaws[column])]
        found = of_cell[np.isfinite(of_cell)]
        assert grid.count[row, column] == found.size
        assert grid.undetected[row, column] == of_cell.size - found.size
        assert mean == pytest.approx(np.abs(found).mean() if found.size else np.nan, nan_ok=True)
    assert grid.undetected.sum() > 0
    assert np.isnan(grid.mean[0]).sum() == 12  # Straight down there is one pan.


@pytest.mark.parametrize("centres", [None, np.arange(-60.0, 61, 20), np.array([7.0])])
@pytest.mark.parametrize("poses", [discrete_poses, random_poses])
def test_means_of_cells_are_shares_of_the_overall_mean(poses, centres: np.ndarray | None) -> None:
    fitted, truth = poses(1)
    placed = ~np.isnan(truth[:, 1:]).any(axis=1)
    for column in (PITCH, YAW):
        grid = pose_grid(pose_errors(fitted, truth)[:, column], truth, centres, centres)
        summary = summarise_pose(fitted[placed], truth[placed])[ANGLES[column]]
        assert np.nansum(grid.mean * grid.count) / grid.count.sum() == pytest.approx(summary.mae)
        assert (grid.undetected.sum(), grid.count.sum() + grid.undetected.sum()) == (summary.undetected, summary.faces)


def test_faces_belong_to_the_nearest_centres() -> None:
    truth = np.random.default_rng(2).uniform(-100, 100, (300, 3))
    errors = np.arange(300.0)
    pitches, yaws = np.array([30.0, -30.0, 0.0]), np.array([-50.0, 0.0, 10.0, 80.0])  # the order does not matter
    grid = pose_grid(errors, truth, pitches, yaws)
    np.testing.assert_array_equal(grid.pitches, [-30, 0, 30])
    rows = np.abs(truth[:, PITCH, None] - grid.pitches).argmin(axis=1)
    columns = np.abs(truth[:, YAW, None] - grid.yaws).argmin(axis=1)
    for (row, column), mean in np.ndenumerate(grid.mean):
        assert mean == pytest.approx(errors[(rows == row) & (columns == column)].mean())


def test_grids_round_distinct_poses_and_ignore_signs_order_and_turns() -> None:
    fitted, truth = discrete_poses(2)
    noise = np.random.default_rng(3).uniform(-0.004, 0.004, truth.shape)
    errors = pose_errors(fitted, truth)[:, PITCH]
    grid = pose_grid(errors, truth)
    order = np.random.default_rng(4).permutation(len(truth))
    for same in (
        pose_grid(errors, truth + noise),
        pose_grid(-errors, truth),
        pose_grid(errors[order], truth[order]),
        pose_grid(errors, truth - 360),
    ):
        for name in ("pitches", "yaws", "mean", "count", "undetected"):
            np.testing.assert_allclose(getattr(same, name), getattr(grid, name))


def test_grids_without_faces() -> None:
    unknown = np.full((3, 3), UNKNOWN)
    assert pose_grid(np.zeros(3), unknown).mean.shape == (0, 0)
    grid = pose_grid(np.zeros(3), unknown, np.array([0.0]), np.array([0.0, 1.0]))
    assert np.isnan(grid.mean).all()
    assert grid.count.tolist() == grid.undetected.tolist() == [[0, 0]]


def test_grids_that_cannot_be() -> None:
    truth = np.zeros((4, 3))
    for errors in (np.zeros(3), truth):
        with pytest.raises(InputError, match="one for each of 4 poses"):
            pose_grid(errors, truth)
    for centres in (np.array([]), np.array([0.0, np.nan])):
        with pytest.raises(InputError, match="at least one pitch and one yaw, all finite"):
            pose_grid(np.zeros(4), truth, yaws=centres)


def test_table_of_a_grid() -> None:
    truth = np.array([(0, -22.5, 0), (0, -22.5, 0), (0, -0.001, 15), (0, 90, 0)], dtype=float)
    grid = pose_grid(np.array([-1.0, 2.0, 0.125, np.inf]), truth)
    assert pose_grid_table(grid).splitlines() == [
        "| pitch \\ yaw | 0 | 15 |",
        "| ---: | ---: | ---: |",
        "| -22.5 | 1.5 | - |",
        "| 0 | - | 0.1 |",
        "| 90 | - | - |",
    ]


def test_intervals_of_poses_are_those_of_their_errors() -> None:
    rng = np.random.default_rng(0)
    truth = np.stack([rng.uniform(-20, 20, 60), rng.uniform(-20, 20, 60), np.linspace(-80, 80, 60)], 1)
    fitted = truth + rng.normal(0, 5, (60, 3))
    fitted[::9] = np.nan
    people = [f"person {number % 20}" for number in range(60)]
    rows, ends = pose_rows(fitted, truth, people), pose_intervals(fitted, truth, people)
    assert len(rows) == len(ends) == 6
    for row, (low, high) in zip(rows, ends, strict=True):
        within = np.abs(truth[:, 2]) <= (45 if "45" in str(row["range"]) else 90)
        off = np.abs(fitted - truth)[:, ("roll", "pitch", "yaw").index(str(row["angle"]))]
        assert (low, high) == pytest.approx(bootstrap_ci(np.where(within, off, np.nan), people))
        assert low < row["MAE"] < high


def test_errors_by_yaw_are_of_the_faces_there() -> None:
    yaws = np.array([-88.0, -80, 0, 2, -3, 1, 4, 28, 31, 60, 61, 120, np.nan])
    errors = np.array([5.0, 7, 1, 2, np.inf, np.inf, np.inf, 3, 4, 6, np.nan, 9, 9])
    medians = medians_by_yaw(errors, yaws, least=2)
    middles = dict(zip(YAW_MIDDLES.tolist(), medians.tolist(), strict=True))
    assert np.isnan(middles[-90])  # one is too few
    assert np.isnan(middles[-75])
    assert middles[0] == np.inf  # most have no fit
    assert middles[30] == 3.5
    means = means_by_yaw(errors, yaws)
    np.testing.assert_allclose(means[:3], [2, 5, 6])  # of fitted faces, up to 30, 60 and 90
    assert means[3] == pytest.approx(np.mean(means[:3]))
    assert np.isnan(means_by_yaw(errors, np.zeros(13))[3])
