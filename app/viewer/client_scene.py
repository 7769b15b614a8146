"""What one connected browser sees: its own scene, drawn as its page asks, never another's.

Everything is in the client's scope of viser, so two people looking at the same building do not move each other, and
nothing of an organisation is in the server's shared scene. The page's controls are not viser's: they ask over HTTP.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np

from app.geometry import Array
from app.viewer import scene as draw
from app.viewer.asked import CameraPose, Marks, Shown, Target
from app.viewer.chosen import Chosen, choose
from app.viewer.floor_scene import DrawnFloor, ShownFloor, layer_scale, norm_scale, residual_scale
from app.viewer.layers import ColourScale, about_layer
from app.viewer.legends import legend
from app.viewer.marks import likelihood_legend
from app.viewer.picture import Marked, Picked, Picture, SupportView, floors_in_words
from app.viewer.pointing import camera_ray, kept_upright, plane_hit, supporting_walks

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle

    from app.viewer.content import OrganisationContent

__all__ = ["ClientScene"]


class ClientScene:
    """The scene of one client. Thread-safe: a request changes it while the camera moves."""

    def __init__(self, client: ClientHandle, content: OrganisationContent) -> None:
        self._client = client
        self._content = content
        self._lock = threading.RLock()
        self._chosen: Chosen | None = None
        self._floors: list[DrawnFloor] = []
        self._origin_m = np.zeros(3)
        self._separation_m = 0.0
        self._scale: ColourScale | None = None
        self._norm_scale: ColourScale | None = None
        self._residual_scale: ColourScale | None = None
        self._arrows_drawn: object = None
        self._arrow_count = 0
        self._suggested_separation_m = 0.0
        self.asked = Shown()
        self.has_shown = False
        self.has_left = False
        self.marks: dict[str, Marks] = {}
        client.camera.on_update(self._on_camera)

    # -- what the page asks -----------------------------------------------------------------------------------------

    def show(self, asked: Shown, moves_camera: bool = True) -> Picture:
        """Draw what is asked for. Raises InvalidInput for a layer there is none of."""
        with self._lock:
            chosen = choose(self._content, asked)
            asked = asked.model_copy(update={"walks": chosen.walks})
            same_floors = self._chosen is not None and chosen.stage == self._chosen.stage
            with self._client.atomic():
                if not same_floors:
                    self._set_stage(chosen)
                self._separate(asked.separation_m)
                self._fill(chosen, asked)
                self._apply_visibility(asked)
            self._chosen, self.asked, self.has_shown = chosen, asked, True
            self._move_camera(asked, first=moves_camera and not same_floors)
            self._draw_arrows(asked)
            return self._in_words(chosen, asked)

    def mark(self, marks: Marks) -> Marked:
        """Draw positions over the floors in place of the last of their kind; floors that are not shown are left out.

        The layer is dimmed under it.
        """
        with self._lock:
            self.marks = self.marks | {marks.of: marks}
            with self._client.atomic():
                for drawn in self._floors:
                    self._draw_layer(drawn, drawn.shown)
                    drawn.draw_marks(marks)
            return Marked(likelihood_legend=likelihood_legend() if marks.likelihood else None)

    def pick(self, target: Target) -> Picked | None:
        """What is known where a point of the picture lies; None where there is no mapped floor behind it."""
        with self._lock:
            camera = self._client.camera
            position = np.asarray(camera.position, dtype=np.float64)
            direction = camera_ray(camera.wxyz, camera.fov, camera.aspect, target.u, target.v)
            hits = []
            for rank, drawn in enumerate(self._floors):
                lift_m = rank * self._separation_m - self._origin_m[2]
                hit = plane_hit(position, direction, drawn.shown.height_m + lift_m)
                if hit is not None and drawn.shown.grid is not None:
                    point_m = np.array([*(hit[1][:2] + self._origin_m[:2]), drawn.shown.height_m])
                    hits.append((hit[0], drawn.shown, point_m))
            found = [
                self._picked(floor, point_m, target.surveys) for _, floor, point_m in sorted(hits, key=lambda h: h[0])
            ]
            inside = [picked for picked in found if picked is not None]
            return next((picked for picked in inside if picked.measured), inside[0] if inside else None)

    def camera(self) -> CameraPose:
        """Where the camera is now, in building metres (floors as they lie, not as they are pulled apart)."""
        with self._lock:
            camera, origin = self._client.camera, self._origin_m
            position, target = kept_upright(camera.wxyz, np.asarray(camera.position), np.asarray(camera.look_at))
            return CameraPose(position_m=(position + origin).tolist(), look_at_m=(target + origin).tolist())

    def resume(self, before: ClientScene) -> None:
        """Show what another scene of the same view showed, where its camera still is."""
        self.marks = before.marks
        if before.has_shown:
            self.show(before.asked.model_copy(update={"camera": "keep"}), moves_camera=False)

    def belongs_to(self, client: ClientHandle) -> bool:
        return self._client is client

    def clear(self) -> None:
        """The client has left: let go of maps and nodes; what was asked for stays known."""
        with self._lock:
            self.has_left = True
            self._chosen, self._floors, self._scale, self._norm_scale = None, [], None, None

    # -- drawing ----------------------------------------------------------------------------------------------------

    def _set_stage(self, chosen: Chosen) -> None:
        """An empty scene with the floors' frames, outlines, labels and the ground."""
        grids = [f.grid for f in chosen.floors if f.grid is not None]
        rings = [ring for f in chosen.floors for ring in f.floor.rings_m]
        self._origin_m = draw.local_origin_m(grids, rings, [walk for f in chosen.floors for walk in f.walks])
        scene = self._client.scene
        scene.reset()
        slab_m = min((f.floor.elevation_m for f in chosen.floors), default=0.0)
        draw.draw_ground(scene, "/ground", grids, self._origin_m, slab_m - 0.02)
        self._floors = [DrawnFloor(scene, f"/floor {k}", f, self._origin_m) for k, f in enumerate(chosen.floors)]
        for drawn in self._floors:
            if drawn.shown.floor.plan is not None:
                drawn.draw_plan(self._content.plan(drawn.shown.floor))
        self._arrows_drawn = None
        self._suggested_separation_m = draw.suggested_separation_m(grids)

    def _fill(self, chosen: Chosen, asked: Shown) -> None:
        """The layer, the walks and the marks on the floors."""
        self._scale = layer_scale(chosen.floors, chosen.layer)
        self._norm_scale = self._scale if chosen.layer == "norm" else norm_scale(chosen.floors)
        self._residual_scale = residual_scale(chosen.floors)
        for drawn, shown in zip(self._floors, chosen.floors, strict=True):
            self._draw_layer(drawn, shown)
            if asked.walks:
                drawn.draw_walks(self._residual_scale)
            for marks in self.marks.values():
                drawn.draw_marks(marks)

    def _draw_layer(self, drawn: DrawnFloor, shown: ShownFloor) -> None:
        if self._scale is not None:
            drawn.draw_layer(shown, self._scale, self.marks.values())

    def _separate(self, separation_m: float | None) -> None:
        self._separation_m = self._suggested_separation_m if separation_m is None else separation_m
        for rank, drawn in enumerate(self._floors):
            drawn.frame.position = (0.0, 0.0, rank * self._separation_m)

    def _apply_visibility(self, asked: Shown) -> None:
        for drawn in self._floors:
            for kind, node in drawn.nodes.items():
                node.visible = bool(getattr(asked, kind))

    def _draw_arrows(self, asked: Shown) -> None:
        """Arrows around what the camera looks at, closer together the nearer it is; nothing when that is as it was."""
        camera, grids = self._client.camera, [d.shown.grid for d in self._floors if d.shown.grid is not None]
        if not grids or self._norm_scale is None or not asked.arrows:
            return
        finest_m = max(grid.resolution_m for grid in grids)
        spacing_m, box = draw.arrow_view(np.asarray(camera.position), np.asarray(camera.look_at), finest_m)
        box_m = (box[0] + self._origin_m[0], box[1] + self._origin_m[1],
                 box[2] + self._origin_m[0], box[3] + self._origin_m[1])  # fmt: skip
        wanted = (
            spacing_m,
            box_m,
            self._norm_scale,
            tuple((d.shown.map_id, d.shown.height_index) for d in self._floors),
        )
        if wanted == self._arrows_drawn:
            return
        with self._client.atomic():
            self._arrow_count = sum(
                drawn.draw_arrows(self._norm_scale, spacing_m, box_m, asked.arrows) for drawn in self._floors
            )
        self._arrows_drawn = wanted

    def _on_camera(self, _: CameraHandle) -> None:
        with self._lock:
            if self._chosen is not None:
                self._draw_arrows(self.asked)

    def _move_camera(self, asked: Shown, first: bool) -> None:
        """As asked; a new building or floor is looked at from the usual place unless a pose is given."""
        if asked.camera == "keep" and not first:
            return
        if isinstance(asked.camera, CameraPose):
            position, target = (np.array(p) - self._origin_m for p in (asked.camera.position_m, asked.camera.look_at_m))
        else:
            position, target = self._usual_pose(asked.camera == "top", asked.aspect)
        with self._client.atomic():
            self._client.camera.position = position
            self._client.camera.look_at = target

    def _usual_pose(self, top: bool, aspect: float) -> tuple[Array, Array]:
        shown = [drawn.shown for drawn in self._floors]
        grids = [s.grid for s in shown if s.grid is not None]
        highest_map_m = max((float(grid.heights_m[-1]) for grid in grids), default=0.0)
        highest_m = max([highest_map_m, *(s.floor.elevation_m for s in shown)])
        spread_m = self._separation_m * max(len(self._floors) - 1, 0) + highest_m - highest_map_m
        return draw.camera_pose(grids, self._origin_m, top, spread_m, aspect)

    # -- words ------------------------------------------------------------------------------------------------------

    def _in_words(self, chosen: Chosen, asked: Shown) -> Picture:
        """What is drawn now."""
        about, residuals = about_layer(chosen.layer), self._residual_scale
        grids = [f.grid for f in chosen.floors if f.grid is not None]
        return Picture(
            building_id=chosen.building_id,
            floor_id=chosen.floor_id,
            map_id=chosen.floors[0].map_id if chosen.floor_id and chosen.floors else None,
            layer=chosen.layer,
            height_m=chosen.height_m,
            heights_m=list(chosen.heights_m),
            layers=chosen.layers,
            legend=legend(about.title, about.unit, self._scale) if grids and self._scale else None,
            walks_legend=legend("Survey walks: measured less map, over 1 m", "µT", residuals) if residuals else None,
            floors=floors_in_words(chosen.floors),
            ground_m=draw.ground_cell_m(grids),
            separation_m=self._separation_m,
            arrows=self._arrow_count if asked.arrows else 0,
            walks=bool(asked.walks),
            notes=list(chosen.notes),
        )

    def _picked(self, floor: ShownFloor, point_m: Array, surveys: bool) -> Picked | None:
        """What is known at a place of a floor; None outside its map."""
        grid, values = floor.grid, floor.values
        assert grid is not None
        assert values is not None
        assert floor.map_id is not None
        i, j = (int(n) for n in np.round((point_m[:2] - np.array(grid.origin_m)) / grid.resolution_m))
        if not (0 <= j < values.shape[0] and 0 <= i < values.shape[1]):
            return None
        at = grid.at(point_m[None, :])
        measured = bool(at.measured[0])
        layer = self._chosen.layer if self._chosen else "norm"
        about = about_layer(layer)
        return Picked(
            floor_id=floor.floor.id, floor=floor.floor.name, map_id=floor.map_id, point_m=point_m.tolist(),
            measured=measured, components=list(grid.component_names),
            mean_ut=at.mean_uT[0].tolist() if measured else None, sd_ut=at.sd_uT[0].tolist() if measured else None,
            norm_ut=float(np.linalg.norm(at.mean_uT[0])) if measured else None,
            layer=layer, layer_title=about.title, layer_unit=about.unit,
            layer_value=float(values[j, i]) if np.isfinite(values[j, i]) else None,
            surveys=_supports(floor, point_m) if surveys else None,
        )  # fmt: skip


def _supports(floor: ShownFloor, point_m: Array) -> list[SupportView]:
    assert floor.grid is not None
    return [
        SupportView(survey_id=s.survey_id, name=s.name, samples=s.samples, nearest_m=s.nearest_m,
                    residual_ut=None if s.residual_uT is None else list(s.residual_uT))
        for s in supporting_walks(floor.grid, floor.walks, point_m)
    ]  # fmt: skip
