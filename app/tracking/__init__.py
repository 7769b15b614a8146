"""Following a device: a step after a step to a track.

The filters of the sources, each a small module, and one that knows more than they do (`track`).
"""
