"""The window and the sensor of a forecast, as query parameters of everything that tells of expected errors."""

from typing import Annotated, Literal, NamedTuple

from fastapi import Depends, Query, Request

from app.api.models import Finite
from app.errors import Fault, InvalidInput
from app.field.expected_error import UNKNOWN_HEADING_SD_RAD, WindowModel

__all__ = ["AskedWindow", "AskedWindowDep", "Knowledge"]

Knowledge = Literal["known", "unknown"]


class AskedWindow(NamedTuple):
    window_m: float
    noise_ut: float
    bias: Knowledge
    heading: Knowledge

    def model(self) -> WindowModel:
        return WindowModel(
            length_m=self.window_m,
            noise_uT=self.noise_ut,
            bias_sd_uT=0.0 if self.bias == "known" else float("inf"),
            heading_sd_rad=0.0 if self.heading == "known" else UNKNOWN_HEADING_SD_RAD,
        )

    def of_layer(self, request: Request, layer: str) -> tuple[object, ...]:
        """What a layer makes use of. Raises InvalidInput for parameters in the request that it does not."""
        used = _OF_LAYER.get(layer, ())
        idle = [name for name in self._fields if name in request.query_params and name not in used]
        if idle:
            takes = f"it takes {', '.join(used)}" if used else "it takes neither window nor sensor"
            reason = f"does not belong to the layer {layer}: {takes}"
            raise InvalidInput(f"{idle[0]} {reason}", *[Fault(f"/query/{name}", reason) for name in idle])
        return tuple(getattr(self, name) for name in used)


_OF_LAYER: dict[str, tuple[str, ...]] = {"expected_error": AskedWindow._fields, "information": ("noise_ut",)}


async def _asked_window(
    window_m: Annotated[Finite, Query(ge=1.0, le=50.0, description="distance walked per window")] = 10.0,
    noise_ut: Annotated[Finite, Query(ge=0.0, le=1000.0, description="white noise of one reading, per axis")] = 0.5,
    bias: Annotated[Knowledge, Query(description="a constant offset of the sensor (unknown: demeaned)")] = "known",
    heading: Annotated[Knowledge, Query(description="of the window's frame")] = "unknown",
) -> AskedWindow:
    return AskedWindow(window_m, noise_ut, bias, heading)


AskedWindowDep = Annotated[AskedWindow, Depends(_asked_window)]
