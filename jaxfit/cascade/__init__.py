"""The cascade of linear regressors: fitting batches of crops in one jitted function, and training."""

from jaxfit.cascade.fit import Heads, fit_crops, fit_face, fit_heads
from jaxfit.cascade.greedy import Greedy
from jaxfit.cascade.model import Cascade, first_steps
from jaxfit.cascade.starts import Starts
from jaxfit.cascade.tuning import Tuning
from jaxfit.image.disturb import Disturbance

__all__ = [
    "Cascade",
    "Disturbance",
    "Greedy",
    "Heads",
    "Starts",
    "Tuning",
    "first_steps",
    "fit_crops",
    "fit_face",
    "fit_heads",
]
