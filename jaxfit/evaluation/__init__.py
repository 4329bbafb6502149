"""How good fits are: errors, curves and statistics."""
