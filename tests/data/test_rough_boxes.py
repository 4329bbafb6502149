"""Boxes of rough detectors, wherever they come from: two passes of the cascade make up for them."""

import pytest

from jaxfit.data.detectors import DETECTORS, Search, all_rough
from jaxfit.fitting.pipeline import Fitting


@pytest.mark.parametrize("name", DETECTORS)
def test_boxes_of_a_file_are_fitted_as_their_detector_is(name: str) -> None:
    entry = DETECTORS[name]
    if not entry.installed:
        pytest.skip("not installed")
    detector = entry.make(Search())
    assert (entry.kinds, entry.rough) == (detector.kinds, detector.rough)
    for kind in detector.kinds:
        assert all_rough([kind, kind]) == detector.rough
    assert not all_rough([*detector.kinds, "square"])
    assert not all_rough([])


def test_rough_boxes_take_two_passes_unless_others_are_asked_for() -> None:
    assert (Fitting().passes_from(rough=True), Fitting().passes_from(rough=False)) == (2, 1)
    assert Fitting(passes=3).passes_from(rough=True) == Fitting(passes=3).passes_from(rough=False) == 3
