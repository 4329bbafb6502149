"""What a landmark's neighbourhood looks like, as a vector; pure JAX, for one landmark."""

from jaxfit.descriptors.dense import Dense
from jaxfit.descriptors.sift import Sift

# What model files, experiments and the command line call them; a new one, as `Descriptor` asks for, is a line here.
DESCRIPTORS = {"sift": Sift, "dense": Dense}
