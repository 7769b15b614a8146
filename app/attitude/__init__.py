"""An orientation, and whether the field that tells it is disturbed."""
