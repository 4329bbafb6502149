"""The thesis that jaxfit implements: its claims, and its numbers beside those of an experiment that asks for them."""
