import numpy as np
import pytest

from jaxfit.errors import InputError
from jaxfit.image.frame import Frame


@pytest.mark.parametrize("crop", [48, 49])
def test_the_middle_is_the_mean_of_the_pixel_centres(crop):
    assert Frame(crop=crop, face=24.0).middle == np.arange(crop).mean()


@pytest.mark.parametrize(("crop", "face"), [(48, 49.0), (48, 7.0), (5000, 90.0), (48, -1.0), (48, float("nan"))])
def test_impossible_sizes_are_refused(crop, face):
    with pytest.raises(InputError, match=f"got face {face}, crop {crop}"):
        Frame(crop=crop, face=face)


@pytest.mark.parametrize("shift", [float("nan"), float("inf"), -11.0])
def test_impossible_shifts_are_refused(shift):
    with pytest.raises(InputError, match=f"shift of {shift}"):
        Frame(shift=shift)
