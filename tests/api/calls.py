"""A call of every route there is, with a body that fits it: for tests that go over all of them."""

import re
from io import BytesIO
from typing import Any

from PIL import Image

OUTLINE = {"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, 5], [0, 5], [0, 0]]]}
WINDOW = {"window": {"frame": "norm", "b_ut": [50.0], "displacement_m": [[0, 0, 0]]}}
BODIES: dict[str, Any] = {
    "/v1/buildings/{building_id}/floors": {"name": "x", "ordinal": 1},
    "/v1/floors/{floor_id}/maps": {},
    "/v1/maps/{map_id}/field": {"points_m": [[0, 0, 0]]},
    "/v1/surveys/{survey_id}": {"included": True},
    "/v1/floors/{floor_id}/outline": OUTLINE,
    "/v1/buildings/{building_id}/floors:import": {"type": "FeatureCollection", "features": []},
    "/v1/buildings/{building_id}": {},
    "/v1/floors/{floor_id}": {},
    "/v1/tracks/{track_id}/steps": {"steps": [{"number": 0, "t_s": 0.0}]},
    "/v1/calibrations": {"device": "x", "reference": {"magnitude_ut": 50.0}, "b_ut": [[50.0, 0.0, 0.0]] * 2},
    "/v1/attitudes": {
        "t_s": [0.0, 0.1],
        "gyro_rad_per_s": [[0, 0, 0]] * 2,
        "accelerometer_m_per_s2": [[0, 0, 9.8]] * 2,
        "reference": {"kind": "none"},
    },
}
QUERIES = {
    "/v1/maps/{map_id}/export": {"format": "csv"},
    "/v1/floors/{floor_id}/plan": {"metres_per_pixel": "0.1"},
}


def routes(app: Any) -> list[tuple[str, str]]:
    """Method and path of every operation in the contract."""
    schema = app.openapi()
    return sorted((method.upper(), path) for path, item in schema["paths"].items() for method in item)


def call(http: Any, method: str, path: str, ids: dict[str, str], headers: dict[str, str]) -> Any:
    """Call a route with these ids in its path. An id that is not among them is a route that no test knows yet."""
    url = re.sub(r"{(\w+)}", lambda name: ids[name[1]], path)
    arguments: dict[str, Any] = {"headers": headers, "params": QUERIES.get(path)}
    if path.endswith(("/surveys", "floor_id}/replay")) and method == "POST":
        arguments["content"] = b"t_s\n"
    elif method in ("POST", "PATCH", "PUT"):
        body = {"queries": [WINDOW]} if path.endswith(":batch") else WINDOW if path.endswith("locate") else None
        arguments["json"] = BODIES.get(path, body)
    return http.request(method, url, **arguments)


def picture() -> bytes:
    """A small PNG."""
    data = BytesIO()
    Image.new("RGB", (40, 30)).save(data, "PNG")
    return data.getvalue()
