"""What `shockley_orderings.py` is made of."""
