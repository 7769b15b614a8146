"""The last metres of a track: readings far enough apart to tell something new, as a window for the global search."""

from dataclasses import dataclass, replace

import numpy as np

from app.geometry import Array
from app.positioning.window import Window, WindowFrame

__all__ = ["Reading", "Recent"]


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Samples taken within a cell of the map, averaged: nearer ones tell nothing new.

    number, t_s      of the last of them, and their mean time
    B_uT             (3,) or (1,) their mean, in the track's frame
    samples          how many they were
    displacement_m   (3,) where they were taken, on average
    yaw_rad, device_to_frame   of the device at the last of them
    unseen_m         that a device which does not know how it moves may have walked since the reading before
    disturbed        it was found to be of no place: it is not searched for
    """

    number: int
    t_s: float
    B_uT: Array
    samples: int
    displacement_m: Array
    yaw_rad: float
    device_to_frame: Array | None
    unseen_m: float = 0.0
    disturbed: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Recent:
    """Readings in order, and the distance walked up to each."""

    readings: tuple[Reading, ...] = ()
    path_m: tuple[float, ...] = ()

    @property
    def length_m(self) -> float:
        return self.path_m[-1] - self.path_m[0] if self.path_m else 0.0

    def with_reading(self, reading: Reading, path_m: float, keep_m: float) -> "Recent":
        """And one more; what is farther behind than `keep_m` is forgotten."""
        first = int(np.searchsorted(self.path_m, path_m - keep_m)) if self.path_m else 0
        return Recent((*self.readings[first:], reading), (*self.path_m[first:], path_m))

    def with_last_disturbed(self) -> "Recent":
        """The last reading marked."""
        return Recent((*self.readings[:-1], replace(self.readings[-1], disturbed=True)), self.path_m)

    def undisturbed(self) -> "Recent":
        """Without the readings that were disturbed."""
        if not any(reading.disturbed for reading in self.readings):
            return self
        kept = [k for k, reading in enumerate(self.readings) if not reading.disturbed]
        return Recent(tuple(self.readings[k] for k in kept), tuple(self.path_m[k] for k in kept))

    def window(
        self, frame: WindowFrame, noise_uT: float, heading_rad: float | None, heading_sd_rad: float | None
    ) -> Window:
        """The readings as a window whose frame is the track's."""
        displacement = np.array([each.displacement_m for each in self.readings])
        tilt = [each.device_to_frame for each in self.readings]
        samples = float(np.mean([each.samples for each in self.readings]))
        return Window(
            frame=frame,
            B_uT=np.array([each.B_uT for each in self.readings]),
            displacement_m=displacement - displacement[0],
            noise_uT=noise_uT / np.sqrt(samples),
            heading_rad=heading_rad,
            heading_sd_rad=heading_sd_rad,
            yaw_rad=np.array([each.yaw_rad for each in self.readings]),
            device_to_frame=None if any(each is None for each in tilt) else np.array(tilt),
        )
