"""The picture a page shows while its 3-D canvas is still starting: the chosen layer from above, as a PNG."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from app.viewer.asked import Shown
from app.viewer.chosen import choose
from app.viewer.floor_scene import layer_scale
from app.viewer.scene import surface

if TYPE_CHECKING:
    from app.viewer.content import OrganisationContent

__all__ = ["poster_png"]

_MOST_PX = 700


def poster_png(content: OrganisationContent, asked: Shown) -> bytes | None:
    """The lowest mapped floor of what is asked for, transparent where nothing was measured; None without a map.

    Raises InvalidInput.
    """
    from PIL import Image

    chosen = choose(content, asked.model_copy(update={"walks": False}))
    scale = layer_scale(chosen.floors, chosen.layer)
    for floor in chosen.floors:
        if floor.grid is not None and floor.values is not None:
            picture = surface(floor.grid, floor.values, scale, np.zeros(3), floor.height_index)
            image = Image.fromarray(picture.rgba[::-1])  # rows of the layer run towards +y, those of a PNG down
            image.thumbnail((_MOST_PX, _MOST_PX))
            written = io.BytesIO()
            image.save(written, "PNG", compress_level=1)
            return written.getvalue()
    return None
