"""Boxes of rough detectors, wherever they come from: two passes of the cascade make up for them."""

import pytest

from jaxfit.data.detectors import DETECTORS, ROUGH_KINDS, Search
from jaxfit.errors import InputError
from jaxfit.fitting.fit import passes_from, passes_from_boxes


@pytest.mark.parametrize("name", DETECTORS)
def test_boxes_of_a_file_are_fitted_as_their_detector_is(name: str) -> None:
    try:
        detector = DETECTORS[name](Search())
    except InputError:
        pytest.skip("not installed")
    for kind in detector.kinds:
        assert (kind in ROUGH_KINDS) == detector.rough
        assert passes_from_boxes([kind, kind]) == passes_from(detector)
    assert passes_from_boxes([*detector.kinds, "square"]) == 1
    assert passes_from_boxes([]) == 1
