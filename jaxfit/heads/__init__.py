"""3D head models: how landmarks lie on heads, learned from FaceKit or FaceWarehouse, and the one of the package."""

from jaxfit.heads.model import HeadModel, bundled_head_models, learn_head_model, load_head_model, save_head_model
from jaxfit.heads.with_heads import with_heads

__all__ = [
    "HeadModel",
    "bundled_head_models",
    "learn_head_model",
    "load_head_model",
    "save_head_model",
    "with_heads",
]
