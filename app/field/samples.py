"""One walk's samples: what a survey file becomes and what a map is fitted from."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from app.errors import IncompatibleFrames
from app.geometry import Array, horizontal_and_vertical, path_length_m

__all__ = ["COMPONENT_NAMES", "Components", "SampleFrame", "Samples", "richest_components"]

Components = Literal["vector", "level", "norm"]
SampleFrame = Literal["building", "level", "norm"]

COMPONENT_NAMES: dict[Components, tuple[str, ...]] = {
    "vector": ("bx", "by", "bz"),
    "level": ("horizontal", "vertical"),
    "norm": ("norm",),
}
_ANSWERS: dict[SampleFrame, tuple[Components, ...]] = {
    "building": ("vector", "level", "norm"),
    "level": ("level", "norm"),
    "norm": ("norm",),
}


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """The samples of one walk, in order of time.

    t_s                    (n,) seconds, strictly increasing
    p_building_m           (n, 3) positions in the building frame
    B_uT                   (n, 3) field in `frame`; (n, 1) when `frame` is "norm"
    frame                  "building", "level" (gravity-levelled, yaw unknown, may change along the walk) or "norm"
    q_body_to_building     (n, 4) scalar-first attitude of the sensor, where the file knew it, else None
    session                label of the sensor's calibration session: samples that share it share one hard-iron
                           offset in the body frame; None when nothing is known
    """

    t_s: Array
    p_building_m: Array
    B_uT: Array
    frame: SampleFrame
    q_body_to_building: Array | None = None
    session: str | None = None

    def __post_init__(self) -> None:
        n = len(self.t_s)
        columns = 1 if self.frame == "norm" else 3
        assert self.p_building_m.shape == (n, 3), self.p_building_m.shape
        assert self.B_uT.shape == (n, columns), self.B_uT.shape
        assert self.q_body_to_building is None or self.q_body_to_building.shape == (n, 4)

    def __len__(self) -> int:
        return len(self.t_s)

    def features(self, components: Components) -> Array:
        """The columns a map of `components` is fitted from: (n, 3), (n, 2) or (n, 1), uT.

        Raises IncompatibleFrames when this walk cannot give them (a level walk has no heading).
        """
        if components not in _ANSWERS[self.frame]:
            raise IncompatibleFrames(
                f"a survey in the {self.frame} frame cannot give a {components} map; "
                f"ask for {' or '.join(_ANSWERS[self.frame])}, or survey with orientation"
            )
        if components == "vector" or self.frame == "norm":
            return self.B_uT
        if components == "level":
            return horizontal_and_vertical(self.B_uT)
        return np.asarray(np.linalg.norm(self.B_uT, axis=1, keepdims=True))

    def path_length_m(self) -> Array:
        """(n,) distance walked since the first sample, along the floor."""
        return path_length_m(self.p_building_m)


def richest_components(frames: set[SampleFrame]) -> Components:
    """The richest components every one of these frames can give: vector, else level, else norm."""
    for components in ("vector", "level", "norm"):
        if all(components in _ANSWERS[frame] for frame in frames):
            return components
    raise AssertionError(frames)
